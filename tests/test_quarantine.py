"""Landmarks that were moved are named; the interval after dead reckoning says how wrong it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from exact import exact
from robot_world import CAMERA, SIGMA_PX, Chain, World, beacons, polar, position_error, project, room, truth_at

from fgloc import se2
from fgloc.graph.factors import LandmarkFactors
from fgloc.robust.moved_landmark_votes import LandmarkExclusion, displacement
from fgloc.types import CornerMeasurement, LandmarkMap, RangeBearingMeasurement

R = np.diag([0.015, 0.06]) ** 2
AFTER = 6


def moved(landmark, dx: float, dy: float):
    return replace(landmark, position=landmark.position + np.array([dx, dy, 0.0]))


def corners(pose, landmark, rng, as_id=None):
    seen = project(pose, landmark) + rng.normal(0.0, SIGMA_PX, (4, 2))
    return CornerMeasurement(0, landmark.landmark_id if as_id is None else as_id, seen, SIGMA_PX, CAMERA)


def beacon(pose, landmark, rng, scale: float = 1.0):
    bearing, distance = rng.multivariate_normal(polar(pose, landmark)[::-1], R)
    return RangeBearingMeasurement(0, landmark.landmark_id, scale * distance, bearing, R)


def poses(seed: int, n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [se2.compose(truth_at(0.4 * i), rng.normal(0.0, 0.005, 3)) for i in range(n)]


@pytest.mark.parametrize("by", [(0.3, -0.4), (0.0, 0.25), (-1.5, 0.2)])
def test_the_displacement_of_a_moved_landmark_is_what_it_was_moved_by(by):
    rng, landmark = np.random.default_rng(0), beacons().landmarks[2]
    factors = LandmarkFactors(beacons())
    found = []
    for pose in poses(0, 12):
        sighting = factors.sighting(0, beacon(pose, moved(landmark, *by), rng), None)
        found.append(displacement(sighting, pose, factors))
    assert np.median(found, axis=0) == pytest.approx(by, abs=0.08)


def accused(sightings, factors, after: int = AFTER) -> LandmarkExclusion:
    quarantine = LandmarkExclusion(after)
    for pose, m in sightings:
        quarantine.reject([factors.sighting(0, m, 3.0)], 0, pose, factors)
    return quarantine


def test_fault_51_a_moved_marker_is_named_with_its_displacement():
    rng, world = np.random.default_rng(1), room()
    factors = LandmarkFactors(world)
    stands = moved(world.landmarks[7], 0.4, 0.3)
    seen = [(pose, corners(pose, stands, rng)) for pose in poses(1, 60) if project(pose, stands) is not None]
    assert len(seen) > AFTER
    before = accused(seen[: AFTER - 1], factors)
    assert not before.excludes(7)
    quarantine = accused(seen, factors)
    assert quarantine.excludes(7)
    assert list(quarantine.displacements) == [7]
    assert quarantine.displacements[7] == pytest.approx((0.4, 0.3), abs=0.05)


def test_fault_49_wrong_ids_scatter_and_name_nobody():
    """Whatever the camera sees is now and then taken for marker 7."""
    rng, world = np.random.default_rng(2), room()
    factors = LandmarkFactors(world)
    wrong = []
    for pose in poses(2, 40):
        others = [lm for lm in world.landmarks.values() if lm.landmark_id != 7 and project(pose, lm) is not None]
        other = others[rng.integers(len(others))]
        if factors.depth(m := corners(pose, other, rng, as_id=7), pose) > 0.5:
            wrong.append((pose, m))
    assert len(wrong) > 2 * AFTER
    assert not accused(wrong, factors).excludes(7)


def test_fault_49_one_landmark_now_and_then_misread_as_another_does_not_name_that_one():
    """Its refused sightings agree on a place, but somebody else stands there and is seen far more often."""
    rng, world = np.random.default_rng(6), beacons()
    factors, quarantine, rarely = LandmarkFactors(world), LandmarkExclusion(AFTER), LandmarkExclusion(AFTER)
    for k, pose in enumerate(poses(6, 200)):
        wrong = factors.sighting(0, replace(beacon(pose, world.landmarks[0], rng), landmark_id=3), None)
        rarely.accept(0)
        if k % 10 == 0:
            rarely.reject([wrong], 0, pose, factors)
        quarantine.accept(0)
        if k % 3 == 0:  # that often it is no misreading
            quarantine.reject([wrong], 0, pose, factors)
    assert not rarely.excludes(3)
    assert quarantine.excludes(3)


def test_a_landmark_that_is_only_ill_seen_is_not_named():
    """A range 4 % too long is no displacement worth a name; 15 % would be."""
    rng, world = np.random.default_rng(3), beacons()
    factors, here = LandmarkFactors(world), np.array([0.0, -1.0, 0.4])
    ill = [(here, beacon(here, world.landmarks[3], rng, 1.04)) for _ in range(30)]
    assert not accused(ill, factors).excludes(3)
    far = [(here, beacon(here, world.landmarks[3], rng, 1.15)) for _ in range(30)]
    assert accused(far, factors).excludes(3)


def test_a_sighting_that_fits_now_and_then_clears_a_landmark():
    rng, world = np.random.default_rng(5), beacons()
    factors, quarantine = LandmarkFactors(world), LandmarkExclusion(AFTER)
    stands = moved(world.landmarks[2], 0.6, 0.4)
    for i, pose in enumerate(poses(5, 60)):
        quarantine.reject([factors.sighting(0, beacon(pose, stands, rng), None)], 0, pose, factors)
        if i % 2:
            quarantine.accept(2)
    assert not quarantine.excludes(2)


def test_fault_51_a_moved_marker_that_is_put_back_does_no_harm_in_a_run():
    true_map = room()
    away = dict(true_map.landmarks)
    away[7] = moved(away[7], 0.5, -0.2)
    early, late = World(true_map, seconds=22.0, shown=LandmarkMap(away)), World(true_map, seconds=42.0, seed=1)
    at = early.start_ns + 22 * 10**9
    events = [e for e in early.events() if e.stamp_ns < at] + [e for e in late.events() if e.stamp_ns >= at]
    chain = Chain(exact(), true_map)
    estimates = chain.run(events)
    reasons = [(e.stamp_ns, d.reason) for e in estimates for d in e.decisions if d.landmark_id == 7]
    assert sum(reason == "quarantined" for stamp, reason in reasons if stamp < at) > 3
    assert set(chain.localizer.association.exclusion.displacements) == {7}  # where it stands now is not asked
    assert {reason for _, reason in reasons[-10:]} == {"quarantined"}
    assert np.mean([position_error(e, late.truth(e.stamp_ns)) for e in estimates]) < 0.006
