"""A clock that is reset alone is corrected; jumps of all, strays and bursts pass as they are."""

import re
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from event_makers import command, imu, joints, ns, odometry

from fgloc.intake.clocks import TopicClocks
from fgloc.sensors.markers.images import CornersEvent

RESET_S = 10.0


def at(event, received_s):

    return replace(event, received_ns=ns(received_s))


def stream(reset, seconds=20.0, topics=("odom", "imu", "cmd")):
    """Three topics with delays of 3 ms; every 10 s the stamps of those named begin at 0 again."""
    made = []
    for k in range(round(seconds * 50)):
        t = 1000.0 + k * 0.02
        for topic in topics:
            stamp = (t - 1000.0) % RESET_S if topic in reset and t >= 1000.0 + RESET_S else t
            make = {"odom": odometry, "imu": imu, "cmd": command}[topic]
            made.append(at(make(stamp + 0.001), t + 0.004))
    return made


def passed(events):
    clocks = TopicClocks()
    out = [e for event in events for e in clocks.correct(event)]
    return clocks, out, clocks.flush()


def test_what_is_on_time_passes_as_it_is():
    events = stream(())
    clocks, out, held = passed(events)
    assert all(a is b for a, b in zip(out, events, strict=True))
    assert clocks.notes == ()
    assert held == []


def test_a_clock_that_is_reset_alone_is_put_back():
    events = stream({"odom"})
    clocks, out, held = passed(events)
    assert held == []
    assert len(out) == len(events)
    odometries = [e for e in out if e.topic == "/odom"]
    delays = np.array([e.received_ns - e.stamp_ns for e in odometries]) * 1e-9
    assert np.abs(delays - 0.003).max() < 1e-3
    assert [e.stamp_ns for e in odometries] == sorted(e.stamp_ns for e in odometries)
    assert len(clocks.notes) == 1
    assert re.match(r"/odom: .*\bclock\b.* 1 time", clocks.notes[0])


def test_it_may_be_reset_again():
    clocks, out, _ = passed(stream({"odom"}, seconds=30.0))
    delays = [e.received_ns - e.stamp_ns for e in out if e.topic == "/odom"]
    assert max(abs(d - 0.003e9) for d in delays) < 1e6
    assert "reset 2 time(s)" in clocks.notes[0]


def test_after_a_jump_of_all_a_topic_that_comes_later_has_jumped_with_them():
    """All pause for 3 s; the first that speaks again is not taken for the only one that was reset."""
    events = []
    for e in stream({"odom", "imu", "cmd"}):
        pause = 3.0 if e.received_ns > ns(1000.0 + RESET_S) else 0.0
        pause += 0.3 if pause and e.topic == "/imu" else 0.0
        events.append(at(e, e.received_ns * 1e-9 + pause))
    events.sort(key=lambda e: e.received_ns)
    clocks, out, held = passed(events)
    assert [id(e) for e in out] == [id(e) for e in events]
    assert held == []
    assert clocks.notes == ()


@pytest.mark.parametrize("topics", [("odom", "imu", "cmd"), ("odom",)])
def test_a_jump_of_all_clocks_is_left_to_the_clock_guard(topics):
    events = stream({"odom", "imu", "cmd"}, topics=topics)
    clocks, out, held = passed(events)
    assert held == []
    assert [id(e) for e in out] == [id(e) for e in events]
    assert clocks.notes == ()


def test_single_wrong_stamps_pass_as_they_are():
    events = stream(())
    wrong = at(odometry(5000.0), 1005.0)
    events.insert(len(events) // 4, wrong)
    clocks, out, _ = passed(events)
    assert any(e is wrong for e in out)
    assert len(out) == len(events)
    assert clocks.notes == ()


def test_a_burst_after_a_stall_is_not_a_reset():
    """One topic is held up for 8 s, then comes all at once."""
    events = [at(e, 1018.0) if e.topic == "/odom" and 1010.0 < e.received_ns * 1e-9 < 1018.0 else e for e in stream(())]
    events.sort(key=lambda e: e.received_ns)
    clocks, out, held = passed(events)
    assert {id(e) for e in out} == {id(e) for e in events}
    assert held == []
    assert clocks.notes == ()


def test_wheels_and_an_arm_may_share_a_topic_with_clocks_of_their_own():
    events = []
    for k in range(1000):
        t = 1000.0 + 0.02 * k
        wheel = t if k < 500 else t - 1010.0
        events.append(at(joints(wheel + 0.001, 0.1 * k, 0.1 * k), t + 0.003))
        events.append(at(joints(t + 0.002, 0.0, 0.0, names=("arm_1", "arm_2")), t + 0.004))
    _, out, _ = passed(events)
    assert len(out) == len(events)
    assert max(abs(e.received_ns - e.stamp_ns) for e in out) < 0.004e9


def test_a_reset_sensor_of_sightings_is_put_back_too():
    events = stream((), topics=("odom", "imu"))
    for k in range(80):
        t = 1000.0 + 0.25 * k
        stamp = t if t < 1010.0 else t - 1010.0
        events.append(CornersEvent(ns(stamp) + 1, ns(t + 0.05), "/tags", "cam", ()))
    _, out, _ = passed(sorted(events, key=lambda e: e.received_ns))
    delays = [e.received_ns - e.stamp_ns for e in out if e.topic == "/tags"]
    assert max(abs(d - 0.05e9) for d in delays) < 1e6


def test_long_names_of_joints_are_not_kept():
    clocks = TopicClocks()
    tracemalloc.start()
    try:
        for k in range(50):
            event = joints(0.1 * k, 0.0, 0.0)
            clocks.correct(at(replace(event, names=(f"{k}" + "x" * 200_000, "right")), 0.1 * k + 0.003))
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 1_000_000
