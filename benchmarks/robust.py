"""``python -m benchmarks.robust``: mutated recordings, hostile settings and models, bombs, kills at every rename.

robust.bag_mutants, bag_failures      recordings with changed bytes, of every format, through ``info`` and ``smooth``;
                                      tracebacks, hangs (20 s), more than 1 GB, signals, silent errors of 5 cm
robust.config_cases, config_failures  settings and models: those refused, and runs with those accepted
robust.peak_mb                        largest memory of ``info`` or ``smooth`` of a file of less than a megabyte
robust.kill_mixtures                  kill -9 before every rename, link and exchange of smooth, online, ablate, train,
                                      sim: results that are neither the old nor the new one
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from benchmarks.common import Row, main
from benchmarks.robust_kills import writers
from tests.fuzz import zygote
from tests.fuzz.cases import MAX_SECONDS, model_case, recording_cases
from tests.fuzz.hostile_bags import make_all, megabytes
from tests.fuzz.hostile_yaml import SYNTAX, numeric_cases
from tests.fuzz.processes import Done
from tests.fuzz.processes import fgloc as fresh
from tests.fuzz.samples import make_samples

_MUTANTS = 1008  # 126 of each of 8 formats
_MODELS = 100
_SAMPLE_S = 3.0
_SMALL_MB = 1.0


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    zygote.load()
    with tempfile.TemporaryDirectory(prefix="fgloc-robust-") as folder:
        place = Path(folder)
        make_samples(place / "samples", _SAMPLE_S)
        yield from _bags(place, 16 if quick else _MUTANTS)
        yield from _settings(place, quick)
        yield _bombs(place)
        yield _kills(place, quick)


def _bags(place: Path, count: int) -> Iterator[Row]:
    failed = 0
    for case in itertools.islice(recording_cases(place, itertools.count()), count):
        failed += bool(case.failures)
        if case.failures:
            _say(f"{case.name}: {'; '.join(case.failures)}")
    yield Row("robust.bag_mutants", count, n=count)
    yield Row("robust.bag_failures", failed, n=count)


def _settings(place: Path, quick: bool) -> Iterator[Row]:
    texts = [*SYNTAX.items(), *numeric_cases()]
    texts = texts[::40] if quick else texts
    failed = 0
    for name, text in texts:
        path = place / "robot.yaml"
        path.write_text(text, encoding="utf-8")
        out = ("--out", place / "out")
        done = zygote.fgloc("smooth", place / "samples" / "mcap", "--config", path, *out, seconds=MAX_SECONDS)
        failed += _told(name, done)
    models = 4 if quick else _MODELS
    for seed in range(models):
        case = model_case(place, seed)
        failed += bool(case.failures)
        if case.failures:
            _say(f"{case.name}: {'; '.join(case.failures)}")
    yield Row("robust.config_cases", len(texts) + models, n=len(texts) + models)
    yield Row("robust.config_failures", failed, n=len(texts) + models)


def _told(name: str, done: Done) -> bool:
    """Whether a run failed in a way that a user should never see."""
    if found := done.failures():
        _say(f"{name}: {'; '.join(found)}")
    return bool(found)


def _bombs(place: Path) -> Row:
    peaks: dict[str, float] = {}
    for name, path in make_all(place / "bombs").items():
        if megabytes(path) < _SMALL_MB:
            for command in ("info", "smooth"):
                more = ("--out", place / "out") if command == "smooth" else ()
                done = fresh(command, path, *more)
                _told(f"{command} {name}", done)
                peaks[f"{command} {name}"] = done.peak_mb
    worst = max(peaks, key=lambda name: peaks[name])
    _say(f"largest memory: {worst}")
    return Row("robust.peak_mb", peaks[worst], n=len(peaks), unit="MB")


def _kills(place: Path, quick: bool) -> Row:
    mixtures = kills = 0
    for writer in writers(place / "kills", place / "samples" / "mcap"):
        states = list(writer.killed_states(every=5 if quick else 1))
        wrong = [state for state in states if state not in ("old", "new")]
        _say(
            f"{writer.name}: {len(states)} kills: {states.count('old')} times the old result, "
            f"{states.count('new')} times the new one, {len(wrong)} times neither"
        )
        mixtures, kills = mixtures + len(wrong), kills + len(states)
    return Row("robust.kill_mixtures", mixtures, n=kills)


if __name__ == "__main__":
    main(measure, __doc__.splitlines()[0])
