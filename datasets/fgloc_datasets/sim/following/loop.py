"""The closed loop of a drive: sensors, pose, follower, motors. Nothing is known earlier than on a robot.

A message reaches the pose's estimator at its simulated receive time; an image `PROCESSING_S` later, which stands for
the time that detection and update take.
"""

from __future__ import annotations

import csv
import heapq
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, get_args

import numpy as np
import yaml
from pydantic import ValidationError

from fgloc.ablation.failures import Corruption, Kidnap, Lift, Truncated
from fgloc.ablation.suite import FailureEntry
from fgloc.config import Config, Role, config_of
from fgloc.errors import ConfigError, EstimatorError
from fgloc.files.atomic import atomic_folder
from fgloc.files.settings import merged, sentences
from fgloc.live import Live
from fgloc.recording.reader import MessageEvents
from fgloc.sensors.failures import Failure
from fgloc.sensors.markers.images import CornersEvent, ImageEvent
from fgloc.types import Event, FloatArray, LandmarkMap, Mode, TruthEvent
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message
from fgloc_datasets.sim.drives import Command, as_driven
from fgloc_datasets.sim.following.pursuit import Curve, Pursuit, PursuitSettings, State, WaypointPath
from fgloc_datasets.sim.physics import Scene, Simulation, make_scene
from fgloc_datasets.sim.record import RUN_FILES, robot_settings, write_beside
from fgloc_datasets.sim.scenario import Scenario
from fgloc_datasets.sim.sensors import EPOCH_NS, Sees, stamp_ns, streams

# --- Failures of sensors ----------------------------------------------------------------------------------------------

_NOW = "/now"  # topic of the events that only tell how late it is


class FailingSensors:
    """Applies failures to the events of a drive, in order of receipt.

    Attributes:
        landmark_map: what the robot is given for a map.
    """

    def __init__(
        self, failures: Sequence[Failure], config: Config, landmarks: LandmarkMap, duration_s: float, seed: int
    ) -> None:
        """Draw what is random in the failures.

        Raises:
            ConfigError: a failure that only a recording can have.
        """
        for failure in failures:
            if failure.stage != "recorded" or isinstance(failure, Kidnap | Lift | Truncated):
                raise ConfigError(
                    f"failure '{failure.kind}' changes recordings or what was found in images; while a robot drives "
                    "there are those of its messages: dropout, darkness, latency, encoder_dead, moved_marker, ..."
                )
        failing = Corruption(failures, (EPOCH_NS, duration_s), config, landmarks, seed)
        self.landmark_map = failing.corrupt_map(landmarks)
        self._waiting: deque[Event] = deque()
        self._now_ns = 0
        self._out = failing.recorded(self._arriving())

    def after(self, events: Iterable[Event], now_ns: int) -> Iterator[Event]:
        """Events received up to now, after the failures, and events that were held back until now."""
        self._waiting.extend(events)
        self._now_ns = now_ns
        for event in self._out:
            if event.topic != _NOW:
                yield event
            elif event.received_ns > now_ns:
                return

    def _arriving(self) -> Iterator[Event]:
        """Yield the waiting events, then times without end, by which failures that hold events back release them."""
        while True:
            if self._waiting:
                yield self._waiting.popleft()
            else:
                self._now_ns += 1
                yield TruthEvent(self._now_ns, self._now_ns, _NOW, "", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def read_failures(texts: Sequence[str]) -> tuple[Failure, ...]:
    """Failures as a suite of ablations describes them, each a YAML mapping.

    Raises:
        ConfigError: no YAML, no such failure, or a wrong value.
    """
    if not texts:
        return ()
    try:
        return FailureEntry.model_validate({"name": "given", "chain": [yaml.safe_load(text) for text in texts]}).chain
    except yaml.YAMLError as error:
        raise ConfigError(f"--failure: no YAML ({error}); write {{kind: dropout, sensor: camera}}") from error
    except ValidationError as error:
        raise ConfigError("--failure: " + "; ".join(sentences(error, FailureEntry))) from error


# --- Poses that guide the robot ---------------------------------------------------------------------------------------

PoseName = Literal["truth", "fgloc", "fgloc-no-model", "fgloc-no-model-no-gyro", "fgloc-constant", "wheels", "learned"]
POSES: tuple[PoseName, ...] = get_args(PoseName)
_START_SIGMA = 1e-3  # m and rad: dead reckoning begins at the true pose
_PATIENCE_S = 120.0  # of wall time, for what has been pushed
_BLIND: dict[str, Any] = {"recording": {"topics": {"image": "none", "camera_info": "none", "sightings": "none"}}}
_CHANGES: dict[PoseName, dict[str, Any]] = {
    "fgloc": {},
    "fgloc-no-model": {"motion": {"use": False}},
    "fgloc-no-model-no-gyro": {"motion": {"use": False}, "gyro": {"use": False}},
    "fgloc-constant": {"weights": {"adaptive": False}},
    "wheels": {**_BLIND, "motion": {"use": False}, "gyro": {"use": False}},
    "learned": {
        "recording": {"topics": {**_BLIND["recording"]["topics"], "odometry": "none"}},
        "wheels": {"source": "none"},
    },
}


class TruePose:
    """The true pose, for comparison."""

    def push(self, event: Event) -> None:
        """Ignore the event."""

    def pose(self, stamp_ns: int, truth: FloatArray) -> tuple[FloatArray | None, float]:
        """The true pose, with sigma 0."""
        return truth, 0.0

    def close(self) -> None:
        """Do nothing: there is nothing to end."""


class LivePose:
    """The pose of a `Live`: everything that has arrived is used before it is asked, so that runs can be repeated."""

    def __init__(self, config: Config, landmark_map: LandmarkMap | None, roles: set[str], heeds_sigma: bool) -> None:
        """Start the live run.

        Args:
            config: as on the robot.
            landmark_map: None: dead reckoning.
            roles: what will arrive; the run begins when all of it is there.
            heeds_sigma: tell the pose's covariance; a dead-reckoned robot would stop at some time.
        """
        self._heeds_sigma = heeds_sigma
        self._live = Live(config, landmark_map, roles=roles)

    def push(self, event: Event) -> None:
        """Add an event."""
        self._live.push(event)

    def pose(self, stamp_ns: int, truth: FloatArray) -> tuple[FloatArray | None, float]:
        """Newest pose ``(3,)``, propagated to the stamp; None where the robot is lost.

        With it the standard deviation of its position in the worst direction [m].
        """
        if not self._live.wait(_PATIENCE_S):
            raise EstimatorError(f"the live run did not use its events within {_PATIENCE_S:.0f} s")
        known = self._live.pose_at(stamp_ns)
        if known is None or known.mode in (Mode.UNCONFIRMED, Mode.LOST):
            return None, 0.0
        sigma = float(np.sqrt(np.linalg.eigvalsh(known.cov[:2, :2])[-1])) if self._heeds_sigma else 0.0
        return known.pose, sigma

    def close(self) -> None:
        """End the threads of the live run."""
        self._live.close()


PoseSource = TruePose | LivePose


def pose_source(
    name: PoseName, config: Config, landmark_map: LandmarkMap, sees: str, start: tuple[float, float, float]
) -> PoseSource:
    """Source of the pose by its name.

    Args:
        name: "truth"; "fgloc", and the same without its learned motion, without that and the gyro, or with constant
            weights; "wheels" or "learned": wheel odometry or the learned motion alone, carried on from the true start.
        config: as in ``robot.yaml``.
        landmark_map: as surveyed.
        sees: role of the camera: "image" or "sightings".
        start: true pose.
    """
    if name == "truth":
        return TruePose()
    changes = _CHANGES[name]
    roles = {"odometry", "joints", "command", "imu"}
    if name.startswith("fgloc"):
        return LivePose(changed(config, changes), landmark_map, roles | {sees}, heeds_sigma=True)
    begin = {"estimator": {"initial_pose": start, "initial_sigmas": (_START_SIGMA,) * 3}}
    roles -= {"odometry"} if name == "learned" else set()
    return LivePose(changed(changed(config, changes), begin), None, roles, heeds_sigma=False)


def changed(config: Config, changes: dict[str, Any]) -> Config:
    """The configuration with some of its values replaced, given as nested mappings."""
    return config_of(merged(config.model_dump(exclude_unset=True), changes))


# --- Outcome of a drive -----------------------------------------------------------------------------------------------

REACHED_M = 0.10  # a waypoint is reached if the robot has come so near
_EVERY_M = 0.01  # of the true path, for means over its length
_COLUMNS = ("t", "x", "y", "yaw", "sigma", "v", "omega", "state", "true_x", "true_y", "true_yaw")


@dataclass(frozen=True, slots=True)
class Score:
    """Measures of how well a path was followed.

    Attributes:
        track_mm: mean distance of the true path from the waypoints' curve, over the length of the true path.
        worst_mm: the largest.
        reached: share of the waypoints that the robot has come within 10 cm of.
        arrived: whether the follower came to its end.
        seconds: until then, or until the time was over.
        pose_mm: mean distance of the pose that guided the robot from the truth.
        stopped_s: how long the robot stood or searched because it had no pose to drive by.
    """

    track_mm: float
    worst_mm: float
    reached: float
    arrived: bool
    seconds: float
    pose_mm: float | None
    stopped_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Trajectory, commands and score of one drive.

    Attributes:
        times_s: ``(n,)`` of the commands.
        poses: ``(n, 3)`` that the follower was given, NaN where there was none.
        sigmas_m: ``(n,)`` of their position.
        commands: ``(n, 2)`` v, omega.
        states: of the follower.
        true_poses: ``(n, 3)`` at the same times.
        true_path: ``(m, 3)`` x, y, z of the whole drive.
        score: how well.
    """

    times_s: FloatArray
    poses: FloatArray
    sigmas_m: FloatArray
    commands: FloatArray
    states: tuple[State, ...]
    true_poses: FloatArray
    true_path: FloatArray
    score: Score

    @classmethod
    def of(cls, curve: Curve, true: FloatArray, rows: FloatArray, states: tuple[State, ...]) -> Followed:
        """Score a drive.

        Args:
            curve: that was to be followed.
            true: ``(m, 7)`` position and quaternion at every tick.
            rows: ``(n, 7)`` of the loop, evenly over the ticks.
            states: ``(n,)``.
        """
        every = round((len(true) - 1) / max(len(rows) - 1, 1))
        at = true[: every * len(rows) : every]
        x, y, z, w = at[:, 3:].T
        true_poses = np.column_stack([at[:, :2], np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])
        known = np.isfinite(rows[:, 1])
        errors = np.hypot(*(rows[known, 1:3] - true_poses[known, :2]).T)
        off = curve.distances(_evenly(true[:, :2]))
        waypoints = curve.points[curve.at_waypoints]
        nearest = [float(np.hypot(*(true[:, :2] - p).T).min()) for p in waypoints]
        waiting = np.array([s in (State.STOPPED, State.SEARCHING) for s in states])
        arrived = State.ARRIVED in states
        end = states.index(State.ARRIVED) if arrived else len(states) - 1
        score = Score(
            track_mm=1e3 * float(off.mean()),
            worst_mm=1e3 * float(off.max()),
            reached=float(np.mean(np.array(nearest) <= REACHED_M)),
            arrived=arrived,
            seconds=float(rows[end, 0]),
            pose_mm=1e3 * float(errors.mean()) if known.any() else None,
            stopped_s=float(waiting.sum() * (rows[1, 0] - rows[0, 0])),
        )
        return cls(rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5:], states, true_poses, true[:, :3], score)


def _evenly(places: FloatArray) -> FloatArray:
    """Places ``(m, 2)`` at even distances along a path ``(n, 2)``."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(places, axis=0).T).cumsum()])
    at = np.arange(0.0, along[-1] + _EVERY_M, _EVERY_M)
    return np.column_stack([np.interp(at, along, places[:, k]) for k in range(2)])


def write_followed(
    followed: Followed, path: WaypointPath, pose: str, failures: Sequence[Failure], folder: Path
) -> None:
    """Write ``following.csv``, a row for each command, and ``following.yaml``: path, pose, failures and score."""
    with (folder / "following.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for i, t in enumerate(followed.times_s):
            numbers = (*followed.poses[i], followed.sigmas_m[i], *followed.commands[i])
            true = [f"{v:.6f}" for v in followed.true_poses[i]]
            table.writerow([f"{t:.3f}", *(f"{v:.6f}" for v in numbers), followed.states[i].value, *true])
    content = {
        "pose": pose,
        "score": asdict(followed.score),
        "failures": [failure.model_dump(mode="json") for failure in failures],
        "path": path.model_dump(mode="json"),
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    (folder / "following.yaml").write_text(text, encoding="utf-8")


# --- The drive --------------------------------------------------------------------------------------------------------

PROCESSING_S = 0.03  # on one core: detection in 640 x 480 takes 15 ms, an update 6 ms (99 %: 10 ms)
_RESTS_S = 0.5  # at the end
_TIME_TO_SPARE = (2.0, 20.0)  # of the time that the path takes at its speed; and seconds
ROLES: dict[str, Role] = {
    "/odom": "odometry",
    "/cmd_vel": "command",
    "/joint_states": "joints",
    "/imu": "imu",
    "/camera/image/compressed": "image",
    "/camera/corners": "sightings",
    "/camera/camera_info": "camera_info",
}


def seen_by(corners: bool) -> Sees:
    """Kind of the camera's messages: corners of markers, or images."""
    return "corners" if corners else "images"


@dataclass(frozen=True, slots=True)
class Drive:
    """Settings of one drive.

    Attributes:
        scenario: robot, room, sensors, installation; its control is not used.
        path: to be followed.
        pose: what guides the robot.
        seed: of all that is drawn.
        failures: of the sensors, on the way to the estimator: the recording has what they measured.
        sees: what the camera sends. Corners need no OpenGL.
        settings: of the follower.
    """

    scenario: Scenario
    path: WaypointPath
    pose: PoseName = "fgloc"
    seed: int = 1
    failures: tuple[Failure, ...] = ()
    sees: Sees = "images"
    settings: PursuitSettings = field(default_factory=PursuitSettings)

    def placed(self) -> Scenario:
        """The scenario with the robot at the path's start, and long enough."""
        factor, spare = _TIME_TO_SPARE
        seconds = factor * Curve(self.path).length_m / self.path.speed_m_s + spare
        return self.scenario.model_copy(update={"start": self.path.start, "duration_s": seconds})


def follow(drive: Drive, out: Path | None = None) -> Followed:
    """Drive once, into ``out`` if it is given: a run's folder as of `record`, ``following.csv`` and ``following.yaml``.

    Raises:
        ConfigError: a failure that a driving robot cannot have, or fgloc is to guide a robot that sees nothing.
        SimulationError: the physics diverged.
        RenderError: images are wanted and there is no OpenGL.
    """
    blind = drive.scenario.camera is None or drive.sees == "nothing"
    if drive.pose.startswith("fgloc") and blind:
        raise ConfigError(
            f"scenario '{drive.scenario.name}' shows the robot no markers: {drive.pose} would never know where it is; "
            "give it a camera, or --pose truth, wheels or learned"
        )
    with ExitStack() as stack:
        if out is None:
            stage = Path(stack.enter_context(TemporaryDirectory()))
        else:
            stage = stack.enter_context(atomic_folder(out, own=(*RUN_FILES, "following.csv", "following.yaml")))
        scene = make_scene(drive.placed(), drive.seed)
        followed = _drive(drive, scene, stage / "bag")
        write_beside(stage, scene, drive.placed(), drive.sees == "images")
        write_followed(followed, drive.path, drive.pose, drive.failures, stage)
    return followed


def _drive(drive: Drive, scene: Scene, bag_folder: Path) -> Followed:
    config = config_of(robot_settings(scene.scenario))
    sensors = FailingSensors(drive.failures, config, scene.surveyed, scene.scenario.duration_s, drive.seed)
    simulation, curve = Simulation(scene), Curve(drive.path)
    role = "sightings" if drive.sees == "corners" else "image"
    with ExitStack() as stack:
        source = pose_source(drive.pose, config, sensors.landmark_map, role, scene.scenario.start)
        stack.callback(source.close)
        arrivals = Arrivals(config)
        bag = stack.enter_context(BagWriter(bag_folder, compress=True, tap=arrivals.take))
        channels = streams(scene, simulation.log, bag, camera=drive.sees)
        for channel in channels:
            if isinstance(channel, Generator):  # the drive may end before its messages do
                stack.enter_context(closing(channel))
        pursuit = Pursuit(curve, drive.path.speed_m_s, drive.settings)
        loop = ClosedLoop(Written(channels), arrivals, sensors, source, pursuit, scene.scenario)
        log = simulation.run(loop)
    true = np.column_stack([log.positions, log.quaternions])[: log.ticks]
    return Followed.of(curve, true, np.array(loop.rows), tuple(loop.states))


class Written:
    """Writes the messages of a run in the order of receipt, as time goes by."""

    def __init__(self, channels: Sequence[Iterator[Message]]) -> None:
        """Take the channels of a run."""
        self._messages = heapq.merge(*channels, key=itemgetter(0))
        self._next = next(self._messages, None)

    def until(self, now_ns: int) -> None:
        """Write all messages that have been received by now."""
        while self._next is not None and self._next[0] <= now_ns:
            self._next[1]()
            self._next = next(self._messages, None)


class Arrivals:
    """Messages on their way to the estimator."""

    def __init__(self, config: Config) -> None:
        """Start without messages."""
        self._events = MessageEvents(config.recording)
        self._queue: list[tuple[int, int, Event]] = []
        self._order = count()

    def take(self, topic: str, message_type: str, content: Any, received_ns: int) -> None:
        """Add the events of a message that was written to the bag."""
        role = ROLES.get(topic)
        if role is None and not topic.startswith("/tf"):
            return
        for event in self._events.of(content, message_type, role, received_ns, topic):
            if isinstance(event, ImageEvent | CornersEvent):
                event = replace(event, received_ns=received_ns + round(1e9 * PROCESSING_S))
            heapq.heappush(self._queue, (event.received_ns, next(self._order), event))

    def until(self, now_ns: int) -> Iterator[Event]:
        """Yield the events that have arrived by now, in order."""
        while self._queue and self._queue[0][0] <= now_ns:
            yield heapq.heappop(self._queue)[2]


class ClosedLoop:
    """`Controller` that at each command uses the events that have arrived, gets the pose, and asks the follower.

    Attributes:
        rows: one for each command: time [s]; the pose x, y, yaw (NaN: none) and its sigma; v and omega.
        states: of the follower, one for each.
    """

    def __init__(
        self,
        written: Written,
        arrivals: Arrivals,
        sensors: FailingSensors,
        source: PoseSource,
        pursuit: Pursuit,
        scenario: Scenario,
    ) -> None:
        """Connect the parts; the robot stands at first, as the scenario says."""
        self._written, self._arrivals, self._sensors = written, arrivals, sensors
        self._source, self._pursuit, self._rest_s = source, pursuit, scenario.control.rest_s
        self._robot, self._steering = scenario.robot, 0.0
        self._arrived_s: float | None = None
        self.rows: list[tuple[float, ...]] = []
        self.states: list[State] = []

    def command(self, t: float, pose: tuple[float, float, float]) -> Command | None:
        """Command of the follower for the events known now; None some time after it has arrived."""
        now_ns = stamp_ns(t)
        self._written.until(now_ns)
        for event in self._sensors.after(self._arrivals.until(now_ns), now_ns):
            self._source.push(event)
        known, sigma = self._source.pose(now_ns, np.array(pose))
        resting = t < self._rest_s
        wanted = (0.0, 0.0) if resting else self._pursuit.command(t, known, sigma)
        command = as_driven(self._robot, *wanted, steering=self._steering)
        self._steering = command.steering
        shown: FloatArray = np.full(3, np.nan) if known is None else known
        self.rows.append((t, *shown.tolist(), sigma, command.v, command.omega))
        self.states.append(State.STOPPED if resting else self._pursuit.state)
        if self._pursuit.state is State.ARRIVED:
            self._arrived_s = t if self._arrived_s is None else self._arrived_s
            if t - self._arrived_s >= _RESTS_S:
                return None
        return command
