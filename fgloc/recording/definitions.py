"""Message definitions: those that a recording embeds, and the defaults for the rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache
from typing import Any

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from fgloc.recording.definition_limits import MAX_TEXT, DefinitionError, check_sizes, plain_idl
from fgloc.recording.messages import default_typestore


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
