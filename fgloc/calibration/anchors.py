"""A survey of radio anchors: their places, from ranges and the motion of one drive.

1. The drive by its motion alone (and by ranges to anchors whose places are given) has a trajectory.
2. Seen from there, robust least squares find each anchor, from several starts and from the mirror image about the path.
3. One graph refines poses, anchors, and scale and offset of the ranges together, as ``fgloc smooth`` does with
   `uwb.anchors_sigma_m`. Ranges that do not fit its solution are left out, and judged again by the next one.

An anchor is taken to be above the tag: ranges of a robot on a floor do not tell it from one as far below.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from fgloc import se2
from fgloc.assembly import Assembly, assemble
from fgloc.calibration.installation import Found, found_values
from fgloc.calibration.survey import FREE, ORIGIN, check_flat
from fgloc.config import Config, base_roles
from fgloc.diagnosis.pairs import MAD
from fgloc.errors import RecordingError
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import InstallationEstimate, installation_of
from fgloc.graph.measurement_log import Keyframe, MeasurementLog, PoseWithCovariance
from fgloc.intake.validation import reported_bounds
from fgloc.recording.reader import open_recording
from fgloc.replay import Progress, Replay
from fgloc.sensors.base import with_values
from fgloc.sensors.learned.sensor import gains_of
from fgloc.sensors.uwb import MOST_UNSURE, Uwb, UwbConfig, UwbEvent, UwbRange, check, noise_m, place_parameters
from fgloc.types import Event, FloatArray, Landmark, LandmarkMap

# --- The drive --------------------------------------------------------------------------------------------------------

_FEWEST = 20  # ranges that place an anchor
_LATE_NS = 1_000_000_000  # from a range to the keyframe after it


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """A drive without the anchors that are looked for.

    Attributes:
        parts: of its run.
        frames: keyframes in order.
        poses: ``(n, 3)`` smoothed.
        ranges: of each keyframe, with the pose ``(3,)`` at the range.
        notes: what the user should know.
    """

    parts: Assembly
    frames: Sequence[Keyframe]
    poses: FloatArray
    ranges: Mapping[int, Sequence[tuple[UwbEvent, FloatArray]]]
    notes: tuple[str, ...]

    def of_anchors(self) -> dict[int, list[tuple[UwbEvent, FloatArray]]]:
        """Ranges, with the poses, by anchor."""
        found: dict[int, list[tuple[UwbEvent, FloatArray]]] = {}
        for event, pose in (one for of_frame in self.ranges.values() for one in of_frame):
            found.setdefault(event.anchor, []).append((event, pose))
        return dict(sorted(found.items()))


def surveys_anchors(bag: Path, config: Config) -> bool:
    """Whether a recording has ranges to anchors, and nothing that sees landmarks."""
    with open_recording(bag, config.recording) as recording:
        kinds = base_roles(recording.roles)
    return "uwb" in kinds and not {"image", "sightings"} & kinds


def _drive(bag: Path, config: Config, progress: Progress | None) -> _Drive:
    heard: list[UwbEvent] = []
    rejected: Counter[str] = Counter()
    bounds = reported_bounds(config)

    def without_ranges(events: Iterator[Event]) -> Iterator[Event]:
        """Keep the ranges aside, and drop them where no anchor is known."""
        for event in events:
            if not isinstance(event, UwbEvent):
                yield event
                continue
            checked = check(event, bounds)
            if isinstance(checked, str):
                rejected[checked] += 1
            else:
                heard.append(checked)
            if parts.sensors:
                yield event

    with open_recording(bag, config.recording) as recording:
        parts = assemble(recording, None, config, keep_all=True)
        for step in Replay(parts, recording, None, progress, {}).steps(without_ranges(recording.events())):
            parts.localizer.update(step)
        parts.localizer.finish(False)
        notes = [*recording.notes, *parts.gate.notes]
    if rejected["range_bound"]:
        notes.append(
            f"{rejected['range_bound']} of {len(heard) + rejected.total()} ranges are outside of "
            f"{config.gate.min_range:g} to {config.gate.max_range:g} m: set expert.gate.max_range if more are right."
        )
    localizer = parts.localizer
    frames = list(localizer.estimator.log.keyframes.values())
    smoother = BatchSmoother(
        localizer.estimator.log, localizer.factors, config.batch, config.estimator.gate_probability
    )
    stamps, poses = smoother.stamps_ns(), smoother.poses()
    if (np.diff(stamps) <= 0).any():
        raise RecordingError(
            f"{bag}: the clock jumps back; expected stamps that increase: cut the recording there, and survey a part"
        )
    ranges: dict[int, list[tuple[UwbEvent, FloatArray]]] = {}
    at = np.array([event.stamp_ns for event in heard], dtype=np.int64)
    after = np.searchsorted(stamps, at).tolist()
    for event, pose, k in zip(heard, se2.interpolate(stamps, poses, at) if heard else (), after, strict=True):
        if 0 < k < len(frames) and frames[k].prior is None and stamps[k] - event.stamp_ns < _LATE_NS:
            ranges.setdefault(k, []).append((event, pose))
    return _Drive(parts, frames, poses, ranges, tuple(notes))


# --- Approximate places -----------------------------------------------------------------------------------------------

_MOST = 300  # ranges of an anchor that its approximate place is made of, evenly chosen
_HEIGHT_M = 2.0  # sigma of an anchor's height over the tag: of a room's walls and ceiling
_AROUND = np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False))
_APART = 6.0  # times the misfit: nearer solutions are one
_DECIDED, _DECIDED_EACH = 12.0, 0.1  # twice the log of the likelihood ratio of two places: of all ranges, and of each
_FITS = 4.0  # times the misfit: ranges farther off are looked at later
_VAGUE_M = 3.0  # sigma of a place from which the graph would not converge


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A place that explains the ranges to an anchor.

    Attributes:
        x: ``(5,)`` x, y, height over the tag [m], scale - 1 and offset [m] of the ranges.
        misfit: robust standard deviation of a range [m].
    """

    x: FloatArray
    misfit: float


def _off(x: FloatArray, tags: FloatArray, ranges: FloatArray) -> FloatArray:
    """Predicted less measured ranges ``(n,)`` from places ``(n, 2)`` of the tag."""
    distance = np.sqrt(((tags - x[:2]) ** 2).sum(axis=1) + x[2] ** 2)
    return np.asarray((1.0 + x[3]) * distance + x[4] - ranges)


def _locate(tags: FloatArray, ranges: FloatArray, config: UwbConfig) -> _Place | str:
    """The place that explains the ranges to an anchor, or why there is none.

    Args:
        tags: ``(n, 2)`` places of the tag [m].
        ranges: ``(n,)`` [m], rid of the configured scale and offset.
        config: noise of a range at least, priors of scale and offset.
    """
    if len(ranges) < _FEWEST:
        return f"{len(ranges)} ranges, needed are {_FEWEST}"
    chosen = np.unique(np.linspace(0, len(ranges) - 1, _MOST).astype(int))
    tags, ranges, noise = tags[chosen], ranges[chosen], config.sigma_m
    prior = np.maximum([math.inf, math.inf, _HEIGHT_M, config.scale_sigma, config.bias_sigma_m], 1e-6)

    def residuals(x: FloatArray, sigma: float) -> FloatArray:
        off = _off(x, tags, ranges) / sigma
        return np.append(np.sign(off) * np.sqrt(2.0 * np.log1p(0.5 * off**2)), x / prior)

    def solved(place: complex, sigma: float) -> FloatArray:
        start = np.array([place.real, place.imag, 0.5 * _HEIGHT_M, 0.0, 0.0])
        return np.asarray(least_squares(residuals, start, method="lm", args=(sigma,)).x)

    def misfit(x: FloatArray) -> float:
        return max(noise, MAD * float(np.median(np.abs(_off(x, tags, ranges)))))

    z, least = tags[:, 0] + 1j * tags[:, 1], int(ranges.argmin())
    far = max(noise, float(np.ptp(ranges)))
    tried = [solved(z[least] + ranges[least] * turn, 0.1 * far + noise) for turn in _AROUND]
    best = min(tried, key=misfit)
    along = np.linalg.svd(tags - tags.mean(axis=0), full_matrices=False)[2][0]
    axis, middle = complex(*along), complex(*tags.mean(axis=0))

    def mirrored(x: FloatArray) -> complex:
        return middle + axis * ((complex(*x[:2]) - middle) / axis).conjugate()

    def cost(x: FloatArray) -> float:
        return float((residuals(x, sigma) ** 2).sum())

    for _ in range(2):
        sigma = misfit(best)
        tried = [solved(complex(*x[:2]), sigma) for x in tried] + [solved(mirrored(best), sigma)]
        best = min(tried, key=cost)
    rivals = [x for x in tried if math.dist(x[:2], best[:2]) > _APART * sigma]
    rival = min(rivals, key=cost, default=None)
    if rival is not None and cost(rival) - cost(best) < max(_DECIDED, _DECIDED_EACH * len(ranges)):
        places = " and ".join(f"({x[0]:.1f}, {x[1]:.1f})" for x in (best, rival))
        return f"two places explain its ranges alike, {places} m: mirror images about a straight path. Drive a curve"
    J = least_squares(residuals, best, method="lm", args=(sigma,)).jac
    vague = float(np.sqrt(np.diag(np.linalg.inv(J.T @ J + 1e-9 * np.eye(len(best))))[:2].max()))
    if vague > _VAGUE_M:
        return f"known to {vague:.1f} m only: drive nearer to it, and around it"
    return _Place(best, sigma)


# --- The graph --------------------------------------------------------------------------------------------------------

_WIDE_M = 5.0  # sigma of x and y about an approximate place
_ROUNDING_M = 1e-3  # least sigma of a place in a map
_ROUNDS = 5  # of judging all ranges by the solution


@dataclass(slots=True, eq=False)
class _Graph:
    """Poses, anchors and installation as one batch.

    Attributes:
        section: settings with all anchors, and sigmas of those that are looked for.
        belief: parameters that were found ...
        found: ... and their values by name.
        used: ranges that the solution is made of, by anchor.
    """

    drive: _Drive
    section: UwbConfig
    belief: InstallationEstimate = field(init=False)
    found: Found = field(init=False)
    used: Counter[int] = field(init=False)
    _index: Mapping[str, int] = field(init=False)

    def solve(self, places: Mapping[int, _Place]) -> None:
        """Estimate all.

        Args:
            places: by which the ranges are chosen that the first solution is made of.

        Raises:
            EstimatorError: there is no solution.
        """
        parts = self.drive.parts
        config = with_values(parts.config, "uwb", dict(self.section))
        sensor, no_landmarks = Uwb(self.section), LandmarkMap({})
        installation = installation_of(
            config,
            no_landmarks,
            corners=False,
            has_gyro=parts.localizer.motion.sources.gyro is not None,
            gains=() if parts.learned is None else gains_of(parts.learned.model.card),
            sensed=sensor.parameters,
        )
        factors = LandmarkFactors(no_landmarks, installation)
        log = MeasurementLog(math.inf, keep_all=True)
        for n, (frame, pose) in enumerate(zip(self.drive.frames, self.drive.poses, strict=True)):
            kept: list[UwbRange] = []
            later: list[UwbRange] = []
            for event, then in self.drive.ranges.get(n, ()):
                for m in sensor.measure(event):
                    moved = m.compensated(se2.between(pose, then), np.zeros((3, 3)))
                    place = places.get(event.anchor)
                    off = 0.0 if place is None else abs(m.by_constants(then, place.x[3:])[0][0])
                    fits = place is None or off < _FITS * place.misfit
                    (kept if fits else later).append(moved)
            others = [s.measurement for s in frame.sightings if not isinstance(s.measurement, UwbRange)]
            origin = ORIGIN if n == 0 and not parts.sensors else FREE
            log.keyframes[n] = Keyframe(
                n,
                frame.stamp_ns,
                0.0,
                PoseWithCovariance(pose, FREE),
                None if frame.prior is None else PoseWithCovariance(pose, origin),
                frame.motions,
                tuple(factors.sighting(n, m, m.cauchy_k) for m in (*kept, *others)),
                tuple(factors.sighting(n, m, m.cauchy_k) for m in later),
            )
        solver = BatchSmoother(log, factors, config.batch, config.estimator.gate_probability)
        for _ in range(_ROUNDS):
            if not solver.reconsider():
                break
        self.belief, self._index = solver.installed(), installation.index
        self.found = found_values(installation, self.belief, config, (), None)
        fused = [s.measurement for held in solver.accepted.values() for s in held]
        self.used = Counter(m.target for m in fused if isinstance(m, UwbRange))

    def landmarks(self, anchors: Sequence[int], against_each_other: bool = False) -> dict[int, Landmark]:
        """Anchors where they were found, with covariances ``(3, 3)`` of x, y, z.

        Args:
            anchors: numbers.
            against_each_other: without what all of them are moved and turned by, which no drive on this map can tell.
        """
        rows = [self._index[name] for i in anchors for name in place_parameters(i)]
        cov = self.belief.cov[np.ix_(rows, rows)]
        positions = np.array([self.section.anchors[i] for i in anchors]) + self.belief.mean[rows].reshape(-1, 3)
        if against_each_other:
            apart = _apart(positions)
            cov = apart @ cov @ apart.T + _ROUNDING_M**2 * np.eye(len(rows))
        blocks = (cov[k : k + 3, k : k + 3] for k in range(0, len(rows), 3))
        made = zip(anchors, positions, blocks, strict=True)
        return {i: Landmark(i, position, np.eye(3), 0.0, 0.5 * (own + own.T)) for i, position, own in made}


def _apart(positions: FloatArray) -> FloatArray:
    """Projection ``(3 n, 3 n)`` of small displacements of points ``(n, 3)`` on those that no planar motion makes.

    Source: Baarda 1973, "S-transformations and criterion matrices".
    """
    moves = np.zeros((len(positions), 3, 3))
    moves[:, 0, 0] = moves[:, 1, 1] = 1.0
    moves[:, 0, 2], moves[:, 1, 2] = -positions[:, 1], positions[:, 0]
    G = moves.reshape(-1, 3)
    return np.asarray(np.eye(len(G)) - G @ np.linalg.pinv(G))


# --- The whole --------------------------------------------------------------------------------------------------------

_KNOWN_M, _KNOWN_RAD = 0.3, 0.1  # sigma of a place that is known, or its share of the mean range
_FRAME = 3  # anchors that make a frame of their own
_LEAST_SHARE = 0.5  # of the ranges that have to fit


@dataclass(frozen=True, slots=True, eq=False)
class AnchorSurvey:
    """Result of a survey.

    Attributes:
        landmarks: the anchors as points, those found with covariances ``(3, 3)``, those given as they were. Where the
            first pose is the origin, covariances of three anchors and more are those against each other.
        ranges: how many the place of each anchor found is made of, by number.
        left_out: anchors that were heard but are not in the map, with the reason.
        installation: what was found besides, by name.
        noise_m: standard deviation of a range that was used.
        notes: what the user should know, one sentence each.
    """

    landmarks: LandmarkMap
    ranges: Mapping[int, int]
    left_out: Mapping[int, str]
    installation: Found
    noise_m: float
    notes: tuple[str, ...]


def survey_anchors(bag: Path, config: Config, progress: Progress | None = None) -> AnchorSurvey:
    """Survey those anchors of a recording that `uwb.anchors` does not have.

    The frame is that of the given anchors or positions (`gnss`), else of the first pose.

    Args:
        bag: with motion and ranges.
        config: all settings.
        progress: called now and then.

    Raises:
        FglocError: the recording cannot be used, or no anchor can be placed.
    """
    check_flat(config, "anchors")
    section: UwbConfig = config.uwb  # type: ignore[attr-defined]
    drive = _drive(bag, config, progress)
    heard = drive.of_anchors()
    wanted = {i: own for i, own in heard.items() if i not in section.anchors}
    if not wanted:
        raise RecordingError(
            f"{bag}: no range to an anchor that uwb.anchors does not have: nothing to survey; heard are "
            f"{', '.join(map(str, heard)) or 'none'}, see `fgloc info {bag}`"
        )
    if len(wanted) > MOST_UNSURE:
        raise RecordingError(
            f"{bag}: {len(wanted)} unknown anchors, expected at most {MOST_UNSURE}: survey parts of the recording, and "
            "give those found in uwb.anchors"
        )
    places: dict[int, _Place] = {}
    left_out: dict[int, str] = {}
    for i, own in wanted.items():
        tags = np.array([se2.compose(pose, np.array([*section.tag[:2], 0.0]))[:2] for _, pose in own])
        ranges = (np.array([event.range_m for event, _ in own]) - section.bias_m) / section.scale
        place = _locate(tags, ranges, section)
        if isinstance(place, str):
            left_out[i] = place
        else:
            places[i] = place
    if not places:
        raise _none(bag, left_out)
    above = section.tag[2]
    # Drift widens the misfit, ranges without line of sight the scatter
    scatter = noise_m([event for own in heard.values() for event, _ in own]) or math.inf
    noise = max(section.sigma_m, min(scatter, float(np.median([place.misfit for place in places.values()]))))
    given = {i: (section.place_sigmas().get(i) or (0.0, 0.0, 0.0)) for i in section.anchors}
    found = {i: (float(p.x[0]), float(p.x[1]), above + abs(float(p.x[2]))) for i, p in places.items()}
    graph = _Graph(
        drive,
        section.model_copy(
            update={
                "anchors": section.anchors | found,
                "anchors_sigma_m": given | dict.fromkeys(found, (_WIDE_M, _WIDE_M, _HEIGHT_M)),
                "sigma_m": noise,
                "non_line_of_sight": "reject",
            }
        ),
    )
    graph.solve(places)
    left_out |= dict(_undetermined(graph, list(places), wanted))
    determined = [i for i in places if i not in left_out]
    if not determined:
        raise _none(bag, left_out)
    kept = graph.landmarks(determined, not drive.parts.sensors and len(determined) >= _FRAME)
    known = {i: Landmark(i, np.array(place), np.eye(3), 0.0) for i, place in section.anchors.items()}
    return AnchorSurvey(
        LandmarkMap(dict(sorted((known | kept).items())), "", "surveyed"),
        {i: graph.used[i] for i in kept},
        dict(sorted(left_out.items())),
        graph.found,
        noise,
        drive.notes,
    )


def _undetermined(
    graph: _Graph, anchors: Sequence[int], heard: Mapping[int, Sequence[tuple[UwbEvent, FloatArray]]]
) -> Iterator[tuple[int, str]]:
    """Anchors that the solution does not determine well enough for a map, with the reason."""
    for i, landmark in graph.landmarks(anchors).items():
        known_m = max(_KNOWN_M, _KNOWN_RAD * float(np.mean([event.range_m for event, _ in heard[i]])))
        sigma = float(np.sqrt(np.diag(landmark.cov)[:2].max()))  # type: ignore[arg-type]
        if graph.used[i] < max(_FEWEST, _LEAST_SHARE * len(heard[i])):
            yield i, f"only {graph.used[i]} of {len(heard[i])} ranges agree on where it is"
        elif sigma > known_m:
            yield i, f"known to {sigma:.1f} m only: drive nearer to it, and around it"


def _none(bag: Path, left_out: Mapping[int, str]) -> RecordingError:
    listed = "; ".join(f"anchor {i}: {why}" for i, why in left_out.items())
    return RecordingError(f"{bag}: no anchor can be placed: {listed}")
