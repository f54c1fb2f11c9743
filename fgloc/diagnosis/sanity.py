"""Whether a run explains its recording no worse than simpler pipelines: odometry alone, and the textbook's smoother.

Both are computed beside the run from the same steps, with constants as they are configured. No truth is read. What is
compared:

- **motion**: the estimate's motion over windows of two seconds and the odometry's. Wheels slip now and then, which a
  median does not see; an estimate that moves differently most of the time does not describe this robot, unless
  sightings of a surveyed map, explained to within their noise, contradict the wheels.
- **sightings**: the share of them that a trajectory explains, all against one place for each landmark: the map's or, of
  an unknown map, the median of where the trajectory itself has it.

`Sanity.judge` compares whole trajectories at the end of a run, and gives the simpler one where it is better. `Watch`
does so while a run goes on: its poses depend on nothing later.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.config import Config, camera_role
from fgloc.diagnosis.marker_sizes import marker_sizes
from fgloc.diagnosis.signals import SightingCollector
from fgloc.graph.textbook import Seen, textbook_poses
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import (
    MOUNTING_CHANGED,
    Camera,
    Estimate,
    Finding,
    FloatArray,
    IntArray,
    LandmarkMap,
    Mode,
    MotionMeasurement,
    Protection,
    Severity,
    Step,
    Trajectory,
    camera_of,
)

_WINDOW_S = 2.0  # wheels are good to a percent over it, and a pose jumps at most once
_MOVING_M, _MOVING_RAD = 0.1, 0.15  # by the odometry within a window: less tells nothing of scale or direction
_FEWEST = 5  # windows in motion that a median needs
_FLOOR_SIGMA_M, _FLOOR_SIGMA_RAD = 0.02, 0.01  # of a window's motion, beside the noise as configured
_SCALES = 0.02  # how far wheels' scales are off, for the same
_FLOOR_M = 0.05  # added to a window's path: sightings move a pose by centimetres however short the path is
_DEPARTS = 0.25  # median departure over path; sound runs have at most 0.04, also with slip on a third of the floor
_DEPARTS_UNMAPPED, _STRAINS_UNMAPPED = 0.055, 0.6  # without a surveyed map, departure and strain; sound: 0.04, 0.26
_STRETCH = 0.05  # least deviation of the median speed ratio from 1 that counts ...
_STRETCH_SIGMAS = 5.0  # ... in sigmas of the wheels' scale as configured
_LEAST_PATH_M = 0.5  # in windows along which the robot moves, for a ratio of paths
_LEFT_OUT = 0.25  # logarithm of path over the odometry's that a run without a map may have ...
_LEFT_OUT_UNSURE = 0.1  # ... and without a doubt, if it has no sightings either
_EXPLAINED = 3.0  # sigmas: a sighting this near its landmark is explained
_MORE = 0.15  # share of all sightings that a simpler trajectory must explain beyond the estimate
_NOT_MORE = 0.02  # share by which it may explain fewer without a doubt
_SUPPORTED = 0.5  # share of the sightings of a surveyed map that an estimate explains at least; sound runs 0.9 ...
_HARDLY, _HARDLY_SIGMAS = (
    0.75,
    2.0,
)  # ... or this share, if half of all are further from their landmarks: wrong ids are far
_WELL = 0.8  # share explained beyond which no other trajectory is looked for
_SIGHTINGS = 30  # fewer do not contradict anything
_SPARSE_NS = 200_000_000  # sightings of one sensor nearer in time share their errors
_MOST_SIGHTINGS = 4000  # that are compared, evenly chosen; bounds time, not memory
_MOST_POSES = 3000  # of the textbook's smoother; of a longer run some are left out between
_GYRO_AGREES = 0.3  # median relative difference of its turn from the wheels'
_CAUCHY_M = 0.3  # scale at which a sighting loses its weight when the odometry is laid onto the map
_ITERATIONS = 15
_WATCHED, _FEWEST_WATCHED = 60, 10  # windows that are remembered while a run goes on, and that a verdict needs
_SEEN_S, _MOST_WATCHED = 30.0, 1000  # sightings that are remembered: a kidnapped robot takes seconds to find its place
_LEAP_M = 1.0  # farthest that a pose corrects itself within a step without a map
_RETURNED = 3.0  # sigmas of the odometry within which an estimate has come back
_CONTRADICTED = 2.0  # factor of the odometry's sigmas while it is given in place of an estimate
_SPANS_TOLD = 5
_WORST = 10.0  # most that a contradicted odometry's sigmas grow by
_LEAST_VARIANCE = 1e-8  # m², rad²
_LEAST_SCALE = 0.01  # of what wheels are off by, however well they are said to be known
_IN_ITS_PLACE = ", which is given in its place"
_PLAIN = 0.7  # median whitened residual of sightings that fit

# stamp, landmark, its place and the sensor's in the base frame, sigma
_Sighting = tuple[int, int, FloatArray, FloatArray, float]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Odometry ``(n,)`` and sightings ``(m,)`` of a run.

    ``motions`` lead from the keyframe before to each; those of the first keyframe and of the first one after a clock
    jump mean nothing.
    """

    stamps_ns: IntArray
    joined: IntArray  # 1 where the motion is known
    motions: FloatArray  # (n, 3)
    covs: FloatArray  # (n, 3, 3) right perturbation
    seen_ns: IntArray
    ids: IntArray
    places: FloatArray  # (m, 2) in the base frame
    sensors: FloatArray  # (m, 2) in the base frame, of what saw them
    sigmas: FloatArray  # (m,) [m]
    landmarks: Mapping[int, FloatArray] | None
    scale_sigma: float  # of the wheels, as configured
    turn_sigma: float

    def seen(self, chosen: NDArray[np.bool_] | IntArray) -> Track:
        """The track with some of its sightings, by mask or index."""
        names = ("seen_ns", "ids", "places", "sensors", "sigmas")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def surveyed(self) -> tuple[Track, FloatArray]:
        """The track with the sightings of known landmarks alone, and where these are ``(k, 2)``; there is a map."""
        assert self.landmarks is not None
        seen = self.seen(np.array([i in self.landmarks for i in self.ids.tolist()], dtype=bool))
        return seen, np.array([self.landmarks[i] for i in seen.ids.tolist()]).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class Comparison:
    """A trajectory against odometry and sightings.

    Attributes:
        windows: in which the robot moves by its odometry.
        departure: median distance from where the odometry leads within a window, over the path.
        strain: median squared departure in units of the odometry's covariance; 2.4 is expected of three coordinates.
        speed: median path over the odometry's; NaN: too few windows.
        path: whole path over the odometry's.
        explained: share of the sightings that it explains; NaN: too few.
        residual: median whitened distance of a sighting from its landmark.
    """

    windows: int
    departure: float
    strain: float
    speed: float
    path: float
    explained: float
    residual: float


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """Result of comparing an estimate with its odometry and with the textbook's pipeline.

    Attributes:
        findings: none where nothing is to be said.
        simpler: estimates to be written in place of the run's; None: the run's are no worse.
        odometry: odometry alone, laid onto the run's frame; None: nothing measured the motion.
    """

    findings: tuple[Finding, ...] = ()
    simpler: list[Estimate] | None = None
    odometry: Trajectory | None = None


class Sanity:
    """Collects odometry and sightings of a run, some 150 bytes a keyframe, and judges its trajectory."""

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        cameras: Sequence[Camera],
        T_base_sensor: FloatArray | None,
        wheels: WheelMotion,
        gyro: Gyro | None,
    ) -> None:
        """Set up for the sensors of a run.

        Args:
            config: as the run uses it.
            landmark_map: the known map; None if landmarks are estimated.
            cameras: of corners.
            T_base_sensor: ``(4, 4)`` of a sensor that reports ranges or marker poses, as `LandmarkSensor` takes it.
            wheels: the run's.
            gyro: one of its own, whose bias only rest corrects; None: there is none.
        """
        self._cameras = tuple(cameras)
        self._of_cameras = {camera_role(camera.name, "corners") for camera in cameras}
        self._place: FloatArray = np.eye(4) if T_base_sensor is None else np.asarray(T_base_sensor, dtype=float)
        self._collector = SightingCollector(config, landmark_map, cameras, T_base_sensor, self._place)
        self._config, self._wheels, self._gyro = config, wheels, gyro
        self._landmarks = None
        if landmark_map is not None:
            self._landmarks = {i: lm.position[:2].copy() for i, lm in landmark_map.landmarks.items()}
        known = {} if landmark_map is None else landmark_map.landmarks
        self._sizes = {i: marker.size_m for i, marker in known.items() if marker.size_m > 0.0}
        self._stamps, self._joined = array("q"), array("b")
        self._motions, self._covs, self._turns = array("d"), array("d"), array("d")
        self._seen_ns, self._ids, self._seen = array("q"), array("q"), array("d")
        self._segment, self._last_seen_ns = -1, -_SPARSE_NS
        self._knocked: set[str] = set()  # kinds of sightings of sensors that are no longer mounted as configured
        self.watch = Watch(landmark_map is not None, config)

    def observe(
        self, step: Step, estimate: Estimate | None, keep: bool = True, by_hand: bool = False
    ) -> Estimate | None:
        """Keep the odometry and the sightings of a step, and hold its estimate against them.

        Args:
            step: as the localizer got it.
            estimate: what came of it; None: no pose is known yet.
            keep: for `judge`; else memory is bounded.
            by_hand: a person has the robot in hand: its wheels do not measure where it goes.

        Returns:
            The estimate, or what is to be given in its place while it fails: the odometry from the last sane pose on.
        """
        if estimate is not None:
            self._knocked |= {d.kind for d in estimate.decisions if d.reason == MOUNTING_CHANGED}
        measured = self._wheels.measure(step)
        if measured is None:
            return estimate
        turn = None if self._gyro is None else self._gyro.measure(step, measured.motion)
        joined = step.segment == self._segment and not by_hand
        self._segment = step.segment
        seen = list(self._sightings(step))
        if keep:
            self._stamps.append(step.stamp_ns)
            self._joined.append(joined)
            self._motions.extend(measured.motion.tolist())
            self._covs.extend(measured.cov.ravel().tolist())
            self._turns.append(math.nan if turn is None else turn.yaw)
            for stamp_ns, landmark_id, place, sensor, sigma in seen:
                self._seen_ns.append(stamp_ns)
                self._ids.append(landmark_id)
                self._seen.extend((*place, *sensor, sigma))
        joined &= not self._wheels.measured_again  # the steps before were taken to stand, and the estimate knows better
        return self.watch.checked(step, measured, joined, estimate, list(self._surveyed(step, seen)))

    def begin_anew(self) -> None:
        """Restart the comparison at the next pose: it was given, and the odometry does not lead there."""
        self._segment = -1

    def _sightings(self, step: Step) -> Iterator[_Sighting]:
        """Sightings that are compared."""
        for event in step.sightings:
            if abs(event.stamp_ns - self._last_seen_ns) < _SPARSE_NS:
                continue
            self._last_seen_ns = event.stamp_ns
            camera = camera_of(self._cameras, event.topic)
            T = self._place if camera is None else camera.T_base_cam
            if camera is None and self._knocked - self._of_cameras:
                continue
            if camera is not None and camera_role(camera.name, "corners") in self._knocked:
                continue
            for sighting in self._collector.sightings(event):
                place = (T[:3, :3] @ sighting.point + T[:3, 3])[:2]
                sigma = math.hypot(sighting.sigma_m, sighting.sigma_rad * math.hypot(place[0], place[1]))
                yield event.stamp_ns, sighting.landmark_id, place, T[:2, 3], sigma

    def _surveyed(self, step: Step, seen: Sequence[_Sighting]) -> Iterator[Placed]:
        """Sightings of landmarks of a known map, in the base frame at the step's stamp."""
        if self._landmarks is None:
            return
        for stamp_ns, landmark_id, place, _, sigma in seen:
            if landmark_id in self._landmarks:
                if stamp_ns != step.stamp_ns:
                    motion = self._wheels.motion_between(step, step.stamp_ns, stamp_ns)[0]
                    place = se2.compose(motion, (*place, 0.0))[:2]
                yield Placed(place, self._landmarks[landmark_id], sigma)

    def judge(self, estimates: Sequence[Estimate], causal: bool = False, held: bool = False) -> Verdict:
        """Compare the run's trajectory with the simpler ones.

        Args:
            estimates: of the run, with increasing stamps.
            causal: the run's poses depend on nothing later: they are judged and not replaced.
            held: likewise of a run that keeps the first pose which it was given against its sightings.
        """
        track = self._track(estimates[0].stamp_ns, estimates[-1].stamp_ns)
        if track is None:
            return Verdict(self.watch.findings())
        verdict, sizes = judged(track, estimates), self._other_sizes(track, estimates)
        if not (causal or held):
            return replace(verdict, findings=(*verdict.findings, *sizes))
        told = [replace(f, text=f.text.replace(_IN_ITS_PLACE, "")) for f in verdict.findings]
        return replace(verdict, simpler=None, findings=(*(self.watch.findings() or told), *sizes))

    def _other_sizes(self, track: Track, estimates: Sequence[Estimate]) -> tuple[Finding, ...]:
        if track.landmarks is None or not self._sizes:
            return ()
        stamps, poses = np.array([e.stamp_ns for e in estimates]), np.array([e.pose for e in estimates])
        seen, where = track.surveyed()
        at = se2.interpolate(stamps, poses, seen.seen_ns)
        expected = se2.turned(where - at[:, :2], -at[:, 2])
        return marker_sizes(seen.ids, seen.places - seen.sensors, expected - seen.sensors, self._sizes)

    def _track(self, first_ns: int, last_ns: int) -> Track | None:
        """Odometry and sightings between two times, the last pass of a clock that jumped; None: no motion known."""
        stamps = np.array(self._stamps, dtype=np.int64)
        if len(stamps) == 0:
            return None
        last_pass = stamps <= np.minimum.accumulate(np.append(stamps[1:], stamps.max() + 1)[::-1])[::-1]
        last_pass &= stamps < np.minimum.accumulate(np.append(stamps[1:], stamps.max() + 1)[::-1])[::-1]
        kept = last_pass & (stamps >= first_ns) & (stamps <= last_ns)
        if kept.sum() < 2:
            return None
        motions = np.array(self._motions).reshape(-1, 3)
        covs = np.array(self._covs).reshape(-1, 3, 3)
        joined = np.array(self._joined, dtype=np.int64)
        joined[1:] &= last_pass[:-1]
        motions, covs = self._with_gyro(motions, covs)
        joined &= (covs[:, 0, 0] < _silent_variance(motions, self._config)).astype(np.int64)
        seen_ns = np.array(self._seen_ns, dtype=np.int64)
        inside = np.flatnonzero((seen_ns >= stamps[kept][0]) & (seen_ns <= stamps[kept][-1]))
        inside = inside[:: max(1, -(-len(inside) // _MOST_SIGHTINGS))]
        seen = np.array(self._seen).reshape(-1, 5)[inside]
        return Track(
            stamps[kept],
            joined[kept],
            motions[kept],
            covs[kept],
            seen_ns[inside],
            np.array(self._ids, dtype=np.int64)[inside],
            seen[:, :2],
            seen[:, 2:4],
            seen[:, 4],
            self._landmarks,
            self._config.wheels.scale_sigma,
            self._config.wheels.turn_scale_sigma,
        )

    def _with_gyro(self, motions: FloatArray, covs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The odometry with the gyro's turn, where there is one; as it is if the two contradict each other."""
        turns = np.array(self._turns)
        known = np.isfinite(turns)
        if not gyro_agrees(motions[known, 2], turns[known]):
            return motions, covs
        motions, covs = motions.copy(), covs.copy()
        motions[known, 2] = turns[known]
        return motions, covs


def gyro_agrees(wheels: FloatArray, gyro: FloatArray) -> bool:
    """Whether two series of turns ``(n,)`` [rad] are of one robot: by the median over stretches of ten steps."""
    stretches = len(wheels) // 10
    if stretches < 1:
        return False
    a, b = (np.add.reduceat(x, np.arange(stretches) * 10) for x in (wheels, gyro))
    larger = np.maximum(np.abs(a), np.abs(b))
    turning = larger > _MOVING_RAD
    return bool(not turning.any() or np.median(np.abs(a - b)[turning] / larger[turning]) < _GYRO_AGREES)


def _silent_variance(motions: FloatArray, config: Config) -> FloatArray:
    """Variance ``(n,)`` [m²] along a step beyond which its wheels were silent: ten times what their noise can be."""
    noise = config.wheels.noise
    length, turn = np.hypot(motions[:, 0], motions[:, 1]), np.abs(motions[:, 2])
    across = noise.x_per_sqrt_m**2 + noise.y_per_sqrt_m**2 + noise.yaw_per_sqrt_m**2
    known = across * length + noise.xy_per_sqrt_rad**2 * turn + noise.xy_per_sqrt_s**2
    return np.asarray(10.0 * known + 1e-4)


# --- the whole run ---


def judged(track: Track, estimates: Sequence[Estimate]) -> Verdict:
    """Compare a trajectory with odometry alone and, where sightings doubt it, with the textbook's smoother."""
    stamps = np.array([e.stamp_ns for e in estimates], dtype=np.int64)
    poses = np.array([e.pose for e in estimates])
    alone = chained(track)
    if not (np.isfinite(poses).all() and np.isfinite([e.cov for e in estimates]).all()):
        laid = laid_onto(track, alone, np.zeros(3))
        return _simpler(track, estimates, laid, compared(track, laid, alone), "poses of the estimate are not finite")
    at = se2.interpolate(stamps, poses, track.stamps_ns)
    ours = compared(track, at, alone)
    laid = laid_onto(track, alone, at[0])
    by_odometry = compared(track, laid, alone)
    why = _worse_than_odometry(track, ours, by_odometry)
    if why is not None or ours.explained < _WELL:
        textbook = _textbook(track, alone, laid, max(ours.explained, by_odometry.explained))
        if textbook is not None:
            alone_covs = _dead_reckoned(track, estimates[0])
            return replace(textbook, odometry=_as_trajectory(track.stamps_ns, laid, alone_covs))
    if why is not None:
        return _simpler(track, estimates, laid, by_odometry, why)
    unsure = _unsure(track, ours, by_odometry)
    findings = () if unsure is None else (Finding("sanity.unsure", unsure, Severity.WARNING),)
    return Verdict(findings, None, _as_trajectory(track.stamps_ns, laid, _dead_reckoned(track, estimates[0])))


def _worse_than_odometry(track: Track, ours: Comparison, odometry: Comparison) -> str | None:
    """Evidence that the estimate explains the recording worse; None: it does not."""
    motion = (
        f"over {ours.windows} windows of {_WINDOW_S:.0f} s it departs from the odometry by {_percent(ours.departure)} "
        f"of the path (median), at {ours.speed:.3g} times its speed, over {ours.path:.3g} times its path"
    )
    sightings = (
        f"it explains {_percent(ours.explained)} of the sightings, odometry alone {_percent(odometry.explained)}"
        if math.isfinite(ours.explained)
        else "no sightings support it"
    )
    if odometry.explained > ours.explained + _MORE:
        return f"{sightings}; {motion}"
    if track.landmarks is not None and not supported(ours.explained, ours.residual):
        return f"{sightings}; {motion}"
    if ours.windows < _FEWEST or (track.landmarks is not None and ours.explained > odometry.explained + _MORE):
        return None
    if departs(ours.departure, ours.strain, track.landmarks is not None):
        return f"{motion}; {sightings}"
    if track.landmarks is not None:
        return None
    if abs(math.log(max(ours.path, 1e-9))) > _LEFT_OUT:
        return f"{motion}; {sightings}"
    if len(track.ids) and abs(math.log(max(ours.speed, 1e-9))) > max(_STRETCH, _STRETCH_SIGMAS * track.scale_sigma):
        return (
            f"{motion}, which wheels known to {_percent(track.scale_sigma)} do not allow, and without a map they are "
            f"the measure of length; {sightings}"
        )
    return None


def supported(explained: float, residual: float) -> bool:
    """Whether an estimate explains the sightings of a surveyed map: by the share, and the median whitened distance."""
    return not (explained < _SUPPORTED or (explained < _HARDLY and residual > _HARDLY_SIGMAS))


def departs(departure: float, strain: float, mapped: bool) -> bool:
    """Whether an estimate moves as the robot does not, by medians over windows; with a surveyed map or without."""
    if mapped:
        return departure > _DEPARTS
    return departure > _DEPARTS_UNMAPPED and strain > _STRAINS_UNMAPPED


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _unsure(track: Track, ours: Comparison, odometry: Comparison) -> str | None:
    """Sentence on an estimate that explains few sightings, or moves unlike the odometry; None: neither holds."""
    if track.landmarks is not None and ours.explained < _WELL and ours.residual > 1.0:
        return (
            f"The estimate explains {_percent(ours.explained)} of the sightings, though more than odometry alone: the "
            "map, the sightings or their sensor's place contradict the rest of the recording."
        )
    if ours.windows >= _FEWEST and ours.explained < odometry.explained - _NOT_MORE:
        return (
            f"The estimate explains {_percent(ours.explained)} of the sightings, odometry alone "
            f"{_percent(odometry.explained)}: the poses may be no better than those of odometry alone."
        )
    if ours.windows < _FEWEST or len(track.ids) or track.landmarks is not None:
        return None
    if abs(math.log(max(ours.path, 1e-9))) > _LEFT_OUT_UNSURE:
        return (
            f"The estimate's path is {ours.path:.3g} times the odometry's, and no sighting confirms it: the poses may "
            "be worse than those of odometry alone."
        )
    return None


def _simpler(track: Track, estimates: Sequence[Estimate], poses: FloatArray, by: Comparison, why: str) -> Verdict:
    """The odometry in place of the estimate, and the finding that says so."""
    contradicted = 1.0
    if math.isfinite(by.residual):
        contradicted = float(np.clip(by.residual / _PLAIN, 1.0, _WORST))
    trajectory = _as_trajectory(track.stamps_ns, poses, _dead_reckoned(track, estimates[0], contradicted))
    text = f"The estimate explains the recording worse than odometry alone{_IN_ITS_PLACE}: {why}."
    return Verdict((Finding("sanity.odometry", text, Severity.ERROR),), _estimates(trajectory), trajectory)


def _estimates(trajectory: Trajectory, mode: Mode = Mode.DEAD_RECKONING) -> list[Estimate]:
    assert trajectory.covs is not None
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.poses, trajectory.covs, strict=True)
    return [Estimate(stamp, pose, cov, mode) for stamp, pose, cov in rows]


def _textbook(track: Track, alone: FloatArray, laid: FloatArray, explained: float) -> Verdict | None:
    """The textbook's trajectory where it moves as the odometry does and explains more than this share; else None."""
    if len(track.ids) < _SIGHTINGS or track.landmarks is None:  # without a map it can bend as the estimate does
        return None
    kept = np.arange(0, len(laid), max(1, -(-len(laid) // _MOST_POSES)))
    stamps_ns = track.stamps_ns[kept]
    nearest = np.clip(np.searchsorted(stamps_ns, track.seen_ns), 0, len(kept) - 1)
    then = se2.interpolate(track.stamps_ns, alone, track.seen_ns)
    places = se2.placed(se2.between_array(alone[kept[nearest]], then), track.places)
    solved = textbook_poses(
        laid[kept],
        se2.between_array(alone[kept[:-1]], alone[kept[1:]]),
        Seen(nearest, track.ids, places, track.sigmas),
        track.landmarks,
    )
    if solved is None:
        return None
    poses, covs = solved
    before = np.searchsorted(kept, np.arange(len(laid)), side="right") - 1  # the odometry leads to those left out
    whole = se2.compose_array(poses[before], se2.between_array(alone[kept[before]], alone))
    given = replace(track, joined=np.ones(len(laid), dtype=np.int64))
    given = given.seen((track.seen_ns >= stamps_ns[0]) & (track.seen_ns <= stamps_ns[-1]))
    theirs = compared(given, whole, alone)
    if departs(theirs.departure, theirs.strain, mapped=False) or theirs.explained < max(explained + _MORE, _WELL):
        return None
    worst = max(1.0, theirs.residual / _PLAIN)
    smoothed = _as_trajectory(stamps_ns, poses, covs * worst**2)
    text = (
        f"The estimate explains the recording worse than plain smoothing with fixed constants{_IN_ITS_PLACE}: that "
        f"explains {_percent(theirs.explained)} of the sightings, the estimate at most "
        f"{_percent(explained)}."
    )
    return Verdict((Finding("sanity.textbook", text, Severity.ERROR),), _estimates(smoothed, Mode.OK), None)


def _as_trajectory(stamps_ns: NDArray[np.int64], poses: FloatArray, covs: FloatArray) -> Trajectory:
    """A trajectory of poses with covariances of their right perturbations."""
    turned = np.array([se2.rotate_cov(cov, yaw) for cov, yaw in zip(covs, poses[:, 2].tolist(), strict=True)])
    return Trajectory(stamps_ns, poses, 0.5 * (turned + turned.transpose(0, 2, 1)))


def _dead_reckoned(track: Track, first: Estimate, contradicted: float = 1.0) -> FloatArray:
    """Covariances ``(n, 3, 3)`` of the odometry's poses, right perturbation.

    Noise adds up from step to step; the wheels' scales, always off alike, add up in proportion to the way.

    Args:
        track: of the run.
        first: the run's first pose, whose covariance the odometry begins with.
        contradicted: factor of all sigmas.
    """
    cov = np.eye(3) * _LEAST_VARIANCE
    begun = se2.rotate_cov(first.cov, -float(first.pose[2]))
    if np.isfinite(begun).all() and np.linalg.eigvalsh(begun)[0] > 0.0:
        cov += begun
    by_scale = np.zeros((3, 2))  # derivative of the pose by the scales of way and turn
    sigmas = np.array([max(track.scale_sigma, _LEAST_SCALE), max(track.turn_sigma, _LEAST_SCALE)])
    covs = np.empty((len(track.stamps_ns), 3, 3))
    for k, (motion, noise) in enumerate(zip(track.motions, track.covs, strict=True)):
        if k:
            ad = se2.adjoint(se2.inverse(motion if track.joined[k] else np.zeros(3)))
            cov = ad @ cov @ ad.T + noise
            by_scale = ad @ by_scale
            if track.joined[k]:
                by_scale[:2, 0] += motion[:2]
                by_scale[2, 1] += motion[2]
        scaled = by_scale * sigmas
        covs[k] = (cov + scaled @ scaled.T) * contradicted**2
    return covs


def chained(track: Track) -> FloatArray:
    """Poses ``(n, 3)`` of the odometry from zero; where a motion is not known it stands still."""
    poses = np.zeros((len(track.stamps_ns), 3))
    x = y = yaw = 0.0
    for k, (joined, (dx, dy, turn)) in enumerate(zip(track.joined.tolist(), track.motions.tolist(), strict=True)):
        if k and joined:
            c, s = math.cos(yaw), math.sin(yaw)
            x, y, yaw = x + c * dx - s * dy, y + s * dx + c * dy, yaw + turn
        poses[k] = x, y, yaw
    poses[:, 2] = se2.wrap_array(poses[:, 2])
    return poses


def compared(track: Track, poses: FloatArray, odometry: FloatArray | None) -> Comparison:
    """Figures of a trajectory ``(n, 3)`` at the track's keyframes; of the motion only with the odometry's poses."""
    away = _distances(track, poses)
    explained, residual = math.nan, math.nan
    if len(away) >= _SIGHTINGS:
        explained, residual = float(np.mean(away < _EXPLAINED)), float(np.median(away))
    windows = [] if odometry is None else _windows(track, poses, odometry)
    along = [w for w in windows if w.moved > _MOVING_M]
    speed, path = math.nan, 1.0
    if len(along) >= _FEWEST:
        speed = float(np.median([w.our_moved / w.moved for w in along]))
    if sum(w.moved for w in along) > _LEAST_PATH_M:
        path = sum(w.our_moved for w in along) / sum(w.moved for w in along)
    departure = float(np.median([w.departure for w in windows])) if windows else 0.0
    strain = float(np.median([w.strain for w in windows])) if windows else 0.0
    return Comparison(len(windows), departure, strain, speed, path, explained, residual)


@dataclass(frozen=True, slots=True)
class Window:
    """Motion over a window by the odometry and by the estimate.

    Attributes:
        moved: distance of its ends by the odometry [m].
        our_moved: by the estimate [m].
        departure: distance of the two ends over the odometry's path.
        strain: squared difference of the motions in units of the odometry's covariance.
    """

    moved: float
    our_moved: float
    departure: float
    strain: float

    @classmethod
    def of(cls, odometry: FloatArray, cov: FloatArray, path: float, ours: FloatArray) -> Window | None:
        """Compare two motions ``(3,)``; None: the robot hardly moves by its odometry.

        Args:
            odometry: motion over the window.
            cov: ``(3, 3)`` of its noise, right perturbation.
            path: length of the odometry's path [m].
            ours: motion by the estimate.
        """
        if path < _MOVING_M and abs(odometry[2]) < _MOVING_RAD:
            return None
        moved, our_moved = math.hypot(odometry[0], odometry[1]), math.hypot(ours[0], ours[1])
        away = math.hypot(ours[0] - odometry[0], ours[1] - odometry[1]) / (path + _FLOOR_M)
        scale = np.diag(np.square([_FLOOR_SIGMA_M, _FLOOR_SIGMA_M, _FLOOR_SIGMA_RAD]))
        scale += np.outer(odometry, odometry) * np.eye(3) * _SCALES**2
        off = se2.log(se2.between(odometry, ours))
        return cls(moved, our_moved, away, float(off @ np.linalg.solve(cov + scale, off)))


def _windows(track: Track, poses: FloatArray, odometry: FloatArray) -> list[Window]:
    """Windows in which the robot moves and the odometry is known throughout."""
    t = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    edges = np.unique(np.searchsorted(t, np.arange(0.0, t[-1] + 1e-6, _WINDOW_S)))
    edges = edges[edges < len(t)]
    lengths = np.hypot(track.motions[:, 0], track.motions[:, 1])
    theirs, ours = (se2.between_array(path[edges[:-1]], path[edges[1:]]) for path in (odometry, poses))
    found = []
    for a, b, motion, our_motion in zip(edges[:-1], edges[1:], theirs, ours, strict=True):
        inside = slice(a + 1, b + 1)
        if not track.joined[inside].all() or t[b] - t[a] > 2.0 * _WINDOW_S:
            continue
        cov = np.zeros((3, 3))
        for step, noise in zip(track.motions[inside], track.covs[inside], strict=True):
            cov = se2.compose_cov(cov, step, noise)
        window = Window.of(motion, cov, float(lengths[inside].sum()), our_motion)
        if window is not None:
            found.append(window)
    return found


def _distances(track: Track, poses: FloatArray) -> FloatArray:
    """Whitened distances ``(k,)`` of the sightings from their landmarks under a trajectory."""
    if track.landmarks is not None:
        seen, where = track.surveyed()
        return np.asarray(np.hypot(*(_seen_from(seen, poses) - where).T) / seen.sigmas, dtype=float)
    places = _seen_from(track, poses)
    away = np.full(len(places), np.nan)
    for landmark_id in np.unique(track.ids):
        same = np.flatnonzero(track.ids == landmark_id)
        if len(same) > 1:
            middle = np.median(places[same], axis=0)
            away[same] = np.hypot(*(places[same] - middle).T) / track.sigmas[same]
    return np.asarray(away[np.isfinite(away)])


def _seen_from(track: Track, poses: FloatArray) -> FloatArray:
    """Places ``(m, 2)`` of the sightings in the frame of a trajectory ``(n, 3)``."""
    return se2.placed(se2.interpolate(track.stamps_ns, poses, track.seen_ns), track.places)


def laid_onto(track: Track, odometry: FloatArray, first: FloatArray) -> FloatArray:
    """The odometry's poses ``(n, 3)`` in the map's frame: by its sightings of a known map, else by the first pose.

    Args:
        track: of the run.
        odometry: from zero.
        first: pose of the estimate at the first keyframe.
    """
    begun = se2.compose_array(first, odometry)
    if track.landmarks is None or len(track.ids) < _SIGHTINGS:
        return begun
    seen, where = track.surveyed()
    if len(where) < _SIGHTINGS:
        return begun
    places = _seen_from(seen, odometry)
    T, weights = np.asarray(first, dtype=float), np.ones(len(places))
    for _ in range(_ITERATIONS):
        T = se2.rigid(places, where, weights)
        off = np.hypot(*(se2.placed(T, places) - where).T)
        weights = 1.0 / (1.0 + (off / _CAUCHY_M) ** 2)
    aligned = se2.compose_array(T, odometry)
    return min((aligned, begun), key=lambda poses: float(np.median(_distances(track, poses))))


# --- while a run goes on ---


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A sighting of a surveyed landmark.

    Attributes:
        place: ``(2,)`` in the base frame at the stamp of its step [m].
        landmark: ``(2,)`` in the map.
        sigma: [m].
    """

    place: FloatArray
    landmark: FloatArray
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """A sighting as it is remembered: its place in the frame in which the odometry began, and how far the estimate was.

    ``away`` is the whitened distance from its landmark.
    """

    stamp_ns: int
    by_odometry: FloatArray
    seen: Placed
    away: float


@dataclass(slots=True, eq=False)
class _Stretch:
    """A window as the run goes on: the estimate at its begin, the odometry since, and how both compare at its end.

    ``window`` is None before the end, and in rest.
    """

    estimate: Estimate
    motion: FloatArray = field(default_factory=lambda: np.zeros(3))
    cov: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    path: float = 0.0
    window: Window | None = None


NO_BOUND = Protection(np.full(3, np.inf), math.inf, "odometry", alert=True)
"""Protection level of odometry given in place of an estimate: infinite, with an alert."""


class Watch:
    """Holds the estimate against the odometry while a run goes on; gives the odometry where the estimate fails.

    It remembers the last two minutes. The odometry goes on from the last pose before the first window that departs.
    """

    def __init__(self, mapped: bool, config: Config) -> None:
        """Begin without data.

        Args:
            mapped: the landmarks' places are surveyed.
            config: as the run uses it.
        """
        self._mapped, self._config = mapped, config
        self._stretches: deque[_Stretch] = deque(maxlen=_WATCHED)
        self._seen: deque[_Compared] = deque(maxlen=_MOST_WATCHED)
        self._predicted: FloatArray | None = None  # where the odometry leads from the pose that was given last
        self._restart(None)
        self._first_ns: int | None = None
        self._spans: list[tuple[float, float]] = []  # [s] from the first pose, in which the odometry was given
        self._why = ""

    def _restart(self, estimate: Estimate | None) -> None:
        self._stretches.clear()
        self._seen.clear()
        self._odometry = np.zeros(3)  # from where it began
        self._open = None if estimate is None else _Stretch(estimate)
        self._carried: tuple[FloatArray, FloatArray] | None = None  # pose and covariance, right perturbation
        self._given: FloatArray | None = None if estimate is None else estimate.pose  # pose that was given last

    def checked(
        self,
        step: Step,
        measured: MotionMeasurement,
        joined: bool,
        estimate: Estimate | None,
        seen: Sequence[Placed],
    ) -> Estimate | None:
        """The estimate, or the odometry in its place.

        Args:
            step: the newest one.
            measured: its odometry.
            joined: it goes on from the step before.
            estimate: None: no pose is known; the comparison begins anew.
            seen: sightings of the step; none without a surveyed map.
        """
        if estimate is None or not joined:
            self._restart(estimate)
            return estimate
        if self._first_ns is None:
            self._first_ns = estimate.stamp_ns
        if self._carried is not None:
            pose, cov = self._carried
            cov = se2.compose_cov(cov, measured.motion, measured.cov * _CONTRADICTED**2)
            self._carried = se2.compose(pose, measured.motion), cov
        finite = bool(np.isfinite(estimate.pose).all() and np.isfinite(estimate.cov).all())
        self._odometry = se2.compose(self._odometry, measured.motion)
        self._predicted = None if self._given is None else se2.compose(self._given, measured.motion)
        self._given = estimate.pose
        self._drive(step, measured, estimate, finite)
        for one in seen:
            away = math.hypot(*(se2.placed(estimate.pose, one.place) - one.landmark)) / one.sigma
            self._seen.append(_Compared(step.stamp_ns, se2.placed(self._odometry, one.place), one, away))
        why = self._failure(step, estimate, finite)
        if why is None and not self._returned(estimate):
            why = self._why
        if why is None:
            self._carried = None
            return estimate
        self._why = self._why or why
        if self._carried is None:
            self._carried = self._last_sane()
        if self._carried is None:
            return estimate
        self._note(step)
        pose, cov = self._carried
        self._given = pose
        turned = se2.rotate_cov(cov, float(pose[2]))
        ground = None if estimate.ground is None else estimate.ground.with_planar(turned)
        bound = None if estimate.protection is None else NO_BOUND
        return replace(estimate, pose=pose, cov=turned, mode=Mode.DEAD_RECKONING, ground=ground, protection=bound)

    def findings(self) -> tuple[Finding, ...]:
        """Finding on the times at which the odometry was given in place of the estimate; empty if it never was."""
        if not self._spans:
            return ()
        spans = ", ".join(f"{a:.0f} to {b:.0f} s" for a, b in self._spans)
        text = (
            f"The estimate explains the recording worse than odometry alone, which is given in its place from {spans} "
            f"after the first pose: {self._why}."
        )
        return (Finding("sanity.odometry", text, Severity.ERROR),)

    def _drive(self, step: Step, measured: MotionMeasurement, estimate: Estimate, finite: bool) -> None:
        """Add a step to the window, and close it where it is long enough."""
        now = self._open
        if now is None:
            self._open = _Stretch(estimate)
            return
        now.motion = se2.compose(now.motion, measured.motion)
        now.cov = se2.compose_cov(now.cov, measured.motion, measured.cov)
        now.path += math.hypot(measured.motion[0], measured.motion[1])
        begun = now.estimate
        if (step.stamp_ns - begun.stamp_ns) * 1e-9 < _WINDOW_S:
            return
        if finite and np.isfinite(begun.pose).all():
            now.window = Window.of(now.motion, now.cov, now.path, se2.between(begun.pose, estimate.pose))
        self._stretches.append(now)
        self._open = _Stretch(estimate)

    def _failure(self, step: Step, estimate: Estimate, finite: bool) -> str | None:
        """Evidence against the estimate as it is now; None: there is none."""
        if not finite:
            return "its pose is not finite"
        if estimate.mode is Mode.LOST:  # it says so itself, and sightings of another place are no surprise
            return None
        since_ns = step.stamp_ns - round(_SEEN_S * 1e9)
        while self._seen and self._seen[0].stamp_ns < since_ns:
            self._seen.popleft()
        explained = math.nan
        if len(self._seen) >= _SIGHTINGS and (self._seen[-1].stamp_ns - self._seen[0].stamp_ns) * 1e-9 > 0.5 * _SEEN_S:
            away = np.array([one.away for one in self._seen])
            explained = float(np.mean(away < _EXPLAINED))
            if not supported(explained, float(np.median(away))) and self._is_better_by_odometry(explained):
                return f"it explains {_percent(explained)} of the sightings of {_SEEN_S:.0f} s"
        moving = [s.window for s in self._stretches if s.window is not None]
        if not self._mapped and self._predicted is not None:
            leap = math.hypot(*(estimate.pose - self._predicted)[:2])
            if leap > _LEAP_M + self._config.gate.max_speed * step.dt:
                return f"it leaps by {leap:.3g} m within a step"
        if len(moving) < _FEWEST_WATCHED or (self._mapped and explained > _SUPPORTED):
            return None
        departure = float(np.median([w.departure for w in moving]))
        strain = float(np.median([w.strain for w in moving]))
        if departs(departure, strain, self._mapped):
            return f"over {len(moving)} windows of {_WINDOW_S:.0f} s it departs by {_percent(departure)} of the path"
        return None

    def _is_better_by_odometry(self, explained: float) -> bool:
        """Whether the odometry, which would be given in place of the estimate, explains about as many sightings.

        One that goes on from the estimate itself explains as many and is no better: only if that is next to none.
        """
        carried = self._carried
        if carried is None and not any(map(self._strained, self._stretches)):
            return explained < _MORE
        carried = carried or self._last_sane()
        if carried is None:
            return False
        T = se2.compose(carried[0], se2.inverse(self._odometry))
        places = se2.placed(T, np.array([one.by_odometry for one in self._seen]))
        off = places - np.array([one.seen.landmark for one in self._seen])
        near = np.hypot(*off.T) < _EXPLAINED * np.array([one.seen.sigma for one in self._seen])
        return float(np.mean(near)) > explained - _MORE

    def _strained(self, stretch: _Stretch) -> bool:
        """Whether the estimate departs from the odometry in a window in which the robot moves."""
        window = stretch.window
        return window is not None and departs(window.departure, window.strain, self._mapped)

    def _returned(self, estimate: Estimate) -> bool:
        """Whether an estimate that has failed can be given again; without a map it must be near the odometry."""
        if self._carried is None or self._mapped:
            return True
        pose, cov = self._carried
        away = math.hypot(*(estimate.pose - pose)[:2])
        return away < _LEAP_M + _RETURNED * math.sqrt(float(np.linalg.eigvalsh(cov[:2, :2])[-1]))

    def _last_sane(self) -> tuple[FloatArray, FloatArray] | None:
        """Pose and covariance now: those before the first window that departs, with the odometry since."""
        last = max(len(self._stretches) - 1, 0)
        first = next((i for i, stretch in enumerate(self._stretches) if self._strained(stretch)), last)
        stretches = [*self._stretches, *(() if self._open is None else (self._open,))][first:]
        while stretches and not np.isfinite(stretches[0].estimate.pose).all():
            stretches = stretches[1:]
        if not stretches:
            return None
        begun = stretches[0].estimate
        pose, cov = begun.pose, se2.rotate_cov(begun.cov, -float(begun.pose[2]))
        for stretch in stretches:
            cov = se2.compose_cov(cov, stretch.motion, stretch.cov * _CONTRADICTED**2)
            pose = se2.compose(pose, stretch.motion)
        return pose, cov

    def _note(self, step: Step) -> None:
        """Add the step to the time in which the odometry was given."""
        assert self._first_ns is not None
        at = (step.stamp_ns - self._first_ns) * 1e-9
        if self._spans and (step.start_ns - self._first_ns) * 1e-9 - self._spans[-1][1] < _WINDOW_S:
            self._spans[-1] = self._spans[-1][0], at
        elif len(self._spans) < _SPANS_TOLD:
            self._spans.append((at, at))
