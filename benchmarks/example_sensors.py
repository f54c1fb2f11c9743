"""The sensors of ``examples/``, found as those of an installed package are, without installing anything."""

from __future__ import annotations

import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fgloc.extensions import GROUP, outside_sensors

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def write_metadata(folder: Path) -> None:
    """Write the metadata of the examples' package as pip does: name, version and entry points of its pyproject.toml."""
    project = tomllib.loads((EXAMPLES / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = "".join(f"{name} = {value}\n" for name, value in project["entry-points"][GROUP].items())
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}")


@contextmanager
def example_sensors() -> Iterator[tuple[Path, Path]]:
    """While inside, fgloc finds them; the two folders are those to put on PYTHONPATH for another process."""
    with tempfile.TemporaryDirectory(prefix="fgloc-sensors-") as name:
        folders = Path(name), EXAMPLES
        write_metadata(folders[0])
        sys.path.extend(map(str, folders))
        outside_sensors.cache_clear()
        try:
            yield folders
        finally:
            for folder in folders:
                sys.path.remove(str(folder))
            outside_sensors.cache_clear()
