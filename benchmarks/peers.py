"""Beside others, on the same steps as installed: ``python -m benchmarks.peers --robot-localization FOLDER [--tune]``.

- ``robot_localization``: its own EKF, built from its sources (branch noetic-devel), fed with wheel twist, gyro and
  poses from images: of each marker alone (``rl_marker_poses``) or of all of an image by RANSAC (``rl_pnp``). The
  settings were chosen on validation recordings by ``--tune`` (`benchmarks.peers_localizer`).
- ``marker_poses``, ``corners``, ``corners_rules``: `benchmarks.textbook`.
- ``wheels``: dead reckoning by the wheels from the first true pose.
- ``fgloc``: online, with the learned motion that its ``robot.yaml`` names.

The case ``mrclam`` has five real robots: see `benchmarks.peers_mrclam`.

``peers.CASE.NAME.*``: mean over the seeds, spread their standard deviation. ``peers.CASE.best_over_fgloc``: the least
mean ATE of the peers over fgloc's. ``update_ms``: mean processor time of a step without the detection of markers.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import peers_filter, peers_mrclam
from benchmarks.adaptive_recordings import Recorded, Split
from benchmarks.adaptive_runs import CASES as FAILURES
from benchmarks.adaptive_runs import Replayed, changed, failure, replayed
from benchmarks.common import Row, main, not_run
from benchmarks.installed_recordings import SEEDS, Take, load, prepare
from benchmarks.installed_runs import floor, kept, processor_times
from benchmarks.peers_localizer import GRID, KINDS, Kind, Localizer, Settings
from benchmarks.textbook import PIPELINES, Textbook
from fgloc import se2
from fgloc.datasets import mrclam
from fgloc.evaluation.consistency import nees
from fgloc.evaluation.matching import match
from fgloc.sensors.wheels.config import WheelsConfig
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Estimate, Step, Trajectory

CASES = ("none", "slip", "dark30", "ids30", "moved", "frozen")
TUNED: dict[Kind, Settings] = {
    "marker_poses": Settings(
        noise_xy=0.003, noise_v=0.1, pose_rad=0.005, reject_twist=3.0, wheel_v=0.1, wheel_omega=0.2, gyro=0.03
    ),
    "pnp": Settings(noise_xy=0.03, noise_yaw=0.003, noise_v=0.1, pose_m=0.05, pose_rad=0.005, wheel_v=0.1, gyro=0.003),
}
"""What ``--tune`` gave on 2026-11-22: 33.5 and 37.4 mm, geometric means over the cases."""
_TUNED_ON = (41, 42)  # of the validation split
_ROUNDS = 2
_LOST_M = 10.0  # an error that counts for one without an end, in the mean of logarithms
Runs = dict[str, Callable[[Sequence[Step]], list[Estimate]]]  # by method
Scores = Mapping[str, Mapping[str, float]]  # by method: ate_mm, yaw_deg, nees_over_3, worst_mm, update_ms


def measure(quick: bool, split: Split, library: Path | str, seeds: int | None) -> Iterator[Row]:
    """All rows; a quick run has one seed and two cases."""
    cases, chosen = (CASES[:2], SEEDS[split][:1]) if quick else (CASES, SEEDS[split][:seeds])
    if isinstance(library, str):
        yield from not_run([f"peers.{case}.best_over_fgloc" for case in cases], library)
        return
    prepare(Take("installed", floor(case), split, seed) for case in cases for seed in chosen)
    for case in cases:
        runs = []
        for seed in chosen:
            runs.append(_scored(case, split, seed, library))
            print(f"{case} {seed}", file=sys.stderr, flush=True)
        yield from _rows(case, runs)
    if peers_mrclam.SOURCE.is_dir():
        yield from _rows("mrclam", [_robot(robot, library) for robot in mrclam.ROBOTS[: 1 if quick else None]])
    else:
        yield from not_run(["peers.mrclam.best_over_fgloc"], f"no {peers_mrclam.SOURCE}; set FGLOC_REAL_DATA")


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
        times = [run[name]["update_ms"] for run in runs]
        yield Row(f"peers.{case}.{name}.update_ms", float(np.mean(times)), float(np.std(times)), len(times), "ms")
    best = min((name for name in means if name != "fgloc"), key=lambda name: means[name])
    ratios = np.array([run[best]["ate_mm"] / run["fgloc"]["ate_mm"] for run in runs])
    yield Row(f"peers.{case}.best_over_fgloc", means[best] / means["fgloc"], float(ratios.std()), len(runs), best)


# --- Runs -------------------------------------------------------------------------------------------------------------


def _scored(case: str, split: Split, seed: int, library: Path) -> Scores:
    """Scores of everybody in one case, kept under the hash of fgloc's sources and of the peers'."""
    made = peers_filter.sources_key(library, *map(repr, TUNED.values()))
    name = f"peers_{case}_{split}_{seed}_{made}"
    return kept(name, lambda: run_all(case, split, seed, library))


def run_all(case: str, split: Split, seed: int, library: Path) -> dict[str, dict[str, float]]:
    """Everybody on the steps of one replay."""
    recorded, made, ms = replay(case, split, seed)
    truth = made.online.truth
    assert truth is not None
    online = made.online.trajectory
    assert online.covs is not None
    stamps = online.stamps_ns.tolist()
    estimates = [Estimate(s, p, c) for s, p, c in zip(stamps, online.poses, online.covs, strict=True)]
    runs = others(recorded, made, library)
    return {"fgloc": score(estimates, truth) | {"update_ms": ms}} | _scores_of(runs, made.steps, truth)


def _robot(robot: int, library: Path) -> Scores:
    """Scores of everybody on one robot of MRCLAM, kept likewise."""

    def run_all() -> dict[str, dict[str, float]]:
        with processor_times() as times:
            made = peers_mrclam.replay(robot)
        ours = score(made.estimates, made.truth) | {"update_ms": float(np.mean(times))}
        runs: Runs = {
            "beacons": lambda steps: peers_mrclam.Beacons(made).run(steps, made.truth),
            "wheels": lambda steps: dead_reckoning(steps, made.config.wheels, made.truth),
        }
        return {"fgloc": ours} | _scores_of(runs, made.steps, made.truth)

    return kept(f"peers_mrclam_{robot}_{peers_filter.sources_key(library)}", run_all)


def _scores_of(runs: Runs, steps: Sequence[Step], truth: Trajectory) -> dict[str, dict[str, float]]:
    out = {}
    for name, run in runs.items():
        began = time.process_time()
        found = run(steps)
        out[name] = score(found, truth) | {"update_ms": 1e3 * (time.process_time() - began) / len(steps)}
    return out


def replay(case: str, split: Split, seed: int) -> tuple[Recorded, Replayed, float]:
    """Fgloc's online run of a case: recording, what came of it, mean processor time of an update [ms]."""
    recorded = load(Take("installed", floor(case), split, seed))
    chain = [failure(described) for described in FAILURES[case].chain(recorded)]
    with processor_times() as times:
        made = replayed(recorded, changed(recorded.config, {}), chain, seed, False)
    if made is None or made.online.truth is None:
        raise ValueError(f"{case}, seed {seed}: no pose was ever found, or there is no truth")
    return recorded, made, float(np.mean(times))


def others(recorded: Recorded, made: Replayed, library: Path) -> Runs:
    """Everybody else, by name."""
    camera, landmarks, wheels = recorded.camera, made.landmarks, recorded.config.wheels
    assert camera is not None
    assert made.online.truth is not None
    truth = made.online.truth
    found: Runs = {
        f"rl_{kind}": lambda steps, k=kind: Localizer(library, k, landmarks, camera, steps).run(TUNED[k])  # type: ignore[misc]
        for kind in KINDS
    }
    found |= {pipeline: Textbook(pipeline, landmarks, camera, wheels).run for pipeline in PIPELINES}
    return found | {"wheels": lambda steps: dead_reckoning(steps, wheels, truth)}


def dead_reckoning(steps: Sequence[Step], wheels: WheelsConfig, truth: Trajectory) -> list[Estimate]:
    """Wheels alone from the first true pose; no covariance is claimed, so that its NEES is not a number."""
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


# --- Tuning -----------------------------------------------------------------------------------------------------------


def tune(library: Path) -> dict[Kind, Settings]:
    """The settings of the least geometric mean ATE over the cases of the validation recordings, axis by axis."""
    prepare(Take("installed", floor(case), "validation", seed) for case in CASES for seed in _TUNED_ON)
    replays = [replay(case, "validation", seed)[:2] for case in CASES for seed in _TUNED_ON]
    return {kind: _tuned(library, kind, replays) for kind in KINDS}


def _tuned(library: Path, kind: Kind, replays: Sequence[tuple[Recorded, Replayed]]) -> Settings:
    fed = []
    for recorded, made in replays:
        assert recorded.camera is not None
        assert made.online.truth is not None
        localizer = Localizer(library, kind, made.landmarks, recorded.camera, made.steps)
        fed.append((localizer, made.online.truth))

    def cost(settings: Settings) -> float:
        ates_m = [1e-3 * score(localizer.run(settings), truth)["ate_mm"] for localizer, truth in fed]
        return float(np.mean([math.log(min(ate, _LOST_M)) for ate in ates_m]))

    best = TUNED[kind]
    least = cost(best)
    for _ in range(_ROUNDS):
        for name, values in GRID.items():
            changes: list[dict[str, Any]] = [{name: value} for value in values if value != getattr(best, name)]
            tried = [replace(best, **change) for change in changes]
            for settings, found in zip(tried, map(cost, tried), strict=True):
                if found < least:
                    best, least = settings, found
        print(f"{kind}: {1e3 * math.exp(least):.1f} mm, {best}", file=sys.stderr, flush=True)
    return best


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--robot-localization", type=Path, default=os.environ.get("ROBOT_LOCALIZATION"), metavar="DIR")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--seeds", type=int, help="so many of the split's seeds")
    parser.add_argument("--tune", action="store_true", help="choose robot_localization's settings and end")
    known, rest = parser.parse_known_args()
    built = (
        peers_filter.build(known.robot_localization)
        if known.robot_localization is not None
        else "robot_localization's sources are not given: --robot-localization DIR"
    )
    if known.tune and isinstance(built, Path):
        print("\n".join(f"{kind}: {settings}" for kind, settings in tune(built).items()))
    else:
        main(lambda quick: measure(quick, known.split, built, known.seeds), __doc__ or "", rest)
