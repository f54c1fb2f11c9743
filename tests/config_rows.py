"""The tables of docs/configuration.md and docs/identification.md, from the models of what they describe.

`python tests/config_rows.py` rewrites them, and with them the JSON schemas of docs/schema/.
"""

import itertools
import typing
from pathlib import Path

import schema_files
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from fgloc.config import CameraConfig, robot_file
from fgloc.files.settings import level_of
from fgloc_training.config import TrainConfig

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = {"configuration.md": robot_file(), "identification.md": TrainConfig}
_OWN_TABLE = (CameraConfig,)
_EXPERT = "expert."
_OF_KINDS = "`kind` names the drive, the other keys describe it."
_OF_EXPERTS = "## Values that few users change\n"


def sections(model=PAGES["configuration.md"], path=""):
    """Dotted name and model of every section, outermost first."""
    for name, field in model.model_fields.items():
        if (kind := _section(field)) is not None:
            yield f"{path}{name}", kind
            yield from sections(kind, f"{path}{name}.")
        if typing.get_origin(field.annotation) is dict:
            kind = typing.get_args(field.annotation)[1]
            if isinstance(kind, type) and issubclass(kind, BaseModel):
                yield f"{path}{name}.NAME", kind
        if kinds := tuple(_kinds(field)):
            yield f"{path}{name}", kinds


def rows(section):
    """One line of a Markdown table per value of a section, or of one of several kinds.

    Neighbouring keys with the same default and meaning share a line. Keys of a parent class that has a table of its own
    stand there alone.
    """
    if isinstance(section, tuple):
        yield from _rows_of_kinds(section)
        return
    parents = [base.model_fields.items() for base in section.__mro__[1:] if base in _OWN_TABLE]
    elsewhere = {key for fields in parents for key, field in fields if level_of(field) != "constant"}
    told = [
        (name, (_default(field.default), _meaning(field)))
        for name, field in section.model_fields.items()
        if _section(field) is None and name not in elsewhere
    ]
    for (default, meaning), alike in itertools.groupby(told, key=lambda row: row[1]):
        yield f"| {', '.join(f'`{name}`' for name, _ in alike)} | {default} | {meaning} |"


def _rows_of_kinds(kinds):
    """One line per key, default and meaning, with the kinds that have it."""
    found = {}
    for kind in kinds:
        for name, field in kind.model_fields.items():
            if name != "kind":
                row = name, _default(field.default), _meaning(field)
                found.setdefault(row, []).append(kind.model_fields["kind"].default)
    for (name, default, meaning), having in sorted(found.items(), key=lambda item: -len(item[1])):
        of = "all" if len(having) == len(kinds) else ", ".join(having)
        yield f"| `{name}` | {of} | {default} | {meaning} |"


def _meaning(field):
    return (field.description or "").replace("|", "/")


def _section(field):
    """The model of a field that is a section, also of one that may be left out; None: it is a value."""
    kinds = [kind for kind in typing.get_args(field.annotation) if kind is not type(None)] or [field.annotation]
    kind = kinds[0]
    return kind if len(kinds) == 1 and isinstance(kind, type) and issubclass(kind, BaseModel) else None


def _kinds(field):
    """The models of a field that is one of several sections, by its kind."""
    for part in typing.get_args(field.annotation):
        if typing.get_origin(part) is typing.Annotated:
            yield from typing.get_args(typing.get_args(part)[0])


def _default(value):
    if value is PydanticUndefined:
        return "needed"
    if value is None:
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{list(value) if isinstance(value, tuple) else value}`"


def tables(model=PAGES["configuration.md"]):
    """All tables, as they stand in the document: values outside every section, users' sections, experts' sections."""
    parts = []
    for name, section in (("top level", model), *sections(model)):
        if lines := list(rows(section)):
            about, columns = _OF_KINDS, "| key | kinds | default | meaning |\n|---|---|---|---|"
            if not isinstance(section, tuple):
                about, columns = section.__doc__.strip().splitlines()[0], "| key | default | meaning |\n|---|---|---|"
            if name.startswith(_EXPERT) and not any(part.startswith(_OF_EXPERTS) for part in parts):
                parts.append(_OF_EXPERTS)
            known = name.startswith(_EXPERT) and any(f"\n\n{about}\n\n" in part for part in parts)
            parts.append("\n".join([f"### {name}\n", *([] if known else [f"{about}\n"]), columns, *lines]) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    for page, described in PAGES.items():
        start = (DOCS / page).read_text(encoding="utf-8").partition("\n### ")[0]
        (DOCS / page).write_text(f"{start}\n{tables(described)}", encoding="utf-8")
    schema_files.write()
