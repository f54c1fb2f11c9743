"""A robot that is picked up: the failure that does it to a recording, and how it is told."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from event_makers import image
from pydantic import ValidationError
from robot_world import START_NS, Chain, World, config, room
from test_ablation_failures import apply, driving, make, of

from fgloc.ablation.failures import corrupt
from fgloc.estimation.faults import LiftMonitor
from fgloc.sensors.failures import Scene
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Mode, MotionMeasurement, MotionReadings, Step, by_class

IN_THE_AIR = {"intervals": [(1.95, 5.95)]}
DT_NS = 200_000_000


# --- the failure ---


def test_lifted_wheels_stand_and_go_on_from_there_while_the_clock_runs():
    before = driving()
    after = apply("lift", before, when=IN_THE_AIR, markers="shown")
    assert [e.stamp_ns for e in after] == [e.stamp_ns for e in before]
    angles = {round(e.stamp_ns * 1e-9, 1): e for e in of(JointsEvent, after)}
    assert angles[5.9].position == pytest.approx(angles[1.9].position)
    assert not angles[3.0].velocity.any()
    exact = {round(e.stamp_ns * 1e-9, 1): e for e in of(JointsEvent, before)}
    assert angles[8.0].position - angles[6.0].position == pytest.approx(exact[8.0].position - exact[6.0].position)
    still = [e for e in of(OdometryEvent, after) if 2.0 < e.stamp_ns * 1e-9 < 5.9]
    assert all(np.allclose(a.position, b.position) and not b.linear.any() for a, b in pairwise(still))
    assert all(e.v == e.omega == 0.0 for e in of(ControlEvent, after) if 2.0 < e.stamp_ns * 1e-9 < 5.9)


def test_the_accelerometer_shows_a_rise_and_a_descent_of_the_height():
    before = [e for e in driving() if isinstance(e, ImuEvent)]
    dense = [replace(before[0], stamp_ns=10_000_000 * k, received_ns=10_000_000 * k) for k in range(1000)]
    after = apply("lift", dense, when={"intervals": [(2.0, 8.0)]}, height_m=0.4)
    vertical = np.array([np.linalg.norm(e.linear_acceleration) for e in after]) - 9.81
    speed = 0.01 * np.cumsum(vertical)
    assert 0.01 * speed[:300].sum() == pytest.approx(0.4, abs=0.12)  # with the bounce of the one who walks
    assert abs(speed[-1]) < 0.2
    assert np.ptp([e.angular_velocity[0] for e in after]) > 0.05


def test_lifted_markers_are_hidden_or_shown_and_lifts_are_bounded():
    images = [image(0.1 * k) for k in range(80)]
    assert len(apply("lift", images, when=IN_THE_AIR)) == 40
    assert len(apply("lift", images, when=IN_THE_AIR, markers="shown")) == 80
    with pytest.raises(ValidationError, match=r"\blift\b.*'when'"):
        make("lift", when={"after_s": 1.0})


# --- how it is told ---


def step(k, force, omega=0.0, command=None):
    end = START_NS + (k + 1) * DT_NS
    stamps = [end - DT_NS + 10_000_000 * (i + 1) for i in range(20)]
    forces = np.broadcast_to(force, 20)
    imu = tuple(
        ImuEvent(t, t, "/imu", "imu", np.array([0.0, 0.0, omega]), np.array([0.0, 0.0, f]), np.zeros((3, 3)))
        for t, f in zip(stamps, forces, strict=True)
    )
    commands = () if command is None else (ControlEvent(end - DT_NS, end - DT_NS, "/cmd_vel", command, 0.0),)
    return Step(k, 0, end - DT_NS, end, by_class((*commands, *imu)))


def readings(s, forward=0.0, turn=0.0):
    def measured(source, yaw, sigma):
        return MotionMeasurement(source, s.start_ns, s.stamp_ns, np.array([forward, 0.0, yaw]), np.eye(3) * sigma**2)

    return MotionReadings(measured("wheels", 0.0, 1e-4), None, measured("gyro", turn, 1e-3))


def alarms(monitor, steps):
    return [[d.reason for d in monitor.observe(s.index, s, r)] for s, r in steps]


def test_no_alarm_of_a_shaken_robot():
    rng = np.random.default_rng(3)
    monitor, told = LiftMonitor(10.0), []
    for k in range(3000):  # 10 minutes with the noise of a floor
        s = step(k, 9.78 + rng.normal(0.0, 0.4, 20), command=0.3)
        told += monitor.observe(k, s, readings(s, forward=0.06))
    assert told == []


def test_a_rise_is_told_within_half_a_second_and_ends_with_a_fix():
    rng, monitor = np.random.default_rng(5), LiftMonitor(10.0)
    calm = [step(k, 9.78 + rng.normal(0.0, 0.4, 20)) for k in range(100)]
    assert not any(alarms(monitor, [(s, readings(s)) for s in calm]))
    rising = [step(100, 10.6 + rng.normal(0.0, 0.4, 20)), step(101, 10.9 + rng.normal(0.0, 0.4, 20))]
    assert "vertical_velocity" in alarms(monitor, [(s, readings(s)) for s in rising])[-1]
    assert monitor.carried
    since_s = [monitor.carried_s(rising[-1]) for _ in range(2)]
    assert since_s[1] > since_s[0] > 0.1
    monitor.fix()
    assert monitor.carried  # still in the hands
    later = [step(k, 9.78 + rng.normal(0.0, 0.4, 20)) for k in range(102, 125)]
    alarms(monitor, [(s, readings(s)) for s in later])
    monitor.fix()
    assert not monitor.carried


@pytest.mark.parametrize(("command", "told"), [(0.0, True), (0.3, False), (None, False)])
def test_a_turn_at_rest_is_a_push_only_where_the_robot_was_told_to_stand(command, told):
    monitor = LiftMonitor(10.0)
    steps = [step(k, 9.78, omega=0.3, command=command) for k in range(20)]
    found = alarms(monitor, [(s, readings(s, turn=0.06)) for s in steps])
    assert any("turned_at_rest" in reasons for reasons in found) == told


def test_an_imu_without_accelerometer_and_one_that_fails_tell_nothing():
    monitor = LiftMonitor(10.0)
    steps = [step(k, 0.0 if k < 30 else math.nan) for k in range(60)]
    assert not any(alarms(monitor, [(s, readings(s)) for s in steps]))


class Carried(World):
    """The world with an IMU, the robot being told to drive on."""

    def events(self):
        made = super().events()
        for tick in range(round(self.seconds * 100)):
            stamp = self.start_ns + tick * 10_000_000
            rate = np.array([0.0, 0.0, 0.33 + self._rng.normal(0.0, 0.02)])
            force = np.array([0.0, 0.0, 9.81]) + self._rng.normal(0.0, 0.2, 3)
            made.append(ImuEvent(stamp, stamp, "/imu", "imu", rate, force, np.zeros((3, 3))))
        return sorted(made, key=lambda e: e.received_ns)


def test_a_lifted_robot_says_that_it_may_be_elsewhere_until_it_sees_a_marker():
    world = Carried(room(), seed=2, seconds=16.0)
    settings = config()
    lift = make("lift", when={"intervals": [(8.0, 11.0)]})
    scene = Scene(START_NS, 16.0, settings, (), np.random.default_rng(1))
    events = list(corrupt([lift], "recorded", iter(world.events()), [scene]))
    estimates = Chain(settings, room()).run(events)
    seconds = [(e.stamp_ns - START_NS) * 1e-9 for e in estimates]
    carried = [e for e, t in zip(estimates, seconds, strict=True) if 8.8 < t < 10.9]
    for e in carried:
        error = e.pose[:2] - world.truth(e.stamp_ns)[:2]
        assert error @ np.linalg.solve(e.cov[:2, :2], error) < 14.0
        assert e.mode is not Mode.OK
    assert math.sqrt(carried[-1].cov[0, 0]) > 1.0
    assert any(d.kind == "lift" for e in carried for d in e.decisions)
    found = next(e for e in estimates if any(d.reason == "jump" for d in e.decisions))
    assert found.mode is Mode.OK
    assert estimates[-1].mode is Mode.OK
    assert np.hypot(*(estimates[-1].pose - world.truth(estimates[-1].stamp_ns))[:2]) < 0.05


@pytest.mark.parametrize(("forward", "told"), [(0.0, True), (0.06, False)])
def test_a_robot_that_stands_and_tilts_is_in_somebodys_hands(forward, told):
    """By 0.16 rad within a second; one that drives may be on a ramp."""
    rng, monitor = np.random.default_rng(6), LiftMonitor(10.0, np.array([0.0, 0.0, 1.0]))
    steps = [step(k, 9.78 + rng.normal(0.0, 0.1, 20)) for k in range(25)]
    rate = np.array([0.2, 0.0, 0.0])
    level, tilts = (
        steps[:20],
        [replace(s, motion=by_class(replace(e, angular_velocity=rate) for e in s.inertial)) for s in steps[20:]],
    )
    assert not any(alarms(monitor, [(s, readings(s, forward)) for s in level]))
    found = alarms(monitor, [(s, readings(s, forward)) for s in tilts])
    assert any("tilted_at_rest" in reasons for reasons in found) == told


def test_one_sample_after_a_silence_is_no_lift():
    """One message does not hold what the IMU measured within a second."""
    rng, monitor = np.random.default_rng(7), LiftMonitor(10.0, np.array([0.0, 0.0, 1.0]))
    calm = [step(k, 9.78 + rng.normal(0.0, 0.1, 20)) for k in range(100)]
    assert not any(alarms(monitor, [(s, readings(s)) for s in calm]))
    last = step(103, 10.9)
    one = replace(last.inertial[-1], angular_velocity=np.array([0.5, 0.0, 0.0]))
    sparse = replace(last, start_ns=calm[-1].stamp_ns, motion=by_class([one]))
    assert alarms(monitor, [(sparse, readings(sparse))]) == [[]]
    assert not monitor.carried
