"""Cost and robustness of a sweep: ``python -m benchmarks.ablation``.

Short jobs replay the odometry of the bundled recording alone, so that the engine's own work shows. Records are compared
whole but for the times that a run took. Workers and the driver are killed with SIGKILL.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from benchmarks.common import Row, main, not_run
from fgloc.ablation.jobs import Job, Record, attempts, make_jobs, record_path
from fgloc.ablation.suite import Suite, expand
from fgloc.ablation.sweep import sweep
from fgloc_datasets import mrclam

_ROOT = Path(__file__).resolve().parent.parent
_SAMPLE = _ROOT / "datasets" / "samples" / "first_run" / "bag"
_DATA = Path(os.environ.get("FGLOC_REAL_DATA", _ROOT.parent / "shared" / "data"))
_CORES = 2
_KILLS = 3  # of workers; then the driver
_ODOMETRY_ALONE = {
    "recording": {"topics": dict.fromkeys(("image", "imu", "joints", "command"), "none")},
    "wheels": {"source": "twist"},
}


def measure(quick: bool) -> Iterator[Row]:
    """Yield every row; a quick run sweeps a tenth of the jobs and leaves out the long rows."""
    with tempfile.TemporaryDirectory() as name:
        scratch = Path(name)
        yield _overhead(_short_jobs(20 if quick else 200), scratch / "overhead")
        jobs = _short_jobs(24 if quick else 60)
        undisturbed = sweep(jobs, scratch / "undisturbed", _CORES)
        yield Row("repeat.differences", _differences(undisturbed, sweep(jobs, scratch / "repeat", _CORES)), n=len(jobs))
        yield from _faults(jobs, undisturbed, scratch / "faults")
        with _cluster(scratch) as address:
            there = sweep(jobs, scratch / "cluster", scheduler=address)
        yield Row("cluster.differences", _differences(undisturbed, there), n=len(jobs))
        if quick:
            yield from not_run(
                ("quick.minutes", "quick.cpu_minutes_per_core", "worker.peak_gb"), "left out of a quick run"
            )
            return
        yield from _quick_suite(scratch / "quick")
        yield _peak(scratch / "peak")


def _short_jobs(count: int) -> list[Job]:
    """Jobs of about half a second each, all different."""
    suite = Suite.model_validate(
        {
            "title": "short",
            "seeds": list(range(count - 1)),
            "recordings": [{"name": "first_run", "bag": str(_SAMPLE)}],
            "variants": [{"name": "odometry", "config": _ODOMETRY_ALONE, "start": "truth"}],
            "failures": [{"name": "loss", "chain": [{"kind": "dropout", "sensor": "wheels", "when": {"share": 0.3}}]}],
        }
    )
    return make_jobs(expand(suite, _ROOT))


def _overhead(jobs: list[Job], out: Path) -> Row:
    began = time.perf_counter()
    records = sweep(jobs, out, _CORES)
    wall = time.perf_counter() - began
    return Row("engine.overhead", wall * _CORES / sum(r.cost.seconds for r in records.values()), n=len(jobs))


def _differences(a: dict[str, Record], b: dict[str, Record]) -> float:
    """Records that are not the same in all but their times, or that only one of the two has."""

    def content(records: dict[str, Record], key: str) -> object:
        record = records.get(key)
        return None if record is None else record.model_dump(exclude={"cost"})

    return float(sum(content(a, key) != content(b, key) for key in a.keys() | b.keys()))


def _faults(jobs: list[Job], undisturbed: dict[str, Record], out: Path) -> Iterator[Row]:
    """Kill a worker three times in mid-sweep, then the driver, then go on."""
    driver = multiprocessing.get_context("spawn").Process(target=_drive, args=(jobs, out))
    driver.start()
    assert driver.pid is not None
    for kill in range(1, _KILLS + 2):
        enough = len(jobs) * kill // (_KILLS + 2)
        _wait_until(lambda enough=enough: len(list((out / "jobs").glob("*.json"))) >= enough)
        if kill <= _KILLS:
            _workers(driver.pid)[0].kill()
        else:
            os.kill(driver.pid, signal.SIGKILL)
    driver.join()
    time.sleep(2.0)  # its workers notice
    unfinished = len(jobs) - len(list((out / "jobs").glob("*.json")))
    assert unfinished > 0, "the driver was killed too late to show anything"
    records = sweep(jobs, out, _CORES)
    written = {job.key: record_path(out, job.key).stat().st_mtime for job in jobs}
    yield Row("faults.differences", _differences(undisturbed, records), n=len(jobs))
    yield Row("faults.rerun_jobs", float(sum(stamp > written[key] for key, stamp in attempts(out))), n=len(jobs))


def _drive(jobs: list[Job], out: Path) -> None:
    sweep(jobs, out, _CORES)


def _workers(driver: int) -> list[psutil.Process]:
    """The driver's worker processes: not multiprocessing's resource tracker."""
    found: list[psutil.Process] = []

    def some() -> bool:
        children = psutil.Process(driver).children(recursive=True)
        found[:] = [c for c in children if c.is_running() and any("spawn_main" in part for part in c.cmdline())]
        return bool(found)

    _wait_until(some)
    return found


def _wait_until(true: Callable[[], bool], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            raise TimeoutError(f"nothing happened for {seconds:g} s")
        time.sleep(0.05)


@contextmanager
def _cluster(scratch: Path) -> Iterator[str]:
    """Address of a scheduler in a process of its own, with two workers in theirs, over loopback TCP."""
    file = scratch / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    scheduler = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    worker = ["worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard"]
    processes = [subprocess.Popen([*dask, *scheduler], cwd=scratch, **quiet)]
    try:
        _wait_until(file.exists, 60.0)
        processes += [subprocess.Popen([*dask, *worker], cwd=scratch, **quiet) for _ in range(_CORES)]
        yield json.loads(file.read_text(encoding="utf-8"))["address"]
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait()


def _quick_suite(out: Path) -> Iterator[Row]:
    """Wall time, and CPU time of all processes over the cores: what the wall time would be on idle ones, at best."""
    command = [sys.executable, "-m", "fgloc.cli", "ablate", str(_ROOT / "ablations" / "quick.yaml")]
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*command, "--out", str(out), "--workers", str(_CORES)], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    yield Row("quick.minutes", (time.perf_counter() - began) / 60.0, unit="min")
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    yield Row("quick.cpu_minutes_per_core", cpu / 60.0 / _CORES, unit="min")


def _peak(out: Path) -> Row:
    source = _DATA / "mrclam6"
    if not source.is_dir():
        return not_run(("worker.peak_gb",), f"{source} is absent; set FGLOC_REAL_DATA")[0]
    bag = mrclam.convert(source, 3, out / "robot3")
    suite = Suite.model_validate(
        {"title": "long", "mode": "batch", "recordings": [{"name": "robot3", "bag": str(bag)}]}
    )
    (record,) = sweep(make_jobs(expand(suite, _ROOT)), out, 1).values()
    return Row("worker.peak_gb", record.cost.peak_mb * 1024.0**2 / 1e9, unit="GB")


if __name__ == "__main__":
    main(measure, __doc__ or "")
