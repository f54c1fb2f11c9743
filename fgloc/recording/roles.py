"""Which topic plays which role. Found by message type; what is ambiguous is named, never guessed silently."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from fgloc.config import BUILT_IN_ROLES, Role, TopicsConfig, role_names
from fgloc.recording.decode import converters_of
from fgloc.sensors import registry

_CAMERA_INFO = ("camera_info",)  # its usual name
# Words (between / and _) by which a topic says what it is.
TRUTH_WORDS = frozenset({"truth", "groundtruth", "gt", "mocap", "vicon", "optitrack", "vrpn", "qualisys"})
_NOT_TRUTH = re.compile(
    r"(?<![a-z])(goal|initial_?pose|target|setpoint|clicked|plan|waypoint|amcl|ekf|ukf|slam|filter(ed)?|estimated?|"
    r"combined|aruco|markers?|(april)?tags?|detections?|odom)(?![a-z])",
    re.IGNORECASE,
)
_NOT_IMAGE = re.compile(
    r"(?<![a-z])((compressed)?depth|disparity|confidence|mask|debug|result|overlay|rect(ified)?|costmap)(?![a-z])",
    re.IGNORECASE,
)


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

    roles: Mapping[Role, str]
    notes: tuple[str, ...]  # what was taken for what, where that was not obvious
    problems: tuple[str, ...]  # ambiguities, and configured topics that do not fit


def select_roles(topics: Sequence[TopicInfo], config: TopicsConfig) -> Selection:
    """Find a topic for each role.

    Args:
        topics: all topics; those without messages are no candidates.
        config: topics given by the user; they win, and "none" switches a role off.
    """
    notes: list[str] = []
    roles, problems = _given_roles(topics, config)
    filled = [topic for topic in topics if topic.count > 0]
    for role in sorted(role_names(), key=_by_dependence):
        if config.given(role) is not None:
            continue
        candidates = [topic.name for topic in filled if _fits(role, topic) and topic.name not in roles.values()]
        chosen, why = _choose(role, candidates, roles.get("image"))
        if chosen is not None:
            roles[role] = chosen
            if why:
                notes.append(f"{chosen} is taken as {role}: {why}.")
        elif candidates and role not in BUILT_IN_ROLES:  # nobody may have asked for the sensor
            notes.append(
                f"No {role}: {', '.join(candidates)} could be it; choose one with recording.topics.{role}, or none."
            )
        elif candidates:
            problems.append(
                f"{len(candidates)} topics could be the {role}: {', '.join(candidates)}; choose one in the "
                f"configuration (recording.topics.{role}: {candidates[0]}), or none (recording.topics.{role}: none)"
            )
        else:
            notes.append(_unnamed(role, filled))
    notes.append(_one_of_images_and_sightings(roles, config))
    notes += [_empty(role, topics) for role in role_names() if role not in roles and config.given(role) is None]
    return Selection(roles, tuple(note for note in notes if note), tuple(problems))


def _given_roles(topics: Sequence[TopicInfo], config: TopicsConfig) -> tuple[dict[Role, str], list[str]]:
    """Roles that the user gave, and what is wrong with them."""
    roles: dict[Role, str] = {}
    problems: list[str] = []
    for role in role_names():
        given = config.given(role)
        if given is None or given == "none":
            continue
        if problem := _misfit(role, given, topics):
            problems.append(problem)
        elif given in roles.values():
            problems.append(f"recording.topics.{role}: {given} is given for another role too; choose one of them")
        else:
            roles[role] = given
    return roles, problems


def _unnamed(role: Role, filled: Iterable[TopicInfo]) -> str:
    """That topics would fit by type but not by name; empty if there is none, or the role is not told by names."""
    if role not in ("image", "truth"):
        return ""
    fitting = converters_of(role).keys() - converters_of("odometry").keys()
    by_type = [topic.name for topic in filled if topic.message_type in fitting]
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
    """What a topic without messages, for a role that no other plays, is the trace of; empty if there is none."""
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
    return {"truth": 0, "camera_info": 2}.get(role, 1)


def _fits(role: Role, topic: TopicInfo) -> bool:
    if topic.message_type not in converters_of(role):
        return False
    if role == "truth":
        odometry = topic.message_type in converters_of("odometry")
        return _says_truth(topic.name) or not (odometry or _NOT_TRUTH.search(topic.name))
    if role == "odometry":
        return not _says_truth(topic.name)
    if role in ("image", "camera_info"):
        return not _NOT_IMAGE.search(topic.name)
    return True


def _choose(role: Role, candidates: list[str], image: str | None) -> tuple[str | None, str]:
    """The candidate to take, or None; and why, where that needs saying."""
    if role == "camera_info" and image is not None:
        siblings = [name for name in candidates if _camera(name) == _camera(image)]
        if siblings:
            candidates = siblings
    if role == "truth" and (named := [name for name in candidates if _says_truth(name)]):
        others = [name for name in candidates if name not in named]
        if len(named) == 1:
            return named[0], f"its name says so, unlike {', '.join(others)}" if others else ""
        return None, ""
    if role == "image" and len(pair := candidates) == 2 and len({_camera(name) for name in pair}) == 1:
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
    """What is wrong with a configured topic; empty if nothing."""
    types = converters_of(role)
    found = next((topic for topic in topics if topic.name == given), None)
    fitting = [topic.name for topic in topics if topic.message_type in types and topic.count > 0]
    remedy = f"choose {' or '.join(fitting)}" if fitting else f"the recording has no topic for the {role}: use none"
    if found is None:
        return f"recording.topics.{role}: {given} is not in the recording; {remedy}"
    if found.message_type not in types:
        expected = " or ".join(types)
        return f"recording.topics.{role}: {given} is a {found.message_type}, expected {expected}; {remedy}"
    if found.count == 0:
        return f"recording.topics.{role}: {given} has no messages; {remedy}"
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


def _camera(topic: str) -> str:
    """Namespace of a camera: the folder of its image or CameraInfo."""
    return topic.removesuffix("/compressed").rpartition("/")[0]
