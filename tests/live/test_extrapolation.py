"""Poses beyond the last keyframe: by the gyro alone, and by wheels and a motion model that agree or do not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from motion_models import make_card, make_tensors
from robot_world import CAMERA, START_NS, TURN, World, config, position_error, room

from fgloc import se2
from fgloc.live import extrapolation
from fgloc.live.extrapolation import Extrapolator
from fgloc.live.run import LiveFacts, OnlineRun
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.learned.sensor import save_model
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import MotionEvent

SECOND = 1_000_000_000


def anchored(settings, world, events, most=math.inf) -> Extrapolator:
    """Extrapolator of a run that has used these events, which is given so many of its keyframes at most."""
    facts = LiveFacts(settings, None, CAMERA)
    for event in events[:20]:
        facts.topic_is_used(event)
        facts.note(event)
    run, poses = OnlineRun(settings, world.map, facts), Extrapolator(settings)
    run.build()
    poses.begin(run.anchors.parts)
    for event in events:
        passed = run.check(event)
        if isinstance(passed, MotionEvent):
            poses.add(passed)
        for step, estimate in () if passed is None else run.use(passed):
            if estimate is not None and (most := most - 1) >= 0:
                poses.anchor(run.anchor(step, estimate))
    return poses


def imu(stamp: int) -> ImuEvent:
    return ImuEvent(stamp, stamp, "/imu", "base_link", np.array([0.0, 0.0, TURN]), np.zeros(3), np.zeros((3, 3)))


def test_where_wheels_fall_silent_the_gyro_tells_the_turn_for_seconds():
    """For more than the pieces of a second in which it is asked; at 12.5 Hz no message may be left out."""
    world = World(room(), seconds=3.0, rate=5)
    rates = [imu(START_NS + k * 80_000_000) for k in range(100)]
    events = sorted(
        [*world.events(), *(e for e in rates if e.stamp_ns < START_NS + 3 * SECOND)], key=lambda e: e.received_ns
    )
    poses = anchored(config(gyro={"bias_sigma": 1e-4}), world, events)
    for event in rates:
        if event.stamp_ns >= START_NS + 3 * SECOND:
            poses.add(event)
    now = poses.pose_at(START_NS + 6 * SECOND)
    assert now.stamp_ns - now.keyframe_ns > 3 * SECOND
    assert abs(se2.wrap(now.pose[2] - world.truth(now.stamp_ns)[2])) < 0.02
    assert math.sqrt(now.cov[2, 2]) < 0.05


def test_from_the_first_keyframe_on_there_are_poses_and_none_before_it():
    world = World(room(), seconds=2.0, rate=5)
    poses = anchored(config(), world, world.events(), most=1)
    first = poses.pose_at(None).keyframe_ns
    assert poses.pose_at(first - 1) is None
    for at_ns in (first, first + SECOND // 2):
        assert position_error(poses.pose_at(at_ns), world.truth(at_ns)) < 0.1


def test_while_no_keyframe_comes_as_many_messages_are_kept_as_may_be(monkeypatch):
    world = World(room(), seconds=2.0, rate=5)
    events = world.events()
    count = sum(isinstance(event, OdometryEvent) for event in events)
    at_ns, moved = START_NS + 19 * SECOND // 10, {}
    for most in (10 * count, count, count - 1):
        monkeypatch.setattr(extrapolation, "_MOST_EVENTS", most)
        moved[most] = anchored(config(), world, events, most=1).pose_at(at_ns)
    assert np.array_equal(moved[count].pose, moved[10 * count].pose)
    assert np.trace(moved[count - 1].cov) > np.trace(moved[count].cov)  # the older half is forgotten


@pytest.mark.parametrize("slips", [False, True])
def test_wheels_are_left_out_of_the_newest_pose_only_if_they_contradict_a_model_of_the_commands(tmp_path, slips):
    card = make_card("naive", kinematics={}, lag=None, joint=None)
    save_model(tmp_path / "m.safetensors", make_tensors(card, np.random.default_rng(0)), card)
    world = World(room(), seconds=6.0, rate=5)
    begins = START_NS + 5 * SECOND
    before, after = ([e for e in world.events() if (e.stamp_ns < begins) == early] for early in (True, False))
    poses = anchored(config(motion={"model": tmp_path / "m.safetensors"}), world, before)
    without = anchored(config(motion={"model": tmp_path / "m.safetensors"}), world, before)
    for event in (e for e in after if isinstance(e, MotionEvent) and e.stamp_ns < begins + SECOND // 2):
        if isinstance(event, OdometryEvent):
            poses.add(replace(event, linear=event.linear * (5.0 if slips else 1.0)))
        else:
            poses.add(event)
            without.add(event)
    at_ns = begins + SECOND // 2
    both, alone = poses.pose_at(at_ns), without.pose_at(at_ns)
    assert position_error(both, world.truth(at_ns)) < 0.05  # wheels alone would have it 0.8 m ahead
    share = np.sqrt(np.trace(both.cov[:2, :2]) / np.trace(alone.cov[:2, :2]))
    assert share > 1.2 if slips else share < 0.9
