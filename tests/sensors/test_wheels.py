"""Wheel motion: exact integration, honest covariance, every source."""

import itertools
import math
import re

import numpy as np
import pytest
from event_makers import command, corners, in_order_of_receipt, joints, ns, odometry, range_bearing, run, stepper, times

from fgloc import se2
from fgloc.config import GateConfig, KeyframesConfig, NoiseDensity, WheelsConfig
from fgloc.errors import ConfigError
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.sensors.wheels.tracks import TwistTimeline

GEOMETRY = dict(left_radius=0.05, right_radius=0.06, track=0.3)


class Drive:
    """A smooth drive with its exact path, from t = 0."""

    def __init__(self, seconds=20.0, dt=1e-3):
        self.t = np.arange(0.0, seconds + dt, dt)
        poses = [np.zeros(3)]
        for t in self.t[:-1]:
            v, w = self.twist(t + 0.5 * dt)
            poses.append(se2.compose(poses[-1], se2.exp((v * dt, 0.0, w * dt))))
        self.poses = np.array(poses)
        self.stamps = np.array([ns(t) for t in self.t])

    @staticmethod
    def twist(t):
        return 0.4 + 0.3 * math.sin(0.7 * t), 0.8 * math.sin(0.5 * t + 1.0)

    def pose(self, t):
        return se2.interpolate(self.stamps, self.poses, np.array([ns(t)]))[0]

    def motion(self, start_ns, end_ns):
        a, b = se2.interpolate(self.stamps, self.poses, np.array([start_ns, end_ns]))
        return se2.between(a, b)

    def wheel_angles(self, rate):
        """Angles of both wheels at these times, from their speeds."""
        v, w = np.array([self.twist(t) for t in self.t]).T
        left = np.concatenate([[0], np.cumsum((v - 0.15 * w)[:-1] * np.diff(self.t))]) / GEOMETRY["left_radius"]
        right = np.concatenate([[0], np.cumsum((v + 0.15 * w)[:-1] * np.diff(self.t))]) / GEOMETRY["right_radius"]
        stride = round(1000 / rate)
        return zip(self.t[::stride], left[::stride], right[::stride], strict=True)


@pytest.fixture(scope="module")
def drive():
    return Drive()


def total(steps, config):
    wheels = WheelMotion(config)
    pose, cov = np.zeros(3), np.zeros((3, 3))
    for step in steps:
        measured = wheels.measure(step)
        if measured is not None:
            assert measured.source == "wheels"
            assert (measured.start_ns, measured.stamp_ns) == (step.start_ns, step.stamp_ns)
            cov = se2.compose_cov(cov, measured.motion, measured.cov)
            pose = se2.compose(pose, measured.motion)
    return pose, cov, wheels


def timeline(vx, vy, w, seconds=1.0, pieces=20):
    made = TwistTimeline()
    made.begin(0)
    for k in range(pieces):
        made.extend(ns(seconds * (k + 1) / pieces), (vx, vy, w))
    return made


# --- integration and covariance ---


@pytest.mark.parametrize(
    "twist", [(0.5, 0.0, 0.0), (0.5, 0.0, 0.8), (0.0, 0.0, 2.0), (-0.3, 0.0, -4.0), (0.3, 0.2, 0.5), (0.0, 0.0, 0.0)]
)
@pytest.mark.parametrize("cuts", [20, 7])
def test_covariance_does_not_depend_on_the_cadence(twist, cuts):
    """One second as one step, and as many: straight, arc, spin, backwards, sideways, at rest."""
    noise = NoiseDensity(xy_per_sqrt_s=0.01, yaw_per_sqrt_s=0.02)
    whole = timeline(*twist)
    motion, cov, unknown = whole.integrate(0, ns(1.0), noise)
    assert unknown == 0.0
    assert motion == pytest.approx(se2.exp(twist), abs=1e-12)
    pose, split = np.zeros(3), np.zeros((3, 3))
    limits = [ns(k / cuts) for k in range(cuts)] + [ns(1.0)]
    for start, end in itertools.pairwise(limits):
        part, part_cov, _ = whole.integrate(start, end, noise)
        split = se2.compose_cov(split, part, part_cov)
        pose = se2.compose(pose, part)
    assert pose == pytest.approx(motion, abs=1e-9)
    scale = np.sqrt(np.outer(cov.diagonal(), cov.diagonal()))
    assert np.abs(split - cov).max() / scale.max() < 1e-4
    assert np.all(np.abs(split - cov) <= 0.01 * scale)
    assert np.linalg.eigvalsh(cov)[0] > 0.0


def test_covariance_does_not_depend_on_the_rate_of_messages():
    noise = NoiseDensity()
    covs = [timeline(0.5, 0.0, 1.5, pieces=pieces).integrate(0, ns(1.0), noise)[1] for pieces in (1, 5, 200)]
    assert covs[1] == pytest.approx(covs[0], rel=1e-4, abs=1e-8)
    assert covs[2] == pytest.approx(covs[0], rel=1e-4, abs=1e-8)


def test_covariance_is_that_of_simulated_noise():
    """White noise of the given densities in a fine simulation spreads as predicted."""
    rng = np.random.default_rng(5)
    noise = NoiseDensity()
    v, w, seconds, n, runs = 0.6, 0.9, 2.0, 400, 20_000
    h = seconds / n
    sigmas = np.sqrt(
        h
        * np.array(
            [
                noise.x_per_sqrt_m**2 * v + noise.xy_per_sqrt_rad**2 * w + noise.xy_per_sqrt_s**2,
                noise.y_per_sqrt_m**2 * v + noise.xy_per_sqrt_rad**2 * w + noise.xy_per_sqrt_s**2,
                noise.yaw_per_sqrt_m**2 * v + noise.yaw_per_sqrt_rad**2 * w + noise.yaw_per_sqrt_s**2,
            ]
        )
    )
    x, y, yaw = np.zeros(runs), np.zeros(runs), np.zeros(runs)
    for _ in range(n):
        dx, dy, dyaw = rng.normal(size=(3, runs)) * sigmas[:, None]
        dx += v * h
        middle = yaw + 0.5 * w * h
        x += np.cos(middle) * dx - np.sin(middle) * dy
        y += np.sin(middle) * dx + np.cos(middle) * dy
        yaw += w * h + dyaw
    motion, cov, _ = timeline(v, 0.0, w, seconds).integrate(0, ns(seconds), noise)
    errors = np.array([se2.log(se2.between(motion, pose)) for pose in zip(x, y, yaw, strict=True)])
    sampled = np.cov(errors.T)
    scale = np.sqrt(np.outer(cov.diagonal(), cov.diagonal()))
    assert np.abs(sampled - cov).max() < 0.03 * scale.max()
    assert np.all(np.abs(sampled - cov) < 0.05 * scale)


def test_noise_along_is_xx_and_across_is_yy():
    none = dict.fromkeys(NoiseDensity.model_fields, 0.0)
    noise = NoiseDensity(**(none | dict(x_per_sqrt_m=0.1, y_per_sqrt_m=0.01)))
    _, cov, _ = timeline(2.0, 0.0, 0.0).integrate(0, ns(1.0), noise)
    assert cov[0, 0] == pytest.approx(0.1**2 * 2.0)
    assert cov[1, 1] == pytest.approx(0.01**2 * 2.0)


def test_covariance_without_any_noise_is_still_positive_definite():
    nothing = NoiseDensity(**dict.fromkeys(NoiseDensity.model_fields, 0.0))
    _, cov, _ = timeline(0.5, 0.0, 0.5).integrate(0, ns(1.0), nothing)
    assert np.linalg.eigvalsh(cov)[0] > 0.0


def test_silence_grows_alike_however_it_is_cut():
    made = timeline(0.5, 0.0, 0.0)
    noise = NoiseDensity()
    _, whole, unknown = made.integrate(ns(1.0), ns(21.0), noise)
    parts = sum(made.integrate(ns(1.0 + k), ns(2.0 + k), noise)[1] for k in range(20))
    assert unknown == pytest.approx(20.0)
    assert parts == pytest.approx(whole, rel=1e-9, abs=1e-9)
    assert 1.0 < math.sqrt(whole[0, 0]) < 10.0  # a robot of 0.5 m/s may be anywhere near


# --- sources ---


def test_twists_repeat_a_smooth_drive(drive):
    steps = run(stepper(), [odometry(t, twist=drive.twist(t)) for t in times(0.1, 18, 20)])
    pose, _, wheels = total(steps, WheelsConfig(source="twist"))
    expected = drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns)
    assert pose == pytest.approx(expected, abs=2e-3)
    assert not wheels.rejections


def test_poses_repeat_a_drive_exactly(drive):
    steps = run(
        stepper(),
        in_order_of_receipt(
            [odometry(t, drive.pose(t)) for t in times(0.1, 18, 20)], [corners(t) for t in times(0.113, 18, 7)]
        ),
    )
    pose, _, _ = total(steps, WheelsConfig(source="pose"))
    expected = drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns)
    assert pose == pytest.approx(expected, abs=1e-3)


def test_wheel_angles_repeat_a_drive(drive):
    events = [joints(t, left, right) for t, left, right in drive.wheel_angles(50) if 0.1 <= t < 18]
    steps = run(stepper(), events)
    for config in (WheelsConfig(source="ticks", **GEOMETRY), WheelsConfig(**GEOMETRY)):
        pose, _, wheels = total(steps, config)
        assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=5e-3)
        assert not wheels.rejections


def test_wheel_rates_stand_in_for_angles(drive):
    def rates(t):
        v, w = drive.twist(t)
        return (v - 0.15 * w) / GEOMETRY["left_radius"], (v + 0.15 * w) / GEOMETRY["right_radius"]

    steps = run(stepper(), [joints(t, None, None, rates=rates(t)) for t in times(0.1, 18, 50)])
    pose, _, _ = total(steps, WheelsConfig(source="ticks", **GEOMETRY))
    assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=2e-3)


def test_commands_hold_until_the_next_over_gaps():
    stamps = [*times(1, 3, 10), 3.4, *times(3.8, 6, 10)]
    events = [command(t, 0.5 if t < 3 else 0.2, 0.0) for t in stamps]
    steps = run(stepper(), events)
    pose, _, wheels = total(steps, WheelsConfig(source="command", hold_s=0.6))
    end = steps[-1].stamp_ns * 1e-9
    held = 3.4  # the last command of 0.5 m/s was given at 2.9 and holds until 3.4
    assert pose[0] == pytest.approx(0.5 * (held - 1.0) + 0.2 * (end - held), abs=1e-9)
    assert not wheels.rejections


def test_the_delay_shifts_commands():
    events = [command(t, 1.0 if t >= 2.0 else 0.0) for t in times(1, 4, 20)]
    steps = run(stepper(), events)
    end = steps[-1].stamp_ns * 1e-9
    for delay in (0.0, 0.12, 0.7):
        pose, _, _ = total(steps, WheelsConfig(source="command", delay_s=delay))
        assert pose[0] == pytest.approx(end - 2.0 - delay, abs=1e-9)


def test_scales_and_veer():
    steps = run(stepper(), [command(t, 0.5, 0.2) for t in times(1, 3, 20)])
    config = WheelsConfig(source="command", scale_v=0.9, scale_omega=1.2, yaw_per_m=-0.1)
    pose, _, _ = total(steps, config)
    seconds = (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9
    assert pose == pytest.approx(se2.exp((0.45 * seconds, 0.0, (0.24 - 0.045) * seconds)), abs=1e-9)


@pytest.mark.parametrize(("omega", "share"), [(0.0, 1.0), (0.2, 0.8), (-0.2, 0.8), (1.5, 0.0)])
def test_a_robot_that_slows_down_in_turns(omega, share):
    steps = run(stepper(), [command(t, 0.5, omega) for t in times(1, 3, 20)])
    pose, _, _ = total(steps, WheelsConfig(source="command", scale_v=1.1, slowdown=1.0))
    seconds = (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9
    assert pose == pytest.approx(se2.exp((0.55 * share * seconds, 0.0, omega * seconds)), abs=1e-9)


def test_auto_prefers_odometry_and_says_so(drive):
    events = in_order_of_receipt(
        [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 10, 20)],
        [command(t, 9.0, 9.0) for t in times(0.12, 10, 10)],
    )
    steps = run(stepper(), events)
    pose, _, wheels = total(steps, WheelsConfig())
    assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=2e-3)
    assert not wheels.by_twist
    assert len(wheels.notes) == 1


def test_auto_takes_commands_where_nothing_else_speaks():
    steps = run(stepper(), [command(t, 0.5) for t in times(1, 3, 10)])
    pose, _, wheels = total(steps, WheelsConfig())
    assert pose[0] == pytest.approx(0.5 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, abs=1e-9)
    assert "commands" in wheels.notes[0]


def test_auto_uses_the_twist_of_an_odometry_whose_pose_never_moves():
    steps = run(stepper(), [odometry(t, twist=(0.5, 0.3)) for t in times(1, 6, 20)])
    pose, _, wheels = total(steps, WheelsConfig())
    assert pose[2] == pytest.approx(0.3 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, abs=1e-9)
    assert wheels.by_twist


def test_a_disagreement_of_twist_and_pose_is_said():
    """A skid-steered robot whose pose comes from elsewhere."""
    steps = run(stepper(), [odometry(t, (0, 0, 0.34 * t), (0.0, 1.0)) for t in times(1, 3, 20)])
    _, _, wheels = total(steps, WheelsConfig())
    assert any("disagrees" in note for note in wheels.notes)


@pytest.mark.parametrize("source", ["auto", "twist", "pose"])
def test_a_setting_that_is_made_already_is_not_advised(source):
    steps = run(stepper(), [odometry(t, (0, 0, 0.34 * t), (0.0, 1.0)) for t in times(1, 3, 20)])
    _, _, wheels = total(steps, WheelsConfig(source=source))
    assert wheels.by_twist == (source == "twist")
    assert any("wheels.source" in note for note in wheels.notes) == (source == "auto")


@pytest.mark.parametrize("drive", [None, "differential"])
def test_angles_whose_messages_come_in_bursts_do_not_jump(drive):
    """Stamps of receipt: ten messages every 0.2 s, the last nine within a millisecond. A real jump is still found."""
    geometry = {"left_joint": "l", "right_joint": "r", "left_radius": 0.05, "right_radius": 0.05, "track": 0.3}
    config = WheelsConfig(source="ticks", **geometry)
    if drive is not None:
        made = {"kind": drive, "left": ["l"], "right": ["r"], "radius": 0.05, "track": 0.3}
        config = WheelsConfig.model_validate({"drive": made})
    angles = [10.0 * 0.02 * k + (500.0 if k > 250 else 0.0) for k in range(300)]
    events = [
        joints(1.0 + 0.2 * (k // 10 + 1) + 1e-4 * (k % 10), angle, angle, ("l", "r")) for k, angle in enumerate(angles)
    ]
    pose, _, wheels = total(run(stepper(), events), config)
    assert wheels.rejections["wheels.encoder_reset"] == 1
    assert pose[0] == pytest.approx(0.05 * 10.0 * 5.8, abs=0.15)


def test_the_pose_bridges_a_long_gap_in_which_the_robot_hardly_moves():
    before = [odometry(t, (0.3 * t, 0.0, 0.0), (0.3, 0.0)) for t in times(0.1, 6, 20)]
    after = [odometry(t, (2.2 + 0.3 * (t - 15.0), 0.0, 0.0), (0.3, 0.0)) for t in times(15.0, 20, 20)]
    steps = run(stepper(), before + after)
    pose, _, wheels = total(steps, WheelsConfig())
    assert pose[0] == pytest.approx(2.2 + 0.3 * 5.0, abs=0.1)
    assert not wheels.rejections


def test_the_pose_bridges_a_silence_of_the_whole_robot_however_far_it_drove(drive):
    events = [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 20, 20) if not 6.0 < t < 15.0]
    seen = [range_bearing(t) for t in (5.5, 15.0, 16.0)]  # received with the first odometry after the gap, or before
    for order in (events + seen, seen + events):
        steps = run(stepper(), in_order_of_receipt(order))
        pose, _, wheels = total(steps, WheelsConfig())
        assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=0.02)
        assert not wheels.rejections


def test_a_pose_within_a_long_silence_is_as_unsure_as_the_way_and_its_end_as_sure_as_the_poses(drive):
    events = [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 20, 20) if not 6.0 < t < 14.0]
    steps = run(KeyframeBuilder(KeyframesConfig(), GateConfig(), 10.0, causal=False), in_order_of_receipt(events))
    wheels, moved, spread, given = WheelMotion(WheelsConfig()), np.zeros(3), np.zeros(3), 0.0
    for step in steps:
        m = wheels.measure(step)
        if m is None:
            continue
        moved, spread = se2.compose(moved, m.motion), spread + m.cov.diagonal()
        off = se2.between(moved, drive.motion(steps[0].stamp_ns, step.stamp_ns))
        assert (np.abs(off) < 3.0 * np.sqrt(spread + (0.0 if m.end_variance is None else m.end_variance)) + 0.02).all()
        given += m.cov[0, 0] * (ns(6.0) < step.stamp_ns < ns(14.0))
    assert given < 0.1


def test_steps_that_ended_within_a_gap_are_not_followed_by_their_share_of_the_way(drive):
    events = [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 24, 20) if not 6.0 < t < 18.0]
    seen = [range_bearing(t) for t in times(5.0, 19.0, 5)]
    steps = run(stepper(), in_order_of_receipt(events, seen))
    _, _, wheels = total(steps, WheelsConfig())
    assert wheels.rejections["wheels.silence"] > 10


@pytest.mark.parametrize("last_s", [7.4, 9.0, 15.0])
def test_steps_that_ended_within_a_gap_of_seconds_are_measured_again_after_it(drive, last_s):
    events = [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 20, 20) if not 6.0 < t < last_s]
    seen = [range_bearing(t) for t in times(5.0, 18.0, 5)]
    steps = run(stepper(), in_order_of_receipt(events, seen))
    wheels, again = WheelMotion(WheelsConfig()), []
    for step in steps:
        wheels.measure(step)
        again += wheels.measured_again
    assert {round(step.stamp_ns * 1e-9, 1) for step in again} == {round(t, 1) for t in times(6.2, last_s - 0.1, 5)}
    pose = np.zeros(3)
    for m in filter(None, map(wheels.measure, steps)):
        pose = se2.compose(pose, m.motion)
    assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=0.02)
    assert not wheels.rejections
    assert not any("no wheel motion" in note for note in wheels.notes)


def test_wheels_tell_way_and_turn_of_a_gap_and_not_the_place_after_it():
    """Straight on for two seconds, then a quarter to the left, or the other way round; a gyro tells which."""
    off, sigmas = [], {}
    for known in (False, True):
        for first in (True, False):
            twists = [(0.4, 0.0) if (t < 8.0) == first else (0.4, 0.25 * math.pi) for t in np.arange(6.0, 10.0, 0.02)]
            weave = [(0.4, 0.8 * math.sin(2.0 * t)) for t in np.arange(0.0, 6.0, 0.02)]
            pose, left, right, events = np.zeros(3), 0.0, 0.0, []
            for k, (v, w) in enumerate(weave + twists + weave[:50]):
                if not 300 < k < 500:
                    events.append(joints(0.1 + 0.02 * k, left / 0.05, right / 0.05, ("l", "r")))
                if 300 <= k < 500:
                    pose = se2.compose(pose, se2.exp(np.array([v, 0.0, w]) * 0.02))
                left, right = left + (v - 0.15 * w) * 0.02, right + (v + 0.15 * w) * 0.02
            geometry = {"left_joint": "l", "right_joint": "r", "left_radius": 0.05, "right_radius": 0.05, "track": 0.3}
            wheels = WheelMotion(WheelsConfig(source="ticks", **geometry))
            wheels.turn_known = known
            steps = run(stepper(), events)
            for step in steps:
                wheels.measure(step)
            motion, cov = wheels.motion_between(steps[-1], ns(6.1), ns(10.1))
            off.append(np.abs(se2.between(pose, motion)[:2]))
            sigmas[known] = np.sqrt(np.diag(cov)[:2])
    assert 0.2 < np.max(off) < 3.0 * sigmas[False].min()
    assert sigmas[True].max() < 0.1


def test_the_heading_of_a_pose_of_few_noisy_messages_is_not_doubted():
    rng = np.random.default_rng(3)
    poses = [se2.exp(np.array([0.3, 0.0, 0.05]) * 0.4 * k) + rng.normal(0.0, [0.004, 0.004, 0.01]) for k in range(12)]
    events = [odometry(0.4 * k, pose, (0.3, 0.05)) for k, pose in enumerate(poses)]
    _, _, wheels = total(run(stepper(), events), WheelsConfig())
    assert not any("heading" in note for note in wheels.notes)


def test_an_odometry_that_begins_anew_after_a_long_gap_is_not_connected_with_what_was():
    before = [odometry(t, (2.0 + 0.3 * t, 0.0, 0.0), (0.3, 0.0)) for t in times(0.1, 6, 20)]
    after = [odometry(t, (0.3 * (t - 15.0), 0.0, 0.0), (0.3, 0.0)) for t in times(15.0, 20, 20)]
    steps = run(stepper(), before + after)
    pose, _, _ = total(steps, WheelsConfig())
    assert pose[0] == pytest.approx(0.3 * (6.0 + 5.0), abs=0.4)


def test_the_twist_is_used_where_the_poses_heading_is_not_that_of_its_motion(drive):
    turned = (0.0, 0.0, 0.1)
    events = [odometry(t, se2.compose(drive.pose(t), turned), drive.twist(t)) for t in times(0.1, 18, 20)]
    steps = run(stepper(), events)
    pose, _, wheels = total(steps, WheelsConfig())
    assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=0.1)
    assert any("5.7°" in note for note in wheels.notes)


def test_a_heading_that_was_doubted_at_first_turns_no_motion_later(drive):
    rng = np.random.default_rng(0)
    off = {t: rng.normal(0.2, 0.1) if t < 3.0 else 0.0 for t in times(0.1, 18, 4)}
    events = [odometry(t, se2.compose(drive.pose(t), (0.0, 0.0, turned)), drive.twist(t)) for t, turned in off.items()]
    wheels, doubted = WheelMotion(WheelsConfig()), []
    for step in run(stepper(), events):
        m = wheels.measure(step)
        doubted.append(wheels.by_twist)
        if m is not None and step.start_ns > ns(13.0):
            assert m.motion == pytest.approx(drive.motion(step.start_ns, step.stamp_ns), abs=0.005)
    assert any(doubted)
    assert not doubted[-1]


def test_a_pose_whose_heading_is_off_bridges_a_silence_of_the_whole_robot(drive):
    turned = (0.0, 0.0, 0.1)
    rate = times(0.1, 20, 20)
    events = [odometry(t, se2.compose(drive.pose(t), turned), drive.twist(t)) for t in rate if not 10.0 < t < 18.0]
    steps = run(stepper(), events)
    pose, _, wheels = total(steps, WheelsConfig())
    assert wheels.by_twist
    assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=0.1)
    assert not wheels.rejections


def test_a_later_better_source_takes_over(drive):
    events = in_order_of_receipt(
        [command(t, *drive.twist(t)) for t in times(0.1, 18, 20)],
        [odometry(t, drive.pose(t), drive.twist(t)) for t in times(4.0, 18, 20)],
    )
    steps = run(stepper(), events)
    pose, _, wheels = total(steps, WheelsConfig())
    assert pose == pytest.approx(drive.motion(steps[0].stamp_ns, steps[-1].stamp_ns), abs=0.05)
    assert "odometry" in wheels.notes[0]
    assert not any("commands" in note for note in wheels.notes)
    assert sum(wheels.rejections.values()) <= 1  # the step in which it began


def test_source_none_measures_nothing_but_can_carry():
    steps = run(stepper(), [odometry(t, twist=(1.0, 0.0)) for t in times(1, 2, 20)])
    wheels = WheelMotion(WheelsConfig(source="none"))
    assert all(wheels.measure(step) is None for step in steps)
    motion, cov = wheels.motion_between(steps[-1], steps[-1].stamp_ns, steps[-1].stamp_ns - ns(0.1))
    assert not motion.any()
    assert cov[0, 0] > 0.04**2


def test_ambiguous_or_missing_wheels_are_named():
    four = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
    steps = run(stepper(), [joints(t, 1, 2, names=four) for t in times(1, 4, 20)])
    with pytest.raises(ConfigError, match=r"front_left_wheel, rear_left_wheel.*wheels\.left_joint"):
        total(steps, WheelsConfig(source="ticks", **GEOMETRY))
    arm = run(stepper(), [joints(t, 1, 2, names=("shoulder", "elbow")) for t in times(1, 4, 20)])
    with pytest.raises(ConfigError, match="shoulder, elbow"):
        total(arm, WheelsConfig(source="ticks", **GEOMETRY))
    misspelled = WheelsConfig(source="ticks", left_joint="sholder", right_joint="elbow", **GEOMETRY)
    with pytest.raises(ConfigError, match=r"wheels\.left_joint: sholder\b.*'shoulder'"):
        total(arm, misspelled)
    _, _, wheels = total(arm, WheelsConfig(**GEOMETRY))
    assert any("shoulder, elbow" in note for note in wheels.notes)
    with pytest.raises(ConfigError, match=r"wheels\.track"):
        WheelMotion(WheelsConfig(source="ticks", left_radius=0.05))


def test_configured_joints_are_used():
    four = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
    names = dict(left_joint=four[2], right_joint=four[3])
    angles = [(t, np.array([50 * t, -50 * t, 2 * t, 2 * t])) for t in times(1, 4, 20)]
    made = [joints(t, 0, 0, names=four) for t, _ in angles]
    events = [
        type(e)(e.stamp_ns, e.received_ns, e.topic, e.names, a, e.velocity, e.effort)
        for e, (_, a) in zip(made, angles, strict=True)
    ]
    steps = run(stepper(), events)
    equal = dict(left_radius=0.1, right_radius=0.1, track=0.4)
    pose, _, _ = total(steps, WheelsConfig(source="ticks", **equal, **names))
    assert pose == pytest.approx([0.2 * (steps[-1].stamp_ns - steps[0].stamp_ns) * 1e-9, 0, 0], abs=1e-9)


# --- faults and edges ---


def test_a_refused_twist_without_pose_is_held_then_unknown():
    nan = np.full(3, np.nan)
    events = [
        odometry(t, twist=(0.5, 0.0), position=nan, **(dict(linear=nan, angular=nan) if 2 < t < 4 else {}))
        for t in times(1, 6, 20)
    ]
    steps = run(stepper(), events)
    pose, cov, wheels = total(steps, WheelsConfig(source="twist", hold_s=0.5))
    assert wheels.rejections["wheels.silence"] > 0
    assert cov[0, 0] > 0.2
    assert 0.5 * 3 < pose[0] < 0.5 * 4.9


@pytest.mark.parametrize(("late_s", "told"), [(0.0005, None), (0.02, "20 ms 1"), (0.3, "0.3 s 6")])
def test_how_long_nothing_was_known_is_told_in_a_unit_that_shows_it(late_s, told):
    """A command comes that much later than the one before it holds."""
    commands = [command(t, 0.3, 0.0) for t in (1.0, 1.1, 1.2, 1.7 + late_s, 1.8 + late_s)]
    steps = run(stepper(), in_order_of_receipt(commands, [corners(t) for t in times(1, 2.2, 20)]))
    _, _, wheels = total(steps, WheelsConfig(source="command", hold_s=0.5))
    found = (re.search(r"([\d.]+ m?s) \D*(\d+) step", note) for note in wheels.notes)
    said = [" ".join(one.groups()) for one in found if one is not None]
    assert said == ([] if told is None else [told])


def test_the_same_step_measured_again_gives_the_same(drive):
    steps = run(stepper(), [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 18, 20)])
    wheels = WheelMotion(WheelsConfig())
    first = [wheels.measure(step) for step in steps]
    counted = wheels.rejections
    again = [wheels.measure(step) for step in steps]
    assert all(a is b for a, b in zip(first, again, strict=True))
    assert wheels.rejections == counted


def test_carry_goes_both_ways_and_agrees_with_measure(drive):
    steps = run(stepper(), [odometry(t, drive.pose(t), drive.twist(t)) for t in times(0.1, 18, 20)])
    wheels = WheelMotion(WheelsConfig(source="pose"))
    for step in steps[:40]:
        measured = wheels.measure(step)
    motion, cov = wheels.motion_between(step, step.start_ns, step.stamp_ns)
    assert motion == pytest.approx(measured.motion, abs=1e-12)
    assert cov == pytest.approx(measured.cov, abs=1e-15)
    back, back_cov = wheels.motion_between(step, step.stamp_ns, step.stamp_ns - ns(3.0))
    there, there_cov = wheels.motion_between(step, step.stamp_ns - ns(3.0), step.stamp_ns)
    assert se2.compose(there, back) == pytest.approx(np.zeros(3), abs=1e-12)
    assert back == pytest.approx(drive.motion(step.stamp_ns, step.stamp_ns - ns(3.0)), abs=1e-3)
    # Going there and back by the same measurement ends where it began, without any error.
    ad = se2.adjoint(there)
    assert back_cov == pytest.approx(ad @ there_cov @ ad.T, rel=1e-9, abs=1e-15)


def test_a_new_segment_shares_no_motion_with_the_last():
    stamps = [*times(1, 3, 20), *times(1001, 1003, 20)]
    steps = run(stepper(), [odometry(t, (0.3 * t, 0, 0), (0.3, 0)) for t in stamps])
    assert {step.segment for step in steps} == {0, 1}
    pose, _, wheels = total(steps, WheelsConfig(source="pose"))
    inside = sum((step.stamp_ns - step.start_ns) * 1e-9 for step in steps)
    assert pose[0] == pytest.approx(0.3 * inside, abs=1e-6)
    assert not wheels.rejections


def test_a_step_of_no_length_has_no_motion():
    steps = run(stepper(), [odometry(t) for t in times(1, 2, 20)])
    assert WheelMotion(WheelsConfig()).measure(steps[0]) is None
