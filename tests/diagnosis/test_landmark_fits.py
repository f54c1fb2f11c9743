"""Fits of a sensor, its map and the first pose to sightings of landmarks, by the wheels' motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from robot_world import points

from fgloc.config import config_of
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.landmark_fits import Mounting, compared, fit_on_map, fit_sightings, reading_of_map
from fgloc.diagnosis.landmarks import check_first_pose
from fgloc.diagnosis.pairs import Figure
from fgloc.diagnosis.signals import Path, SightingCollector, Sightings, Signals
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.types import Landmark, LandmarkMap

T = np.arange(0.0, 50.0, 0.02)
SPEED, RATE = 0.3 + 0.15 * np.sin(0.9 * T), 0.25 + 0.5 * np.sin(0.6 * T) + 0.2 * np.sin(1.7 * T)
YAW = np.concatenate([[0.0], np.cumsum(0.02 * RATE)[:-1]])
X, Y = (np.concatenate([[0.0], np.cumsum(0.02 * SPEED * f(YAW))[:-1]]) for f in (np.cos, np.sin))
_AROUND = np.linspace(0.0, math.tau, 9)[:-1]
BEACONS = np.column_stack([X.mean() + 3.0 * np.cos(_AROUND) + 0.3 * _AROUND, Y.mean() + 2.5 * np.sin(_AROUND)])
ONE, NONE = Figure(1.0, 0.001), Figure(0.0, 0.001)
MOUNTING = Mounting("body", ONE, NONE, NONE, NONE, NONE, ONE, 0.05)


def path_of(x=X, y=Y, yaw=YAW) -> Path:
    return Path(T, np.column_stack([x, y, yaw]), np.zeros(len(T), dtype=np.int64), "odometry")


def seen_from(x=X, y=Y, yaw=YAW, along_axis=False) -> Sightings:
    """Ranges and bearings of the beacons in view, or depths in place of the ranges."""
    rng, rows = np.random.default_rng(1), []
    for k in range(0, len(T), 5):
        away = BEACONS - [x[k], y[k]]
        ranges = np.hypot(*away.T) + rng.normal(0.0, 0.02, len(away))
        bearings = np.arctan2(away[:, 1], away[:, 0]) - yaw[k] + rng.normal(0.0, 0.005, len(away))
        bearings = np.arctan2(np.sin(bearings), np.cos(bearings))
        ranges = ranges * np.cos(bearings) if along_axis else ranges
        rows += [
            (T[k], i, r * math.cos(b), r * math.sin(b), 0.0)
            for i, (r, b) in enumerate(zip(ranges, bearings, strict=True))
            if abs(b) < 1.2
        ]
    table = np.array(rows)
    return Sightings(table[:, 0], table[:, 1].astype(np.int64), table[:, 2:], False)


def places(off: np.ndarray | float = 0.0) -> dict[int, np.ndarray]:
    return dict(enumerate(BEACONS + off))


@pytest.mark.parametrize(("moved_m", "expected"), [(0.1, 0.1), (0.0, 0.0)])
def test_by_how_much_landmarks_stand_elsewhere_than_on_the_map_is_found(moved_m, expected):
    off = moved_m * np.column_stack([np.cos(2.0 * _AROUND + 0.3), np.sin(3.0 * _AROUND)]) * math.sqrt(2.0)
    _, noise = fit_on_map(path_of(), seen_from(), MOUNTING, places(off))
    assert noise.map_m == pytest.approx(expected, abs=0.03)
    assert noise.range_m == pytest.approx(0.02, abs=0.01)


def test_heights_that_wander_on_a_flat_floor_are_misfit_of_the_axes():
    seen = seen_from()
    flat = Sightings(seen.times[::4], seen.ids[::4], seen.points[::4], True)
    heights = np.random.default_rng(2).normal(0.0, 0.3, len(flat.times))
    wandering = replace(flat, points=flat.points + heights[:, None] * [0.0, 0.0, 1.0])
    level, wild = (fit_sightings(path_of(), some, ["body"])["body"].misfit for some in (flat, wandering))
    assert level < 0.1
    assert wild == pytest.approx(math.hypot(level, 0.3), rel=0.1)


@pytest.mark.parametrize(("given", "is_named"), [((0.0, 0.0, 0.0), False), ((0.8, -0.3, 0.0), True), (None, False)])
def test_a_first_pose_that_the_first_sightings_contradict_is_named_and_not_used(given, is_named):
    known = points(places())
    found = Conventions(config_of({"estimator": {"initial_pose": given}}), Signals(), landmark_map=known)
    check_first_pose(found, path_of(), seen_from())
    assert found.codes == ({"frame.first_pose"} if is_named else set())
    assert found.config.estimator.initial_pose == (None if is_named else given)


def test_sightings_before_the_first_message_of_the_wheels_do_not_contradict_a_first_pose():
    known = points(places())
    found = Conventions(config_of({"estimator": {"initial_pose": (0.0, 0.0, 0.0)}}), Signals(), landmark_map=known)
    seen = seen_from()
    check_first_pose(found, path_of(), replace(seen, times=seen.times - 0.2))
    assert not found.codes


def test_a_map_tells_ranges_from_depths_where_the_way_of_a_robot_hardly_does():
    still = np.zeros(len(T))
    ahead = np.cumsum(0.02 * (0.05 + 0.03 * np.sin(0.9 * T))), still, still
    path, (depths, ranges) = path_of(*ahead), (seen_from(*ahead, along_axis=along) for along in (True, False))
    on_map, alone = (compared(path, depths, ranges, MOUNTING, known) for known in (places(), {}))
    assert on_map.value > 3.0 * alone.value > 0.0
    assert on_map.value > 5.0 * on_map.sigma


@pytest.mark.parametrize(("distance", "least"), [(0.2, 0.02), (20.0, 0.2)])
def test_a_sensor_without_noise_still_has_what_wheels_err_by(distance, least):
    sharp = {"range_sigma_m": 1e-3, "bearing_sigma_rad": 1e-4, "range_scale_sigma": 0.0}
    config = config_of({"landmarks": sharp | {"bearing_bias_sigma_rad": 0.0}})
    known = LandmarkMap({1: Landmark(1, np.array([1.0, 0.0, 0.0]), np.eye(3), 0.0)})
    collector = SightingCollector(config, known, (), None, np.eye(4))
    event = RangeBearingEvent(1, 1, "/landmarks", "base_link", (RangeBearing(1, distance, 0.3),))
    (seen,) = collector.sightings(event)
    assert np.linalg.norm(seen.point) == pytest.approx(distance)
    assert least <= seen.sigma_m < 2.0 * least
    assert 0.01 <= seen.sigma_rad < 0.02


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_a_scale_beyond_any_unit_of_length_is_not_known(factor):
    seen = seen_from()
    tiny = Sightings(seen.times[::4], seen.ids[::4], factor * seen.points[::4], False)
    found = fit_sightings(path_of(), tiny, ["body"])["body"]
    assert found.scale.sigma == found.yaw.sigma == found.late_s.sigma == math.inf
    assert 1e-5 < found.scale.value < 1e5


def windows_of(seed: int, shift: int = 0, mirrored: bool = False, carried: bool = False):
    """Places of four landmarks in each of three windows, and the map; carried: in all but the first, two are off."""
    rng = np.random.default_rng(seed)
    places = {i: rng.uniform(-4.0, 4.0, 2) for i in range(9)}
    windows = []
    for k in range(3):
        window = {}
        for n, i in enumerate(rng.choice(9, 4, replace=False).tolist()):
            z = complex(*places[i]) + 0.05 * complex(*rng.normal(size=2))
            z = z.conjugate() if mirrored else z
            off = 3.0 * np.exp(1j * rng.uniform(0.0, math.tau))
            window[i - shift] = z + (off if carried and k and n < 2 else 0.0)
        windows.append(window)
    return windows, places


def test_a_robot_that_is_carried_makes_no_map_a_mirror_image_or_of_other_ids():
    for seed in range(300):
        _, mirrored, shift, _ = reading_of_map(*windows_of(seed, carried=True))
        assert (mirrored, shift) == (False, 0), seed


@pytest.mark.parametrize(("shift", "mirrored"), [(1, False), (0, True), (-1, True)])
def test_a_map_with_a_mistake_is_read_with_it(shift, mirrored):
    read = [reading_of_map(*windows_of(seed, shift, mirrored)) for seed in range(100)]
    assert sum((m, s) == (mirrored, shift) for _, m, s, _ in read) >= 99
