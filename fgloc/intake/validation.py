"""The gate: every event is validated, repaired or rejected here, before anything is estimated from it."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from fgloc.config import GateConfig
from fgloc.intake.field_checks import PLANAR, Changes, FieldChecks
from fgloc.intake.sighting_validation import EMPTIED, SightingsValidator
from fgloc.sensors.base import Check, Stream
from fgloc.types import (
    CommandEvent,
    CornersEvent,
    Event,
    FloatArray,
    ImageEvent,
    ImuEvent,
    JointsEvent,
    MarkerPosesEvent,
    OdometryEvent,
    RangeBearingEvent,
    SensorEvent,
    TransformEvent,
    TruthEvent,
)

_RECENT = 64  # accepted stamps of a topic that are remembered to find duplicates
_MAX_ANGLE = 1e9  # rad, of a joint
_MAX_ACCELERATION = 1e3  # m/s²
_NO_TWIST = dict(linear=np.full(3, np.nan), angular=np.full(3, np.nan), twist_cov=np.zeros((6, 6)))
_NO_POSE = dict(position=np.full(3, np.nan), orientation=np.full(4, np.nan), pose_cov=np.zeros((6, 6)))


@dataclass(slots=True)
class _Topic:
    """What is remembered of one topic."""

    newest_ns: int
    recent: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT))
    gaps: int = 0
    longest_gap_ns: int = 0
    back: bool = False  # the last stamp was far behind the newest


class EventValidator:
    """Validates events one by one; what it lets through can be computed with.

    An event comes back as it was, or as a repaired copy, or not at all (None). Repairs:

    - A nearly unit quaternion is normalised; a nearly symmetric covariance is made symmetric.
    - A covariance that says nothing (a zero, NaN or absurdly large variance where one is needed) becomes all zeros:
      "use the configured default". The odometry's is judged by x, y, yaw, the others' whole.
    - A part that cannot be used is NaN in the copy and the rest is kept. Odometry: ``position`` and ``orientation``, or
      ``linear`` and ``angular``. Joints: single entries of ``position``, ``velocity``, ``effort``. IMU:
      ``linear_acceleration``. Events without any usable part are rejected whole.
    - Bad entries of sightings are taken out; if none is left the event is rejected. Bearings in [pi, 2 pi] are wrapped.

    ``rejections`` counts what was lost, by "sensor.reason". Sensors: odometry, command, joints, imu, image, sightings,
    truth, transform. Reasons: stamp_zero, duplicate_stamp; non_finite, speed_bound, yaw_rate_bound, range_bound,
    position_bound, quaternion, negative_variance, asymmetric_cov, indefinite_cov (of odometry with ``pose_`` or
    ``twist_`` before them); length, position_non_finite, velocity_non_finite, effort_non_finite, position_bound,
    wheel_rate_bound (joints); unavailable, acceleration (imu); empty, truncated (image); unknown_id,
    corners_degenerate, corners_small, bearing_bound, bearing_unit (sightings).

    Camera information passes unseen: whoever makes a camera of it validates it. Transforms may have stamp 0.
    """

    def __init__(
        self, config: GateConfig, known_ids: Collection[int] | None = None, streams: Iterable[Stream] = ()
    ) -> None:
        """Set up.

        Args:
            config: bounds.
            known_ids: ids of the map; None if no map is given: then every id passes.
            streams: of registered sensors, which bring their own checks.
        """
        self.rejections: Counter[str] = Counter()
        self._config = config
        self._notes: dict[str, None] = {}  # an ordered set
        self._parts = FieldChecks(config, self._note)
        self._sightings = SightingsValidator(config, known_ids, self._parts, self.rejections, self._note)
        self._seen: Counter[str] = Counter()  # events by sensor
        self._topics: dict[str, _Topic] = {}
        self._checks: dict[type, tuple[str, Callable[[Any], Event | str]]] = {
            OdometryEvent: ("odometry", self._odometry),
            CommandEvent: ("command", self._command),
            JointsEvent: ("joints", self._joints),
            ImuEvent: ("imu", self._imu),
            ImageEvent: ("image", self._image),
            TruthEvent: ("truth", self._truth),
            CornersEvent: ("sightings", self._sightings.corners),
            MarkerPosesEvent: ("sightings", self._sightings.marker_poses),
            RangeBearingEvent: ("sightings", self._sightings.range_bearings),
        }
        for stream in streams:
            self._checks[stream.event] = stream.role, partial(_by_stream, stream.check, config)

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know so far, one sentence each; nothing is said twice."""
        notes = [*self._notes, *self._sightings.notes]
        for reason in ("odometry.twist_yaw_rate_bound", "command.yaw_rate_bound", "imu.yaw_rate_bound"):
            bad, seen = self.rejections[reason], self._seen[reason.split(".")[0]]
            if bad >= 10 and bad > 0.1 * seen:
                notes.append(
                    f"{bad} of {seen} yaw rates ({reason}) exceed {self._config.max_yaw_rate:g} rad/s: perhaps degrees "
                    "were given for radians; else raise gate.max_yaw_rate"
                )
        for name, topic in self._topics.items():
            if topic.gaps:
                notes.append(
                    f"{name}: {topic.gaps} silence(s) longer than {self._config.gap_s:g} s, "
                    f"the longest {topic.longest_gap_ns * 1e-9:.1f} s"
                )
        return tuple(notes)

    def check(self, event: Event) -> Event | None:
        """The event, a repaired copy, or None if it was rejected (and counted)."""
        entry = self._checks.get(type(event))
        if entry is None:
            checked = self._transform(event) if isinstance(event, TransformEvent) else event
            if isinstance(checked, str):
                self.rejections[f"transform.{checked}"] += 1
                return None
            return checked
        sensor, check = entry
        self._seen[sensor] += 1
        topic = self._topics.get(event.topic)
        reason = self._stamp(event, topic)
        if not reason:
            checked = check(event)
            if not isinstance(checked, str):
                self._remember(event, topic)
                return checked
            reason = checked
        if reason != EMPTIED:  # its parts are counted already
            self.rejections[f"{sensor}.{reason}"] += 1
        return None

    # --- stamps ---

    def _stamp(self, event: Event, topic: _Topic | None) -> str:
        """Reason to reject the event for its stamp, or ""."""
        stamp = event.stamp_ns
        if stamp <= 0:
            self._note(
                f"{event.topic}: messages with stamp 0 are rejected; if all are, list its role in "
                "recording.received_stamps"
            )
            return "stamp_zero"
        if topic is None or stamp > topic.newest_ns:
            return ""
        if stamp >= topic.newest_ns - self._config.clock_back_s * 1e9:
            return "duplicate_stamp" if stamp in topic.recent else ""
        if topic.back:  # twice running: the clock was set back (a bag loops), its stamps may come again
            topic.recent.clear()
            topic.newest_ns = stamp
        topic.back = not topic.back
        return ""

    def _remember(self, event: Event, topic: _Topic | None) -> None:
        stamp = event.stamp_ns
        if topic is None:
            topic = self._topics[event.topic] = _Topic(stamp)
        elif stamp > topic.newest_ns:
            gap = stamp - topic.newest_ns
            if gap > self._config.gap_s * 1e9:
                topic.gaps += 1
                topic.longest_gap_ns = max(topic.longest_gap_ns, gap)
            topic.newest_ns = stamp
            topic.back = False
        topic.recent.append(stamp)

    # --- one method per kind of event: the event, a repaired copy, or the reason for rejection ---

    def _odometry(self, event: OdometryEvent) -> Event | str:
        config = self._config
        changes: Changes = {}
        vx, vy, vz = event.linear.tolist()
        wx, wy, wz = event.angular.tolist()
        if not math.isfinite(vx + vy + vz + wx + wy + wz):
            twist = "non_finite"
        elif max(abs(vx), abs(vy), abs(vz)) > config.max_speed:
            twist = "speed_bound"
        elif max(abs(wx), abs(wy), abs(wz)) > config.max_yaw_rate:
            twist = "yaw_rate_bound"
        else:
            twist = self._parts.covariance(event.topic, "twist", event.twist_cov, PLANAR, "twist_cov", changes)
        x, y, z = event.position.tolist()
        if not math.isfinite(x + y + z):
            pose = "non_finite"
        elif max(abs(x), abs(y), abs(z)) > config.max_position:
            pose = "position_bound"
        else:
            pose = self._parts.quaternion(event.orientation, "orientation", changes) or self._parts.covariance(
                event.topic, "pose", event.pose_cov, PLANAR, "pose_cov", changes
            )
        if twist:
            self.rejections[f"odometry.twist_{twist}"] += 1
            changes |= _NO_TWIST
        if pose:
            self.rejections[f"odometry.pose_{pose}"] += 1
            changes |= _NO_POSE
        if twist and pose:
            return EMPTIED
        return replace(event, **changes) if changes else event

    def _command(self, event: CommandEvent) -> Event | str:
        if not math.isfinite(event.v + event.omega):
            return "non_finite"
        if abs(event.v) > self._config.max_speed:
            return "speed_bound"
        return "yaw_rate_bound" if abs(event.omega) > self._config.max_yaw_rate else event

    def _joints(self, event: JointsEvent) -> Event | str:
        n = len(event.names)
        changes: Changes = {}
        usable = 0  # angles and rates
        for name, bound, wild in (
            ("position", _MAX_ANGLE, "position_bound"),
            ("velocity", self._config.max_wheel_rate, "wheel_rate_bound"),
            ("effort", math.inf, ""),
        ):
            array: FloatArray = getattr(event, name)
            values: list[float] = array.tolist()
            if n == 0 or len(values) not in (0, n):
                return "length"
            good = [abs(value) <= bound and math.isfinite(value) for value in values]
            if name != "effort":
                usable += sum(good)
            if all(good):
                continue
            if all(math.isnan(value) for value in values):  # a driver's way to say that it has none
                self._note(f"{event.topic}: every {name} is NaN in some messages; taken as not given")
                changes[name] = np.empty(0)
            else:
                finite = all(math.isfinite(value) for value in values)
                self.rejections["joints." + (wild if finite else f"{name}_non_finite")] += 1
                changes[name] = np.where(good, array, np.nan)
        if not usable:
            return "non_finite"
        return replace(event, **changes) if changes else event

    def _imu(self, event: ImuEvent) -> Event | str:
        changes: Changes = {}
        cov = event.angular_velocity_cov
        if cov[0, 0] == -1.0:  # REP 145
            self._note(f"{event.topic}: says that it has no gyroscope (its covariance starts with -1)")
            return "unavailable"
        wx, wy, wz = event.angular_velocity.tolist()
        if not math.isfinite(wx + wy + wz):
            return "non_finite"
        if max(abs(wx), abs(wy), abs(wz)) > self._config.max_yaw_rate:
            return "yaw_rate_bound"
        if reason := self._parts.covariance(
            event.topic, "angular velocity", cov, (0, 1, 2), "angular_velocity_cov", changes
        ):
            return reason
        ax, ay, az = event.linear_acceleration.tolist()
        if not abs(ax) + abs(ay) + abs(az) <= _MAX_ACCELERATION:  # also NaN
            self.rejections["imu.acceleration"] += 1
            changes["linear_acceleration"] = np.full(3, np.nan)
        return replace(event, **changes) if changes else event

    def _image(self, event: ImageEvent) -> Event | str:
        size = len(event.data)
        if size == 0 or (not event.compressed and (event.width <= 0 or event.height <= 0)):
            return "empty"
        return "truncated" if not event.compressed and size < event.height * event.step else event

    def _truth(self, event: TruthEvent) -> Event | str:
        changes: Changes = {}
        x, y, z = event.position.tolist()
        if not math.isfinite(x + y + z):
            return "non_finite"
        if max(abs(x), abs(y), abs(z)) > self._config.max_position:
            return "position_bound"
        if reason := self._parts.quaternion(event.orientation, "orientation", changes):
            return reason
        return replace(event, **changes) if changes else event

    def _transform(self, event: TransformEvent) -> Event | str:
        changes: Changes = {}
        if not np.isfinite(event.translation).all():
            return "non_finite"
        if reason := self._parts.quaternion(event.rotation, "rotation", changes):
            return reason
        return replace(event, **changes) if changes else event

    def _note(self, text: str) -> None:
        self._notes.setdefault(text)


def _by_stream(check: Check, config: GateConfig, event: SensorEvent) -> Event | str:
    return check(event, config)
