"""One run of a sweep: named by the hash of its inputs, executed once, its record written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

import fgloc
from fgloc import se2
from fgloc.ablation.failures import Scene, generators, spoil
from fgloc.ablation.suite import Cell
from fgloc.config import Config
from fgloc.errors import FglocError, RecordingError
from fgloc.evaluation.metrics import Metrics, compute_metrics, match_result
from fgloc.frames import quaternion_yaw
from fgloc.recording.outputs import sha256_of, write_json
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.maps import load_map, write_map
from fgloc.types import Mode, RunResult, TruthEvent

_TRACK_POINTS = 200
_SOURCES_LEFT_OUT = (
    "cli.py",
    "ablation/report.py",
    "ablation/tables.py",
    "ablation/sweep.py",
    "evaluation/plots.py",
    "evaluation/ablation_plots.py",
    "evaluation/html.py",
    "evaluation/report.py",
)
_COSTS = {"real_time_factor", "step_ms"}


class Track(BaseModel):
    """Estimate and truth at common times, for a picture [m]."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    estimate: list[tuple[float, float]]
    truth: list[tuple[float, float]]


class Cost(BaseModel):
    """What a run took; never the same twice."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seconds: float
    peak_mb: float
    real_time_factor: float | None = None


class Record(BaseModel):
    """What is known of a job after its run. All but ``cost`` depends on the inputs alone."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    outcome: Literal["done", "refused", "crashed"]
    error: str = ""  # of a refused run the message, of a crashed one the traceback
    figures: dict[str, Any] = {}  # of Metrics, without times
    modes: dict[str, float] = {}  # mode -> share of the poses
    touched: dict[str, int] = {}  # events that the failures changed, by kind
    track: Track | None = None
    cost: Cost


class Job(BaseModel):
    """A cell and the hash of everything that its result depends on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    key: str
    cell: Cell


def make_jobs(cells: Sequence[Cell]) -> list[Job]:
    """Name each cell by the SHA-256 of recording, map, model, configuration, failures, seed and code.

    Two cells with the same inputs get the same key, and run once.
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
        config["camera"]["file"] = digest(cell.config.camera.file)
        config["motion"]["model"] = digest(cell.config.motion.model)
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
        jobs.append(Job(key=hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest(), cell=cell))
    return jobs


@cache
def code_hash() -> str:
    """SHA-256 of the package's code, but for what only shows results, and of the versions of the solvers."""
    root = Path(fgloc.__file__).parent
    sources = (
        file for file in sorted(root.rglob("*.py")) if file.relative_to(root).as_posix() not in _SOURCES_LEFT_OUT
    )
    digest = hashlib.sha256(" ".join([sys.version, version("gtsam"), version("numpy")]).encode())
    for source in sources:
        digest.update(source.relative_to(root).as_posix().encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()


def record_path(out: Path, key: str) -> Path:
    """Where a job's record is."""
    return out / "jobs" / f"{key}.json"


def read_record(out: Path, key: str) -> Record | None:
    """A job's record; None if it has none."""
    path = record_path(out, key)
    return Record.model_validate_json(path.read_bytes()) if path.exists() else None


def write_record(out: Path, record: Record) -> None:
    """Write a job's record, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    write_json(record_path(out, record.key), record.model_dump(mode="json"))


def execute(job: Job, out: Path) -> str:
    """Run a job unless its record is there already; return its key. A run that fails is recorded as such.

    Raises:
        OutputError: the record cannot be written.
    """
    if record_path(out, job.key).exists():
        return job.key
    _log_attempt(out, job.key)
    began = time.perf_counter()
    outcome: dict[str, Any]
    try:
        outcome = {"outcome": "done", **_localise(job.cell)}
    except FglocError as error:
        outcome = {"outcome": "refused", "error": f"{type(error).__name__}: {error}"}
    except Exception:  # a bug: the sweep goes on, and the report lists it
        outcome = {"outcome": "crashed", "error": traceback.format_exc(limit=-4)}
    cost = Cost(
        seconds=time.perf_counter() - began,
        peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        real_time_factor=outcome.pop("real_time_factor", None),
    )
    write_record(out, Record(key=job.key, cost=cost, **outcome))
    return job.key


def attempts(out: Path) -> list[tuple[str, float]]:
    """Key and time [s since 1970] of every run that was begun, in order."""
    path = out / "jobs" / "attempts.log"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [(key, float(stamp)) for key, stamp in (line.split() for line in lines)]


def _log_attempt(out: Path, key: str) -> None:
    folder = out / "jobs"
    folder.mkdir(parents=True, exist_ok=True)
    file = os.open(folder / "attempts.log", os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(file, f"{key} {time.time():.6f}\n".encode())  # one short write: lines of several workers do not mix
    finally:
        os.close(file)


def _localise(cell: Cell) -> dict[str, Any]:
    config = cell.config
    with open_recording(cell.bag, config.recording) as recording:
        start_ns, duration_s = recording.span_ns[0], recording.duration_s
    landmark_map = load_map(cell.map, config.markers.default_size_m) if cell.map is not None else None
    ids = () if landmark_map is None else tuple(sorted(landmark_map.landmarks))
    scenes = [Scene(start_ns, duration_s, config, ids, rng) for rng in generators(len(cell.chain), cell.seed)]
    if cell.start == "truth":
        config = _start_at_truth(cell.bag, config)
    with tempfile.TemporaryDirectory(prefix="fgloc-") as folder:
        map_file = cell.map
        if landmark_map is not None:
            spoiled = landmark_map
            for failure, scene in zip(cell.chain, scenes, strict=True):
                spoiled = failure.spoil_map(spoiled, scene)
            if spoiled is not landmark_map:
                map_file = Path(folder) / "map.yaml"
                write_map(spoiled, map_file)
        result = run(
            cell.bag,
            map_file,
            config,
            cell.mode,
            events=lambda events: spoil(cell.chain, "recorded", events, scenes),
            sightings=lambda events: spoil(cell.chain, "sightings", events, scenes),
        )
    metrics = compute_metrics(result, config)
    touched: dict[str, int] = {}
    for scene in scenes:
        for kind, n in scene.touched.items():
            touched[kind] = touched.get(kind, 0) + n
    return {
        "figures": _figures(metrics),
        "modes": {mode.value: sum(m is mode for m in result.modes) / len(result.modes) for mode in Mode},
        "touched": touched,
        "track": _track(result, config),
        "real_time_factor": metrics.real_time_factor,
    }


def _figures(metrics: Metrics) -> dict[str, Any]:
    return metrics.model_dump(mode="json", exclude=_COSTS)


def _track(result: RunResult, config: Config) -> Track | None:
    matched = match_result(result, config)
    if matched is None:
        return None
    picked = np.unique(np.linspace(0, len(matched.estimate) - 1, _TRACK_POINTS).astype(int))
    estimate, truth = matched.estimate[picked, :2].round(4), matched.truth[picked, :2].round(4)
    return Track(estimate=estimate.tolist(), truth=truth.tolist())


def _start_at_truth(bag: Path, config: Config) -> Config:
    """The configuration with the truth's first pose as the initial one.

    Raises:
        RecordingError: the recording has no truth.
    """
    with open_recording(bag, config.recording) as recording:
        first = next((event for event in recording.events() if isinstance(event, TruthEvent)), None)
    if first is None:
        raise RecordingError(f"{bag}: no truth to start from; use 'start: configured' and estimator.initial_pose")
    T_body_base = se2.inverse((*config.truth.offset_m, config.truth.yaw_offset_rad))
    pose = se2.compose((first.position[0], first.position[1], quaternion_yaw(first.orientation)), T_body_base)
    x, y, yaw = pose.tolist()
    estimator = config.estimator.model_copy(update={"initial_pose": (x, y, yaw)})
    return config.model_copy(update={"estimator": estimator})
