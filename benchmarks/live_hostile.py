"""Impossible messages on every input topic of a live run, and inputs that stop: `python -m benchmarks.live_hostile`.

A robot drives in a circle among beacons (`benchmarks.live`). Between its own messages others come on every
topic, by the same publisher: invalid text, ±1e300, infinities and NaN, empty and huge arrays, frames of ever new names,
stamps of the future, of the past and of none. They are decoded as those of the wire.

- ``live.hostile``: messages that were pushed; the run goes on to its end.
- ``live.hostile_crashes``: runs that ended, and messages that raised anything in `Live`.
- ``live.hostile_wrong``: poses more than 0.1 m off, and by more than 5 sigma.
- ``live.hostile_mb``: resident memory gained after the first tenth.
- ``live.stale_s``: from the last message of any motion source until the status says so.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from benchmarks.common import Row, main
from benchmarks.live import START_NS, circle, circle_config, circle_map, circle_truth, resident_mb
from fgloc.config import Role, TopicsConfig
from fgloc.live import Live
from fgloc.recording.messages import Messages
from fgloc.recording.reader import MessageEvents
from fgloc.sensors.base import with_values
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.types import Estimate, Event

_MANY = 100_000  # hostile messages on each topic
_SECONDS = 120.0  # of the drive
_AT_ONCE = 500  # messages between two waits
_WRONG_M, _WRONG_SIGMAS = 0.1, 5.0
_LONG = 3000  # elements of a huge array, and characters of a huge text ...
_VERY_LONG, _VERY_LONG_SHARE = 300_000, 0.002  # ... and of a few
_STALE_S = 5.0  # that is waited for at most

TOPICS: dict[str, tuple[str, Role | None]] = {
    "/odom": ("nav_msgs/msg/Odometry", "odometry"),
    "/imu": ("sensor_msgs/msg/Imu", "imu"),
    "/joint_states": ("sensor_msgs/msg/JointState", "joints"),
    "/cmd_vel": ("geometry_msgs/msg/Twist", "command"),
    "/tags": ("apriltag_msgs/msg/AprilTagDetectionArray", "sightings"),
    "/image": ("sensor_msgs/msg/Image", "image"),
    "/image/compressed": ("sensor_msgs/msg/CompressedImage", "image"),
    "/camera_info": ("sensor_msgs/msg/CameraInfo", "camera_info"),
    "/tf": ("tf2_msgs/msg/TFMessage", None),
    "/tf_static": ("tf2_msgs/msg/TFMessage", None),
}
_USED: dict[str, str] = {"odometry": "/odom", "imu": "/imu", "sightings": "/landmarks"}
_WILD = (math.nan, 1e300, -1e300, math.inf, -math.inf, 0.0)
_STAMPS_S = (3600.0, 1e9, 0.9, -3600.0, -0.9)  # from now


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    yield from hostile(500 if quick else _MANY, 20.0 if quick else _SECONDS)
    yield stale()


# --- Messages that no sensor sends ------------------------------------------------------------------------------------


class Hostile:
    """Makes hostile messages of every topic, in turn, as events.

    Attributes:
        undecodable: messages that are refused before they are events, by topic.
    """

    def __init__(self, seed: int = 0) -> None:
        """Draw by this seed."""
        self._rng = np.random.default_rng(seed)
        self._messages = Messages()
        self._config = circle_config().recording
        self._number = 0
        self.undecodable: Counter[str] = Counter()
        self._last: dict[str, Event] = {}  # of the robot's own, by topic

    def own(self, event: Event) -> None:
        """Store a message of the robot's, which some of the hostile ones are made from."""
        self._last[event.topic] = event

    def events(self, topic: str, now_ns: int) -> list[Event]:
        """Events of the next hostile message on a topic."""
        self._number += 1
        last = self._last.get(topic)
        if last is not None and self._rng.random() < 0.2:
            return [self._misplaced(last, now_ns)]
        if topic not in TOPICS:
            return [] if last is None else [self._wild_sightings(last, now_ns)]
        kind, role = TOPICS[topic]
        try:
            content = self._messages.decode(kind, self._cdr(kind, now_ns))
            self._spoil(content)
            return MessageEvents(self._config).of(content, kind, role, now_ns, topic)
        except Exception:  # as the wire's intake has it: damaged bytes raise anything
            self.undecodable[topic] += 1
            return []

    def _misplaced(self, last: Event, now_ns: int) -> Event:
        """Copy of a sound message, of another frame or with a stamp from elsewhere."""
        names = [f.name for f in fields(last) if f.name in ("frame_id", "child_frame_id")]
        stamp = now_ns + round(float(self._rng.choice(_STAMPS_S)) * 1e9)
        if self._rng.random() < 0.5:
            return replace(last, received_ns=now_ns, stamp_ns=stamp)
        return replace(last, received_ns=now_ns, stamp_ns=stamp, **{name: self._name() for name in names})

    def _wild_sightings(self, last: Event, now_ns: int) -> Event:
        """Copy of sightings with values and ids that none has."""
        assert isinstance(last, RangeBearingEvent)
        wild = [
            replace(
                one,
                landmark_id=int(self._rng.choice([one.landmark_id, -1, 2**40, 12345])),
                range_m=float(self._rng.choice(_WILD)),
                bearing_rad=float(self._rng.choice(_WILD)),
            )
            for one in last.sightings
        ]
        return replace(
            last, received_ns=now_ns, stamp_ns=now_ns, sightings=tuple(wild) * int(self._rng.integers(0, 30))
        )

    def _cdr(self, kind: str, now_ns: int) -> bytes:
        """A message of zeros, stamped now, with text in all strings that is sometimes no text."""
        header = {"stamp": {"sec": now_ns // 10**9, "nanosec": now_ns % 10**9}, "frame_id": "frame"}
        values: dict[str, Any] = {"header": header}
        if kind.startswith("tf2"):
            values = {
                "transforms": [{"header": header, "child_frame_id": self._name()}] * int(self._rng.integers(1, 4))
            }
        cdr = self._messages.encode(kind, values if "Twist" not in kind else {})
        return cdr.replace(b"frame", b"\xff\xfe\xff\xfe\xff") if self._rng.random() < 0.1 else cdr

    def _spoil(self, content: Any) -> None:
        """Put wild numbers, long arrays, and names that were never there into some fields of a message, and inside."""
        for field in fields(content):
            value = getattr(content, field.name)
            if is_dataclass(value):
                self._spoil(value)
            elif isinstance(value, list):
                self._spoil_list(value)
            elif self._rng.random() < 0.3:
                setattr(content, field.name, self._spoilt(value, content, field.name))

    def _spoil_list(self, value: list[Any]) -> None:
        for one in value:
            if is_dataclass(one):
                self._spoil(one)
        if not value or isinstance(value[0], str):
            name = self._name()
            value[:] = [f"{name}{k}" for k in range(self._length())]

    def _spoilt(self, value: Any, content: Any, name: str) -> Any:
        wild = float(self._rng.choice(_WILD))
        if isinstance(value, str):
            return self._name()
        if isinstance(value, float):
            return wild
        if isinstance(value, int) and name not in ("sec", "nanosec"):
            return int(self._rng.choice([0, 1, 2**31 - 1]))
        if isinstance(value, np.ndarray):
            size = self._length() if value.size == 0 else value.size
            filled = np.full(size, wild if value.dtype.kind == "f" else 255, dtype=value.dtype)
            return np.where(self._rng.random(size) < 0.5, filled, np.zeros(size, dtype=value.dtype))
        return value

    def _length(self) -> int:
        if self._rng.random() < _VERY_LONG_SHARE:
            return _VERY_LONG
        return int(self._rng.choice([0, 1, 4, 4, _LONG], p=[0.3, 0.3, 0.19, 0.2, 0.01]))

    def _name(self) -> str:
        length = _LONG if self._rng.random() < 0.01 else 0
        return str(self._rng.choice(["", "map", "base_link", f"name_{self._number}{'x' * length}", "\0", "é" * 20]))


# --- The run ----------------------------------------------------------------------------------------------------------


def hostile(count: int, seconds: float) -> Iterator[Row]:
    """Rows of a drive with so many hostile messages on each topic."""
    source, own = Hostile(), list(circle(seconds))
    topics = [*TOPICS, "/landmarks"]
    made: list[Estimate] = []
    crashes = pushed = 0
    memory_mb = [0.0]
    each = count * len(topics) / len(own)
    config = with_values(
        circle_config(), "recording", {"topics": TopicsConfig(**_USED)}
    )  # else the first topic of a role is used
    with Live(config, circle_map(), roles=("odometry", "imu", "sightings")) as live:
        live.subscribe(made.append)
        try:
            for k, event in enumerate(own):
                live.push(event)
                source.own(event)
                while pushed < each * k:
                    for one in source.events(topics[pushed % len(topics)], event.received_ns):
                        live.push(one)
                    pushed += 1
                    if pushed % _AT_ONCE == 0:
                        live.wait()
                if k % (len(own) // 10) == 0:
                    live.wait()
                    gc.collect()
                    memory_mb.append(resident_mb())
            live.wait()
        except Exception as error:  # what is looked for
            crashes += 1
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
        status = live.status()
    print(
        f"rejected {sum(status.rejections.values())}, undecodable {sum(source.undecodable.values())}", file=sys.stderr
    )
    away = [e for e in made if _is_wrong(e)]
    yield Row("live.hostile", pushed, n=len(topics))
    yield Row("live.hostile_crashes", crashes)
    yield Row("live.hostile_keyframes", len(made) / (seconds * 5.0), n=len(made))
    yield Row("live.hostile_wrong", len(away), n=len(made))
    yield Row("live.hostile_mb", max(memory_mb[2:], default=0.0) - memory_mb[min(2, len(memory_mb) - 1)], unit="MB")


def _is_wrong(estimate: Estimate) -> bool:
    """Whether the truth is far away, and further than the covariance allows."""
    off = float(np.hypot(*(estimate.pose[:2] - circle_truth(estimate.stamp_ns)[:2])))
    sigma = math.sqrt(float(np.linalg.eigvalsh(estimate.cov[:2, :2])[-1]))
    return off > max(_WRONG_M, _WRONG_SIGMAS * sigma)


def stale() -> Row:
    """Row of the time until a silence of all motion is said."""
    with Live(circle_config(), circle_map(), roles=("odometry", "imu", "sightings")) as live:
        began = time.monotonic()
        for event in circle(4.0):
            time.sleep(max(0.0, (event.stamp_ns - START_NS) * 1e-9 - (time.monotonic() - began)))
            live.push(replace(event, received_ns=time.time_ns(), stamp_ns=time.time_ns()))
        ended = time.monotonic()
        while not live.status().stale and time.monotonic() < ended + _STALE_S:
            time.sleep(0.01)
        return Row("live.stale_s", time.monotonic() - ended, unit="s")


if __name__ == "__main__":
    main(measure, __doc__)
