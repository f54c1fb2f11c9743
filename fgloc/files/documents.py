"""YAML and JSON files that a user gives: one reader with bounds, whose values know their line, so that errors name it.

A few lines of aliases can stand for gigabytes, deep nesting exhausts the stack, a pipe never ends, and YAML makes dates
of texts and numbers of thousands of digits: all of it is refused, or read as it was written.
"""

from __future__ import annotations

import math
import os
import re
import stat
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgloc.errors import FglocError
from fgloc.types import FloatArray

_MAX_BYTES = 20_000_000
_MAX_DEPTH = 64
_FREE_VALUES = 100_000  # values that aliases may repeat, beside one for each character of the file
_MAX_DIGITS = 40
_OPENCV, _OPENCV_MATRIX = "%YAML:", "!!opencv-matrix"
_TAG = "tag:yaml.org,2002:"


class Item:
    """A value in a file.

    Its methods raise the error type that the file was read with, naming file and line, if the value is not of the asked
    kind.
    """

    __slots__ = ("_error", "_node", "_path")

    def __init__(self, node: yaml.Node, path: Path, error: type[FglocError]) -> None:
        self._node = node
        self._path = path
        self._error = error

    @property
    def line(self) -> int:
        """Line in the file, from 1."""
        return int(self._node.start_mark.line) + 1

    @property
    def node(self) -> yaml.Node:
        """YAML node of the value."""
        return self._node

    @property
    def is_mapping(self) -> bool:
        """Whether the YAML node is a mapping."""
        return isinstance(self._node, yaml.MappingNode)

    @property
    def is_sequence(self) -> bool:
        """Whether the YAML node is a sequence."""
        return isinstance(self._node, yaml.SequenceNode)

    def fail(self, message: str) -> FglocError:
        """An error that names this place, to be raised."""
        return self._error(f"{self._path}:{self.line}: {message}")

    def pairs(self) -> list[tuple[str, Item]]:
        """Keys and values of a mapping; a key given twice is an error."""
        if not isinstance(self._node, yaml.MappingNode):
            raise self.fail(f"expected keys with values, got {self._shown()}")
        seen: dict[str, int] = {}
        found = []
        for key, value in self._node.value:
            name, line = str(key.value), int(key.start_mark.line) + 1
            if name in seen:
                raise self.fail(f"key '{name}' stands in line {seen[name]} and again in line {line}; keep one")
            seen[name] = line
            found.append((name, Item(value, self._path, self._error)))
        return found

    def get(self, key: str) -> Item | None:
        """Value of a key, None if the key is missing or its value is null."""
        found = dict(self.pairs()).get(key)
        return None if found is None or found._node.tag == "tag:yaml.org,2002:null" else found

    def need(self, key: str) -> Item:
        """Value of a key that has to be there."""
        found = self.get(key)
        if found is None:
            raise self.fail(f"'{key}' is missing; there are: {', '.join(k for k, _ in self.pairs()) or 'no keys'}")
        return found

    def only(self, *keys: str) -> None:
        """Refuse keys other than these."""
        for name, value in self.pairs():
            if name not in keys:
                raise value.fail(f"unknown key '{name}'; known are {', '.join(keys)}")

    def entries(self) -> list[Item]:
        """Values of a list."""
        if not isinstance(self._node, yaml.SequenceNode):
            raise self.fail(f"expected a list, got {self._shown()}")
        return [Item(node, self._path, self._error) for node in self._node.value]

    def text(self) -> str:
        """A scalar, as written."""
        if not isinstance(self._node, yaml.ScalarNode):
            raise self.fail(f"expected one value, got {self._shown()}")
        return str(self._node.value)

    def number(self) -> float:
        """A finite number."""
        try:
            value = float(self.text())
        except ValueError:
            raise self.fail(f"expected a number, got {self._shown()}") from None
        if not math.isfinite(value):
            raise self.fail(f"expected a finite number, got {self._shown()}")
        return value

    def integer(self) -> int:
        """A whole number."""
        value = self.number()
        if value != int(value):
            raise self.fail(f"expected a whole number, got {self._shown()}")
        return int(value)

    def numbers(self, *lengths: int) -> FloatArray:
        """A list of finite numbers, of one of these lengths if any are given."""
        values = np.array([item.number() for item in self.entries()])
        if lengths and len(values) not in lengths:
            raise self.fail(f"expected {' or '.join(map(str, lengths))} numbers, got {len(values)}")
        return values

    def _shown(self) -> str:
        if isinstance(self._node, yaml.ScalarNode):
            return f"'{self._node.value}'"
        return "a list" if self.is_sequence else "keys with values"


class HostileError(yaml.YAMLError):
    """A document that would take much more memory or stack than its size."""


class _Loader(yaml.SafeLoader):
    """Composes nodes, and counts what they stand for once aliases are followed."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._limit = _FREE_VALUES + len(text)
        self._depth = 0
        self._sizes: dict[int, tuple[int, int]] = {}  # of a node: values in it, depth

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        alias = self.check_event(yaml.AliasEvent)
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise HostileError(f"line {mark.line + 1}: nested deeper than {_MAX_DEPTH} levels")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if node is None:
            return node
        if alias and id(node) not in self._sizes:
            raise HostileError(f"line {mark.line + 1}: an alias that stands for what it is part of")
        if not alias:
            self._sizes[id(node)] = self._size(node)
        size, depth = self._sizes[id(node)]
        if size > self._limit or depth + self._depth > _MAX_DEPTH:
            raise HostileError(f"line {mark.line + 1}: aliases stand for more than {self._limit} values")
        return node

    def _size(self, node: yaml.Node) -> tuple[int, int]:
        parts: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            parts = node.value
        elif isinstance(node, yaml.MappingNode):
            parts = [part for pair in node.value for part in pair]
        inner = [self._sizes[id(part)] for part in parts]
        return 1 + sum(size for size, _ in inner), 1 + max((depth for _, depth in inner), default=0)


def parse(text: str, name: str) -> yaml.Node | None:
    """The root of a YAML or JSON text; None if it is empty.

    Raises:
        HostileError: it has deep nesting, or aliases that stand for much more than the text holds.
        yaml.YAMLError: it is not YAML.
    """
    try:
        # JSON is YAML but for tabs, which may indent it.
        loader = _Loader(text.replace("\t", " ") if text.lstrip().startswith(("{", "[")) else text)
        loader.name = name
        node: yaml.Node | None = loader.get_single_node()
    except (RecursionError, ValueError, OverflowError) as cause:
        raise HostileError(f"cannot be parsed: {cause}") from cause
    return node


def plain(node: yaml.Node) -> Any:
    """Values of a node as dict, list, str, int, float, bool and None; a date stays the text that was written.

    Raises:
        yaml.MarkedYAMLError: a key is given twice or is not a word, a number is too long, or a tag is unknown.
    """
    if isinstance(node, yaml.SequenceNode):
        return [plain(part) for part in node.value]
    if isinstance(node, yaml.MappingNode):
        return _mapping(node)
    kind = node.tag.removeprefix(_TAG)
    if kind in ("str", "timestamp"):
        return str(node.value)
    if kind == "null":
        return None
    if kind not in ("bool", "int", "float"):
        raise _wrong(node, f"the tag '{node.tag}' is not known here; write a plain value")
    if kind == "int" and len(node.value) > _MAX_DIGITS:
        raise _wrong(node, f"a number of {len(node.value)} digits; expected at most {_MAX_DIGITS}")
    try:
        constructor = yaml.constructor.SafeConstructor()
        return getattr(constructor, f"construct_yaml_{kind}")(node)
    except (ValueError, KeyError, IndexError, OverflowError) as cause:
        raise _wrong(node, f"'{str(node.value)[:_MAX_DIGITS]}' is not a value of kind {kind}") from cause


def _mapping(node: yaml.MappingNode) -> dict[Any, Any]:
    """Keys and values; those of ``<<`` serve where a key is not given."""
    merged: dict[Any, Any] = {}
    given: dict[Any, Any] = {}
    for key, value in node.value:
        if key.tag == _TAG + "merge":
            for part in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                if not isinstance(part, yaml.MappingNode):
                    raise _wrong(part, "expected keys with values after '<<'")
                merged = plain(part) | merged
            continue
        if not isinstance(key, yaml.ScalarNode):
            raise _wrong(key, "expected a word as key")
        name = plain(key)
        if name in given:
            raise _wrong(key, f"key '{name}' is given twice; keep one")
        given[name] = plain(value)
    return merged | given


def _wrong(node: yaml.Node, message: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(None, None, message, node.start_mark)


def read_text(path: Path, error: type[FglocError], remedy: str, max_bytes: int = _MAX_BYTES) -> str:
    """Read a text file that is one: no folder, pipe or device, and not too large.

    Raises:
        FglocError: of the given type; the path and the reason are named, and the remedy.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(handle, "rb") as file:
            state = os.fstat(handle)
            if not stat.S_ISREG(state.st_mode):
                raise error(f"{path}: not a regular file; {remedy}")
            data = file.read(max_bytes + 1)
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror}); {remedy}") from cause
    except ValueError as cause:  # a NUL in the path
        raise error(f"{str(path)!r}: not a file name; {remedy}") from cause
    if len(data) > max_bytes:
        raise error(f"{path}: {state.st_size} bytes, expected less than {max_bytes}; is it the right file?")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a text file: {cause}") from cause


def nested(text: str, most: int = _MAX_DEPTH) -> bool:
    """Whether brackets are nested deeper than this, as no reader has to bear; those in texts count too."""
    depth = 0
    for bracket in re.findall(r"[\[\]{}]", text):
        depth += 1 if bracket in "[{" else -1
        if depth > most:
            return True
    return False


def check_regular(path: Path, error: type[FglocError], remedy: str, max_bytes: int) -> None:
    """Find out before another reader opens a file whether it is a regular one, and not too large.

    Raises:
        FglocError: of the given type; it is not, or not there.
    """
    try:
        state = path.stat()
    except (OSError, ValueError) as cause:
        raise error(f"{str(path)!r}: cannot be read ({cause}); {remedy}") from cause
    if not stat.S_ISREG(state.st_mode):
        raise error(f"{path}: not a regular file; {remedy}")
    if state.st_size > max_bytes:
        raise error(f"{path}: {state.st_size} bytes, expected less than {max_bytes}; is it the right file?")


def read_document(
    path: Path,
    error: type[FglocError],
    max_bytes: int = _MAX_BYTES,
    remedy: str = "give a YAML or JSON file",
    empty: str = "",
) -> Item:
    """Read a YAML or JSON file, or one that OpenCV wrote: its head and its tags are no YAML, and are left out.

    Args:
        path: the file.
        error: what to raise, here and in the items' methods.
        max_bytes: a larger file is refused.
        remedy: what to do about a file that cannot be read.
        empty: what an empty file stands for; "": it is refused.

    Raises:
        FglocError: of the given type; the file is missing, no regular file, too large, empty, not YAML, or hostile.
    """
    text = read_text(path, error, remedy, max_bytes)
    if text.startswith(_OPENCV) or _OPENCV_MATRIX in text:
        text = text.removeprefix(text.partition("\n")[0] if text.startswith(_OPENCV) else "")
        text = text.replace(_OPENCV_MATRIX, "")
    try:
        node = parse(text, str(path)) or parse(empty, str(path))
    except yaml.YAMLError as cause:
        indented = _indented_by_tab(text, cause)
        hint = f"line {indented} is indented by a tab; YAML takes spaces only" if indented else str(cause)
        raise error(f"{path}: not YAML or JSON: {hint}") from cause
    if node is None:
        raise error(f"{path}: the file is empty")
    return Item(node, path, error)


def _indented_by_tab(text: str, cause: yaml.YAMLError) -> int | None:
    """Number of the line that begins with a tab, where the reader stumbled over it; None: over something else."""
    mark = cause.problem_mark if isinstance(cause, yaml.MarkedYAMLError) else None
    lines = text.splitlines()
    if mark is None or mark.line >= len(lines):
        return None
    line = lines[mark.line]
    return int(mark.line) + 1 if "\t" in line[: len(line) - len(line.lstrip())] else None
