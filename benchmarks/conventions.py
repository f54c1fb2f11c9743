"""Injected conventions: ``python -m benchmarks.conventions [--quick] [--json FILE]``.

Each convention of each sensor is broken, one at a time, in recordings that agree with the robot.yaml that
``fgloc init`` makes of them, and the engine that all commands share is asked what it finds first.

- ``conventions.named``: share of injected mistakes that the first new finding names by its code, with a figure within
  the tolerance where the mistake has one.
- ``conventions.false``: findings on the recordings as they are, but for notes, remarks and times in a person's hands.
- ``conventions.online_s``: nine tenths of the mistakes that are named, but for those of the truth, are named by a
  running check within so many seconds of motion; ``conventions.online_named``: their share of all.
  ``conventions.online_false``: what a running check names meanwhile of the recordings as they are.

Recordings: two samples of the simulator, and those of other people that the folder ``FGLOC_REAL_DATA`` holds; two of
these have surveyed maps (of text, `benchmarks.field_recordings` makes bags). Where there are images, findings are those
of `fgloc info`, which fits what they show. The half of the mistakes that ``--quick`` has was looked at while
thresholds were chosen; the other was not.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import yaml

from benchmarks.common import DATA, SAMPLES, Row, main
from benchmarks.field_recordings import RECORDINGS as FIELD
from benchmarks.live import mirrored
from fgloc.assembly import assemble
from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config, Role, config_of_file
from fgloc.diagnosis import mistakes as diagnosis
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.signals import SignalCollector
from fgloc.errors import FglocError
from fgloc.recording.reader import Recording
from fgloc.recording.storage import RawMessage, find_beside
from fgloc.sensor_setup import recorded_setup
from fgloc.sensors.maps import write_map
from fgloc.sensors.marker_pose import MarkerPose
from fgloc.sensors.range_bearing import RangeBearing
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import (
    REMARKS,
    ControlEvent,
    Event,
    Finding,
    InertialEvent,
    LandmarkMap,
    Severity,
    SightingsEvent,
    TruthEvent,
)

RECORDINGS = {
    "installed_run": SAMPLES / "installed_run" / "bag",
    "first_run": SAMPLES / "first_run" / "bag",
    "duarte": DATA / "pioneer_aruco" / "duarte.bag",
    "tb3_landmarks": DATA / "turtlebot3" / "rosbag2_2025_11_25-15_11_34",
    "husky": DATA / "robot_localization_bags" / "test1.bag",
    "tb3_imu": DATA / "turtlebot3" / "rosbag2_2025_11_06-17_25_46",
}
_MAPPED = ("turtlebot_aruco", "mrclam6_1")  # text: bags are made of them
_ONLINE_S = 40.0  # of motion: what is not named by then is not named online
Change = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class Mistake:
    """One broken convention.

    Attributes:
        of: class of event that it is in, or the map.
        change: of an event.
        code: of the finding that has to come first.
        value: figure that the finding has to have; None: it has none.
        tolerance: of that figure, as a share (or in seconds for a lag).
        choice: whether it was looked at while thresholds were chosen.
    """

    of: type[Event] | type[LandmarkMap]
    change: Change
    code: str
    value: float | None = None
    tolerance: float = 0.1
    choice: bool = True


def _sightings(change: Change) -> Change:
    return lambda event: replace(event, sightings=tuple(change(s) for s in event.sightings))


def _late(seconds: float) -> Change:
    return lambda event: replace(event, stamp_ns=event.stamp_ns + round(seconds * 1e9))


def _mirrored(s: Any) -> Any:
    if isinstance(s, RangeBearing):
        return replace(s, bearing_rad=-s.bearing_rad)
    return replace(s, position=s.position * [-1.0, 1.0, 1.0])  # optical: x to the left


def _scaled(factor: float) -> Change:
    def change(s: Any) -> Any:
        if isinstance(s, RangeBearing):
            return replace(s, range_m=s.range_m / factor)
        return replace(s, position=s.position / factor)

    return _sightings(change)


def _axes(s: Any) -> Any:
    """Optical axes instead of body axes, and back."""
    if not isinstance(s, MarkerPose):
        return s
    x, y, z = s.position
    return replace(s, position=np.array([z, -x, -y]))


def _imu(M: Any) -> Change:
    R = np.asarray(M, dtype=float)
    return lambda e: replace(e, angular_velocity=R @ e.angular_velocity, linear_acceleration=R @ e.linear_acceleration)


def _in_world(e: OdometryEvent) -> OdometryEvent:
    assert e.odometer is not None
    c, s = math.cos(e.odometer.pose[2]), math.sin(e.odometer.pose[2])
    x, y = e.linear[:2]
    return replace(e, linear=np.array([c * x - s * y, s * x + c * y, 0.0]))


def _ned(e: TruthEvent) -> TruthEvent:
    x, y, z = e.position
    qx, qy, qz, qw = e.orientation
    yaw = 0.5 * math.pi - math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    half = np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)])
    return replace(e, position=np.array([y, x, -z]), orientation=half)


def _turned(angle: float) -> Change:
    s, c = math.sin(0.5 * angle), math.cos(0.5 * angle)

    def change(e: TruthEvent) -> TruthEvent:
        x, y, z, w = e.orientation
        return replace(e, orientation=np.array([x * c + y * s, y * c - x * s, z * c + w * s, w * c - z * s]))

    return change


def _joints(factor: float) -> Change:
    return lambda e: replace(e, position=factor * e.position, velocity=factor * e.velocity)


def _map(change: Callable[[int, Any], tuple[int, Any]]) -> Change:
    """A change of a map's landmarks by their ids and positions."""

    def changed(landmark_map: LandmarkMap) -> LandmarkMap:
        moved = (change(i, m.position) for i, m in landmark_map.landmarks.items())
        every = zip(moved, landmark_map.landmarks.values(), strict=True)
        return replace(
            landmark_map, landmarks={i: replace(m, landmark_id=i, position=place) for (i, place), m in every}
        )

    return changed


_CLOCKS = "clock.imu|clock.odometry|clock.joints|clock.sightings"  # of two, either may be wrong
_COMMANDS = "wheels.scale|sightings.scale|commands.unit"  # the first two where commands stand in for wheels
MISTAKES: dict[str, Mistake] = {
    "sightings mirrored": Mistake(SightingsEvent, _sightings(_mirrored), "sightings.mirrored|sightings.axes"),
    "sightings axes": Mistake(SightingsEvent, _sightings(_axes), "sightings.axes", choice=False),
    "ranges in feet": Mistake(SightingsEvent, _scaled(0.3048), "sightings.scale", 0.3048),
    "ranges x 0.3048": Mistake(SightingsEvent, _scaled(3.2808), "sightings.scale", 3.2808, choice=False),
    "ranges in cm": Mistake(SightingsEvent, _scaled(0.01), "sightings.scale", 0.01, choice=False),
    "ranges in km": Mistake(SightingsEvent, _scaled(1000.0), "sightings.scale", 1000.0, choice=False),
    "sightings 0.1 s late": Mistake(SightingsEvent, _late(0.1), "clock.sightings", 0.1, 0.05),
    "sightings 0.4 s late": Mistake(SightingsEvent, _late(0.4), "clock.sightings", 0.4, 0.05, choice=False),
    "sightings 1 s late": Mistake(SightingsEvent, _late(1.0), "clock.sightings", 1.0, 0.05, choice=False),
    "IMU z flipped": Mistake(InertialEvent, _imu(np.diag([1, 1, -1])), "imu.axes|imu.gravity"),
    "IMU x and z exchanged": Mistake(InertialEvent, _imu([[0, 0, 1], [0, 1, 0], [1, 0, 0]]), "imu.axes|imu.gravity"),
    "IMU negated": Mistake(InertialEvent, _imu(-np.eye(3)), "imu.axes|imu.gravity", choice=False),
    "IMU in degrees": Mistake(
        InertialEvent,
        lambda e: replace(e, angular_velocity=np.degrees(e.angular_velocity)),
        "imu.unit",
        math.pi / 180.0,
        0.2,
    ),
    "IMU 0.1 s late": Mistake(InertialEvent, _late(0.1), "clock.imu|clock.odometry|clock.joints", 0.1, 0.05),
    "IMU 0.7 s late": Mistake(
        InertialEvent, _late(0.7), "clock.imu|clock.odometry|clock.joints", 0.7, 0.05, choice=False
    ),
    "speeds in mm/s": Mistake(
        OdometryEvent, lambda e: replace(e, linear=1e3 * e.linear), "odometry.twist_unit", 1e-3, 0.05
    ),
    "yaw rate in degrees": Mistake(
        OdometryEvent, lambda e: replace(e, angular=np.degrees(e.angular)), "odometry.yaw_unit", choice=False
    ),
    "yaw rate negated": Mistake(OdometryEvent, lambda e: replace(e, angular=-e.angular), "odometry.yaw_sign"),
    "twist in the world": Mistake(OdometryEvent, _in_world, "odometry.twist_frame", choice=False),
    "odometry 0.3 s late": Mistake(OdometryEvent, _late(0.3), _CLOCKS, 0.3, 0.05),
    "joints 0.3 s late": Mistake(JointsEvent, _late(0.3), _CLOCKS, 0.3, 0.05, choice=False),
    "joints reversed": Mistake(JointsEvent, _joints(-1.0), "yaw.sign|wheels.sign|wheels.reversed"),
    "joints in degrees": Mistake(JointsEvent, _joints(180.0 / math.pi), "wheels.unit|odometry.yaw_unit", choice=False),
    "commands in mm/s": Mistake(ControlEvent, lambda e: replace(e, v=1e3 * e.v), _COMMANDS, 1e3, 0.15, choice=False),
    "commands in feet/s": Mistake(ControlEvent, lambda e: replace(e, v=e.v / 0.3048), _COMMANDS, 0.3048, 0.15),
    "map in feet": Mistake(LandmarkMap, _map(lambda i, p: (i, p / 0.3048)), "map.unit", 0.3048),
    "map x 0.3048": Mistake(LandmarkMap, _map(lambda i, p: (i, p * 0.3048)), "map.unit", 0.3048, choice=False),
    "map in cm": Mistake(LandmarkMap, _map(lambda i, p: (i, p * 100.0)), "map.unit", 0.01, choice=False),
    "map in km": Mistake(LandmarkMap, _map(lambda i, p: (i, p * 0.001)), "map.unit", 1e3),
    "map mirrored": Mistake(LandmarkMap, mirrored, "map.mirrored"),
    "ids off by one": Mistake(LandmarkMap, _map(lambda i, p: (i + 1, p)), "map.ids", choice=False),
    "truth in NED": Mistake(TruthEvent, _ned, "truth.axes"),
    "truth 0.5 s late": Mistake(TruthEvent, _late(0.5), "clock.truth", 0.5, 0.05),
    "truth in mm": Mistake(
        TruthEvent, lambda e: replace(e, position=1e3 * e.position), "truth.scale", 1e3, 0.1, choice=False
    ),
    "truth turned": Mistake(TruthEvent, _turned(0.5), "truth.mounting", 0.5, 0.15, choice=False),
}


@dataclass(frozen=True, slots=True)
class Heard:
    """A recording, decoded once: its events but for images, in order, and the sensors as they are configured."""

    bag: Path
    map_path: Path | None
    config: Config
    events: Sequence[Event]
    roles: dict[Any, str]
    T_base_sensor: Any = None
    imu_up: Any = None
    landmark_map: LandmarkMap | None = None
    R: Any = None  # of the IMU in the base

    def has(self, kind: type) -> bool:
        """Whether there is anything of a class that the engine reads."""
        return self.landmark_map is not None if kind is LandmarkMap else any(isinstance(e, kind) for e in self.events)

    def broken(self, mistake: Mistake | None) -> Iterator[Event]:
        """Events with one convention broken; an IMU on its side has the robot's axes broken, not its own."""
        for event in self.events:
            if mistake is not None and isinstance(event, mistake.of):
                event = _turned_imu(self.R.T, mistake.change(_turned_imu(self.R, event)))
            yield event


def heard(bag: Path, config: Config) -> Heard:
    """Decode a recording."""
    map_path = find_beside(bag, "map.yaml")
    with Recording(bag, config.recording) as recording:
        found = Heard(bag, map_path, config, [], dict(recording.roles), R=np.eye(3))
        try:
            setup = recorded_setup(recording, map_path, config)
            R = np.eye(3) if setup.T_base_imu is None else setup.T_base_imu[:3, :3]
            found = replace(
                found, T_base_sensor=setup.T_base_sensor, imu_up=setup.imu_up, landmark_map=setup.landmark_map, R=R
            )
        except FglocError:
            pass
        role_of = {topic: role for role, topic in recording.roles.items() if role not in ("image", "camera_info")}
        return replace(
            found,
            events=[e for m in recording.messages(role_of.keys()) for e in recording.decode(m, role_of[m[0]])],
        )


class _Broken(Recording):
    """A recording with one convention broken in what is decoded."""

    mistake: Mistake | None = None

    def decode(self, message: RawMessage, role: Role | None) -> list[Event]:
        """Events of a message, as the mistake has them."""
        made, events = self.mistake, super().decode(message, role)
        return [made.change(event) if made is not None and isinstance(event, made.of) else event for event in events]


def found_in(recording: Heard, mistake: Mistake | None) -> tuple[Finding, ...]:
    """Findings on a recording with one convention broken; none broken: as it is."""
    if any(role == "image" for role in recording.roles):
        return _found_by_info(recording, mistake)
    collector, landmark_map = SignalCollector(recording.config, recording.roles), recording.landmark_map
    for event in recording.broken(mistake):
        collector.add(event)
    if mistake is not None and mistake.of is LandmarkMap:
        landmark_map = mistake.change(landmark_map)
    found = conventions(collector.found, recording.config, recording.T_base_sensor, recording.imu_up, landmark_map)
    return tuple(sorted(found.findings, key=lambda f: -f.severity))


def _found_by_info(recording: Heard, mistake: Mistake | None) -> tuple[Finding, ...]:
    """Findings of `fgloc info` where images tell too: the same comparisons, then fits of what the images show."""
    opened = type("Opened", (_Broken,), {"mistake": mistake})
    with tempfile.TemporaryDirectory() as folder, ExitStack() as patches:
        patches.enter_context(mock.patch.object(diagnosis, "Recording", opened))
        patches.enter_context(mock.patch.object(diagnosis, "open_recording", opened))
        map_path = recording.map_path
        if recording.landmark_map is not None and mistake is not None and mistake.of is LandmarkMap:
            map_path = Path(folder) / "map.yaml"
            write_map(mistake.change(recording.landmark_map), map_path)
        return diagnosis.inspect_all(recording.bag, map_path, recording.config).found


def _turned_imu(R: Any, event: Event) -> Event:
    return _imu(R)(event) if isinstance(event, InertialEvent) else event


def named_online(heard: Heard, mistake: Mistake | None) -> Iterator[tuple[float, tuple[Finding, ...]]]:
    """Seconds of motion and what a running check of a live run finds then, whenever it compares."""
    with Recording(heard.bag, heard.config.recording) as recording:
        parts = assemble(recording, heard.map_path, heard.config, keep_all=False)
    moving_s = 0.0
    for event in heard.broken(mistake):
        if isinstance(event, TruthEvent):
            continue
        parts.diagnosis.add(event)
        passed = parts.gate.check(event)
        for step in () if passed is None else parts.stepper.push(passed):
            measured = parts.wheels.measure(step)
            motion = np.zeros(3) if measured is None else measured.motion
            parts.diagnosis.observe(step, motion=motion)
            if math.hypot(motion[0], motion[1]) > 0.01 * step.dt or abs(motion[2]) > 0.02 * step.dt:
                moving_s += step.dt
        comparison = parts.diagnosis.comparison()
        if comparison is not None:
            comparison()
            yield moving_s, parts.diagnosis.found
        if moving_s > _ONLINE_S:
            return


def named(mistake: Mistake, found: tuple[Finding, ...]) -> bool:
    """Whether the first finding is that of the mistake, with its figure."""
    if not found or found[0].code not in mistake.code.split("|"):
        return False
    value = found[0].value
    if mistake.value is None:
        return True
    if value is None:
        return False
    if found[0].code.startswith("clock."):
        return abs(abs(value) - mistake.value) < max(mistake.tolerance, 3.0 * (found[0].sigma or 0.0))
    return min(abs(math.log(abs(value) / mistake.value)), abs(math.log(abs(value) * mistake.value))) < mistake.tolerance


def bags() -> Iterator[tuple[str, Path]]:
    """Name and bag of each recording that is there."""
    yield from ((name, bag) for name, bag in RECORDINGS.items() if bag.exists())
    with tempfile.TemporaryDirectory() as folder:
        for one in FIELD:
            if one.name in _MAPPED and (DATA / one.source).exists():
                (Path(folder) / one.name).mkdir()
                yield one.name, one.bag(Path(folder) / one.name)


def measure(quick: bool) -> Iterator[Row]:
    """A row for each recording, and the totals; a quick run has the mistakes that thresholds were chosen on."""
    total, hits, false, recordings = 0, 0, 0, 0
    online: list[float] = []
    online_false = 0
    for name, bag in bags():
        recordings += 1
        recording = heard(bag, config_of_file(yaml.safe_load(first_settings(bag).text)))
        sound = found_in(recording, None)
        if sound:
            print(f"  {name} as it is: {[(f.code, f.value) for f in sound]}")
        grave = (f for f in sound if f.severity is not Severity.NOTE and f.code not in REMARKS)
        wrong = sum(not f.code.startswith("motion.") for f in grave)  # held and lifted it was
        false += wrong
        early = {f.code for _, found in named_online(recording, None) for f in found if f.severity is Severity.ERROR}
        early -= {f.code for f in sound}
        if early:
            print(f"  {name} as it is, online: {sorted(early)}")
        online_false += len(early)
        count = right = 0
        for what, mistake in MISTAKES.items():
            if (quick and not mistake.choice) or not recording.has(mistake.of):
                continue
            if what == "sightings axes" and name != "duarte":
                continue  # ranges and bearings have no axes
            known = {f.code for f in sound}  # what is true of the recording itself
            found = tuple(f for f in found_in(recording, mistake) if f.code not in known)
            ok = named(mistake, found)
            count, right = count + 1, right + ok
            if not ok:
                print(f"  {name}: {what}: {[(f.code, f.value) for f in found[:2]]}")
            if mistake.of not in (TruthEvent, LandmarkMap):
                codes = set(mistake.code.split("|"))
                running = named_online(recording, mistake)
                at_s = next((s for s, by_then in running if codes & {f.code for f in by_then}), math.inf)
                online.append(at_s)
                if at_s > 20.0:
                    print(f"  {name}: {what}: online after {at_s:.0f} s of motion")
        total, hits = total + count, hits + right
        yield Row(f"conventions.named.{name}", right / max(count, 1), n=count, unit="share")
        yield Row(f"conventions.false.{name}", wrong, n=1, unit="findings")
    yield Row("conventions.named", hits / max(total, 1), n=total, unit="share")
    yield Row("conventions.false", false, n=recordings, unit="findings")
    in_time = sorted(s for s in online if math.isfinite(s))
    worst = float(np.quantile(in_time, 0.9)) if in_time else None
    yield Row("conventions.online_s", worst, n=len(in_time), unit="s", reason="" if in_time else "nothing was named")
    yield Row("conventions.online_named", len(in_time) / max(len(online), 1), n=len(online), unit="share")
    yield Row("conventions.online_false", online_false, n=recordings, unit="findings")


if __name__ == "__main__":
    main(measure, __doc__ or "")
