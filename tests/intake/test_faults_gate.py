"""Rows of the table of faults that the gate, the stepper and the wheel motion answer for."""

import re
from dataclasses import replace

import numpy as np
import pytest
from event_makers import (
    SQUARE,
    check_steps,
    command,
    corners,
    image,
    imu,
    in_order_of_receipt,
    joints,
    marker_pose,
    ns,
    odometry,
    range_bearing,
    run,
    stepper,
    times,
)

from fgloc import se2
from fgloc.config import GateConfig, WheelsConfig
from fgloc.errors import ConfigError
from fgloc.intake.validation import EventValidator
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Grave


@pytest.fixture
def gate():
    return EventValidator(GateConfig(), known_ids={0, 1, 2})


def total(steps, config=None):
    """Composed wheel motion of all steps, and the sensor."""
    wheels = WheelMotion(config or WheelsConfig())
    pose = np.zeros(3)
    for step in steps:
        measured = wheels.measure(step)
        if measured is not None:
            pose = se2.compose(pose, measured.motion)
    return pose, wheels


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_fault_01_nan_or_inf_pose_or_twist(gate, bad):
    assert gate.check(command(1.0, bad, 0.0)) is None
    assert gate.check(command(1.0, 0.0, bad)) is None
    assert gate.check(imu(1.0, bad)) is None
    assert gate.check(marker_pose(1.0, position=(bad, 0, 0))) is None
    assert gate.check(odometry(1.0, (bad, 0, 0), (bad, 0))) is None
    assert gate.rejections == {
        "command.non_finite": 2,
        "imu.non_finite": 1,
        "sightings.non_finite": 1,
        "odometry.pose_non_finite": 1,
        "odometry.twist_non_finite": 1,
    }
    # The state is unchanged: the robot that stands still is where it was, whatever else was sent.
    events = [odometry(t, twist=(bad, 0.0) if k % 5 == 3 else (0.0, 0.0)) for k, t in enumerate(times(2, 4, 20))]
    passed = [e for e in (gate.check(e) for e in events) if e is not None]
    pose, _ = total(run(stepper(), passed))
    assert np.array_equal(pose, np.zeros(3))


def test_fault_02_zero_covariance_is_the_default_said_once(gate):
    zero = np.zeros((6, 6))
    for k in range(5):
        event = gate.check(odometry(1.0 + k / 10, pose_cov=zero))
        assert not event.pose_cov.any()
        assert np.isfinite(event.position).all()
    [note] = gate.notes
    assert re.search(r"^/odom: pose\b.*\bzero\b", note)
    assert not gate.rejections


def test_fault_03_huge_covariance_is_unknown(gate):
    event = gate.check(odometry(1.0, pose_cov=np.eye(6) * 1e308, twist_cov=np.full((6, 6), 1e308)))
    assert not event.pose_cov.any()
    assert not event.twist_cov.any()
    assert len(gate.notes) == 2
    assert not gate.rejections


def test_fault_04_negative_variance(gate):
    cov = np.diag([0.1, 0.1, 0.1, 0.1, 0.1, -0.1])
    assert gate.check(marker_pose(1.0, cov=cov)) is None
    assert np.isnan(gate.check(odometry(1.0, pose_cov=cov)).position).all()
    assert gate.rejections == {"sightings.negative_variance": 1, "odometry.pose_negative_variance": 1}


def test_fault_05_indefinite_covariance(gate):
    cov = np.eye(6)
    cov[0, 1] = cov[1, 0] = 2.0
    assert gate.check(marker_pose(1.0, cov=cov)) is None
    assert np.isnan(gate.check(odometry(1.0, pose_cov=cov)).position).all()
    three = np.eye(6)  # each pair is possible, the three together are not
    for i, j, value in ((0, 1, 0.9), (0, 5, 0.9), (1, 5, -0.9)):
        three[i, j] = three[j, i] = value
    assert np.isnan(gate.check(odometry(1.1, twist_cov=three)).linear).all()
    assert gate.rejections == {
        "sightings.indefinite_cov": 1,
        "odometry.pose_indefinite_cov": 1,
        "odometry.twist_indefinite_cov": 1,
    }


def test_fault_06_asymmetric_covariance(gate):
    cov = np.eye(6)
    cov[0, 1], cov[1, 0] = 0.5, 0.500001
    event = gate.check(marker_pose(1.0, cov=cov))
    repaired = event.sightings[0].cov
    assert np.array_equal(repaired, repaired.T)
    assert repaired[0, 1] == pytest.approx(0.5000005)
    cov = cov.copy()
    cov[1, 0] = 0.4
    assert gate.check(marker_pose(1.1, cov=cov)) is None
    assert gate.rejections == {"sightings.asymmetric_cov": 1}


def test_fault_07_nan_covariance_is_the_default_said_once(gate):
    for k in range(3):
        event = gate.check(odometry(1.0 + k / 10, twist_cov=np.full((6, 6), np.nan)))
        assert not event.twist_cov.any()
    [note] = gate.notes
    assert re.search(r"^/odom: twist\b.*\bNaN\b", note)


def test_fault_08_zero_quaternion(gate):
    assert gate.check(marker_pose(1.0, quaternion=np.zeros(4))) is None
    assert np.isnan(gate.check(odometry(1.0, orientation=np.zeros(4))).orientation).all()
    assert gate.rejections == {"sightings.quaternion": 1, "odometry.pose_quaternion": 1}


def test_fault_09_unnormalised_quaternion(gate):
    event = gate.check(odometry(1.0, orientation=np.array([0.0, 0.0, 0.6, 0.83])))
    assert np.linalg.norm(event.orientation) == pytest.approx(1.0, abs=1e-12)
    assert gate.check(marker_pose(1.0, quaternion=np.array([0.0, 0.0, 1.0, 1.0]))) is None
    assert gate.rejections == {"sightings.quaternion": 1}


@pytest.mark.parametrize("bad", [1e256, -1e256, 125.0, -125.0])
def test_fault_10_absurd_magnitude(gate, bad):
    event = gate.check(odometry(1.0, twist=(0.1, bad)))
    assert np.isnan(event.angular).all()
    assert gate.check(command(1.0, 0.0, bad)) is None
    assert gate.check(imu(1.0, bad)) is None
    assert sum(gate.rejections.values()) == 3
    far = gate.check(odometry(1.1, (bad * 1e5, 0, 0)))
    assert np.isnan(far.position).all()


def test_fault_10_spikes_of_the_twist_are_bridged_by_the_pose(gate):
    events = []
    for k, t in enumerate(times(1, 11, 20)):
        yaw = 0.5 * (t - 1)
        omega = 125.0 if k % 7 == 5 else 0.5  # as TurtleBot3's, where the yaw wraps
        events.append(odometry(t, (np.sin(yaw) * 0.4, (1 - np.cos(yaw)) * 0.4, yaw), (0.2, omega)))
    steps = run(stepper(), [gate.check(e) for e in events])
    pose, _ = total(steps, WheelsConfig(source="twist"))
    seconds = (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9
    assert pose[2] == pytest.approx(se2.wrap(0.5 * seconds), abs=1e-6)
    assert gate.rejections["odometry.twist_yaw_rate_bound"] > 20


def test_fault_11_duplicate_stamp(gate):
    events = [e for t in times(1, 3, 20) for e in (odometry(t, twist=(1, 0)), odometry(t, twist=(1, 0)))]
    passed = [e for e in (gate.check(e) for e in events) if e is not None]
    assert gate.rejections == {"odometry.duplicate_stamp": 40}
    assert len(passed) == 40
    # Without a gate before it the stepper drops them too: no division by dt = 0.
    target = stepper()
    steps = run(target, [*events, corners(2.95), corners(2.95)])
    check_steps(steps)
    assert target.rejections == {"odometry.duplicate": 40, "sightings.duplicate": 1}
    pose, _ = total(steps)
    assert pose[0] == pytest.approx((steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, abs=1e-9)


def test_fault_12_negative_dt_is_reordered():
    stamps = list(times(1, 6, 20))
    in_order = [odometry(t, twist=(np.sin(t), 0)) for t in stamps]
    swapped = in_order.copy()
    for k in range(4, len(swapped) - 4, 10):
        swapped[k], swapped[k + 1] = swapped[k + 1], swapped[k]
    target = stepper(reorder_s=0.2)
    steps = run(target, swapped)
    check_steps(steps)
    expected, _ = total(run(stepper(reorder_s=0.2), in_order), WheelsConfig(source="twist"))
    pose, _ = total(steps, WheelsConfig(source="twist"))
    assert sum(target.rejections.values()) <= 1  # the first step back may come as a surprise
    assert pose == pytest.approx(expected, abs=5e-3)


def test_fault_12_negative_dt_beyond_the_buffer_is_dropped():
    target = stepper()
    events = [odometry(t) for t in times(1, 3, 20)]
    events.insert(30, odometry(1.512))
    steps = run(target, events)
    check_steps(steps)
    assert target.rejections == {"odometry.late": 1}


@pytest.mark.parametrize("late_s", [0.15, 0.8, 3.0, 9.0])
def test_fault_13_late_sighting_inside_the_lag_keeps_its_time(late_s):
    odometries = [odometry(t) for t in times(1, 15, 20)]
    steps = run(stepper(), in_order_of_receipt(odometries, [corners(3.33, received=3.33 + late_s)]))
    check_steps(steps)
    found = [(step.stamp_ns, e.stamp_ns) for step in steps for e in step.sightings]
    assert len(found) == 1
    assert found[0][1] == ns(3.33)
    assert found[0][0] <= ns(3.33 + late_s + 0.4)


def test_fault_14_late_beyond_the_lag_is_dropped():
    target = stepper(lag_s=2.0)
    odometries = [odometry(t) for t in times(1, 10, 20)]
    steps = run(target, in_order_of_receipt(odometries, [corners(3.33, received=5.5)]))
    assert not any(step.sightings for step in steps)
    assert target.rejections == {"sightings.late": 1}


def test_fault_15_a_bag_that_loops_begins_a_segment(gate):
    once = in_order_of_receipt([odometry(t) for t in times(1, 6, 20)], [corners(t) for t in times(1.02, 6, 5)])
    events = [e for e in (gate.check(e) for e in once * 3) if e is not None]
    target = stepper()
    steps = run(target, events)
    check_steps(steps)
    assert [step.segment for step in steps] == sorted(step.segment for step in steps)
    assert steps[-1].segment == 2
    assert sum("jumped back" in note for note in target.notes) == 2
    per_segment = [sum(len(s.sightings) for s in steps if s.segment == k) for k in range(3)]
    assert per_segment == [25, 25, 25]
    assert gate.rejections.total() + target.rejections.total() <= 4


def test_fault_16_clock_jumps_ahead(gate):
    events = [odometry(t) for t in [*times(1, 5, 20), *times(1005, 1010, 20)]]
    target = stepper()
    steps = run(target, [gate.check(e) for e in events])
    check_steps(steps)
    assert {step.segment for step in steps} == {0, 1}
    assert any(" 1000" in note for note in target.notes)
    assert steps[-1].stamp_ns == ns(1009.95)
    assert not target.rejections


def test_fault_17_stamp_zero_names_the_topic(gate):
    for _ in range(3):
        assert gate.check(range_bearing(0.0, topic="/front/landmarks")) is None
    assert gate.rejections == {"sightings.stamp_zero": 3}
    assert len(gate.notes) == 1
    assert "/front/landmarks" in gate.notes[0]


@pytest.mark.parametrize("ahead_s", [3.0, 30.0, 3600.0, 3e8])
def test_fault_18_stray_stamps_in_the_future(ahead_s):
    odometries = [odometry(t, twist=(1.0, 0.0)) for t in times(1, 10, 20)]
    strays = [odometry(t + ahead_s, received=t) for t in (2.0, 2.01, 4.0, 8.0)]
    target = stepper()
    steps = []
    for event in in_order_of_receipt(odometries, strays):
        steps += target.push(event)
        if steps:  # no freeze: the newest keyframe follows the clock
            assert steps[-1].stamp_ns > event.received_ns - ns(0.5)
    steps += target.flush()
    check_steps(steps)
    assert {step.segment for step in steps} == {0}
    assert steps[-1].stamp_ns == ns(9.95)
    assert target.rejections == {"odometry.future": 4}


def test_fault_18_a_sensor_that_lives_in_the_future():
    odometries = [odometry(t, received=t) for t in times(1, 60, 20)]
    tags = [corners(t + 3600, received=t) for t in times(1.01, 60, 30)]
    target = stepper()
    steps = run(target, in_order_of_receipt(odometries, tags))
    check_steps(steps)
    assert {step.segment for step in steps} == {0}
    assert target.rejections["sightings.future"] == len(tags)
    assert any("/tags" in note and "stamp_offset_s" in note for note in target.notes)


def test_a_stray_stamp_is_in_the_future_even_where_messages_are_rare():
    """Four usual intervals ahead are 0.8 s here; 50 ms of them have passed."""
    odometries = [odometry(t, twist=(1.0, 0.0), received=t) for t in times(1, 10, 5)]
    target = stepper()
    check_steps(run(target, in_order_of_receipt(odometries, [odometry(6.1 + 0.55, received=6.1)])))
    assert target.rejections == {"odometry.future": 1}


def test_odometry_of_another_frame_is_rejected_until_its_publisher_is_another_one(gate):
    of_another = [replace(odometry(1.05 + 0.1 * k, (0, 0, 0), (0, 0)), frame_id=f"odd{k % 2}") for k in range(40)]
    own = [odometry(1.0 + 0.1 * k, (0.1 * k, 0, 0), (1.0, 0)) for k in range(40)]
    for mine, other in zip(own, of_another, strict=True):
        assert gate.check(mine) is mine
        assert gate.check(other) is None
    assert gate.rejections == {"odometry.frame": 40}
    renamed = [replace(odometry(6.0 + 0.1 * k, (0, 0, 0), (0, 0)), frame_id="odom2") for k in range(30)]
    assert [gate.check(event) is event for event in renamed] == 20 * [False] + 10 * [True]


def test_fault_21_gap_of_all_sensors(gate):
    stamps = [*times(1, 5, 20), *times(55, 60, 20)]
    events = in_order_of_receipt([odometry(t, twist=(0.3, 0.0)) for t in stamps], [corners(t + 0.01) for t in stamps])
    target = stepper()
    steps = run(target, [gate.check(e) for e in events])
    check_steps(steps)
    assert {step.segment for step in steps} == {0}
    wheels = WheelMotion(WheelsConfig(source="twist"))
    xs = [(step.stamp_ns, m.cov[0, 0]) for step in steps if (m := wheels.measure(step)) is not None]
    before = sum(x for t, x in xs if t < ns(5))
    within = sum(x for t, x in xs if ns(5) < t < ns(55))
    assert within > 100 * before  # the covariance grows with the time that nothing is known
    assert wheels.rejections["wheels.silence"] >= 40
    assert any(re.search(r"\bwheel\b.* \d+\.\d s .*\d+ steps", note) for note in wheels.notes)
    assert steps[-1].sightings  # and the robot can be found again


def test_fault_23_jittered_updates_never_lock_up():
    rng = np.random.default_rng(23)
    for _ in range(20):
        odometries = [odometry(t, received=t + rng.exponential(0.03)) for t in times(1, 20, 20)]
        tags = [corners(t, received=t + rng.exponential(0.1)) for t in times(1, 20, 7)]
        target = stepper()
        steps = []
        for event in in_order_of_receipt(odometries, tags):
            steps += target.push(event)
            if event.received_ns > ns(2):
                assert steps[-1].stamp_ns > event.received_ns - ns(1.5)
        steps += target.flush()
        check_steps(steps)
        handed = [e.stamp_ns for step in steps for e in step.sightings]
        assert len(handed) + target.rejections["sightings.late"] == len(tags)
        assert len(handed) == len(set(handed))
        assert target.rejections["sightings.late"] <= 1  # one may precede the first keyframe


@pytest.mark.parametrize("rates", [(6.0, 5.0), (-6.0, -5.0), (4.0, -4.0)])
def test_fault_25_encoder_rollover_both_ways(rates):
    geometry = dict(source="ticks", left_radius=0.05, right_radius=0.05, track=0.3)
    stamps = times(1, 11, 20)
    whole = [joints(t, rates[0] * t, rates[1] * t) for t in stamps]
    rolled = [joints(t, np.mod(rates[0] * t, 2 * np.pi), np.mod(rates[1] * t, 2 * np.pi)) for t in stamps]
    expected, _ = total(run(stepper(), whole), WheelsConfig(**geometry))
    pose, wheels = total(run(stepper(), rolled), WheelsConfig(**geometry, angle_range=2 * np.pi))
    assert np.hypot(*expected[:2]) > 0.1 or abs(expected[2]) > 0.1
    assert pose == pytest.approx(expected, abs=1e-9)
    assert not wheels.rejections


def test_fault_25_rollover_without_its_range_is_said():
    geometry = dict(source="ticks", left_radius=0.05, right_radius=0.05, track=0.3)
    rolled = [joints(t, np.mod(6 * t, 2 * np.pi), np.mod(6 * t, 2 * np.pi)) for t in times(1, 11, 50)]
    steps = run(stepper(), rolled)
    pose, wheels = total(steps, WheelsConfig(**geometry))
    assert wheels.rejections["wheels.encoder_reset"] == 10  # from 0.95 turns to 10.5
    assert any("wheels.angle_range" in note for note in wheels.notes)
    assert pose[0] == pytest.approx(0.3 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, rel=1e-6)  # held over it


@pytest.mark.parametrize("source", ["auto", "pose", "twist"])
def test_fault_26_odometry_reset_to_zero_is_rebased(source):
    events = []
    for t in times(1, 9, 20):
        since = t - 1 if t < 5 else t - 5
        events.append(odometry(t, (0.5 * since, 0, 0), (0.5, 0)))
    steps = run(stepper(), events)
    pose, wheels = total(steps, WheelsConfig(source=source))
    assert pose == pytest.approx([0.5 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, 0, 0], abs=1e-9)
    assert wheels.rejections == {"wheels.pose_reset": 1}
    assert any("reset" in note for note in wheels.notes)


def test_fault_27_huge_first_value_counts_only_by_differences(gate):
    events = [odometry(t, (4e5 + 0.5 * t, -3e5, 0.0), (0.5, 0)) for t in times(1, 5, 20)]
    steps = run(stepper(), [gate.check(e) for e in events])
    pose, _ = total(steps, WheelsConfig(source="pose"))
    assert pose == pytest.approx([0.5 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, 0, 0], abs=1e-6)


def test_fault_28_twist_always_zero_while_the_pose_moves():
    events = [odometry(t, (0.4 * np.sin(t), 0.4 * (1 - np.cos(t)), t)) for t in times(0.05, 5, 20)]
    steps = run(stepper(), events)
    pose, wheels = total(steps)
    first, last = steps[0].stamp_ns * 1e-9, steps[-1].stamp_ns * 1e-9
    assert pose[2] == pytest.approx(se2.wrap(last - first), abs=1e-6)  # nothing is lost before that was found out
    assert not wheels.by_twist
    assert any(re.search(r"\btwist\b.*\bzero\b", note) for note in wheels.notes)
    _, insisting = total(steps, WheelsConfig(source="twist"))
    assert any("wheels.source" in note for note in insisting.notes)


def test_fault_29_residual_velocity_at_rest():
    events = [odometry(t, twist=(0.003, -0.004)) for t in times(1, 60, 20)]
    steps = run(stepper(), events)
    pose, _ = total(steps, WheelsConfig(source="twist", zero_speed=0.005, zero_yaw_rate=0.005))
    assert np.array_equal(pose, np.zeros(3))
    drifted, _ = total(steps, WheelsConfig(source="twist"))
    assert abs(drifted[2]) > 0.2


def test_fault_30_dt_too_small_is_merged():
    odometries = [odometry(t) for t in times(1, 5, 20)]
    tags = [corners(t + d, topic=f"/tags{k}") for t in times(1.5, 5, 4) for k, d in enumerate((0, 1e-4, 3e-3, 0.04))]
    target = stepper()
    steps = run(target, in_order_of_receipt(odometries, tags))
    check_steps(steps)
    assert sum(len(step.sightings) for step in steps) == len(tags)
    assert not target.rejections


def test_fault_32_bearings_in_degrees(gate):
    rng = np.random.default_rng(32)
    passed = 0
    for k in range(200):
        event = gate.check(range_bearing(1 + k / 10, (0, 2.0, rng.uniform(-60, 60))))
        passed += event is not None
    assert passed < 5
    assert any("degrees" in note for note in gate.notes)


def test_fault_32_one_wild_bearing_does_not_silence_the_sensor(gate):
    for k in range(50):
        gate.check(range_bearing(1 + k / 10, (0, 2.0, 57.0 if k % 17 == 3 else 0.5)))
    assert gate.rejections == {"sightings.bearing_bound": 3}


def test_fault_32_yaw_rate_in_degrees(gate):
    events = [odometry(t, (0, 0, 0.1 * t), (0, np.degrees(0.1))) for t in times(1, 9, 20)]
    steps = run(stepper(), [gate.check(e) for e in events])
    pose, wheels = total(steps)
    assert pose[2] == pytest.approx(0.1 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, abs=1e-6)
    assert any("degrees" in note for note in wheels.notes)
    with pytest.raises(ConfigError, match=r"0\.017453"):
        total(steps, WheelsConfig(source="twist"))


def test_fault_32_most_yaw_rates_beyond_the_bound_suggest_degrees(gate):
    for k in range(40):
        gate.check(command(1 + k / 10, 0.2, 30.0 if k % 2 else 0.0))
    assert any("degrees" in note and isinstance(note, Grave) for note in gate.notes)


def test_fault_50_id_not_in_the_map(gate):
    assert gate.check(corners(0.5, 17)) is None
    assert isinstance(gate.notes[-1], Grave)  # none is: it may be another map
    event = gate.check(corners(1.0, 2, 17, 1))
    assert [s.landmark_id for s in event.sightings] == [2, 1]
    assert gate.check(range_bearing(1.0, (99, 1.0, 0.0))) is None
    assert gate.rejections == {"sightings.unknown_id": 3}
    assert any(": 17, 99 (it has " in note for note in gate.notes)
    free = EventValidator(GateConfig())  # no map: every id may turn out to be a landmark
    assert free.check(corners(1.0, 17)) is not None


def test_fault_54_id_zero_works_like_any_other(gate):
    for event in (corners(1.0, 0), range_bearing(1.0, (0, 1.0, 0.0)), marker_pose(1.0, 0)):
        assert gate.check(event) is event
    without = EventValidator(GateConfig(), known_ids={1})
    assert without.check(corners(1.0, 0)) is None


@pytest.mark.parametrize(
    ("at", "reason"),
    [
        (np.full((4, 2), np.nan), "non_finite"),
        (SQUARE * 1e300, "non_finite"),
        (np.zeros((4, 2)), "corners_degenerate"),
        (SQUARE[[0, 1, 1, 3]], "corners_degenerate"),
        (SQUARE[[0, 2, 1, 3]], "corners_degenerate"),  # crossed
        (np.outer(np.arange(4.0), [30, 40]), "corners_degenerate"),  # on a line
        (np.array([[100.0, 100], [200, 100], [120, 120], [100, 200]]), "corners_degenerate"),  # dented
        (SQUARE[:3], "corners_degenerate"),
        (SQUARE * 0.1, "corners_small"),
    ],
)
def test_fault_56_degenerate_or_nan_corners(gate, at, reason):
    assert gate.check(corners(1.0, 0, at=at)) is None
    assert gate.rejections == {f"sightings.{reason}": 1}


def test_fault_58_empty_image(gate):
    assert gate.check(image(1.0, b"")) is None
    assert gate.check(image(1.1, b"", compressed=False, width=640, height=480, step=640)) is None
    assert gate.check(image(1.2, bytes(100), compressed=False, width=640, height=480, step=640)) is None
    assert gate.rejections == {"image.empty": 2, "image.truncated": 1}
