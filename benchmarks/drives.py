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

Ranges by radio, Plaza 1:

- ``plaza1.known.ate_m``: batch with the places of the four radios as the set has them, sigma 0.5 m as the set's data
  sheet of ranges shows it, scale and offset of the ranges by their priors. The truth is in the frame of the radios:
  nothing is aligned. The prior of the scale (5 %) was chosen on this recording.
- ``plaza1.known.range_scale``: reported over true range, as found; the set's own fit is 1.068 to 1.071.
- ``plaza1.unknown.ate_over_known``: the places of the radios hidden, found by ``fgloc map`` in a frame of the drive's own,
  and smoothed with the lines that it says; ATE after a rigid alignment over that with the known places, likewise aligned.
  Mean over 20 drives that begin at a random time in the first half of the recording and last to its end, ``.largest``
  the largest of them (quick: of two). No constant of the survey was chosen on these drives; the whole recording was looked at.
- ``plaza1.unknown.{ate_m,known_ate_m}``: numerator and denominator, with their ``.largest``. They belong to the ratio: on the
  first of the drives the run with known places gets lost (17 m, against 0.3 m with surveyed ones), and its ratio of 0.02 says
  nothing of the survey.

Reflectors without identity, ACFR's car park (``car_park.*``):

- ``car_park.ate_m``: batch, laser hits of 15 surveyed beacons as `reflectors`, by intensity; first pose by constellations.
  ``.online.ate_m``: as known at the time. ``.first_pose_s``: from the first step on. Truth is the GPS in the map's frame,
  3.78 m ahead of the rear axle and 0.50 m left, as the laser is: nothing is aligned, the pose is compared at the antenna.
- ``car_park.nees_over_2``: of that position, batch, with 2 cm on each axis for the GPS, which is usual of carrier phase.
  The owner does not state it: with none the NEES is 3.4, with 5 cm 0.3.
- ``car_park.odometry.ate_m``: the odometry by the owner's geometry, its frame fitted.

Nothing was tuned on it: mounting and geometry are the owner's, the intensity is any above 0, all sigmas are defaults.

A car by speed and steering alone, its GNSS cut for 60 s (``car_gnss.*``):

Speed and the angle at the steering wheel are joints of an ``ackermann`` drive with the owner's wheelbase and factor (32),
the two antennas, told apart by their frames, are `gnss` with a sigma of 0.3 m; there is no gyro. The steering has play.
Online, a run for each of six cuts; what both antennas measure in a cut is the truth, and not given.

- ``car_gnss.cut60_percent``: error at the end of the cut over the way in it, mean (and deviation) of the cuts.
  ``.worst``: the largest. ``car_gnss.nees_over_2``: of the antennas' positions over the cuts.

All noises are defaults. Constants fitted to all of it, in place of found, leave 35 to 62 %.

Wheels that their readme describes wrongly, UWB indoors (``uwb_indoor.*``):

- ``uwb_indoor.ate_m``: batch with what ``fgloc init`` writes for the bag as described, by `benchmarks.field`.
  ``.online.ate_m``, ``.as_described.ate_m`` (the odometry) likewise.
- ``uwb_indoor.named``: share of the recording's two mistakes (left and right exchanged at half the track; long ranges)
  that a command names.

A second odometry beside the wheels of the simulated robot (``sim.odometry.*``):

The robots are those of `benchmarks.installed` (floor with patches, as installed, ten seeds), with their cameras. Topic
``/odom`` holds another odometry, 20 Hz: the truth at a place 0.1 m ahead of the base and turned by 0.05 rad (the settings
say 0.09 m and 0.04 rad), distances 1 % long, stamps 10 ms late, increments with white noise of 5 mm and 3 mrad. Its twist
has the covariance of that noise, in ``scale10`` a tenth of it.

- ``sim.odometry.none.{ate_mm,nees}``: without it, as `benchmarks.installed` runs them online.
- ``sim.odometry.{sound,scale10,frozen,jump}.{ate_mm,nees}``: with it; frozen for 20 s from 30 s on, or its pose jumps by
  0.5 m and 0.3 rad at 30 s. ``nees`` is NEES/3 of all poses.
- ``sim.odometry.{frozen,jump}.named_s``: from the failure (frozen: from the first 0.02 m that the robot goes in it) to the
  first step that leaves the source out, the largest of the seeds. ``.wrongly_named``: share of the steps
  of ``sound`` in which it is left out.

Nothing was chosen on these seeds; thresholds were set by what robots do (docs/odometries.md).

Simulated robots of several drives, as installed (``sim.DRIVE.*``):

Each robot drives over the floors of the simulated suite, with the control functions of its test split: grippy (``none``),
and patches of friction 0.04 to 0.15 in stop and go (``slip``; ``dark30``: the same with no image for 30 s). Corners are
those that `CornerDetector` finds, without rendering, at 5 Hz. None has learned motion. The differential robot is the
measure of the others: ``sim.DRIVE.CASE.MODE.ate_mm`` is the mean distance from the truth, ``.over_differential`` its ratio
to the differential robot's, ``.nees`` NEES/3, each a mean over the seeds.

Noise of the wheels is that of the simulator's robots; of other seeds only 91 was looked at. Finished cells are kept (`benchmarks.replays.kept`).

ATE is the rmse of positions, the truth's frame fitted by a rigid motion. The length of the
calibration's windows was chosen on the whole tricycle (its parameters are 3.8 sigmas from that fit with 2 s in place of 4 s),
the noise as it is most likely on bag1 and the first half of bag2.
"""

# ruff: noqa: E501 (lines of the description)
from __future__ import annotations

import heapq
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from hashlib import sha256
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.io import loadmat

from benchmarks.common import DATA, Row, main, mean_row, not_run
from benchmarks.field import distances, outcome
from benchmarks.field_peers import hear
from benchmarks.field_recordings import RECORDINGS, Recording, car_gnss, mecanum, plaza, tricycle
from benchmarks.field_sheet import SHEET
from benchmarks.field_sheet import found as is_found
from benchmarks.recordings import SEEDS, Recorded, Take, cache_folder, changed, load, scenario, truth_of
from benchmarks.replays import failure, kept, replayed
from benchmarks.scores import errors
from fgloc import se2
from fgloc.ablation.failures import Corruption
from fgloc.calibrate import calibrate
from fgloc.calibration.anchors import survey_anchors
from fgloc.config import Config, config_of
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import compute_metrics, match_result
from fgloc.files.atomic import atomic_folder
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.recording.reader import open_recording
from fgloc.runner import RunResult, run
from fgloc.sensors.gnss import GnssEvent, east_north
from fgloc.sensors.maps import load_map
from fgloc.sensors.odometry import BesideEvent
from fgloc.sensors.uwb import anchor_lines
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Estimate, Event, FloatArray, Step, Trajectory, TruthEvent
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.physics import make_scene, simulate
from fgloc_datasets.sim.record import (
    BUNDLED,
    RUN_FILES,
    describe,
    is_recorded,
    load_suite,
    robot_settings,
    write_beside,
)
from fgloc_datasets.sim.scenario import FRONT, REAR, Camera, Installation, Robot, Scenario
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
    yield from plaza_known()
    yield from plaza_unknown(2 if quick else 20)
    yield from car_park_rows()
    yield from car_gnss_rows(quick)
    yield from uwb_indoor_rows()
    yield from second_odometry_rows(quick)
    yield from drive_rows(quick)


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


# --- Ranges by radio --------------------------------------------------------------------------------------------------


_EPOCH_S = 1_600_000_000.0  # of the converter's stamps
_SIGMA_M = 0.5


def plaza_known() -> Iterator[Row]:
    """Rows of Plaza 1 with known radios."""
    names = ("plaza1.known.ate_m", "plaza1.known.range_scale")
    if not (DATA / "plaza").is_dir():
        yield from not_run(names, f"no {DATA / 'plaza'}; set FGLOC_REAL_DATA")
        return
    data = loadmat(DATA / "plaza" / "Plaza1.mat")
    anchors = {int(i): (float(x), float(y), 0.0) for i, x, y in data["TL"][:, :3]}
    with tempfile.TemporaryDirectory(prefix="fgloc-plaza-") as folder:
        result = smoothed(named("plaza").bag(Path(folder)), _with_ranges({"anchors": anchors}))
    at, true = _plaza_places(result, data["GT"])
    yield Row(names[0], _rms(at - true), n=len(true), unit="m")
    value, sigma = result.installation["uwb.range_scale"]
    yield Row(names[1], value, sigma)


def plaza_unknown(drives: int) -> Iterator[Row]:
    """Rows of Plaza 1 with radios that are surveyed first."""
    names = [f"plaza1.unknown.{name}" for name in ("ate_over_known", "ate_m", "known_ate_m")]
    if not (DATA / "plaza").is_dir():
        every = [row for name in names for row in (name, f"{name}.largest")]
        yield from not_run(every, f"no {DATA / 'plaza'}; set FGLOC_REAL_DATA")
        return
    data = loadmat(DATA / "plaza" / "Plaza1.mat")
    known = {int(i): (float(x), float(y), 0.0) for i, x, y in data["TL"][:, :3]}
    drove = []
    for since in np.random.default_rng(0).uniform(0.0, 0.5, 20)[:drives].tolist():
        with tempfile.TemporaryDirectory(prefix="fgloc-plaza-") as folder:
            bag = replace(named("plaza"), make=partial(plaza, since=since)).bag(Path(folder))
            lines = anchor_lines(survey_anchors(bag, _with_ranges({})).landmarks.landmarks)
            found = yaml.safe_load("\n".join(["uwb:", *lines]))["uwb"]
            of_run = [smoothed(bag, _with_ranges(section)) for section in (found, {"anchors": known})]
        errors_m = [_rms(_aligned(*_plaza_places(result, data["GT"]))) for result in of_run]
        drove.append([errors_m[0] / errors_m[1], *errors_m])
    for name, unit, values in zip(names, ("", "m", "m"), np.array(drove).T, strict=True):
        yield mean_row(name, values, unit)
        yield Row(f"{name}.largest", float(np.max(values)), n=len(values), unit=unit)


def _with_ranges(section: dict[str, Any]) -> Config:
    return config_of({"uwb": section | {"sigma_m": _SIGMA_M}, "gate": {"max_range": 200.0}})


def _plaza_places(result: RunResult, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions ``(n, 2)`` of a run, and the true ones, at the times of the truth that the run has."""
    seconds = result.trajectory.stamps_ns * 1e-9 - _EPOCH_S
    truth = truth[(truth[:, 0] >= seconds[0]) & (truth[:, 0] <= seconds[-1])]
    at = [np.interp(truth[:, 0], seconds, result.trajectory.poses[:, i]) for i in range(2)]
    return np.column_stack(at), truth[:, 1:3]


def _aligned(at: FloatArray, true: FloatArray) -> FloatArray:
    """Differences ``(n, 2)`` of positions from the true ones, after a rigid motion."""
    x, y, yaw = se2.rigid(at, true)
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(at @ np.array([[c, s], [-s, c]]) + [x, y] - true)


# --- Reflectors -------------------------------------------------------------------------------------------------------


CAR_PARK: dict[str, Any] = {"reflectors": {"min_intensity": 1.0, "pose": [3.78, 0.50, 0.0]}}
_ANTENNA = np.array([3.78, 0.50, 0.0])
_GPS_SIGMA_M = 0.02


def car_park_rows() -> Iterator[Row]:
    """Rows of the car park."""
    names = ("car_park.ate_m", "car_park.online.ate_m", "car_park.nees_over_2", "car_park.odometry.ate_m")
    if not (DATA / "car_park").is_dir():
        yield from not_run(names, f"no {DATA / 'car_park'}; set FGLOC_REAL_DATA")
        return
    config = config_of(CAR_PARK)
    data = loadmat(DATA / "car_park" / "data_set.mat")
    truth = np.column_stack([_EPOCH_S + data["TimeGPS"].ravel(), data["GPSLon"].ravel(), data["GPSLat"].ravel()])
    with tempfile.TemporaryDirectory(prefix="fgloc-car-park-") as folder:
        bag, landmarks = named("car_park").bag(Path(folder)), Path(folder) / "map.yaml"
        batch, online = (run(bag, landmarks, config, mode, check=False) for mode in ("batch", "online"))
        plain = hear(bag, "").odometry
    off, nees = at_antenna(batch.trajectory, truth)
    yield Row(names[0], _rms(off), n=len(off), unit="m")
    off, _ = at_antenna(online.trajectory, truth)
    yield Row(names[1], _rms(off), n=len(off), unit="m")
    yield Row("car_park.first_pose_s", online.first_pose_s, unit="s")
    yield Row(names[2], float(np.mean(nees)) / 2.0, n=len(nees))
    assert plain is not None
    known = truth[(truth[:, 0] >= plain.stamps_ns[0] * 1e-9) & (truth[:, 0] <= plain.stamps_ns[-1] * 1e-9)]
    poses = se2.interpolate(plain.stamps_ns, plain.poses, np.round(known[:, 0] * 1e9).astype(np.int64))
    placed = np.array([se2.compose(pose, _ANTENNA) for pose in poses])
    yield Row(names[3], _rms(distances(placed, known[:, 1:], align=True, lever=False)[:, None]), n=len(known), unit="m")


def at_antenna(
    found: Trajectory, truth: FloatArray, antenna: FloatArray = _ANTENNA, sigma_m: float = _GPS_SIGMA_M
) -> tuple[FloatArray, FloatArray]:
    """Errors ``(n, 2)`` [m] of the antenna's position at times and positions ``(m, 3)``, and the NEES of each ``(n,)``."""
    known = truth[(truth[:, 0] >= found.stamps_ns[0] * 1e-9) & (truth[:, 0] <= found.stamps_ns[-1] * 1e-9)]
    stamps = np.round(known[:, 0] * 1e9).astype(np.int64)
    poses = se2.interpolate(found.stamps_ns, found.poses, stamps)
    assert found.covs is not None
    off, nees = np.zeros((len(known), 2)), np.zeros(len(known))
    for i, (pose, k) in enumerate(zip(poses, np.searchsorted(found.stamps_ns, stamps), strict=True)):
        at = se2.compose(pose, antenna)[:2]
        off[i] = at - known[i, 1:]
        J = np.column_stack([np.eye(2), [pose[1] - at[1], at[0] - pose[0]]])
        cov = J @ found.covs[k] @ J.T + np.eye(2) * sigma_m**2
        nees[i] = off[i] @ np.linalg.solve(cov, off[i])
    return off, nees


def _rms(off: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


# --- A car whose GNSS is cut ------------------------------------------------------------------------------------------


_CUT_S = 60.0
CUTS_S = (210.0, 230.0, 270.0, 290.0, 310.0, 340.0)
"""Begin of each cut; the fixes are good at both ends."""
_FIX_SIGMA_M = 0.3
_AHEAD_M = {"rear_antenna": 0.0, "front_antenna": 2.03}
_ORIGIN = (45.6189, 9.2812, 229.0)
_WHEEL_RATIO = 1.0 / 32.0
CAR_GNSS: dict[str, Any] = {
    "recording": {"topics": {"odometry": "none"}},
    "wheels": {
        "drive": {
            "kind": "ackermann",
            "wheelbase": 1.765,
            "steering_joints": ["steering_wheel"],
            "steering_ratio": _WHEEL_RATIO,
        }
    },
    "gnss": {"origin": _ORIGIN, "sigma_m": _FIX_SIGMA_M},
    "gate": {"max_speed": 30.0},
}


def car_gnss_rows(quick: bool) -> Iterator[Row]:
    """Rows of the cuts; a quick run has one."""
    if not (DATA / "car_gnss").is_dir():
        yield from not_run(
            ["car_gnss.cut60_percent", "car_gnss.nees_over_2"], f"no {DATA / 'car_gnss'}; set FGLOC_REAL_DATA"
        )
        return
    with tempfile.TemporaryDirectory(prefix="fgloc-car-gnss-") as folder:
        car_gnss(DATA / "car_gnss", Path(folder))
        cuts = [in_cut(Path(folder) / "bag", config_of(CAR_GNSS), at_s) for at_s in CUTS_S[: 1 if quick else None]]
    percents, nees = np.array(cuts).T
    n = len(cuts)
    yield Row("car_gnss.cut60_percent", float(np.mean(percents)), float(np.std(percents)), n, "%")
    yield Row("car_gnss.cut60_percent.worst", float(np.max(percents)), n=n, unit="%")
    yield Row("car_gnss.nees_over_2", float(np.mean(nees)), float(np.std(nees)), n)


def in_cut(bag: Path, config: Config, at_s: float) -> tuple[float, float]:
    """Error at the end of a cut that begins at this time, in percent of the way in it, and mean NEES/2 over it."""
    hidden: dict[str, list[tuple[float, float, float]]] = {name: [] for name in _AHEAD_M}
    start_ns = 0

    def left(events: Iterator[Event]) -> Iterator[Event]:
        nonlocal start_ns
        for event in events:
            start_ns = start_ns or event.received_ns + round(at_s * 1e9)
            if event.stamp_ns > start_ns + _CUT_S * 1e9:
                return
            if not (isinstance(event, GnssEvent) and event.stamp_ns >= start_ns):
                yield event
            elif event.latitude != 0.0:  # as without a fix
                place = east_north(event.latitude, event.longitude, event.altitude, _ORIGIN)
                hidden[event.frame_id].append((event.stamp_ns * 1e-9, *place.tolist()))

    found = run(bag, None, config, "online", check=False, events=left).trajectory
    ends, nees = [], []
    for name, ahead_m in _AHEAD_M.items():
        off, of_each = at_antenna(found, np.array(hidden[name]), np.array([ahead_m, 0.0, 0.0]), _FIX_SIGMA_M)
        ends.append(math.hypot(*off[-1]))
        nees.append(float(np.mean(of_each)) / 2.0)
    way = float(np.hypot(*np.diff(found.poses[found.stamps_ns >= start_ns, :2], axis=0).T).sum())
    return 100.0 * float(np.mean(ends)) / way, float(np.mean(nees))


# --- Wheels that are described wrongly --------------------------------------------------------------------------------


def uwb_indoor_rows() -> Iterator[Row]:
    """Rows of UWB indoors, with the settings that ``fgloc init`` writes."""
    if not (DATA / "uwb_indoor").is_dir():
        yield from not_run(["uwb_indoor.ate_m"], f"no {DATA / 'uwb_indoor'}; set FGLOC_REAL_DATA")
        return
    o = outcome(named("uwb_indoor"))
    for name, key in (("", "batch"), ("online.", "online"), ("as_described.", "odometry")):
        if key in o.ate:
            yield Row(f"uwb_indoor.{name}ate_m", o.ate[key], unit="m")
        else:
            yield from not_run([f"uwb_indoor.{name}ate_m"], o.error or "no poses")
    traps = [trap for trap in SHEET if trap.recording == "uwb_indoor"]
    yield Row("uwb_indoor.named", float(np.mean([is_found(trap, o) for trap in traps])), n=len(traps))


# --- A second odometry ------------------------------------------------------------------------------------------------


_NAME = "odometry.visual"
_FAILED_S = (30.0, 50.0)
_RATE_NS = 50_000_000
_LATE_NS = 10_000_000
_MOUNTED, _TOLD = (0.1, 0.0, 0.05), (0.09, 0.0, 0.04)
_LONG = 1.01
_SIGMAS = np.array([0.005, 0.005, 0.003])  # m, m, rad of an increment
_MOVED_M = 0.02
ODOMETRY_CASES = {
    "sound": (1.0, ()),
    "scale10": (0.1, ()),
    "frozen": (1.0, ({"kind": "odometries_frozen", "when": {"intervals": [_FAILED_S]}},)),
    "jump": (1.0, ({"kind": "odometries_jump", "when": {"intervals": [_FAILED_S]}},)),
}


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures of one run."""

    ate_mm: float
    nees: float
    named_s: float
    left_out: float


def second_odometry(recorded: Recorded, seed: int, told: float) -> list[BesideEvent]:
    """Messages of the second odometry, by the truth; ``told``: variance that it reports over its own."""
    rng = np.random.default_rng(seed)
    events: list[BesideEvent] = []
    last, pose, due = None, np.array([1.0, -2.0, 0.7]), 0
    cov = np.zeros((6, 6))
    cov[np.ix_((0, 1, 5), (0, 1, 5))] = told * np.diag(_SIGMAS**2) / (_RATE_NS * 1e-9) ** 2
    for event in recorded.events:
        if not isinstance(event, TruthEvent) or event.stamp_ns < due:
            continue
        true = np.array([event.position[0], event.position[1], quaternion_yaw(event.orientation)])
        tracked = se2.compose(true, _MOUNTED)
        step, seconds = np.zeros(3), 1.0
        if last is not None:
            step = se2.between(last[1], tracked) * (_LONG, _LONG, 1.0) + _SIGMAS * rng.standard_normal(3)
            seconds = (event.stamp_ns - last[0]) * 1e-9
        last, due = (event.stamp_ns, tracked), event.stamp_ns + _RATE_NS - 1_000_000
        pose = se2.compose(pose, step)
        vx, vy, w = se2.log(step) / seconds
        events.append(
            BesideEvent(
                event.stamp_ns + _LATE_NS,
                event.received_ns + _LATE_NS,
                "/odom",
                "visual",
                "",
                np.array([pose[0], pose[1], 0.0]),
                yaw_quaternion(float(pose[2])),
                np.zeros((6, 6)),
                np.array([vx, vy, 0.0]),
                np.array([0.0, 0.0, w]),
                cov,
            )
        )
    return events


def with_odometry(seed: int, case: str | None) -> Scores:
    """One run of a seed's recording; ``case``: of `ODOMETRY_CASES`, None: without the second odometry."""
    recorded = load(Take("installed", "patches", "test", seed))
    told, described = ODOMETRY_CASES[case] if case is not None else (1.0, ())
    chain = [failure(dict(one)) for one in described]
    topics = {"topics": {"odometry": "none"}}
    if case is not None:
        topics["odometries"] = [{"name": "visual", "topic": "/odom", "pose": _TOLD}]  # type: ignore[assignment]
    config = changed(recorded.config, {"recording": topics, "motion": {"use": False}})
    added = second_odometry(recorded, seed, told) if case is not None else []
    kept = [e for e in recorded.events if not isinstance(e, OdometryEvent)]
    events: Sequence[Event] = sorted([*kept, *added], key=lambda e: e.received_ns)
    failing = Corruption(chain, (recorded.start_ns, recorded.duration_s), config, seed=seed)
    named: list[tuple[float, bool]] = []  # when a step was judged, and whether it left the source out

    def note(step: Step, estimate: Estimate | None) -> None:
        rows = [d for d in (estimate.decisions if estimate is not None else ()) if d.kind == _NAME]
        if rows:
            named.append(((step.stamp_ns - recorded.start_ns) * 1e-9, any(d.reason for d in rows)))

    result = run(
        recorded.bag,
        recorded.map_path,
        config,
        "online",
        on_step=note,
        events=lambda _: failing.recorded(iter(events)),
    )
    metrics = compute_metrics(result, config)
    begun = recorded.truth[recorded.truth[:, 0] >= _FAILED_S[0]]
    went = np.append(0.0, np.cumsum(np.hypot(*np.diff(begun[:, 1:3], axis=0).T)))
    since_s = float(begun[np.argmax(went > _MOVED_M), 0]) if case == "frozen" else _FAILED_S[0]
    after = [t for t, wrong in named if wrong and t >= _FAILED_S[0]]
    return Scores(
        1e3 * (metrics.ate_mean_m or math.nan),
        metrics.nees_over_3 or math.nan,
        min(after, default=math.inf) - since_s,
        float(np.mean([wrong for _, wrong in named])) if named else 0.0,
    )


def second_odometry_rows(quick: bool) -> Iterator[Row]:
    """Rows of all cases."""
    seeds = SEEDS["test"][: 2 if quick else None]
    for case in (None, *ODOMETRY_CASES):
        found = [with_odometry(seed, case) for seed in seeds]
        name, n = f"sim.odometry.{case or 'none'}", len(found)
        for key, unit in (("ate_mm", "mm"), ("nees", "")):
            values = [getattr(s, key) for s in found]
            yield Row(f"{name}.{key}", float(np.mean(values)), float(np.std(values)), n, unit)
        if case in ("frozen", "jump"):
            values = [s.named_s for s in found]
            yield Row(f"{name}.named_s", max(values), float(np.std(values)), n, "s")
        elif case == "sound":
            yield Row(f"{name}.wrongly_named", float(np.mean([s.left_out for s in found])), None, n)


# --- Simulated robots of several drives -------------------------------------------------------------------------------


DRIVES = ("differential", "ackermann", "mecanum", "skid")
FLOORS = ("none", "slip", "dark30")
DRIVE_SEEDS = tuple(range(101, 111))
_QUICK_SEEDS = DRIVE_SEEDS[:1]
DURATION_S = 50.0
_DARK30_S = (15.0, 45.0)
_SCENARIOS = {"ackermann": "ackermann", "mecanum": "mecanum", "skid": "skid_steer"}


def drive_rows(quick: bool, drives: Sequence[str] = DRIVES, seeds: Sequence[int] | None = None) -> Iterator[Row]:
    """The rows; a quick run has one seed."""
    seeds = seeds or (_QUICK_SEEDS if quick else DRIVE_SEEDS)
    of: dict[tuple[str, str, str], list[dict[str, float]]] = {}
    for drive in drives:
        for case in FLOORS:
            cells = [_cell(drive, case, seed) for seed in seeds]
            for mode in ("batch", "online"):
                found = [cell[mode] for cell in cells if mode in cell]
                of[drive, case, mode] = found
                name = f"sim.{drive}.{case}.{mode}"
                failed = "; ".join(cell["failed"] for cell in cells if "failed" in cell)
                ate = [cell["ate_mm"] for cell in found]
                yield _row(f"{name}.ate_mm", ate, "mm", failed)
                yield _row(f"{name}.nees", [cell["nees_over_3"] for cell in found], "", failed)
                reference = [cell["ate_mm"] for cell in of.get(("differential", case, mode), [])]
                if drive != "differential" and ate and reference:
                    yield Row(f"{name}.over_differential", float(np.mean(ate) / np.mean(reference)), n=len(ate))


def _row(name: str, values: Sequence[float], unit: str, failed: str) -> Row:
    if failed or not values:
        return Row(name, None, n=0, reason=failed or "no run")
    return mean_row(name, values, unit)


def _cell(drive: str, case: str, seed: int) -> dict[str, Any]:
    """Errors in batch and online of one run, from the cache or measured now."""
    made = recorded_scenario(drive, case)
    key = sha256(describe(made, seed, True).encode()).hexdigest()[:12]
    return dict(kept(f"drive_{drive}_{case}_{seed}_{key}", lambda: run_drive(drive, case, seed)))


def run_drive(drive: str, case: str, seed: int) -> dict[str, Any]:
    """Errors in batch and online of one run."""
    recorded = load_drive(drive, "none" if case == "none" else "slip", seed)
    dark = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [_DARK30_S]}}
    chain = [failure(dark)] if case == "dark30" else []
    try:
        made = replayed(recorded, recorded.config, chain, seed, batch=True)
    except FglocError as error:
        return {"failed": f"seed {seed}: {type(error).__name__}: {error}"}
    if made is None or made.batch is None:
        return {"failed": f"seed {seed}: no pose was ever found"}
    return {mode: asdict(errors(getattr(made, mode), recorded.config)) for mode in ("batch", "online")}


# --- Recordings -------------------------------------------------------------------------------------------------------


def recorded_scenario(drive: str, case: str) -> Scenario:
    """Scenario of a robot on the floor of a case."""
    floor = scenario("unequal_radii" if case == "none" else "patches", "test")
    robot = Robot() if drive == "differential" else load_suite(BUNDLED).find(_SCENARIOS[drive]).robot
    quick = {} if case == "none" else {"max_acceleration": 8.0, "max_angular_acceleration": 40.0}
    return floor.model_copy(
        update={
            "robot": robot.model_copy(update=quick),
            "duration_s": DURATION_S,
            "installation": Installation.as_installed(),
        }
    )


@lru_cache(maxsize=2)
def load_drive(drive: str, case: str, seed: int) -> Recorded:
    """One recording, made first if it is not there."""
    return load_made(recorded_scenario(drive, case), seed, f"drives/{drive}_{case}")


def load_made(made: Scenario, seed: int, name: str) -> Recorded:
    """The recording of a scenario with corners in place of images, made first if it is not there.

    Args:
        made: the scenario.
        seed: of all that is drawn.
        name: begins that of its folder in the cache.
    """
    key = sha256(describe(made, seed, True).encode()).hexdigest()[:12]
    folder = cache_folder() / f"{name}_{seed}_{key}"
    if not is_recorded(made, seed, folder, True):
        record_drive(made, seed, folder)
    config = config_of(robot_settings(made) | {"motion": {"use": False}})
    with open_recording(folder / "bag", config.recording) as recording:
        start_ns, duration_s, events = recording.span_ns[0], recording.duration_s, tuple(recording.events())
    return Recorded(
        name=folder.name,
        bag=folder / "bag",
        map_path=folder / "map.yaml",
        config=config,
        landmarks=load_map(folder / "map.yaml"),
        events=events,
        start_ns=start_ns,
        truth=truth_of(events, start_ns),
        duration_s=duration_s,
    )


def record_drive(made: Scenario, seed: int, folder: Path) -> None:
    """Record a run with corners in place of images."""
    began = time.monotonic()
    scene = make_scene(made, seed)
    log = simulate(scene)
    with atomic_folder(folder, own=RUN_FILES) as stage:
        with BagWriter(stage / "bag", compress=True) as bag:
            for _, write in heapq.merge(*streams(scene, log, bag, "corners"), key=itemgetter(0)):
                write()
        write_beside(stage, scene, made, camera=True)
    print(f"  recorded {folder.name}: {time.monotonic() - began:.1f} s", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(measure, __doc__ or "")
