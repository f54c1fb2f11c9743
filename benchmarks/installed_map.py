"""Maps for `benchmarks.installed`: surveyed from images, then fed back.

A robot tours a room of 6 m for three minutes; camera, clocks, wheels and gyro are as installed. `fgloc map` is given
the dictionary and size of the markers and nothing else; then `fgloc smooth` takes the file that it wrote.

- ``map.images.rms_mm``, ``.direction_deg``: root mean square over the markers of a run, of their distance from where
  they hang and of the angle by which they are turned, after SE(3) alignment of the places; ``map.images.missing``
  counts the markers that hang there and are not in the map.
- ``map.fed_back.ate_mm``: mean distance from the truth after SE(2) alignment.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import adaptive_recordings
from benchmarks.adaptive_recordings import Split
from benchmarks.common import Row, not_run
from benchmarks.installed_recordings import SEEDS, installed
from benchmarks.installed_runs import kept
from fgloc.calibration.survey import survey
from fgloc.config import Config, load_config
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import match_result
from fgloc.runner import run
from fgloc.sensors.maps import load_map, write_map
from fgloc.types import LandmarkMap
from fgloc_datasets.sim.camera import RenderError
from fgloc_datasets.sim.installed import INSTALLED, load_installed
from fgloc_datasets.sim.scenario import Control, Markers, Scenario, World

TOUR_S = 180.0
VALIDATION = 3  # seeds of the validation split that are used
_TOUR = (
    (-1.8, -1.6), (-0.4, -1.5), (1.0, -1.5), (1.8, -0.5), (1.4, 1.2), (0.2, 1.6), (-0.3, 0.3), (-1.4, -0.2),
    (-1.8, 1.2), (-0.9, 1.7), (0.3, 0.5), (1.2, -0.5), (0.3, -1.2), (-1.0, -0.8),
)  # fmt: skip
_UNITS = {
    "map.images.rms_mm": "mm",
    "map.images.direction_deg": "deg",
    "map.images.missing": "",
    "map.fed_back.ate_mm": "mm",
}


def tour(made: Scenario) -> Scenario:
    """Three minutes around a room of 6 m."""
    changes = {
        "duration_s": TOUR_S,
        "start": (*_TOUR[0], 0.0),
        "world": World(size_m=(6.0, 6.0), markers=Markers(count=16)),
        "control": Control(waypoints=_TOUR, speed=0.42),
    }
    return installed(made).model_copy(update=changes)


def measure(quick: bool, split: Split = "test") -> Iterator[Row]:
    """All rows of maps; a quick run takes one seed."""
    seeds = SEEDS[split] if split == "test" else SEEDS[split][:VALIDATION]
    seeds = seeds[:1] if quick else seeds
    jobs = [adaptive_recordings.job("unequal_radii", split, seed, tour) for seed in seeds]
    try:
        adaptive_recordings.record_missing(jobs)
    except RenderError as error:
        yield from not_run(_UNITS, str(error))
        return
    folders = [adaptive_recordings.cache_folder() / job.folder for job in jobs]
    found = [kept(f"map_{folder.name}", lambda folder=folder: figures(folder)) for folder in folders]  # type: ignore[misc]
    failed = [f["failed"] for f in found if "failed" in f]
    if failed:
        yield from not_run(_UNITS, f"in {len(failed)} of {len(found)} runs: {failed[0]}")
        return
    for name, unit in _UNITS.items():
        values = [float(f[name]) for f in found]
        yield Row(name, float(np.mean(values)), float(np.std(values)), len(values), unit)


def figures(folder: Path) -> Mapping[str, float | str]:
    """Survey a recording, and smooth it with the map."""
    true = load_installed(folder / INSTALLED).map.landmark_map()
    config = load_config(folder / "robot.yaml")
    size = next(iter(true.landmarks.values())).size_m
    markers = config.markers.model_copy(update={"dictionary": Markers().dictionary, "default_size_m": size})
    try:
        surveyed = survey([folder / "bag"], config.model_copy(update={"markers": markers})).landmarks
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "map.yaml"
            write_map(surveyed, path)
            return {**compared(load_map(path), true), "map.fed_back.ate_mm": _fed_back(folder / "bag", path, config)}
    except FglocError as error:
        return {"failed": f"{type(error).__name__}: {error}"}


def compared(surveyed: LandmarkMap, true: LandmarkMap) -> dict[str, float]:
    """Errors of a map after the rigid motion that fits the places best.

    Source: Umeyama, IEEE PAMI 13(4), 1991, without scale.
    """
    ids = sorted(set(surveyed.landmarks) & set(true.landmarks))
    a = np.array([true.landmarks[i].position for i in ids])
    b = np.array([surveyed.landmarks[i].position for i in ids])
    U, _, V = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V).T
    off = (a - a.mean(axis=0)) - (b - b.mean(axis=0)) @ R.T
    turned = [
        Rotation.from_matrix(true.landmarks[i].rotation.T @ R @ surveyed.landmarks[i].rotation).magnitude() for i in ids
    ]
    return {
        "map.images.rms_mm": 1e3 * math.sqrt(float((off**2).sum(axis=1).mean())),
        "map.images.direction_deg": math.degrees(math.sqrt(float(np.square(turned).mean()))),
        "map.images.missing": float(len(set(true.landmarks) - set(ids))),
    }


def _fed_back(bag: Path, map_path: Path, config: Config) -> float:
    aligned = config.model_copy(update={"truth": config.truth.model_copy(update={"align": "se2"})})
    matched = match_result(run(bag, map_path, config, "batch"), aligned)
    if matched is None:
        return math.nan
    return 1e3 * float(matched.distances.mean())
