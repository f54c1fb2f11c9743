"""YAML and JSON files whose values know their line, so that an error can name it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgloc.errors import FglocError
from fgloc.types import FloatArray

_MAX_BYTES = 20_000_000


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
    def is_mapping(self) -> bool:
        """Whether it is keys and values."""
        return isinstance(self._node, yaml.MappingNode)

    @property
    def is_sequence(self) -> bool:
        """Whether it is a list."""
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


class _Loader(yaml.SafeLoader):
    """Refuses aliases: none of our formats needs them, and a few lines of them can expand to gigabytes."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not allowed; write the value out", mark)
        return super().compose_node(parent, index)


def read_document(path: Path, error: type[FglocError]) -> Item:
    """Read a YAML or JSON file.

    Args:
        path: the file.
        error: what to raise, here and in the items' methods.

    Raises:
        FglocError: of the given type; the file is missing, too large, empty, not YAML, or uses aliases.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise error(f"{path}: {path.stat().st_size} bytes, expected less than {_MAX_BYTES}; is it the right file?")
        text = path.read_text(encoding="utf-8")
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror}); give a YAML or JSON file") from cause
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a text file: {cause}") from cause
    try:
        # JSON is YAML but for tabs, which may indent it.
        loader = _Loader(text.replace("\t", " ") if text.lstrip().startswith(("{", "[")) else text)
        loader.name = str(path)
        node = loader.get_single_node()
    except yaml.YAMLError as cause:
        raise error(f"{path}: not YAML or JSON: {cause}") from cause
    except RecursionError as cause:
        raise error(f"{path}: nested too deeply") from cause
    if node is None:
        raise error(f"{path}: the file is empty")
    return Item(node, path, error)
