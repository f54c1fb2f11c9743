"""The closed loop: sensors, pose, follower, motors. Nothing is known earlier than on a robot.

A message reaches the pose's estimator at its simulated receive time; an image `PROCESSING_S` later, which stands for
the time that detection and update take.
"""

from __future__ import annotations

import heapq
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import count
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from fgloc.config import Config, Role, config_of
from fgloc.errors import ConfigError
from fgloc.files.atomic import atomic_folder
from fgloc.recording.reader import events_of
from fgloc.sensors.failures import Failure
from fgloc.sensors.markers.images import CornersEvent, ImageEvent
from fgloc.types import Event, FloatArray
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message
from fgloc_datasets.sim.control import Command
from fgloc_datasets.sim.following.failing import FailingSensors
from fgloc_datasets.sim.following.path import Curve, WaypointPath
from fgloc_datasets.sim.following.poses import PoseName, PoseSource, pose_source
from fgloc_datasets.sim.following.pursuit import Pursuit, PursuitSettings, State
from fgloc_datasets.sim.following.results import Followed, write_followed
from fgloc_datasets.sim.physics import Scene, Simulation, make_scene
from fgloc_datasets.sim.record import RUN_FILES, robot_settings, write_beside
from fgloc_datasets.sim.scenario import Scenario
from fgloc_datasets.sim.sensors import Sees, stamp_ns, streams

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
    """What the camera sends: corners of markers, or images."""
    return "corners" if corners else "images"


@dataclass(frozen=True, slots=True)
class Drive:
    """What is to be driven.

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
            from tempfile import TemporaryDirectory

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
        loop = ClosedLoop(Written(channels), arrivals, sensors, source, pursuit, scene.scenario.control.rest_s)
        log = simulation.run(loop)
    true = np.column_stack([log.positions, log.quaternions])[: log.ticks]
    return Followed.of(curve, true, np.array(loop.rows), tuple(loop.states))


class Written:
    """Writes messages in the order of receipt, as time goes by."""

    def __init__(self, channels: Sequence[Iterator[Message]]) -> None:
        """Take the channels of a run."""
        self._messages = heapq.merge(*channels, key=itemgetter(0))
        self._next = next(self._messages, None)

    def until(self, now_ns: int) -> None:
        """All that has been received by now."""
        while self._next is not None and self._next[0] <= now_ns:
            self._next[1]()
            self._next = next(self._messages, None)


class Arrivals:
    """Messages on their way to the estimator."""

    def __init__(self, config: Config) -> None:
        """Nothing is on its way."""
        self._config = config.recording
        self._queue: list[tuple[int, int, Event]] = []
        self._order = count()

    def take(self, topic: str, message_type: str, content: Any, received_ns: int) -> None:
        """A message that was written to the bag."""
        role = ROLES.get(topic)
        if role is None and not topic.startswith("/tf"):
            return
        for event in events_of(content, message_type, role, received_ns, topic, self._config):
            if isinstance(event, ImageEvent | CornersEvent):
                event = replace(event, received_ns=received_ns + round(1e9 * PROCESSING_S))
            heapq.heappush(self._queue, (event.received_ns, next(self._order), event))

    def until(self, now_ns: int) -> Iterator[Event]:
        """What has arrived by now, in order."""
        while self._queue and self._queue[0][0] <= now_ns:
            yield heapq.heappop(self._queue)[2]


class ClosedLoop:
    """A `Controller`: at each command it takes what has arrived, asks for the pose, and asks the follower.

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
        rest_s: float,
    ) -> None:
        """Connect the parts; the robot stands for ``rest_s`` at first."""
        self._written, self._arrivals, self._sensors = written, arrivals, sensors
        self._source, self._pursuit, self._rest_s = source, pursuit, rest_s
        self._arrived_s: float | None = None
        self.rows: list[tuple[float, ...]] = []
        self.states: list[State] = []

    def command(self, t: float, pose: tuple[float, float, float]) -> Command | None:
        """The follower's command for what is known now; None some time after it has arrived."""
        now_ns = stamp_ns(t)
        self._written.until(now_ns)
        for event in self._sensors.after(self._arrivals.until(now_ns), now_ns):
            self._source.push(event)
        known, sigma = self._source.pose(now_ns, np.array(pose))
        resting = t < self._rest_s
        v, omega = (0.0, 0.0) if resting else self._pursuit.command(t, known, sigma)
        shown: FloatArray = np.full(3, np.nan) if known is None else known
        self.rows.append((t, *shown.tolist(), sigma, v, omega))
        self.states.append(State.STOPPED if resting else self._pursuit.state)
        if self._pursuit.state is State.ARRIVED:
            self._arrived_s = t if self._arrived_s is None else self._arrived_s
            if t - self._arrived_s >= _RESTS_S:
                return None
        return v, omega
