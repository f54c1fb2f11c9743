"""Simulated robots of other drives: their physics against theory, their recordings, and what their files say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fgloc.config import load_config
from fgloc.recording.reader import open_recording
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, TruthEvent
from fgloc_datasets.sim.drives import as_driven, believed, steering_angles, steering_names, wheel_names
from fgloc_datasets.sim.installed import load_installed
from fgloc_datasets.sim.physics import base_twist, make_scene, simulate, slipping, wheel_twist
from fgloc_datasets.sim.record import BUNDLED, load_suite, record
from fgloc_datasets.sim.scenario import Control, Floor, Installation, Robot, Scenario, World
from fgloc_datasets.sim.sensors import odometry

SUITE = load_suite(BUNDLED)
HALL = World(size_m=(20.0, 20.0))


def robot(kind: str, **changes: object) -> Robot:
    return SUITE.find(kind).robot.model_copy(update=changes)


def driven(of: Robot, function: str, seconds: float = 6.0, seed: int = 3, **changes: object) -> Scenario:
    fields = {"world": HALL, **changes}
    return Scenario(
        name="test", duration_s=seconds, camera=None, robot=of, control=Control(functions=(function,)), **fields
    )


@pytest.mark.parametrize("function", ["straight", "turns", "sines"])
@pytest.mark.parametrize(("kind", "within"), [("ackermann", 0.01), ("mecanum", 0.03)])
def test_a_robot_moves_as_its_wheels_say_where_they_grip(kind: str, within: float, function: str) -> None:
    of = robot(kind)
    log = simulate(make_scene(driven(of, function), 3))
    steady = log.stamps_s > 2.0
    true, by_wheels = base_twist(log)[steady], wheel_twist(log, of)[steady]
    speed, turn = np.hypot(*true[:, :2].T).mean(), np.abs(true[:, 2]).mean()
    assert speed > 0.1
    np.testing.assert_allclose(by_wheels[:, :2].mean(axis=0), true[:, :2].mean(axis=0), atol=within * speed)
    np.testing.assert_allclose(by_wheels[:, 2].mean(), true[:, 2].mean(), atol=within * max(turn, 0.2))
    assert slipping(log, of)[steady].mean() < 0.05  # a roller takes over from the one before
    assert np.ptp(log.positions[steady, 2]) < 1e-3  # rollers are round enough


def test_a_mecanum_robot_goes_sideways_and_rollers_slip_on_ice() -> None:
    of = robot("mecanum")
    grips, ice = (
        simulate(make_scene(driven(of, "straight", world=HALL.model_copy(update={"floor": Floor(mu=mu)})), 3))
        for mu in (0.8, 0.03)
    )
    steady = grips.stamps_s > 2.0
    aside = base_twist(grips)[steady, 1]
    assert np.abs(aside).max() > 0.1
    wanted = np.interp(grips.stamps_s[steady], grips.commands[:, 0], grips.commands[:, 3])
    np.testing.assert_allclose(aside, wanted, atol=0.02)
    start = (ice.stamps_s > 1.1) & (ice.stamps_s < 1.6)
    assert slipping(ice, of)[start].mean() > 0.8


def test_a_car_turns_about_a_point_of_its_rear_axle() -> None:
    of = robot("ackermann")
    command = as_driven(of, 0.3, 0.5)
    curvature = math.tan(command.steering) / of.wheelbase_m
    assert command.omega == pytest.approx(0.5) == pytest.approx(command.v * curvature)
    left, right = steering_angles(of, command.steering)
    assert 1.0 / math.tan(right) - 1.0 / math.tan(left) == pytest.approx(of.track_m / of.wheelbase_m)
    log = simulate(make_scene(driven(of, "turns"), 3))
    steady = log.stamps_s > 2.0
    true = base_twist(log)[steady]
    angle = log.commands[-1, 4]
    assert abs(angle) > 0.1
    np.testing.assert_allclose(true[:, 2].mean() / true[:, 0].mean(), math.tan(angle) / of.wheelbase_m, rtol=0.02)
    np.testing.assert_allclose(true[:, 1].mean(), 0.0, atol=0.003)


def test_a_car_does_not_turn_where_it_stands() -> None:
    of = robot("ackermann")
    turned = as_driven(of, 0.0, 1.0)
    assert turned.steering == pytest.approx(of.max_steering_rad)
    assert turned.v == pytest.approx(turned.omega * of.wheelbase_m / math.tan(of.max_steering_rad))
    assert as_driven(of, 0.0, 0.0, steering=0.3) == (0.0, 0.0, 0.0, 0.3)
    assert as_driven(Robot(), 0.2, 0.3, 0.4) == (0.2, 0.3, 0.0, 0.0)


def test_odometry_believes_the_geometry_that_is_written() -> None:
    errors = Installation(steering_zero_deg=3.0, wheelbase_share=0.03)
    scene = make_scene(driven(robot("ackermann"), "straight", installation=errors), 3)
    steering = scene.installed.wheels.steering
    assert steering is not None
    assert abs(steering.zero_rad) > 0.005
    log = simulate(scene)
    poses, twists = odometry(log, scene.scenario.robot, 4)
    travelled = np.linalg.norm(log.positions[-1])
    true_yaw = 2 * np.arctan2(log.quaternions[-1, 2], log.quaternions[-1, 3])
    turned = travelled * math.tan(steering.zero_rad) / scene.installed.wheels.wheelbase
    assert true_yaw == pytest.approx(turned, rel=0.1)
    assert poses[-1, 2] / turned == pytest.approx(1.0 / 3.0, abs=0.1)  # by the wheels' difference, not by the steering
    assert twists.shape == poses.shape


@pytest.mark.parametrize("kind", ["ackermann", "mecanum", "skid_steer"])
def test_recordings_read_back_with_the_drive(kind: str, tmp_path: Path) -> None:
    scenario = SUITE.find(kind).model_copy(update={"duration_s": 4.0})
    record(scenario, 5, tmp_path, camera=False)
    config, of = load_config(tmp_path / "robot.yaml"), scenario.robot
    drive, installed = config.wheels.drive, load_installed(tmp_path / "installed.yaml")
    assert drive == believed(of)
    assert drive.kind == kind
    names = (*wheel_names(of), *steering_names(of))
    assert set(names) == {*drive.driven, *drive.steered}
    with open_recording(tmp_path / "bag", config.recording) as recording:
        events = list(recording.events())
    joints = [e for e in events if isinstance(e, JointsEvent)]
    assert all(e.names == names for e in joints)
    commands = [e for e in events if isinstance(e, ControlEvent)]
    assert len(commands) == 81
    assert (commands[-1].steering is not None) == (kind == "ackermann")
    assert (abs(commands[-1].vy) > 0.0) == (kind == "mecanum")
    told = [e for e in events if isinstance(e, OdometryEvent)][-1]
    where = [e for e in events if isinstance(e, TruthEvent)][-1]
    if kind != "skid_steer":
        np.testing.assert_allclose(told.position[:2], where.position[:2], atol=0.05)
        assert installed.wheels.wheelbase != installed.believed.wheels.wheelbase == of.wheelbase_m
    assert ("steering" in (tmp_path / "installed.yaml").read_text()) == (kind == "ackermann")
