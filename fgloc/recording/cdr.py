"""Messages as ROS 2 puts them on the wire (CDR): decoded, encoded, converted from ROS 1; layouts of their types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from fgloc.errors import RecordingError
from fgloc.recording.definitions import Decoder
from fgloc.recording.messages import default_typestore
from fgloc.recording.storage import Channel

_HEADER = "std_msgs/msg/Header"
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}  # ROS 1 types that ROS 2 has, alike, under another name
_ROS1_NAMES = {ros2: ros1 for ros1, ros2 in _RENAMED.items()}
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
        self._ros1 = ros1

    @classmethod
    def of_channel(cls, channel: Channel, ros1: bool) -> Messages:
        """With the definitions that a recording embeds for one of its channels; those of ROS 1 as ROS 2 has them."""
        store = Decoder(ros1, [(channel.message_type, channel.definition)]).store
        if ros1 and _HEADER in store.fielddefs:
            constants, fields = store.fielddefs[_HEADER]
            header = {_HEADER: (constants, [field for field in fields if field[0] != "seq"])}
            definitions = {**store.fielddefs, **header}
            store = get_typestore(Stores.EMPTY)
            store.register(definitions)
        return cls(store, ros1)

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
        fields = [_field(name, description) for name, description in self._store.fielddefs[message_type][1]]
        if unknown := values.keys() - {field.name for field in fields}:
            raise KeyError(f"{message_type} has no {', '.join(sorted(unknown))}")
        return self._store.types[message_type](**{field.name: self._value(field, values) for field in fields})

    def _value(self, field: FieldLayout, values: Mapping[str, Any]) -> Any:
        given = values.get(field.name)
        if field.array is None and field.sequence is None:
            if field.nested:
                return self._build(field.element, given or {})
            if given is not None:
                return given
            return "" if field.element == "string" else np.zeros(1, _dtype(field.element))[0].item()
        items: Sequence[Any] = given if given is not None else ()
        if field.nested:
            return [self._build(field.element, item) for item in items]
        if field.element == "string":
            return list(items)
        return np.asarray(items if given is not None else np.zeros(field.array or 0), dtype=_dtype(field.element))


def ros2_type(message_type: str) -> str:
    """What ROS 2 calls a recorded message type."""
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
