"""The pose before it is confirmed: what beacons allow, its covariance, and the work that it takes."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from robot_world import SPEED, START_NS, TURN, Chain, World, beacons, config, nees, position_error, truth_at
from test_initializer import landmark_map, point, seen_point
from world_bags import write_world

from fgloc import se2
from fgloc.estimation.beacons import GaussianSum
from fgloc.estimation.landmark_modes import MOST_HYPOTHESES
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.runner import run
from fgloc.types import Mode, MotionMeasurement

TRUTH = np.array([0.4, -0.3, 0.35])
A, B, C = point(1, 3.0, 1.0), point(2, 1.0, 3.0), point(3, -2.0, 2.0)


def drive(landmarks, seen, seconds=4.0, seed=0):
    """The sum after each step of a drive in which some of the landmarks are seen at 5 Hz, and the true poses."""
    cov = np.diag([0.004, 0.002, 0.006]) ** 2
    rng, total, pose = np.random.default_rng(seed), GaussianSum(config(), landmark_map(*landmarks)), TRUTH
    motion = np.array([0.08, 0.0, 0.06])
    for k in range(round(seconds / 0.2)):
        motions = []
        if k:
            pose = se2.compose(pose, se2.compose(motion, se2.exp(rng.multivariate_normal(np.zeros(3), cov))))
            motions = [MotionMeasurement("wheels", 0, 0, motion, cov)]
        noisy = [seen_point(pose, m, rng.normal(0, (0.06, 0.015))) for m in seen(k)]
        total.add(motions, noisy)
        yield total, pose


def error(total: GaussianSum, pose) -> tuple[np.ndarray, float]:
    """Error in the map and its NEES over 3."""
    belief = total.belief()
    off = belief.pose - pose
    off[2] = se2.wrap(off[2])
    cov = se2.rotate_cov(belief.cov, float(belief.pose[2]))
    return off, float(off @ np.linalg.solve(cov, off)) / 3.0


def test_fault_55_one_beacon_leaves_a_ring_and_its_covariance_says_so():
    total, pose = next(drive((A, B, C), lambda _k: [A], 0.2))
    belief = total.belief()
    assert np.sqrt(belief.cov[2, 2]) > 1.2
    assert np.sqrt(np.diag(belief.cov)[:2]).max() > 1.5
    assert error(total, pose)[1] < 3.0


def test_two_beacons_seen_in_turns_tell_the_pose():
    spread = []
    for seed in range(20):
        *_, (total, pose) = drive((A, B, C), lambda k: [(A, B)[k % 2]], seed=seed)
        off, honest = error(total, pose)
        assert np.hypot(*off[:2]) < 0.25
        spread.append(honest)
    assert 0.5 < np.mean(spread) < 1.6


def test_a_false_first_sighting_is_outvoted():
    stands = point(1, -3.0, -2.0)  # where A really is
    *_, (total, pose) = drive((A, B, C), lambda k: [stands] if k == 0 else [B, C], seconds=1.0)
    assert np.hypot(*error(total, pose)[0][:2]) < 0.2


def test_a_moved_beacon_counts_as_one_contradiction_however_often_it_is_seen():
    """Beacon 1 stands 1.5 m from where the map has it, and is seen in nine of ten steps."""
    stands = point(1, 4.5, 1.0)
    *_, (total, pose) = drive((A, B, C), lambda k: [(B, C)[k // 10 % 2]] if k % 10 == 9 else [stands], seconds=8.0)
    off, honest = error(total, pose)
    assert np.hypot(*off[:2]) < 0.3
    assert honest < 3.0
    assert total.confirmed() is not None


@pytest.mark.parametrize(("beacons", "jumps"), [((A, B, C), True), ((A, B), False)])
def test_a_tracked_pose_is_given_up_where_three_beacons_tell_another_place(beacons, jumps):
    """Two may both have been moved."""
    tracked = PoseWithCovariance(np.array([-1.0, -2.0, 2.0]), 1e-4 * np.eye(3))
    total = GaussianSum(config(), landmark_map(A, B, C))
    for m in beacons:
        total.add([], [seen_point(TRUTH, m)], tracked)
    place = total.confirmed(tracked)
    assert (place is not None and np.abs(place.pose - TRUTH).max() < 0.1) == jumps


def test_the_work_of_a_step_is_bounded():
    """However many beacons are seen, and however long none of them is where the map has it."""
    rng = np.random.default_rng(2)
    landmarks = [point(i, *rng.uniform(-4, 4, 2)) for i in range(60)]
    elsewhere = [point(i, *rng.uniform(-4, 4, 2)) for i in range(60)]
    times = []
    for total, _ in drive(landmarks, lambda _k: elsewhere, seconds=12.0):
        assert len(total.poses) <= MOST_HYPOTHESES
        began = time.process_time()
        total.add([], [seen_point(TRUTH, m) for m in elsewhere])
        times.append(time.process_time() - began)
    assert np.median(times[-20:]) < 5.0 * np.median(times[:20])


def test_the_first_pose_of_a_drive_comes_with_the_second_beacon():
    """Until its place is certain the pose is told, and is not surer than it may be."""
    told, honest = [], []
    for seed in range(12):
        world = World(beacons(), seed=seed, seconds=3.0, rate=5)
        chain = Chain(config(), world.map)
        estimates = chain.run(world.events())
        told.append((estimates[0].stamp_ns - START_NS) * 1e-9)
        early = [e for e in estimates if e.mode is Mode.UNCONFIRMED]
        honest += [nees(e, world.truth(e.stamp_ns)) / 3.0 for e in early]
        assert position_error(estimates[-1], world.truth(estimates[-1].stamp_ns)) < 0.3
    assert max(told) < 0.5
    assert np.mean(honest) < 1.6


@pytest.mark.parametrize("mode", ["batch", "online"])
def test_the_batch_begins_with_the_first_step(tmp_path, mode):
    """No beacon is seen for 12 s, longer than the search looks back."""
    world = World(beacons(), seconds=20.0, blind=((0.0, 12.0),))
    result = run(write_world(tmp_path, world), tmp_path / "map.yaml", config(), mode)
    began_s = (result.trajectory.stamps_ns[0] - START_NS) * 1e-9
    assert result.first_pose_s == pytest.approx(12.0, abs=0.5)
    if mode == "online":
        assert began_s == pytest.approx(result.first_pose_s, abs=0.1)
        return
    assert began_s == pytest.approx(0.0, abs=0.05)
    truth = np.array([truth_at((stamp - START_NS) * 1e-9) for stamp in result.trajectory.stamps_ns.tolist()])
    off = result.trajectory.poses - truth
    off[:, 2] = se2.wrap_array(off[:, 2])
    honest = np.einsum("ni,nij,nj->n", off, np.linalg.inv(result.trajectory.covs), off) / 3.0
    assert np.hypot(*off[:, :2].T).max() < 0.6
    assert honest.mean() < 2.5


def near(world: World, reach: float) -> list:
    """Its events with the sightings of beacons within reach alone."""
    kept = []
    for event in world.events():
        if hasattr(event, "sightings"):
            event = replace(event, sightings=tuple(s for s in event.sightings if s.range_m < reach))
            if not event.sightings:
                continue
        kept.append(event)
    return kept


@pytest.mark.parametrize("seed", range(6))
def test_sightings_within_a_metre_begin_where_the_robot_is_and_accuse_nobody(seed):
    radius = SPEED / TURN
    angles = np.linspace(0.0, 2.0 * math.pi, 7, endpoint=False) + 0.3
    along = [(radius + (0.5 if i % 2 else -0.5)) * np.array([math.sin(a), -math.cos(a)]) for i, a in enumerate(angles)]
    the_map = landmark_map(*(point(i, *place) for i, place in enumerate(along)))
    world = World(the_map, seed=seed, seconds=60.0)
    chain = Chain(config(), the_map)
    estimates = chain.run(near(world, 1.0))
    first = [e for e in estimates if e.mode is not Mode.UNCONFIRMED]
    assert position_error(first[0], world.truth(first[0].stamp_ns)) < 0.3
    assert not chain.localizer.sightings.modes.displacements
    assert np.mean([nees(e, world.truth(e.stamp_ns)) for e in estimates]) / 3.0 < 2.0


def test_beacons_along_a_corridor_tell_that_the_robot_is_in_it():
    """The last beacon of the corridor, seen from 6 m: from there all around, as far as it alone tells."""
    corridor = [point(k, 2.0 * k, 0.0) for k in range(8)]
    total = GaussianSum(config(), landmark_map(*corridor))
    total.add([], [seen_point(np.array([8.0, 0.0, 0.0]), corridor[-1])])
    belief = total.belief()
    cov = se2.rotate_cov(belief.cov, float(belief.pose[2]))
    assert np.sqrt(cov[1, 1]) < 3.0 < np.sqrt(cov[0, 0])
    assert belief.pose[0] < 12.5
