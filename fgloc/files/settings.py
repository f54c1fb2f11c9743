"""Settings from YAML into pydantic models; a wrong value is named with file, line, key and the likeliest correction."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, to_jsonable_python

from fgloc.errors import ConfigError
from fgloc.files.documents import plain, read_document

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


# --- Who sets a value: a user, an expert, or nobody -------------------------------------------------------------------

EXPERT = "expert"
"""Section of a settings file with the values that few users change, in sections of the same names."""

Level = Literal["user", "expert", "constant"]


def expert(default: Any, **rest: Any) -> Any:
    """Field of a `Section` that a settings file has under ``expert:``."""
    return Field(default, json_schema_extra={"level": "expert"}, **rest)


def constant(value: Any, reason: str, **rest: Any) -> Any:
    """Field of a `Section` that no settings file has; Python code may give it another value.

    Args:
        value: of the constant.
        reason: why it is so, in a few words; shown to whoever sets it.
        rest: as of pydantic's ``Field``.
    """
    return Field(value, json_schema_extra={"level": "constant", "reason": reason}, **rest)


def level_of(field: FieldInfo) -> Level:
    """Who sets a value that is no section."""
    extra = field.json_schema_extra
    return extra.get("level", "user") if isinstance(extra, dict) else "user"  # type: ignore[return-value]


def section_of(field: FieldInfo) -> type[Section] | None:
    """Model of a field that is a section; None: it is a value."""
    kind = field.annotation
    return kind if isinstance(kind, type) and issubclass(kind, Section) else None


@cache
def file_type(model: type[Section]) -> type[Section]:
    """Model of a settings file: the values of users, and under ``expert`` those of experts.

    Args:
        model: with all values, as the code reads them.
    """
    users, experts = _part(model, "user"), _part(model, "expert")
    if experts is None:
        return model
    experts.__doc__ = "Values that few users change, in sections of the same names."
    fields: dict[str, Any] = {EXPERT: (experts, experts())}
    return _made(model, users or Section, fields)


def _made(model: type[Section], base: type[Section], fields: dict[str, Any]) -> type[Section]:
    made: Any = create_model(model.__name__, __base__=base, __doc__=model.__doc__, **fields)
    return made


def _part(model: type[Section], level: Level) -> type[Section] | None:
    """The model with its values of one level alone; None: it has none."""
    fields: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        if (inner := section_of(field)) is not None:
            if (part := _part(inner, level)) is not None:
                fields[name] = (part, part())
        elif level_of(field) == level:
            fields[name] = (field.annotation, field)
    if len(fields) == len(model.model_fields) and all(
        section_of(field) in (None, fields[name][0]) for name, field in model.model_fields.items()
    ):
        return model
    return _made(model, Section, fields) if fields else None


def joined(content: Any) -> Any:
    """Content of a settings file with the values under ``expert`` in the sections that they belong to."""
    if not isinstance(content, Mapping):
        return content
    return merged({key: value for key, value in content.items() if key != EXPERT}, content.get(EXPERT) or {})


def merged(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Values of ``base`` with those of ``change`` in their places, also within sections."""
    out = dict(base)
    for key, value in change.items():
        old = out.get(key)
        out[key] = merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def parted(content: Mapping[str, Any], model: type[Section]) -> dict[str, Any]:
    """Values of a model as a settings file has them, without constants: the inverse of `joined`."""
    users, experts = _of_level(content, model, "user"), _of_level(content, model, "expert")
    return users | {EXPERT: experts} if experts else users


def _of_level(content: Mapping[str, Any], model: type[Section], level: Level) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in content.items():
        field = model.model_fields.get(key)
        if field is None:
            out |= {key: value} if level == "user" else {}
        elif (inner := section_of(field)) is not None:
            if part := _of_level(value, inner, level):
                out[key] = part
        elif level_of(field) == level:
            out[key] = value
    return out


def key_in_file(key: str, model: type[Section]) -> str:
    """Place of a value in a settings file: ``expert.wheels.delay_s`` for ``wheels.delay_s``.

    Args:
        key: of the value, or of a section whose values are all of one level.
        model: with all values.
    """
    *outer, last = key.split(".")
    inner = model
    for part in outer:
        section = section_of(inner.model_fields[part])
        if section is None:  # one of several sections, such as a drive or a camera, whose keys are all the user's
            return key
        inner = section
    field = inner.model_fields[last]
    while (section := section_of(field)) is not None:  # of a section the first value
        field = next(iter(section.model_fields.values()))
    return f"{EXPERT}.{key}" if level_of(field) == "expert" else key


def refuse_misplaced(content: Any, model: type[Section], where: Callable[[Sequence[str]], str] = lambda _: "") -> None:
    """Refuse values of a settings file that belong elsewhere in it, or that are constants.

    Args:
        content: of the file.
        model: with all values.
        where: what a line of the message begins with, by the place of its key.

    Raises:
        ConfigError: there are some; the message has the lines that replace them.
    """
    if not isinstance(content, Mapping):
        return
    experts = content.get(EXPERT)
    users = {key: value for key, value in content.items() if key != EXPERT}
    wrong = [*_misplaced(users, model), *_misplaced(experts, model, (EXPERT,))]
    if not wrong:
        return
    moved: dict[str, Any] = {}
    for _, _, value in wrong:
        if value is not None:
            moved = merged(moved, value)
    lines = [f"{where(loc)}{sentence}" for loc, sentence, _ in wrong]
    if len(lines) > 1:
        lines = [f"{len(lines)} settings are elsewhere now, or none any more", *(f"  {line}" for line in lines)]
    if moved:
        block = yaml.safe_dump(to_jsonable_python(moved), sort_keys=False, default_flow_style=None, width=110)
        lines[-1] += "; write"
        lines.append(block.rstrip())
    raise ConfigError("\n".join(lines))


def _misplaced(
    content: Any, model: type[Section], loc: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], str, dict[str, Any] | None]]:
    """Place, complaint and replacement of each value that is not where a settings file has it."""
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        field, place = model.model_fields.get(key), (*loc, str(key))
        if field is None:
            continue
        if (inner := section_of(field)) is not None:
            yield from _misplaced(value, inner, place)
            continue
        level, name = level_of(field), ".".join(place)
        if level == "constant":
            assert isinstance(field.json_schema_extra, dict)
            is_now = f"{field.default:g}" if isinstance(field.default, float) else str(field.default)
            why = field.json_schema_extra["reason"]
            yield place, f"{name} is no setting any more (it is {is_now}: {why}); remove the line", None
        elif (level == "expert") != (loc[0] == EXPERT if loc else False):
            to = place[1:] if level == "user" else (EXPERT, *place)
            yield place, f"{name} is now {'.'.join(to)}", _nested(to, value)


def _nested(place: Sequence[str], value: Any) -> dict[str, Any]:
    for key in reversed(place):
        value = {key: value}
    return dict(value)


# --- Reading ----------------------------------------------------------------------------------------------------------

MAX_BYTES = 1_000_000  # of a settings file; PyYAML takes 6 s for it
_MOST_SHOWN = 20  # wrong values
_LONGEST = 80  # characters of a wrong value that are shown
_EXPECTED = {  # by the kind of error
    "bool_parsing": "expected true or false",
    "float_parsing": "expected a number alone, its unit is in the documentation",
    "int_parsing": "expected a whole number",
    "model_type": "expected keys with values",
    "model_attributes_type": "expected keys with values",
    "dict_type": "expected keys with values",
    "path_type": "expected the name of a file",
}
_OF_LISTS = ("tuple_type", "list_type", "set_type", "frozen_set_type", "too_short", "too_long")

M = TypeVar("M", bound=BaseModel)
S = TypeVar("S", bound=Section)


class Settings:
    """A settings file: its content, and the lines of its keys."""

    def __init__(self, path: Path, remedy: str) -> None:
        """Read it.

        Raises:
            ConfigError: it is missing, not YAML, hostile, or not keys with values.
        """
        self.path = path
        self._item = read_document(path, ConfigError, MAX_BYTES, remedy, empty="{}")
        try:
            content = plain(self._item.node)
        except yaml.MarkedYAMLError as error:
            line = error.problem_mark.line + 1 if error.problem_mark is not None else 1
            raise ConfigError(f"{path}:{line}: {error.problem}") from error
        content = {} if content is None else content
        if not isinstance(content, dict):
            raise ConfigError(f"{path}:{self._item.line}: expected keys with values, got {short(content)}; {remedy}")
        self.content: dict[str, Any] = content

    def validated_in_parts(self, model: type[S]) -> S:
        """The content as a model some of whose values are under ``expert`` in the file, and some are constants.

        Raises:
            ConfigError: a key is unknown, misplaced or a constant, or a value is wrong; all are named.
        """
        refuse_misplaced(self.content, model, lambda loc: f"{self.path}:{self._line(loc)}: ")
        self.validated(file_type(model))
        self.content = joined(self.content)
        return self.validated(model)

    def validated(self, model: type[M]) -> M:
        """The content as a model.

        Raises:
            ConfigError: a key is unknown or a value is wrong; all are named.
        """
        try:
            return model.model_validate(self.content)
        except ValidationError as error:
            found = _complaints(error, model, self.content)
            wrong = sorted((self._line(loc), text) for loc, text in found[:_MOST_SHOWN])
            lines = [f"{self.path}:{line}: {text}" for line, text in wrong]
            if len(found) > 1:
                lines = [f"{self.path}: {len(found)} wrong values", *(f"  {line}" for line in lines)]
            raise ConfigError("\n".join(lines)) from error

    def _line(self, loc: Sequence[int | str]) -> int:
        """Line of a value, or of the innermost thing around it that there is."""
        node, line = self._item.node, 1
        for part in loc:
            if isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
                node = node.value[part]
                line = node.start_mark.line + 1
            elif isinstance(node, yaml.MappingNode):
                found = next(((k, v) for k, v in node.value if str(k.value) == str(part)), None)
                if found is not None:  # else a kind in a union, or a key that is missing
                    line, node = found[0].start_mark.line + 1, found[1]
        return line


def sentences(error: ValidationError, model: type[BaseModel], content: Any = None) -> list[str]:
    """One sentence for each wrong value (the first ones of many): key, reason, value, likely correction.

    Args:
        error: of the validation.
        model: that was to be made.
        content: of the file, as it was validated: keys are named as they stand there; None: it is not known.
    """
    return [text for _, text in _complaints(error, model, content)[:_MOST_SHOWN]]


def _complaints(
    error: ValidationError, model: type[BaseModel], content: Any
) -> list[tuple[tuple[int | str, ...], str]]:
    """Place and sentence of each wrong value; of a value that may be of several kinds, one sentence for all of them."""
    schema: dict[str, Any] = {}
    reasons: dict[tuple[int | str, ...], tuple[list[str], object]] = {}
    for e in _own(error):
        loc = e["loc"] if content is None else _in_file(e["loc"], content)
        if not schema and e["type"] in ("extra_forbidden", *_OF_LISTS):  # it takes long to make
            schema = model.model_json_schema()
        if e["type"] == "extra_forbidden":
            reason = f"unknown key{_meant(str(loc[-1]), _keys(schema, e['loc'][:-1]))}"
        elif e["type"] in _OF_LISTS:
            reason = _list_wanted(_places(schema, e["loc"]), schema)
        else:
            reason = _complaint(e)
        whole = e["type"] in ("missing", "union_tag_invalid") or (
            e["type"] == "value_error" and isinstance(e["input"], dict)
        )
        several, _ = reasons.setdefault(loc, ([], _NOTHING if whole else e["input"]))
        several.append(reason)
    found = []
    for loc, (several, value) in reasons.items():
        first, *others = dict.fromkeys(several)
        text = " or ".join([first, *(other.removeprefix("expected ") for other in others)])
        where = ".".join(map(str, loc)) or "file"
        found.append((loc, f"{where}: {text}{'' if value is _NOTHING else f' (got {short(value)})'}"))
    return found


_NOTHING = object()


def _in_file(loc: Sequence[int | str], content: Any) -> tuple[int | str, ...]:
    """Keys and indices of a place as they stand in a file, without the kinds of value that pydantic tried."""
    found: list[int | str] = []
    for k, part in enumerate(loc):
        if isinstance(content, Mapping):
            key = next((key for key in content if str(key) == str(part)), None)
            if key is not None:
                found.append(part)
                content = content[key]
            elif k == len(loc) - 1 and str(part).isidentifier():  # a key that is missing
                found.append(part)
        elif isinstance(content, (list, tuple)) and isinstance(part, int):
            found.append(part)
            content = content[part] if part < len(content) else None
    return tuple(found)


def _list_wanted(places: Sequence[Any], schema: Mapping[str, Any]) -> str:
    """Sentence on the list that a schema has at a place: its length, what is in it, and its description."""
    described = next((place["description"] for place in places if "description" in place), "")
    for place in _resolved(places, schema):
        if "prefixItems" in place:
            kinds = {inner.get("type") for inner in _resolved(place["prefixItems"], schema)}
            things = "numbers" if kinds <= {"number", "integer"} else "values"
            told = f"expected a list of {len(place['prefixItems'])} {things}"
            return f"{told}, {described.partition('; None')[0]}" if described else told
        if least := place.get("minItems", 0):
            return (
                f"expected a list of {least} to {place['maxItems']}"
                if "maxItems" in place
                else (f"expected a list of {least} or more")
            )
    return "expected a list"


def _own(error: ValidationError) -> list[ErrorDetails]:
    """The errors; one, of the list, for the numbers that are missing at its end.

    A list which is too short only because what it holds is wrong is none.
    """
    found = error.errors()
    own: list[ErrorDetails] = []
    for e in found:
        if e["type"] == "too_short" and any(_is_within(o["loc"], e["loc"]) for o in found):
            continue
        if e["type"] == "missing" and isinstance(e["loc"][-1], int):
            e = ErrorDetails(type="too_short", loc=e["loc"][:-1], msg=e["msg"], input=e["input"])
            if e in own:
                continue
        own.append(e)
    return own


def _is_within(inner: Sequence[int | str], outer: Sequence[int | str]) -> bool:
    return len(inner) > len(outer) and tuple(inner[: len(outer)]) == tuple(outer)


def _meant(word: str, known: Sequence[str]) -> str:
    """The known word that is most like another one, as the end of a complaint."""
    near = get_close_matches(word, known, n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def _complaint(e: ErrorDetails) -> str:
    """Reason why a value is refused, in words that do not depend on pydantic, without the value."""
    kind, value, context = e["type"], e["input"], e.get("ctx", {})
    if kind == "missing":
        return "is missing"
    if kind == "union_tag_invalid":
        known = re.findall(r"'([^']*)'", context["expected_tags"])
        hint = _meant(context["tag"], known) or f"; known are {', '.join(known)}"
        return f"there is no {context['discriminator'].strip(chr(39))} '{context['tag']}'{hint}"
    if kind == "union_tag_not_found":
        return f"{context['discriminator'].strip(chr(39))} is missing"
    if kind == "literal_error":
        hint = _meant(str(value), re.findall(r"'([^']*)'", context["expected"]))
        return f"expected {context['expected']}{hint}"
    text = _EXPECTED.get(kind) or e["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    return text.replace("Input should be", "expected").replace("a valid ", "a ")


def short(value: object) -> str:
    """A value for a message, not longer than it can be read."""
    if isinstance(value, int) and value.bit_length() > 200:
        return "a huge integer"
    said = repr(value)
    return said if len(said) <= _LONGEST else said[:_LONGEST] + " ..."


def _keys(schema: Mapping[str, Any], loc: Sequence[int | str]) -> list[str]:
    """Keys that a model knows at a place."""
    return [key for place in _resolved(_places(schema, loc), schema) for key in place.get("properties", {})]


def _places(schema: Mapping[str, Any], loc: Sequence[int | str]) -> list[Any]:
    """Schemas of a place, not resolved; a part that none of them knows is a kind of value that pydantic tried."""
    places: list[Any] = [schema]
    for part in loc:
        inner: list[Any] = []
        for place in _resolved(places, schema):
            mapping = place.get("discriminator", {}).get("mapping", {})
            if part in mapping:
                inner.append({"$ref": mapping[part]})
            elif isinstance(part, int) and ("items" in place or "prefixItems" in place):
                inner += [place["items"]] if "items" in place else place["prefixItems"]
            elif part in place.get("properties", {}):
                inner.append(place["properties"][part])
            else:
                any_key = [place.get("additionalProperties"), *place.get("patternProperties", {}).values()]
                inner += [values for values in any_key if isinstance(values, dict)]
        places = inner or places
    return places


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
