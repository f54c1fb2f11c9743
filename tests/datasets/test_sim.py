"""The simulator: physics against its own laws, and recordings read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from fgloc.config import load_config
from fgloc.sensors.maps import load_map
from fgloc_datasets.sim.physics import Log, base_twist, make_scene, simulate, slipping, wheel_twist
from fgloc_datasets.sim.record import is_recorded, record
from fgloc_datasets.sim.scenario import Camera, Control, Floor, Patch, Robot, Scenario, World
from fgloc_datasets.sim.sensors import odometry

HALL = World(size_m=(20.0, 20.0))


def drive(seconds: float = 4.0, **fields: object) -> tuple[Scenario, Log]:
    scenario = Scenario(name="test", duration_s=seconds, camera=None, **{"world": HALL, **fields})
    return scenario, simulate(make_scene(scenario, 3))


@pytest.mark.parametrize("function", ["straight", "spin"])
def test_wheels_and_truth_agree_on_a_grippy_floor(function: str) -> None:
    scenario, log = drive(control=Control(functions=(function,)))
    half = len(log.stamps_s) // 2
    true, wheels = base_twist(log)[half:], wheel_twist(log, scenario.robot)[half:]
    axis = 0 if function == "straight" else 2
    assert abs(true[:, axis].mean()) > 0.1
    np.testing.assert_allclose(true[:, axis].mean(), wheels[:, axis].mean(), rtol=0.005)
    assert not slipping(log, scenario.robot).any()


def test_wheels_spin_on_ice_only() -> None:
    ice = Patch(center=(0.0, 0.0), size=(2.0, 2.0), shape="rectangle", mu=0.04)
    world = HALL.model_copy(update={"floor": Floor(patches=(ice,))})
    scenario, log = drive(world=world, control=Control(functions=("straight",)))
    slips = slipping(log, scenario.robot)
    start = (log.stamps_s > 1.2) & (log.stamps_s < 1.6)
    assert slips[start].mean() > 0.9
    difference = (wheel_twist(log, scenario.robot)[:, 0] - base_twist(log)[:, 0])[start]
    assert difference.mean() > 0.04


def test_odometry_believes_the_nominal_radii() -> None:
    robot = Robot(radius_scale=(0.99, 1.01))
    _, log = drive(6.0, robot=robot, control=Control(functions=("straight",)))
    poses, _ = odometry(log, robot, 4)
    true_yaw = 2 * np.arctan2(log.quaternions[-1, 2], log.quaternions[-1, 3])
    travelled = np.linalg.norm(log.positions[-1])
    assert travelled > 0.5
    assert poses[-1, 2] - true_yaw == pytest.approx(-0.02 * travelled / robot.track_m, rel=0.05)


def test_same_seed_same_log_other_seed_other_log() -> None:
    scenario = Scenario(name="test", duration_s=2.5, camera=None)
    first, again, other = (simulate(make_scene(scenario, seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.positions, again.positions)
    np.testing.assert_array_equal(first.torques, again.torques)
    assert np.abs(first.commands - other.commands).max() > 0.01


def test_recording_without_camera_reads_back(tmp_path: Path) -> None:
    scenario = Scenario(name="test", duration_s=2.0)
    out = tmp_path / "run"
    record(scenario, 5, out, camera=False)
    counts: dict[str, int] = {}
    last: dict[str, int] = {}
    with AnyReader([out / "bag"]) as reader:
        for connection, received_ns, raw in reader.messages():
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            message = reader.deserialize(raw, connection.msgtype)
            if hasattr(message, "header"):
                stamp_ns = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                assert last.get(connection.topic, 0) < stamp_ns < received_ns
                last[connection.topic] = stamp_ns
    assert counts["/odom"] == counts["/joint_states"] == counts["/truth"] == 101
    assert counts["/imu"] == 201
    assert counts["/cmd_vel"] == 41
    assert "/camera/image/compressed" not in counts
    assert len(load_map(out / "map.yaml")) == scenario.world.markers.count
    assert load_config(out / "robot.yaml").wheels.left_radius == scenario.robot.radius_m
    assert is_recorded(scenario, 5, out, camera=False)
    assert not is_recorded(scenario, 6, out, camera=False)
    assert not is_recorded(scenario.model_copy(update={"duration_s": 3.0}), 5, out, camera=False)


def test_scenario_refuses_what_it_does_not_know() -> None:
    with pytest.raises(ValueError, match="Extra inputs"):
        Camera(focal_mm=3.0)
