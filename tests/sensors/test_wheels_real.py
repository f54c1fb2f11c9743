"""Gate, stepper and wheel motion on recordings of real robots."""

import numpy as np
import pytest
from event_makers import check_steps
from real_data import real_data

from fgloc import se2
from fgloc.config import GateConfig, KeyframesConfig, RecordingConfig, WheelsConfig
from fgloc.frames import quaternion_yaw
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.intake.validation import EventValidator
from fgloc.recording.reader import open_recording
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion

pytestmark = pytest.mark.real_data


def replay(path, received=()):
    """Steps, raw odometry, gate and stepper of a recording."""
    source = open_recording(path, RecordingConfig(received_stamps=received))
    gate, stepper = EventValidator(GateConfig()), KeyframeBuilder(KeyframesConfig(), GateConfig(), 10.0)
    steps, raw = [], []
    for event in source.events():
        if isinstance(event, OdometryEvent):
            raw.append(event)
        checked = gate.check(event)
        if checked is not None:
            steps += stepper.push(checked)
    steps += stepper.flush()
    source.close()
    check_steps(steps)
    return steps, raw, gate, stepper


def total(steps, source):
    wheels = WheelMotion(WheelsConfig(source=source))
    pose = np.zeros(3)
    worst = 0.0
    for step in steps:
        measured = wheels.measure(step)
        if measured is not None:
            pose = se2.compose(pose, measured.motion)
            worst = max(worst, abs(measured.motion[2]) / step.dt)
            assert np.linalg.eigvalsh(measured.cov)[0] > 0.0
    return pose, worst


def recorded(raw, steps):
    """Motion between the odometry's poses at the first and the last keyframe."""
    stamps = np.array([e.stamp_ns for e in raw])
    poses = np.array([[e.position[0], e.position[1], quaternion_yaw(e.orientation)] for e in raw])
    start, end = se2.interpolate(stamps, poses, np.array([max(steps[0].stamp_ns, stamps[0]), steps[-1].stamp_ns]))
    return se2.between(start, end)


@pytest.mark.parametrize("name", ["rosbag2_2025_11_25-14_27_38", "rosbag2_2025_11_25-15_11_34"])
def test_fault_10_turtlebot3_spikes_do_not_reach_the_motion(name):
    steps, raw, gate, stepper = replay(real_data("turtlebot3", name))
    spikes = sum(abs(e.angular[2]) > 100 for e in raw)
    assert spikes > 0
    assert gate.rejections["odometry.twist_yaw_rate_bound"] == spikes
    assert not stepper.rejections
    expected = recorded(raw, steps)
    for source in ("auto", "twist", "pose"):
        pose, worst = total(steps, source)
        assert worst < 3.5  # the robot's limit is 2.84 rad/s
        assert pose == pytest.approx(expected, abs=1e-3 if source == "pose" else 0.03)


@pytest.mark.parametrize("name", ["duarte.bag", "pinto1.bag"])
def test_pioneer_poses_survive_stamps_of_receipt(name):
    roles = ("odometry", "sightings", "truth")
    steps, raw, gate, stepper = replay(real_data("pioneer_aruco", name), roles)
    assert not gate.rejections
    assert not stepper.rejections
    pose, _ = total(steps, "pose")
    assert pose == pytest.approx(recorded(raw, steps), abs=1e-3)
    assert sum(len(step.sightings) for step in steps) > 700
