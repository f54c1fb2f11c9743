"""What the gate lets through, repairs and rejects, beyond the rows of faults (test_faults_gate.py)."""

import re
from dataclasses import replace

import numpy as np
import pytest
from event_makers import (
    SQUARE,
    command,
    corners,
    image,
    imu,
    joints,
    marker_pose,
    odometry,
    range_bearing,
    times,
)

from fgloc.config import GateConfig
from fgloc.intake.validation import EventValidator
from fgloc.types import CameraInfoEvent, Grave, TransformEvent, TruthEvent


@pytest.fixture
def gate():
    return EventValidator(GateConfig())


GOOD = [
    odometry(1.0, (1, 2, 3), (0.5, 0.1)),
    command(1.0, 0.5, -0.3),
    joints(1.0, 1e5, -3.0),
    joints(1.0, None, None, rates=(1.0, 2.0)),
    imu(1.0, 0.2),
    image(1.0),
    image(1.0, bytes(12), compressed=False, width=4, height=3, step=4),
    corners(1.0, 0, 5),
    marker_pose(1.0),
    range_bearing(1.0, (3, 4.0, -3.1)),
    TruthEvent(10**9, 10**9, "/truth", "map", np.zeros(3), np.array([0, 0, 0, 1.0])),
    TransformEvent(0, 10**9, "/tf_static", "base", "cam", np.zeros(3), np.array([0, 0, 0, 1.0]), True),
    CameraInfoEvent(0, 10**9, "/camera_info", "cam", 0, 0, "", np.zeros((3, 3)), np.empty(0)),
]


@pytest.mark.parametrize("event", GOOD, ids=lambda e: type(e).__name__)
def test_a_good_event_comes_back_as_it_was(gate, event):
    assert gate.check(event) is event
    assert not gate.rejections
    assert not gate.notes


def test_a_bad_twist_leaves_the_pose_usable(gate):
    event = gate.check(odometry(1.0, (1.0, 2.0, 0.5), (0.1, 125.0)))
    assert np.isnan(event.linear).all()
    assert np.isnan(event.angular).all()
    assert event.position[1] == 2.0
    assert gate.rejections == {"odometry.twist_yaw_rate_bound": 1}


def test_a_bad_pose_leaves_the_twist_usable(gate):
    event = gate.check(odometry(1.0, (np.nan, 0, 0), (0.1, 0.2)))
    assert np.isnan(event.position).all()
    assert np.isnan(event.orientation).all()
    assert event.linear[0] == 0.1
    assert gate.rejections == {"odometry.pose_non_finite": 1}


@pytest.mark.parametrize("lacking", ["pose", "twist"])
def test_a_part_that_messages_do_not_have_is_no_rejection(gate, lacking):
    values = ("position", "orientation") if lacking == "pose" else ("linear", "angular")
    whole = odometry(1.0, (1.0, 2.0, 0.5), (0.1, 0.2))
    none = {name: np.full_like(getattr(whole, name), np.nan) for name in (*values, f"{lacking}_cov")}
    event = gate.check(replace(whole, **none))
    assert np.isnan(getattr(event, values[0])).all()
    assert not gate.rejections


def test_an_odometry_without_any_usable_part_is_rejected(gate):
    assert gate.check(odometry(1.0, (np.nan, 0, 0), (0.1, 125.0))) is None
    assert gate.rejections == {"odometry.pose_non_finite": 1, "odometry.twist_yaw_rate_bound": 1}


def test_unlimited_variance_of_unread_axes_is_no_fault(gate):
    cov = np.diag([0.1, 0.1, np.inf, 1e9, np.inf, 0.2])
    event = odometry(1.0, pose_cov=cov, twist_cov=cov)
    assert gate.check(event) is event
    assert not gate.notes


def test_a_correlated_covariance_passes(gate):
    rng = np.random.default_rng(1)
    for k in range(20):
        a = rng.normal(size=(6, 6))
        cov = a @ a.T
        cov = 0.5 * (cov + cov.T)
        event = marker_pose(1.0 + k, cov=cov)
        assert gate.check(event) is event
        event = odometry(1.0 + k, pose_cov=cov)
        assert gate.check(event) is event
    assert not gate.rejections


def test_a_semidefinite_covariance_passes(gate):
    cov = np.eye(6) * 0.01
    cov[0, 1] = cov[1, 0] = 0.01  # x and y wholly correlated
    assert gate.check(odometry(1.0, pose_cov=cov)) is not None
    assert not gate.rejections


def test_a_changed_covariance_is_judged_anew(gate):
    bad = np.diag([-1.0, 1, 1, 1, 1, 1])
    assert np.isfinite(gate.check(odometry(1.0)).position).all()
    assert np.isnan(gate.check(odometry(1.1, pose_cov=bad)).position).all()
    assert np.isnan(gate.check(odometry(1.2, pose_cov=bad)).position).all()
    assert np.isfinite(gate.check(odometry(1.3)).position).all()
    assert gate.rejections == {"odometry.pose_negative_variance": 2}


def test_bad_entries_are_taken_out_of_sightings(gate):
    event = gate.check(range_bearing(1.0, (1, 2.0, 0.0), (2, np.inf, 0.0), (3, 1e3, 0.0), (4, 3.0, 1.0), (5, 0.0, 1.0)))
    assert [s.landmark_id for s in event.sightings] == [1, 4]
    assert gate.rejections == {"sightings.non_finite": 1, "sightings.range_bound": 2}


def test_an_empty_detection_is_not_a_rejection(gate):
    event = range_bearing(1.0)
    empty = type(event)(event.stamp_ns, event.received_ns, event.topic, event.frame_id, ())
    assert gate.check(empty) is empty
    assert not gate.rejections


def test_bearings_from_0_to_2_pi_are_wrapped(gate):
    event = gate.check(range_bearing(1.0, (1, 2.0, 1.5 * np.pi)))
    assert event.sightings[0].bearing_rad == pytest.approx(-0.5 * np.pi)
    assert not gate.rejections


def test_joints_keep_what_is_good(gate):
    event = gate.check(joints(1.0, 1.0, np.nan, rates=(2.0, 1e4)))
    assert event.position[0] == 1.0
    assert np.isnan(event.position[1])
    assert event.velocity[0] == 2.0
    assert np.isnan(event.velocity[1])
    assert gate.rejections == {"joints.position_non_finite": 1, "joints.wheel_rate_bound": 1}


def test_joints_that_are_nan_throughout_are_not_given(gate):
    event = gate.check(joints(1.0, 1.0, 2.0, rates=(np.nan, np.nan)))
    assert len(event.velocity) == 0
    assert not gate.rejections
    assert "velocity" in gate.notes[0]
    assert gate.check(joints(1.1, np.nan, np.nan)) is None
    assert gate.rejections == {"joints.non_finite": 1}


def test_joints_of_unequal_lengths_are_rejected(gate):
    assert gate.check(joints(1.0, 1.0, 2.0, names=("a", "b", "c"))) is None
    assert gate.rejections == {"joints.length": 1}


def test_an_imu_without_gyroscope_is_rejected(gate):
    cov = np.zeros((3, 3))
    cov[0, 0] = -1.0
    assert gate.check(imu(1.0, cov=cov)) is None
    assert gate.rejections == {"imu.unavailable": 1}


def test_gaps_are_reported_once_with_the_longest(gate):
    for t in [*times(1.0, 3.0, 10), *times(8.0, 9.0, 10), 30.0]:
        gate.check(odometry(t))
    [note] = gate.notes
    assert re.search(r"^/odom: 2 .* 1 s\b.* 21\.1 s$", note)


def test_one_very_late_message_is_no_gap(gate):
    for t in [1.0, 1.1, 1.2, 8.0 - 6.7, 8.0 - 6.6]:
        gate.check(odometry(t))
    gate.check(odometry(0.1))
    gate.check(odometry(1.5))
    assert not gate.notes


def test_a_small_marker_is_not_believed_but_a_slanted_one_is(gate):
    assert gate.check(corners(1.0, at=SQUARE * 0.1)) is None
    slanted = SQUARE * np.array([0.1, 1.0])
    assert gate.check(corners(1.1, at=slanted)) is not None
    assert gate.rejections == {"sightings.corners_small": 1}


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["forward", "reverse"])
@pytest.mark.parametrize("axis", range(3))
def test_speeds_are_bounded_in_both_directions(gate, sign, axis):
    bound = GateConfig().max_speed
    linear = np.zeros(3)
    linear[axis] = sign * 1.01 * bound
    event = gate.check(odometry(1.0, linear=linear))
    assert np.isnan(event.linear).all()
    assert gate.rejections == {"odometry.twist_speed_bound": 1}
    linear[axis] = sign * 0.99 * bound
    kept = odometry(1.1, linear=linear)
    assert gate.check(kept) is kept


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["forward", "reverse"])
def test_commands_are_bounded_in_both_directions(gate, sign):
    config = GateConfig()
    assert gate.check(command(1.0, sign * 1.01 * config.max_speed)) is None
    assert gate.check(command(1.1, 0.0, sign * 1.01 * config.max_yaw_rate)) is None
    assert gate.rejections == {"command.speed_bound": 1, "command.yaw_rate_bound": 1}
    kept = command(1.2, sign * 0.99 * config.max_speed, sign * 0.99 * config.max_yaw_rate)
    assert gate.check(kept) is kept


def test_yaw_rates_of_odometry_are_bounded_in_both_directions(gate):
    gate.check(odometry(1.0, twist=(0.0, -1.01 * GateConfig().max_yaw_rate)))
    assert gate.rejections == {"odometry.twist_yaw_rate_bound": 1}


def repeated_imu(rates, accelerations):
    values = dict(angular_velocity=np.array(rates), linear_acceleration=np.array(accelerations))
    return [replace(imu(1.0 + 0.05 * k), **values) for k in range(60)]


def test_an_imu_that_repeats_itself_is_frozen_until_it_measures_again(gate):
    passed = [gate.check(event) for event in repeated_imu((0.004, -0.08, 0.02), (-0.1, 0.05, 10.3))]
    assert [event is not None for event in passed] == [k <= 20 for k in range(60)]  # of the first second
    assert gate.rejections == {"imu.frozen": 39}
    assert any(isinstance(note, Grave) for note in gate.notes)
    assert gate.check(imu(5.0, 0.21)) is not None


def test_a_simulated_imu_without_noise_may_repeat_itself(gate):
    assert all(gate.check(event) is not None for event in repeated_imu((0.0, 0.0, 0.2), (0.0, 0.1, 9.81)))
