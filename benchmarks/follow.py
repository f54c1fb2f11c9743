"""Following waypoints: ``python -m benchmarks.follow [--quick] [--json FILE] [--split validation] [--jobs N]``.

A simulated robot, as installed by a careful person (`benchmarks.installed`), drives itself along waypoints
(`fgloc_datasets.sim.following`). Nothing is told of what is off. ``track_mm``: mean distance of the true path from the
curve through the waypoints, over the length of the path. Values are means over the seeds, spreads their standard
deviations; a value ``a_over_b`` is the mean of a over the mean of b, its spread that of the single ratios.
``over_truth``: over a drive on the same floor with the true pose. ``no_model_pose``, ``no_model_seconds``: error of the
pose that guided the robot, and how long it drove, without the learned motion: an uncertain robot slows down and waits.
``reached``: share of the waypoints that the robot has come within 10 cm of.

With ``--corners`` the camera sends corners with a detector's noise (`fgloc_datasets.sim.camera`); nothing is rendered.
Cases (`fgloc_datasets.sim.following.cases`): flat30 and flat20, waypoints 0.3 and 0.2 m apart on a grippy floor; ice,
friction 0.1 everywhere; dark20, no images from 16 to 36 s, on ice; onewheel, the left encoder counts nothing in that
time; moved, a marker is 0.5 m from where the map has it. Finished drives are kept by the hash of the sources, so
that an interrupted run goes on.

Ground that is not flat (``--ground`` measures these rows alone): one drive a seed and floor, estimated as it was
recorded. On the slope the robot is guided by fgloc; over the rough field and on the level floor by the true pose, as
only the estimate counts. Then the recording is run online, with ``estimator.ground`` uneven and flat, without the
checks before a run.

- ``slope.ate_mm``: mean distance in space from the truth; ``slope.nees_over_d``: NEES over 6 of the pose in space;
  ``slope.pitch_deg``: rms error of the pitch; ``slope.height_mm``, ``slope.roll_deg`` likewise.
- ``slope.flat_config_ate_over``: error in the plane of a flat configuration over that of an uneven one;
  ``slope.flat_config_named``: share of these runs whose mistakes name the floor.
- ``slope.track_mm``: mean distance of the true path from the waypoint path, both in the plane.
- ``flat.uneven_over_flat``: on the level floor, error in the plane; ``flat.uneven_over_flat_time``: median time of an
  update.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np

from benchmarks.common import Row, main, mean_row, not_run, ratio_row
from benchmarks.replays import kept, parallel
from fgloc.config import Config, load_config
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.runner import run
from fgloc_datasets.sim.camera import RenderError
from fgloc_datasets.sim.following.cases import drive_of
from fgloc_datasets.sim.following.loop import PoseName, follow

Split = Literal["validation", "test"]
SEEDS: dict[Split, tuple[int, ...]] = {"validation": (141, 142, 143), "test": tuple(range(161, 171))}
Key = tuple[str, PoseName]
_Rows = Mapping[Key, Sequence["Driven"]]
_QUICK = ("flat30",)


@dataclass(frozen=True, slots=True)
class Wanted:
    """A row, and the drives that it is made of: one for each seed."""

    id: str
    needs: tuple[Key, ...]
    row: Callable[[str, Sequence[Sequence[Driven]]], Row]


def wanted() -> Iterator[Wanted]:
    """Rows of the benchmark."""
    for case in ("flat30", "flat20"):
        yield Wanted(f"{case}.track_mm", ((case, "fgloc"),), _mean("track_mm", "mm"))
        yield Wanted(f"{case}.truth.track_mm", ((case, "truth"),), _mean("track_mm", "mm"))
        yield Wanted(f"{case}.track_over_truth", ((case, "fgloc"), (case, "truth")), _over("track_mm"))
    for case, truth in (("ice", "ice"), ("dark20", "ice"), ("onewheel", "flat30"), ("moved", "flat30")):
        yield Wanted(f"{case}.track_mm", ((case, "fgloc"),), _mean("track_mm", "mm"))
        yield Wanted(f"{case}.track_over_truth", ((case, "fgloc"), (truth, "truth")), _over("track_mm"))
    without: tuple[Key, ...] = (("dark20", "fgloc-no-model"), ("dark20", "fgloc"))
    yield Wanted("dark20.no_model_over_model", without, _over("track_mm"))
    bare: tuple[Key, ...] = (("dark20", "fgloc-no-model-no-gyro"), ("dark20", "fgloc"))
    yield Wanted("dark20.no_model_no_gyro_over_model", bare, _over("track_mm"))
    yield Wanted("dark20.no_model_pose_over_model", without, _over("pose_mm"))
    yield Wanted("dark20.no_model_seconds_over_model", without, _over("seconds"))
    yield Wanted("ice.wheels_over_fgloc", (("ice", "wheels"), ("ice", "fgloc")), _over("track_mm"))
    for case in ("flat30", "flat20", "ice", "dark20", "onewheel", "moved"):
        yield Wanted(f"{case}.reached", ((case, "fgloc"),), _mean("reached", ""))


def measure(
    quick: bool, split: Split = "test", jobs: int | None = None, corners: bool = False, seeds: int | None = None
) -> Iterator[Row]:
    """Rows of the benchmark; a quick run has one seed and one case, others all or the first ``seeds``."""
    drawn = SEEDS[split][: 1 if quick else seeds]
    rows = list(wanted())
    todo = [w for w in rows if not quick or all(case in _QUICK for case, _ in w.needs)]
    keys = {key for w in todo for key in w.needs}
    try:
        cells = {(seed, *key): Cell(seed, *key, corners) for seed in drawn for key in sorted(keys)}
        driven = run_all(list(cells.values()), jobs)
    except RenderError as error:
        yield from not_run([w.id for w in rows], str(error))
        return
    found: _Rows = {(case, pose): [driven[cells[seed, case, pose]] for seed in drawn] for case, pose in keys}
    if quick:
        yield from not_run(GROUND_IDS, "left out of a quick run")
    else:
        yield from ground(drawn)
    for w in rows:
        if w not in todo:
            yield not_run([w.id], "left out of a quick run")[0]
            continue
        failed = [d.failed for key in w.needs for d in found[key] if d.failed]
        yield (
            Row(w.id, None, n=len(drawn), reason=f"{len(failed)} drives failed: {failed[0]}")
            if failed
            else w.row(w.id, [found[key] for key in w.needs])
        )


def _mean(field: str, unit: str) -> Callable[[str, Sequence[Sequence[Driven]]], Row]:
    """Mean and standard deviation over the seeds."""

    def row(row_id: str, drives: Sequence[Sequence[Driven]]) -> Row:
        return mean_row(row_id, [float(getattr(d, field)) for d in drives[0]], unit)

    return row


def _over(field: str) -> Callable[[str, Sequence[Sequence[Driven]]], Row]:
    """Mean of a figure over that of other drives."""

    def row(row_id: str, drives: Sequence[Sequence[Driven]]) -> Row:
        first, second = ([float(getattr(d, field)) for d in same] for same in drives)
        return ratio_row(row_id, first, second)

    return row


# --- Drives along waypoints -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """One drive."""

    seed: int
    case: str
    pose: PoseName
    corners: bool = False  # of markers, not images


@dataclass(frozen=True, slots=True)
class Driven:
    """Score of the drive (`fgloc_datasets.sim.following.loop.Score`), or the reason why it failed."""

    track_mm: float = float("nan")
    reached: float = 0.0
    arrived: bool = False
    pose_mm: float | None = None
    seconds: float = float("nan")
    failed: str = ""


def run_all(cells: Sequence[Cell], jobs: int | None = None) -> dict[Cell, Driven]:
    """All drives, from the cache or driven now."""
    found: dict[Cell, Driven] = {}
    began = time.monotonic()
    for cell, driven in parallel(_kept_drive, cells, jobs or os.cpu_count() or 1):
        found[cell] = driven
        left = (time.monotonic() - began) * (len(cells) / len(found) - 1.0)
        print(f"{len(found)} of {len(cells)} drives, {left:.0f} s left", file=sys.stderr, flush=True)
    return found


def _kept_drive(cell: Cell) -> tuple[Cell, Driven]:
    """A drive from the cache, or driven now."""
    sees: Literal["corners", "images"] = "corners" if cell.corners else "images"

    def drive() -> dict[str, Any]:
        try:
            score = follow(drive_of(cell.case, cell.pose, cell.seed, sees)).score
        except FglocError as error:
            return asdict(Driven(failed=str(error)))
        return asdict(Driven(score.track_mm, score.reached, score.arrived, score.pose_mm, score.seconds))

    return cell, Driven(**kept(f"follow_{cell.case}_{cell.pose}_{cell.seed}_{sees}", drive, Path(__file__)))


# --- Ground that is not flat ------------------------------------------------------------------------------------------


_GUIDE: dict[str, PoseName] = {"slope": "fgloc", "rough": "truth", "level": "truth"}
_FLAT_TOO = ("slope", "level")


@dataclass(frozen=True, slots=True)
class OnGround:
    """OnGround of one drive; NaN: not measured."""

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


def measured(case: str, seed: int) -> OnGround:
    """One drive's figures, from the cache or driven now."""

    def drive() -> dict[str, Any]:
        try:
            return asdict(_drive_on_ground(case, seed))
        except FglocError as error:
            return asdict(OnGround(failed=str(error)))

    return OnGround(**kept(f"ground_{case}_{seed}", drive, Path(__file__)))


def _drive_on_ground(case: str, seed: int) -> OnGround:
    with TemporaryDirectory() as place:
        folder = Path(place) / "run"
        drive = drive_of(case, _GUIDE[case], seed, "corners", always=True)
        track_mm = follow(drive, folder).score.track_mm
        config = load_config(folder / "robot.yaml")
        found = {"track_mm": track_mm if _GUIDE[case] == "fgloc" else float("nan")} | _uneven(folder, config)
        if case in _FLAT_TOO:
            found |= _flat(folder, config)
        return OnGround(**found)


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
        "flat_named": float(any(f.code == "floor.uneven" for f in result.findings)),
    }


def _on(config: Config, ground: str) -> Config:
    estimator = config.estimator.model_copy(update={"ground": ground})
    return config.model_copy(update={"estimator": estimator})


GROUND_ROWS: tuple[tuple[str, str, str, str], ...] = (  # id, case, figure, unit
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
GROUND_RATIOS: tuple[tuple[str, str, str, str], ...] = (  # id, case, figure, over
    ("slope.flat_config_ate_over", "slope", "flat_plane_mm", "plane_mm"),
    ("flat.uneven_over_flat", "level", "plane_mm", "flat_plane_mm"),
    ("flat.uneven_over_flat_time", "level", "step_ms", "flat_step_ms"),
)
GROUND_IDS = tuple(row[0] for row in (*GROUND_ROWS, *GROUND_RATIOS))


def ground(seeds: Sequence[int]) -> Iterator[Row]:
    """All rows over these seeds."""
    drives = {case: [measured(case, seed) for seed in seeds] for case in _GUIDE}
    for row_id, case, figure, unit in GROUND_ROWS:
        yield _failed(row_id, drives[case]) or mean_row(row_id, [getattr(d, figure) for d in drives[case]], unit)
    for row_id, case, figure, over in GROUND_RATIOS:
        first, second = ([getattr(d, name) for d in drives[case]] for name in (figure, over))
        yield _failed(row_id, drives[case]) or ratio_row(row_id, first, second)


def _failed(row_id: str, drives: Sequence[OnGround]) -> Row | None:
    """A row with the reason why there is no value; None: no drive failed."""
    why = next((d.failed for d in drives if d.failed), "")
    return Row(row_id, None, n=len(drives), reason=why) if why else None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--corners", action="store_true", help="corners of markers, not images: a third of the time")
    parser.add_argument("--seeds", type=int, default=None, help="only the first so many")
    parser.add_argument("--jobs", type=int, default=None, help="processes")
    parser.add_argument("--ground", action="store_true", help="only the rows on ground that is not flat")
    known, rest = parser.parse_known_args()
    if known.ground:
        chosen = SEEDS[known.split][: known.seeds]
        main(lambda quick: ground(chosen[:1] if quick else chosen), __doc__ or "", rest)
        raise SystemExit
    main(lambda quick: measure(quick, known.split, known.jobs, known.corners, known.seeds), __doc__ or "", rest)
