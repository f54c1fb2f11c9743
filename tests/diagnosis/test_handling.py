"""A robot that is held, lifted or turned by hand: named with its times, and nothing sound is blamed for it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from event_makers import command, odometry
from real_data import real_data

from fgloc import run
from fgloc.calibration.first_settings import first_settings
from fgloc.config import Config, config_of_file
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.gyro import by_hand
from fgloc.diagnosis.handling import handling
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.diagnosis.signals import Signals, read_signals
from fgloc.frames import rpy_matrix
from fgloc.recording.info import RecordingInfo
from fgloc.recording.reader import open_recording
from fgloc.runner import RunResult
from fgloc_datasets.bag import BagWriter

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
RADIUS, TRACK, DT = 0.033, 0.16, 0.02
REST, HELD, LIFTED, SECONDS = 8.0, (26.0, 34.0), (40.0, 46.0), 60.0
SIDES = {"left_joint": "wheel_left_joint", "right_joint": "wheel_right_joint"} | dict.fromkeys(
    ("left_radius", "right_radius"), RADIUS
)
HANDS = {"motion.held", "motion.lifted"}


@dataclass(frozen=True)
class Robot:
    """Optional contents of a small robot's recording.

    Attributes:
        hands: held while its wheels turn it on the spot, then lifted and turned.
        fused: the odometry's yaw is the gyro's.
        gravity: size of the specific force at rest [m/s²].
        shake: of the specific force while it drives [m/s²].
    """

    hands: bool = True
    fused: bool = True
    gravity: float = 10.25
    shake: float = 1.0


def record(out: Path, robot: Robot) -> Path:
    """Write its recording: commands at 10 Hz, joints, odometry and IMU at 50 Hz."""
    rng, t = np.random.default_rng(4), np.arange(0.0, SECONDS, DT)
    v, omega = np.zeros(len(t)), np.zeros(len(t))
    for a, b, speed, turn in ((8, 14, 0.2, 0.0), (14, 20, 0.0, 0.4), (20, 26, 0.2, -0.1), (26, 34, 0.0, -0.3)):
        v[(t >= a) & (t < b)], omega[(t >= a) & (t < b)] = speed, turn
    wheels, true = np.column_stack([v, omega]), omega.copy()
    tilt, yaw_by_hand = np.zeros((len(t), 2)), np.zeros(len(t))
    if robot.hands:
        true[(t >= HELD[0]) & (t < HELD[1])] *= 0.2
        up = (t >= LIFTED[0]) & (t < LIFTED[1])
        phase = (t[up] - LIFTED[0])[:, None] * [2.0, 3.0]
        tilt[up] = [0.25, 0.2] * np.sin(np.pi * phase / 3.0)
        yaw_by_hand[up] = 0.8 * np.sin(np.pi * (t[up] - LIFTED[0]) / 3.0)
        true = true + yaw_by_hand
    else:
        wheels[t >= HELD[0]] = 0.0
        true[t >= HELD[0]] = 0.0
    gyro = np.column_stack([np.gradient(tilt[:, 0], DT), np.gradient(tilt[:, 1], DT), true])
    gyro += np.array([0.01, -0.02, 0.004]) + rng.normal(0.0, 0.003, gyro.shape)
    angles = np.cumsum(wheels @ np.array([[1.0, 1.0], [-0.5 * TRACK, 0.5 * TRACK]]) * DT / RADIUS, axis=0)
    turn = gyro[:, 2] if robot.fused else wheels[:, 1]
    yaw = np.cumsum(turn * DT)
    xy = np.cumsum((wheels[:, 0] * DT)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    with BagWriter(out / "bag") as bag:
        for k, stamp in enumerate((START + np.round(t * SECOND)).astype(np.int64).tolist()):
            force = rpy_matrix(tilt[k, 0], tilt[k, 1], 0.0).T @ [0.0, 0.0, robot.gravity] + rng.normal(0.0, 0.05, 3)
            if wheels[k, 0] > 0.0:
                force += rng.normal(0.0, robot.shake, 3)
            bag.imu("/imu", stamp, gyro[k], force)
            bag.joints("/joint_states", stamp, ["wheel_left_joint", "wheel_right_joint"], angles[k])
            bag.odometry("/odom", stamp, (*xy[k], yaw[k]), (wheels[k, 0], turn[k]))
            if k % 5 == 0:
                bag.command("/cmd_vel", stamp, *wheels[k])
    return out / "bag"


@pytest.fixture(scope="module")
def handled(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("handled"), Robot())


@pytest.fixture(scope="module", params=["batch", "online"])
def ran(handled, request) -> RunResult:
    return run(handled, None, config_of_file(yaml.safe_load(first_settings(handled).text)), request.param)


def codes(found: RunResult | RecordingInfo) -> dict[str, float | None]:
    """Value of each finding of the motion, by code."""
    findings = found.findings if isinstance(found, RunResult) else found.found
    return {f.code: f.value for f in findings if f.code.split(".")[0] not in ("run", "recording", "place")}


def sigmas(result: RunResult, second: float) -> np.ndarray:
    at = int(np.searchsorted(result.trajectory.stamps_ns, START + round(second * SECOND)))
    return np.sqrt(np.diag(result.trajectory.covs[min(at, len(result.trajectory.covs) - 1)]))


def test_what_hands_did_is_named_with_its_times_before_a_run(handled) -> None:
    found = codes(inspect_all(handled, None, Config()))
    assert found["motion.held"] == pytest.approx(HELD[0], abs=1.0)
    assert found["motion.lifted"] == pytest.approx(LIFTED[0], abs=0.7)
    assert found["imu.gravity_scale"] == pytest.approx(10.25, abs=0.02)
    assert found.keys() == {*HANDS, "imu.gravity_scale", "odometry.yaw_is_gyro"}


def test_a_robot_that_would_be_in_hands_for_most_of_a_drive_is_in_none(handled) -> None:
    config = Config.model_validate({"wheels": {"source": "ticks", "track": TRACK, **SIDES}})
    with open_recording(handled, config.recording) as recording:
        signals = read_signals(recording, config)
    path = signals.path(config)
    for first_s, last_s, is_cut in ((0.0, SECONDS, True), (22.0, 49.0, False)):
        some = (path.times >= first_s) & (path.times <= last_s)
        part = replace(path, times=path.times[some], poses=path.poses[some], gaps=path.gaps[some])
        found = Conventions(config, signals)
        assert (by_hand(found, part) is not part) == is_cut
        assert bool(found.codes & HANDS) == is_cut


def test_a_run_blames_nothing_else_and_does_not_fail(ran) -> None:
    assert codes(ran).keys() >= HANDS
    assert not [code for code in codes(ran) if code.startswith(("floor", "sanity", "imu.a", "wheels", "clock"))]
    assert not ran.mistakes


def test_at_rest_a_pose_stays_as_certain_as_it_was(ran) -> None:
    assert sigmas(ran, REST - 0.5) == pytest.approx(sigmas(ran, 3.0), rel=0.02)
    assert sigmas(ran, SECONDS - 1.0) == pytest.approx(sigmas(ran, SECONDS - 8.0), rel=0.02)
    assert sigmas(ran, REST + 4.0)[0] > 2.0 * sigmas(ran, REST - 0.5)[0]


def test_in_hands_a_pose_is_not_known(ran) -> None:
    assert sigmas(ran, HELD[1])[2] < 0.1  # the gyro knows how it turned
    assert 0.1 < sigmas(ran, HELD[1])[0] < 1.0
    assert sigmas(ran, LIFTED[1])[0] > 2.0


def test_a_gyro_with_a_bias_and_wheels_that_are_silent_for_a_while_are_no_hands() -> None:
    rng, t = np.random.default_rng(3), np.arange(0.0, 30.0, 0.05)
    speeds = list(zip(t.tolist(), np.where((t > 10.0) & (t < 20.0), 0.3, 0.0).tolist(), strict=True))
    wheels = [odometry(s, twist=(v, 0.0)) for s, v in speeds if not 25.0 < s < 27.0]
    wheels += [command(s, v) for s, v in speeds[::2]]
    measured = rng.normal([0.0, 0.0, 0.03, 0.0, 0.0, 9.81], 0.003, (len(t), 6))
    imu = [(s, *row) for s, row in zip(t.tolist(), measured.tolist(), strict=True)]
    signals, config = Signals(motion=wheels, imu=imu), Config()
    found = handling(signals, config, signals.path(config), np.array([0.0, 0.0, 1.0]))
    assert found.spans == ()
    assert found.gravity == pytest.approx(9.81, abs=0.01)


def test_a_robot_that_nobody_touched_is_not_accused(tmp_path) -> None:
    bag = record(tmp_path, Robot(hands=False, fused=False, gravity=9.81, shake=2.0))
    assert not codes(inspect_all(bag, None, Config()))
    assert not codes(run(bag, None, Config(), "online"))


def test_the_first_settings_read_the_wheels_where_the_odometry_has_the_gyros_yaw(handled) -> None:
    wheels = config_of_file(yaml.safe_load(first_settings(handled).text)).wheels
    assert wheels.source == "ticks"
    assert wheels.left_radius == pytest.approx(RADIUS, rel=0.02)
    assert wheels.track == pytest.approx(TRACK, rel=0.02)


def test_a_gyro_learns_its_bias_at_rest(ran) -> None:
    turned = np.diff(np.unwrap(ran.trajectory.poses[:, 2]))
    late = ran.trajectory.stamps_ns[1:] > START + round((SECONDS - 8.0) * SECOND)
    assert abs(turned[late].sum()) < 1e-3  # 0.004 rad/s of bias would be 0.03 rad


@pytest.mark.parametrize(
    ("folder", "name", "held_s", "lifted_s"),
    [
        ("turtlebot3", "rosbag2_2025_11_06-17_25_46", 31.5, 43.2),
        ("turtlebot3_more", "rosbag2_2025_11_06-17_00_32", 20.6, 26.9),
        ("turtlebot3_more", "rosbag2_2025_11_06-17_30_33", None, 22.6),
    ],
)
def test_a_laboratory_floor_is_flat_although_the_robot_was_lifted_from_it(folder, name, held_s, lifted_s) -> None:
    bag = real_data(folder, name)
    config = config_of_file(yaml.safe_load(first_settings(bag).text))
    for found in (codes(inspect_all(bag, None, config)), codes(run(bag, None, config, "online"))):
        assert found.get("motion.held") == (held_s and pytest.approx(held_s, abs=1.0))
        assert found["motion.lifted"] == pytest.approx(lifted_s, abs=1.0)
        assert found["imu.gravity_scale"] == pytest.approx(10.25, abs=0.02)
        assert "odometry.yaw_is_gyro" in found
        assert not [code for code in found if code.startswith(("floor", "sanity", "imu.axes", "wheels"))]
