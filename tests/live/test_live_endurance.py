"""In the long term: memory and work per step stay as they are, whatever is seen and however often the clock jumps."""

import dataclasses
import gc
import math
import threading
import time
from unittest.mock import patch

import numpy as np
import pytest
from live_feed import PATIENCE_S, feed, live_in
from robot_world import CAMERA, START_NS, World, beacons, config, room

from benchmarks.live import circle, circle_config, circle_map, mirrored, run_of, wrong_ids
from fgloc.estimation.pose_fit import PoseFit
from fgloc.live.extrapolation import Extrapolator
from fgloc.live.run import LiveFacts, OnlineRun
from fgloc.types import Mode, MotionEvent

SECOND = 1_000_000_000
STEPS, WARM_UP = 450, 250
_LONG = 1_000_000


def started(world, events):
    """A run without threads whose parts are built."""
    facts = LiveFacts(config(), None, CAMERA if world.sees_corners else None)
    for event in events[:50]:
        facts.topic_is_used(event)
        facts.note(event)
    run = OnlineRun(config(), world.map, facts)
    run.build()
    return run


def kept(parts):
    """Sizes of all that a run keeps of the past."""
    localizer = parts.localizer
    stepper, estimator = parts.stepper, localizer.estimator
    return {
        "log": len(estimator.log.keyframes),
        "slots": len(estimator._slots),
        "factors": estimator._backend._smoother.getFactors().size(),
        "pending": len(stepper._pending),
        "seen": len(stepper._seen),
        "reached": len(stepper._reached),
        "motion": sum(len(buffer.stamps) for buffer in stepper._motion.values()),
        "pieces": sum(len(track.timeline._pieces) for track in parts.wheels._all),
    }


@pytest.mark.slow
def test_what_is_found_of_the_installation_does_not_drift():
    """Nothing is off, in 13 minutes of a circle; gyro scale and bias can't be told apart at a constant turn rate."""
    config_, map_ = circle_config(), circle_map()
    facts = LiveFacts(config_, None, None)
    run = OnlineRun(config_, map_, facts)
    for k, event in enumerate(circle(800.0)):
        if run.parts is None:
            facts.topic_is_used(event)
            facts.note(event)
            if k == 20:
                run.build()
            continue
        passed = run.check(event)
        for _ in () if passed is None else run.use(passed, False):
            pass
    estimator = run.parts.localizer.estimator
    sigmas = np.sqrt(np.diag(estimator.installed.cov))
    off = dict(zip(estimator.installation.names, estimator.installed.mean / sigmas, strict=True))
    del off["gyro.scale"]
    assert max(abs(x) for x in off.values()) < 3.5, off


def test_memory_and_what_is_kept_stay_as_they_are():
    made, sizes, objects = 0, [], []
    config_, map_ = circle_config(), circle_map()
    facts = LiveFacts(config_, None, None)
    run, poses = OnlineRun(config_, map_, facts), Extrapolator(config_)
    for k, event in enumerate(circle((STEPS + 20) / 5.0)):
        if run.parts is None:
            facts.topic_is_used(event)
            facts.note(event)
            if k == 20:
                run.build()
                poses.begin(run.anchors.parts)
            continue
        passed = run.check(event)
        if isinstance(passed, MotionEvent):
            poses.add(passed)
        for step, estimate in () if passed is None else run.use(passed):
            if estimate is not None:
                poses.anchor(run.anchor(step, estimate))
            made += 1
            if made in (WARM_UP, STEPS):
                events = {kind.__name__: len(some) for kind, some in poses._events.items()}
                sizes.append(kept(run.parts) | {"anchors": len(poses._anchors)} | events)
                gc.collect()
                objects.append(len(gc.get_objects()))
    assert made >= STEPS
    for name, before in sizes[0].items():
        assert sizes[1][name] <= before + 5 if name != "pieces" else sizes[1][name] <= 1000, name
    assert objects[1] < 1.02 * objects[0]
    assert run.newest.mode is Mode.OK


@pytest.mark.parametrize("fault", ["wrong ids", "mirrored map", "noise"])
def test_a_search_that_finds_nothing_works_no_more_than_it_may(fault):
    """Counted, not timed: fits per second of the stream, once the first five seconds have passed in vain."""
    world = World(room(), seconds=9.0, rate=5)
    events, rng = world.events(), np.random.default_rng(1)
    if fault == "noise":
        events = [scattered(e, rng) if e.topic == "/tags" else e for e in events]
    if fault == "wrong ids":
        events = list(wrong_ids(events, world.map.landmarks, rng))
    landmark_map = mirrored(world.map) if fault == "mirrored map" else world.map
    run = started(dataclasses.replace(world, map=landmark_map), events)
    fits, solve = [], PoseFit.solve

    def counted(self, *args):
        fits.append(now)
        return solve(self, *args)

    with patch.object(PoseFit, "solve", counted):
        for event in events:
            now = (event.received_ns - START_NS) * 1e-9
            passed = run.check(event)
            for _ in () if passed is None else run.use(passed):
                pass
    late = [t for t in fits if t > 6.5]
    assert len([t for t in fits if t < 5.0]) > 0
    assert 0 < len(late) / 2.5 < 60.0  # 4 rough places, and 4 fitted with 3 trims each, at most every 0.8 s


def scattered(event, rng):
    """Squares anywhere, with ids by chance."""
    return dataclasses.replace(
        event,
        sightings=tuple(
            dataclasses.replace(
                s,
                landmark_id=int(rng.integers(20)),
                corners_px=s.corners_px - s.corners_px.mean(axis=0) + rng.uniform(100, 380, 2),
            )
            for s in event.sightings
        ),
    )


def jumping(count, length=8):
    """A stream whose clock jumps ahead or back again and again."""
    rng = np.random.default_rng(0)
    world = World(beacons(), seconds=length / 10.0 + 0.01)
    events, shift, received = world.events(), 0, 0
    for _ in range(count):
        for event in events:
            stamp = event.stamp_ns + shift
            yield dataclasses.replace(
                event, stamp_ns=stamp, received_ns=START_NS + received + event.stamp_ns - START_NS
            )
        received += round(length * 0.1 * SECOND)
        shift += int(rng.choice([-1, 1])) * int(rng.integers(70, 10_000)) * SECOND


@pytest.mark.parametrize("count", [40, pytest.param(10_000, marks=pytest.mark.slow)])
def test_the_clock_may_jump_again_and_again(count):
    world = World(beacons(), seconds=3.0)
    with live_in(world, config(live={"startup_s": 0.1}), roles=("odometry", "sightings")) as live:
        for k, event in enumerate(jumping(count)):
            live.push(event)
            if k % 500 == 0:
                assert live.wait(PATIENCE_S)
        assert live.wait(PATIENCE_S)
        status = live.status()
        last = feed(live, World(beacons(), seconds=6.0, start_ns=event.stamp_ns + 3600 * SECOND).events())
    assert len(status.notes) < 30
    assert [n for n in status.notes if "times in all" in n]
    assert last[-1].mode is Mode.OK


def test_pauses_of_all_sensors_do_no_harm():
    """Nothing comes for 40 s, twice: the pose goes on with what that allows."""
    world = World(room(), seconds=4.0)
    events = world.events()
    for pause_s in (40.0, 80.0):
        later = round(pause_s * SECOND)
        events += [
            dataclasses.replace(e, stamp_ns=e.stamp_ns + later, received_ns=e.received_ns + later)
            for e in world.events()
        ]
    with live_in(world) as live:
        made = feed(live, events)
        assert live.pose_at().mode is Mode.OK
    assert made[-1].mode is Mode.OK
    at = world.truth(made[-1].stamp_ns - 80 * SECOND)
    assert math.hypot(*(made[-1].pose - at)[:2]) < 0.06


def test_a_stream_faster_than_the_estimator_never_blocks_and_is_bounded(monkeypatch):
    """Nobody waits for the estimator: the oldest events go, and it catches up."""
    monkeypatch.setattr("fgloc.live.engine._MOST_EVENTS", 300)
    world = World(beacons(), seconds=20.0)
    with live_in(world) as live:
        for event in world.events():
            live.push(event)
            assert live.status().queued_events <= 2000
        assert live.wait(PATIENCE_S)
        status = live.status()
        made = feed(live, World(beacons(), seconds=4.0, start_ns=START_NS + 20 * SECOND, start_s=20.0).events())
    assert status.topics["/odom"].count == 400
    assert made[-1].mode is Mode.OK
    assert not [t for t in threading.enumerate() if t.name.startswith("fgloc-")]


@pytest.mark.slow
def test_a_million_keyframes():
    """Cost of the last tenth over the first, and memory: as `benchmarks.live` has it."""
    seconds = np.zeros(_LONG)
    for k, (*_, spent) in zip(
        range(_LONG), run_of(circle_config(), circle_map(), circle(_LONG / 5.0 + 20.0)), strict=False
    ):
        seconds[k] = spent
    assert seconds[-_LONG // 10 :].mean() < 1.3 * seconds[: _LONG // 10].mean()


@pytest.mark.slow
def test_an_hour_of_real_time():
    """As a robot would: paced by the wall clock, asked for its pose at 50 Hz."""
    map_, began, latest = circle_map(), time.monotonic(), 0.0
    with live_in(World(map_), circle_config(), roles=("odometry", "imu", "sightings")) as live:
        for event in circle(3600.0):
            ahead = (event.received_ns - START_NS) * 1e-9 - (time.monotonic() - began)
            if ahead > 0.0:
                time.sleep(ahead)
            live.push(event)
            asked = time.perf_counter()
            live.pose_at()
            latest = max(latest, time.perf_counter() - asked)
        assert live.wait(PATIENCE_S)
        status = live.status()
    assert status.mode is Mode.OK
    assert status.dropped == {}
    assert latest < 2.0
