"""Joints and other roles in messages of any type: which field holds which number, several topics put together."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from fgloc.config import JointField, Role, RoleFields
from fgloc.recording.messages import Decoder
from fgloc.recording.storage import Channel, Storage
from fgloc.sensors import registry
from fgloc.sensors.base import When
from fgloc.types import Event, FloatArray

_STEP = re.compile(r"(\w+)|\[(\d+)\]")
_RATE = re.compile(r"speed|vel(ocity|ocities|s)?(?![a-z])|rpm|rate", re.IGNORECASE)
_ANGLE = re.compile(r"steer|angle|tick|count|encoder|position|travel", re.IGNORECASE)
_MOST_FIELDS = 12  # of a message that is of little else: of longer ones those that are named so
_CAMEL = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
_LARGE = re.compile("(sensor|nav|visualization|rosgraph|rcl_interfaces|diagnostic)_?(msgs)?/")  # no wheels in them
_MOST_ENTRIES = 4  # of an array
_MOST_LOOKED_AT = 5000  # messages
_JOINT_STATE = "sensor_msgs/msg/JointState"
_MOST_WAITING = 2000  # readings of a topic that wait for those of the others
_AGAIN_NS = 1_000_000_000  # a message received so much before the last one: the recording is read again
_ENOUGH = 20  # messages without an event, to be told
_DEEPEST = 8  # messages inside messages
_MOST_PATHS = 10_000  # of a message type: twenty messages in each of twenty, and so on, are billions
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")


def in_words(name: str) -> str:
    """The name in small letters, words of camel case apart: ``leftWheel`` as ``left_wheel``."""
    return _CAMEL.sub("_", name).lower()


def value_at(content: Any, path: str) -> float:
    """Number in a message, by its path, such as ``point.x`` or ``data[0]``.

    Raises:
        AttributeError, IndexError, TypeError, ValueError: there is none.
    """
    return float(_part(content, path))


def _part(content: Any, path: str) -> Any:
    for name, index in _STEP.findall(path):
        content = getattr(content, name) if name else content[int(index)]
    return content


def entries_at(content: Any, path: str) -> list[Any]:
    """Values in a message by a path; where it has ``[]``, one of each entry of that array.

    Raises:
        AttributeError, IndexError, TypeError: there is none.
    """
    array, each, rest = path.partition("[]")
    if not each:
        return [_part(content, path)]
    return [value for entry in _part(content, array) for value in entries_at(entry, rest.removeprefix("."))]


def events_of_role(role: Role, fields: RoleFields, content: Any, when: When) -> list[Event]:
    """Events of a message whose fields play a role, by the converter of a usual type with the same content.

    Raises:
        AttributeError, IndexError, TypeError, ValueError: it lacks a field, or has not as many of one as of another.
    """
    make, header = registry.converters(role), getattr(content, "header", SimpleNamespace(frame_id=""))
    if role == "odometry":
        forward, turn = (value_at(content, path or "") for path in (fields.forward, fields.turn))
        linear, angular = SimpleNamespace(x=forward, y=0.0, z=0.0), SimpleNamespace(x=0.0, y=0.0, z=turn)
        message = SimpleNamespace(header=header, twist=SimpleNamespace(linear=linear, angular=angular))
        return [make["geometry_msgs/msg/TwistStamped"](message, when)]
    ids, *others = (
        entries_at(content, path) for path in (fields.id, fields.range, fields.bearing, fields.pose) if path is not None
    )
    rows = [(int(i), *row) for i, *row in zip(ids, *others, strict=True)]
    if role == "uwb":
        of_range = make["sensor_msgs/msg/Range"]
        found = ((i, SimpleNamespace(header=SimpleNamespace(frame_id=str(i)), range=r)) for i, r in rows)
        return [of_range(one, (*when[:2], f"{when[2]}[{i}]")) for i, one in found]  # each anchor has its own stamps
    if fields.pose is None:
        seen = [SimpleNamespace(id=i, range=r, bearing=b) for i, r, b in rows]
        return [make["landmark_msgs/msg/LandmarkArray"](SimpleNamespace(header=header, landmarks=seen), when)]
    markers = [SimpleNamespace(marker_id=i, pose=_as_pose(row[-1])) for i, *row in rows]
    return [make["aruco_opencv_msgs/msg/ArucoDetection"](SimpleNamespace(header=header, markers=markers), when)]


def _as_pose(pose: Any) -> Any:
    """A Pose, where a Transform may be given."""
    moved = getattr(pose, "translation", None)
    return pose if moved is None else SimpleNamespace(position=moved, orientation=pose.rotation)


def numeric_fields(message_type: str, definitions: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Paths of the numbers in a message type and their types ("uint16"); ``[]`` in a path stands for each entry.

    Args:
        message_type: "pkg/msg/Name".
        definitions: fields of it and of the types inside it, as rosbags' typestore has them.
    """
    looked_at = islice(_fields(message_type, definitions), _MOST_PATHS)
    return ((path, kind) for path, kind in looked_at if kind not in ("", "string", "wstring"))


def _fields(message_type: str, definitions: Mapping[str, Any], depth: int = 0) -> Iterator[tuple[str, str]]:
    """Paths of all fields and their types; "" of messages."""
    if message_type not in definitions or depth > _DEEPEST:
        return
    for name, (kind, content) in definitions[message_type][1]:
        if name == "header" or content in _TIMES:
            continue
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            name, (kind, content) = f"{name}[]", content[0]
        yield name, content[0] if kind == Nodetype.BASE else ""
        if kind == Nodetype.NAME:
            yield from ((f"{name}.{path}", of) for path, of in _fields(content, definitions, depth + 1))


@dataclass(frozen=True, slots=True)
class NumericField:
    """One number of a topic's messages: its type, such as "uint16", and the range of its first values."""

    topic: str
    path: str
    kind: str
    low: float
    high: float

    @property
    def name(self) -> str:
        """Name of its topic and its path, as `in_words` has it."""
        return in_words(f"{self.topic} {self.path}")

    @property
    def is_of_wheels(self) -> bool:
        """Whether its name or its topic's says that it is an angle, a rate or a counter of wheels."""
        return bool(_RATE.search(self.name) or _ANGLE.search(self.name) or "wheel" in self.name)

    @property
    def is_rate(self) -> bool:
        """Whether its name or its topic's says that it is one, and not an angle."""
        return bool(_RATE.search(self.name)) and not _ANGLE.search(self.name)


def _unread(
    storage: Storage, known: Collection[str], taken: Collection[str]
) -> Iterator[tuple[Channel, Decoder, dict[str, str]]]:
    """Channels of types that nothing reads, with a decoder, and the types of their numbers by path."""
    channels = [
        c
        for c in storage.channels
        if c.count and c.message_type not in known and c.topic not in taken and not _LARGE.match(c.message_type)
    ]
    decoder = Decoder(storage.kind == "ros1", [(c.message_type, c.definition) for c in channels])
    for channel in channels:
        yield channel, decoder, dict(numeric_fields(channel.message_type, decoder.store.fielddefs))


def unread_paths(storage: Storage, known: Collection[str], taken: Collection[str]) -> dict[str, dict[str, str]]:
    """Types of the numbers by path, by topic, of those that `unread_numbers` looks at."""
    return {channel.topic: paths for channel, _, paths in _unread(storage, known, taken)}


def unread_numbers(storage: Storage, known: Collection[str], taken: Collection[str]) -> Iterator[NumericField]:
    """Numbers in the messages of types that nothing reads: they may be the angles or rates of wheels.

    Args:
        storage: of the recording.
        known: types that something reads.
        taken: topics that play a role.
    """
    for channel, decoder, paths in _unread(storage, known, taken):
        fields = {
            path.replace("[]", f"[{k}]", 1).replace("[]", "[0]"): kind
            for path, kind in paths.items()
            for k in range(_MOST_ENTRIES if "[]" in path else 1)
        }
        if len(fields) > _MOST_FIELDS:
            fields = {p: k for p, k in fields.items() if NumericField(channel.topic, p, k, 0.0, 0.0).is_of_wheels}
        if not 0 < len(fields) <= 4 * _MOST_FIELDS:
            continue
        seen: dict[str, list[float]] = {path: [] for path in fields}
        for _, message_type, _, raw in islice(storage.messages([channel.topic]), _MOST_LOOKED_AT):
            with suppress(Exception):  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
                content = decoder.deserialize(message_type, raw)
                for path in fields:
                    with suppress(IndexError):  # an array may be empty
                        if math.isfinite(value := value_at(content, path)):
                            seen[path].append(value)
        for path, values in seen.items():
            if values:
                yield NumericField(channel.topic, path, fields[path], min(values), max(values))


class JointFields:
    """Maker of joint states from the fields that `recording.joints` names.

    Joints of one topic make an event for each message. Those of several make one for each time that all topics have
    reached: the readings before and after it are interpolated.
    """

    def __init__(self, joints: Mapping[str, JointField]) -> None:
        """Take the joints by name; the events are of the first one's topic."""
        self._joints = joints
        self._names = tuple(joints)
        self.topics = tuple(dict.fromkeys(joint.topic for joint in joints.values()))
        self._received_ns = self._made_ns = -1
        self._columns = {topic: [k for k, j in enumerate(joints.values()) if j.topic == topic] for topic in self.topics}
        self._forget()

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on a field that is not there, and on topics that no time is common to."""
        if self._taken >= _ENOUGH and not self._made and len(self.topics) > 1:
            apart = f"The stamps of {' and '.join(self.topics)} have no time in common, so that their joints make no "
            return (*self._notes.values(), f"{apart}motion: set recording.received_stamps: [joints].")
        return tuple(self._notes.values())

    def events(self, content: Any, when: When) -> list[Event]:
        """Events that a message completes.

        Args:
            content: the message.
            when: its stamp, receive time and topic.

        Raises:
            AttributeError, IndexError, TypeError, ValueError: it lacks a field, or one is no number.
        """
        stamp_ns, received_ns, topic = when
        if received_ns < self._received_ns - _AGAIN_NS:
            self._forget()
        self._received_ns = received_ns
        self._taken += 1
        values = self._read(content, topic)
        if len(self.topics) == 1:
            return [self._event(values, when)]
        waiting = self._waiting[topic]
        if waiting and stamp_ns <= waiting[-1][0]:  # late, or its clock was set back
            waiting.clear()
        waiting.append((stamp_ns, values))
        if not all(self._waiting.values()):
            return []
        reached_ns = min(readings[-1][0] for readings in self._waiting.values())
        found = {name: self._at(readings, reached_ns) for name, readings in self._waiting.items()}
        if reached_ns == self._made_ns or any(value is None for value in found.values()):
            return []
        self._made_ns = reached_ns
        self._made += 1
        whole = np.full((2, len(self._names)), math.nan)
        for name, at in found.items():
            whole[:, self._columns[name]] = at[:, self._columns[name]]  # type: ignore[index]
        return [self._event(whole, (reached_ns, received_ns, self.topics[0]))]

    def _forget(self) -> None:
        self._received_ns = self._made_ns = -1
        self._taken = self._made = 0
        self._notes: dict[str, str] = {}
        self._waiting: dict[str, deque[tuple[int, FloatArray]]] = {
            topic: deque(maxlen=_MOST_WAITING) for topic in self.topics
        }
        self._counts: dict[str, tuple[float, float]] = {}  # the last reading and its turns, of what rolls over

    def _read(self, content: Any, topic: str) -> FloatArray:
        """Angles and rates ``(2, n)`` of all joints; NaN where this message has none."""
        values = np.full((2, len(self._names)), math.nan)
        for k in self._columns[topic]:
            joint = self._joints[self._names[k]]
            if joint.position is not None:
                told = self._value(content, k, joint.position)
                if joint.rolls_over is not None and math.isfinite(told):
                    told = self._unrolled(self._names[k], told, joint.rolls_over)
                values[0, k] = joint.scale * told + joint.offset
            if joint.velocity is not None:
                values[1, k] = joint.scale * self._value(content, k, joint.velocity)
                if joint.position is None:
                    values[1, k] += joint.offset
        return values

    def _value(self, content: Any, k: int, path: str) -> float:
        try:
            return value_at(content, path)
        except IndexError:
            name = self._names[k]
            self._notes[name] = (
                f"recording.joints.{name}: {path} is beyond the end of the array in messages of "
                f"{self._joints[name].topic}; they are not used."
            )
            raise

    def _unrolled(self, name: str, told: float, after: float) -> float:
        last, whole = self._counts.get(name, (told, told))
        whole += math.remainder(told - last, after)
        self._counts[name] = told, whole
        return whole

    def _at(self, readings: deque[tuple[int, FloatArray]], at_ns: int) -> FloatArray | None:
        """Values at a time between two readings; those before it are dropped. None: it is before the first one."""
        while len(readings) > 1 and readings[1][0] <= at_ns:
            readings.popleft()
        (first_ns, first), (last_ns, last) = readings[0], readings[min(1, len(readings) - 1)]
        if first_ns > at_ns:
            return None
        share = 0.0 if last_ns == first_ns else (at_ns - first_ns) / (last_ns - first_ns)
        return first if share == 0.0 else first + share * (last - first)

    def _event(self, values: FloatArray, when: When) -> Event:
        position, velocity = (row if np.isfinite(row).any() else np.empty(0) for row in values)
        message = SimpleNamespace(name=self._names, position=position, velocity=velocity, effort=np.empty(0))
        return registry.converters("joints")[_JOINT_STATE](message, when)
