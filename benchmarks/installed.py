"""Installations: ``python -m benchmarks.installed [--quick] [--json FILE] [--split validation] [--rows PREFIX,...]``.

Simulated recordings in which map, camera, clocks and wheels are not quite as written, with failures of the ablations
(`benchmarks.recordings`). Values are means over the seeds and spreads their standard deviations, with these
exceptions: ``update_*`` are percentiles over the updates of all seeds, ``found.*`` root mean squares over the seeds,
``found.coverage3`` a share of all values, and ``textbook.*.best_over_fgloc`` the least mean of the textbook's three
pipelines (`benchmarks.textbook`) over that of fgloc without learned motion, both online on the same steps.

- ATE is the mean distance from the truth. NEES/3 is of the whole run; of a robot that was carried away the time until
  it saw a marker again is left out.
- ``lost_share``: poses of mode LOST without cause. ``refused_share``: sightings not used as given; none is wrong.
- ``update_*``: processor time of a whole update, all but the detection of markers.
- ``found.*``: from drives of two minutes. Time offsets are relative to the IMU's stamps.
- ``map.*``: a robot tours a room of 6 m for three minutes; `fgloc map` is given the dictionary and size of the markers
  and nothing else, then `fgloc smooth` takes the file that it wrote. ``map.images.rms_mm``, ``.direction_deg``: root
  mean square over the markers of a run, of their distance from where they hang and of the angle by which they are
  turned, after SE(3) alignment of the places; ``map.images.missing`` counts the markers that hang there and are not in
  the map. ``map.fed_back.ate_mm``: mean distance from the truth after SE(2) alignment.

Settings are chosen on the training and validation splits; the rows are of the test split. Finished cells are kept
(`benchmarks.replays`), so that an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common import Row, main, mean_row, not_run, ratio_row
from benchmarks.recordings import (
    SEEDS,
    Recorded,
    Split,
    Take,
    Variant,
    cache_folder,
    changed,
    folder,
    load,
    prepare,
)
from benchmarks.replays import Replayed, by_recording, failures, floor, kept, processor_times, replayed
from benchmarks.scores import (
    Figure,
    Scores,
    figures,
    found_by,
    found_errors,
    inside,
    kept_scores,
    map_over_survey,
    mean_of,
    of_errors,
    places_in,
    trajectory_scores,
)
from benchmarks.textbook import PIPELINES, Textbook
from fgloc.calibration.survey import survey
from fgloc.config import Config, load_config
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import match, match_result
from fgloc.runner import run
from fgloc.sensors.maps import load_map, write_map
from fgloc.types import LandmarkMap, Trajectory
from fgloc_datasets.sim.camera import RenderError
from fgloc_datasets.sim.installed import INSTALLED, load_installed
from fgloc_datasets.sim.scenario import Markers

CASES = ("none", "slip", "mu01", "dark30", "dark60", "ids30", "moved", "frozen", "onewheel", "kidnap")
QUICK_CASES = ("none", "slip")
TEXTBOOK_CASES = ("none", "slip", "dark30", "ids30", "moved")
_FOUND = {  # row: name, factor, unit
    "time_offset_ms": ("camera.time_offset_s", 1e3, "ms"),
    "camera_yaw_deg": ("camera.yaw", math.degrees(1.0), "deg"),
    "focal_percent": ("camera.focal_scale", 100.0, "%"),
    "radius_percent": ("wheels.radius_scale", 100.0, "%"),
    "track_percent": ("wheels.track_scale", 100.0, "%"),
}
_PLAIN = {"motion": {"use": False}}  # a textbook knows no learned motion either
_MAPS = {
    "map.images.rms_mm": "mm",
    "map.images.direction_deg": "deg",
    "map.images.missing": "",
    "map.fed_back.ate_mm": "mm",
}
_MAPPED = 3  # seeds of the validation split that are mapped
_LEFT_OUT = "left out of a quick run"
_ONLINE_MM = of_errors("online", "ate_mm")


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """A case on a recording."""

    take: Take
    case: str
    plain: bool = False  # without learned motion, online, and beside it the textbook's pipelines on the same steps

    @property
    def name(self) -> str:
        """Name of the cell, for files and tables."""
        return f"{self.case}{'_plain' if self.plain else ''}_{folder(self.take)}_{self.take.variant}"


@dataclass(frozen=True, slots=True)
class Wanted:
    """A row, and the runs that it is made of: one for each seed."""

    id: str
    row: Callable[[str, Sequence[Scores]], Row]
    case: str = "none"
    variant: Variant = "installed"
    plain: bool = False

    def cells(self, split: Split, seeds: Sequence[int]) -> list[Cell]:
        """The runs, in the order of the seeds."""
        return [Cell(Take(self.variant, floor(self.case), split, seed), self.case, self.plain) for seed in seeds]


def measure(
    quick: bool, split: Split = "test", prefixes: Sequence[str] = ("",), jobs: int = os.cpu_count() or 1
) -> Iterator[Row]:
    """The rows whose ids begin with one of the prefixes; a quick run has one seed and two cases."""
    rows = [w for w in wanted() if w.id.startswith(tuple(prefixes))]
    seeds = SEEDS[split][:1] if quick else SEEDS[split]
    todo = [w for w in rows if not quick or (w.case in QUICK_CASES and w.variant == "installed")]
    cells = {cell for w in todo for cell in w.cells(split, seeds)}
    try:
        prepare(cell.take for cell in cells)
        found = by_recording(scores_of, sorted(cells), attrgetter("take"), jobs)
    except RenderError as error:
        yield from not_run([w.id for w in rows], str(error))
    else:
        for w in rows:
            of_seeds = [found[cell] for cell in w.cells(split, seeds)] if w in todo else []
            yield w.row(w.id, of_seeds) if of_seeds else not_run([w.id], _LEFT_OUT)[0]
    if any(row_id.startswith(tuple(prefixes)) for row_id in _MAPS):
        yield from (row for row in maps(quick, split) if row.id.startswith(tuple(prefixes)))


def wanted() -> Iterator[Wanted]:
    """All rows but those of maps."""
    for case in CASES:
        yield Wanted(f"{case}.batch.nees_over_3", _mean(of_errors("batch", "nees_over_3")), case)
        yield Wanted(f"{case}.online.nees_over_3", _mean(of_errors("online", "nees_over_3")), case)
        yield Wanted(f"{case}.batch.ate_mm", _mean(of_errors("batch", "ate_mm"), "mm"), case)
        yield Wanted(f"{case}.online.ate_mm", _mean(_ONLINE_MM, "mm"), case)
        yield Wanted(f"{case}.online.lost_share", _mean(lambda s: s.lost_share), case)
        yield Wanted(f"{case}.update_p99_ms", _updates(99.0), case)
        yield Wanted(f"{case}.update_median_ms", _updates(50.0), case)
    yield Wanted("none.batch.yaw_deg", _mean(of_errors("batch", "yaw_deg"), "deg"))
    yield Wanted("none.refused_share", _mean(lambda s: s.refused_share))
    yield Wanted("map5mm.batch.ate_mm", _mean(of_errors("batch", "ate_mm"), "mm"), variant="map5mm")
    yield Wanted("map5mm.online.ate_mm", _mean(_ONLINE_MM, "mm"), variant="map5mm")
    nees = _mean(of_errors("online", "nees_over_3"))
    yield Wanted("map5mm.online.nees_over_3", nees, variant="map5mm")
    yield Wanted("perfect.none.online.ate_mm", _mean(_ONLINE_MM, "mm"), variant="perfect")
    for case in TEXTBOOK_CASES:
        yield Wanted(f"textbook.{case}.best_over_fgloc", best_over_fgloc, case, plain=True)
        yield Wanted(f"textbook.{case}.fgloc.ate_mm", _mean(_ONLINE_MM, "mm"), case, plain=True)
        for pipeline in PIPELINES:
            figure = _mean(lambda s, p=pipeline: s.textbook_mm.get(p), "mm")  # type: ignore[misc]
            yield Wanted(f"textbook.{case}.{pipeline}.ate_mm", figure, case, plain=True)
    for row, (name, factor, unit) in _FOUND.items():
        yield Wanted(f"found.{row}", _rms(name, factor, unit), variant="found")
    yield Wanted("found.map_mm_over_survey", _mean(lambda s: s.map_over_survey), variant="found")
    yield Wanted("found.coverage3", coverage3, variant="found")


def _mean(figure: Figure, unit: str = "") -> Callable[[str, Sequence[Scores]], Row]:
    return lambda row_id, scores: mean_of(row_id, scores, figure, unit)


def _rms(name: str, factor: float, unit: str) -> Callable[[str, Sequence[Scores]], Row]:
    """Root mean square of an error of the installation; the spread is that of its size."""

    def row(row_id: str, scores: Sequence[Scores]) -> Row:
        values, missing = figures(row_id, scores, lambda s: s.found[name][0] if s.found and name in s.found else None)
        size = factor * np.abs(values)
        return missing or Row(row_id, float(np.sqrt(np.mean(size**2))), float(np.std(size)), len(values), unit)

    return row


def coverage3(row_id: str, scores: Sequence[Scores]) -> Row:
    """Share of all values found that are within three of their sigmas of the truth; the spread is over the seeds."""
    values, missing = figures(row_id, scores, lambda s: float(np.mean(inside(s.found))) if s.found else None)
    every = [good for s in scores if s.found for good in inside(s.found)]
    return missing or Row(row_id, float(np.mean(every)), float(np.std(values)), len(values))


def _updates(percentile: float) -> Callable[[str, Sequence[Scores]], Row]:
    """Percentile over the updates of all seeds; the spread is that of the seeds' own."""

    def row(row_id: str, scores: Sequence[Scores]) -> Row:
        figure: Figure = lambda s: float(np.percentile(s.update_ms, percentile)) if s.update_ms else None  # noqa: E731
        values, missing = figures(row_id, scores, figure)
        every = [ms for s in scores for ms in s.update_ms]
        return missing or Row(row_id, float(np.percentile(every, percentile)), float(np.std(values)), len(values), "ms")

    return row


def best_over_fgloc(row_id: str, scores: Sequence[Scores]) -> Row:
    """Least mean error of the textbook's pipelines over fgloc's; the spread is that of the single ratios."""
    ours, missing = figures(row_id, scores, _ONLINE_MM)
    if missing:
        return missing
    theirs = {p: np.array([s.textbook_mm[p] for s in scores]) for p in PIPELINES}
    best = min(theirs.values(), key=lambda values: float(values.mean()))
    if not np.isfinite(best).all():
        return Row(row_id, None, n=len(scores), reason="no pipeline of the textbook found a pose in every run")
    return ratio_row(row_id, best, ours)


# --- Many cells -------------------------------------------------------------------------------------------------------


def scores_of(cell: Cell) -> Scores:
    """Scores of a cell, from the cache or run now."""
    return kept_scores(cell.name, lambda: run_cell(cell))


# --- One cell ---------------------------------------------------------------------------------------------------------


def run_cell(cell: Cell) -> Scores:
    """Scores of a case that is replayed now; of a failed run the reason."""
    recorded = load(cell.take)
    try:
        chain = failures(cell.case, recorded)
    except ValueError as error:  # a drive too short for the failure
        return Scores(failed=str(error))
    config = changed(recorded.config, _PLAIN if cell.plain else {})
    batch_failed = ""
    for batch in (False,) if cell.plain else (True, False):
        with processor_times() as times:
            try:
                made = replayed(recorded, config, chain, cell.take.seed, batch)
            except FglocError as error:
                if not batch:
                    return Scores(failed=f"{type(error).__name__}: {error}")
                batch_failed = f"{type(error).__name__}: {error}"  # what was found online is scored all the same
                continue
        if made is None:
            return Scores(failed="no pose was ever found")
        return replace(_scores(recorded, config, made, times, cell.plain), batch_failed=batch_failed)
    raise AssertionError("an online run ends the loop")


def _scores(recorded: Recorded, config: Config, made: Replayed, times: Sequence[float], plain: bool) -> Scores:
    installed = recorded.installed
    found = None if made.batch is None or installed is None else found_by(made.batch)
    return replace(
        trajectory_scores(made, config, made.unknown_ns(recorded.start_ns)),
        update_ms=tuple(round(ms, 4) for ms in times),
        found=None if found is None else found_errors(found, installed or {}),
        map_over_survey=None if found is None else map_over_survey(places_in(found), made.landmarks, installed or {}),
        textbook_mm=textbook_mm(recorded, config, made) if plain else {},
    )


def textbook_mm(recorded: Recorded, config: Config, made: Replayed) -> dict[str, float]:
    """Mean distance from the truth of each of the textbook's pipelines on the steps of a run [mm]."""
    if recorded.camera is None or made.online.truth is None:
        raise ValueError(f"{recorded.name}: the textbook needs a camera and a truth")
    out = {}
    for pipeline in PIPELINES:
        estimates = Textbook(pipeline, made.landmarks, recorded.camera, config.wheels).run(made.steps)
        stamps = np.array([e.stamp_ns for e in estimates], dtype=np.int64)
        trajectory = Trajectory(stamps, np.array([e.pose for e in estimates]).reshape(-1, 3))
        enough = len(estimates) > 1
        out[pipeline] = 1e3 * float(match(trajectory, made.online.truth).distances.mean()) if enough else np.inf
    return out


# --- Maps -------------------------------------------------------------------------------------------------------------


def maps(quick: bool, split: Split) -> Iterator[Row]:
    """Rows of maps that are surveyed from images, then fed back; a quick run takes one seed."""
    seeds = SEEDS[split] if split == "test" else SEEDS[split][:_MAPPED]
    takes = [Take("tour", "unequal_radii", split, seed) for seed in (seeds[:1] if quick else seeds)]
    try:
        prepare(takes)
    except RenderError as error:
        yield from not_run(_MAPS, str(error))
        return
    found = [kept(f"map_{folder(take)}", lambda take=take: mapped(cache_folder() / folder(take))) for take in takes]  # type: ignore[misc]
    failed = [f["failed"] for f in found if "failed" in f]
    if failed:
        yield from not_run(_MAPS, f"in {len(failed)} of {len(found)} runs: {failed[0]}")
        return
    for name, unit in _MAPS.items():
        values = [float(f[name]) for f in found]
        yield mean_row(name, values, unit)


def mapped(run_folder: Path) -> Mapping[str, float | str]:
    """Survey a recording, and smooth it with the map."""
    true = load_installed(run_folder / INSTALLED).map.landmark_map()
    config = load_config(run_folder / "robot.yaml")
    size = next(iter(true.landmarks.values())).size_m
    markers = config.markers.model_copy(update={"dictionary": Markers().dictionary, "default_size_m": size})
    try:
        surveyed = survey([run_folder / "bag"], config.model_copy(update={"markers": markers})).landmarks
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "map.yaml"
            write_map(surveyed, path)
            ate_mm = _fed_back(run_folder / "bag", path, config)
            return {**compared(load_map(path), true), "map.fed_back.ate_mm": ate_mm}
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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--rows", default="", help="comma-separated beginnings of ids")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    known, rest = parser.parse_known_args()
    main(lambda quick: measure(quick, known.split, tuple(known.rows.split(",")), known.jobs), __doc__ or "", rest)
