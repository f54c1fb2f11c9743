"""Beside others, on the same steps as installed: ``python -m benchmarks.peers [--export DIR] [--poses NAME=DIR]``.

- ``marker_poses``, ``corners``, ``corners_rules``: `benchmarks.textbook`.
- ``wheels``: dead reckoning by the wheels from the first true pose.
- ``fgloc``: online, with the learned motion that its ``robot.yaml`` names.
- Any other program takes part by its poses: ``--export`` writes each recording (``bag/``, ``robot.yaml``, ``map.yaml``
  in a folder of its name) and ends; ``--poses NAME=DIR`` reads ``DIR/RECORDING.tum`` into the same table.

The case ``mrclam`` has five real robots among beacons, each with the constants of the other four. All begin at the true
pose, take the same steps and the constants of ``robot.yaml`` (gains and delay of the commands, scale of the camera's
ranges, offset of its bearings); ``fgloc`` has the motion model of the other four. ``beacons`` is iSAM2 as a good
engineer writes it in an afternoon: commands integrated at constant noise, ranges and bearings with a Cauchy kernel,
landmarks held by tight priors. Its constants are the best of 13 sets on robots 1 and 2 (least geometric mean of the
ATE), which are among the five. ``wheels``: the commands alone.

``peers.CASE.NAME.*``: mean over the seeds, spread their standard deviation. ``peers.CASE.best_over_fgloc``: the least
mean ATE of the peers over fgloc's. ``update_ms``: mean processor time of a step without the detection of markers, of
those who run here.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.common import Row, main, not_run
from benchmarks.recordings import MRCLAM, SEEDS, Recorded, Split, Take, changed, converted, load, prepare
from benchmarks.replays import Replayed, failures, floor, kept, processor_times, replayed
from benchmarks.textbook import PIPELINES, Textbook
from fgloc import se2
from fgloc.ablation.failures import corrupt, generators
from fgloc.ablation.jobs import start_at_truth
from fgloc.config import Config, WheelsConfig, load_config
from fgloc.evaluation.metrics import match, nees
from fgloc.files.outputs import read_tum
from fgloc.frames import quaternion_yaw
from fgloc.recording.reader import Recording, open_recording
from fgloc.runner import run
from fgloc.sensors.failures import Scene
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.maps import load_map, write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Estimate, Event, FloatArray, LandmarkMap, Step, Trajectory, TruthEvent
from fgloc_datasets import mrclam
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
    if MRCLAM.is_dir():
        robots = mrclam.ROBOTS[: 1 if quick else None]
        runs = [{**_robot(k), **_of_files(poses, f"mrclam_{k}", lambda k=k: _robots_truth(k))} for k in robots]
        yield from _rows("mrclam", runs)
    else:
        yield from not_run(["peers.mrclam.best_over_fgloc"], f"no {MRCLAM}; set FGLOC_REAL_DATA")


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
        yield Row(f"peers.{case}.{name}.update_ms", float(np.mean(times)), float(np.std(times)), len(times), "ms")
    best = min((name for name in means if name != "fgloc"), key=lambda name: means[name])
    ratios = np.array([run[best]["ate_mm"] / run["fgloc"]["ate_mm"] for run in runs])
    yield Row(f"peers.{case}.best_over_fgloc", means[best] / means["fgloc"], float(ratios.std()), len(runs), best)


# --- Runs -------------------------------------------------------------------------------------------------------------


def _scored(case: str, split: Split, seed: int) -> Scores:
    """Scores of fgloc and all peers in one case, kept under the hash of fgloc's sources and of the peers'."""
    return kept(f"peers_{case}_{split}_{seed}_{_sources()}", lambda: run_all(case, split, seed))


@cache
def _sources() -> str:
    """Hash of the sources of this benchmark's peers."""
    parts = [(_HERE / f"{name}.py").read_bytes() for name in ("peers", "textbook")]
    return hashlib.sha256(b"".join(parts)).hexdigest()[:12]


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


def _robot(robot: int) -> Scores:
    """Scores of fgloc and all peers on one robot of MRCLAM, kept likewise."""

    def run_all() -> dict[str, dict[str, float]]:
        with processor_times() as times:
            made = replay_robot(robot)
        ours = score(made.estimates, made.truth) | {"update_ms": float(np.mean(times))}
        runs: Runs = {
            "beacons": lambda steps: Beacons(made).run(steps, made.truth),
            "wheels": lambda steps: dead_reckoning(steps, made.config.wheels, made.truth),
        }
        return {"fgloc": ours} | _scores_of(runs, made.steps, made.truth)

    return kept(f"peers_mrclam_{robot}_{_sources()}", run_all)


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


def _robots_truth(robot: int) -> Trajectory:
    with tempfile.TemporaryDirectory() as scratch:
        bag = mrclam.convert(MRCLAM, robot, Path(scratch) / "robot")
        with open_recording(bag, load_config(bag.parent / "robot.yaml").recording) as recording:
            return _truth(recording.events())


def export(out: Path, quick: bool, split: Split, seeds: int | None) -> None:
    """Write the input of all peers, a folder for each recording: ``bag/``, ``robot.yaml``, ``map.yaml``.

    Images are replaced by the corners that fgloc detects in them; failures are made.
    """
    cases, chosen = (CASES[:2], SEEDS[split][:1]) if quick else (CASES, SEEDS[split][:seeds])
    prepare(Take("installed", floor(case), split, seed) for case in cases for seed in chosen)
    for case in cases:
        for seed in chosen:
            _export(load(Take("installed", floor(case), split, seed)), case, seed, out / f"{case}_{split}_{seed}")
    if MRCLAM.is_dir():
        for robot in mrclam.ROBOTS[: 1 if quick else None]:
            mrclam.convert(MRCLAM, robot, out / f"mrclam_{robot}")


def _export(recorded: Recorded, case: str, seed: int, out: Path) -> None:
    chain = failures(case, recorded)
    ids = tuple(sorted(recorded.landmarks.landmarks))
    scenes = [
        Scene(recorded.start_ns, recorded.duration_s, recorded.config, ids, rng) for rng in generators(len(chain), seed)
    ]
    landmarks = recorded.landmarks
    for made, scene in zip(chain, scenes, strict=True):
        landmarks = made.corrupt_map(landmarks, scene)
    events = corrupt(chain, "sightings", corrupt(chain, "recorded", iter(recorded.events), scenes), scenes)
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


# --- Beacons of MRCLAM ------------------------------------------------------------------------------------------------


_START = np.array([0.1, 0.1, 0.1])  # m, m, rad
_HELD_M = 1e-3  # of a landmark
_LANDMARKS = 1_000_000_000  # keys of landmarks are above those of poses


@dataclass(frozen=True, slots=True)
class Constants:
    """Sigmas: of motion over a second, growing with the root of time, and of a sighting."""

    motion_m: float = 0.02
    motion_rad: float = 0.05
    range_m: float = 0.1
    bearing_rad: float = 0.03
    cauchy: float = 1.0  # in sigmas


@dataclass(frozen=True, slots=True, eq=False)
class RobotReplay:
    """A robot's run: what fgloc made of it, and the steps that the others take."""

    config: Config
    landmarks: LandmarkMap
    steps: list[Step]
    estimates: list[Estimate]
    truth: Trajectory


def replay_robot(robot: int) -> RobotReplay:
    """Fgloc online on one robot's recording, begun at the true pose."""
    steps: list[Step] = []
    estimates: list[Estimate] = []

    def note(step: Step, estimate: Estimate | None) -> None:
        steps.append(step)
        estimates.extend([] if estimate is None else [estimate])

    with tempfile.TemporaryDirectory() as scratch:
        bag, map_yaml, config = converted(robot, Path(scratch))
        config = start_at_truth(bag, config)
        truth = run(bag, map_yaml, config, "online", on_step=note).truth
        landmarks = load_map(map_yaml)
    assert truth is not None
    return RobotReplay(config, landmarks, steps, estimates, truth)


class Beacons:
    """The plain pipeline, fed with steps."""

    def __init__(self, replayed: RobotReplay, constants: Constants | None = None) -> None:
        """Take what the installer believes."""
        self._constants = c = constants or Constants()
        self._config, self._landmarks = replayed.config, replayed.landmarks.landmarks
        self._commands = WheelMotion(replayed.config.wheels)
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(c.cauchy)
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([c.bearing_rad, c.range_m]))
        self._sighting_noise = gtsam.noiseModel.Robust.Create(kernel, sigmas)
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        self._held: set[int] = set()
        self._k = 0
        self._pose: FloatArray | None = None

    def run(self, steps: Iterable[Step], truth: Trajectory) -> list[Estimate]:
        """All poses, from the first one that is known in truth on."""
        out = []
        for step in steps:
            if self._pose is not None:
                out.append(self._update(step))
            elif truth.stamps_ns[0] <= step.stamp_ns <= truth.stamps_ns[-1]:
                self._pose = truth.interpolate(step.stamp_ns)
                prior = gtsam.noiseModel.Diagonal.Sigmas(_START)
                out.append(self._solve(step, [gtsam.PriorFactorPose2(0, gtsam.Pose2(*self._pose), prior)], self._pose))
        return out

    def _update(self, step: Step) -> Estimate:
        measured, c, root_s = self._commands.measure(step), self._constants, step.dt**0.5
        motion = np.zeros(3) if measured is None else measured.motion
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([c.motion_m, c.motion_m, c.motion_rad]) * root_s)
        self._k += 1
        assert self._pose is not None
        between = gtsam.BetweenFactorPose2(self._k - 1, self._k, gtsam.Pose2(*motion), noise)
        return self._solve(step, [between], se2.compose(self._pose, motion))

    def _solve(self, step: Step, factors: list[gtsam.NonlinearFactor], initial: FloatArray) -> Estimate:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(self._k, gtsam.Pose2(*initial))
        for event in step.sightings:
            for seen in event.sightings if isinstance(event, RangeBearingEvent) else ():
                if seen.landmark_id in self._landmarks:
                    factors.append(self._sighting(seen))
                    self._hold(seen.landmark_id, factors, values)
        for factor in factors:
            graph.add(factor)
        self._isam.update(graph, values)
        pose = self._isam.calculateEstimatePose2(self._k)
        self._pose = np.array([pose.x(), pose.y(), pose.theta()])
        cov = np.asarray(self._isam.marginalCovariance(self._k))
        return Estimate(step.stamp_ns, self._pose, se2.rotate_cov(cov, pose.theta()))

    def _sighting(self, seen: RangeBearing) -> gtsam.NonlinearFactor:
        section, mounting = self._config.landmarks, self._config.recording.sightings_pose
        assert mounting is not None
        depth, bearing = section.range_scale * seen.range_m, seen.bearing_rad - section.bearing_bias_rad
        x, y = depth + mounting[0], depth * np.tan(bearing)  # depth is along the axis
        key, direction = _LANDMARKS + seen.landmark_id, gtsam.Rot2(float(np.arctan2(y, x)))
        return gtsam.BearingRangeFactor2D(self._k, key, direction, float(np.hypot(x, y)), self._sighting_noise)

    def _hold(self, landmark_id: int, factors: list[gtsam.NonlinearFactor], values: gtsam.Values) -> None:
        if landmark_id not in self._held:
            self._held.add(landmark_id)
            place, key = self._landmarks[landmark_id].position[:2], _LANDMARKS + landmark_id
            factors.append(gtsam.PriorFactorPoint2(key, place, gtsam.noiseModel.Isotropic.Sigma(2, _HELD_M)))
            values.insert(key, place)


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
