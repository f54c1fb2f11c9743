"""A batch never loses a run: gaps, silent sensors, no sightings, no map, odometry and IMU alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robot_world import SPEED, START_NS, TURN, Chain, World, beacons, config, truth_at
from world_bags import write_world

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.graph.batch import BatchSmoother
from fgloc.runner import run
from fgloc.sensors.maps import write_map
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.stats import chi2_bound
from fgloc.types import ControlEvent, Mode
from fgloc_datasets.bag import BagWriter

MODES = ("batch", "online")
STEP_NS = 20_000_000


def test_without_a_map_likely_sightings_are_kept_and_their_landmarks_are_found():
    world = World(beacons(), seconds=6.0, rate=5)
    chain = Chain(config(estimator={"kind": "isam2"}), None, keep_all=True)
    start = chain.run(world.events())[0]
    estimator, factors = chain.localizer.estimator, chain.localizer.factors
    solver = BatchSmoother(estimator.log, factors, BatchConfig(), 0.9999)
    seen = sum(len(frame.sightings) for frame in solver.frames)
    assert 0.9 * seen < sum(map(len, solver.accepted.values())) <= seen
    T = se2.compose(start.pose, se2.inverse(world.truth(start.stamp_ns)))
    landmarks = solver.result().landmarks
    assert landmarks.keys() == world.map.landmarks.keys()
    off = [
        np.hypot(*(m.position[:2] - se2.placed(T, world.map.landmarks[i].position[:2]))) for i, m in landmarks.items()
    ]
    assert max(off) < 0.2


def test_without_a_map_the_cost_is_that_of_the_graph_and_of_what_is_left_out():
    world = World(beacons(), seconds=3.0, rate=5)
    chain = Chain(config(), None, keep_all=True)
    chain.run(world.events())
    for probability in (1.0 - 1e-9, 0.5):
        solver = BatchSmoother(chain.localizer.estimator.log, chain.localizer.factors, BatchConfig(), probability)
        left_out = sum(len(frame.sightings) - len(solver.accepted[frame.k]) for frame in solver.frames)
        assert (left_out > 3) == (probability == 0.5)
        bounds = 0.5 * chi2_bound(probability, 2) * left_out
        assert solver.cost() == pytest.approx(solver.result().error + bounds, rel=0.05)  # weights settled


def test_sightings_that_were_refused_online_are_taken_if_they_fit_the_batch_on_a_map():
    world = World(beacons(), seconds=3.0, rate=5)
    for mapped in (True, False):
        chain = Chain(config(), world.map if mapped else None, keep_all=True)
        chain.run(world.events())
        log = chain.localizer.estimator.log
        frame = [frame for frame in log.keyframes.values() if frame.sightings][-1]
        frame.sightings, frame.rejected = (), (*frame.rejected, *frame.sightings)
        solver = BatchSmoother(log, chain.localizer.factors, BatchConfig(), 0.9999)
        assert not solver.accepted[frame.k]
        assert solver.reconsider() == mapped
        assert bool(solver.accepted[frame.k]) == mapped
        assert not solver.reconsider()  # there are no more


def finite(result) -> bool:
    poses, covs = result.trajectory.poses, result.trajectory.covs
    return bool(np.isfinite(poses).all() and np.isfinite(covs).all() and (np.linalg.eigvalsh(covs) > 0.0).all())


def span_s(result) -> float:
    stamps = result.trajectory.stamps_ns
    return float(stamps[-1] - stamps[0]) * 1e-9


def distances(result) -> np.ndarray:
    truth = np.array([truth_at((stamp - START_NS) * 1e-9) for stamp in result.trajectory.stamps_ns.tolist()])
    return np.hypot(*(result.trajectory.poses - truth)[:, :2].T)


def nis(result) -> np.ndarray:
    """Squared Mahalanobis distance of each position from the truth."""
    truth = np.array([truth_at((stamp - START_NS) * 1e-9) for stamp in result.trajectory.stamps_ns.tolist()])
    off = (result.trajectory.poses - truth)[:, :2]
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(result.trajectory.covs[:, :2, :2]), off)


@pytest.mark.parametrize(
    ("mode", "unseen", "commands"),
    [("batch", ((8.0, 18.0),), False), ("batch", (), True), ("online", (), False), ("online", ((8.0, 18.0),), True)],
)
def test_ten_seconds_without_motion(tmp_path, mode, unseen, commands):
    world = World(beacons(), seconds=24.0, dumb=((8.0, 18.0),), blind=unseen)
    bag = write_world(tmp_path, world, leave_out=(OdometryEvent if commands else ControlEvent,))
    settings = config(wheels={"source": "command"} if commands else {})
    result = run(bag, tmp_path / "map.yaml", settings, mode)
    assert finite(result)
    assert span_s(result) > 23.5
    assert distances(result)[-20:].max() < 0.3
    inside = (np.abs((result.trajectory.stamps_ns - START_NS) * 1e-9 - 13.0)) < 4.0
    assert nis(result)[inside].max() < 16.0
    assert result.rejections["wheels.silence"] > 0


@pytest.mark.parametrize("mode", MODES)
def test_a_map_but_no_sightings_at_all(tmp_path, mode):
    bag = write_world(tmp_path, World(beacons(), seconds=10.0), sightings=False)
    result = run(bag, tmp_path / "map.yaml", config(), mode)
    assert finite(result)
    assert span_s(result) > (9.5 if mode == "batch" else 4.5)  # online keeps no more than the search looks at
    assert set(result.modes) == {Mode.LOST}
    assert result.first_pose_s is None
    assert any("estimator.initial_pose" in note for note in result.notes)
    relative = result.trajectory.poses[:, :2] - result.trajectory.poses[0, :2]
    assert np.hypot(*relative[len(relative) // 2]) > 0.3


@pytest.mark.parametrize("mode", MODES)
def test_neither_map_nor_sightings(tmp_path, mode):
    bag = write_world(tmp_path, World(beacons(), seconds=10.0), sightings=False)
    result = run(bag, None, config(), mode)
    assert finite(result)
    assert span_s(result) > 9.5
    assert np.hypot(*result.trajectory.poses[0, :2]) < 1e-3


@pytest.mark.parametrize("mode", MODES)
def test_no_map_with_a_gap(tmp_path, mode):
    gap = ((8.0, 18.0),)
    bag = write_world(tmp_path, World(beacons(), seconds=24.0, dumb=gap, blind=gap), leave_out=(ControlEvent,))
    result = run(bag, None, config(), mode)
    assert finite(result)
    assert span_s(result) > 23.5


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("sightings", [True, False], ids=["sightings", "blind"])
def test_gyro_without_wheels(tmp_path, mode, sightings):
    world = World(beacons(), seconds=12.0)
    neither = (OdometryEvent, ControlEvent)
    bag = write_world(tmp_path, world, sightings=sightings, leave_out=neither, gyro_sigma=0.002)
    result = run(bag, tmp_path / "map.yaml", config(), mode)
    assert finite(result)
    assert span_s(result) > (11.0 if sightings or mode == "batch" else 4.5)
    if sightings:
        assert distances(result)[10:].mean() < 0.3


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("mapped", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["map", "no_map"])
def test_two_odometries_an_imu_in_three_dimensions_and_minutes_of_rest(tmp_path, mode, mapped):
    rng = np.random.default_rng(5)
    seconds, rest = 300, (60.0, 240.0)
    pose = np.zeros(3)
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(seconds * 20):
            stamp, t = START_NS + k * 50_000_000, 0.05 * k
            v, omega = (0.0, 0.0) if rest[0] <= t < rest[1] else (SPEED, TURN)
            pose = se2.compose(pose, se2.exp((0.05 * v, 0.0, 0.05 * omega)))
            bag.odometry("/odom", stamp, pose, (v, omega))
            bag.odometry("/odometry/second", stamp + 7_000_000, pose, (v, omega))
            gyro = np.array([0.0, 0.0, omega + 0.004]) + rng.normal(0.0, 0.01, 3)
            bag.imu("/imu/data", stamp + 3_000_000, gyro, (0.3, -0.2, 9.7))
    write_map(beacons(), tmp_path / "map.yaml")
    result = run(tmp_path / "bag", tmp_path / "map.yaml" if mapped else None, config(), mode)
    assert finite(result)
    assert span_s(result) > (4.5 if mapped and mode == "online" else seconds - 1.0)
    if span_s(result) < seconds / 2:
        return
    stamps = (result.trajectory.stamps_ns - START_NS) * 1e-9
    resting = result.trajectory.poses[(stamps > rest[0] + 2.0) & (stamps < rest[1] - 2.0)]
    assert np.ptp(resting[:, :2], axis=0).max() < 0.05


@pytest.mark.parametrize("mode", MODES)
def test_one_beacon_alone_tells_a_ring(tmp_path, mode):
    """Not where the robot is: no pose is sure of itself, and the batch still has every keyframe."""

    class OneSeen(World):
        def _sightings(self, stamp):
            event = super()._sightings(stamp)
            return replace(event, sightings=tuple(s for s in event.sightings if s.landmark_id == 2))

    bag = write_world(tmp_path, OneSeen(beacons(), seconds=12.0), leave_out=(ControlEvent,))
    result = run(bag, tmp_path / "map.yaml", config(), mode)
    assert finite(result)
    assert span_s(result) > (11.0 if mode == "batch" else 4.5)
    assert set(result.modes) <= {Mode.LOST, Mode.UNCONFIRMED}
