"""Message types: definitions (embedded in a recording, or the defaults), their limits, and (de)serialization.

rosbags writes code for each element of a fixed array of texts or messages (``string[100000000]`` takes 5 GB), and
parses IDL by trying: two nested parentheses take a minute. So a definition is checked before it is used.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fgloc.errors import RecordingError
from fgloc.recording.storage import Channel

# --- Default definitions ----------------------------------------------------------------------------------------------

# Public interface definitions of the packages named in the keys.
_DEFINITIONS = {
    "landmark_msgs/msg/Landmark": (
        "int32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\nfloat32 range\nfloat32 bearing\n"
    ),
    "landmark_msgs/msg/LandmarkArray": "std_msgs/Header header\nlandmark_msgs/Landmark[] landmarks\n",
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n"
    ),
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections\n"
    ),
    "apriltag_msgs/msg/Apriltag": (
        "int32 id\nstring family\nint32 hamming\nint32 border\nint32 bits\n"
        "geometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
    ),
    "apriltag_msgs/msg/ApriltagArrayStamped": "std_msgs/Header header\napriltag_msgs/Apriltag[] apriltags\n",
    "fiducial_msgs/msg/Fiducial": (
        "int32 fiducial_id\nint32 direction\n"
        "float64 x0\nfloat64 y0\nfloat64 x1\nfloat64 y1\nfloat64 x2\nfloat64 y2\nfloat64 x3\nfloat64 y3\n"
    ),
    "fiducial_msgs/msg/FiducialArray": (
        "std_msgs/Header header\nint32 image_seq\nfiducial_msgs/Fiducial[] fiducials\n"
    ),
    "fiducial_msgs/msg/FiducialTransform": (
        "int32 fiducial_id\ngeometry_msgs/Transform transform\n"
        "float64 image_error\nfloat64 object_error\nfloat64 fiducial_area\n"
    ),
    "fiducial_msgs/msg/FiducialTransformArray": (
        "std_msgs/Header header\nint32 image_seq\nfiducial_msgs/FiducialTransform[] transforms\n"
    ),
    "aruco_opencv_msgs/msg/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose\n",
    "aruco_opencv_msgs/msg/BoardPose": "string board_name\ngeometry_msgs/Pose pose\n",
    "aruco_opencv_msgs/msg/ArucoDetection": (
        "std_msgs/Header header\naruco_opencv_msgs/MarkerPose[] markers\naruco_opencv_msgs/BoardPose[] boards\n"
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        "std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses\n"
    ),
    "aruco_msgs/msg/Marker": (
        "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence\n"
    ),
    "aruco_msgs/msg/MarkerArray": "std_msgs/Header header\naruco_msgs/Marker[] markers\n",
    "apriltag_ros/msg/AprilTagDetection": (
        "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose\n"
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections\n"
    ),
    "ar_track_alvar_msgs/msg/AlvarMarker": (
        "std_msgs/Header header\nuint32 id\nuint32 confidence\ngeometry_msgs/PoseStamped pose\n"
    ),
    "ar_track_alvar_msgs/msg/AlvarMarkers": ("std_msgs/Header header\nar_track_alvar_msgs/AlvarMarker[] markers\n"),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
        "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
        "geometry_msgs/PoseWithCovarianceStamped pose\n"
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\nisaac_ros_apriltag_interfaces/AprilTagDetection[] detections\n"
    ),
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}


def default_typestore(ros1: bool = False, distribution: Stores = Stores.ROS2_HUMBLE) -> Typestore:
    """Typestore for bags that carry no definitions: a distribution's (or ROS 1 Noetic's) and the marker packages'."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else distribution)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


# --- Limits of what a definition may ask for --------------------------------------------------------------------------

MAX_TEXT = 1 << 18  # characters of one definition with all that it uses; that of nav_msgs/Odometry has 9000
_MAX_UNROLLED = 1000  # elements of a fixed array of texts or messages; AprilTag has 4 corners
_FREE_VALUES, _VALUES_PER_BYTE = 16, 4
_MAX_NESTED_SEQUENCES = 3
_IDL_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|/\*.*?\*/|//[^\n]*|#[^\n]*|@\w+(?:::\w+)*|.', re.DOTALL)


class DefinitionError(Exception):
    """A definition that is damaged or hostile."""


def plain_idl(text: str) -> str:
    """IDL without comments, includes and annotations, which do not affect the serialization.

    Raises:
        DefinitionError: what is left has parentheses, or sequences nested deeply.
    """
    out: list[str] = []
    depth, annotated, nested = 0, False, 0
    for match in _IDL_TOKEN.finditer(text):
        token = match[0]
        if token.startswith(("/*", "//", "#")):
            out.append(" ")
        elif depth or (annotated and token == "("):
            depth += {"(": 1, ")": -1}.get(token, 0)
            annotated = depth > 0
        elif token.startswith("@"):
            annotated = True
        elif annotated and token.isspace():
            continue
        else:
            annotated = False
            nested += {"<": 1, ">": -1}.get(token, 0)
            if token == "(" or nested > _MAX_NESTED_SEQUENCES:
                raise DefinitionError(f"{token!r} after {''.join(out)[-40:]!r}")
            out.append(token)
    return "".join(out)


def check_sizes(definitions: Typesdict) -> None:
    """Refuse definitions by which a short message stands for many values.

    Raises:
        DefinitionError: one of them does, or contains itself.
    """
    sizes: dict[str, tuple[int, int]] = {}
    for name in definitions:
        _size(name, definitions, sizes, ())


def _size(
    name: str, definitions: Mapping[str, Any], sizes: dict[str, tuple[int, int]], inside: tuple[str, ...]
) -> tuple[int, int]:
    """Values that are made of one message of a type, and the bytes that it takes at least."""
    if name in sizes:
        return sizes[name]
    if name in inside or len(inside) > 50:
        raise DefinitionError(f"{name} contains itself, or is nested too deeply")
    if name not in definitions:
        return 1, 1  # rosbags will miss it
    values, size = 1, 0
    for _, field in definitions[name][1]:
        kind, content = field
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            element, length = content
            each_values, each_size = _field_size(element, definitions, sizes, (*inside, name))
            if kind == Nodetype.SEQUENCE:
                if each_size == 0:
                    raise DefinitionError(f"{name} has a sequence of messages without fields")
                values, size = values + 1, size + 4
                continue
            numbers = element[0] == Nodetype.BASE and element[1][0] != "string"
            if length > _MAX_UNROLLED and not numbers:
                raise DefinitionError(f"{name} has a fixed array of {length}")
            values, size = values + (1 if numbers else length * each_values), size + length * each_size
        else:
            more_values, more_size = _field_size(field, definitions, sizes, (*inside, name))
            values, size = values + more_values, size + more_size
    if values > _FREE_VALUES + _VALUES_PER_BYTE * size:
        raise DefinitionError(f"{name} makes {values} values of {size} bytes")
    sizes[name] = values, size
    return values, size


def _field_size(
    field: Any, definitions: Mapping[str, Any], sizes: dict[str, tuple[int, int]], inside: tuple[str, ...]
) -> tuple[int, int]:
    kind, content = field
    if kind == Nodetype.NAME:
        return _size(content, definitions, sizes, inside)
    name = content[0]
    return 1, 4 if name == "string" else {"16": 2, "32": 4, "64": 8}.get(name[-2:], 1)


# --- Definitions that a recording embeds ------------------------------------------------------------------------------


class Decoder:
    """Deserializes messages of one recording.

    Definitions that the recording embeds win; the defaults serve for the rest.

    Attributes:
        store: rosbags' typestore with the definitions used.
        notes: what the user should know of the definitions used.
    """

    def __init__(self, ros1: bool, definitions: Iterable[tuple[str, MessageDefinition]]) -> None:
        """Build the typestore.

        Args:
            ros1: messages are in ROS 1 serialization, else CDR.
            definitions: message type and embedded definition (format NONE if there is none) of each topic in use.
        """
        embedded: Typesdict = {}
        used, missing, damaged = set(), set(), set()
        seen: set[tuple[str, str]] = set()
        characters = 0
        for message_type, definition in definitions:
            used.add(message_type)
            if definition.format == MessageDefinitionFormat.NONE:
                missing.add(message_type)
                continue
            if (message_type, definition.data) in seen:
                continue
            seen.add((message_type, definition.data))
            try:
                characters += len(definition.data)
                if characters > MAX_TEXT:
                    raise DefinitionError(f"definitions of more than {MAX_TEXT} characters")
                embedded.update(_parse(message_type, definition))
            except Exception:  # the parser leaks what damaged text makes it meet
                damaged.add(message_type)
        self.store = get_typestore(Stores.EMPTY)
        try:
            needed = _needed(used, embedded, ros1)
            check_sizes(needed)
            self.store.register(needed)
        except Exception:  # a definition that parses may still be nonsense
            self.store = get_typestore(Stores.EMPTY)
            self.store.register(_needed(used, {}, ros1))
            damaged |= embedded.keys() & used
        self._deserialize = self.store.deserialize_ros1 if ros1 else self.store.deserialize_cdr
        self._serialize = self.store.serialize_ros1 if ros1 else self.store.serialize_cdr
        self.notes: list[str] = []
        name = "ROS 1 Noetic" if ros1 else "ROS 2 Humble"
        if missing:
            self.notes.append(
                f"The recording holds no definitions of {', '.join(sorted(missing))}: those of {name} are used."
            )
        if damaged:
            self.notes.append(f"Damaged definitions of {', '.join(sorted(damaged))}: those of {name} are used.")

    def deserialize(self, message_type: str, raw: bytes) -> Any:
        """Deserialize. Raises whatever rosbags leaks on damaged bytes."""
        return self._deserialize(raw, message_type)

    def serialize(self, message_type: str, content: Any) -> bytes:
        """Serialize what `deserialize` gave, or a part of it."""
        return bytes(self._serialize(content, message_type))


@cache
def _default_definitions(ros1: bool) -> Typesdict:
    return default_typestore(ros1).fielddefs


def _needed(used: Iterable[str], embedded: Typesdict, ros1: bool) -> Typesdict:
    """The definitions of some types and of all the types inside them: loading hundreds more takes a while.

    The default definitions are loaded only if one is not embedded.
    """
    needed: Typesdict = {}
    queue = list(used)
    while queue:
        name = queue.pop()
        if name in needed:
            continue
        found = embedded.get(name) or _default_definitions(ros1).get(name)
        if found is not None:
            needed[name] = found
            queue += [inner for _, field in found[1] for inner in _names(field)]
    return needed


def _names(field: Any) -> Iterator[str]:
    """Message types that a field's description holds."""
    kind, value = field
    if kind == Nodetype.NAME:
        yield value
    elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        yield from _names(value[0])


def _parse(message_type: str, definition: MessageDefinition) -> Typesdict:
    if definition.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.data, message_type)
    types: Typesdict = {}
    separator = "=" * 80 + "\n"
    for part in definition.data.split(separator):
        text = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if text.strip():
            types.update(get_types_from_idl(plain_idl(text)))
    return types


# --- ROS 2's serialization on the wire (CDR) --------------------------------------------------------------------------

_HEADER = "std_msgs/msg/Header"
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # ROS 1 types that ROS 2 has, alike, under another name
_ROS1_NAMES = {ros2: ros1 for ros1, ros2 in _RENAMED.items()}
_DISTRIBUTIONS = (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_IRON)
_NUMPY = {"byte": "uint8", "char": "uint8", "bool": "bool"}  # the other element types have numpy's names


@dataclass(frozen=True, slots=True)
class FieldLayout:
    """One field of a message type."""

    name: str
    element: str  # "float64", "string", ..., or the name of a message type
    nested: bool  # whether the element is a message
    array: int | None = None  # length of an array
    sequence: int | None = None  # most elements of a sequence, 0 if unbounded


class Messages:
    """Message types and their (de)serialization."""

    def __init__(self, store: Typestore | None = None, ros1: bool = False) -> None:
        """Use the types of a store; None: ROS 2 Humble's and those of the marker packages.

        ``ros1``: `to_cdr` is given messages in ROS 1 serialization.
        """
        self._store = default_typestore() if store is None else store
        self._fields: dict[str, dict[str, tuple[FieldLayout, Any]]] = {}  # with their zeros, by type
        self._ros1 = ros1

    @classmethod
    def of_channel(cls, channel: Channel, ros1: bool) -> Messages:
        """Message types by the definitions that a recording embeds for a channel; those of ROS 1 as ROS 2 has them."""
        store = Decoder(ros1, [(channel.message_type, channel.definition)]).store
        if ros1 and _HEADER in store.fielddefs:
            constants, fields = store.fielddefs[_HEADER]
            header = {_HEADER: (constants, [field for field in fields if field[0] != "seq"])}
            definitions = {**store.fielddefs, **header}
            store = get_typestore(Stores.EMPTY)
            store.register(definitions)
        return cls(store, ros1)

    @classmethod
    def of_hash(cls, message_type: str, type_hash: str) -> Messages | None:
        """Message types of the first distribution whose type has this hash, see `type_hash`; None: no one's has."""
        for distribution in _DISTRIBUTIONS:
            messages = cls(default_typestore(distribution=distribution))
            if messages.type_hash(message_type) == type_hash:
                return messages
        return None

    def type_hash(self, message_type: str) -> str:
        """Hash of a message type as ROS 2 announces it from Iron on (RIHS01, REP 2011); empty: it has none."""
        try:
            return str(self._store.hash_rihs01(message_type))
        except Exception:  # rosbags has no hash of some kinds of fields, and none of unknown types
            return ""

    def layout(self, message_type: str) -> dict[str, tuple[FieldLayout, ...]]:
        """Fields of a message type and of all the types inside it, by type.

        Raises:
            RecordingError: one of the types is not known.
        """
        found: dict[str, tuple[FieldLayout, ...]] = {}
        queue = [message_type]
        while queue:
            name = queue.pop()
            if name in found:
                continue
            known = name if name in self._store.fielddefs else _ROS1_NAMES.get(name, name)
            if known not in self._store.fielddefs:
                raise RecordingError(f"no definition of the message type {name}; record it with its definition")
            found[name] = tuple(_field(field, description) for field, description in self._store.fielddefs[known][1])
            queue += [field.element for field in found[name] if field.nested]
        return found

    def definition(self, message_type: str) -> str:
        """The text of a message type and of all the types inside it, as recordings embed it."""
        return str(self._store.generate_msgdef(message_type, ros_version=2)[0])

    def decode(self, message_type: str, cdr: bytes) -> Any:
        """The message. Raises whatever rosbags leaks on damaged bytes."""
        return self._store.deserialize_cdr(cdr, message_type)

    def encode(self, message_type: str, values: Mapping[str, Any]) -> bytes:
        """CDR of a message; fields that ``values`` lacks are zero or empty, nested messages are mappings themselves.

        Raises:
            KeyError: a value that is no field of the type.
        """
        return bytes(self._store.serialize_cdr(self._build(message_type, values), message_type))

    def to_cdr(self, message_type: str, raw: bytes) -> bytes:
        """CDR of a recorded message. Raises whatever rosbags leaks on damaged bytes."""
        return bytes(self._store.ros1_to_cdr(raw, message_type)) if self._ros1 else raw

    def _build(self, message_type: str, values: Mapping[str, Any]) -> Any:
        fields = self._fields.get(message_type)
        if fields is None:
            described = [_field(name, description) for name, description in self._store.fielddefs[message_type][1]]
            fields = self._fields[message_type] = {field.name: (field, _zero(field)) for field in described}
        if unknown := values.keys() - fields.keys():
            raise KeyError(f"{message_type} has no {', '.join(sorted(unknown))}")
        content = {name: self._value(field, zero, values.get(name)) for name, (field, zero) in fields.items()}
        return self._store.types[message_type](**content)

    def _value(self, field: FieldLayout, zero: Any, given: Any) -> Any:
        if field.array is None and field.sequence is None:
            if field.nested:
                return self._build(field.element, given or {})
            return zero if given is None else given
        if field.nested:
            return [self._build(field.element, item) for item in (() if given is None else given)]
        if field.element == "string":
            return list(() if given is None else given)
        return zero.copy() if given is None else np.asarray(given, dtype=zero.dtype)


def _zero(field: FieldLayout) -> Any:
    """Value of a field that is not given."""
    if field.nested or field.element == "string":
        return ""
    if field.array is not None or field.sequence is not None:
        return np.zeros(field.array or 0, _dtype(field.element))
    return np.zeros(1, _dtype(field.element))[0].item()


def ros2_type(message_type: str) -> str:
    """ROS 2's name of a recorded message type."""
    return _RENAMED.get(message_type, message_type)


def _dtype(element: str) -> str:
    return _NUMPY.get(element, element)


def _field(name: str, description: Any) -> FieldLayout:
    kind, value = description
    if kind == Nodetype.BASE:
        return FieldLayout(name, value[0], False)
    if kind == Nodetype.NAME:
        return FieldLayout(name, value, True)
    inner = _field(name, value[0])
    if kind == Nodetype.ARRAY:
        return FieldLayout(name, inner.element, inner.nested, array=value[1])
    return FieldLayout(name, inner.element, inner.nested, sequence=value[1])
