"""Drives beyond two wheels, on recordings that others made: ``python -m benchmarks.drives [--quick] [--json FILE]``.

The bags are those of `benchmarks.field_recordings`, in their owners' units. A robot is described as its owner does, in
`wheels.drive`; ``fgloc calibrate`` finds its geometry by the truth of what is named below, and ``fgloc smooth`` runs with it.

- ``mecanum.bag2.{ate_m,nees_over_3}``: wheels' ticks. Calibrated on bag1 and the first half of bag2, reported on all of
  bag2; ``.second_half.ate_m`` on what calibration did not see, ``.nominal.ate_m`` without it. Poses of the truth that are
  repeated are left out.
- ``tricycle.{ate_m,parameters_sigma}``: raw ticks, from the guesses of the file's header. Calibrated and reported on the
  whole recording, as the fit that it is compared with was: the largest difference of a parameter from that fit, in our
  sigmas. ``.half.ate_m``: calibrated on the first half, reported on the second. ``.nominal.ate_m``: the guesses.

- ``sim.two_cameras.front_dark.over_none``: simulated robots as installed, with a front and a rear camera, online; ATE where
  the front one is dark for 60 of 100 s over that where none is, both as means over the seeds. ``.one_dark.over_none``: the same
  of a robot without the rear camera. ``.update_over_one``: mean time of a step with both over that with the front one alone.

Further rows are those of `benchmarks.drives_radio` (ranges and positions), `benchmarks.drives_odometry` (a second
odometry) and `benchmarks.drives_sim` (``sim.*``: simulated robots), which say themselves what was chosen on which data.

ATE is the rmse of positions, the truth's frame fitted by a rigid motion. The length of the
calibration's windows was chosen on the whole tricycle (its parameters are 3.8 sigmas from that fit with 2 s in place of 4 s),
the noise as it is most likely on bag1 and the first half of bag2.
"""

# ruff: noqa: E501 (lines of the description)
from __future__ import annotations

import heapq
import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import drives_odometry, drives_radio, drives_sim
from benchmarks.common import Row, main, not_run
from benchmarks.field_recordings import DATA, RECORDINGS, Recording, mecanum, tricycle
from fgloc.calibrate import calibrate
from fgloc.config import Config, config_of
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.runner import RunResult, run
from fgloc.types import Event, FloatArray, Trajectory
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.physics import make_scene, simulate
from fgloc_datasets.sim.record import robot_settings, write_beside
from fgloc_datasets.sim.scenario import FRONT, REAR, Camera, Installation, Scenario
from fgloc_datasets.sim.sensors import stamp_ns, streams

MECANUM: dict[str, Any] = {
    "recording": {"topics": {"odometry": "none"}},
    "wheels": {
        "drive": {
            "kind": "mecanum",
            "wheels": ["front_left", "front_right", "rear_left", "rear_right"],
            "radius": 0.07 / 5.0,  # over the gear
            "ticks_per_turn": 42,
            "half_sum": 0.200 + 0.169,
        }
    },
    "truth": {"align": "se2"},
}
TRICYCLE: dict[str, Any] = {
    "recording": {"topics": {"odometry": "none"}},
    "wheels": {
        "drive": {
            "kind": "tricycle",
            "wheel": "traction_wheel",
            "ticks_per_turn": 5000,
            "rolls_over": 2.0**32,
            "radius": 0.0106141 / math.tau,
            "steering_joint": "steering",
            "steering_ticks": 8192,
            "steering_ratio": 0.1,
            "wheelbase": 1.4,
            # They are guesses, which the header says
            "sigmas": {"radius": 0.001, "steering_ratio": 1.0, "wheelbase": 0.5, "steering_zero": 0.3},
        }
    },
    "truth": {"align": "se2", "offset_m": [1.5, 0.0]},
}
REFIT = {
    "wheels.drive.radius": 0.011215 / math.tau,
    "wheels.drive.steering_ratio": 0.5790,
    "wheels.drive.wheelbase": 1.628,
    "wheels.drive.steering_zero": -0.0706,
    "truth.x": 1.795,
    "truth.y": -0.004,
}
"""Fit of the whole path to the whole reference, which nobody of fgloc's tuning used."""


def measure(quick: bool) -> Iterator[Row]:
    """Rows of all recordings; a quick run leaves out what was calibrated on halves."""
    yield from _two_cameras(range(1 if quick else 5))
    if not DATA.is_dir():
        yield from not_run(["mecanum.bag2.ate_m", "tricycle.ate_m"], f"no {DATA}; set FGLOC_REAL_DATA")
    else:
        with tempfile.TemporaryDirectory() as scratch:
            yield from _mecanum(Path(scratch), quick)
            yield from _tricycle(Path(scratch), quick)
    yield from drives_radio.measure(quick)
    yield from drives_odometry.measure(quick)
    yield from drives_sim.measure(quick)


def _mecanum(scratch: Path, quick: bool) -> Iterator[Row]:
    config, (bag1, bag2) = config_of(MECANUM), (named(f"mecanum_{name}") for name in ("bag1", "bag2"))
    whole, first_half = bag2.bag(scratch / "m2"), half(bag2, mecanum).bag(scratch / "m2_half")
    found, _ = calibrate([bag1.bag(scratch / "m1"), first_half], None, config)
    result = smoothed(whole, found)
    yield Row("mecanum.bag2.ate_m", ate(result), unit="m")
    yield Row("mecanum.bag2.nees_over_3", nees_over_3(result))
    yield Row("mecanum.bag2.second_half.ate_m", ate(second_half(result)), unit="m")
    yield Row("mecanum.bag2.nominal.ate_m", ate(smoothed(whole, config)), unit="m")
    if not quick:
        yield Row("mecanum.bag1.ate_m", ate(smoothed(scratch / "m1" / "bag", found)), unit="m")


def _tricycle(scratch: Path, quick: bool) -> Iterator[Row]:
    config, recording = config_of(TRICYCLE), named("tricycle")
    bag = recording.bag(scratch / "t")
    found, settings = calibrate([bag], None, config)
    result = smoothed(bag, found)
    off = {s.name: abs(s.found - REFIT[s.name]) / s.sigma for s in settings if s.name in REFIT}
    furthest = max(off, key=lambda name: off[name])
    yield Row("tricycle.ate_m", ate(result), unit="m")
    yield Row("tricycle.parameters_sigma", off[furthest], n=len(off), unit=furthest)
    yield Row("tricycle.nees_over_3", nees_over_3(result))
    yield Row("tricycle.nominal.ate_m", ate(smoothed(bag, config)), unit="m")
    if not quick:
        by_half, _ = calibrate([half(recording, tricycle).bag(scratch / "t_half")], None, config)
        yield Row("tricycle.half.ate_m", ate(second_half(smoothed(bag, by_half))), unit="m")


_DARK_S = (25.0, 85.0)
_SCENARIO = Scenario(
    name="two_cameras",
    duration_s=100.0,
    rear=Camera(position=(-0.10, 0.0, 0.25), rpy_deg=(0.0, 0.0, 180.0)),
    installation=Installation.as_installed(),
)


def _two_cameras(seeds: range) -> Iterator[Row]:
    ates: dict[str, list[float]] = {name: [] for name in ("none", "front_dark", "one", "one_dark")}
    step_ms: dict[str, list[float]] = {name: [] for name in ates}
    for seed in seeds:
        with tempfile.TemporaryDirectory() as scratch:
            bag = _simulated(Path(scratch), seed)
            for name in ates:
                result = _seen_by(bag, one=name.startswith("one"), dark=name.endswith("dark"))
                matched = match_result(result, result.config or Config())
                assert matched is not None
                ates[name].append(float(np.sqrt(np.mean(matched.distances**2))))
                step_ms[name].append(float(np.mean(result.step_ms)))
    mean = {name: float(np.mean(values)) for name, values in ates.items()}
    spread, n = float(np.std([d / a for d, a in zip(ates["front_dark"], ates["none"], strict=True)])), len(seeds)
    yield Row("sim.two_cameras.none.ate_mm", 1e3 * mean["none"], float(1e3 * np.std(ates["none"])), n, "mm")
    yield Row("sim.two_cameras.front_dark.over_none", mean["front_dark"] / mean["none"], spread, n)
    yield Row("sim.two_cameras.one_dark.over_none", mean["one_dark"] / mean["none"], n=n)
    ratios = [two / one for two, one in zip(step_ms["none"], step_ms["one"], strict=True)]
    yield Row("sim.two_cameras.update_over_one", float(np.mean(ratios)), float(np.std(ratios)), n)


def _simulated(folder: Path, seed: int) -> Path:
    """Bag of a robot with two cameras that send the corners of markers, with map and settings beside it."""
    scene = make_scene(_SCENARIO, seed)
    log = simulate(scene)
    with BagWriter(folder / "bag") as bag:
        for _, write in heapq.merge(*streams(scene, log, bag, "corners"), key=itemgetter(0)):
            write()
    write_beside(folder, scene, _SCENARIO, camera=False)
    return folder / "bag"


def _seen_by(bag: Path, one: bool, dark: bool) -> RunResult:
    """The run online, by both cameras or the front one alone, which may be dark."""
    cameras = {name: {"sightings": f"/{name}/corners"} for name in ((FRONT,) if one else (FRONT, REAR))}
    config = config_of(robot_settings(_SCENARIO) | {"cameras": cameras})
    start, end = (stamp_ns(at_s) for at_s in _DARK_S)

    def left(events: Iterator[Event]) -> Iterator[Event]:
        for event in events:
            if not (dark and event.topic == f"/{FRONT}/corners" and start <= event.received_ns < end):
                yield event

    return run(bag, bag.parent / "map.yaml", config, "online", check=False, events=left)


def named(name: str) -> Recording:
    """The recording of this name."""
    return next(recording for recording in RECORDINGS if recording.name == name)


def half(recording: Recording, make: Any) -> Recording:
    """The first half of a recording, by its converter."""
    return replace(recording, make=partial(make, share=0.5))


def smoothed(bag: Path, config: Config) -> RunResult:
    """The run in batch, without corrections of the set-up by what is recorded."""
    return run(bag, None, config, "batch", check=False)


def second_half(result: RunResult) -> RunResult:
    """The same run, from the middle of its poses on."""
    t = result.trajectory
    k = len(t) // 2
    covs = None if t.covs is None else t.covs[k:]
    return replace(result, trajectory=Trajectory(t.stamps_ns[k:], t.poses[k:], covs))


def ate(result: RunResult) -> float:
    """Rmse of positions [m] at the poses of the run, by fresh poses of the truth alone, its frame fitted."""
    assert result.truth is not None
    truth = without_repetitions(result.truth)
    matched = match_result(replace(result, truth=truth), result.config or Config())
    assert matched is not None
    return float(np.sqrt(np.mean(matched.distances**2)))


def nees_over_3(result: RunResult) -> float | None:
    """NEES/3 of the run by fresh poses of the truth alone."""
    assert result.truth is not None
    fresh = replace(result, truth=without_repetitions(result.truth))
    return compute_metrics(fresh, result.config or Config()).nees_over_3


def without_repetitions(truth: Trajectory) -> Trajectory:
    """The truth without poses that repeat the one before."""
    fresh: FloatArray = np.abs(np.diff(truth.poses, axis=0)).max(axis=1)
    keep = np.append(True, fresh > 0.0)
    return Trajectory(truth.stamps_ns[keep], truth.poses[keep])


if __name__ == "__main__":
    main(measure, __doc__ or "")
