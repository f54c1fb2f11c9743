"""The gate: every event is validated, repaired or rejected here, before anything is estimated from it."""

from __future__ import annotations

import hashlib
import math
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from fgloc.config import Config, GateConfig, camera_role
from fgloc.extensions import outside_sensors
from fgloc.sensors import registry
from fgloc.sensors.base import Stream
from fgloc.sensors.checks import EMPTIED, Changes, FieldChecks
from fgloc.types import Event, Grave, MotionEvent, SightingsEvent, TransformEvent, TruthEvent

_RECENT = 64  # accepted stamps of a topic that are remembered to find duplicates
_MOST_NOTES, _LONGEST_NOTE = 40, 1000  # sentences, and characters of one
_OTHER_FRAMES = 20  # messages, without one of the frames before for ...
_SILENT_NS = 1_000_000_000  # ... so long: the publisher is another one from then on
_LEAST_SCALE = 1e-3  # of a rate: no unit of angle is smaller

# --- Copies of messages -----------------------------------------------------------------------------------------------

_MOST_CONTENTS = 1000  # messages of a topic that are remembered: 30 s of a fast camera
_OVERTAKEN_NS = 100_000_000  # messages overtake each other on their way by as much
_OLDEST_NS = 60_000_000_000  # a stamp further back is of a clock that was set back, or of none


class Contents:
    """Finds copies of a topic's sightings that claim to be older than the first of them.

    Noise makes each measurement differ from all others in its last digits: landmarks with the same values to the digit
    are one measurement. Where the robot stands and the sensor has no noise, or coarse digits, they come again with
    later stamps. With an earlier stamp they are a copy by a node that stamps wrongly. Copies agree with each other, so
    that together they overrule a prediction that is right.

    Several detectors with different delays, messages that overtake each other, and clocks that are set back bring other
    values, or the same with the stamps that they had: these pass.

    Attributes:
        copies: how many there were.
    """

    def __init__(self) -> None:
        """Start without messages."""
        self.copies = 0
        self._first_ns: dict[bytes, int] = {}  # first stamp of a content, the one that was heard last at the end

    def is_copy(self, event: SightingsEvent) -> bool:
        """Whether the event is a copy with an earlier stamp; else it is remembered."""
        if not event.sightings:
            return False
        content, stamp = _digest(event), event.stamp_ns
        first = self._first_ns.pop(content, stamp)
        back = first - stamp
        copy = _OVERTAKEN_NS < back <= _OLDEST_NS
        self._first_ns[content] = stamp if 0 < back <= _OVERTAKEN_NS else first
        if len(self._first_ns) > _MOST_CONTENTS:
            del self._first_ns[next(iter(self._first_ns))]
        self.copies += copy
        return copy


def _digest(event: SightingsEvent) -> bytes:
    """Digest of the landmarks of a message with all their values; the same frame by another name does not change it."""
    digest = hashlib.blake2b(digest_size=16)
    for one in event.sightings:
        for each in fields(one):
            value = getattr(one, each.name)
            digest.update(value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
            digest.update(b";")
    return digest.digest()


# --- The gate ---------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Topic:
    """State of one topic: stamps and gaps."""

    newest_ns: int
    used_ns: int  # when the last message that is used was received
    recent: deque[int] = field(default_factory=lambda: deque(maxlen=_RECENT))
    gaps: int = 0
    longest_gap_ns: int = 0
    back: bool = False  # the last stamp was far behind the newest
    frames: tuple[str, ...] = ()  # of the messages that are used
    other: tuple[str, ...] = ()  # frames that most of the others have ...
    votes: int = 0  # ... and by how many more of those messages, since the last that is used
    stray: int = 0  # messages rejected for their frames


def reported_bounds(config: Config) -> GateConfig:
    """Bounds of what sensors report: of what is true, in the units that the settings say they report in."""
    gate, turn = config.gate, min(abs(config.wheels.scale_omega), abs(config.gyro.scale), 1.0)
    bounds = {
        "max_speed": gate.max_speed / min(config.wheels.scale_v, 1.0),
        "max_yaw_rate": gate.max_yaw_rate / max(turn, _LEAST_SCALE),
        "max_range": gate.max_range / min(config.landmarks.range_scale, 1.0),
        "max_wheel_rate": gate.max_wheel_rate if config.wheels.in_radians else math.inf,
        "max_position": gate.max_position / min(config.truth.scale, 1.0),
    }
    sections = ((sensor, getattr(config, sensor.name, None)) for sensor in outside_sensors())
    units = {
        stream.role: section.unit_m
        for sensor, section in sections
        if section is not None and hasattr(section, "unit_m")
        for stream in sensor.streams
    }
    return gate.model_copy(update=bounds).in_units(units)


class EventValidator:
    """Validates events one by one; what it lets through can be computed with.

    An event comes back as it was, or as a repaired copy, or not at all (None). Repairs:

    - A nearly unit quaternion is normalised; a nearly symmetric covariance is made symmetric.
    - A covariance without meaning (a zero, NaN or absurdly large variance where one is needed) becomes all zeros:
      "use the configured default". The odometry's is judged by x, y, yaw, the others' whole.
    - A part that cannot be used is NaN in the copy and the rest is kept. Odometry: ``position`` and ``orientation``, or
      ``linear`` and ``angular``. Joints: single entries of ``position``, ``velocity``, ``effort``. IMU:
      ``linear_acceleration``. Events without any usable part are rejected whole.
    - Odometry or IMU of other frames than the topic's messages so far is rejected, until those have been silent
      for a second and twenty others have the same.
    - Sightings that repeat a message of their topic to the digit, with an earlier stamp, are rejected (`Contents`).
    - Bad entries of sightings are taken out; if none is left the event is rejected. Bearings in [pi, 2 pi] are wrapped.

    ``rejections`` counts what was lost, by "sensor.reason". Sensors: odometry, command, joints, imu, image, sightings,
    truth, transform. Reasons: stamp_zero, duplicate_stamp; frame; non_finite, speed_bound, yaw_rate_bound, range_bound,
    position_bound, quaternion, negative_variance, asymmetric_cov, indefinite_cov (of odometry with ``pose_`` or
    ``twist_`` before them); length, position_non_finite, velocity_non_finite, effort_non_finite, position_bound,
    wheel_rate_bound (joints); unavailable, frozen, acceleration (imu); empty, truncated, resized (image); copy,
    unknown_id, corners_degenerate, corners_small, bearing_bound, bearing_unit (sightings).

    Camera information passes unseen: whoever makes a camera of it validates it. Transforms may have stamp 0.
    """

    def __init__(
        self,
        config: GateConfig,
        known_ids: Collection[int] | None = None,
        streams: Iterable[Stream] = (),
        named: Mapping[str, str] | None = None,
    ) -> None:
        """Start without events.

        Args:
            config: bounds.
            known_ids: ids of the map; None if no map is given: then every id passes.
            streams: of sensors of other packages; the built-in ones are known.
            named: name of the camera of a topic, where there are several: its sensor is ``front/image`` then.
        """
        self.rejections: Counter[str] = Counter()
        self._config = config
        self._notes: dict[str, None] = {}  # an ordered set
        self._parts = FieldChecks(config, self._note, self.rejections, known_ids, named)
        self._named = named or {}
        self._seen: Counter[str] = Counter()  # events by role
        self._topics: dict[str, _Topic] = {}
        self._contents: defaultdict[str, Contents] = defaultdict(Contents)  # by topic
        self._checks: dict[type, tuple[str, Callable[[Any], Event | str]]] = {TruthEvent: ("truth", self._truth)}
        for stream in (*registry.streams(), *streams):
            self._checks[stream.event] = stream.role, stream.validate(self._parts)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user so far, one sentence each, without repetitions."""
        notes = [*self._notes, *self._parts.notes]
        for reason in sorted(r for r in self.rejections if r.endswith("yaw_rate_bound")):
            bad, seen = self.rejections[reason], self._seen[reason.split(".")[0]]
            if bad >= 10 and bad > 0.1 * seen:
                text = (
                    f"{bad} of {seen} yaw rates ({reason}) exceed {self._config.max_yaw_rate:g} rad/s: perhaps degrees "
                    "were given for radians; else raise expert.gate.max_yaw_rate"
                )
                notes.append(Grave(text))
        for name, topic in self._topics.items():
            if topic.stray:
                notes.append(
                    f"{name}: {topic.stray} messages of other frames than {topic.frames!r} were rejected"[
                        :_LONGEST_NOTE
                    ]
                )
            if topic.gaps:
                notes.append(
                    f"{name}: {topic.gaps} silence(s) longer than {self._config.gap_s:g} s, "
                    f"the longest {topic.longest_gap_ns * 1e-9:.1f} s"
                )
        notes += [
            f"{name}: {contents.copies} messages repeat an earlier one to the digit, with stamps before it, and were "
            "rejected: see which nodes publish on this topic"
            for name, contents in self._contents.items()
            if contents.copies
        ]
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
        if event.topic in self._named:
            sensor = camera_role(self._named[event.topic], sensor)
        self._seen[sensor] += 1
        topic = self._topics.get(event.topic)
        frames = self._frames(event)
        copied = isinstance(event, SightingsEvent) and self._contents[event.topic].is_copy(event)
        reason = "copy" if copied else self._stamp(event, topic) or self._frame(event, topic, frames)
        if not reason:
            checked = check(event)
            if not isinstance(checked, str):
                self._remember(event, topic, frames)
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

    @staticmethod
    def _frames(event: Event) -> tuple[str, ...]:
        """Frames of a message of odometry or IMU; none of others, which may tell several apart by them."""
        named = (getattr(event, name, "") for name in ("frame_id", "child_frame_id"))
        return tuple(named) if isinstance(event, MotionEvent) else ()

    @staticmethod
    def _frame(event: Event, topic: _Topic | None, frames: tuple[str, ...]) -> str:
        """Reason to reject a message of these frames, or ""."""
        if topic is None or topic.frames == frames:
            return ""
        if frames != topic.other and topic.votes == 0:
            topic.other = frames
        topic.votes += 1 if frames == topic.other else -1
        if topic.votes >= _OTHER_FRAMES and abs(event.received_ns - topic.used_ns) >= _SILENT_NS:
            return ""
        topic.stray += 1
        return "frame"

    def _remember(self, event: Event, topic: _Topic | None, frames: tuple[str, ...]) -> None:
        stamp = event.stamp_ns
        if topic is None:
            topic = self._topics[event.topic] = _Topic(stamp, event.received_ns)
        topic.frames, topic.votes, topic.used_ns = frames, 0, event.received_ns
        if stamp > topic.newest_ns:
            gap = stamp - topic.newest_ns
            if gap > self._config.gap_s * 1e9:
                topic.gaps += 1
                topic.longest_gap_ns = max(topic.longest_gap_ns, gap)
            topic.newest_ns = stamp
            topic.back = False
        topic.recent.append(stamp)

    # --- what no sensor has: the event, a repaired copy, or the reason for rejection ---

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
        if len(self._notes) < _MOST_NOTES:  # names in messages are in them
            self._notes.setdefault(type(text)(text[:_LONGEST_NOTE]))
