"""Events as a robot would send them; times in seconds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from fgloc.config import GateConfig, KeyframesConfig
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.marker_pose import MarkerPose, MarkerPosesEvent
from fgloc.sensors.markers.images import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Event, Step

SQUARE = np.array([[100.0, 100.0], [150.0, 100.0], [150.0, 150.0], [100.0, 150.0]])
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def odometry(t, pose=(0.0, 0.0, 0.0), twist=(0.0, 0.0), received=None, topic="/odom", **changes) -> OdometryEvent:
    x, y, yaw = pose
    fields = dict(
        stamp_ns=ns(t),
        received_ns=ns(t if received is None else received),
        topic=topic,
        frame_id="odom",
        child_frame_id="base_link",
        position=np.array([x, y, 0.0]),
        orientation=np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]),
        pose_cov=np.eye(6) * 0.01,
        linear=np.array([twist[0], 0.0, 0.0]),
        angular=np.array([0.0, 0.0, twist[-1]]),
        twist_cov=np.eye(6) * 0.01,
    )
    return OdometryEvent(**(fields | changes))


def command(t, v=0.0, omega=0.0, received=None, topic="/cmd_vel") -> ControlEvent:
    return ControlEvent(ns(t), ns(t if received is None else received), topic, v, omega)


def joints(t, left, right, names=("left_wheel_joint", "right_wheel_joint"), rates=(), topic="/joints") -> JointsEvent:
    position = np.array([left, right], dtype=float) if left is not None else np.empty(0)
    return JointsEvent(ns(t), ns(t), topic, tuple(names), position, np.array(rates, dtype=float), np.empty(0))


def imu(t, omega=0.0, cov=None, topic="/imu") -> ImuEvent:
    cov = np.eye(3) * 1e-4 if cov is None else cov
    return ImuEvent(ns(t), ns(t), topic, "imu", np.array([0.0, 0.0, omega]), np.array([0.0, 0.0, 9.81]), cov)


def corners(t, *ids, received=None, topic="/tags", at=SQUARE) -> CornersEvent:
    sightings = tuple(MarkerCorners(i, at) for i in (ids or (0,)))
    return CornersEvent(ns(t), ns(t if received is None else received), topic, "cam", sightings)


def range_bearing(t, *sightings, received=None, topic="/landmarks") -> RangeBearingEvent:
    made = tuple(RangeBearing(*s) for s in (sightings or ((0, 1.0, 0.0),)))
    return RangeBearingEvent(ns(t), ns(t if received is None else received), topic, "base_link", made)


def marker_pose(t, marker_id=0, position=(1.0, 0.0, 0.0), quaternion=UPRIGHT, cov=None) -> MarkerPosesEvent:
    cov = np.eye(6) * 0.01 if cov is None else cov
    sighting = MarkerPose(marker_id, np.array(position), np.asarray(quaternion), cov)
    return MarkerPosesEvent(ns(t), ns(t), "/markers", "cam", (sighting,))


def image(t, data: bytes = b"\xff\xd8", compressed=True, width=0, height=0, step=0) -> ImageEvent:
    array = np.frombuffer(data, dtype=np.uint8)
    encoding = "jpeg" if compressed else "mono8"
    return ImageEvent(ns(t), ns(t), "/image", "cam", encoding, compressed, width, height, step, False, array)


def stepper(lag_s: float = 10.0, gate: GateConfig | None = None, **keyframes) -> KeyframeBuilder:
    return KeyframeBuilder(KeyframesConfig(**keyframes), gate or GateConfig(), lag_s)


def in_order_of_receipt(*streams: Iterable[Event]) -> list[Event]:
    return sorted((e for stream in streams for e in stream), key=lambda e: e.received_ns)


def run(target: KeyframeBuilder, events: Iterable[Event]) -> list[Step]:
    """All steps of a recording."""
    return [step for event in events for step in target.push(event)] + target.flush()


def times(start: float, end: float, rate: float) -> Sequence[float]:
    return [start + k / rate for k in range(round((end - start) * rate))]


def check_steps(steps: Sequence[Step], min_interval_s: float = 0.05, max_interval_s: float = 1.0) -> None:
    """What holds for steps whatever was heard."""
    for k, step in enumerate(steps):
        assert step.index == k
        first = k == 0 or step.segment != steps[k - 1].segment
        if first:
            assert step.start_ns == step.stamp_ns
        else:
            assert step.start_ns == steps[k - 1].stamp_ns
            assert ns(min_interval_s) <= step.stamp_ns - step.start_ns <= ns(max_interval_s)
        for kind in (*step.motion.values(), step.sightings):
            stamps = [e.stamp_ns for e in kind]
            assert stamps == sorted(stamps)
        assert all(e.stamp_ns <= step.stamp_ns for e in step.sightings)
