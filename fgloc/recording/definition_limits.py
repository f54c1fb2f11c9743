"""What an embedded message definition may ask for: text that is quick to parse, and values that the message must hold.

rosbags writes code for each element of a fixed array of texts or messages (``string[100000000]`` takes 5 GB), and
parses IDL by trying: two nested parentheses take a minute.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict

MAX_TEXT = 1 << 18  # characters of one definition with all that it uses; that of nav_msgs/Odometry has 9000
_MAX_UNROLLED = 1000  # elements of a fixed array of texts or messages; AprilTag has 4 corners
_FREE_VALUES, _VALUES_PER_BYTE = 16, 4
_MAX_NESTED_SEQUENCES = 3
_IDL_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|/\*.*?\*/|//[^\n]*|#[^\n]*|@\w+(?:::\w+)*|.', re.DOTALL)


class DefinitionError(Exception):
    """A definition that is damaged or hostile."""


def plain_idl(text: str) -> str:
    """IDL without comments, includes and annotations, which tell nothing of the serialization.

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
