"""Sightings of landmarks against the wheels' motion, and against a map: mounting, scale, lag and noise of their sensor.

A landmark that stands still is at one place, whatever the robot does meanwhile: that tells how its sensor is mounted
and reports, without a map. On a map, the wheels' path is laid onto it over short stretches.

Source: Umeyama 1991 (similarity of point sets).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fgloc.diagnosis.pairs import (
    BLOCKS,
    CAUCHY,
    MAD,
    MOST_LAG_S,
    SITS,
    TURN,
    ComplexArray,
    Figure,
    complex_poses,
    irls,
    jackknife,
)
from fgloc.diagnosis.signals import Path, Sightings
from fgloc.instrumentation import give_way
from fgloc.stats import few_samples
from fgloc.types import FloatArray, IntArray

_LAG_STEP_S = 0.05
_NUDGE_S = 1e-3
_PAIR_S = (0.4, 6.0)  # between two sightings of one landmark: the wheels err little over seconds
_MOST_PAIRS = 4000
_FEWEST_TRACKS = 5  # landmarks times _TRACK_S: the errors of one track are alike, and fewer are no sample
_MOST_LOG_SCALE = 10.0  # beyond any unit of length
_GAINS = 2.5  # standard deviations of the gain from track to track: noise of the wheels gains up to 2.4
_MOST_OF_TRACKS = 3000  # sightings, evenly chosen
_TRACK_S = 6.0  # over which one landmark's sightings are held against the wheels
_MAP_WINDOWS_S = (8.0, 20.0, 50.0)  # over which landmarks are compared with a map: the shortest that shows three
_COARSE_S = (20.0, 50.0, 120.0, 300.0)  # likewise where one is in view at a time
_COARSE_MISFIT, _COARSE_OF_THREE = 0.25, 0.1  # of a map so compared; three landmarks fit many maps
_CLEARLY, _NO_DOUBT = 0.5, 0.05  # of the misfit of all others; misfit by the wheels' drift alone
_FITS, _IN_PART = (
    0.1,
    0.25,
)  # largest misfit of a window that the map fits; share of such windows of one that fits in part
_MAP_STEP, _FEWEST_WINDOWS = 0.625, 3  # from window to window, in their widths; of windows with three landmarks
_STEEPEST = 30.0  # of a prior's cost: its exponential is a number
_WINDOW_S = (
    20.0  # over which the wheels' path is laid on the map: shorter ones hardly turn, and leave range and place alike
)
_OF_THREE = 0.05  # least sigma of the scale of a map of which three landmarks are seen: only a unit is told by them
_SPREAD_M = 0.5  # of the landmarks of a window, for its yaw
_ROUNDS = 3  # of the noise and the fit
_FEWEST_ON_MAP = 100  # sightings
_LONGEST_CORRELATION_S = 2.0

AXES: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    # forward and left in the sensor's axes, each as (axis, sign); up completes them to a right-handed frame
    "body": ((0, 1), (1, 1)),
    "optical": ((2, 1), (0, -1)),
    "body, upside down": ((0, 1), (1, -1)),
    "optical, upside down": ((2, 1), (0, 1)),
    "x up": ((2, 1), (1, -1)),  # an optical frame turned by a quarter about its axis
    "x down": ((2, 1), (1, 1)),
}


@dataclass(frozen=True, slots=True)
class Mounting:
    """How a sensor of landmarks is mounted and reports, by the wheels' motion alone.

    Attributes:
        axes: name in `AXES`.
        scale: true over reported distance, in the wheels' unit of length.
        yaw: of the sensor's forward axis in the base frame [rad].
        x: place of the sensor in the base frame [m].
        y: likewise.
        late_s: how much later the sensor's stamps are than the wheels'.
        turns: the robot's turn over the wheels': a path that turns too much looks like a sensor further back, or late.
        misfit: robust standard deviation of a landmark's place between two sightings, in the sensor's unit of length.
    """

    axes: str
    scale: Figure
    yaw: Figure
    x: Figure
    y: Figure
    late_s: Figure
    turns: Figure
    misfit: float


def planar(points: FloatArray, axes: str) -> ComplexArray:
    """Points ``(n, 3)`` in the plane of the base: forward + i left, ``(n,)``, for a sensor that looks ahead."""
    (i, a), (j, b) = AXES[axes]
    return np.asarray(a * points[:, i] + 1j * b * points[:, j])


def rotation_to_base(axes: str) -> FloatArray:
    """Rotation ``(3, 3)`` from the sensor's axes to forward, left and up."""
    (i, a), (j, b) = AXES[axes]
    forward, left = np.zeros(3), np.zeros(3)
    forward[i], left[j] = a, b
    return np.array([forward, left, np.cross(forward, left)])


def _robust(errors: FloatArray) -> float:
    """Standard deviation of errors about zero, by their median size."""
    return MAD * float(np.median(np.abs(errors)))


def _wander(heights: FloatArray, tracks: IntArray) -> float:
    """Robust standard deviation of heights within a track [m]: on a flat floor a landmark keeps its height."""
    _, number = np.unique(tracks, return_inverse=True)
    mean = np.bincount(number, heights) / np.bincount(number)
    return _robust(heights - mean[number])


def fit_sightings(
    path: Path, seen: Sightings, names: Sequence[str] | None = None, turn_sigma: float = TURN
) -> dict[str, Mounting]:
    """Mounting for each hypothesis of the sensor's axes that the sightings determine, by name.

    Args:
        path: motion of the wheels.
        seen: landmarks in the sensor's axes.
        names: of the hypotheses; None: all that such a sensor can have.
        turn_sigma: prior of the share by which the robot turns more or less than the wheels say.
    """
    first, last = _pairs(seen, path)
    if len(first) < 60:
        return {}
    names = names or (list(AXES) if seen.spatial else ["body", "body, upside down"])
    planes = {name: planar(seen.points, name) for name in names}
    found: dict[str, tuple[float, float, complex, complex]] = {}
    for late in np.arange(-MOST_LAG_S, MOST_LAG_S + 1e-9, _LAG_STEP_S).tolist():
        poses = (*complex_poses(path, seen.times[first] - late), *complex_poses(path, seen.times[last] - late))
        for name, z in planes.items():
            alpha, beta, misfit = _similarity(poses, z[first], z[last])
            if misfit < found.get(name, (math.inf,))[0]:
                found[name] = (misfit, late, alpha, beta)
    least = min((f[0] for f in found.values()), default=math.inf)
    return {
        name: _refined(path, seen, name, planes[name], late, alpha, beta, turn_sigma)
        for name, (misfit, late, alpha, beta) in found.items()
        if misfit < 5.0 * least or name == "body"
    }


def _pairs(seen: Sightings, path: Path) -> tuple[IntArray, IntArray]:
    """Indices of pairs of sightings of one landmark between which the wheels' motion is known, evenly thinned out."""
    found: list[NDArray[np.int64]] = []
    for landmark in np.unique(seen.ids):
        own = np.flatnonzero(seen.ids == landmark)
        at = seen.times[own]
        low, high = np.searchsorted(at, at + _PAIR_S[0]), np.searchsorted(at, at + _PAIR_S[1], side="right")
        counts = np.maximum(high - low, 0)
        left = np.repeat(np.arange(len(own)), counts)
        right = np.arange(len(left)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(low, counts)
        found.append(np.column_stack([own[left], own[right]]))
    pairs = np.concatenate(found) if found else np.zeros((0, 2), dtype=np.int64)
    pairs = pairs[path.known(seen.times[pairs[:, 0]] - MOST_LAG_S, seen.times[pairs[:, 1]] + MOST_LAG_S)]
    pairs = pairs[:: max(1, len(pairs) // _MOST_PAIRS)]
    return pairs[:, 0], pairs[:, 1]


def _similarity(
    poses: tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray], z1: ComplexArray, z2: ComplexArray
) -> tuple[complex, complex, float]:
    """Scale and yaw (as one complex number) and place of the sensor, and the misfit in the sensor's unit.

    A landmark that stands still is at one place: ``p_1 + R_1 (α z_1 + β) = p_2 + R_2 (α z_2 + β)``, which is linear in
    α and β. The poses of the robot are p_1, R_1, p_2, R_2, ``(n,)`` each.
    """
    p1, r1, p2, r2 = poses
    A = np.column_stack([r1 * z1 - r2 * z2, r1 - r2])
    x, residual = irls(A, p2 - p1, 1e-9, SITS)
    size = abs(x[0])
    return complex(x[0]), complex(x[1]), math.inf if size < 1e-9 else float(np.median(residual)) / size


def _refined(
    path: Path,
    seen: Sightings,
    name: str,
    z: ComplexArray,
    late: float,
    alpha: complex,
    beta: complex,
    turn_sigma: float,
) -> Mounting:
    """Least squares in what the sensor reports, so that its noise does not shorten the scale; sigmas by a jackknife."""
    some = _known(path, seen, z)
    some = some[:: max(1, len(some) // _MOST_OF_TRACKS)]
    times, ids, z = seen.times[some], seen.ids[some], z[some]
    tracks = _tracks(times, ids)
    start = np.array([math.log(abs(alpha)), math.atan2(alpha.imag, alpha.real), beta.real, beta.imag, late, 0.0])
    start[2:4] = np.clip(start[2:4], -2.0, 2.0)
    start[4:] += _NUDGE_S  # a step of derivatives is a share of the value: at 0 there is none

    def solve(use: NDArray[np.bool_], x0: FloatArray, sigma: float) -> tuple[FloatArray, _Places, FloatArray]:
        part = _Places(path, times[use], z[use], tracks[use], turn_sigma, sigma)
        fit = _fitted(part.residuals, x0)
        return fit.x, part, part.by_priors(fit.jac)

    everything = np.ones(len(z), dtype=bool)
    x, part, by_priors = solve(everything, start, _Places.SIGMA)
    sigma = part.spread(x)  # of wheels that are bad, places scatter more: a narrow kernel takes some for the truth
    if sigma > _Places.SIGMA:
        x, part, by_priors = solve(everything, x, sigma)
    typical = part.misfit(x)
    blocks = np.minimum(((times - times[0]) / max(times[-1] - times[0], 1e-9) * BLOCKS).astype(int), BLOCKS - 1)
    sigmas = np.full(len(x), np.inf)
    if (samples := len(np.unique(tracks))) >= _FEWEST_TRACKS:
        by_parts = _jackknifed(lambda use: solve(use, x, part.sigma)[0], blocks, _by_landmark(ids))
        # a mounting is named by nothing but this: the errors of a track are alike, and of few tracks all may be
        by_parts[1:4] *= few_samples(samples)
        sigmas = np.hypot(by_parts, by_priors)
    for k in (1, 4):  # the wheels' noise has more than one place where a yaw or a lag fits a little better
        sigmas[k] = _as_sure(x, k, float(sigmas[k]), part.gain)
    scale, yaw, bx, by, late, turn = x.tolist()
    if abs(late) >= MOST_LAG_S or abs(scale) > _MOST_LOG_SCALE:  # it ran to where nothing tells
        sigmas = np.full(len(x), np.inf)
        late, scale = min(max(late, -MOST_LAG_S), MOST_LAG_S), min(max(scale, -_MOST_LOG_SCALE), _MOST_LOG_SCALE)
    height = _wander(seen.points[some] @ rotation_to_base(name)[2], tracks) if seen.spatial else 0.0
    return Mounting(
        name,
        Figure(math.exp(scale), math.exp(scale) * float(sigmas[0])),
        Figure(math.remainder(yaw, math.tau), float(sigmas[1])),
        Figure(bx, float(sigmas[2])),
        Figure(by, float(sigmas[3])),
        Figure(late, float(sigmas[4])),
        Figure(1.0 + turn, float(sigmas[5])),
        math.hypot(typical, height),
    )


def compared(path: Path, first: Sightings, second: Sightings, m: Mounting, places: dict[int, FloatArray]) -> Figure:
    """How much better the second of two readings of the same sightings explains them: mean gain of cost of a track.

    Each reading has the mounting that suits it best. With a map (three landmarks or more) landmarks are where it has
    them, else each is at the mean place of its track by the wheels. The sigma is by the scatter from track to track;
    infinite: too little is seen.

    Args:
        path: motion of the wheels.
        first: sightings, read in one way.
        second: the same, in another.
        m: mounting by the first.
        places: ``(2,)`` of landmarks on the map [m], by id; empty: no map.
    """
    tracks = np.zeros(0, dtype=np.int64)
    spreads: list[FloatArray] = []
    errors: list[FloatArray] = []
    for seen in (first, second):
        z = planar(seen.points, m.axes)
        on_map = _OnMap(path, seen, z, places) if len(places) > 2 else None
        if on_map is not None and len(on_map) >= _FEWEST_ON_MAP and on_map.window.max() >= 2:
            along, across, _ = on_map.errors(on_map.adapted(_start(m)))
            times, ids = on_map.times, on_map.ids
        else:
            some = _known(path, seen, z)
            some = some[:: max(1, len(some) // _MOST_OF_TRACKS)]
            times, ids, z = seen.times[some], seen.ids[some], z[some]
            if len(z) < _FEWEST_ON_MAP:
                return Figure(0.0, math.inf)
            part = _Places(path, times, z, _tracks(times, ids))
            along, across = part.errors(_fitted(part.residuals, _of_track(m)).x)
        errors.append(np.array([along, across]))
        spreads.append(MAD * np.median(np.abs(errors[-1]), axis=1))
        tracks = np.unique(_tracks(times, ids), return_inverse=True)[1]
    least = np.maximum(np.min(spreads, axis=0), 1e-4)[:, None]
    before, after = ((e / (CAUCHY * least)).ravel() for e in errors)
    return _gain(before, after, tracks)


def _known(path: Path, seen: Sightings, z: ComplexArray) -> IntArray:
    """Indices of the sightings ``z (n,)`` about whose time the wheels' motion is known, whatever their lag."""
    known = path.known(seen.times - MOST_LAG_S - 0.1, seen.times + MOST_LAG_S + 0.1)
    return np.flatnonzero(known & (np.abs(z) > 1e-6))


def _fitted(residuals: Callable[[FloatArray], FloatArray], start: FloatArray) -> Any:
    """Least squares with Cauchy's loss, as scipy has it."""
    return least_squares(residuals, start, loss="cauchy", diff_step=1e-4, max_nfev=30)


def _start(m: Mounting) -> FloatArray:
    """Start values ``(7,)`` of `_OnMap.solve` from a mounting."""
    place = np.clip([m.x.value, m.y.value], -1.0, 1.0)
    return np.array([0.0, 0.0, m.yaw.value, *place, m.late_s.value + _NUDGE_S, m.turns.value - 1.0 + _NUDGE_S])


def _of_track(m: Mounting) -> FloatArray:
    """Start values ``(6,)`` of `_Places.residuals` from a mounting."""
    return np.array([math.log(max(m.scale.value, 1e-9)), *_start(m)[2:]])


def _jackknifed(estimate: Callable[[NDArray[np.bool_]], FloatArray], *partitions: IntArray) -> FloatArray:
    """Standard deviations ``(p,)``: the larger of those by several partitions into blocks; infinite: too few blocks."""
    sigmas = []
    for blocks in partitions:
        left_out = [estimate(blocks != b) for b in range(BLOCKS) if 0 < (blocks == b).sum() < len(blocks)]
        if len(left_out) > 2:
            sigmas.append(jackknife(np.array(left_out)))
    return np.asarray(np.max(sigmas, axis=0) if sigmas else np.inf * np.ones_like(estimate(blocks >= 0)))


def _by_landmark(ids: IntArray) -> IntArray:
    """Block of the jackknife of each sighting, by its landmark: the errors of one landmark are alike at all times."""
    return np.asarray(np.unique(ids, return_inverse=True)[1] % BLOCKS, dtype=np.int64)


def _tracks(times: FloatArray, ids: IntArray) -> IntArray:
    """Number of the track of each sighting: one landmark over some seconds."""
    out = np.zeros(len(times), dtype=np.int64)
    begun: dict[int, tuple[float, int]] = {}
    count = 0
    for k, (at, landmark) in enumerate(zip(times.tolist(), ids.tolist(), strict=True)):
        start, number = begun.get(landmark, (-math.inf, -1))
        if at - start > _TRACK_S:
            start, number, count = at, count, count + 1
            begun[landmark] = (start, number)
        out[k] = number
    return out


def _gain(before: FloatArray, after: FloatArray, tracks: IntArray) -> Figure:
    """Mean gain of cost of a track, with its sigma by the scatter from track to track; infinite: they are too few.

    What only noise explains fits better in some tracks and worse in others.

    Args:
        before: white residuals ``(2 n,)``.
        after: likewise.
        tracks: ``(n,)`` number of the track of each pair.
    """
    costs = [np.log1p(r**2).reshape(2, -1).sum(axis=0) for r in (before, after)]
    gains = np.bincount(tracks, costs[0] - costs[1]) / np.bincount(tracks)
    if len(gains) < _FEWEST_TRACKS:
        return Figure(0.0, math.inf)
    return Figure(float(gains.mean()), float(gains.std(ddof=1)) / math.sqrt(len(gains)) + 1e-9)


def _as_sure(x: FloatArray, k: int, sigma: float, gain: Callable[[FloatArray, int], Figure]) -> float:
    """Sigma of the unknown ``k`` of a fit; where the fit gains by it no more than by noise, it is wider."""
    size = abs(float(x[k]))
    if size < 2.0 * sigma:
        return sigma
    gained = gain(x, k)
    gains = gained.value / gained.sigma
    return sigma if gains > _GAINS else max(sigma, size / max(gains, 0.5))


class _Places:
    """Residuals of sightings against the mean place of their track."""

    SIGMA = 0.03  # of a range over its length, and of a bearing [rad], unless they scatter more
    PLACE_M = 0.3  # prior of the sensor's place: it sits on the robot

    def __init__(
        self,
        path: Path,
        times: FloatArray,
        z: ComplexArray,
        tracks: IntArray,
        turn_sigma: float = TURN,
        sigma: float = SIGMA,
    ) -> None:
        self.sigma = sigma
        self._turn_sigma = turn_sigma
        _, self._tracks = np.unique(tracks, return_inverse=True)
        self._path, self._times, self._z = path, times, z
        self._turned = (0.0, path)
        self._counts = np.bincount(self._tracks)
        # sightings of one landmark within a second count as one; to the fit they are many
        self._repeated = len(times) / len(np.unique(np.column_stack([self._tracks, times.astype(np.int64)]), axis=0))

    def residuals(self, x: FloatArray) -> FloatArray:
        """``(2 n + 3,)``: along and across the line of sight, over the range, in units of `sigma`; and the priors."""
        give_way()
        scale, yaw, bx, by, late, turn = x.tolist()
        alpha, beta = math.exp(min(scale, 50.0)) * np.exp(1j * yaw), complex(bx, by)
        if turn != self._turned[0]:
            self._turned = (turn, self._path.turned(1.0 + turn))
        p, r = complex_poses(self._turned[1], self._times - min(max(late, -MOST_LAG_S), MOST_LAG_S))
        q = p + r * (alpha * self._z + beta)
        real, imaginary = (np.bincount(self._tracks, part) / self._counts for part in (q.real, q.imag))
        place = (real + 1j * imaginary)[self._tracks]
        # in the sensor: what would be seen of that place, over what was seen; 1 if they agree
        ratio = ((place - p) / r - beta) / (alpha * self._z)
        off = (ratio - 1.0) / self.sigma
        off = np.where(np.isfinite(off), off, 1e3)
        prior = self._repeated * np.square([bx / self.PLACE_M, by / self.PLACE_M, turn / self._turn_sigma])
        # a prior is no outlier: such that the robust loss of it is its square
        steep = np.sqrt(np.expm1(np.minimum(prior, _STEEPEST))) * np.maximum(prior / _STEEPEST, 1.0)
        return np.concatenate([off.real, off.imag, steep])

    def by_priors(self, jacobian: FloatArray) -> FloatArray:
        """Standard deviations ``(6,)`` of the unknowns by what the priors may be off by, at a fit's Jacobian."""
        priors = np.array([self.PLACE_M, self.PLACE_M, self._turn_sigma])
        J, information = jacobian[: 2 * len(self._z)], np.zeros(6)
        information[[2, 3, 5]] = self._repeated * priors**-2.0
        means = np.linalg.pinv(J.T @ J + np.diag(information))[:, [2, 3, 5]] * (self._repeated / priors)
        return np.asarray(np.linalg.norm(means, axis=1))

    def gain(self, x: FloatArray, k: int) -> Figure:
        """Gain by the unknown ``k`` of a fit against 0; see `_gain`."""

        def without(rest: FloatArray) -> FloatArray:
            return self.residuals(np.insert(rest, k, 0.0))

        fit = _fitted(without, np.delete(x, k))
        n = 2 * len(self._z)
        return _gain(without(fit.x)[:n], self.residuals(x)[:n], self._tracks)

    def errors(self, x: FloatArray) -> FloatArray:
        """``(2, n)`` along and across the line of sight, over the range."""
        return (self.residuals(x)[: 2 * len(self._z)] * self.sigma).reshape(2, -1)

    def spread(self, x: FloatArray) -> float:
        """Robust standard deviation of the residuals, without their unit."""
        return self.sigma * MAD * float(np.median(np.abs(self.residuals(x)[: 2 * len(self._z)])))

    def misfit(self, x: FloatArray) -> float:
        """Robust standard deviation of a landmark's place in the sensor's plane [m]."""
        return _robust(np.hypot(*self.errors(x)) * np.abs(self._z))


# --- landmarks against the map ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MapFit:
    """Map against the places of landmarks by wheels and sightings.

    Attributes:
        scale: distances on the map over those seen at the same time, ranges taken as the mounting has them.
        mirrored: whether the map is a mirror image.
        shift: by how much the ids of the map are higher than those seen; 0 if they agree.
        misfit: robust residual over the spread of the landmarks: small if the map fits.
        in_part: whether the map as given fits some of the stretches.
    """

    scale: Figure
    mirrored: bool
    shift: int
    misfit: float
    in_part: bool


def fit_map(path: Path, seen: Sightings, mounting: Mounting, places: dict[int, FloatArray]) -> MapFit | None:
    """Similarity between the map and the places of landmarks within short stretches; None: undetermined.

    Args:
        path: motion of the wheels.
        seen: sightings.
        mounting: how they are reported.
        places: ``(2,)`` on the map [m], by id.
    """
    z = planar(seen.points, mounting.axes)
    alpha = mounting.scale.value * np.exp(1j * mounting.yaw.value)
    p, r = complex_poses(path, seen.times - mounting.late_s.value)
    q = p + r * (alpha * z + complex(mounting.x.value, mounting.y.value))
    for width in _MAP_WINDOWS_S:  # a narrow view takes longer to see three landmarks
        windows = list(_places_seen(path, seen, q, width))
        if sum(len(window) > 2 for window in windows) >= _FEWEST_WINDOWS:
            break
    best = reading_of_map(windows, places)
    if best is None:
        return None
    misfit, mirrored, shift, scales = best
    scale = float(np.median(scales))
    in_part = _share_within(_laid_on(windows, places, 0, False)[1], _FITS) >= _IN_PART
    # landmarks are off on the map all the time, so that only other landmarks are another sample; of three there is none
    ids = np.array(sorted({i for window in windows for i in window if i + shift in places}))
    left_out = []
    for b in range(min(BLOCKS, len(ids))):
        kept = [{i: q for i, q in w.items() if i not in ids[b::BLOCKS]} for w in windows]
        part, _ = _laid_on(kept, places, shift, mirrored)
        if len(part) >= _FEWEST_WINDOWS:
            left_out.append([float(np.median(part))])
    sigma = float(jackknife(np.array(left_out))[0]) if len(left_out) > 2 else scale * max(misfit, _OF_THREE)
    return MapFit(Figure(scale, sigma + 1e-3), mirrored, shift, misfit, in_part)


def reading_of_map(
    windows: list[dict[int, complex]], places: dict[int, FloatArray]
) -> tuple[float, bool, int, list[float]] | None:
    """Misfit, mirror image, shift of ids and scales of the reading of a map that fits best; None: too few landmarks.

    The map as given stands where some windows fit it as well as most fit another reading: a mistake of the map is in
    all of them, a robot that was carried, or slipped, spoils those about that time.
    """
    best: tuple[float, bool, int, list[float]] | None = None
    laid = {by: _laid_on(windows, places, *by) for by in product((0, 1, -1), (False, True))}
    as_given = laid[0, False][1]
    for (shift, mirrored), (scales, misfits) in laid.items():
        if len(misfits) < _FEWEST_WINDOWS:
            continue
        misfit = float(np.median(misfits))
        if best is None or (misfit < 0.5 * best[0] and _share_within(as_given, misfit) < _IN_PART):
            best = (misfit, mirrored, shift, scales)
    return best


def _share_within(misfits: Sequence[float], most: float) -> float:
    """Share of windows whose misfit is at most this."""
    return float(np.mean(np.array(misfits) <= most)) if misfits else 0.0


@dataclass(frozen=True, slots=True)
class CoarseFit:
    """A map laid onto places by the wheels.

    Attributes:
        kind: "": as configured; "map": mirrored; "bearings": mirrored; "mirror": one of the two; "turn": the wheels
            turn the other way; "left", "back", "right": the sensor looks there from where it is configured to.
        scale: of the map's distances over those by wheels and sightings.
        count: landmarks that tell it.
    """

    kind: str
    scale: float
    count: int


LOOKS = {"left": 1j, "back": -1.0, "right": -1j}
"""Turns by which a sensor may look elsewhere than configured, as factors of its bearings."""


def coarse_fit(
    path: Path, seen: Sightings, place: tuple[float, float], places: dict[int, FloatArray]
) -> CoarseFit | None:
    """Lay a map onto places by wheels and sightings, of landmarks that need not be in one view; None: it fits nowhere.

    The way from one landmark to the next is the wheels', whose drift leaves a unit of length, a mirror image or a
    quarter turn of the sensor to be told, and no more.

    Args:
        path: motion of the wheels.
        seen: sightings in the base's axes.
        place: of the sensor [m].
        places: ``(2,)`` on the map [m], by id.
    """
    p, r = complex_poses(path, seen.times)
    z = planar(seen.points, "body")
    over = {"turn": True} if seen.spatial else {"turn": True, "bearings": False}
    readings = [(z, {"": False, "map": True}), (z.conj(), over)]  # with kinds, and whether the map is mirrored in them
    readings += [(turn * z, {kind: False}) for kind, turn in LOOKS.items()]
    for width in _COARSE_S:
        fits: dict[str, tuple[int, float, float]] = {}  # landmarks, misfit with a minus, scale
        for reading, kinds in readings:
            windows = list(_places_seen(path, seen, p + r * (reading + complex(*place)), width))
            for kind, mirrored in kinds.items():
                laid = [
                    (sum(i in places for i in window), -misfit, scale)
                    for window in windows
                    for scale, misfit in zip(*_laid_on([window], places, 0, mirrored), strict=True)
                ]
                if laid:
                    fits[kind] = max(laid)
        found = _clearest(fits)
        if found is not None:
            return found
    return None


def _clearest(fits: dict[str, tuple[int, float, float]]) -> CoarseFit | None:
    """Fit as configured or, where another is better by far than all, that one; None: none is good enough.

    Bearings and a map that are mirror images look alike while the robot hardly moves.
    """
    misfits = {kind: -misfit for kind, (_, misfit, _) in fits.items()}
    least = min(misfits, key=lambda kind: misfits[kind], default="")
    alike = {"map", "bearings"} if least in ("map", "bearings") else {least}
    clear = all(misfits[least] < _CLEARLY * misfit for kind, misfit in misfits.items() if kind not in alike)
    if least and fits[least][0] > 3 and misfits[least] < _COARSE_MISFIT and clear:
        sure = all(misfits[least] < _CLEARLY * misfits[kind] for kind in alike & misfits.keys() - {least})
        return CoarseFit(least if sure else "mirror", fits[least][2], fits[least][0])
    if "" not in fits:
        return None
    (count, _, scale), usual = fits[""], misfits[""]
    doubted = usual > _NO_DOUBT and misfits[least] < _CLEARLY * usual
    fits_well = usual < (_COARSE_MISFIT if count > 3 else _COARSE_OF_THREE)
    return CoarseFit("", scale, count) if fits_well and not doubted else None


def _places_seen(path: Path, seen: Sightings, q: ComplexArray, width: float) -> Iterator[dict[int, complex]]:
    """Places of landmarks by the wheels' path ``q (n,)``, in each window of time [s] whose motion is known."""
    for start in np.arange(seen.times[0], seen.times[-1], _MAP_STEP * width):
        use = (seen.times >= start) & (seen.times < start + width) & np.isfinite(q)
        if use.any() and path.known(np.array([start]), np.array([min(start + width, path.times[-1])]))[0]:
            ids, there = seen.ids[use], q[use]
            of_each = {int(i): there[ids == i] for i in np.unique(ids)}
            yield {i: complex(np.median(own.real), np.median(own.imag)) for i, own in of_each.items()}


def _laid_on(
    windows: list[dict[int, complex]], places: dict[int, FloatArray], shift: int, mirrored: bool
) -> tuple[list[float], list[float]]:
    """Scale and relative misfit of the map in each window that has three of its landmarks."""
    fits = []
    for window in windows:
        common = [i for i in window if i + shift in places]
        if len(common) < 3:
            continue
        a = np.array([window[i] for i in common])
        b = np.array([complex(*places[i + shift]) for i in common])
        fitted = _point_similarity(a, b.conj() if mirrored else b)
        if fitted is not None:
            fits.append(fitted)
    return [s for s, _ in fits], [m for _, m in fits]


def _point_similarity(a: ComplexArray, b: ComplexArray) -> tuple[float, float] | None:
    """Scale that takes points a to b, and the residual over the spread; None where they are nearly one point."""
    a, b = a - a.mean(), b - b.mean()
    size_a, size_b = float(np.sum(np.abs(a) ** 2)), float(np.sum(np.abs(b) ** 2))
    if size_a < 1e-9 or size_b < 1e-12:
        return None
    s = np.vdot(a, b) / size_a
    return math.sqrt(size_b / size_a), math.sqrt(float(np.sum(np.abs(b - s * a) ** 2)) / size_b)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of a sensor of landmarks on a known map, estimated over short stretches of the wheels' path.

    Attributes:
        scale: true over reported range, once the bias is subtracted.
        bias_m: subtracted from reported ranges.
        yaw: of the sensor in the base frame, beside its axes [rad].
        x: place of the sensor in the base frame [m].
        y: likewise.
        late_s: how much later its stamps are than the wheels'.
        too_long_m: reported less true range at the median distance, which is known better than scale and bias.
        distance_m: that distance.
    """

    scale: Figure
    bias_m: Figure
    yaw: Figure
    x: Figure
    y: Figure
    late_s: Figure
    too_long_m: Figure
    distance_m: float


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of a sensor of landmarks, by what the wheels leave unexplained over some seconds.

    Attributes:
        range_m: standard deviation of a range.
        bearing_rad: standard deviation of a bearing.
        correlated_s: time over which one landmark's errors are alike.
        map_m: by how much landmarks stand elsewhere than on the map, on each axis; None: there is no map.
    """

    range_m: float
    bearing_rad: float
    correlated_s: float
    map_m: float | None


class _OnMap:
    """Residuals of sightings of known landmarks, each window of the wheels' path laid on the map by itself."""

    # sigmas of log scale, bias [m], yaw [rad], place [m, m], lag [s] and turn: what a careless installation is off by
    PRIOR = np.array([0.05, 0.1, 0.2, _Places.PLACE_M, _Places.PLACE_M, 0.2, TURN])

    def __init__(self, path: Path, seen: Sightings, z: ComplexArray, places: dict[int, FloatArray]) -> None:
        known = np.array([int(i) in places for i in seen.ids])
        known &= path.known(seen.times - MOST_LAG_S, seen.times + MOST_LAG_S) & (np.abs(z) > 1e-6)
        window = ((seen.times - seen.times[0]) / _WINDOW_S).astype(np.int64)
        m = np.array([complex(*places[int(i)]) if k else 0j for i, k in zip(seen.ids, known, strict=True)])
        for w in np.unique(window):
            use = known & (window == w)
            known[use] = use.sum() >= 8 and float(np.std(m[use])) > _SPREAD_M
        self.times, self.ids, self.z, self.m = seen.times[known], seen.ids[known], z[known], m[known]
        _, self.window = np.unique(window[known], return_inverse=True)
        self._path = path
        self.sigma_m, self.sigma_rad = 0.1, 0.02

    def __len__(self) -> int:
        return len(self.z)

    def take(self, keep: NDArray[np.bool_]) -> _OnMap:
        """Residuals of a part of the sightings."""
        part = copy.copy(self)
        part.times, part.ids, part.z, part.m = self.times[keep], self.ids[keep], self.z[keep], self.m[keep]
        _, part.window = np.unique(self.window[keep], return_inverse=True)
        return part

    def errors(self, x: FloatArray) -> tuple[FloatArray, FloatArray, ComplexArray]:
        """Range [m] and bearing [rad] reported less predicted ``(n,)``, and the latter's direction on the map."""
        scale, bias, yaw, bx, by, late, turn = x.tolist()
        r, bearing = np.abs(self.z), np.angle(self.z)
        p, turned = complex_poses(self._path.turned(1.0 + turn), self.times - min(max(late, -MOST_LAG_S), MOST_LAG_S))
        seen = math.exp(np.clip(scale, -3.0, 3.0)) * (r - bias) * np.exp(1j * (bearing + yaw))
        q = p + turned * (seen + complex(bx, by))
        weights = 1.0 / (self.sigma_m**2 + (self.sigma_rad * r) ** 2)
        total = np.bincount(self.window, weights)

        def mean(values: ComplexArray) -> ComplexArray:
            parts = [np.bincount(self.window, weights * part) / total for part in (values.real, values.imag)]
            return np.asarray((parts[0] + 1j * parts[1])[self.window])

        dq, dm = q - mean(q), self.m - mean(self.m)
        product = weights * dm * dq.conj()
        sums = np.bincount(self.window, product.real) + 1j * np.bincount(self.window, product.imag)
        rotation = (sums / np.maximum(np.abs(sums), 1e-12))[self.window]  # takes the path to the map
        away = (dm * rotation.conj() + mean(q) - p) / turned - complex(bx, by)  # where the map has it, from the sensor
        off = np.angle(seen * away.conj())
        return np.abs(seen) - np.abs(away), np.asarray(off), np.asarray(rotation * turned * away)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Whitened residuals ``(2 n,)``: ranges, then bearings."""
        along, across, _ = self.errors(x)
        off = np.concatenate([along / self.sigma_m, across / self.sigma_rad])
        return np.where(np.isfinite(off), off, 1e3)

    def gain(self, x: FloatArray, k: int) -> Figure:
        """Gain by the unknown ``k`` of a fit against 0; a track is a landmark in a window. See `_gain`."""
        prior, start = self.PRIOR.copy(), x.copy()
        prior[k], start[k] = 1e-6, 0.0
        tracks = np.unique(np.column_stack([self.window, self.ids]), axis=0, return_inverse=True)[1].ravel()
        return _gain(self.residuals(self.solve(start, prior)), self.residuals(x), tracks)

    def solve(self, x: FloatArray, sigmas: FloatArray = PRIOR) -> FloatArray:
        """Gauss-Newton with Cauchy weights; sightings of one landmark within a second count as one.

        Args:
            x: start.
            sigmas: ``(7,)`` of the priors.
        """
        cells = len(np.unique(np.column_stack([self.ids, self.times.astype(np.int64)]), axis=0))
        share, prior = cells / len(self), sigmas**-2.0
        for _ in range(20):
            r = self.residuals(x)
            J = np.column_stack([(self.residuals(x + 1e-5 * e) - r) / 1e-5 for e in np.eye(len(x))])
            weights = share / (1.0 + (r / 1.5) ** 2)
            H = (J.T * weights) @ J + np.diag(prior)
            step = np.linalg.solve(H, -(J.T @ (weights * r) + prior * x))
            x = x + step / max(1.0, float(np.abs(step / sigmas).max()))
            if np.abs(step / sigmas).max() < 1e-3:
                break
        return x

    def adapted(self, x: FloatArray) -> FloatArray:
        """`solve` with the noise that the residuals show, which is kept."""
        for _ in range(_ROUNDS):
            x = self.solve(x)
            along, across, _ = self.errors(x)
            self.sigma_m, self.sigma_rad = max(_robust(along), 0.005), max(_robust(across), 0.001)
        return x


def fit_on_map(
    path: Path, seen: Sightings, mounting: Mounting, places: dict[int, FloatArray]
) -> tuple[Calibration, Noise] | None:
    """Calibration and noise of a sensor whose axes are right, on a known map; None: too little is seen of it.

    Args:
        path: motion of the wheels.
        seen: sightings in the base's axes.
        mounting: by the wheels alone.
        places: ``(2,)`` of landmarks on the map [m], by id.
    """
    on_map = _OnMap(path, seen, planar(seen.points, "body"), places)
    if len(on_map) < _FEWEST_ON_MAP or on_map.window.max() < 2:
        return None
    x = on_map.adapted(_start(mounting))
    blocks = (on_map.window * BLOCKS) // (int(on_map.window.max()) + 1)
    typical = float(np.median(np.abs(on_map.z)))

    def values(x: FloatArray) -> FloatArray:
        scale = math.exp(x[0])
        return np.array([scale, *x[1:6], typical - scale * (typical - x[1])])

    def sigmas(groups: IntArray) -> FloatArray:
        return _jackknifed(lambda use: values(on_map.take(use).solve(x)), groups)

    by_time = sigmas(blocks)
    along, across, _ = on_map.errors(x)
    noise = _noise(on_map, x, along, across)
    s = np.maximum(by_time, sigmas(_by_landmark(on_map.ids)))
    # of the one figure that every landmark tells by itself, their errors are known: they average out
    s[-1] = math.hypot(by_time[-1], (noise.map_m or 0.0) / math.sqrt(len(np.unique(on_map.ids))))
    for k in (2, 5):  # as in `_refined`
        s[k] = _as_sure(x, k, float(s[k]), on_map.gain)
    scale, bias, yaw, at_x, at_y, late, too_long = (
        Figure(float(v), float(sigma)) for v, sigma in zip(values(x), s, strict=True)
    )
    return Calibration(scale, bias, yaw, at_x, at_y, late, too_long, typical), noise


def _noise(on_map: _OnMap, x: FloatArray, along: FloatArray, across: FloatArray) -> Noise:
    """Noise by the residuals: what is alike for a landmark in all its views is the map's."""
    _, _, direction = on_map.errors(x)
    unit = direction / np.maximum(np.abs(direction), 1e-9)
    off = unit * (along + 1j * np.abs(direction) * np.clip(across, -0.2, 0.2))  # on the map
    mean = {}
    for i in np.unique(on_map.ids):
        own = on_map.ids == i
        if own.sum() >= 20:
            mean[int(i)] = complex(np.median(off[own].real), np.median(off[own].imag))
    moved = np.array([mean.get(int(i), 0j) for i in on_map.ids])
    local = (off - moved) / unit
    spread = [_robust(part) for part in (local.real, local.imag / np.abs(direction))]
    parts = [v for one in mean.values() for v in (one.real, one.imag)]
    map_m = float(np.sqrt(np.mean(np.square(parts)))) if len(mean) > 2 else 0.0
    correlated = correlation_time(on_map.times, on_map.ids, np.asarray(local.real / max(spread[0], 1e-9)))
    return Noise(max(spread[0], 0.003), max(spread[1], 0.0005), correlated, map_m)


def track_noise(path: Path, seen: Sightings, m: Mounting) -> Noise:
    """Noise of a sensor by the scatter of each landmark's place over some seconds, without a map."""
    z = planar(seen.points, m.axes)
    known = _known(path, seen, z)
    times, ids, z = seen.times[known], seen.ids[known], z[known]
    along, across = _Places(path, times, z, _tracks(times, ids)).errors(_of_track(m))
    along = along * np.abs(z) * m.scale.value
    sigma_m, sigma_rad = _robust(along), _robust(across)
    correlated = correlation_time(times, ids, along / max(sigma_m, 1e-9))
    return Noise(max(sigma_m, 0.003), max(sigma_rad, 0.0005), correlated, None)


def correlation_time(times: FloatArray, ids: IntArray, errors: FloatArray) -> float:
    """Time [s] over which errors ``(n,)`` of one landmark, of about unit size, are alike: integral of the correlation.

    Source: Priestley, Spectral Analysis and Time Series, 5.3 (integral time scale), both sides of it.
    """
    errors = np.clip(errors, -3.0, 3.0)
    width = 0.1
    sums, counts = np.zeros((2, int(_LONGEST_CORRELATION_S / width) + 1))
    for i in np.unique(ids):
        own = np.flatnonzero(ids == i)
        for step in range(1, 80):
            if step >= len(own):
                break
            apart = times[own[step:]] - times[own[:-step]]
            use = apart <= _LONGEST_CORRELATION_S
            if not use.any():
                break
            k = (apart[use] / width).astype(int)
            np.add.at(sums, k, (errors[own[step:]] * errors[own[:-step]])[use])
            np.add.at(counts, k, 1.0)
    variance = float(np.mean(errors**2))
    seen = counts > 20
    if not seen.any() or variance <= 0.0:
        return 0.0
    rho = np.interp(np.arange(len(sums)), np.flatnonzero(seen), sums[seen] / counts[seen]) / variance
    ends = np.flatnonzero(rho < 0.05)
    rho = np.clip(rho[: int(ends[0])] if len(ends) else rho, 0.0, 1.0)
    return float(min(2.0 * width * rho.sum(), _LONGEST_CORRELATION_S))
