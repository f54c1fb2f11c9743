"""The tables of docs/configuration.md, from the configuration's models; `python tests/config_rows.py` rewrites them.

With them it rewrites the JSON schemas of docs/schema/.
"""

from pathlib import Path

import schema_files
from pydantic import BaseModel

from fgloc.config import Config


def sections(model=Config, path=""):
    """Dotted name and model of every section, outermost first."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield f"{path}{name}", kind
            yield from sections(kind, f"{path}{name}.")


def rows(model):
    """One line of a Markdown table per value of a section."""
    for name, field in model.model_fields.items():
        if not (isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)):
            yield f"| `{name}` | {_default(field.default)} | {(field.description or '').replace('|', '/')} |"


def _default(value):
    if value is None:
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{list(value) if isinstance(value, tuple) else value}`"


def tables():
    """All tables, as they stand in the document."""
    parts = []
    for name, model in sections():
        if lines := list(rows(model)):
            head = (
                f"### {name}\n\n{model.__doc__.strip().splitlines()[0]}\n\n| key | default | meaning |\n|---|---|---|"
            )
            parts.append("\n".join([head, *lines]) + "\n")
    return "\n".join(parts)


if __name__ == "__main__":
    page = Path(__file__).parent.parent / "docs" / "configuration.md"
    start = page.read_text(encoding="utf-8").partition("\n### ")[0]
    page.write_text(f"{start}\n{tables()}", encoding="utf-8")
    schema_files.write()
