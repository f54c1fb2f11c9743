"""DDS types of ROS messages, built from their definitions; rosbags (de)serializes what goes through them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from fgloc.errors import WireError
from fgloc.live.wire.names import dds_type
from fgloc.recording.messages import FieldLayout


def cdr_type(message_type: str, layout: Mapping[str, Sequence[FieldLayout]]) -> type[Any]:
    """A topic type of cyclonedds whose samples are made of, and hold, a message's CDR as ``cdr``.

    DDS gets the true type, so that others can check against it what they exchange with us, and damaged samples are
    dropped on arrival; cyclonedds' own (de)serialization in Python, which is slow, is left out.

    Args:
        message_type: "pkg/msg/Name".
        layout: fields of it and of all the types inside it, by type.

    Raises:
        WireError: a field is of a kind that DDS lacks.
    """
    made: dict[str, type[Any]] = {}
    kind = _struct(message_type, layout, made)

    def init(self: Any, cdr: bytes) -> None:
        self.cdr = cdr

    def serialize(self: Any, buffer: Any = None, endianness: Any = None, use_version_2: bool | None = None) -> bytes:
        return bytes(self.cdr)

    def deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
        return cls(data)

    kind.__init__ = init
    kind.serialize = serialize
    kind.deserialize = kind.deserialize_key = classmethod(deserialize)  # a key comes alone when a writer leaves
    return kind


def _struct(name: str, layout: Mapping[str, Sequence[FieldLayout]], made: dict[str, type[Any]]) -> type[Any]:
    from cyclonedds.idl import make_idl_struct

    if name not in made:
        fields = {field.name: _field(field, layout, made) for field in layout[name]}
        typename = dds_type(name).replace("::", ".")  # cyclonedds' spelling
        made[name] = make_idl_struct(name.rsplit("/", 1)[-1] + "_", typename, fields)
    return made[name]


def _field(field: FieldLayout, layout: Mapping[str, Sequence[FieldLayout]], made: dict[str, type[Any]]) -> Any:
    from cyclonedds.idl import types

    plain = {"string": str, "bool": bool, "char": types.uint8}
    inner: Any
    if field.nested:
        inner = _struct(field.element, layout, made)
    else:
        inner = plain.get(field.element) or getattr(types, field.element, None)
        if inner is None:
            raise WireError(f"field {field.name} is a {field.element}, which cannot be put on the wire; leave it out")
    if field.array is not None:
        return types.array[inner, field.array]
    if field.sequence is not None:
        return types.sequence[inner]  # bounds do not change the CDR
    return inner
