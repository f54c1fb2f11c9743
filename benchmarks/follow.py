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
time; moved, a marker is 0.5 m from where the map has it. Rows ``slope``, ``rough`` and ``flat.uneven_over_flat`` are
described in `benchmarks.follow_ground`; ``--ground`` measures these alone. Finished drives are kept, so that an
interrupted run goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks import follow_ground
from benchmarks.common import Row, main, not_run
from benchmarks.follow_runs import Cell, Driven, run_all
from fgloc_datasets.sim.camera import RenderError
from fgloc_datasets.sim.following import PoseName

Split = Literal["validation", "test"]
SEEDS: dict[Split, tuple[int, ...]] = {"validation": (141, 142, 143), "test": tuple(range(161, 171))}
Key = tuple[str, PoseName]
_Rows = Mapping[Key, Sequence[Driven]]
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
        yield from not_run(follow_ground.IDS, "left out of a quick run")
    else:
        yield from follow_ground.measure(drawn)
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
        values = [float(getattr(d, field)) for d in drives[0]]
        return Row(row_id, float(np.mean(values)), float(np.std(values)), len(values), unit)

    return row


def _over(field: str) -> Callable[[str, Sequence[Sequence[Driven]]], Row]:
    """Mean of a figure over that of other drives."""

    def row(row_id: str, drives: Sequence[Sequence[Driven]]) -> Row:
        first, second = (np.array([float(getattr(d, field)) for d in same]) for same in drives)
        return Row(row_id, float(first.mean() / second.mean()), float(np.std(first / second)), len(first))

    return row


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
        main(lambda quick: follow_ground.measure(chosen[:1] if quick else chosen), follow_ground.__doc__ or "", rest)
        raise SystemExit
    main(lambda quick: measure(quick, known.split, known.jobs, known.corners, known.seeds), __doc__ or "", rest)
