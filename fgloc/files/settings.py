"""Settings from YAML into pydantic models; a wrong value is named with file, line, key and the likeliest correction."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic_core import ErrorDetails

from fgloc.errors import ConfigError
from fgloc.files.documents import Item, plain, read_document

SHIPPED = "shipped:"
"""Begins the name of a file that comes with fgloc."""


class Section(BaseModel):
    """A part of the configuration: unknown keys are errors, numbers are finite, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _of_comments(cls, content: Any) -> Any:
        """A section whose keys are all comments is an empty one; YAML reads it as None."""
        return {} if content is None else content


MAX_BYTES = 1_000_000  # of a settings file; PyYAML takes 6 s for it
_MOST_SHOWN = 20  # wrong values
_LONGEST = 80  # characters of a wrong value that are shown
_EXPECTED = {  # by the kind of error
    "bool_parsing": "expected true or false",
    "float_parsing": "expected a number alone, its unit is in the documentation",
    "int_parsing": "expected a whole number",
    "model_type": "expected keys with values",
    "model_attributes_type": "expected keys with values",
}

M = TypeVar("M", bound=BaseModel)


class Settings:
    """A settings file: its content, and the lines of its keys."""

    def __init__(self, path: Path, remedy: str) -> None:
        """Read it.

        Raises:
            ConfigError: it is missing, not YAML, hostile, or not keys with values.
        """
        self.path = path
        self._item: Item | None = None
        self.content: dict[str, Any] = {}
        try:
            self._item = read_document(path, ConfigError, MAX_BYTES, remedy)
        except ConfigError as error:
            if "the file is empty" in str(error):
                return
            raise
        try:
            content = plain(self._item.node)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark is not None else 1
            raise ConfigError(f"{path}:{line}: {error.problem}") from error
        if content is None:
            content = {}
        if not isinstance(content, dict):
            raise ConfigError(f"{path}:{self._item.line}: expected keys with values, got {short(content)}; {remedy}")
        self.content = content

    def validated(self, model: type[M]) -> M:
        """The content as a model.

        Raises:
            ConfigError: a key is unknown or a value is wrong; all are named.
        """
        try:
            return model.model_validate(self.content)
        except ValidationError as error:
            found = _own(error)
            wrong = sorted(
                (self._line(e["loc"]), text) for e, text in zip(found, sentences(error, model), strict=False)
            )
            lines = [f"{self.path}:{line}: {text}" for line, text in wrong]
            if len(found) > 1:
                lines = [f"{self.path}: {len(found)} wrong values", *(f"  {line}" for line in lines)]
            raise ConfigError("\n".join(lines)) from error

    def _line(self, loc: Sequence[int | str]) -> int:
        """Line of a value, or of the innermost thing around it that there is."""
        node = self._item.node if self._item is not None else None
        line = 1
        for part in loc:
            if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
                line = node.start_mark.line + 1
            elif isinstance(node, yaml.MappingNode):
                found = next(((k, v) for k, v in node.value if str(k.value) == str(part)), None)
                if found is not None:  # else a kind in a union, or a key that is missing
                    line, node = found[0].start_mark.line + 1, found[1]
        return line


def sentences(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """One sentence for each wrong value (the first ones of many): key, reason, value, likely correction."""
    schema: dict[str, Any] | None = None
    found = []
    for e in _own(error)[:_MOST_SHOWN]:
        where = ".".join(str(part) for part in e["loc"]) or "file"
        if e["type"] == "extra_forbidden":
            schema = schema or model.model_json_schema()
            hint = _meant(str(e["loc"][-1]), _keys(schema, e["loc"][:-1]))
            found.append(f"{where}: unknown key{hint} (got {short(e['input'])})")
        else:
            found.append(f"{where}: {_complaint(e)}")
    return found


def _own(error: ValidationError) -> list[ErrorDetails]:
    """The errors, without that of a list which is too short only because what it holds is wrong."""
    found = error.errors()
    return [e for e in found if e["type"] != "too_short" or not any(_is_within(o["loc"], e["loc"]) for o in found)]


def _is_within(inner: Sequence[int | str], outer: Sequence[int | str]) -> bool:
    return len(inner) > len(outer) and tuple(inner[: len(outer)]) == tuple(outer)


def _meant(word: str, known: Sequence[str]) -> str:
    """The known word that is most like another one, as the end of a complaint."""
    near = get_close_matches(word, known, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def _complaint(e: ErrorDetails) -> str:
    """Reason why a value is refused, in words that do not depend on pydantic."""
    kind, value, context = e["type"], e["input"], e.get("ctx", {})
    if kind == "missing":
        return "is missing"
    if kind == "union_tag_invalid":
        known = re.findall(r"'([^']*)'", context["expected_tags"])
        hint = _meant(context["tag"], known) or f"; known are {', '.join(known)}"
        return f"there is no {context['discriminator'].strip(chr(39))} '{context['tag']}'{hint}"
    if kind == "literal_error":
        hint = _meant(str(value), re.findall(r"'([^']*)'", context["expected"]))
        return f"expected {context['expected']}{hint} (got {short(value)})"
    text = _EXPECTED.get(kind) or e["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    text = text.replace("Input should be", "expected").replace("a valid ", "a ")
    return text if kind == "value_error" and isinstance(value, dict) else f"{text} (got {short(value)})"


def short(value: object) -> str:
    """A value for a message, not longer than it can be read."""
    if isinstance(value, int) and value.bit_length() > 200:
        return "a huge integer"
    said = repr(value)
    return said if len(said) <= _LONGEST else said[:_LONGEST] + " ..."


def _keys(schema: Mapping[str, Any], loc: Sequence[int | str]) -> list[str]:
    """Keys that a model knows at a place."""
    places = [schema]
    for part in loc:
        inner: list[Any] = []
        for place in _resolved(places, schema):
            mapping = place.get("discriminator", {}).get("mapping", {})
            if part in mapping:
                inner.append({"$ref": mapping[part]})
            elif isinstance(part, int):
                inner += [place["items"]] if "items" in place else place.get("prefixItems", [])
            elif part in place.get("properties", {}):
                inner.append(place["properties"][part])
            elif isinstance(place.get("additionalProperties"), dict):
                inner.append(place["additionalProperties"])
        places = inner
    return [key for place in _resolved(places, schema) for key in place.get("properties", {})]


def _resolved(places: Sequence[Any], schema: Mapping[str, Any]) -> list[Any]:
    """Schemas with references and alternatives followed."""
    out: list[Any] = []
    queue = list(places)
    while queue and len(out) < 1000:
        place = queue.pop(0)
        if "$ref" in place:
            queue.append(schema.get("$defs", {}).get(place["$ref"].rpartition("/")[2], {}))
            continue
        out.append(place)
        queue += [*place.get("anyOf", ()), *place.get("allOf", ())]
    return out
