"""Installations: ``python -m benchmarks.installed [--quick] [--json FILE] [--split validation] [--rows PREFIX,...]``.

Simulated recordings in which map, camera, clocks and wheels are not quite as written, with failures of the ablations
(`benchmarks.installed_recordings`). Values are means over the seeds and spreads their standard deviations, with these
exceptions: ``update_*`` are percentiles over the updates of all seeds, ``found.*`` root mean squares over the seeds,
``found.coverage3`` a share of all values, and ``textbook.*.best_over_fgloc`` the least mean of the textbook's three
pipelines (`benchmarks.textbook`) over that of fgloc without learned motion, both online on the same steps.

- ATE is the mean distance from the truth. NEES/3 is of the whole run; of a robot that was carried away the time until
  it saw a marker again is left out.
- ``lost_share``: poses of mode LOST without cause. ``refused_share``: sightings not used as given; none is wrong.
- ``update_*``: processor time of a whole update, all but the detection of markers.
- ``found.*``: from drives of two minutes. Time offsets are relative to the IMU's stamps.

Settings are chosen on the training and validation splits; the rows are of the test split. Finished cells are kept
(`benchmarks.installed_runs`), so that an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import installed_map, installed_mrclam
from benchmarks.adaptive_recordings import Split
from benchmarks.common import Row, main, not_run
from benchmarks.installed_recordings import SEEDS, Take, Variant, prepare
from benchmarks.installed_runs import CASES, Cell, floor, run_all
from benchmarks.installed_scores import Scores, inside
from benchmarks.textbook import PIPELINES
from fgloc_datasets.sim.camera import RenderError

QUICK_CASES = ("none", "slip")
TEXTBOOK_CASES = ("none", "slip", "dark30", "ids30", "moved")
_FOUND = {  # row: name, factor, unit
    "time_offset_ms": ("camera.time_offset_s", 1e3, "ms"),
    "camera_yaw_deg": ("camera.yaw", math.degrees(1.0), "deg"),
    "focal_percent": ("camera.focal_scale", 100.0, "%"),
    "radius_percent": ("wheels.radius_scale", 100.0, "%"),
    "track_percent": ("wheels.track_scale", 100.0, "%"),
}
_LEFT_OUT = "left out of a quick run"
_Figure = Callable[[Scores], float | None]


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
    quick: bool, split: Split = "test", prefixes: Sequence[str] = ("",), jobs: int | None = None
) -> Iterator[Row]:
    """The rows whose ids begin with one of the prefixes; a quick run has one seed and two cases."""
    rows = [w for w in wanted() if w.id.startswith(tuple(prefixes))]
    seeds = SEEDS[split][:1] if quick else SEEDS[split]
    todo = [w for w in rows if not quick or (w.case in QUICK_CASES and w.variant == "installed")]
    cells = {cell for w in todo for cell in w.cells(split, seeds)}
    try:
        prepare(cell.take for cell in cells)
        found = run_all(sorted(cells), jobs) if cells else {}
    except RenderError as error:
        yield from not_run([w.id for w in rows], str(error))
    else:
        for w in rows:
            of_seeds = [found[cell] for cell in w.cells(split, seeds)] if w in todo else []
            yield w.row(w.id, of_seeds) if of_seeds else not_run([w.id], _LEFT_OUT)[0]
    for name, part in (("map", installed_map.measure), ("mrclam", installed_mrclam.measure)):
        if any(p.startswith(f"{name}.") or f"{name}.".startswith(p) for p in prefixes):
            yield from (row for row in part(quick, split) if row.id.startswith(tuple(prefixes)))


def wanted() -> Iterator[Wanted]:
    """All rows but those of maps and of MRCLAM."""
    for case in CASES:
        yield Wanted(f"{case}.batch.nees_over_3", _mean(lambda s: s.batch and s.batch.nees_over_3), case)
        yield Wanted(f"{case}.online.nees_over_3", _mean(lambda s: s.online and s.online.nees_over_3), case)
        yield Wanted(f"{case}.batch.ate_mm", _mean(_batch_mm, "mm"), case)
        yield Wanted(f"{case}.online.ate_mm", _mean(_online_mm, "mm"), case)
        yield Wanted(f"{case}.online.lost_share", _mean(lambda s: s.lost_share), case)
        yield Wanted(f"{case}.update_p99_ms", _updates(99.0), case)
        yield Wanted(f"{case}.update_median_ms", _updates(50.0), case)
    yield Wanted("none.batch.yaw_deg", _mean(lambda s: s.batch and s.batch.yaw_deg, "deg"))
    yield Wanted("none.refused_share", _mean(lambda s: s.refused_share))
    yield Wanted("map5mm.batch.ate_mm", _mean(_batch_mm, "mm"), variant="map5mm")
    yield Wanted("map5mm.online.ate_mm", _mean(_online_mm, "mm"), variant="map5mm")
    nees = _mean(lambda s: s.online and s.online.nees_over_3)
    yield Wanted("map5mm.online.nees_over_3", nees, variant="map5mm")
    yield Wanted("perfect.none.online.ate_mm", _mean(_online_mm, "mm"), variant="perfect")
    for case in TEXTBOOK_CASES:
        yield Wanted(f"textbook.{case}.best_over_fgloc", best_over_fgloc, case, plain=True)
        yield Wanted(f"textbook.{case}.fgloc.ate_mm", _mean(_online_mm, "mm"), case, plain=True)
        for pipeline in PIPELINES:
            figure = _mean(lambda s, p=pipeline: s.textbook_mm.get(p), "mm")  # type: ignore[misc]
            yield Wanted(f"textbook.{case}.{pipeline}.ate_mm", figure, case, plain=True)
    for row, (name, factor, unit) in _FOUND.items():
        yield Wanted(f"found.{row}", _rms(name, factor, unit), variant="found")
    yield Wanted("found.map_mm_over_survey", _mean(lambda s: s.map_over_survey), variant="found")
    yield Wanted("found.coverage3", coverage3, variant="found")


def _online_mm(scores: Scores) -> float | None:
    return None if scores.online is None else scores.online.ate_mm


def _batch_mm(scores: Scores) -> float | None:
    return None if scores.batch is None else scores.batch.ate_mm


def _mean(figure: _Figure, unit: str = "") -> Callable[[str, Sequence[Scores]], Row]:
    """Mean and standard deviation over the seeds."""

    def row(row_id: str, scores: Sequence[Scores]) -> Row:
        values, missing = _values(row_id, scores, figure)
        return missing or Row(row_id, float(np.mean(values)), float(np.std(values)), len(values), unit)

    return row


def _rms(name: str, factor: float, unit: str) -> Callable[[str, Sequence[Scores]], Row]:
    """Root mean square of an error of the installation; the spread is that of its size."""

    def row(row_id: str, scores: Sequence[Scores]) -> Row:
        values, missing = _values(row_id, scores, lambda s: s.found[name][0] if s.found and name in s.found else None)
        size = factor * np.abs(values)
        return missing or Row(row_id, float(np.sqrt(np.mean(size**2))), float(np.std(size)), len(values), unit)

    return row


def coverage3(row_id: str, scores: Sequence[Scores]) -> Row:
    """Share of all values found that are within three of their sigmas of the truth; the spread is over the seeds."""
    values, missing = _values(row_id, scores, lambda s: float(np.mean(inside(s.found))) if s.found else None)
    every = [good for s in scores if s.found for good in inside(s.found)]
    return missing or Row(row_id, float(np.mean(every)), float(np.std(values)), len(values))


def _updates(percentile: float) -> Callable[[str, Sequence[Scores]], Row]:
    """Percentile over the updates of all seeds; the spread is that of the seeds' own."""

    def row(row_id: str, scores: Sequence[Scores]) -> Row:
        figure: _Figure = lambda s: float(np.percentile(s.update_ms, percentile)) if s.update_ms else None  # noqa: E731
        values, missing = _values(row_id, scores, figure)
        every = [ms for s in scores for ms in s.update_ms]
        return missing or Row(row_id, float(np.percentile(every, percentile)), float(np.std(values)), len(values), "ms")

    return row


def best_over_fgloc(row_id: str, scores: Sequence[Scores]) -> Row:
    """Least mean error of the textbook's pipelines over fgloc's; the spread is that of the single ratios."""
    ours, missing = _values(row_id, scores, _online_mm)
    if missing:
        return missing
    theirs = {p: np.array([s.textbook_mm[p] for s in scores]) for p in PIPELINES}
    best = min(theirs.values(), key=lambda values: float(values.mean()))
    if not np.isfinite(best).all():
        return Row(row_id, None, n=len(scores), reason="no pipeline of the textbook found a pose in every run")
    return Row(row_id, float(best.mean() / np.mean(ours)), float(np.std(best / ours)), len(scores))


def _values(row_id: str, scores: Sequence[Scores], figure: _Figure) -> tuple[list[float], Row | None]:
    """The figure of each seed; and a row that says why there is none, if one is missing."""
    values = [None if s.failed else figure(s) for s in scores]
    known = [v for v in values if v is not None and math.isfinite(v)]
    if len(known) == len(scores):
        return known, None
    missing = [s for s, v in zip(scores, values, strict=True) if v is None or not math.isfinite(v)]
    why = next((said for s in missing if (said := s.failed or s.batch_failed)), "the run says nothing of it")
    return known, Row(row_id, None, n=len(scores), reason=f"in {len(missing)} of {len(scores)} runs: {why}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--rows", default="", help="comma-separated beginnings of ids")
    parser.add_argument("--jobs", type=int, default=None, help="processes")
    known, rest = parser.parse_known_args()
    main(lambda quick: measure(quick, known.split, tuple(known.rows.split(",")), known.jobs), __doc__ or "", rest)
