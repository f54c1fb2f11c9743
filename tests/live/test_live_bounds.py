"""A live run's memory is bounded for any names of topics and frames."""

import dataclasses
import gc
import tracemalloc

import numpy as np
import pytest
from robot_world import World, beacons, config

from fgloc.config import Config
from fgloc.diagnosis.mistakes import Diagnosis
from fgloc.live import Live
from fgloc.live.run import LiveFacts
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, TransformEvent

START_NS = 1_000_000_000_000
UNIT = np.array([0.0, 0.0, 0.0, 1.0])
MANY = 1500  # names; a robot has tens
KEPT_MB = 1.0  # that a stream of new names may leave behind


def at_ns(k):
    return START_NS + k * 1_000_000


def transform(k, static=False):
    name = f"link_{k}_{'x' * 50}"
    return TransformEvent(at_ns(k), at_ns(k), "/tf", "base_link", name, np.array([1.0, k, 0.0]), UNIT, static)


@pytest.mark.parametrize("static", [False, True])
def test_frames_of_ever_new_names_take_no_more_memory(static):
    with Live(Config(), roles=("command",)) as live:
        live.push(ControlEvent(at_ns(0), at_ns(0), "/cmd_vel", 0.2, 0.0))
        for k in range(MANY):
            live.push(transform(k, static))
        assert live.wait(60.0)
        gc.collect()
        tracemalloc.start()
        try:
            for k in range(MANY, 3 * MANY):
                live.push(transform(k, static))
            assert live.wait(60.0)
            gc.collect()
            kept = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
        assert kept < KEPT_MB * 1e6
        assert live.status().rejections["transform.too_many_frames"] > MANY


def test_a_mounting_that_is_told_again_and_again_is_kept_once():
    facts = LiveFacts(Config(), None, None)
    facts.note(transform(0))
    frames = facts.frames
    for k in range(1, 5):
        facts.note(dataclasses.replace(transform(0), stamp_ns=at_ns(k), received_ns=at_ns(k)))
        assert facts.frames is frames  # there is nothing to build anew
    moved = dataclasses.replace(transform(0), translation=np.array([0.5, 0.0, 0.0]))
    facts.note(moved)
    assert facts.frames is not frames


def test_joints_and_topics_of_ever_new_names_make_few_notes_and_statistics():
    with Live(Config(), roles=("command",)) as live:
        for k in range(2 * MANY):
            joints = (f"wheel_{k}", f"arm_{k}")
            angles, rates = np.array([0.1, 0.1]), np.array([0.1, np.nan])
            live.push(JointsEvent(at_ns(k), at_ns(k), "/joint_states", joints, angles, rates, np.empty(0)))
            live.push(ControlEvent(at_ns(k), at_ns(k), f"/cmd_vel_{k}", 0.2, 0.0))
        assert live.wait(60.0)
        status = live.status()
        assert len(status.notes) < MANY / 10
        assert sum(map(len, status.notes)) < 100_000
        assert len(status.topics) < MANY


def test_a_stamp_of_another_age_does_not_end_the_comparison_of_sensors():
    world = World(beacons(), seed=2, seconds=10.0)
    compared = Diagnosis(config(), world.map, (), np.eye(4))
    for k, event in enumerate(world.events()):
        compared.add(event)
        if k > 50 and isinstance(event, OdometryEvent):
            compared.add(dataclasses.replace(event, stamp_ns=event.stamp_ns + 10**18))
    assert not compared.findings()
