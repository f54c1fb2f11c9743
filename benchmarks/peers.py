"""Beside others, on the same steps as installed: ``python -m benchmarks.peers [--export DIR] [--poses NAME=DIR]``.

- ``marker_poses``, ``corners``, ``corners_rules``: `benchmarks.textbook`.
- ``wheels``: dead reckoning by the wheels from the first true pose.
- ``fgloc``: online, with the learned motion that its ``robot.yaml`` names.
- Any other program takes part by its poses: ``--export`` writes each recording (``bag/``, ``robot.yaml``, ``map.yaml``
  in a folder of its name) and ends; ``--poses NAME=DIR`` reads ``DIR/RECORDING.tum`` into the same table.

Recordings that others made have a bench of their own (`benchmarks.public`).

``peers.CASE.NAME.*``: mean over the seeds, spread their standard deviation. ``peers.CASE.best_over_fgloc``: the least
mean ATE of the peers over fgloc's. ``update_ms``: mean processor time of a step without the detection of markers, of
those who run here.
"""

from __future__ import annotations

import argparse
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.common import Row, main, mean_row, ratio_row
from benchmarks.recordings import SEEDS, Recorded, Split, Take, changed, load, prepare
from benchmarks.replays import Replayed, failures, floor, kept, processor_times, replayed
from benchmarks.textbook import PIPELINES, Textbook
from fgloc import se2
from fgloc.ablation.failures import Corruption
from fgloc.config import WheelsConfig
from fgloc.evaluation.metrics import match, nees
from fgloc.files.outputs import read_tum
from fgloc.frames import quaternion_yaw
from fgloc.recording.reader import Recording
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Estimate, Event, Step, Trajectory, TruthEvent
from fgloc_datasets.bag import BagWriter

CASES = ("none", "slip", "dark30", "ids30", "moved", "frozen")
_REWRITTEN = (
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
)
_HERE = Path(__file__).parent
Poses = Mapping[str, Path]  # folder of another program's TUM files, by its name
Runs = dict[str, Callable[[Sequence[Step]], list[Estimate]]]  # by method
Scores = Mapping[str, Mapping[str, float]]  # by method: ate_mm, yaw_deg, nees_over_3, worst_mm, update_ms


def measure(quick: bool, split: Split, poses: Poses, seeds: int | None) -> Iterator[Row]:
    """Rows of the benchmark; a quick run has one seed and two cases."""
    cases, chosen = (CASES[:2], SEEDS[split][:1]) if quick else (CASES, SEEDS[split][:seeds])
    prepare(Take("installed", floor(case), split, seed) for case in cases for seed in chosen)
    for case in cases:
        runs = []
        for seed in chosen:
            truth = cache(lambda case=case, seed=seed: _truth(load(Take("installed", floor(case), split, seed)).events))
            runs.append({**_scored(case, split, seed), **_of_files(poses, f"{case}_{split}_{seed}", truth)})
            print(f"{case} {seed}", file=sys.stderr, flush=True)
        yield from _rows(case, runs)


def _rows(case: str, runs: Sequence[Scores]) -> Iterator[Row]:
    means: dict[str, float] = {}
    for name in runs[0]:
        for figure, unit in (("ate_mm", "mm"), ("yaw_deg", "deg"), ("nees_over_3", ""), ("worst_mm", "mm")):
            values = np.array([run[name][figure] for run in runs])
            if np.isfinite(values).all():
                yield Row(f"peers.{case}.{name}.{figure}", float(values.mean()), float(values.std()), len(values), unit)
            else:
                yield Row(f"peers.{case}.{name}.{figure}", None, n=len(values), reason="not in every run")
        means[name] = float(np.mean([run[name]["ate_mm"] for run in runs]))
        times = [run[name].get("update_ms", math.nan) for run in runs]
        if np.isnan(times).any():  # ran elsewhere
            continue
        yield mean_row(f"peers.{case}.{name}.update_ms", times, "ms")
    best = min((name for name in means if name != "fgloc"), key=lambda name: means[name])
    theirs, ours = ([run[name]["ate_mm"] for run in runs] for name in (best, "fgloc"))
    yield ratio_row(f"peers.{case}.best_over_fgloc", theirs, ours, best)


# --- Runs -------------------------------------------------------------------------------------------------------------


def _scored(case: str, split: Split, seed: int) -> Scores:
    """Scores of fgloc and all peers in one case, kept under the hash of fgloc's sources and of the peers'."""
    return kept(f"peers_{case}_{split}_{seed}", lambda: run_all(case, split, seed), Path(__file__))


def run_all(case: str, split: Split, seed: int) -> dict[str, dict[str, float]]:
    """Scores of fgloc and all peers on the steps of one replay."""
    recorded, made, ms = replay(case, split, seed)
    truth = made.online.truth
    assert truth is not None
    online = made.online.trajectory
    assert online.covs is not None
    stamps = online.stamps_ns.tolist()
    estimates = [Estimate(s, p, c) for s, p, c in zip(stamps, online.poses, online.covs, strict=True)]
    runs = others(recorded, made)
    return {"fgloc": score(estimates, truth) | {"update_ms": ms}} | _scores_of(runs, made.steps, truth)


def _scores_of(runs: Runs, steps: Sequence[Step], truth: Trajectory) -> dict[str, dict[str, float]]:
    out = {}
    for name, method in runs.items():
        began = time.process_time()
        found = method(steps)
        out[name] = score(found, truth) | {"update_ms": 1e3 * (time.process_time() - began) / len(steps)}
    return out


def replay(case: str, split: Split, seed: int) -> tuple[Recorded, Replayed, float]:
    """Fgloc's online run of a case: recording, what came of it, mean processor time of an update [ms]."""
    recorded = load(Take("installed", floor(case), split, seed))
    chain = failures(case, recorded)
    with processor_times() as times:
        made = replayed(recorded, changed(recorded.config, {}), chain, seed, False)
    if made is None or made.online.truth is None:
        raise ValueError(f"{case}, seed {seed}: no pose was ever found, or there is no truth")
    return recorded, made, float(np.mean(times))


def others(recorded: Recorded, made: Replayed) -> Runs:
    """Peers by name."""
    camera, landmarks, wheels = recorded.camera, made.landmarks, recorded.config.wheels
    assert camera is not None
    assert made.online.truth is not None
    truth = made.online.truth
    found: Runs = {pipeline: Textbook(pipeline, landmarks, camera, wheels).run for pipeline in PIPELINES}
    return found | {"wheels": lambda steps: dead_reckoning(steps, wheels, truth)}


def dead_reckoning(steps: Sequence[Step], wheels: WheelsConfig, truth: Trajectory) -> list[Estimate]:
    """Poses by the wheels alone from the first true pose; the covariance is NaN, and so is the NEES."""
    motion, pose, out = WheelMotion(wheels), None, []
    for step in steps:
        measured = motion.measure(step)
        if pose is None:
            if truth.stamps_ns[0] <= step.stamp_ns <= truth.stamps_ns[-1]:
                pose = truth.interpolate(step.stamp_ns)
        elif measured is not None:
            pose = se2.compose(pose, measured.motion)
        if pose is not None:
            out.append(Estimate(step.stamp_ns, pose, np.full((3, 3), np.nan)))
    return out


def score(estimates: Sequence[Estimate], truth: Trajectory) -> dict[str, float]:
    """Errors of a run against the truth; infinite if there is no pose."""
    if len(estimates) < 2:
        return dict.fromkeys(("ate_mm", "yaw_deg", "nees_over_3", "worst_mm"), math.inf)
    stamps = np.array([e.stamp_ns for e in estimates], dtype=np.int64)
    poses, covs = np.array([e.pose for e in estimates]), np.array([e.cov for e in estimates])
    matched = match(Trajectory(stamps, poses, covs), truth)
    assert matched.covs is not None
    known = np.isfinite(matched.covs).all()
    return {
        "ate_mm": 1e3 * float(matched.distances.mean()),
        "yaw_deg": math.degrees(float(np.abs(matched.errors[:, 2]).mean())),
        "nees_over_3": float(nees(matched.errors, matched.covs).mean()) / 3.0 if known else math.nan,
        "worst_mm": 1e3 * float(matched.distances.max()),
    }


# --- Programs that run elsewhere --------------------------------------------------------------------------------------


def _of_files(poses: Poses, name: str, truth: Callable[[], Trajectory]) -> Scores:
    """Scores of the TUM files of other programs; infinite where a file is missing."""
    out = {}
    for program, folder in poses.items():
        path = folder / f"{name}.tum"
        read = read_tum(path) if path.is_file() else None
        stamps = [] if read is None else read.stamps_ns.tolist()
        unknown = np.full((3, 3), np.nan)
        estimates = [] if read is None else [Estimate(s, p, unknown) for s, p in zip(stamps, read.poses, strict=True)]
        out[program] = score(estimates, truth())
    return out


def _truth(events: Iterable[Event]) -> Trajectory:
    true = [e for e in events if isinstance(e, TruthEvent)]
    poses = [(e.position[0], e.position[1], quaternion_yaw(e.orientation)) for e in true]
    return Trajectory(np.array([e.stamp_ns for e in true], dtype=np.int64), np.array(poses))


def export(out: Path, quick: bool, split: Split, seeds: int | None) -> None:
    """Write the input of all peers, a folder for each recording: ``bag/``, ``robot.yaml``, ``map.yaml``.

    Images are replaced by the corners that fgloc detects in them; failures are made.
    """
    cases, chosen = (CASES[:2], SEEDS[split][:1]) if quick else (CASES, SEEDS[split][:seeds])
    prepare(Take("installed", floor(case), split, seed) for case in cases for seed in chosen)
    for case in cases:
        for seed in chosen:
            _export(load(Take("installed", floor(case), split, seed)), case, seed, out / f"{case}_{split}_{seed}")


def _export(recorded: Recorded, case: str, seed: int, out: Path) -> None:
    chain = failures(case, recorded)
    span = recorded.start_ns, recorded.duration_s
    failing = Corruption(chain, span, recorded.config, recorded.landmarks, seed)
    landmarks = failing.corrupt_map(recorded.landmarks)
    events = failing.sightings(failing.recorded(iter(recorded.events)))
    with BagWriter(out / "bag", overwrite=True) as bag, Recording(recorded.bag, recorded.config.recording) as source:
        for topic, kind, received_ns, raw in source.messages():
            if kind not in _REWRITTEN:
                bag.copy(topic, kind, raw, received_ns)
        for event in events:
            _write(bag, event)
    shutil.copy(recorded.bag.parent / "robot.yaml", out / "robot.yaml")
    write_map(landmarks, out / "map.yaml")


def _write(bag: BagWriter, event: Event) -> None:
    match event:
        case JointsEvent(stamp_ns=stamp, received_ns=received, topic=topic):
            arrays = (event.position.tolist(), event.velocity.tolist(), event.effort.tolist())
            bag.joints(topic, stamp, event.names, *arrays, received_ns=received)
        case ImuEvent(stamp_ns=stamp, received_ns=received, topic=topic):
            rates = (event.angular_velocity.tolist(), event.linear_acceleration.tolist())
            variances = (float(event.angular_velocity_cov[0, 0]), 0.0)
            bag.imu(topic, stamp, *rates, received, event.frame_id, variances)
        case CornersEvent(stamp_ns=stamp, received_ns=received):
            seen = {s.landmark_id: s.corners_px for s in event.sightings}
            bag.corners("/tag_detections", stamp, seen, received, event.frame_id)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--seeds", type=int, help="so many of the split's seeds")
    parser.add_argument("--export", type=Path, metavar="DIR", help="write the recordings there and end")
    parser.add_argument("--poses", action="append", default=[], metavar="NAME=DIR", help="another program's TUM files")
    known, rest = parser.parse_known_args()
    if known.export is not None:
        export(known.export, "--quick" in rest, known.split, known.seeds)
    else:
        named = {name: Path(folder) for name, _, folder in (given.partition("=") for given in known.poses)}
        main(lambda quick: measure(quick, known.split, named, known.seeds), __doc__ or "", rest)
