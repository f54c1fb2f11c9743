"""Uneven ground: motions in the robot's plane seen in the map, sightings by the pose in space, gravity, prediction."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from robot_world import Chain, World, config, position_error, room
from test_graph import break_down, wall_map
from test_observation import scene

from fgloc import se2
from fgloc.config import BatchConfig, Config, EstimatorConfig
from fgloc.frames import quaternion_matrix, rpy_matrix, rpy_quaternion
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.estimators import IncrementalEstimator
from fgloc.graph.factors import INSTALLATION, LandmarkFactors, ground_key
from fgloc.graph.ground import (
    GRAVITY,
    driven,
    gravity,
    ground_factors,
    ground_step,
    levelled,
    planar_turn,
    predict,
    spatial,
    step_of,
)
from fgloc.graph.installation import GROUND, Installation, InstallationEstimate
from fgloc.graph.joint import fuse_installed, predict_on_plane
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.observation import Observations
from fgloc.types import InertialReading, MotionMeasurement

IMU = ("gyro.bias_x", "gyro.bias_y", "gyro.roll_rad", "gyro.pitch_rad", "gyro.level_x_rad", "gyro.level_y_rad")


def installation(*names: str, ground: bool = True) -> Installation:
    sigmas = dict.fromkeys(names, 0.01) | (dict.fromkeys(GROUND, 0.1) if ground else {})
    return Installation(sigmas)


def moved(motion, inertial: InertialReading | None = None) -> MotionMeasurement:
    return MotionMeasurement("wheels", 0, 200_000_000, np.array(motion), np.diag([1e-4, 1e-5, 1e-4]), inertial=inertial)


def reading(turn, force=None) -> InertialReading:
    return InertialReading(np.array(turn), 1e-6, None if force is None else np.array(force), 0.04, 0.2)


def in_space(pose, ground) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = rpy_matrix(ground[1], ground[2], pose[2])
    T[:3, 3] = pose[0], pose[1], ground[0]
    return T


def test_a_motion_in_the_robots_plane_is_one_of_se3() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        pose, ground = rng.normal(0.0, 1.0, 3), rng.normal(0.0, 0.2, 3)
        yaw, turn = rng.normal(0.0, 0.3), rng.normal(0.0, 0.1, 2)
        way = np.array([*rng.normal(0.0, 0.2, 2), 0.0])
        planar, climbed, after = driven(ground[None, 1:], np.array([[*way[:2], yaw]]), turn[None])
        T = np.eye(4)
        T[:3, :3] = gtsam.Rot3.Expmap(np.array([*turn, yaw])).matrix()
        T[:3, 3] = gtsam.Rot3.Expmap(np.array([*(0.5 * turn), 0.0])).matrix() @ way
        expected = in_space(pose, ground) @ T
        got = in_space(se2.compose(pose, planar[0]), (ground[0] + climbed[0], *after[0]))
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_level_ground_leaves_motions_as_they_are() -> None:
    motions = np.array([[0.3, 0.02, 0.4]])
    planar, climbed, after = driven(np.zeros((1, 2)), motions, np.zeros((1, 2)))
    np.testing.assert_allclose(planar, motions, atol=1e-15)
    np.testing.assert_allclose((climbed[0], *after[0]), 0.0, atol=1e-15)


def test_a_climb_is_shorter_in_the_map() -> None:
    """15 degrees up: cos(15°) of the way, and sin(15°) of it in height; the nose is up: negative pitch."""
    found = step([0.2, 0.0, 0.0], (0.0, 0.0, -np.radians(15.0)), reading([0.0, 0.0]))
    np.testing.assert_allclose(found.motions[0].motion, (0.2 * np.cos(np.radians(15.0)), 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(found.after, (0.2 * np.sin(np.radians(15.0)), 0.0, -np.radians(15.0)), atol=1e-9)


def test_turning_on_a_slope_turns_the_slope_in_the_robots_axes() -> None:
    """Nose up by 10 degrees, then a quarter turn to the left about the robot's own axis: uphill is on the right."""
    slope = np.radians(10.0)
    found = step([0.0, 0.0, 0.5 * np.pi], (0.0, 0.0, -slope), reading([0.0, 0.0]))
    np.testing.assert_allclose(found.after[1:], (-slope, 0.0), atol=1e-9)


def test_a_height_is_less_sure_where_the_slope_changes_and_not_on_a_steady_one() -> None:
    way, turn = [0.2, 0.0, 0.0], reading([0.0, 0.02])
    level, steady, bent = (
        step(way, (0.0, 0.0, pitch), inertial).cov[0, 0]
        for pitch, inertial in ((0.0, reading([0.0, 0.0])), (-0.3, reading([0.0, 0.0])), (0.0, turn))
    )
    along = np.sin(0.3) ** 2 * 1e-4  # of the motion, seen in the height
    assert steady == pytest.approx(level + along, rel=0.01)
    assert bent > 2.0 * level


def test_the_height_of_a_standing_robot_does_not_become_surer() -> None:
    """Else its covariance would be singular, or no covariance, after a while."""
    assert np.linalg.eigvalsh(step([0.0, 0.0, 0.0], (0.0, 0.0, 0.0), reading([0.0, 0.0])).cov)[0] > 0.0
    assert step([0.0, 0.0, 0.0], (0.0, 0.0, 0.0)).cov[0, 0] > 0.0


def step(motion, ground, inertial=None, of: Installation | None = None, theta=None):
    of = of or installation()
    motions = [moved(motion, inertial)]
    theta = np.zeros(of.constants) if theta is None else theta
    return ground_step(motions, fuse_installed(motions), np.array(ground), theta, of)


def test_derivatives_of_a_step() -> None:
    of = installation(*IMU)
    ground, theta = np.array([0.1, 0.08, -0.2]), np.array([0.004, -0.003, 0.01, -0.02, 0.0, 0.0])
    motion, turn = [0.15, 0.01, 0.3], [0.03, -0.05]

    def after(g, t):
        return step(motion, g, reading(turn), of, t).after

    found, h = step(motion, ground, reading(turn), of, theta), 1e-6
    A = np.array([(after(ground + h * e, theta) - after(ground - h * e, theta)) / (2 * h) for e in np.eye(3)]).T
    D = np.array([(after(ground, theta + h * e) - after(ground, theta - h * e)) / (2 * h) for e in np.eye(6)]).T
    np.testing.assert_allclose(found.A, A, atol=1e-5)
    np.testing.assert_allclose(found.D, D, atol=2e-3 * np.abs(D).max())  # the share of the gyro changes a little
    assert np.linalg.eigvalsh(found.cov).min() > 0.0


def test_a_tilted_imu_sees_a_turn_about_its_other_axes() -> None:
    """ε about y: of a turn by 1 rad about the robot's z the IMU sees -ε about x; taken out, nothing is left of it."""
    of, tilt = installation(*IMU), 0.02
    R = rpy_matrix(0.0, tilt, 0.0)
    seen = R.T @ np.array([0.0, 0.0, 1.0])
    theta = np.zeros(6)
    theta[IMU.index("gyro.pitch_rad")] = tilt
    found = step([0.0, 0.0, 1.0], (0.0, 0.0, 0.0), reading(seen[:2]), of, theta)
    assert found.turning is not None
    np.testing.assert_allclose(found.turning.turn, 0.0, atol=1e-4)
    assert found.turning.D[0, IMU.index("gyro.pitch_rad")] == pytest.approx(1.0)


@pytest.mark.parametrize("names", [(), IMU], ids=["none", "imu"])
def test_factors_of_the_ground_hold_where_a_step_leads_and_gravity_agrees(names) -> None:
    of = installation(*names)
    theta, turn = np.zeros(of.constants + 3), np.array([0.03, -0.05])
    after = step_of([moved([0.15, 0.01, 0.3], reading(turn))], theta, of).after
    force = rpy_matrix(after[1], after[2], 0.0).T @ np.array([0.0, 0.0, GRAVITY])
    motions = [moved([0.15, 0.01, 0.3], reading(turn, force))]
    found = step_of(motions, theta, of)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in ground_factors(1, motions, found, theta, of):
        graph.add(factor)
    values.insert(ground_key(0), found.before)
    values.insert(ground_key(1), found.after)
    if names:
        values.insert(INSTALLATION, theta[: of.constants])
    assert found.turning is not None
    turned = 0.5 * float(turn @ turn) / found.turning.variance  # which bias or mounting would have to explain
    assert graph.error(values) == pytest.approx(turned if names else 0.0, abs=1e-9)


def test_gravity_tells_roll_and_pitch() -> None:
    of, ground = installation(), np.array([0.0, 0.12, -0.2])
    force = rpy_matrix(0.12, -0.2, 0.7).T @ np.array([0.0, 0.0, GRAVITY])
    seen = gravity([moved([0.1, 0.0, 0.0], reading([0.0, 0.0], force))], ground, np.zeros(3), of)
    assert seen is not None
    np.testing.assert_allclose(seen.residual, 0.0, atol=1e-12)
    pushed = gravity(
        [moved([0.1, 0.0, 0.0], reading([0.0, 0.0], force + np.array([6.0, 0.0, 0.0])))], ground, np.zeros(3), of
    )
    assert pushed is not None
    assert pushed.cov[0, 0] > 20.0 * seen.cov[0, 0]  # what is not gravity's counts for little
    assert gravity([moved([0.1, 0.0, 0.0])], ground, np.zeros(3), of) is None


def test_while_no_pose_is_known_gravity_levels_the_base() -> None:
    of = installation()
    force = rpy_matrix(0.1, -0.25, 0.0).T @ np.array([0.0, 0.0, GRAVITY])
    found = levelled(of.prior(), [moved([0.0, 0.0, 0.0], reading([0.0, 0.0], force))], of)
    np.testing.assert_allclose(found.mean[-2:], (0.1, -0.25), atol=0.02)
    assert (np.diag(found.cov)[-2:] < 0.05**2).all()


@pytest.mark.parametrize("ground", [(0.0, 0.0, 0.0), (0.05, 0.1, -0.2)])
def test_derivatives_of_corners_by_the_pose_in_space(ground) -> None:
    poses, markers, seen = scene(3)
    of = Installation({f"camera.{i}": 0.01 for i in range(12)} | dict.fromkeys(GROUND, 0.1))
    theta = np.concatenate([np.random.default_rng(4).normal(0.0, 1e-3, 12), ground])
    seen = [replace(m, tilting=np.array([0.2, -0.3])) for m in seen]
    observed, h = Observations(seen, markers.landmarks, of), 1e-6
    lines = observed.linearize(poses, theta)
    ahead = [i for i, one in enumerate(lines) if not one.behind]
    assert len(ahead) > 2
    for i in ahead:
        one = lines[i]

        def at(by_pose, by_theta, i=i):
            there = np.array([se2.compose(p, se2.exp(by_pose)) for p in poses])
            return observed.linearize(there, theta + by_theta)[i].residual

        J = np.array([(at(h * e, 0.0 * theta) - at(-h * e, 0.0 * theta)) / (2 * h) for e in np.eye(3)]).T
        H = np.array([(at(np.zeros(3), h * e) - at(np.zeros(3), -h * e)) / (2 * h) for e in np.eye(15)[12:]]).T
        assert one.columns[-3:].tolist() == [12, 13, 14]
        np.testing.assert_allclose(one.J, J, atol=2e-4 * np.abs(J).max())
        np.testing.assert_allclose(one.H[:, -3:], H, atol=2e-3 * np.abs(H).max())


def test_corners_on_level_ground_are_those_of_a_flat_floor() -> None:
    poses, markers, seen = scene(5)
    flat = Observations(seen, markers.landmarks, Installation({})).linearize(poses, np.zeros(0))
    uneven = Observations(seen, markers.landmarks, installation()).linearize(poses, np.zeros(3))
    for a, b in zip(flat, uneven, strict=True):
        np.testing.assert_allclose(a.residual, b.residual, atol=1e-9)
        np.testing.assert_allclose(a.J, b.J, atol=1e-9)


def test_prediction_on_level_ground_is_that_on_the_plane() -> None:
    of, flat = installation(), installation(ground=False)
    start = PoseWithCovariance(np.array([1.0, 2.0, 0.5]), np.diag([1e-4, 2e-4, 3e-4]))
    motions = [moved([0.2, 0.0, 0.1])]
    on_plane = predict_on_plane(start, InstallationEstimate(np.zeros(0), np.zeros((0, 0))), flat, motions)
    known = InstallationEstimate(np.zeros(3), np.diag([0.01, 0.02, 0.02]) ** 2)
    found = predict(start, known, of, motions)
    np.testing.assert_allclose(found.pose, on_plane.pose, atol=1e-9)
    np.testing.assert_allclose(found.cov, on_plane.cov, atol=1e-9)
    ground = spatial(found, of, np.zeros((3, 3)))
    assert ground is not None
    assert np.linalg.eigvalsh(ground.cov).min() > 0.0
    assert spatial(found, flat, np.zeros((3, 3))) is None


def test_the_yaw_on_a_slope_is_not_what_the_gyro_turns() -> None:
    of, motion = installation(), np.array([0.0, 0.0, 0.1])
    theta = np.array([0.0, 0.2, 0.0])  # rolled: a turn about the robot's axis is one about the map's by its cosine
    assert planar_turn(motion, None, theta, of) == pytest.approx(0.1 * np.cos(0.2), abs=1e-3)


def test_the_configuration_makes_the_state() -> None:
    from fgloc.graph.installation import installation_of
    from fgloc.types import LandmarkMap

    flat = installation_of(Config(), LandmarkMap({}), corners=True, has_gyro=True)
    config = Config.model_validate({"estimator": {"ground": "uneven"}})
    uneven = installation_of(config, LandmarkMap({}), corners=True, has_gyro=True)
    assert not flat.ground
    assert flat.constants == len(flat)
    assert uneven.names[-3:] == GROUND
    assert uneven.constants == len(uneven) - 3
    assert set(IMU) < set(uneven.names)
    assert not set(IMU) & set(flat.names)


def test_a_window_that_is_built_again_keeps_the_slope_of_each_keyframe() -> None:
    """The nose rises step by step: a motion is as long in the map as the slope it was driven on has it."""
    motion = moved([0.1, 0.0, 0.0], reading([0.0, -0.05]))
    found = []
    for breaks in (False, True):
        of = installation()
        estimator = IncrementalEstimator(EstimatorConfig(), LandmarkFactors(wall_map(), of))
        estimator.start(0, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-4))
        for k in range(1, 12):
            if breaks and k == 11:
                break_down(estimator)
            belief = estimator.update(k * 10**8, 0.1, [motion])
        assert estimator.rebuilt == breaks
        found.append(belief)
    assert found[0].pose[0] < 1.08
    np.testing.assert_allclose(found[1].pose, found[0].pose, atol=1e-4)
    np.testing.assert_allclose(found[1].installation.mean, found[0].installation.mean, atol=1e-4)


def test_quaternions_of_roll_pitch_and_yaw() -> None:
    np.testing.assert_allclose(
        quaternion_matrix(rpy_quaternion(0.1, -0.2, 2.0)), rpy_matrix(0.1, -0.2, 2.0), atol=1e-12
    )


@pytest.mark.parametrize("kind", ["fixed_lag", "isam2", "ekf"])
def test_a_flat_floor_that_may_be_uneven_gives_the_same_place(kind) -> None:
    world = World(room(), seconds=4.0, rate=5)
    chain = Chain(config(estimator={"ground": "uneven", "kind": kind}), world.map)
    estimates = chain.run(world.events())
    assert len(estimates) > 15
    assert max(position_error(e, world.truth(e.stamp_ns)) for e in estimates[3:]) < 0.05
    assert all(abs(e.ground.z) < 0.1 for e in estimates[3:])


def test_height_and_tilt_are_less_sure_by_the_clock_the_faster_they_change() -> None:
    world = World(room(), seconds=2.0, rate=5)
    chain = Chain(config(estimator={"ground": "uneven"}, recording={"clock_sigma_s": 0.1}), world.map, keep_all=True)
    made = chain.run(world.events())
    frames = {frame.stamp_ns: frame for frame in chain.localizer.estimator.log.keyframes.values()}
    for before, now in pairwise(made):
        was, is_ = (np.array([e.ground.z, e.ground.roll, e.ground.pitch]) for e in (before, now))
        rates = (is_ - was) / ((now.stamp_ns - before.stamp_ns) * 1e-9)
        added = frames[now.stamp_ns].ground_clock_cov
        assert np.linalg.norm(rates) > 0.0
        np.testing.assert_allclose(np.sqrt(np.diag(added)[2:5]), 0.1 * np.abs(rates), rtol=0.1)
    assert not frames[made[0].stamp_ns].ground_clock_cov.any()  # nothing tells how fast yet


def test_a_batch_begins_at_the_height_and_the_tilt_of_each_keyframe() -> None:
    world = World(room(), seconds=2.0, rate=5)
    chain = Chain(config(estimator={"ground": "uneven"}), world.map, keep_all=True)
    estimates = chain.run(world.events())
    solver = BatchSmoother(chain.localizer.estimator.log, chain.localizer.factors, BatchConfig(), 0.9999)
    result = solver.result()
    assert result.ground.shape == (len(estimates), 3)
    assert np.abs(result.ground).max() < 0.1
    assert len(np.unique(result.ground[:, 0])) == len(estimates)
