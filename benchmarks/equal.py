"""Whether the bundled samples give the results of the committed file, bit by bit: `make equal`, around a refactoring.

One line a sample and mode: a hash of poses, covariances and counts. Another processor may round differently: write the
file anew there (`python -m benchmarks.equal --write`), from the commit that the change starts from.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from fgloc.config import load_config
from fgloc.replay.options import RunMode
from fgloc.runner import run
from fgloc.types import RunResult

SAMPLES = Path(__file__).resolve().parent.parent / "datasets" / "samples"
EXPECTED = Path(__file__).with_suffix(".json")
MODES: tuple[RunMode, ...] = ("online", "batch")


def digest(result: RunResult) -> str:
    """Hash of what a run found: poses, covariances, counts."""
    counts = repr(sorted(result.counts.items())).encode()
    parts = result.trajectory.poses.tobytes() + result.trajectory.covs.tobytes() + counts
    return hashlib.sha256(parts).hexdigest()[:16]


def digests() -> dict[str, str]:
    """``sample.mode`` -> hash, of all bundled samples."""
    found = {}
    for sample in sorted(path.parent for path in SAMPLES.glob("*/robot.yaml")):
        for mode in MODES:
            result = run(sample / "bag", sample / "map.yaml", load_config(sample / "robot.yaml"), mode)
            found[f"{sample.name}.{mode}"] = digest(result)
    return found


def differences() -> list[str]:
    """Samples and modes whose results are not the committed ones."""
    found, expected = digests(), json.loads(EXPECTED.read_text(encoding="utf-8"))
    return [name for name in sorted(found | expected) if found.get(name) != expected.get(name)]


def main(
    write: Annotated[bool, typer.Option("--write", help="Make today's results the expected ones.")] = False,
) -> None:
    """Compare the bundled samples' results with the committed ones; exit code 1 if any differs."""
    found = digests()
    expected = json.loads(EXPECTED.read_text(encoding="utf-8")) if EXPECTED.is_file() else {}
    for name in sorted(found | expected):
        verdict = "equal" if found.get(name) == expected.get(name) else f"DIFFERS (expected {expected.get(name)})"
        print(f"{name:28} {found.get(name)} {verdict}")
    if write:
        EXPECTED.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    elif found != expected:
        sys.exit(1)


if __name__ == "__main__":
    typer.run(main)
