"""One run of a sweep: named by the hash of its inputs, executed once, and its record."""

from __future__ import annotations

import fcntl
import hashlib
import json
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

import fgloc
from fgloc.ablation.failures import Corruption
from fgloc.ablation.suite import Cell
from fgloc.config import Config, files_of
from fgloc.errors import FglocError, OutputError, RecordingError
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.evaluation.report import write_results
from fgloc.files.outputs import sha256_of, write_json, write_text
from fgloc.recording.reader import Recording, open_recording
from fgloc.recording.truth import base_pose
from fgloc.runner import RunResult, run
from fgloc.sensor_setup import recorded_setup, resolved
from fgloc.sensors.base import with_values
from fgloc.sensors.maps import configured_map, write_map
from fgloc.sensors.markers.images import ImageError, ImageEvent
from fgloc.sensors.registry import events_by_sensor, streams_of
from fgloc.types import Mode, TruthEvent

# --- Records, written whole or not at all, and a line for every attempt -----------------------------------------------


class _Kept(BaseModel):
    """Contents of a file, or a part of them: unknown keys are errors, values are immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Track(_Kept):
    """Estimate and truth at common times, for a picture [m]."""

    estimate: list[tuple[float, float]]
    truth: list[tuple[float, float]]


class Cost(_Kept):
    """Wall time, CPU time and peak memory of one run; never the same twice."""

    seconds: float
    cpu_s: float
    peak_mb: float


class Record(_Kept):
    """Result of a job's run. All fields but ``cost`` depend on the inputs alone."""

    key: str
    outcome: Literal["done", "refused", "crashed"]
    error: str = ""  # of a refused run the message, of a crashed one the traceback
    figures: dict[str, Any] = {}  # of Metrics, without times
    modes: dict[str, float] = {}  # mode -> share of the poses
    mistakes: tuple[str, ...] = ()  # of the set-up
    sensors: tuple[str, ...] = ()  # with messages in the recording, as failures name them
    affected: dict[str, int] = {}  # events that the failures changed, by kind
    track: Track | None = None
    cost: Cost


def record_path(out: Path, key: str) -> Path:
    """Path of a job's record."""
    return out / "jobs" / f"{key}.json"


def owner_path(out: Path, folder: str) -> Path:
    """Path of the file with the key of the job that wrote a folder last."""
    return out / "jobs" / f"{folder}.owner"


def read_record(out: Path, key: str) -> Record | None:
    """A job's record; None if it has none, or if its file is damaged: then the job has to run again."""
    try:
        return Record.model_validate_json(record_path(out, key).read_bytes())
    except (FileNotFoundError, ValidationError):
        return None


def write_record(out: Path, record: Record) -> None:
    """Write a job's record, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    write_json(record_path(out, record.key), record.model_dump(mode="json"))


def log_attempt(out: Path, key: str) -> None:
    """Note that a run begins.

    Raises:
        OutputError: it cannot be noted.
    """
    path = out / "jobs" / "attempts.log"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab", buffering=0) as file:
            file.write(f"{key} {time.time():.6f}\n".encode())  # one short write: lines of several workers do not mix
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); finished runs are kept") from error


@contextmanager
def only_sweep(out: Path) -> Iterator[None]:
    """Keep other sweeps out of a folder: two would run the same jobs, and each replace the other's report.

    Raises:
        OutputError: another one is at work in it, or it cannot be written.
    """
    path = out / "jobs" / ".lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error})") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputError(f"{out}: another sweep is at work in it; wait for it, or give another folder") from error
        except OSError:  # a file system without locks
            pass
        yield


# --- Jobs -------------------------------------------------------------------------------------------------------------

_TRACK_POINTS = 200
_SOURCES_LEFT_OUT = (
    "ablation/report.py",
    "ablation/sweep.py",
    "evaluation/interactive.py",
    "evaluation/plots.py",
    "evaluation/report.py",
    "evaluation/style.py",
)
_COSTS = {"real_time_factor", "step_ms"}


class Job(_Kept):
    """A cell and the hash of everything that its result depends on."""

    key: str
    cell: Cell
    images: str = ""  # hash of the images that it sees and of how markers are found in them
    folder: str | None = None  # of the sweep's folder: gets all files of the run
    command: str = ""  # for those files


def make_jobs(cells: Sequence[Cell], in_folders: bool = False, command: str = "") -> list[Job]:
    """Name each cell by the SHA-256 of recording, map, model, configuration, failures, seed and code.

    Two cells with the same inputs get the same key, and run once.

    Args:
        cells: from `expand`.
        in_folders: all files of a run are kept, in a folder of its recording's name; else figures alone.
        command: what the user typed, for those files.
    """
    hashes: dict[Path, str] = {}

    def digest(path: Path | None) -> str | None:
        if path is None:
            return None
        if path not in hashes:
            hashes[path] = sha256_of(path)
        return hashes[path]

    jobs = []
    for cell in cells:
        config = cell.config.model_dump(mode="json")
        for section, key in files_of(type(cell.config)):
            config[section][key] = digest(getattr(getattr(cell.config, section), key))
        inputs = {
            "bag": digest(cell.bag),
            "map": digest(cell.map),
            "config": config,
            "mode": cell.mode,
            "start": cell.start,
            "chain": [failure.model_dump(mode="json") for failure in cell.chain],
            "seed": cell.seed if cell.chain else None,
            "code": code_hash(),
        }
        seen = {name: inputs[name] for name in ("bag", "map", "code")} | {"dictionary": cell.config.markers.dictionary}
        if any(failure.pixels for failure in cell.chain):
            seen |= {name: inputs[name] for name in ("chain", "seed")}
        folder = cell.recording if in_folders else None
        if folder is not None:
            inputs["folder"] = folder
        jobs.append(Job(key=_hash(inputs), cell=cell, images=_hash(seen), folder=folder, command=command))
    return jobs


def _hash(inputs: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


@cache
def code_hash() -> str:
    """SHA-256 of the package's code, but for what only shows results, and of the versions of the solvers."""
    root = Path(fgloc.__file__).parent
    versions = [version(name) for name in ("gtsam", "numpy", "opencv-contrib-python-headless")]
    digest = hashlib.sha256(" ".join([sys.version, *versions]).encode())
    for source in sorted(root.rglob("*.py")):
        name = source.relative_to(root).as_posix()
        if name not in _SOURCES_LEFT_OUT and not name.startswith("cli/"):
            digest.update(name.encode())
            digest.update(source.read_bytes())
    return digest.hexdigest()


def finished(job: Job, out: Path) -> Record | None:
    """The record of a job that need not run; None if it has none, or if the files of its run are gone or another's."""
    record = read_record(out, job.key)
    if record is None or record.outcome != "done" or job.folder is None:
        return record
    owner = owner_path(out, job.folder)
    whole = (out / job.folder / "metrics.json").exists() and owner.exists() and owner.read_bytes() == job.key.encode()
    return record if whole else None


def execute(job: Job, out: Path) -> str:
    """Run a job unless it is finished already; return its key. A run that fails is recorded as such.

    Raises:
        OutputError: the record, or a file of the run, cannot be written.
    """
    if finished(job, out) is not None:
        return job.key
    log_attempt(out, job.key)
    began, cpu = time.perf_counter(), time.process_time()
    outcome: dict[str, Any]
    try:
        outcome = {"outcome": "done", **_localise(job, out)}
    except OutputError:
        raise  # a full disk is no property of the job
    except FglocError as error:
        outcome = {"outcome": "refused", "error": f"{type(error).__name__}: {error}"}
    except Exception:  # a bug: the sweep goes on, and the report lists it
        outcome = {"outcome": "crashed", "error": traceback.format_exc(limit=-4)}
    cost = Cost(
        seconds=time.perf_counter() - began,
        cpu_s=time.process_time() - cpu,
        peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    )
    write_record(out, Record(key=job.key, cost=cost, **outcome))
    return job.key


def detections_path(out: Path, job: Job) -> Path:
    """Path of the file with the markers detected in a job's images, shared by the jobs with the same images."""
    return out / "detections" / f"{job.images}.npz"


def detect(job: Job, out: Path) -> None:
    """Find the markers in all images of a job's recording, so that each job that sees them need not.

    What cannot be read is left to the jobs, which report it.
    """
    cell, memory = job.cell, None
    try:
        with open_recording(cell.bag, cell.config.recording) as recording:
            setup = recorded_setup(recording, cell.map, resolved(cell.config, cell.map))
            if setup.detector is None:
                return
            memory = setup.detector.remembering(setup.detector, detections_path(out, job), None)
            for event in recording.events():
                if isinstance(event, ImageEvent):
                    with suppress(ImageError):
                        memory.detect(event)
    except FglocError:
        pass
    if memory is not None:
        memory.save()


def _localise(job: Job, out: Path) -> dict[str, Any]:
    cell = job.cell
    config = resolved(cell.config, cell.map)
    with open_recording(cell.bag, config.recording) as recording:
        span = recording.span_ns[0], recording.duration_s
        sensors = _sensors(recording)
    landmark_map = configured_map(cell.map, config) if cell.map is not None else None
    failing = Corruption(cell.chain, span, config, landmark_map, cell.seed)
    if cell.start == "truth":
        config = start_at_truth(cell.bag, config)
    plain = job.folder is not None and not cell.chain  # in a sweep all runs of a recording have one set-up
    with tempfile.TemporaryDirectory(prefix="fgloc-") as folder:
        map_file = cell.map
        corrupted = None if landmark_map is None else failing.corrupt_map(landmark_map)
        if corrupted is not None and corrupted is not landmark_map:
            map_file = Path(folder) / "map.yaml"
            write_map(corrupted, map_file)
            config = with_values(config, "map", {"scale": 1.0, "size_scale": 1.0})  # it is in metres
        result = run(
            cell.bag,
            map_file,
            config,
            cell.mode,
            events=None if plain else failing.recorded,
            sightings=None if plain else failing.sightings,
            detections=detections_path(out, job) if job.folder is None else None,
        )
    config = result.config or config
    metrics = compute_metrics(result, config)
    if job.folder is not None:
        owner = owner_path(out, job.folder)
        owner.unlink(missing_ok=True)  # the files may be those of a run with other settings
        write_results(result, config, out / job.folder, job.command, sha256_of(cell.bag))
        write_text(owner, job.key)
    return {
        "figures": metrics.model_dump(mode="json", exclude=_COSTS),
        "modes": {mode.value: sum(m is mode for m in result.modes) / len(result.modes) for mode in Mode},
        "mistakes": result.mistakes,
        "sensors": sensors,
        "affected": failing.affected,
        "track": _track(result, config),
    }


def _sensors(recording: Recording) -> tuple[str, ...]:
    """Sensors with messages in a recording, as failures name them."""
    roles = [topic.role for topic in recording.topics if topic.role is not None and topic.count]
    heard = {stream.event for role in roles for stream in streams_of(role)}
    return tuple(name for name, events in events_by_sensor().items() if heard.intersection(events))


def _track(result: RunResult, config: Config) -> Track | None:
    matched = match_result(result, config)
    if matched is None:
        return None
    picked = np.unique(np.linspace(0, len(matched.estimate) - 1, _TRACK_POINTS).astype(int))
    estimate, truth = matched.estimate[picked, :2].round(4), matched.truth[picked, :2].round(4)
    return Track(estimate=estimate.tolist(), truth=truth.tolist())


def start_at_truth(bag: Path, config: Config) -> Config:
    """The configuration with the truth's first pose as the initial one.

    Raises:
        RecordingError: the recording has no truth.
    """
    with open_recording(bag, config.recording) as recording:
        first = next((event for event in recording.events() if isinstance(event, TruthEvent)), None)
    if first is not None and not first.has_yaw:
        raise RecordingError(f"{bag}: the truth has no yaw to start with; give estimator.initial_pose")
    if first is None:
        raise RecordingError(f"{bag}: no truth to start from; use 'start: configured' and estimator.initial_pose")
    x, y, yaw = base_pose(first, config.truth).tolist()
    return with_values(config, "estimator", {"initial_pose": (x, y, yaw)})
