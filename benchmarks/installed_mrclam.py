"""MRCLAM 6 for `benchmarks.installed`: five real robots, each with the constants and the model of the other four.

``first_pose_s`` is from a robot's first motion (the first command to move) to its first pose. Values are means over the
robots; ``robot3.*`` is of one.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.adaptive_recordings import Split
from benchmarks.adaptive_runs import changed
from benchmarks.common import Row, not_run
from benchmarks.installed_runs import kept
from benchmarks.installed_scores import errors
from fgloc.config import load_config
from fgloc.recording.storage import find_beside
from fgloc.runner import run
from fgloc.types import Estimate, Step, Trajectory
from fgloc_datasets import mrclam

_ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("FGLOC_REAL_DATA", _ROOT.parent / "shared" / "data"))
MODELS = _ROOT / "fgloc" / "sensors" / "learned" / "models" / "mrclam"
_MODES = ("batch", "online")
IDS = (
    "mrclam.first_pose_s",
    *(f"mrclam.{mode}.{figure}" for mode in _MODES for figure in ("ate_mean_m", "nees_over_3")),
    *(f"mrclam.robot{robot}.{mode}.nees_over_3" for robot in mrclam.ROBOTS for mode in _MODES),
)


def measure(quick: bool, split: Split = "test") -> Iterator[Row]:
    """Rows of the benchmark; a quick run takes one robot.

    There is one split, as no robot's settings have seen its own run: ``split`` is not used.
    """
    del split
    source = DATA / "mrclam6"
    if not source.is_dir():
        yield from not_run(IDS, f"no {source}; set FGLOC_REAL_DATA")
        return
    robots = (3,) if quick else mrclam.ROBOTS
    with ProcessPoolExecutor(min(os.cpu_count() or 1, len(robots)), get_context("spawn")) as pool:
        found = dict(zip(robots, pool.map(_robot, robots), strict=True))
    yield from rows(found)


def rows(found: Mapping[int, Mapping[str, float]]) -> Iterator[Row]:
    """Rows of the figures that `localized` gave for each robot."""
    yield _mean("mrclam.first_pose_s", [f["first_pose_s"] for f in found.values()], "s")
    for mode in _MODES:
        yield _mean(f"mrclam.{mode}.ate_mean_m", [f[f"{mode}.ate_mean_m"] for f in found.values()], "m")
        yield _mean(f"mrclam.{mode}.nees_over_3", [f[f"{mode}.nees_over_3"] for f in found.values()])
    for robot in mrclam.ROBOTS:
        for mode in _MODES:
            name = f"mrclam.robot{robot}.{mode}.nees_over_3"
            if robot in found:
                yield Row(name, found[robot][f"{mode}.nees_over_3"])
            else:
                yield from not_run([name], "left out of a quick run")


def _mean(row_id: str, values: Sequence[float], unit: str = "") -> Row:
    return Row(row_id, float(np.mean(values)), float(np.std(values)), len(values), unit)


def _robot(robot: int) -> Mapping[str, Any]:
    return kept(f"mrclam_robot{robot}", lambda: localized(robot))


def localized(robot: int) -> dict[str, float]:
    """Figures of one robot, online and smoothed from the same replay."""
    with tempfile.TemporaryDirectory() as scratch:
        bag = mrclam.convert(DATA / "mrclam6", robot, Path(scratch) / "robot")
        robot_yaml = find_beside(bag, "robot.yaml")
        assert robot_yaml is not None
        model = {"motion": {"model": MODELS / f"without_robot{robot}.safetensors"}}
        config = changed(load_config(robot_yaml), model)
        estimates: list[Estimate] = []
        moved_ns: list[int] = []

        def note(step: Step, estimate: Estimate | None) -> None:
            if not moved_ns:
                moved_ns.extend(c.stamp_ns for c in step.controls if c.v or c.omega)
            if estimate is not None:
                estimates.append(estimate)

        smoothed = run(bag, find_beside(bag, "map.yaml"), config, "batch", on_step=note)
    trajectory = Trajectory(
        np.array([e.stamp_ns for e in estimates], dtype=np.int64),
        np.array([e.pose for e in estimates]),
        np.array([e.cov for e in estimates]),
    )
    told = {"online": replace(smoothed, trajectory=trajectory), "batch": smoothed}
    out = {"first_pose_s": max(estimates[0].stamp_ns - moved_ns[0], 0) * 1e-9}
    for mode, result in told.items():
        found = errors(result, config)
        out |= {f"{mode}.ate_mean_m": 1e-3 * found.ate_mm, f"{mode}.nees_over_3": found.nees_over_3}
    return out
