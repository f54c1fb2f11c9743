"""Gross mistakes: ``python -m benchmarks.gross [--quick] [--json FILE] [--split validation] [--mistakes NAME,...]``.

Each of `benchmarks.gross_recordings.MISTAKES` is made on three simulated recordings as installed, of a minute each, and
`fgloc.runner.run` and `fgloc info` are asked about it.

- ``gross.named``: share of mistakes that the first note of the run (or its error) names, with the line to be set (its
  value within 2 to 25 % of the true one) and an exit code other than 0. ``gross.info``: likewise of the first line that
  ``fgloc info`` has to say.
- ``gross.false``: sound runs of which a mistake is named: those without a mistake, and the bundled samples.
- ``gross.seconds``: processor time of the run with the mistake over that of the sound run; largest and median.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common import Row, main, not_run
from benchmarks.gross_recordings import MISTAKES, write
from benchmarks.recordings import SEEDS, Split, Take, cache_folder, folder, prepare
from fgloc.cli.terminal import EXIT_BAD_INPUT, exit_code
from fgloc.config import load_config
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.errors import FglocError
from fgloc.replay import RunMode
from fgloc.runner import run
from fgloc_datasets.sim.camera import RenderError

RECORDINGS = 3
QUICK = ("size_0.95", "joints_swapped", "dictionary")
SAMPLES = Path(__file__).resolve().parent.parent / "datasets" / "samples"
_END = re.compile(r"(?<=\.)\s+(?=[A-Z])")  # of a sentence
_VALUE = re.compile(r"\(\?#(\S+) (\S+)\)")  # in a pattern: the bounds of its group "value"


@dataclass(frozen=True, slots=True)
class Outcome:
    """First sentence, exit code and processor time of one run; and the first line of ``fgloc info``."""

    first: str
    code: int
    seconds: float
    info: str


def outcome(bag: Path, mode: RunMode) -> Outcome:
    """Run a recording with the ``robot.yaml`` and ``map.yaml`` beside it."""
    config = load_config(bag.parent / "robot.yaml")
    map_path = bag.parent / "map.yaml"
    began = time.process_time()
    try:
        result = run(bag, map_path, config, mode)
        first, code = next(iter(result.notes), ""), exit_code(result)
    except FglocError as error:
        first, code = str(error), EXIT_BAD_INPUT
    except Exception as error:  # a crash is a result too: it names nothing
        first, code = f"{type(error).__name__}: {error}", EXIT_BAD_INPUT
    seconds = time.process_time() - began
    try:
        report = inspect_all(bag, map_path, config)
        info = next(iter((*report.problems, *report.findings)), "")
    except FglocError as error:
        info = str(error)
    return Outcome(first, code, seconds, info)


def names(pattern: str, sentence: str) -> bool:
    """Whether the first sentence matches, its value within the bounds that the pattern has in a comment."""
    found = re.search(pattern, _END.split(sentence, maxsplit=1)[0])
    if found is None:
        return False
    bounds = _VALUE.search(pattern)
    return bounds is None or float(bounds[1]) <= float(found["value"].rstrip(".")) <= float(bounds[2])


def measure(quick: bool, split: Split = "test", mistakes: Sequence[str] = (), mode: RunMode = "batch") -> Iterator[Row]:
    """The rows; a quick run has one recording and three mistakes."""
    chosen = mistakes or (QUICK if quick else tuple(MISTAKES))
    takes = [Take("installed", "unequal_radii", split, seed) for seed in SEEDS[split][: 1 if quick else RECORDINGS]]
    try:
        prepare(takes)
    except RenderError as error:
        yield from not_run(("gross.named", "gross.info", "gross.false", "gross.seconds"), str(error))
        return
    sound: list[Outcome] = []
    wrong: dict[str, list[Outcome]] = {name: [] for name in chosen}
    for take in takes:
        with tempfile.TemporaryDirectory() as made:
            source = cache_folder() / folder(take)
            sound.append(outcome(write(source, Path(made) / "sound", None), mode))
            _say(take, "sound", sound[-1])
            for name in chosen:
                wrong[name].append(outcome(write(source, Path(made) / name, MISTAKES[name]), mode))
                _say(take, name, wrong[name][-1], MISTAKES[name].said)
    for sample in () if quick else sorted(SAMPLES.iterdir()):
        if (sample / "bag").is_dir():
            sound.append(outcome(sample / "bag", mode))
            print(f"{sample.name}: {sound[-1].code} {sound[-1].first}", file=sys.stderr, flush=True)
    yield from _rows(sound, wrong)


def _rows(sound: Sequence[Outcome], wrong: dict[str, list[Outcome]]) -> Iterator[Row]:
    named, told, ratios = [], [], []
    for name, outcomes in wrong.items():
        said = MISTAKES[name].said
        named.append([names(said, o.first) and o.code != 0 for o in outcomes])
        told.append([names(said, o.info) for o in outcomes])
        ratios.append([o.seconds / s.seconds for o, s in zip(outcomes, sound, strict=False)])
    for name, good, times in zip(wrong, named, ratios, strict=True):
        yield Row(f"gross.{name}.named", float(np.mean(good)), float(np.std(good)), len(good))
        yield Row(f"gross.{name}.seconds", float(np.max(times)), float(np.std(times)), len(times))
    count = sum(map(len, named))
    yield Row("gross.named", float(np.mean(named)), float(np.std(np.mean(named, axis=1))), count)
    yield Row("gross.info", float(np.mean(told)), float(np.std(np.mean(told, axis=1))), count)
    accused = [o for o in sound if o.code or any(names(m.said, o.first) for m in MISTAKES.values())]
    yield Row("gross.false", float(len(accused)), None, len(sound))
    yield Row("gross.seconds", float(np.max(ratios)), None, count)
    yield Row("gross.seconds_median", float(np.median(ratios)), None, count)


def _say(take: Take, name: str, o: Outcome, pattern: str = "") -> None:
    good = f"{names(pattern, o.first)!s:5} {names(pattern, o.info)!s:5}" if pattern else " " * 11
    print(
        f"{take.seed} {name:20} {good} {o.code} {o.seconds:6.1f} s  {o.first}\n    {o.info}",
        file=sys.stderr,
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--mistakes", default="", help="comma-separated names; default: all")
    parser.add_argument("--mode", choices=("batch", "online"), default="batch")
    known, rest = parser.parse_known_args()
    picked = tuple(filter(None, known.mistakes.split(",")))
    main(lambda quick: measure(quick, known.split, picked, known.mode), __doc__ or "", rest)
