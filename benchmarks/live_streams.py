"""Streams for `benchmarks.live`: recordings as installed, what disturbs them, and a circle without end."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from benchmarks.recordings import Recorded
from fgloc import se2
from fgloc.config import Config, config_of
from fgloc.frames import yaw_quaternion
from fgloc.live import Live
from fgloc.live.run import role_of
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Event, FloatArray, Landmark, LandmarkMap

START_NS = 1_700_000_000_000_000_000
_FED_AT_ONCE = 500  # events, between waits: a replay is faster than the estimator
_DROPPED, _TWICE, _DELAYED = 0.02, 0.02, 0.05  # shares of messages
_DELAY_S = 0.08  # up to so much, so that messages overtake one another
_CAMERA_LATE_S = 0.3
_STALLS = ((20.0, 21.5), (55.0, 55.8))  # s: nothing arrives, then all at once
_RESTART_S = 40.0  # the wheels' publisher restarts ...
_RESTART_OFF_S = 0.6  # ... and is away for this long; its clock then begins at 0

Role = str


def truth_of(recorded: Recorded) -> Callable[[int], FloatArray]:
    """True pose ``(3,)`` by stamp [ns]; NaN outside of the recording."""
    stamps = recorded.start_ns + np.round(recorded.truth[:, 0] * 1e9).astype(np.int64)
    poses = recorded.truth[:, 1:4]

    def at(stamp_ns: int) -> FloatArray:
        if not stamps[0] <= stamp_ns <= stamps[-1]:
            return np.full(3, np.nan)
        return se2.interpolate(stamps, poses, np.array([stamp_ns]))[0]

    return at


def roles_of(events: Iterable[Event]) -> set[Role]:
    """Roles that the events play."""
    return {role for role in map(role_of, events) if role is not None}


def feed(live: Live, events: Iterable[Event]) -> None:
    """Push events as fast as they are used."""
    for k, event in enumerate(events):
        live.push(event)
        if k % _FED_AT_ONCE == 0:
            live.wait()
    live.wait()


# --- Disorder ---------------------------------------------------------------------------------------------------------


def disordered(events: Iterable[Event], start_ns: int, rng: np.random.Generator) -> list[Event]:
    """All that goes wrong on the way, at once, in the new order of receipt.

    Messages are lost, doubled and delayed so that they overtake one another; the camera is 300 ms late; the network
    stalls and then delivers all at once; the publisher of the joints and the odometry restarts with its clock at zero;
    a second publisher of the joints tells of an arm.
    """
    out: list[Event] = []
    for event in events:
        at_s = (event.received_ns - start_ns) * 1e-9
        wheels = isinstance(event, JointsEvent | OdometryEvent)
        if rng.random() < _DROPPED or (wheels and _RESTART_S <= at_s < _RESTART_S + _RESTART_OFF_S):
            continue
        if wheels and at_s >= _RESTART_S:
            event = dataclasses.replace(event, stamp_ns=event.stamp_ns - start_ns - round(_RESTART_S * 1e9))
        late_s = _CAMERA_LATE_S if isinstance(event, CornersEvent) else 0.0
        late_s += float(rng.uniform(0.0, _DELAY_S)) if rng.random() < _DELAYED else 0.0
        arrives = _after_stalls(at_s + late_s)
        out.append(_received(event, start_ns, arrives))
        if rng.random() < _TWICE:
            out.append(_received(event, start_ns, arrives + 0.001))
        if isinstance(event, JointsEvent):
            stamp = event.received_ns + 1
            arm = JointsEvent(stamp, stamp, event.topic, ("arm_joint",), np.zeros(1), np.zeros(1), np.zeros(1))
            out.append(_received(arm, start_ns, arrives + 0.002))
    return sorted(out, key=lambda e: e.received_ns)


def _after_stalls(at_s: float) -> float:
    return next((end for start, end in _STALLS if start <= at_s < end), at_s)


def _received(event: Event, start_ns: int, at_s: float) -> Event:
    return dataclasses.replace(event, received_ns=start_ns + round(at_s * 1e9))


# --- Sightings that are wrong -----------------------------------------------------------------------------------------


def wrong_ids(events: Iterable[Event], ids: Iterable[int], rng: np.random.Generator) -> Iterator[Event]:
    """The events with every marker read as another one of the map."""
    known = np.array(sorted(ids))
    for event in events:
        if isinstance(event, CornersEvent):
            seen = [
                MarkerCorners(int(rng.choice(known[known != s.landmark_id])), s.corners_px) for s in event.sightings
            ]
            event = dataclasses.replace(event, sightings=tuple(seen))
        yield event


def mirrored(landmark_map: LandmarkMap) -> LandmarkMap:
    """The map as it is seen from below."""
    flip = np.diag([1.0, -1.0, 1.0])
    landmarks = {
        i: dataclasses.replace(m, position=flip @ m.position, rotation=flip @ m.rotation @ np.diag([-1.0, 1.0, 1.0]))
        for i, m in landmark_map.landmarks.items()
    }
    return dataclasses.replace(landmark_map, landmarks=landmarks)


# --- A circle without end ---------------------------------------------------------------------------------------------

PERIOD_S, RADIUS_M = 20.0, 1.2
_ODOMETRY_HZ, SIGHTINGS_HZ = 10, 5
_SIGMA_RANGE, _SIGMA_BEARING = 0.06, 0.015


def circle_config() -> Config:
    """Settings that fit the noise of `circle`."""
    return config_of(
        {
            "wheels": {"source": "twist"},
            "landmarks": {"range_sigma_m": _SIGMA_RANGE, "bearing_sigma_rad": _SIGMA_BEARING},
        }
    )


def circle_map() -> LandmarkMap:
    """Seven beacons around the circle."""
    angles = np.linspace(0.0, 2.0 * math.pi, 7, endpoint=False)
    places = [3.0 * np.array([math.cos(a + 0.1 * a * a), math.sin(a + 0.1 * a * a), 0.0]) for a in angles]
    return LandmarkMap({i: Landmark(i, p, np.eye(3), 0.0) for i, p in enumerate(places)})


def circle_truth(stamp_ns: int) -> FloatArray:
    """True pose ``(3,)`` of the robot on the circle."""
    angle = 2.0 * math.pi * ((stamp_ns - START_NS) * 1e-9 % PERIOD_S) / PERIOD_S
    return np.array([RADIUS_M * math.sin(angle), -RADIUS_M * math.cos(angle), se2.wrap(angle)])


def circle(seconds: float, seed: int = 0) -> Iterator[Event]:
    """Events of a robot that drives in a circle: odometry at 10 Hz, an IMU at 20 Hz, two beacons seen at 5 Hz."""
    rng = np.random.default_rng(seed)
    landmarks = list(circle_map().landmarks.values())
    speed, turn = 2.0 * math.pi * RADIUS_M / PERIOD_S, 2.0 * math.pi / PERIOD_S
    zeros6, zeros3 = np.zeros((6, 6)), np.zeros((3, 3))
    spread = math.sqrt(_ODOMETRY_HZ)
    for tick in range(round(seconds * 20)):
        stamp = START_NS + tick * 50_000_000
        rate = np.array([0.0, 0.0, turn + rng.normal(0.0, 0.005)])
        yield ImuEvent(stamp, stamp, "/imu", "base_link", rate, np.zeros(3), zeros3)
        pose = circle_truth(stamp)
        if tick % 2 == 0:
            linear = np.array([speed + rng.normal(0.0, 0.03 * math.sqrt(speed) * spread), 0.0, 0.0])
            angular = np.array([0.0, 0.0, turn + rng.normal(0.0, 0.03 * math.sqrt(speed) * spread)])
            place = np.array([pose[0], pose[1], 0.0]), yaw_quaternion(float(pose[2])), zeros6
            yield OdometryEvent(stamp, stamp, "/odom", "odom", "base_link", *place, linear, angular, zeros6)
        if tick % (20 // SIGHTINGS_HZ) == 0:
            seen = []
            for k in rng.choice(len(landmarks), 2, replace=False):
                x, y, _ = se2.between(pose, np.array([*landmarks[k].position[:2], 0.0]))
                r, bearing = math.hypot(x, y), math.atan2(y, x)
                r, bearing = r + rng.normal(0.0, _SIGMA_RANGE), bearing + rng.normal(0.0, _SIGMA_BEARING)
                seen.append(RangeBearing(landmarks[k].landmark_id, float(r), float(bearing)))
            yield RangeBearingEvent(stamp, stamp, "/landmarks", "base_link", tuple(seen))
