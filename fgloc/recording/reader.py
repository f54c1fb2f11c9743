"""Recordings as events: which topic plays which role, its messages as events, `open_recording` for all kinds of bag."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from itertools import islice
from operator import attrgetter
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from fgloc.config import (
    BESIDE,
    BUILT_IN_ROLES,
    RecordingConfig,
    Role,
    TopicsConfig,
    base_role,
    camera_folder,
    camera_role,
    role_names,
)
from fgloc.errors import RecordingError
from fgloc.recording.fields import JointFields, events_of_role, numeric_fields
from fgloc.recording.messages import Decoder
from fgloc.recording.storage import RawMessage, Storage, lost
from fgloc.recording.transforms import TF_TOPIC, FrameTree, is_odometry_pair, pair_topic
from fgloc.sensors import registry
from fgloc.sensors.base import Converter, UnusableMessageError, When, matrix, nanoseconds, vector, xyz, xyzw
from fgloc.types import CameraInfoEvent, Event, TransformEvent, TruthEvent

# --- Messages to events, without validation: that is the gate's part --------------------------------------------------

TF_TYPES = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
HEADERLESS = frozenset({"geometry_msgs/msg/Twist", "geometry_msgs/msg/Pose2D"})


def transforms(message: Any, received_ns: int, topic: str, static: bool) -> list[TransformEvent]:
    """Events of a TFMessage."""
    return [
        TransformEvent(
            nanoseconds(t.header.stamp),
            received_ns,
            topic,
            t.header.frame_id,
            t.child_frame_id,
            xyz(t.transform.translation),
            xyzw(t.transform.rotation),
            static,
        )
        for t in message.transforms
    ]


class MessageEvents:
    """Turns messages into events; keeps what joints on several topics wait for."""

    def __init__(self, config: RecordingConfig) -> None:
        """Take topics and clocks."""
        self._config = config
        self._fields = JointFields(config.joints if config.topics.of_joints else {})

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on joints that the messages do not tell as they are configured."""
        return self._fields.notes

    def of(self, content: Any, message_type: str, role: Role | None, received_ns: int, topic: str) -> list[Event]:
        """Events of one message in a role (None: none but that of tf), stamped as the configuration has it.

        Raises:
            KeyError, ValueError, AttributeError, IndexError, TypeError: the message is not what its type says, or
                lacks a configured field.
        """
        if message_type in TF_TYPES:
            return list(transforms(content, received_ns, topic, topic.rstrip("/").endswith("tf_static")))
        if role is None:
            return []
        header = None if role in self._config.received_stamps else getattr(content, "header", content)
        stamp = getattr(header, "stamp", None)
        stamp_ns = nanoseconds(stamp) if hasattr(stamp, "sec") else received_ns  # a stamp may be a number of any unit
        stamp_ns += round(self._config.stamp_offset_s.get(role, 0.0) * 1e9)
        if topic in self._fields.topics:
            return self._fields.events(content, (stamp_ns, received_ns, topic))
        if self._config.topics.of_fields.get(role) == topic:
            return events_of_role(role, self._config.fields[role], content, (stamp_ns, received_ns, topic))  # type: ignore[index]
        return [converters_of(role)[message_type](content, (stamp_ns, received_ns, topic))]


# --- One converter for each type --------------------------------------------------------------------------------------


def _camera_info(m: Any, when: When) -> Event:
    K, D, P = (m.K, m.D, m.P) if hasattr(m, "K") else (m.k, m.d, m.p)  # ROS 1 has capitals
    roi = m.roi.x_offset, m.roi.y_offset, m.roi.width, m.roi.height
    binning = max(m.binning_x, 1), max(m.binning_y, 1)
    projection = vector(P).reshape(3, 4)
    arrays = matrix(K, 3), vector(D), projection
    return CameraInfoEvent(*when, m.header.frame_id, m.width, m.height, m.distortion_model, *arrays, roi, binning)


def _truth(position: str, orientation: str) -> Converter:
    """Converter of messages that have position and orientation in these fields."""
    place, turn = attrgetter(position), attrgetter(orientation)
    return lambda m, when: TruthEvent(*when, m.header.frame_id, xyz(place(m)), xyzw(turn(m)))


def _point_truth(m: Any, when: When) -> Event:
    return TruthEvent(*when, m.header.frame_id, xyz(m.point), np.array([0.0, 0.0, 0.0, 1.0]), has_yaw=False)


def _planar_truth(m: Any, when: When) -> Event:
    half = 0.5 * float(m.theta)
    orientation = np.array([0.0, 0.0, math.sin(half), math.cos(half)]) if math.isfinite(half) else np.full(4, math.nan)
    return TruthEvent(*when, "", np.array([m.x, m.y, 0.0]), orientation)


_ODOMETRY, _TWIST = "nav_msgs/msg/Odometry", "geometry_msgs/msg/TwistWithCovarianceStamped"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"  # as Vicon's bridge publishes poses
_MOST_OF_TF = 2000  # messages from the beginning, to see which frames move
POINT = "geometry_msgs/msg/PointStamped"  # a total station's, without a yaw; or a click on a map
_COVARIANCE_TRUTH = _truth("pose.pose.position", "pose.pose.orientation")
CONVERTERS: dict[Role, dict[str, Converter]] = {
    "camera_info": {"sensor_msgs/msg/CameraInfo": _camera_info},
    "truth": {
        "geometry_msgs/msg/PoseStamped": _truth("pose.position", "pose.orientation"),
        "geometry_msgs/msg/PoseWithCovarianceStamped": _COVARIANCE_TRUTH,
        "geometry_msgs/msg/Pose2D": _planar_truth,
        _TRANSFORM: _truth("transform.translation", "transform.rotation"),
        _ODOMETRY: _COVARIANCE_TRUTH,
        POINT: _point_truth,
    },
}
"""Of the roles that no sensor has."""


def converters_of(role: Role) -> Mapping[str, Converter]:
    """Converters of any role, by message type."""
    role = base_role(role)
    return CONVERTERS[role] if role in CONVERTERS else registry.converters(role)


# --- Roles of topics, by message type: what is ambiguous is named, never guessed silently -----------------------------

OWN = "/fgloc/"  # topics below are outputs of fgloc: of `fgloc live`, of this process or another, or of a finished run
_CAMERA_INFO = ("camera_info",)  # its usual name
# Words (between / and _) by which a topic says what it is.
TRUTH_WORDS = frozenset({"truth", "groundtruth", "gt", "mocap", "vicon", "optitrack", "vrpn", "qualisys"})
_NO_BASE_WORDS = r"goal|target|setpoint|clicked|plan|waypoint|aruco|markers?|(april)?tags?|detections?"
_NO_BASE = re.compile(rf"(?<![a-z])({_NO_BASE_WORDS})(?![a-z])", re.IGNORECASE)  # a pose, and not the robot's
_NOT_TRUTH = re.compile(
    rf"(?<![a-z])({_NO_BASE_WORDS}|initial_?pose|amcl|ekf|ukf|slam|filter(ed)?|estimated?|combined|odom)(?![a-z])",
    re.IGNORECASE,
)
_NOT_IMAGE = re.compile(
    r"(?<![a-z])((compressed)?depth|disparity|confidence|mask|debug|result|overlay|costmap)(?![a-z])",
    re.IGNORECASE,
)
_RECTIFIED = re.compile(r"(?<![a-z])rect(ified)?(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a recording."""

    name: str
    message_type: str  # "pkg/msg/Name"
    count: int
    role: Role | None = None  # the role that it was selected for


@dataclass(frozen=True, slots=True)
class Selection:
    """Outcome of the selection."""

    roles: Mapping[Role, str]  # of several topics the first
    notes: tuple[str, ...]  # what was taken for what, where that was not obvious
    problems: tuple[str, ...]  # ambiguities, and configured topics that do not fit
    also: Mapping[str, Role] = field(default_factory=dict)  # further topics, of roles that may have several


def select_roles(
    topics: Sequence[TopicInfo], config: TopicsConfig, beside: Mapping[Role, str] | None = None, growing: bool = False
) -> Selection:
    """Find a topic for each role.

    Args:
        topics: all topics; those without messages are no candidates.
        config: topics given by the user; they win, and "none" switches a role off.
        beside: topics of the odometries beside the wheels, by role.
        growing: a configured topic that is not there may still come: that is no problem.
    """
    roles, also, problems, notes = _given_roles(topics, config, beside or {}, growing)
    filled = [topic for topic in topics if topic.count > 0]
    names = (*role_names(), *config.of_cameras)
    for role in sorted(names, key=_by_dependence):
        if config.given(role) is not None:
            continue
        taken = (*roles.values(), *also, *config.of_joints)
        fitting = [topic for topic in filled if _fits(role, topic) and topic.name not in taken]
        whole = [topic.name for topic in fitting if topic.message_type not in (_TRANSFORM, POINT, _TWIST)]
        candidates = unrectified(whole or [topic.name for topic in fitting])
        camera = role.rpartition("/")[0]
        near = roles.get(camera_role(camera, "image")) or roles.get(camera_role(camera, "sightings"))
        if role in config.of_cameras:  # a calibration that is not beside its images may be of any camera
            candidates = [
                name for name in candidates if near is not None and camera_folder(name) == camera_folder(near)
            ]
        chosen, why = _choose(role, candidates, near)
        if chosen is not None:
            roles[role] = chosen
            if why:
                notes.append(f"{chosen} is taken as {role}: {why}.")
        elif registry.of_several(role) and len(candidates) > 1 and len({*map(_unnumbered, candidates)}) == 1:
            roles[role], *others = sorted(candidates)
            also |= dict.fromkeys(others, role)
            notes.append(f"{', '.join(sorted(candidates))} are all taken as {role}: they differ by a number only.")
        elif candidates and role not in BUILT_IN_ROLES and role not in config.asked:  # nobody asked for the sensor
            notes.append(
                f"No {role}: {', '.join(candidates)} could be it; choose one with recording.topics.{role}, or none."
            )
        elif candidates:
            none = f"none (recording.topics.{role}: none)"
            none += "; list others in recording.odometries to use them too" if role == "odometry" else ""
            none += "; put together by recording.joints (docs/drives.md)" if role == "joints" else ""
            none += "; several by a pattern: /uwb/range_*" if registry.of_several(role) else ""
            problems.append(
                f"{len(candidates)} topics could be the {role}: {', '.join(candidates)}; choose one in the "
                f"configuration (recording.topics.{role}: {candidates[0]}), or {none}"
            )
        else:
            free = [t for t in filled if t.name not in (*roles.values(), *also, *config.of_joints)]
            notes.append(_unnamed(role, free))
    notes.append(_one_of_images_and_sightings(roles, config))
    told = [topic.name for topic in filled if topic.message_type in converters_of("truth")]
    own = [name for name in told if name.startswith(OWN) and name not in roles.values()]
    if own:
        notes.append(f"{', '.join(own)}: the output of a run of fgloc, which is not read.")
    notes += [_empty(role, topics) for role in role_names() if role not in roles and config.given(role) is None]
    return Selection(roles, tuple(note for note in notes if note), tuple(problems), also)


def _given_roles(
    topics: Sequence[TopicInfo], config: TopicsConfig, beside: Mapping[Role, str], growing: bool
) -> tuple[dict[Role, str], dict[str, Role], list[str], list[str]]:
    """Roles that the user gave, further topics of them, what is wrong, and cameras without anything there."""
    roles: dict[Role, str] = {}
    also: dict[str, Role] = {}
    problems: list[str] = []
    notes: list[str] = []
    there, filled = {topic.name for topic in topics}, {topic.name for topic in topics if topic.count > 0}
    seeing = [t for role, t in config.of_cameras.items() if base_role(role) != "camera_info" and t in filled]
    own = ((role, config.given(role)) for role in (*role_names(), *config.of_cameras))
    for role, given in (*own, *beside.items()):
        if given is None or given == "none":
            continue
        if "*" in given and registry.of_several(role):
            fitting = [t for t in topics if t.message_type in converters_of(role) and t.count > 0]
            given, *others = sorted(t.name for t in fitting if fnmatchcase(t.name, given)) or [given]
            also |= dict.fromkeys(others, role)
        if growing and given not in there:
            continue
        if role in config.of_cameras and given not in filled and seeing:
            notes.append(f"{topic_key(role)}: {given} has no messages; the run goes on without it.")
        elif given in (config.of_joints if role == "joints" else (config.of_fields.get(role),)) and given in filled:
            roles[role] = given
        elif given in config.of_joints:
            problems.append(f"{topic_key(role)}: {given} is given in recording.joints too; choose one of them")
        elif problem := _misfit(role, given, topics):
            problems.append(problem)
        elif given in roles.values():
            problems.append(f"{topic_key(role)}: {given} is given for another role too; choose one of them")
        else:
            roles[role] = given
    lacking = [topic for topic in config.of_joints if topic not in filled and not (growing and topic not in there)]
    problems += [f"recording.joints: {topic} is not in the recording, or has no messages" for topic in lacking]
    if len(problems) > 1 and not roles:
        problems.append(
            "no topic of the configuration fits: if it is another robot's, `fgloc init BAG` writes this one's"
        )
    return roles, also, problems, notes


def _unnumbered(topic: str) -> str:
    """Name of a topic without what numbers it among others: its words with a figure in them."""
    return re.sub(r"[A-Za-z0-9]*\d[A-Za-z0-9]*", "#", topic)


def is_derived(topic: str) -> bool:
    """Whether the name of a topic of images says that they are of no camera: depth, a mask, an overlay."""
    return bool(_NOT_IMAGE.search(topic))


def is_rectified(topic: str) -> bool:
    """Whether the name of a topic of images says that the lens's distortion is taken out of them."""
    return bool(_RECTIFIED.search(topic))


def unrectified(topics: list[str]) -> list[str]:
    """Those of some topics that are as the camera gives them; all, where there is none."""
    return [name for name in topics if not is_rectified(name)] or topics


def topic_key(role: Role) -> str:
    """Key of a role's topic in robot.yaml."""
    if role.startswith(BESIDE):
        return "recording.odometries"
    camera, _, base = role.rpartition("/")
    return f"cameras.{camera}.{base}" if camera else f"recording.topics.{role}"


def _unnamed(role: Role, filled: Iterable[TopicInfo]) -> str:
    """Note on topics that fit by type but not by name; empty if there are none, or names do not count for the role."""
    if role not in ("image", "truth"):
        return ""
    fitting = converters_of(role).keys() - {_ODOMETRY}
    by_type = [
        t.name
        for t in filled
        if t.message_type in fitting
        and not t.name.startswith(OWN)
        and not (role == "truth" and _NO_BASE.search(t.name))
    ]
    if not by_type:
        return ""
    return (
        f"No {role}: {', '.join(by_type)} would fit by type but not by name "
        f"(to use it all the same: recording.topics.{role}: {by_type[0]})."
    )


def _one_of_images_and_sightings(roles: dict[Role, str], config: TopicsConfig) -> str:
    """Leave one of them out unless both were given: most often the sightings were found in these very images."""
    if not {"image", "sightings"} <= roles.keys() or None not in (config.image, config.sightings):
        return ""
    spare: Role = "image" if config.image is None else "sightings"
    kept: Role = "sightings" if spare == "image" else "image"
    return (
        f"{roles.pop(spare)} is not used as {spare}, because {roles[kept]} tells of the markers already "
        f"(to use both: name both in recording.topics; to use it alone: recording.topics.{kept}: none)."
    )


def _empty(role: Role, topics: Iterable[TopicInfo]) -> str:
    """Note on topics without messages that could play an unfilled role; empty if there are none."""
    names = [topic.name for topic in topics if topic.count == 0 and role != "truth" and _fits(role, topic)]
    if not names:
        return ""
    return (
        f"No {role}: {', '.join(names)} holds no message. Nothing was published, or recorder and publisher had no "
        "matching quality of service: `ros2 topic info -v` shows both, `ros2 bag record --qos-profile-overrides-path` "
        "settles it."
    )


def _by_dependence(role: Role) -> int:
    """Truth first, for its Odometry topics are not the odometry; CameraInfo after its image."""
    return {"truth": 0, "camera_info": 2}.get(base_role(role), 1)


def _fits(role: Role, topic: TopicInfo) -> bool:
    role = base_role(role)
    if topic.name.startswith(OWN):  # a run would be fed with, or held against, itself
        return False
    if topic.message_type not in converters_of(role):
        return False
    if role == "truth":
        other = topic.message_type in (_TRANSFORM, POINT, _ODOMETRY)
        return _says_truth(topic.name) or not (other or _NOT_TRUTH.search(topic.name))
    if role == "odometry":  # other poses and twists may be anything: the configuration has to name them
        of_odometry = topic.message_type in (_ODOMETRY, _TWIST) or topic.name.startswith(TF_TOPIC)
        return of_odometry and not _says_truth(topic.name)
    if role in ("image", "camera_info"):
        return not is_derived(topic.name)
    return True


def _choose(role: Role, candidates: list[str], beside: str | None) -> tuple[str | None, str]:
    """The candidate to take, or None; and why, where that needs saying."""
    role = base_role(role)
    if role == "camera_info" and beside is not None:
        siblings = [name for name in candidates if camera_folder(name) == camera_folder(beside)]
        if siblings:
            candidates = siblings
    if role == "truth" and (named := [name for name in candidates if _says_truth(name)]):
        others = [name for name in candidates if name not in named]
        if len(named) == 1:
            return named[0], f"its name says so, unlike {', '.join(others)}" if others else ""
        return None, ""
    if role == "image" and len(pair := candidates) == 2 and len({camera_folder(name) for name in pair}) == 1:
        raw = [name for name in pair if not name.endswith("/compressed")]
        if len(raw) == 1 and f"{raw[0]}/compressed" in pair:
            return raw[0], f"not compressed, unlike {raw[0]}/compressed"
    if len(candidates) == 1:
        return candidates[0], "it is the only pose there, though its name does not say so" if role == "truth" else ""
    conventional = [name for name in candidates if _conventional(role, name)]
    if len(conventional) == 1:
        others = [name for name in candidates if name not in conventional]
        return conventional[0], f"its name is the usual one, unlike {', '.join(others)}"
    return None, ""


def _misfit(role: Role, given: str, topics: Iterable[TopicInfo]) -> str:
    """Reason why a topic that is configured under a key does not fit; empty if it fits."""
    types = converters_of(role)
    found = next((topic for topic in topics if topic.name == given), None)
    fitting = [topic.name for topic in topics if topic.count > 0 and topic.message_type in types and _fits(role, topic)]
    remedy = f"choose {' or '.join(fitting)}" if fitting else f"the recording has no topic for the {role}: use none"
    if found is None:
        return f"{topic_key(role)}: {given} is not in the recording; {remedy}"
    if found.message_type not in types:
        expected = " or ".join(types)
        return f"{topic_key(role)}: {given} is a {found.message_type}, expected {expected}; {remedy}"
    if found.count == 0:
        return f"{topic_key(role)}: {given} has no messages; {remedy}"
    return ""


def _says_truth(topic: str) -> bool:
    """Whether one of the words of a topic (between / and _, or in camel case) says so."""
    return not TRUTH_WORDS.isdisjoint(
        word.lower()
        for separators in (r"[/_.-]+", r"[/_.-]+|(?<=[a-z])(?=[A-Z])")
        for word in re.split(separators, topic)
    )


def _conventional(role: Role, topic: str) -> bool:
    names = _CAMERA_INFO if role == "camera_info" else registry.usual_names(role)
    return any(topic.strip("/") == name or topic.endswith(f"/{name}") for name in names)


# --- Recordings -------------------------------------------------------------------------------------------------------


def open_recording(path: Path, config: RecordingConfig) -> Recording:
    """Open a ROS 1 ``.bag``, a rosbag2 folder, an ``.mcap`` or a ``.db3``.

    Args:
        path: file or folder.
        config: topics, clocks.

    Raises:
        RecordingError: the recording cannot be read, several topics could play one role, or a configured topic does
            not fit.

    Example:
        >>> with open_recording(Path("run.bag"), RecordingConfig()) as recording:  # doctest: +SKIP
        ...     for event in recording.events(): ...
    """
    recording = Recording(path, config)
    if recording.problems:
        recording.close()
        raise RecordingError(f"{path}: " + "\n".join(recording.problems))
    return recording


class Recording:
    """An opened recording. Close it, or use it in a ``with``.

    Attributes:
        path: as given.
        kind: "ros1", "sqlite3" or "mcap".
        topics: all topics, with the role that each plays.
        roles: selected topic of each role, of several the first.
        role_of: role of each selected topic.
        problems: why no topic could be selected for a role; `open_recording` raises them.
        undecodable: messages that the latest pass of `events` could not decode, by topic.
    """

    def __init__(self, path: Path, config: RecordingConfig) -> None:
        """Open; see `open_recording`, which also refuses ambiguous roles."""
        self.path = path
        self.config = config
        self._storage = Storage(path)
        self.kind = self._storage.kind
        channels = self._storage.channels
        found: dict[str, TopicInfo] = {}
        for channel in sorted(channels, key=lambda c: (c.topic, -c.count)):
            known = found.setdefault(channel.topic, TopicInfo(channel.topic, channel.message_type, 0))
            found[channel.topic] = replace(known, count=known.count + channel.count)
        known_types = TF_TYPES.union(*map(converters_of, role_names()))
        by_fields = {*config.topics.of_joints, *config.topics.of_fields.values()}
        known_types |= {t.message_type for t in found.values() if t.name in by_fields}
        self._decoder = Decoder(
            self.kind == "ros1",
            [(c.message_type, c.definition) for c in channels if c.message_type in known_types and c.count],
        )
        self._tf_topics = {t.name for t in found.values() if t.message_type in TF_TYPES and t.count}
        pairs, of_pairs = self._pairs(tuple(found.values()))
        self._in_tf = frozenset(pairs)
        found |= pairs
        selection = select_roles(tuple(found.values()), config.topics, config.beside)
        self.roles: Mapping[Role, str] = selection.roles
        self.problems = selection.problems
        self.role_of: Mapping[str, Role] = {
            **{topic: role for role, topic in selection.roles.items()},
            **selection.also,
            **dict.fromkeys(config.topics.of_joints, "joints"),
        }
        self.topics = tuple(replace(topic, role=self.role_of.get(topic.name)) for topic in found.values())
        self._notes = (*of_pairs, *selection.notes, *self._decoder.notes)
        self.undecodable: dict[str, int] = {}
        self._reasons: dict[str, str] = {}  # why the first message of a topic cannot be used although it is decoded
        self._events = MessageEvents(config)
        self.problems = (*self.problems, *self._lacking_fields())

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._storage.close()

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user, one sentence each. Damage is noted when reading meets it."""
        return (*self._storage.notes, *self._notes, *self._events.notes)

    @property
    def unreadable(self) -> tuple[str, ...]:
        """Sentence for each topic with messages that the latest pass of `events` could not decode."""
        counts = {topic.name: topic.count for topic in self.topics}
        of = {topic: max(n, counts.get(topic, 0)) for topic, n in self.undecodable.items()}
        why = dict.fromkeys(self.undecodable, "decoded") | {t: f"used: {reason}" for t, reason in self._reasons.items()}
        return tuple(
            lost(f"{topic}: {n} of {of[topic]} messages cannot be {why[topic]}.", n / of[topic])
            for topic, n in self.undecodable.items()
        )

    @property
    def span_ns(self) -> tuple[int, int]:
        """Receive time of the first and of the last message."""
        return self._storage.span_ns

    @property
    def duration_s(self) -> float:
        """Time from the first message received to the last [s]."""
        start, end = self.span_ns
        return max(0, end - start) * 1e-9

    @cached_property
    def frames(self) -> FrameTree:
        """All transforms of ``/tf_static`` and ``/tf``; the first use reads these topics through."""
        messages = self._storage.messages(self._tf_topics) if self._tf_topics else iter(())
        events = (event for message in messages for event in self.decode(message, None))
        return FrameTree(event for event in events if isinstance(event, TransformEvent))

    def events(self) -> Iterator[Event]:
        """Events of the selected topics and of tf, in order of receive time. May be called again.

        Raises:
            RecordingError: the storage is damaged and nothing could be read before.
        """
        self.undecodable = {}
        role_of = {topic.name: topic.role for topic in self.topics if topic.role or topic.message_type in TF_TYPES}
        for message in self.messages(role_of.keys()):
            yield from self.decode(message, role_of[message[0]])

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages of these topics (None: of all), serialized, in order of receive time; also of pairs in tf."""
        pairs = self._in_tf if topics is None else self._in_tf & set(topics)
        if not pairs:
            return self._storage.messages(topics)
        return self._with_pairs(topics, pairs)

    def _with_pairs(self, topics: Collection[str] | None, pairs: Collection[str]) -> Iterator[RawMessage]:
        wanted = None if topics is None else {*topics, *self._tf_topics} - self._in_tf
        for message in self._storage.messages(wanted):
            if topics is None or message[0] in topics:
                yield message
            for name, transform in self._split(message):
                if name in pairs:
                    yield name, _TRANSFORM, message[2], self._decoder.serialize(_TRANSFORM, transform)

    def _split(self, message: RawMessage) -> list[tuple[str, Any]]:
        """Transforms of a message of tf by the names of their pairs; empty if it is of another topic, or damaged."""
        topic, message_type, _, raw = message
        try:
            content = self._decoder.deserialize(message_type, raw) if topic in self._tf_topics else None
        except Exception:  # rosbags leaks struct and decoding errors on damaged bytes
            return []
        listed = [] if content is None else content.transforms
        return [(pair_topic(t.header.frame_id, t.child_frame_id), t) for t in listed]

    def _pairs(self, topics: Sequence[TopicInfo]) -> tuple[dict[str, TopicInfo], list[str]]:
        """Poses in tf that are read as topics: those that the configuration names, else an odometry that is only there.

        Returns:
            A topic for each, with the messages counted in the beginning of tf, and notes on what was taken so.
        """
        of_role = {role: self.config.topics.given(role) for role in role_names()} | dict(self.config.beside)
        named = {given for given in of_role.values() if given is not None and given.startswith(TF_TOPIC)}
        alone = of_role["odometry"] is None and not any(t.count and _fits("odometry", t) for t in topics)
        if not self._tf_topics or not (named or alone):
            return {}, []
        counts: dict[str, int] = {}
        for message in islice(self._storage.messages(self._tf_topics), _MOST_OF_TF):
            for name, _ in self._split(message):
                counts[name] = counts.get(name, 0) + 1
        fitting = [name for name, n in counts.items() if n > 1 and is_odometry_pair(name, self.config.base_frame)]
        notes = []
        if alone and len(fitting) == 1:
            named |= set(fitting)
            notes = [f"{fitting[0]} is taken as odometry: no topic holds one."]
        elif alone and fitting:
            notes = [
                f"No odometry: {', '.join(fitting)} could be it; choose one with recording.topics.odometry, or none."
            ]
        return {name: TopicInfo(name, _TRANSFORM, counts[name]) for name in named & counts.keys()}, notes

    def _configured_fields(self) -> Iterator[tuple[str, str, str]]:
        """Setting, topic and path of each field that joints and other roles are made of."""
        topics = self.config.topics
        for name, joint in self.config.joints.items():
            for key in ("position", "velocity"):
                if joint.topic in topics.of_joints and (path := getattr(joint, key)) is not None:
                    yield f"recording.joints.{name}.{key}", joint.topic, path
        for role, fields in self.config.fields.items():
            for key, path in fields.model_dump(exclude_none=True, exclude={"topic"}).items():
                if topics.of_fields.get(role) == fields.topic:
                    yield f"recording.fields.{role}.{key}", fields.topic, path

    def _lacking_fields(self) -> Iterator[str]:
        """Sentences on fields that the topic's messages do not have."""
        types = {topic.name: topic.message_type for topic in self.topics if topic.count}
        for setting, topic, path in self._configured_fields():
            if topic not in types:
                continue
            there = [name for name, _ in numeric_fields(types[topic], self._decoder.store.fielddefs)]
            wanted, is_pose = re.sub(r"\[\d+\]", "[]", path), setting.endswith(".pose")
            if wanted not in there and not (is_pose and any(name.startswith(f"{wanted}.") for name in there)):
                shown = ", ".join(there) or "none: the recording does not hold its definition"
                shown = shown if setting.startswith("recording.fields") else shown.replace("[]", "[0]")
                what = "pose" if is_pose else "number"
                yield f"{setting}: {topic} ({types[topic]}) has no {what} {path}, expected one of {shown}"

    def decode(self, message: RawMessage, role: Role | None) -> list[Event]:
        """Events of one message in a role (None: tf); empty, and counted, if it cannot be decoded."""
        topic, message_type, received_ns, raw = message
        try:
            content = self._decoder.deserialize(message_type, raw)
            return self._events.of(content, message_type, role, received_ns, topic)
        except Exception as error:  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
            self.undecodable[topic] = self.undecodable.get(topic, 0) + 1
            if isinstance(error, UnusableMessageError):
                self._reasons.setdefault(topic, str(error))
            return []

    @property
    def size_bytes(self) -> int:
        """Size of the storage files."""
        return self._storage.size_bytes
