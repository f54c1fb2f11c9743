"""Wheels calibrated by a truth, where no landmark is seen: their motion between its poses, by least squares.

The truth is cut into windows. Over each, the displacement of the tracked body is that of the base, moved by the body's
place on the robot. What the two differ by is noise of the wheels, by their densities, and noise of the truth's poses,
which neighbouring windows share. Geometry of the drive (or gains of two wheels), place of the body and clock of the
truth are found by Gauss-Newton steps with damping; the motion is integrated anew after each step, so that a geometry
may be far off at first. Factors on the noise of the wheels and the noise of the truth are those under which the windows
are most likely.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.optimize import minimize

from fgloc import se2
from fgloc.calibration.installation import with_settings
from fgloc.config import Config, NoiseDensity
from fgloc.errors import EstimatorError
from fgloc.intake.validation import EventValidator, reported_bounds
from fgloc.recording.reader import open_recording
from fgloc.recording.truth import base_pose, lacks_yaw
from fgloc.sensors import registry
from fgloc.sensors.base import InstallationState, Rank, with_values
from fgloc.sensors.wheels.motion import INSTALLATION, WheelMotion
from fgloc.sensors.wheels.sensor import freed, with_wheels
from fgloc.types import FloatArray, InstallationFound, IntArray, MotionEvent, Setting, Step, TruthEvent, by_class

_WINDOW_S = 4.0  # over it errors of wheels add up beyond the truth's noise
_GAP_S = 0.2  # between poses of the truth about the end of a window: no frozen one, no silence
_GAPS = 2.5  # likewise, times the usual step of a slow truth
_LONGEST_S = 10.0  # of a window that the truth's gaps make longer
_FEWEST = 10  # windows
_ROUNDS, _STEPS = 4, 30  # of noise and weights; of Gauss-Newton in each
_PLACE_M, _YAW_RAD, _LATE_S = 1.0, 3.0, 0.1  # priors of the body's place and of the truth's clock
_SHIFT_S = 0.02  # for the derivative by the clock
_CAUCHY_2 = 9.0  # squared sigmas of a window beyond which it counts less
_TRUTH_M, _TRUTH_RAD = 0.003, 0.003  # noise of the truth, at first
_LOG_PRIOR = math.log(3.0)  # sigma of the logarithm of a factor on the wheels' noise; of the truth's twice that
_BLOCKS = 12  # of windows, for the sigmas
_SIMPLEX = np.array([[-2.0, 0, 2, 0], [0, -2, 0, 2], [-2, -2, 2, 2], [1, 1, 1, 1]])  # from where noise is sought
_CONVERGED = 1e-4  # change of the cost
_FOLLOWS = 0.3  # median misfit of a window over its displacement, above which the wheels do not follow the truth
_SEEN = 0.5  # share of its prior sigma above which a constant is not determined, and stays as given
OF_BODY = ("truth.x", "truth.y", "truth.yaw", "truth.late_s")


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
    """One recording: the wheels' steps from window to window, and the truth as the settings read its axes."""

    steps: tuple[Step, ...]
    linked: tuple[bool, ...]  # whether each window begins where the one before ends
    times: FloatArray  # (n,) of the truth, in s since `origin_ns`
    poses: FloatArray  # (n, 3), yaw continuous
    origin_ns: int

    def displacement(self, step: Step, late_s: float) -> FloatArray:
        """Displacement ``(3,)`` of the tracked body over a step, if the truth's stamps are late by so much."""
        ends = np.array([step.start_ns - self.origin_ns, step.stamp_ns - self.origin_ns]) * 1e-9 + late_s
        a, b = np.column_stack([np.interp(ends, self.times, self.poses[:, k]) for k in range(3)])
        return se2.between(a, b)


def calibrate_by_truth(bags: Sequence[Path], config: Config) -> tuple[Config, tuple[Setting, ...]]:
    """Find the geometry of the drive, or the gains of two wheels, by the truth of recordings of one robot.

    Args:
        bags: recordings with a truth.
        config: of the robot; its geometry may be far off.

    Returns:
        The configuration with what was found and its sigmas, the noise of the wheels, the place of the tracked body and
        the clock of the truth; and the settings as they were given and found.

    Raises:
        FglocError: a recording cannot be used, or the wheels do not follow the truth.
    """
    fit = _Fit([_recorded(bag, config) for bag in bags], config)
    fit.run()
    settings = fit.settings()
    seen = [s for s in settings if s.sigma < _SEEN * s.prior_sigma]
    found = with_settings(config, [s for s in seen if s.name.startswith("wheels.")])
    found = with_values(found, "wheels", {"noise": fit.noise})
    names = {s.name: s for s in seen}
    x, y = config.truth.offset_m
    place = [names[n].found if n in names else given for n, given in zip(OF_BODY[:2], (x, y), strict=True)]
    truth: dict[str, object] = {"offset_m": tuple(round(p, 4) for p in place)}
    if "truth.yaw" in names:
        truth["yaw_offset_rad"] = round(names["truth.yaw"].found, 5)
    found = with_values(found, "truth", truth)
    if "truth.late_s" in names:
        offsets = dict(config.recording.stamp_offset_s)
        offsets["truth"] = round(offsets.get("truth", 0.0) - names["truth.late_s"].found, 4)
        found = with_values(found, "recording", {"stamp_offset_s": offsets})
    return found, settings


def _recorded(bag: Path, config: Config) -> _Recorded:
    """Windows of one recording.

    Raises:
        EstimatorError: the truth has too few poses beside the wheels' messages.
    """
    gate = EventValidator(reported_bounds(config))
    motion: list[MotionEvent] = []
    rows: list[tuple[float, ...]] = []
    body = config.truth.model_copy(update={"offset_m": (0.0, 0.0), "yaw_offset_rad": 0.0})
    origin_ns, has_yaw = 0, True
    with open_recording(bag, config.recording) as recording:
        for event in recording.events():
            passed = gate.check(event)
            if isinstance(passed, MotionEvent):
                motion.append(passed)
            elif isinstance(passed, TruthEvent):
                origin_ns = origin_ns or passed.stamp_ns
                has_yaw &= passed.has_yaw
                rows.append(((passed.stamp_ns - origin_ns) * 1e-9, *base_pose(passed, body)))
    table = np.array(rows, dtype=float).reshape(-1, 4)
    table = table[np.unique(table[:, 0], return_index=True)[1]]
    table = table[np.append(True, np.abs(np.diff(table[:, 1:], axis=0)).max(axis=1, initial=0.0) > 0.0)[: len(table)]]
    motion.sort(key=lambda event: event.stamp_ns)
    stamps = np.array([event.stamp_ns for event in motion], dtype=np.int64)
    if not has_yaw or lacks_yaw(table[:, 1:]):
        raise EstimatorError(f"{bag}: the truth has positions and no yaw; wheels are calibrated by a truth with yaw")
    windows = list(_windows(table[:, 0], origin_ns, stamps))
    if len(windows) < _FEWEST:
        raise EstimatorError(
            f"{bag}: {len(windows)} windows of {_WINDOW_S:g} s in which both truth and wheels have messages, expected "
            f"at least {_FEWEST}: nothing else determines the wheels where no landmark is seen; see `fgloc info {bag}`"
        )
    steps, linked = [], []
    for k, (start, end) in enumerate(windows):
        first = max(int(np.searchsorted(stamps, start)) - 3, 0)
        last = int(np.searchsorted(stamps, end, side="right")) + 3
        steps.append(Step(k, 0, start, end, by_class(motion[first:last])))
        linked.append(k > 0 and windows[k - 1][1] == start)
    return _Recorded(
        tuple(steps), tuple(linked), table[:, 0], np.column_stack([table[:, 1:3], np.unwrap(table[:, 3])]), origin_ns
    )


def _windows(times: FloatArray, origin_ns: int, motion: IntArray) -> Iterator[tuple[int, int]]:
    """Start and end [ns] of the windows: at poses of the truth that have others just before and after."""
    if len(times) < 3 or len(motion) < 3:
        return
    apart = np.diff(times)
    longest = max(_GAP_S, _GAPS * float(np.median(apart)))
    near = (np.append(np.inf, apart) < longest) & (np.append(apart, np.inf) < longest)
    ends = origin_ns + np.round(times[near] * 1e9).astype(np.int64)
    ends = ends[(ends > motion[0] + 200_000_000) & (ends < motion[-1] - 200_000_000)]
    start = None
    for end in ends.tolist():
        if start is None or (end - start) * 1e-9 > _LONGEST_S:
            start = end
        elif (end - start) * 1e-9 >= _WINDOW_S:
            yield start, end
            start = end


class _Part(NamedTuple):
    """One window.

    Attributes:
        seen: displacement ``(3,)`` of the tracked body by the truth.
        cov: ``(3, 3)`` of the wheels' noise, in the body's axes.
        linked: whether it begins where the one before ends: they share a pose of the truth.
    """

    seen: FloatArray
    cov: FloatArray
    linked: bool


_Rows = tuple[FloatArray, FloatArray, list[_Part]]
"""Residuals ``(3 K,)``, their derivatives ``(3 K, p)``, and the windows."""


class _Fit:
    """State of the fit: settings of the wheels, place of the body, clock, and noise."""

    def __init__(self, recorded: Sequence[_Recorded], config: Config) -> None:
        free = next(iter(freed(config)))
        parameters = [p for p in registry.motion_parameters(free, ("wheels",)) if p.rank is Rank.GAIN and p.sigma > 0.0]
        self._names = [p.name for p in parameters if p.name.startswith("wheels.") and p.name != "wheels.delay_s"]
        sigmas = {p.name: p.sigma for p in parameters}
        self._prior = np.array([*(sigmas[n] for n in self._names), _PLACE_M, _PLACE_M, _YAW_RAD, _LATE_S])
        self._recorded, self._given, self.config = recorded, config, free
        self._off = np.zeros(len(self._prior))  # what was added to the given values, in all
        self._body = np.array([*config.truth.offset_m, config.truth.yaw_offset_rad])
        self._late_s = 0.0
        self._logs = np.zeros(4)  # of the noise: of the way and of yaw of the wheels, of places and of yaw of the truth
        self._weights = np.ones(sum(len(r.steps) for r in recorded))
        self._cov = np.diag(self._prior**2)

    def run(self) -> None:
        """Find the parameters, with weights and noise between the rounds.

        Raises:
            EstimatorError: the wheels do not follow the truth.
        """
        for round_ in range(_ROUNDS):
            self._descend()
            residuals, jacobian, parts = self._rows()
            if round_ < _ROUNDS - 1:
                self._find_noise(residuals, parts)
                self._weigh(residuals, parts)
        way = np.array([np.hypot(*part.seen[:2]) + abs(part.seen[2]) for part in parts])
        misfit = np.abs(residuals.reshape(-1, 3)).sum(axis=1)
        moved = way > 0.2 * np.max(way)
        if float(np.median(misfit[moved] / way[moved])) > _FOLLOWS:
            raise EstimatorError(
                f"the wheels do not follow the truth: over a window of {_WINDOW_S:g} s they differ by "
                f"{np.median(misfit[moved] / way[moved]):.0%} of the way (median); look for a wrong joint, sign, unit, "
                "or kind of drive (wheels.drive)"
            )
        self._cov = self._covariance(residuals, jacobian, parts)

    @property
    def noise(self) -> NoiseDensity:
        """Noise densities of the wheels, by the factors found."""
        of_way, of_yaw = np.exp(self._logs[:2]).tolist()
        given = self._given.wheels.noise.model_dump()
        return NoiseDensity(
            **{k: float(f"{v * (of_yaw if k.startswith('yaw') else of_way):.3g}") for k, v in given.items()}
        )

    def settings(self) -> tuple[Setting, ...]:
        """Rows of the table of `fgloc calibrate`: each setting as it was given and as it was found."""
        n = len(self._names)
        before = {s.name: s.given for s in self._settings(self._given, np.zeros(n))}
        made = [replace(s, given=before[s.name]) for s in self._settings(self.config, np.zeros(n))]
        sigma = np.sqrt(np.diag(self._cov))[n:]
        at = [*self._given.truth.offset_m, self._given.truth.yaw_offset_rad, 0.0]
        now = [*self._body.tolist(), self._late_s]
        made += [Setting(*row) for row in zip(OF_BODY, at, now, sigma.tolist(), self._prior[n:].tolist(), strict=True)]
        return tuple(made)

    def _settings(self, config: Config, mean: FloatArray) -> Iterator[Setting]:
        """Settings of the wheels in a configuration, with its constants changed by so much ``(n,)``."""
        n = len(self._names)
        found = InstallationFound(
            tuple(self._names), mean, self._cov[:n, :n], np.diag(self._prior[:n] ** 2), (), "", "joints"
        )
        return INSTALLATION.settings(InstallationState(found), config)

    def _covariance(self, residuals: FloatArray, jacobian: FloatArray, parts: Sequence[_Part]) -> FloatArray:
        """Covariance of the parameters, no smaller than what blocks of windows differ by.

        Wheels that slip, or lose ticks, are off for longer than a window. Source: White 1980, "A
        heteroskedasticity-consistent covariance matrix estimator", with the sums of a block in place of a sample.
        """
        whitened = self._solved(jacobian, parts)
        cov = np.linalg.inv(jacobian.T @ whitened + np.diag(self._prior**-2))
        blocks = np.array_split(np.arange(len(residuals)), _BLOCKS)
        scores = np.array([whitened[block].T @ residuals[block] for block in blocks])
        scores -= scores.mean(axis=0)
        spread = cov @ (scores.T @ scores * (_BLOCKS / (_BLOCKS - 1.0))) @ cov
        larger = np.sqrt(np.maximum(np.diag(spread) / np.diag(cov), 1.0))
        return np.asarray(cov * np.outer(larger, larger))

    def _descend(self) -> None:
        """Gauss-Newton steps, damped where they do not lower the cost."""
        damping = 1e-9
        rows = self._rows()
        cost = self._cost(rows)
        for _ in range(_STEPS):
            residuals, jacobian, parts = rows
            whitened = self._solved(jacobian, parts)
            H = jacobian.T @ whitened + np.diag(self._prior**-2)
            g = whitened.T @ residuals + self._off / self._prior**2
            before = self.config, self._off, self._body, self._late_s
            improved = False
            for _ in range(8):
                step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
                self._move(step)
                rows = self._rows()
                now = self._cost(rows)
                if now < cost:
                    improved, damping = True, max(damping * 0.1, 1e-12)
                    break
                self.config, self._off, self._body, self._late_s = before
                damping = max(30.0 * damping, 1e-6)
            if not improved or cost - now < _CONVERGED * max(1.0, cost):
                return
            cost = now

    def _move(self, step: FloatArray) -> None:
        n = len(self._names)
        values = {s.name.removeprefix("wheels."): s.found for s in self._settings(self.config, step[:n])}
        try:
            self.config = with_wheels(self.config, values)
        except ValueError:  # no such geometry: a shorter step is tried
            step = np.full_like(step, np.inf)
        self._off = self._off + step
        self._body = se2.compose(self._body, se2.exp(step[n : n + 3])) if np.isfinite(step).all() else self._body
        self._late_s += float(step[n + 3])

    def _rows(self) -> _Rows:
        """All windows under the settings as they are now."""
        residuals, jacobian, parts = [], [], []
        to_body = se2.adjoint(se2.inverse(self._body))
        for recorded in self._recorded:
            wheels = WheelMotion(self.config.wheels)
            for step, linked in zip(recorded.steps, recorded.linked, strict=True):
                m = wheels.measure(step)
                if m is None:
                    continue
                by = wheels.derivatives(step, m)
                predicted = se2.compose(se2.compose(se2.inverse(self._body), m.motion), self._body)
                seen, before, after = (
                    recorded.displacement(step, self._late_s + shift) for shift in (0.0, -_SHIFT_S, _SHIFT_S)
                )
                residual = se2.log(se2.between(predicted, seen))
                J = np.zeros((3, len(self._prior)))
                for k, name in enumerate(self._names):
                    J[:, k] = -to_body @ by[name]
                n = len(self._names)
                J[:, n : n + 3] = se2.adjoint(se2.inverse(predicted)) - np.eye(3)
                J[:, n + 3] = se2.log(se2.between(before, after)) / (2.0 * _SHIFT_S)
                residuals.append(residual)
                jacobian.append(J)
                parts.append(_Part(seen, to_body @ m.cov @ to_body.T, linked))
        return np.concatenate(residuals), np.vstack(jacobian), parts

    def _blocks(self, parts: Sequence[_Part], logs: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Covariance ``(3, 3)`` of each window's residual, and that with the window before if they share a pose."""
        of_way, of_yaw, place, yaw = np.exp(logs)
        scale = np.outer(*[np.array([of_way, of_way, of_yaw])] * 2)
        R = np.diag(np.square([_TRUTH_M * place, _TRUTH_M * place, _TRUTH_RAD * yaw]))
        for part, weight in zip(parts, self._weights, strict=False):
            back = se2.adjoint(se2.inverse(part.seen))
            yield part.cov * scale / weight + R + back @ R @ back.T, -back @ R * part.linked

    def _factor(self, parts: Sequence[_Part], logs: FloatArray) -> FloatArray:
        """Lower band ``(6, 3 K)`` of the Cholesky factor of the covariance of all residuals."""
        band = np.zeros((6, 3 * len(parts)))
        for k, (own, cross) in enumerate(self._blocks(parts, logs)):
            for j in range(3):
                band[: 3 - j, 3 * k + j] = own[j:, j]
                if k:
                    band[3 - j : 6 - j, 3 * (k - 1) + j] = cross[:, j]
        return np.asarray(cholesky_banded(band, lower=True))

    def _solved(self, columns: FloatArray, parts: Sequence[_Part]) -> FloatArray:
        """Inverse covariance of the residuals times columns ``(3 K, m)``."""
        return np.asarray(cho_solve_banded((self._factor(parts, self._logs), True), columns))

    def _cost(self, rows: _Rows) -> float:
        residuals, _, parts = rows
        if not np.isfinite(residuals).all() or not np.isfinite(self._off).all():
            return math.inf
        return float(residuals @ self._solved(residuals, parts) + np.sum((self._off / self._prior) ** 2))

    def _find_noise(self, residuals: FloatArray, parts: Sequence[_Part]) -> None:
        """Set the noise under which the residuals are most likely."""
        spread = np.array([1.0, 1.0, 2.0, 2.0]) * _LOG_PRIOR

        def cost(logs: FloatArray) -> float:
            factor = self._factor(parts, logs)
            squares = float(residuals @ cho_solve_banded((factor, True), residuals))
            return 0.5 * (squares + float(np.sum((logs / spread) ** 2))) + float(np.log(factor[0]).sum())

        limits = [(-math.log(30.0), math.log(30.0))] * 4
        starts = [np.zeros(4), *(_LOG_PRIOR * row for row in _SIMPLEX)]
        best = minimize(
            cost,
            self._logs,
            method="Nelder-Mead",
            bounds=limits,
            options={"initial_simplex": np.clip(starts, *limits[0]), "xatol": 0.02, "fatol": 0.01},
        )
        self._logs = best.x

    def _weigh(self, residuals: FloatArray, parts: Sequence[_Part]) -> None:
        """Weights of the windows by Cauchy's kernel, each by its own covariance."""
        self._weights = np.ones(len(parts))
        covs = np.array([cov for cov, _ in self._blocks(parts, self._logs)])
        residuals = residuals.reshape(-1, 3, 1)
        squares = (residuals * np.linalg.solve(covs, residuals)).sum(axis=(1, 2))
        self._weights = 1.0 / (1.0 + squares / 3.0 / _CAUCHY_2)
