"""``python -m benchmarks.robust``: mutated recordings, hostile settings and models, bombs, kills at every rename.

robust.bag_mutants, bag_failures      recordings with changed bytes, of every format, through ``info`` and ``smooth``;
                                      tracebacks, hangs (20 s), more than 1 GB, signals, silent errors of 5 cm
robust.config_cases, config_failures  settings and models: those refused, and runs with those accepted
robust.peak_mb                        largest memory of ``info`` or ``smooth`` of a file of less than a megabyte
robust.kill_mixtures                  kill -9 before every rename, link and exchange of smooth, online, ablate, train,
                                      sim: results that are neither the old nor the new one
"""

from __future__ import annotations

import hashlib
import itertools
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from benchmarks.common import Row, main
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


# --- Writers that are killed ------------------------------------------------------------------------------------------


_EVENTS = {"os.rename", "os.link", "fgloc.exchange", "shutil.rmtree"}
_STATE = ("jobs", "detections", ".checkpoints")  # of a sweep or a training: no part of its result
_SECONDS = 120.0


@dataclass(frozen=True)
class Writer:
    """A command that writes a result into a folder."""

    name: str
    out: Path
    old: Callable[[], None]
    new: Callable[[], None]

    def killed_states(self, every: int = 1) -> Iterator[str]:
        """Old, new or mixed: what a kill before each change of names leaves, until a run gets through."""
        self.old()
        before = self.out.parent.with_name(f"{self.name}-before")
        shutil.copytree(self.out, before)
        old = digest(self.out)
        zygote.forked(lambda: _call(self.new), _SECONDS)
        new = digest(self.out)
        if old == new:
            raise RuntimeError(f"{self.name}: the new result is the old one; nothing can be told")
        for n in range(1, 10_000, every):
            shutil.rmtree(self.out.parent)
            shutil.copytree(before, self.out)
            ended = zygote.forked(lambda n=n: _call(self.new, n), _SECONDS)
            state = {old: "old", new: "new"}.get(digest(self.out), "mixed")
            if ended.code == 0:
                return
            if ended.code != -9 or ended.timed_out:
                raise RuntimeError(f"{self.name}: {ended.stderr[-2000:]}")
            yield state


def _call(work: Callable[[], None], kill_at: int = 0) -> int:
    count = 0

    def watch(event: str, _: object) -> None:
        nonlocal count
        if event in _EVENTS:
            count += 1
            if count == kill_at:
                os.kill(os.getpid(), 9)

    sys.addaudithook(watch)
    work()
    return 0


def digest(folder: Path) -> str:
    """Hash of the names and contents of a result."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")) if folder.is_dir() else []:
        name = path.relative_to(folder)
        if path.is_file() and name.parts[0] not in _STATE and not name.name.startswith("."):
            found.update(f"{name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return found.hexdigest()


def writers(place: Path, bag: Path) -> Iterator[Writer]:
    """Writers, one for each command."""
    yield from _runs(place, bag)
    yield _ablation(place, bag)
    yield _simulation(place)
    yield _training(place)


def _runs(place: Path, bag: Path) -> Iterator[Writer]:
    from fgloc.config import Config
    from fgloc.evaluation.report import write_results
    from fgloc.runner import run

    for name in ("smooth", "online"):
        result = run(bag, bag / "map.yaml", Config(), "batch" if name == "smooth" else "online")
        out = place / name / "out"
        config = result.config or Config()
        yield Writer(
            name,
            out,
            lambda result=result, config=config, out=out: _nothing(write_results(result, config, out, "old")),
            lambda result=result, config=config, out=out: _nothing(write_results(result, config, out, "new")),
        )


def _nothing(_: object) -> None:
    return None


def _ablation(place: Path, bag: Path) -> Writer:
    """The report of a sweep whose runs are done, beside their records."""
    from fgloc.ablation.jobs import execute, make_jobs, read_record
    from fgloc.ablation.report import write_report
    from fgloc.ablation.suite import expand, load_suite

    out = place / "ablate" / "out"
    suite_file = place / "suite.yaml"
    suite_file.parent.mkdir(parents=True, exist_ok=True)
    chain = [{"kind": "dropout", "sensor": "camera", "when": {"intervals": [[1, 2]]}}]
    suite = {"title": "t", "recordings": [{"name": "a", "bag": str(bag)}], "failures": [{"name": "f", "chain": chain}]}
    suite_file.write_text(yaml.safe_dump(suite))
    plan = load_suite(suite_file)
    jobs = make_jobs(expand(plan, suite_file.parent))

    def write(command: str) -> None:
        records = {execute(job, out): read_record(out, job.key) for job in jobs}
        write_report(plan, jobs, {key: record for key, record in records.items() if record is not None}, out, command)

    return Writer("ablate", out, lambda: write("old"), lambda: write("new"))


def _simulation(place: Path) -> Writer:
    from fgloc_datasets.sim.record import record
    from fgloc_datasets.sim.scenario import Scenario

    out = place / "sim" / "out"
    scenario = Scenario(name="short", duration_s=0.5)
    return Writer(
        "sim",
        out,
        lambda: _nothing(record(scenario, 1, out, camera=False)),
        lambda: _nothing(record(scenario, 2, out, camera=False)),
    )


def _training(place: Path) -> Writer:
    from fgloc_training.train import train_models
    from tests.support.synthetic_robot import write_bag

    out = place / "train" / "out"
    data = place / "train-data"
    for seed in range(3):
        write_bag(data / f"run{seed}" / "bag", seed, 20.0)
    settings = {
        "robot": "synthetic",
        "recordings": {f"run{seed}": f"run{seed}/bag" for seed in range(3)},
        "split": {"train": ["run0"], "validation": ["run1"], "test": ["run2"]},
        "network": {"kind": "velocity", "hidden": [8]},
        "optimization": {"iterations": 4, "validate_every": 2, "batch": 8, "variance_iterations": 2},
        "calibration": {"horizons_s": [2.0, 5.0], "window_s": 2.0},
    }

    def run(seed: int) -> None:
        config = place / f"train{seed}.yaml"
        changed = settings | {"optimization": {"seed": seed, "iterations": 4, "validate_every": 2, "batch": 8}}
        config.write_text(yaml.safe_dump(changed))
        train_models(config, data, out, None, lambda _: None, lambda _: None)

    return Writer("train", out, lambda: run(1), lambda: run(2))


if __name__ == "__main__":
    main(measure, __doc__.splitlines()[0])
