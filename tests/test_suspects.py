"""Beacons moved by less than the gate sees are named and taken back; where nothing was moved nobody is accused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robot_world import Chain, World, beacons, config, position_error, truth_at

from fgloc import se2
from fgloc.robust.moved_landmark_glr import MovedLandmarkBank
from fgloc.types import LandmarkMap, RangeBearingMeasurement

COARSE = {"range_sigma_m": 0.2, "bearing_sigma_rad": 0.05}  # of which one sighting cannot show half a metre
NONE = np.zeros(2), np.diag([0.05, 0.05, 0.02, 0.0, 0.0]) ** 2


def moved(world: LandmarkMap, landmark_id: int, dx: float, dy: float) -> LandmarkMap:
    there = world.landmarks[landmark_id]
    shown = replace(there, position=there.position + np.array([dx, dy, 0.0]))
    return LandmarkMap({**world.landmarks, landmark_id: shown})


def sighting(rng, pose, landmark, stamp_ns: int, as_id: int | None = None) -> RangeBearingMeasurement:
    sigmas = np.array([COARSE["bearing_sigma_rad"], COARSE["range_sigma_m"]])
    x, y, _ = se2.between(pose, (*landmark.position[:2], 0.0))
    bearing, distance = np.array([np.arctan2(y, x), np.hypot(x, y)]) + rng.normal(0.0, sigmas)
    landmark_id = landmark.landmark_id if as_id is None else as_id
    return RangeBearingMeasurement(stamp_ns, landmark_id, distance, bearing, np.diag(sigmas**2))


def listened(seed: int, world: LandmarkMap, shown: LandmarkMap, steps: int = 150, misread: float = 0.0):
    """Filters that hear one sighting a step of a robot on its circle, until one is accused; and after how many."""
    rng, suspects = np.random.default_rng(seed), MovedLandmarkBank(world, repeat_s=0.0)
    suspects.start(truth_at(0.0), *NONE)
    ids = sorted(world.landmarks)
    for k in range(1, steps + 1):
        motion, cov = se2.between(truth_at(0.2 * (k - 1)), truth_at(0.2 * k)), np.diag([0.01, 0.004, 0.01]) ** 2
        landmark = shown.landmarks[int(rng.choice(ids))]
        as_id = int(rng.choice(ids)) if rng.uniform() < misread else None
        noisy = se2.compose(motion, rng.multivariate_normal(np.zeros(3), cov))
        seen = sighting(rng, truth_at(0.2 * k), landmark, k * 200_000_000, as_id)
        suspects.step(noisy, cov, [seen])
        if suspects.accused is not None:
            break
    return suspects, k


@pytest.mark.parametrize("landmark_id", [0, 3, 5])
def test_the_beacon_that_was_moved_is_accused_and_no_other(landmark_id):
    world = beacons()
    accused = listened(landmark_id, world, moved(world, landmark_id, 0.4, -0.3), steps=400)[0].accused
    assert accused is not None
    assert accused.landmark_id == landmark_id
    assert accused.displacement == pytest.approx((0.4, -0.3), abs=0.25)


def test_where_nothing_was_moved_nobody_is_accused():
    world = beacons()
    assert all(listened(seed, world, world)[0].accused is None for seed in range(12))


def test_wrong_ids_accuse_nobody():
    world = beacons()
    assert all(listened(seed, world, world, misread=0.3)[0].accused is None for seed in range(12))


def test_without_the_moved_beacon_the_pose_is_right_and_its_covariance_honest():
    world, nees = beacons(), []
    for seed in range(10):
        suspects, steps = listened(seed, world, moved(world, 3, 0.5, 0.0), steps=400)
        accused = suspects.accused
        assert accused is not None
        miss = se2.log(se2.between(truth_at(0.2 * steps), accused.pose))
        nees.append(float(miss @ np.linalg.solve(accused.cov[:3, :3], miss)))
    assert np.mean(nees) / 3 < 2.2  # χ² of 30 degrees of freedom, 99.9 %: 2


def test_an_accusation_puts_the_robot_where_angles_are_wrapped():
    world = beacons()
    suspects, _ = listened(3, world, moved(world, 3, 0.4, -0.3), steps=400)
    accused = suspects.accused
    assert accused is not None
    assert -np.pi <= accused.pose[2] < np.pi


def test_sightings_after_the_clock_went_back_share_nothing_with_those_before():
    world, covs = beacons(), []
    for before_ns in (10**9, 3600 * 10**9):
        suspects = MovedLandmarkBank(world, repeat_s=2.0)
        for stamp_ns in (before_ns, 100 * 10**9):
            suspects.start(truth_at(0.0), *NONE)
            seen = sighting(np.random.default_rng(0), truth_at(0.0), world.landmarks[2], stamp_ns)
            suspects.step(np.zeros(3), np.zeros((3, 3)), [seen])
        covs.append(suspects.belief[1])
    assert covs[0] == pytest.approx(covs[1])


def drive(world: LandmarkMap, shown: LandmarkMap | None, seed: int, keep_all: bool = False, **landmarks):
    made = World(world, seed=seed, seconds=40.0, rate=5, shown=shown)
    chain = Chain(config(landmarks=landmarks), world, keep_all=keep_all)
    return made, chain, chain.run(made.events())


def test_fault_51_a_beacon_moved_by_less_than_a_sighting_shows_is_named_and_its_harm_undone():
    world = beacons()
    made, chain, estimates = drive(world, moved(world, 3, 0.3, 0.25), seed=1, **COARSE)
    by = chain.localizer.association.exclusion.displacements
    assert list(by) == [3]
    assert by[3] == pytest.approx((0.3, 0.25), abs=0.15)
    (told,) = [d for e in estimates for d in e.decisions if d.reason == "landmark_moved"]
    assert told.landmark_id == 3
    assert chain.localizer.association.rejections["sightings.gate"] < 5  # it was not the gate that found it
    late = [position_error(e, made.truth(e.stamp_ns)) for e in estimates if e.stamp_ns > told.stamp_ns]
    assert np.mean(late) < 0.07
    log = chain.localizer.estimator.log.keyframes.values()
    assert not any(s.measurement.landmark_id == 3 for frame in log for s in frame.sightings)


@pytest.mark.parametrize("settings", [{}, COARSE, {"repeat_s": 5.0}, {"range_scale_sigma": 0.02}])
def test_in_a_run_where_nothing_was_moved_nobody_is_named(settings):
    world = beacons()
    for seed in range(2):
        _, chain, estimates = drive(world, None, seed, **settings)
        assert not chain.localizer.association.exclusion.displacements
        assert not any(d.reason == "landmark_moved" for e in estimates for d in e.decisions)


def test_repeated_sightings_share_their_information_and_are_refused_all_the_same():
    """The covariance that repeated sightings share says nothing of how far off one of them may be."""
    world = beacons()
    shown = moved(world, 2, 0.5, -0.4)
    _, chain, _ = drive(world, shown, seed=2, repeat_s=20.0)
    assert list(chain.localizer.association.exclusion.displacements) == [2]
