"""JSON schemas for editors, from the models; `python tests/schema_files.py` rewrites docs/schema/."""

import json
from pathlib import Path

from fgloc.ablation.suite import Suite
from fgloc.config import robot_file

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "schema"
MODELS = {"robot.schema.json": robot_file(), "suite.schema.json": Suite}


def schema(name):
    """The text of a schema."""
    content = {"$schema": "https://json-schema.org/draft/2020-12/schema", **MODELS[name].model_json_schema()}
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def write():
    """Rewrite all."""
    FOLDER.mkdir(exist_ok=True)
    for name in MODELS:
        (FOLDER / name).write_text(schema(name), encoding="utf-8")


if __name__ == "__main__":
    write()
