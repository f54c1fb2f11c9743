"""One bench for all programs: ``python -m benchmarks.public [--only NAME,...] [--page FILE.md] [--poses NAME=DIR]``.

Recordings that others made, with truth and landmarks (`benchmarks.field_recordings`), go through ``fgloc init`` and
fgloc with what it wrote, and the same messages through other programs. ATE is that of `benchmarks.field`.

- ``fgloc``: ``smooth`` and ``online`` with defaults after ``init``.
- ``odometry``: the robot's own, or its integrated commands.
- ``isam2``: the textbook's iSAM2 of `benchmarks.field_peers`, online and smoothed, with the best constants of a search
  along each of them in turn, on the recordings marked for development (least geometric mean of ATE over odometry).
- ``untuned``: the same with what an engineer writes down before the first run.
- Others take part by their poses. ``--export DIR`` writes each recording as a bag with its ``map.yaml`` and ends;
  ``--poses NAME=DIR`` reads ``DIR/RECORDING.tum`` into the same table. In a map's frame they are compared as they are.

On a map the baselines start at the truth's first pose: fgloc finds its own. ``fgloc_begun`` is given that pose, too
(`estimator.initial_pose`). ``--tune`` searches the constants and prints them. The simulator's recordings have a bench of their own (`benchmarks.peers`).

- ``public.NAME.PROGRAM.{batch,online}.ate_m``
- ``public.NAME.{batch,online}.best_over_fgloc``: least ATE of the others over fgloc's; below 1 fgloc loses.
  ``.best_over_fgloc_begun``: on a map, all begun alike.
- ``public.{batch,online}.median_over_fgloc``, ``public.losses``: of all sets, and how many ratios are below 1;
  ``.median_over_fgloc_begun``, ``.losses_begun``: begun alike where there is a map.
"""

# ruff: noqa: E501 (lines of the page)
from __future__ import annotations

import argparse
import math
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import DATA, Row, main, not_run
from benchmarks.field import ates, landmarks_of, ran_through
from benchmarks.field_peers import UNTUNED, Constants, Heard, hear, textbook
from benchmarks.field_recordings import RECORDINGS, Recording
from benchmarks.field_sheet import MODES, Mode
from fgloc.files.atomic import atomic_file
from fgloc.files.outputs import read_tum
from fgloc.types import FloatArray, Trajectory

COMPARED = tuple(r for r in RECORDINGS if r.truth and r.landmarks)
_NONE_M = 1e3  # ATE of no poses
_QUICK = ("duarte", "turtlebot_aruco")
ISAM2 = Constants(motion_m=0.005, motion_rad=0.01, bearing_rad=0.01, range_m=0.1, kernel="cauchy", k=1.0)
_GRID: dict[str, tuple[Any, ...]] = {
    "motion_m": (0.005, 0.01, 0.02, 0.05, 0.1),
    "motion_rad": (0.01, 0.02, 0.05, 0.1),
    "bearing_rad": (0.01, 0.03, 0.06),
    "range_m": (0.03, 0.1, 0.2),
    "kernel": ("huber", "cauchy"),
}


# --- Programs ---------------------------------------------------------------------------------------------------------


def others(heard: Heard, landmarks: Mapping[int, FloatArray]) -> dict[str, Trajectory]:
    """Trajectories of the baselines, by program and mode."""
    found: dict[str, Trajectory] = {}
    if heard.odometry is not None:
        found |= {"odometry.online": heard.odometry, "odometry.batch": heard.odometry}
    for name, constants in (("isam2", ISAM2), ("untuned", UNTUNED)):
        if (plain := textbook(heard, landmarks, constants=constants)) is not None:
            found[f"{name}.online"], found[f"{name}.batch"] = plain
    return found


def compared(recording: Recording, poses: Mapping[str, Path]) -> dict[str, float]:
    """ATE [m] of every program on a recording, by program and mode; those of no use are left out."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        bag = recording.bag(folder)
        ran = ran_through(recording, bag, folder)
        heard, landmarks = hear(bag, recording.truth), landmarks_of(recording, folder)
        begun = None
        if landmarks and heard.odometry is not None and heard.truth is not None:
            first = heard.truth.interpolate(int(max(heard.odometry.stamps_ns[0], heard.truth.stamps_ns[0])))
            begun = ran_through(recording, bag, folder, first)
    estimates = others(heard, landmarks)
    for name, results in (("fgloc", ran), ("fgloc_begun", begun)):
        for mode in MODES:
            if results is not None and len(results[mode].get("poses", ())) > 1:
                poses_of = Trajectory(np.array(results[mode]["stamps"]), np.array(results[mode]["poses"]))
                estimates[f"{name}.{mode}"] = poses_of
    for program, tums in poses.items():
        if (path := tums / f"{recording.name}.tum").is_file():
            estimates |= dict.fromkeys((f"{program}.batch", f"{program}.online"), read_tum(path))
    own = {name: e for name, e in estimates.items() if name.startswith("odometry.")}  # in a frame of its own always
    rest = {name: e for name, e in estimates.items() if name not in own}
    return ates(replace(recording, frame="se2"), heard, own, False) | ates(recording, heard, rest, bool(landmarks))


def tune(recordings: Sequence[Recording]) -> None:
    """Search the constants of `isam2` along each in turn, and print them."""
    given = []
    for recording in recordings:
        with tempfile.TemporaryDirectory() as scratch:
            bag = recording.bag(Path(scratch))
            given.append((recording, hear(bag, recording.truth), landmarks_of(recording, Path(scratch))))

    def cost(constants: Constants) -> float:
        logs = []
        for recording, heard, landmarks in given:
            assert heard.odometry is not None
            plain = textbook(heard, landmarks, constants=constants)
            base = ates(replace(recording, frame="se2"), heard, {"odometry": heard.odometry}, False)["odometry"]
            found = {} if plain is None else {"online": plain[0], "batch": plain[1]}
            scores = ates(recording, heard, found, bool(landmarks))
            logs += [math.log(scores.get(mode, _NONE_M) / base) for mode in MODES]
        return float(np.exp(np.mean(logs)))

    best = Constants()
    least = cost(best)
    for name, values in _GRID.items():
        for value in values:
            changed: dict[str, Any] = {name: value} | ({"k": 1.0} if value == "cauchy" else {})
            if (tried := replace(best, **changed)) != best and (found := cost(tried)) < least:
                best, least = tried, found
            print(f"{changed}: least {least:.4f}", file=sys.stderr, flush=True)
    print(f"{best}: ATE over odometry {least:.4f}")


# --- Rows -------------------------------------------------------------------------------------------------------------


def measure(quick: bool, only: Sequence[str], poses: Mapping[str, Path], page: Path | None) -> Iterator[Row]:
    """Rows of the benchmark; a quick run has two recordings."""
    if not DATA.is_dir():
        yield from not_run(["public.losses"], f"no {DATA}; set FGLOC_REAL_DATA")
        return
    chosen = [r for r in COMPARED if r.name in (only or (_QUICK if quick else [x.name for x in COMPARED]))]
    found = {}
    for recording in chosen:
        found[recording.name] = compared(recording, poses)
        print(f"  {recording.name}: {found[recording.name]}", file=sys.stderr, flush=True)
        for name, value in found[recording.name].items():
            yield Row(f"public.{recording.name}.{name}.ate_m", value, unit="m")
    for program, suffix in (("fgloc", ""), ("fgloc_begun", "_begun")):
        yield from _ratios(found, program, suffix)
    if page is not None:
        write_page(page, chosen, found)


def _ratios(found: Mapping[str, Mapping[str, float]], program: str, suffix: str) -> Iterator[Row]:
    """Rows of the least ATE of others over that of a program of fgloc's, which is `fgloc` where it has none."""
    ratios: dict[Mode, list[float]] = {mode: [] for mode in MODES}
    for name, ate in found.items():
        for mode in MODES:
            best, own = best_of(ate, mode), ate.get(f"{program}.{mode}", ate.get(f"fgloc.{mode}"))
            if best is None or own is None:
                key = f"public.{name}.{mode}.best_over_fgloc{suffix}"
                yield from not_run([key], "no poses of fgloc, or of others")
                continue
            ratios[mode].append(ate[best] / own)
            if f"{program}.{mode}" in ate:
                yield Row(f"public.{name}.{mode}.best_over_fgloc{suffix}", ratios[mode][-1], unit=best)
    for mode, values in ratios.items():
        if values:
            spread = float(np.std(np.log(values)))
            yield Row(f"public.{mode}.median_over_fgloc{suffix}", float(np.median(values)), spread, len(values))
    every = [value for values in ratios.values() for value in values]
    yield Row(f"public.losses{suffix}", float(sum(value < 1.0 for value in every)), n=len(every))


def best_of(ate: Mapping[str, float], mode: Mode) -> str | None:
    """Program and mode of the least ATE other than fgloc's; None: there is none."""
    rivals = [name for name in ate if name.endswith(f".{mode}") and not name.startswith("fgloc")]
    return min(rivals, key=lambda name: ate[name], default=None)


_HEAD = """# Public bench

<!-- Written by `python -m benchmarks.public --page docs/public.md` on {day}. -->

Recordings that others made, with truth and landmarks: ATE [m] of fgloc with defaults after `fgloc init`, and of other programs on the same messages, losses first.
Programs, their constants and the error are described in `benchmarks/public.py`. On a map the others start at the truth's first pose; fgloc has to find its own. Constants of
`isam2` are the best on the recordings marked *dev*, those of `untuned` were never chosen. `fgloc_begun` starts at the truth's first pose as they do. Another program takes
part by its poses (`--export`, `--poses`).

| recording | {programs} | best other / fgloc: batch | online | / fgloc_begun: batch | online |
|---|{dashes}---|---|---|---|
"""


def write_page(path: Path, chosen: Sequence[Recording], found: Mapping[str, Mapping[str, float]]) -> None:
    """Write the table as Markdown, the least ratio first. A program whose modes are alike has one column."""
    programs = list(dict.fromkeys(name.rsplit(".", 1)[0] for ate in found.values() for name in ate))
    programs.sort(key=lambda name: not name.startswith("fgloc"))
    columns = [(name, mode) for name in programs for mode in MODES]
    for name in programs:
        if all(ate.get(f"{name}.{MODES[0]}") == ate.get(f"{name}.{MODES[1]}") for ate in found.values()):
            columns.remove((name, MODES[1]))
    rows = []
    for recording in chosen:
        ate = found[recording.name]
        own = [(program, mode) for program in ("fgloc", "fgloc_begun") for mode in MODES]
        best = {mode: best_of(ate, mode) for mode in MODES}
        ratios = [
            math.nan if best[mode] is None else ate[str(best[mode])] / ate.get(f"{program}.{mode}", math.nan)
            for program, mode in own
        ]
        cells = [f"{ate[key]:.3f}" if (key := f"{name}.{mode}") in ate else "–" for name, mode in columns]
        cells += ["no poses" if math.isnan(ratio) else f"{ratio:.2f}" for ratio in ratios[:2]]
        cells += ["–" if math.isnan(ratio) else f"{ratio:.2f}" for ratio in ratios[2:]]
        name = f"{recording.name} *dev*" if recording.development else recording.name
        least = -math.inf if any(map(math.isnan, ratios[:2])) else min(ratios[:2])
        rows.append((least, f"| {name} | {' | '.join(cells)} |"))
    rows.sort(key=lambda row: row[0])
    heads = [f"{name} {mode}" if (name, MODES[1]) in columns else name for name, mode in columns]
    day = datetime.now(UTC).date().isoformat()
    head = _HEAD.format(day=day, programs=" | ".join(heads), dashes="---|" * len(columns))
    with atomic_file(path) as file:
        file.write(head + "\n".join(line for _, line in rows) + "\n")


def export(out: Path, only: Sequence[str]) -> None:
    """Write each recording into a folder of its name: ``bag`` (as its format has it), ``map.yaml`` if there is one."""
    for recording in (r for r in COMPARED if not only or r.name in only):
        folder = out / recording.name
        folder.mkdir(parents=True, exist_ok=True)
        bag = recording.bag(folder)
        if recording.make is None:
            copy = shutil.copytree if bag.is_dir() else shutil.copy
            copy(bag, folder / (bag.name if bag.is_file() else "bag"))
        if (places := recording.map_path(folder)) is not None and places.parent != folder:
            shutil.copy(places, folder / "map.yaml")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--only", default="", help="comma-separated names; default: all")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="also write the table as a page")
    parser.add_argument("--export", type=Path, metavar="DIR", help="write the recordings there and end")
    parser.add_argument("--poses", action="append", default=[], metavar="NAME=DIR", help="another program's TUM files")
    parser.add_argument("--tune", action="store_true", help="search the constants of isam2 and end")
    known, rest = parser.parse_known_args()
    names = tuple(filter(None, known.only.split(",")))
    if known.export is not None:
        export(known.export, names)
    elif known.tune:
        tune([r for r in COMPARED if r.development and (not names or r.name in names)])
    else:
        programs = {name: Path(folder) for name, _, folder in (given.partition("=") for given in known.poses)}
        main(lambda quick: measure(quick, names, programs, known.page), __doc__ or "", rest)
