"""Recordings as training sees them: recorded inputs, smoothed truth, body velocities, at a fixed time step.

Source: paper eq. 1, 2.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import savgol_filter

from fgloc import se2
from fgloc.config import Config, GyroConfig, RecordingConfig, WheelsConfig, load_config
from fgloc.errors import RecordingError, TrajectoryError
from fgloc.evaluation.results import read_modes
from fgloc.files.outputs import read_tum
from fgloc.frames import rotations
from fgloc.intake.keyframing import EventBuffer
from fgloc.recording.reader import Recording, open_recording
from fgloc.recording.truth import base_ground, base_pose, lacks_yaw
from fgloc.sensor_setup import RecordingFacts, mounted_up
from fgloc.sensors.base import Mounting, WheelJoints
from fgloc.sensors.commands import told
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.sensors.learned.card import Signals, signals_of
from fgloc.sensors.learned.network import CommandHistory
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent, Event, FloatArray, InertialEvent, Mode, MotionEvent, Step, TruthEvent
from fgloc_training.config import DataConfig

# --- Inputs of a motion model, as recorded ----------------------------------------------------------------------------

_STEP_NS = 200_000_000  # of the gyro's filter
_NO_FIX_NS = 10_000_000_000  # without a fix: no window that is judged may have taught the bias it is judged with
_FIRST_NS = 2_000_000_000
_FIX_SIGMA = 0.002  # rad
_MAX_TRUTH_GAP_NS = 200_000_000


class SensorRecord:
    """Commands, IMU, joints and odometry of one recording.

    Attributes:
        commands: in order of stamp.
        imu_up: ``(3,)`` the base's z axis in the IMU's frame.
        wheels: how the robot's wheels are read.
    """

    def __init__(
        self,
        events: Iterable[Event],
        config: Config | None = None,
        imu_up: ArrayLike = (0.0, 0.0, 1.0),
        truth: tuple[NDArray[np.int64], FloatArray] | None = None,
    ) -> None:
        """Keep what a motion model may read.

        Args:
            events: of any kind, in any order.
            config: the robot's.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame.
            truth: stamps ``(n,)`` and poses ``(n, 3)``: the fixes from which the gyro's bias is learned, as the
                localizer learns it from sightings. None: from rests alone.
        """
        config = Config() if config is None else config
        self.wheels: WheelsConfig = config.wheels
        self.imu_up = imu_up
        kinds = (ControlEvent, ImuEvent, JointsEvent, OdometryEvent)
        self._buffers: dict[type[MotionEvent], EventBuffer[Any]] = {kind: EventBuffer() for kind in kinds}
        for event in events:
            if isinstance(event, kinds):
                one = told(event, self.wheels.drive) if isinstance(event, ControlEvent) else event
                self._buffers[type(event)].insert(one)
        self.commands: tuple[ControlEvent, ...] = self._all(ControlEvent)
        self._biases = self._gyro_biases(config.gyro, truth)

    @property
    def has_wheels(self) -> bool:
        """Whether wheel odometry comes from wheels, not from commands."""
        if self.wheels.source in ("command", "none"):
            return False
        drive = self.wheels.drive
        if drive is None:
            by_joints = bool(self._stamps(JointsEvent)) and self.wheels.left_radius is not None
        else:
            names = {*drive.driven, *drive.steered}  # others are an arm's
            by_joints = any(names <= {*event.names} for event in self._all(JointsEvent))
        return by_joints or bool(self._stamps(OdometryEvent))

    @property
    def has_gyro(self) -> bool:
        """Whether there is an IMU."""
        return bool(self._stamps(ImuEvent))

    @property
    def joints(self) -> WheelJoints | None:
        """Names and sizes of the wheels' joints; None if there are no joint states."""
        if not self._stamps(JointsEvent):
            return None
        w = self.wheels
        return WheelJoints(
            left=w.left_joint,
            right=w.right_joint,
            left_radius=w.left_radius,
            right_radius=w.right_radius,
            track=w.track,
        )

    def step(self, start_ns: int, end_ns: int, history_s: float = 0.0) -> Step:
        """Step with all messages around a time, as the localizer would get them."""
        return Step(
            index=0,
            segment=0,
            start_ns=start_ns,
            stamp_ns=end_ns,
            motion={
                kind: buffer.window(start_ns - round(history_s * 1e9), end_ns, beyond=False)
                if kind is ControlEvent
                else buffer.window(start_ns, end_ns)
                for kind, buffer in self._buffers.items()
            },
        )

    def gyro_bias(self, stamp_ns: int) -> float:
        """Bias of the gyro [rad/s] as it was known 10 s before a time, as after 10 s of dead reckoning."""
        if not len(self._biases):
            return 0.0
        return float(self._biases[max(0, int(np.searchsorted(self._stamps(ImuEvent), stamp_ns, "right")) - 1)])

    def signals(self, wanted: tuple[str, ...], origin_ns: int) -> Signals:
        """The wanted signals over the whole recording."""
        events = {InertialEvent: self._all(ImuEvent), JointsEvent: self._all(JointsEvent)}
        return signals_of(wanted, events, origin_ns, Mounting(self.joints, self._biases, self.imu_up))

    def _stamps(self, kind: type[MotionEvent]) -> list[int]:
        return self._buffers[kind].stamps

    def _all(self, kind: type[MotionEvent]) -> tuple[Any, ...]:
        stamps = self._stamps(kind)
        return self._buffers[kind].window(stamps[0], stamps[-1]) if stamps else ()

    def _gyro_biases(self, config: GyroConfig, truth: tuple[NDArray[np.int64], FloatArray] | None) -> FloatArray:
        """Bias [rad/s] that the localizer's own filter knew some time before each IMU message ``(n,)``."""
        stamps = self._stamps(ImuEvent)
        if not stamps:
            return np.zeros(0)
        gyro, wheels = Gyro(config, self.imu_up), WheelMotion(self.wheels) if self.has_wheels else None
        at, biases = [stamps[0]], [0.0]
        for start in range(stamps[0], stamps[-1], _STEP_NS):
            step = self.step(start, start + _STEP_NS)
            measured = None if wheels is None else wheels.measure(step)
            turn = gyro.measure(step, None if measured is None else measured.motion)
            if turn is None:
                gyro.forget_fix()
            else:
                gyro.turned(turn.yaw, step.dt)
            at.append(step.stamp_ns)
            if truth is not None and (yaw := _yaw_at(*truth, step.stamp_ns)) is not None:
                gyro.fix(yaw, _FIX_SIGMA**2)
            biases.append(gyro.bias)
        known = np.searchsorted(at, np.array(stamps) - _NO_FIX_NS, "right") - 1
        first = np.searchsorted(at, stamps[0] + _FIRST_NS)  # a robot rests before it sets out
        return np.array(biases)[np.maximum(known, np.minimum(np.searchsorted(at, stamps, "right") - 1, first))]


def _yaw_at(stamps_ns: NDArray[np.int64], poses: FloatArray, at_ns: int) -> float | None:
    """Yaw [rad] between the poses around a time; None if there is no truth there."""
    k = int(np.searchsorted(stamps_ns, at_ns, "right")) - 1
    if k < 0 or k + 1 >= len(stamps_ns) or stamps_ns[k + 1] - stamps_ns[k] > _MAX_TRUTH_GAP_NS:
        return None
    share = (at_ns - stamps_ns[k]) / (stamps_ns[k + 1] - stamps_ns[k])
    return float(poses[k, 2] + share * math.remainder(poses[k + 1, 2] - poses[k, 2], math.tau))


# --- Motion on slopes -------------------------------------------------------------------------------------------------

_LEVEL_RAD = 0.01  # a positioning system measures roll and pitch no better; below, the floor is flat


def in_robots_plane(poses: FloatArray, ground: FloatArray) -> FloatArray:
    """The path that would be driven on a flat floor by the same motions in the robot's plane.

    Args:
        poses: ``(m, 3)`` in the map, in order of time.
        ground: ``(m, 3)`` height, roll and pitch there.

    Returns:
        ``(m, 3)``, beginning at the first pose; of a flat floor the poses as they are.
    """
    if np.ptp(ground[:, 1:], axis=0).max() < _LEVEL_RAD:
        return poses
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    Rz = np.zeros((len(poses), 3, 3))
    Rz[:, 0, 0], Rz[:, 0, 1], Rz[:, 1, 0], Rz[:, 1, 1], Rz[:, 2, 2] = c, -s, s, c, 1.0
    R = Rz @ rotations(ground[:, 1:])
    moved = np.diff(np.column_stack([poses[:, :2], ground[:, 0]]), axis=0)
    way = np.einsum("mji,mj->mi", R[:-1], moved)  # in the axes of the robot
    turn = np.einsum("mji,mjk->mik", R[:-1], R[1:])
    yaw = poses[0, 2] + np.concatenate([[0.0], np.cumsum(0.5 * (turn[:, 1, 0] - turn[:, 0, 1]))])
    steps = se2.turned(way[:, :2], yaw[:-1])
    return np.column_stack([poses[0, :2] + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), yaw])


# --- Runs -------------------------------------------------------------------------------------------------------------

_FINE_S = 0.02  # the truth is resampled to this before it is smoothed


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One recording at times ``k·dt_s``."""

    name: str
    origin_ns: int
    dt_s: float
    poses: FloatArray  # (n, 3) smoothed truth, yaw unwrapped
    velocities: FloatArray  # (n, 3) body vx [m/s], vy [m/s], ω [rad/s]
    valid: NDArray[np.bool_]  # (n,) there is a truth around this time, and it can be true
    sensors: SensorRecord
    track: CommandHistory  # time zero is origin_ns

    @property
    def commands(self) -> tuple[ControlEvent, ...]:
        """Commands in order of stamp."""
        return self.sensors.commands

    @property
    def times(self) -> FloatArray:
        """Times ``(n,)`` [s] of the samples since the origin."""
        return np.asarray(np.arange(len(self.poses)) * self.dt_s, dtype=float)

    def starts(self, steps: int, stride: int = 1) -> NDArray[np.int64]:
        """Indices from which ``steps`` steps are valid throughout."""
        broken = np.concatenate([[0], np.cumsum(~self.valid)])
        k = np.arange(0, len(self.poses) - steps, stride)
        return np.asarray(k[broken[k + steps + 1] == broken[k]], dtype=np.int64)


def need_windows(runs: Sequence[Run], window_s: float, purpose: str) -> None:
    """Make sure that samples can be made of some recordings.

    Args:
        runs: those that train, or those that validate.
        window_s: time for which there has to be a truth throughout.
        purpose: what the samples are for.

    Raises:
        RecordingError: none of the runs has such a window.
    """
    if any(len(run.starts(round(window_s / run.dt_s))) for run in runs):
        return
    raise RecordingError(
        f"no samples to {purpose}: no {window_s:g} s of unbroken truth in {', '.join(map(_validity, runs))}. Gaps of "
        "the truth (data.max_truth_gap_s) are left out, sideways motion (data.max_sideways_mps) and, of a smoothed "
        "truth, poses that are LOST or too unsure (data.max_truth_sigma_m): record or smooth anew, or raise the limits"
    )


def _validity(run: Run) -> str:
    """A run's name, with how much of it has a truth."""
    ends = np.flatnonzero(np.diff(np.concatenate([[False], run.valid, [False]]).astype(int)))
    longest = max(ends[1::2] - ends[::2], default=0) * run.dt_s
    known, whole = run.valid.sum() * run.dt_s, len(run.valid) * run.dt_s
    return f"{run.name} ({known:.1f} of {whole:.1f} s, at most {longest:.1f} s at a time)"


def load_run(
    path: Path, name: str, dt_s: float, history_s: float, config: DataConfig, truth_from: Path | None = None
) -> Run:
    """Read a bag. A ``robot.yaml`` beside it says how.

    Args:
        path: the bag.
        name: what the split calls it.
        dt_s: time step of the samples.
        history_s: commands wanted before the first sample.
        config: smoothing and cutting.
        truth_from: what `fgloc smooth` wrote for this bag, to be believed in place of the bag's own truth: its folder
            or a TUM file. Poses whose covariance beside it says too little are left out.

    Raises:
        RecordingError: it cannot be read, or has no commands, no truth or too little of both.
        TrajectoryError: the trajectory cannot be read.
    """
    whole = _read(path, config, truth_from)
    return make_run(
        name,
        SensorRecord(whole.sensed, whole.settings, whole.imu_up, whole.truth),
        *whole.truth,
        dt_s,
        history_s,
        config,
    )


def load_runs(path: Path, name: str, dt_s: float, config: DataConfig, truth_from: Path | None = None) -> dict[str, Run]:
    """Read a bag as one run or, where no message at all came for longer than ``config.apart_s``, as several.

    The name of one run is the recording's, of several ``name.0``, ``name.1`` and so on; stretches that are too short
    are left out. Arguments else, and errors, as of `load_run`.
    """
    whole = _read(path, config, truth_from)
    stamps, poses = whole.truth
    all_ns = np.sort(np.concatenate([[e.stamp_ns for e in whole.sensed], stamps]).astype(np.int64))
    limits = [int(all_ns[0]), *all_ns[1:][np.diff(all_ns) > config.apart_s * 1e9].tolist(), int(all_ns[-1]) + 1]
    if len(limits) == 2:
        record = SensorRecord(whole.sensed, whole.settings, whole.imu_up, whole.truth)
        return {name: make_run(name, record, stamps, poses, dt_s, config.history_s, config)}
    runs: dict[str, Run] = {}
    both = False
    sensed = sorted(whole.sensed, key=lambda e: e.stamp_ns)
    sensed_ns = [e.stamp_ns for e in sensed]
    for k, (first, last) in enumerate(pairwise(limits)):
        part = sensed[bisect_left(sensed_ns, first) : bisect_left(sensed_ns, last)]
        inside = (stamps >= first) & (stamps < last)
        if not inside.any() or not any(isinstance(event, ControlEvent) for event in part):
            continue
        both = True
        record, label = SensorRecord(part, whole.settings, whole.imu_up, whole.truth), f"{name}.{k}"
        with suppress(RecordingError):
            runs[label] = make_run(label, record, stamps[inside], poses[inside], dt_s, config.history_s, config)
    if not both:
        raise RecordingError(
            f"{path}: none of {len(limits) - 1} stretches between silences has both commands and truth; check their "
            "stamps with `fgloc info`"
        )
    if not runs:
        raise RecordingError(f"{path}: {len(limits) - 1} stretches, each shorter than {config.shortest_s:g} s")
    return runs


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
    """A recording before it is cut to samples."""

    settings: Config
    sensed: list[Event]
    truth: tuple[NDArray[np.int64], FloatArray]  # stamps (m,) and poses (m, 3)
    imu_up: FloatArray


def _read(path: Path, config: DataConfig, truth_from: Path | None) -> _Recorded:
    settings = _settings(path)
    truth: list[TruthEvent] = []
    sensed: list[Event] = []
    with _opened(path, settings.recording) as recording:
        for event in recording.events():
            if isinstance(event, TruthEvent):
                truth.append(event)
            else:
                sensed.append(event)
        up = mounted_up(RecordingFacts(recording), settings)
    if truth_from is None:
        stamps, rows = np.array([e.stamp_ns for e in truth]), np.array([base_pose(e, settings.truth) for e in truth])
        if len(truth) > 1:
            rows = in_robots_plane(rows, np.array([base_ground(e, settings.truth) for e in truth]))
    else:
        stamps, rows = smoothed_truth(truth_from, config)
    for kind, count in (("commands", sum(isinstance(e, ControlEvent) for e in sensed)), ("truth", len(stamps))):
        if count < 2:
            raise RecordingError(f"{path}: {count} messages of {kind}; identification needs commands and truth")
    if truth_from is None and (lacks_yaw(rows) or not all(event.has_yaw for event in truth)):
        raise RecordingError(
            f"{path}: the truth has positions and no yaw, which identification needs; smooth the recording and give "
            "its folder as the truth of the training"
        )
    return _Recorded(settings, sensed, (stamps, rows), up)


_READ = ("command", "joints", "imu", "odometry", "truth")


def _opened(path: Path, config: RecordingConfig) -> Recording:
    """The recording; topics that training does not read may be missing or ambiguous.

    Raises:
        RecordingError: it cannot be read, or one of the other topics is missing or ambiguous.
    """
    recording = Recording(path, config)
    if not recording.problems:
        return recording
    recording.close()
    return open_recording(path, config.model_copy(update={"topics": config.topics.only(_READ)}))


def make_run(
    name: str,
    record: SensorRecord | Sequence[ControlEvent],
    truth_ns: NDArray[np.int64],
    truth: FloatArray,
    dt_s: float,
    history_s: float,
    config: DataConfig,
) -> Run:
    """A run from sensors, or commands alone, and truth poses ``(m, 3)`` at ``truth_ns``; else as `load_run`.

    Raises:
        RecordingError: commands and truth overlap too little.
    """
    record = record if isinstance(record, SensorRecord) else SensorRecord(record)
    commands = record.commands
    order = np.unique(truth_ns, return_index=True)[1]
    truth_ns, truth = truth_ns[order], truth[order]
    first = max(int(truth_ns[0]) + round(config.margin_s * 1e9), commands[0].stamp_ns + round(history_s * 1e9))
    last = min(int(truth_ns[-1]), commands[-1].stamp_ns) - round(config.margin_s * 1e9)
    n = int((last - first) * 1e-9 / dt_s) + 1
    if n * dt_s < config.shortest_s:
        raise RecordingError(
            f"{name}: commands and truth overlap for {max(0.0, (last - first) * 1e-9):.1f} s; expected at least "
            f"{config.shortest_s:g} s; check the stamps with `fgloc info`"
        )
    t_truth = np.asarray((truth_ns - first) * 1e-9, dtype=float)
    times = np.asarray(np.arange(n) * dt_s, dtype=float)
    poses, velocities = _smooth(t_truth, truth, times, config.smoothing_s)
    return Run(
        name=name,
        origin_ns=first,
        dt_s=dt_s,
        poses=poses,
        velocities=velocities,
        valid=_has_truth(t_truth, times, config) & _possible(velocities, dt_s, config),
        sensors=record,
        track=CommandHistory(commands, first),
    )


def smoothed_truth(path: Path, config: DataConfig) -> tuple[NDArray[np.int64], FloatArray]:
    """Stamps and poses ``(m, 3)`` of a smoothed trajectory, without those that are LOST or too unsure.

    Args:
        path: a folder that `fgloc smooth` wrote, or a TUM file; ``steps.csv`` and ``covariance.csv`` beside the file
            are read if there.
        config: ``max_truth_sigma_m`` bounds the standard deviation of the position.

    Raises:
        TrajectoryError: it cannot be read, or nothing is left.
    """
    tum = path / "trajectory.tum" if path.is_dir() else path
    trajectory = read_tum(tum)
    steps, table = tum.with_name("steps.csv"), tum.with_name("covariance.csv")
    modes = read_modes(steps) if steps.is_file() else {}
    known = ~np.isin(trajectory.stamps_ns, [stamp for stamp, mode in modes.items() if mode is Mode.LOST])
    if not known.any():
        raise TrajectoryError(
            f"{path}: the robot was LOST at each of its {len(trajectory)} poses, which are no truth; see its "
            "report.html, smooth the recording again, or leave it out"
        )
    if config.max_truth_sigma_m is None or not table.is_file():
        return trajectory.stamps_ns[known], trajectory.poses[known]
    try:
        variances = np.loadtxt(table, delimiter=",", skiprows=1, usecols=(1, 4), ndmin=2)
    except (OSError, ValueError) as error:
        raise TrajectoryError(f"{table}: not a table of covariances ({error}); write it with `fgloc smooth`") from error
    if len(variances) != len(trajectory):
        raise TrajectoryError(f"{table}: {len(variances)} rows, {tum} has {len(trajectory)}; both come from one run")
    best = np.sqrt(variances[known].sum(axis=1).min())
    known &= variances.sum(axis=1) <= config.max_truth_sigma_m**2
    if not known.any():
        raise TrajectoryError(
            f"{tum}: no pose is known to {config.max_truth_sigma_m} m, the best to {best:.3f} m; "
            "raise data.max_truth_sigma_m"
        )
    return trajectory.stamps_ns[known], trajectory.poses[known]


def cut(run: Run, name: str, first: int, last: int) -> Run:
    """The samples ``[first, last)`` of a run, as a run of their own; commands before them stay known."""
    return replace(
        run,
        name=name,
        origin_ns=run.origin_ns + round(first * run.dt_s * 1e9),
        poses=run.poses[first:last],
        velocities=run.velocities[first:last],
        valid=run.valid[first:last],
        track=CommandHistory(run.commands, run.origin_ns + round(first * run.dt_s * 1e9)),
    )


def _smooth(
    t_truth: FloatArray, truth: FloatArray, times: FloatArray, window_s: float
) -> tuple[FloatArray, FloatArray]:
    """Poses ``(n, 3)`` and body velocities ``(n, 3)`` at the times, from local cubic fits."""
    window = max(5, 2 * round(window_s / _FINE_S / 2) + 1)
    first, last = max(times[0] - window * _FINE_S, t_truth[0]), min(times[-1] + window * _FINE_S, t_truth[-1])
    fine = np.linspace(first, last, max(window, 1 + round((last - first) / _FINE_S)))
    yaw = np.unwrap(truth[:, 2])
    raw = np.column_stack([np.interp(fine, t_truth, c) for c in (truth[:, 0], truth[:, 1], yaw)])
    smooth = savgol_filter(raw, window, 3, axis=0)
    rates = savgol_filter(raw, window, 3, deriv=1, delta=fine[1] - fine[0], axis=0)
    poses, rates = (np.column_stack([np.interp(times, fine, c) for c in part.T]) for part in (smooth, rates))
    return poses, np.column_stack([se2.turned(rates[:, :2], -poses[:, 2]), rates[:, 2]])


def _has_truth(t_truth: FloatArray, times: FloatArray, config: DataConfig) -> NDArray[np.bool_]:
    """Whether the smoothing window around each time is free of gaps."""
    reach = 0.5 * config.smoothing_s
    gaps = np.flatnonzero(np.diff(t_truth) > config.max_truth_gap_s)
    known = np.ones(len(times), dtype=bool)
    for k in gaps:
        known[(times > t_truth[k] - reach) & (times < t_truth[k + 1] + reach)] = False
    return known


def _possible(velocities: FloatArray, dt_s: float, config: DataConfig) -> NDArray[np.bool_]:
    """Whether the smoothing window around each time is free of motion that wheels do not make."""
    if config.max_sideways_mps is None:
        return np.ones(len(velocities), dtype=bool)
    reach = round(0.5 * config.smoothing_s / dt_s)
    slid = np.abs(velocities[:, 1]) > config.max_sideways_mps
    return np.convolve(slid, np.ones(2 * reach + 1), "same") < 0.5


def _settings(path: Path) -> Config:
    beside = path.parent / "robot.yaml"
    return load_config(beside) if beside.is_file() else Config()
