"""Many jobs on many cores: a Dask cluster, local or elsewhere, that may be killed at any time and goes on later."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgloc.ablation.jobs import (
    Cost,
    Job,
    Record,
    detect,
    detections_path,
    execute,
    finished,
    make_jobs,
    read_record,
    record_path,
    write_record,
)
from fgloc.ablation.suite import Cell
from fgloc.config import Config
from fgloc.errors import ConfigError, FglocError, OutputError
from fgloc.instrumentation import repeated
from fgloc.recording.storage import find_beside

Progress = Callable[[int, int], None]
"""Called with the number of jobs done and their total."""

_WATCH_S = 5.0
_DEATHS = 3  # of workers, while they ran one job, after which the job is quarantined


def sweep(
    jobs: Sequence[Job],
    out: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    retry: bool = False,
    progress: Progress | None = None,
) -> dict[str, Record]:
    """Run all jobs that have no record yet; return all records by key.

    A job whose record exists is not run again: a sweep that was killed goes on where it was. A job that fails, or that
    kills its worker again and again, gets a record with that outcome, and is not run again.

    Args:
        jobs: from `make_jobs`.
        out: folder for the records; on a cluster all workers must see it, and the recordings, under the same paths.
        workers: processes of the local cluster; None: one per core.
        scheduler: address of a running Dask scheduler (``tcp://host:8786``) instead of a local cluster.
        retry: run jobs that failed once more.
        progress: called after each job.

    Raises:
        ConfigError: Dask is not installed or the scheduler cannot be reached.
        OutputError: a record cannot be written.
    """
    unique = {job.key: job for job in jobs}
    records = {key: record for key, job in unique.items() if (record := finished(job, out)) is not None}
    if retry:
        for key in [key for key, record in records.items() if record.outcome != "done"]:
            record_path(out, key).unlink(missing_ok=True)
            del records[key]
    todo = _by_turns([job for key, job in unique.items() if key not in records])
    if progress is not None:
        progress(len(records), len(unique))
    if not todo:
        return records
    out = out.resolve()
    with _client(min(workers or os.cpu_count() or 1, len(todo)), scheduler) as client:
        for key, error in _finished(client, todo, out):
            records[key] = _recorded(out, key, error)
            if progress is not None:
                progress(len(records), len(unique))
    return records


def _recorded(out: Path, key: str, error: str | None) -> Record:
    """The record of a job that ended; written here if its worker could not."""
    if error is not None and not record_path(out, key).exists():
        write_record(
            out, Record(key=key, outcome="crashed", error=error, cost=Cost(seconds=0.0, cpu_s=0.0, peak_mb=0.0))
        )
    record = read_record(out, key)
    if record is None:
        raise OutputError(f"{record_path(out, key)}: was written by a worker, but is not here: do all see {out}?")
    return record


def _by_turns(jobs: Sequence[Job]) -> list[Job]:
    """Jobs ordered so that those with the same images are apart, and reuse the detections of the first of them."""
    turns: Counter[str] = Counter()
    ranked = []
    for place, job in enumerate(jobs):
        ranked.append((turns[job.images], place, job))
        turns[job.images] += 1
    return [job for *_, job in sorted(ranked, key=lambda r: r[:2])]


def _finished(client: Any, todo: Sequence[Job], out: Path) -> Iterator[tuple[str, str | None]]:
    """Keys of finished jobs, with an error if their workers died."""
    import distributed

    # First and by themselves: jobs that depended on them would all be queued at one worker, and blamed if it dies.
    shared = _shared_images(todo, out)
    distributed.wait(
        [client.submit(_prepare, job, out, key=f"detect-{images}", pure=False) for images, job in shared.items()]
    )
    futures = [client.submit(_attempt, job, out, key=job.key, pure=False, retries=0) for job in todo]
    for future in distributed.as_completed(futures):
        error = future.exception() if future.status == "error" else future.result()
        if error is not None and not isinstance(error, distributed.KilledWorker):
            raise error
        said = None if error is None else f"its worker died {_DEATHS + 1} times while it ran"
        yield future.key, said
        future.release()


def _shared_images(todo: Sequence[Job], out: Path) -> dict[str, Job]:
    """One job for each set of unaltered images that several jobs share and whose markers are not detected yet."""
    count = Counter(job.images for job in todo)
    return {
        job.images: job
        for job in todo
        if count[job.images] > 1
        and job.folder is None
        and not any(failure.pixels for failure in job.cell.chain)
        and not detections_path(out, job).exists()
    }


def _prepare(job: Job, out: Path) -> None:
    """Detect the markers of a job's images; errors are left to the jobs."""
    with suppress(Exception):
        detect(job, out)


def _attempt(job: Job, out: Path) -> OutputError | None:
    """Execute a job; return an error of output instead of raising it, as the worker would log that at length."""
    try:
        execute(job, out)
    except OutputError as error:
        return error
    return None


@contextmanager
def _client(workers: int, scheduler: str | None) -> Iterator[Any]:
    """A client of the given scheduler, or of a local cluster that ends with it."""
    try:
        import dask
        import distributed
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"{error.name} is not installed, and many runs at once need it: "
            f"{sys.executable} -m pip install 'fgloc[sweep]'"
        ) from error
    settings = {
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.scheduler.allowed-failures": _DEATHS,
        "distributed.deploy.lost-worker-timeout": "60s",  # a busy machine takes long to start a new process
    }
    with dask.config.set(settings):
        if scheduler is not None:
            try:
                client = distributed.Client(scheduler, timeout=20)
            except (OSError, TimeoutError, ValueError) as error:
                raise ConfigError(
                    f"{scheduler}: no Dask scheduler answers ({error}); start `dask scheduler`"
                ) from error
            with client:
                yield client
            return
        with (
            _local_cluster(
                n_workers=workers,
                threads_per_worker=1,  # GTSAM holds Python's lock
                processes=True,
                dashboard_address="127.0.0.1:0",  # any free port: several sweeps may run side by side
                memory_limit=None,
                silence_logs="ERROR",
            ) as cluster,
            distributed.Client(cluster) as client,
            # those that the cluster has given up, as it does with one that dies again while it starts
            repeated(lambda: cluster.scale(workers), _WATCH_S, "worker-watch"),
        ):
            yield client


def _local_cluster(**settings: Any) -> Any:
    """Local processes, with their scratch folders in the temporary folder."""
    import distributed

    try:
        return distributed.LocalCluster(**settings)
    except OSError as error:
        raise OutputError(f"the worker processes cannot be started ({error}); is the disk full?") from error


# --- Batch smoothing of many bags: each is a job, with a folder for all files of its run ------------------------------

_TAKEN = {"jobs"}  # the sweep's own folder


@dataclass(frozen=True, slots=True)
class Plan:
    """Jobs of a sweep over several bags, and the bags that cannot be tried.

    Attributes:
        names: folders of the bags, in their order.
        jobs: of the bags that can be tried.
        errors: of the others, by name.
    """

    names: tuple[str, ...]
    jobs: tuple[Job, ...]
    errors: dict[str, str]


def plan_bags(bags: Sequence[Path], map_file: Path | None, configure: Callable[[Path], Config], command: str) -> Plan:
    """One job per bag. A bag that is missing, or whose configuration is wrong, is noted and does not stop the others.

    Args:
        bags: recordings.
        map_file: for all; None: the map beside each bag.
        configure: the configuration for a bag.
        command: what the user typed, for the results.

    Raises:
        ConfigError: a bag is given twice.
    """
    names = folder_names(bags)
    cells: list[Cell] = []
    errors: dict[str, str] = {}
    for name, bag in zip(names, bags, strict=True):
        try:
            if not bag.exists():
                raise ConfigError(f"{bag}: does not exist; expected a ROS 1 .bag, a rosbag2 folder, an .mcap or a .db3")
            config = configure(bag)
        except FglocError as error:
            errors[name] = str(error)
            continue
        map_path = map_file or find_beside(bag, "map.yaml")
        cells.append(Cell(recording=name, bag=bag, map=map_path, config=config, mode="batch"))
    jobs = make_jobs(cells, in_folders=True, command=command)
    return Plan(tuple(names), tuple(jobs), errors)


def folder_names(bags: Sequence[Path]) -> list[str]:
    """A folder name for each bag: its own, with the names of as many folders above as it takes to differ.

    Raises:
        ConfigError: a bag is given twice.
    """
    whole = [bag.resolve() for bag in bags]
    twice = [path for path, n in Counter(whole).items() if n > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: given twice; give each recording once")
    depths = [1] * len(whole)
    while True:
        names = [_name(path, depth) for path, depth in zip(whole, depths, strict=True)]
        count = Counter(names)
        clash = [i for i, name in enumerate(names) if count[name] > 1 or name in _TAKEN]
        deeper = [i for i in clash if depths[i] < len(whole[i].parts) - 1]
        if not deeper:
            break
        for i in deeper:
            depths[i] += 1
    return [f"{name}_{k}" if count[name] > 1 or name in _TAKEN else name for k, name in enumerate(names, start=1)]


def _name(path: Path, depth: int) -> str:
    stem = path.name if path.is_dir() else path.stem
    return "_".join([*path.parts[-depth:-1], stem])
