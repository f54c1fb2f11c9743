"""Rows of `benchmarks.follow` about ground that is not flat: one drive a seed and floor, estimated as it was recorded.

On the slope the robot is guided by fgloc; over the rough field and on the level floor by the true pose, as only the
estimate counts. Then the recording is run online, with ``estimator.ground`` uneven and flat, without the checks
before a run.

- ``slope.ate_mm``: mean distance in space from the truth; ``slope.nees_over_d``: NEES over 6 of the pose in space;
  ``slope.pitch_deg``: rms error of the pitch; ``slope.height_mm``, ``slope.roll_deg`` likewise.
- ``slope.flat_config_ate_over``: error in the plane of a flat configuration over that of an uneven one;
  ``slope.flat_config_named``: share of these runs whose mistakes name the floor.
- ``slope.track_mm``: mean distance of the true path from the waypoint path, both in the plane.
- ``flat.uneven_over_flat``: on the level floor, error in the plane; ``flat.uneven_over_flat_time``: median time of an
  update.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.common import Row
from benchmarks.follow_runs import source_hash
from benchmarks.recordings import cache_folder
from fgloc.config import Config, load_config
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.files.atomic import atomic_file
from fgloc.runner import run
from fgloc_datasets.sim.following import PoseName, follow
from fgloc_datasets.sim.following.cases import drive_of

_GUIDE: dict[str, PoseName] = {"slope": "fgloc", "rough": "truth", "level": "truth"}
_FLAT_TOO = ("slope", "level")


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of one drive; NaN: not measured."""

    track_mm: float = float("nan")
    ate_mm: float = float("nan")  # in space
    plane_mm: float = float("nan")  # in the plane
    nees_over_6: float = float("nan")
    pitch_deg: float = float("nan")
    roll_deg: float = float("nan")
    height_mm: float = float("nan")
    step_ms: float = float("nan")
    flat_plane_mm: float = float("nan")
    flat_step_ms: float = float("nan")
    flat_named: float = float("nan")
    failed: str = ""


def measured(case: str, seed: int) -> Figures:
    """One drive's figures, from the cache or driven now."""
    path = cache_folder() / "follow" / f"ground_{case}_{seed}_{source_hash(Path(__file__))}.json"
    if path.is_file():
        return Figures(**json.loads(path.read_text(encoding="utf-8")))
    try:
        made = _driven(case, seed)
    except FglocError as error:
        made = Figures(failed=str(error))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        json.dump(asdict(made), file)
    print(f"  {case} {seed}: {made}", file=sys.stderr, flush=True)
    return made


def _driven(case: str, seed: int) -> Figures:
    with TemporaryDirectory() as place:
        folder = Path(place) / "run"
        drive = drive_of(case, _GUIDE[case], seed, "corners", always=True)
        track_mm = follow(drive, folder).score.track_mm
        config = load_config(folder / "robot.yaml")
        found = {"track_mm": track_mm if _GUIDE[case] == "fgloc" else float("nan")} | _uneven(folder, config)
        if case in _FLAT_TOO:
            found |= _flat(folder, config)
        return Figures(**found)


def _uneven(folder: Path, config: Config) -> dict[str, float]:
    config = _on(config, "uneven")
    result = run(folder / "bag", folder / "map.yaml", config, "online", check=False)
    matched, metrics = match_result(result, config), compute_metrics(result, config)
    assert matched is not None
    assert metrics.ground is not None
    assert metrics.ate_mean_m is not None
    errors = matched.spatial_errors
    assert errors is not None
    return {
        "ate_mm": 1e3 * float(np.linalg.norm(errors[:, :3], axis=1).mean()),
        "plane_mm": 1e3 * metrics.ate_mean_m,
        "nees_over_6": metrics.ground.nees_over_6,
        "pitch_deg": metrics.ground.pitch_rmse_deg,
        "roll_deg": metrics.ground.roll_rmse_deg,
        "height_mm": 1e3 * metrics.ground.height_rmse_m,
        "step_ms": float(np.median(result.step_ms)),
    }


def _flat(folder: Path, config: Config) -> dict[str, float]:
    config = _on(config, "flat")
    result = run(folder / "bag", folder / "map.yaml", config, "online", check=False)
    metrics = compute_metrics(result, config)
    assert metrics.ate_mean_m is not None
    return {
        "flat_plane_mm": 1e3 * metrics.ate_mean_m,
        "flat_step_ms": float(np.median(result.step_ms)),
        "flat_named": float(any("floor is not flat" in mistake for mistake in result.mistakes)),
    }


def _on(config: Config, ground: str) -> Config:
    estimator = config.estimator.model_copy(update={"ground": ground})
    return config.model_copy(update={"estimator": estimator})


ROWS: tuple[tuple[str, str, str, str], ...] = (  # id, case, figure, unit
    ("slope.ate_mm", "slope", "ate_mm", "mm"),
    ("slope.ate_plane_mm", "slope", "plane_mm", "mm"),
    ("slope.nees_over_d", "slope", "nees_over_6", ""),
    ("slope.pitch_deg", "slope", "pitch_deg", "°"),
    ("slope.roll_deg", "slope", "roll_deg", "°"),
    ("slope.height_mm", "slope", "height_mm", "mm"),
    ("slope.flat_config_named", "slope", "flat_named", ""),
    ("slope.track_mm", "slope", "track_mm", "mm"),
    ("rough.ate_mm", "rough", "ate_mm", "mm"),
    ("rough.nees_over_d", "rough", "nees_over_6", ""),
)
RATIOS: tuple[tuple[str, str, str, str], ...] = (  # id, case, figure, over
    ("slope.flat_config_ate_over", "slope", "flat_plane_mm", "plane_mm"),
    ("flat.uneven_over_flat", "level", "plane_mm", "flat_plane_mm"),
    ("flat.uneven_over_flat_time", "level", "step_ms", "flat_step_ms"),
)
IDS = tuple(row[0] for row in (*ROWS, *RATIOS))


def measure(seeds: Sequence[int]) -> Iterator[Row]:
    """All rows over these seeds."""
    drives = {case: [measured(case, seed) for seed in seeds] for case in _GUIDE}
    for row_id, case, figure, unit in ROWS:
        yield _row(row_id, drives[case], lambda d, f=figure: getattr(d, f), unit)  # type: ignore[misc]
    for row_id, case, figure, over in RATIOS:
        kept = drives[case]
        first, second = (np.array([getattr(d, name) for d in kept]) for name in (figure, over))
        failed = next((d.failed for d in kept if d.failed), "")
        value = None if failed else float(first.mean() / second.mean())
        yield Row(row_id, value, None if failed else float(np.std(first / second)), len(kept), "", failed)


def _row(row_id: str, drives: Sequence[Figures], figure: Callable[[Figures], float], unit: str) -> Row:
    failed = next((d.failed for d in drives if d.failed), "")
    values = np.array([figure(d) for d in drives])
    if failed:
        return Row(row_id, None, None, len(drives), unit, failed)
    return Row(row_id, float(values.mean()), float(values.std()), len(drives), unit)
