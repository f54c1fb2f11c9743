"""Whether the bundled samples give the results of the committed file: `make equal`, around a refactoring.

One line a sample and mode. Results are *equal* bit by bit or, as another processor or another order of sums gives them,
*rounded*: the same counts, and poses and standard deviations within 1e-9 of the committed ones. After a change that is
meant to change them: `python -m benchmarks.equal --write`.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from fgloc.config import load_config
from fgloc.replay import RunMode
from fgloc.runner import RunResult, run
from fgloc.types import FloatArray

SAMPLES = Path(__file__).resolve().parent.parent / "datasets" / "samples"
EXPECTED = Path(__file__).with_suffix(".json")
MODES: tuple[RunMode, ...] = ("online", "batch")
ROUNDING = 1e-9  # m, rad
_EVERY = 10  # keyframes, of which numbers are kept beside the hash


def described(result: RunResult) -> dict[str, Any]:
    """What a run found: a hash of it all, its counts, and pose and sigmas ``(6,)`` of every tenth keyframe."""
    covs = result.trajectory.covs
    counts = {name: int(n) for name, n in sorted(result.counts.items())}
    parts = result.trajectory.poses.tobytes() + covs.tobytes() + repr(list(counts.items())).encode()
    rows = np.hstack([result.trajectory.poses, np.sqrt(np.diagonal(covs, axis1=1, axis2=2))])[::_EVERY]
    return {"hash": hashlib.sha256(parts).hexdigest()[:16], "counts": counts, "rows": np.round(rows, 12).tolist()}


def difference(found: dict[str, Any], expected: dict[str, Any]) -> float:
    """0 if the results are the same bits, else the largest difference [m, rad]; infinite if counts differ."""
    if found["hash"] == expected["hash"]:
        return 0.0
    a: FloatArray = np.array(found["rows"])
    b: FloatArray = np.array(expected["rows"])
    if found["counts"] != expected["counts"] or a.shape != b.shape:
        return float("inf")
    return float(np.abs(a - b).max())


def results() -> dict[str, dict[str, Any]]:
    """``sample.mode`` -> what was found, of all bundled samples."""
    found = {}
    for sample in sorted(path.parent for path in SAMPLES.glob("*/robot.yaml")):
        for mode in MODES:
            result = run(sample / "bag", sample / "map.yaml", load_config(sample / "robot.yaml"), mode)
            found[f"{sample.name}.{mode}"] = described(result)
    return found


def compared() -> tuple[dict[str, dict[str, Any]], dict[str, float]]:
    """What was found, and by how much it differs from the committed results."""
    found = results()
    expected = json.loads(EXPECTED.read_text(encoding="utf-8")) if EXPECTED.is_file() else {}
    names = sorted(found | expected)
    both = {name: name in found and name in expected for name in names}
    return found, {name: difference(found[name], expected[name]) if both[name] else float("inf") for name in names}


def differences() -> list[str]:
    """Samples and modes whose results differ by more than rounding."""
    return [name for name, value in compared()[1].items() if not value <= ROUNDING]


def main(
    write: Annotated[bool, typer.Option("--write", help="Make today's results the expected ones.")] = False,
) -> None:
    """Compare the bundled samples' results with the committed ones; exit code 1 if any differs."""
    found, apart = compared()
    for name, value in apart.items():
        verdict = "equal" if value == 0.0 else f"rounded: {value:.1g}" if value <= ROUNDING else f"DIFFERS: {value:.2g}"
        print(f"{name:28} {found.get(name, {}).get('hash')} {verdict}")
    if write:
        rows = [f" {json.dumps(name)}: {json.dumps(result)}" for name, result in found.items()]
        EXPECTED.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    elif not all(value <= ROUNDING for value in apart.values()):
        sys.exit(1)


if __name__ == "__main__":
    typer.run(main)
