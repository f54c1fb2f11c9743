"""How the stream of events is cut into steps."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from event_makers import (
    check_steps,
    command,
    corners,
    image,
    imu,
    in_order_of_receipt,
    joints,
    ns,
    odometry,
    range_bearing,
    run,
    stepper,
    times,
)

from fgloc.config import GateConfig, KeyframesConfig, WheelsConfig
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent

MOTION = (OdometryEvent, ControlEvent, JointsEvent, ImuEvent)


def robot(rng, seconds=30.0, camera_latency=0.06):
    """A usual robot: all sensors, some latency and jitter, a camera that sees nothing for a while."""
    start, end = 100.0, 100.0 + seconds

    def late(mean):
        return rng.exponential(mean)

    blind = (start + 0.4 * seconds, start + 0.7 * seconds)
    return in_order_of_receipt(
        [odometry(t, twist=(0.5, 0.1), received=t + late(0.002)) for t in times(start, end, 50)],
        [command(t + 0.003, 0.5, received=t + late(0.003)) for t in times(start, end, 10)],
        [imu(t + 0.001) for t in times(start, end, 100)],
        [joints(t + 0.004, t, t) for t in times(start, end, 25)],
        [
            corners(t, received=t + camera_latency + late(0.01))
            for t in times(start + 0.02, end, 9)
            if not blind[0] < t < blind[1]
        ],
    )


def same(a, b):
    """Whether two runs gave the same steps."""

    def key(step):
        kinds = (*(step.of(kind) for kind in MOTION), step.sightings)
        return (step.index, step.segment, step.start_ns, step.stamp_ns, [[id(e) for e in k] for k in kinds])

    return [key(s) for s in a] == [key(s) for s in b]


def test_each_sighting_gets_a_keyframe_at_its_stamp():
    rng = np.random.default_rng(0)
    events = robot(rng)
    steps = run(stepper(), events)
    check_steps(steps)
    seen = {e.stamp_ns for e in events if isinstance(e, CornersEvent)}
    at_keyframes = {e.stamp_ns for step in steps for e in step.sightings if e.stamp_ns == step.stamp_ns}
    assert len(at_keyframes) == len(seen)
    assert all(step.dt <= 0.25 + 1e-9 for step in steps)


def test_steps_are_deterministic_and_flushed_to_the_end():
    events = robot(np.random.default_rng(1))
    a, b = run(stepper(), events), run(stepper(), events)
    assert same(a, b)
    assert a[-1].stamp_ns >= events[-1].stamp_ns - ns(0.06)


def test_windows_hold_what_integration_needs():
    events = robot(np.random.default_rng(2))
    steps = run(stepper(history_s=2.0), events)
    for step in steps[10:-3]:
        for kind in (step.of(OdometryEvent), step.of(JointsEvent), step.inertial):
            stamps = [e.stamp_ns for e in kind]
            assert stamps[0] <= step.start_ns < stamps[1]
            assert stamps[-2] < step.stamp_ns <= stamps[-1]
        stamps = [e.stamp_ns for e in step.controls]
        assert stamps[0] <= max(step.start_ns - ns(2.0), ns(100.003)) < stamps[1] or stamps[0] == ns(100.003)
    inside = {id(e) for step in steps for e in step.of(OdometryEvent)}
    assert all(id(e) in inside for e in events if isinstance(e, OdometryEvent) and e.stamp_ns >= steps[0].stamp_ns)


def test_grid_keyframes_while_only_odometry_speaks():
    steps = run(stepper(max_interval_s=0.25), [odometry(t) for t in times(1, 6, 20)])
    check_steps(steps)
    assert [step.dt for step in steps[1:-1]] == pytest.approx([0.25] * (len(steps) - 2), abs=1e-9)
    assert steps[0].dt == 0.0
    assert steps[-1].stamp_ns == ns(5.95)


def test_a_sighting_just_after_the_grid_is_waited_for():
    events = in_order_of_receipt([odometry(t) for t in times(1, 3, 20)], [corners(1.0), corners(1.23)])
    steps = run(stepper(max_interval_s=0.2, min_interval_s=0.05), events)
    check_steps(steps)
    assert steps[1].stamp_ns == ns(1.23)
    assert steps[1].sightings


def test_an_online_step_comes_soon():
    target = stepper()
    worst = 0
    for event in robot(np.random.default_rng(3), camera_latency=0.03):
        for step in target.push(event):
            worst = max(worst, event.received_ns - step.stamp_ns)
    assert worst < ns(0.16)


def test_a_keyframe_does_not_wait_for_the_next_command():
    """The command before it holds: at 4 commands a second a keyframe is closed by the odometry, 20 ms apart."""
    target = stepper()
    waits = []
    for event in in_order_of_receipt(
        [odometry(t) for t in times(1, 9, 50)],
        [command(t, 0.2, received=t + 0.002) for t in times(1.001, 9, 4)],
        [corners(t, received=t + 0.03) for t in times(1.26, 9, 5)],
    ):
        steps = target.push(event)
        waits += [event.received_ns - step.stamp_ns for step in steps if step.sightings]
    assert len(waits) > 30
    assert max(waits[5:]) <= ns(0.05)


def test_a_late_command_holds_from_the_next_keyframe_on():
    events = in_order_of_receipt(
        [odometry(t) for t in times(1, 4, 50)],
        [command(t, 0.2, received=t + 0.002) for t in times(1.001, 4, 10) if abs(t - 2.501) > 0.01],
        [command(2.501, 0.7, received=2.75)],
        [corners(t, received=t + 0.03) for t in times(1.1, 4, 10)],
    )
    target = stepper()
    steps = run(target, events)
    check_steps(steps)
    assert target.rejections == {}
    late = [step for step in steps if any(c.v == 0.7 for c in step.controls)]
    assert ns(2.6) <= late[0].stamp_ns <= ns(2.9)


def test_sightings_alone_make_steps():
    steps = run(stepper(), [corners(t) for t in times(1, 5, 5)])
    check_steps(steps)
    assert len(steps) == 20
    assert all(step.sightings[0].stamp_ns == step.stamp_ns for step in steps)


def test_sparse_events_make_steps_of_a_second_at_most():
    target = stepper()
    events = [command(t, 0.1) for t in np.arange(1.0, 60.0, 1.7)]
    steps = run(target, events)
    check_steps(steps)
    assert {step.segment for step in steps} == {0}
    assert not target.rejections
    assert steps[-1].stamp_ns == events[-1].stamp_ns


def test_simultaneous_sightings_share_a_keyframe():
    events = in_order_of_receipt(
        [odometry(t) for t in times(1, 3, 20)],
        [corners(2.02, topic="/left"), corners(2.02, topic="/right"), range_bearing(2.02)],
    )
    steps = run(stepper(), events)
    assert [len(step.sightings) for step in steps if step.sightings] == [3]


def test_an_empty_detection_makes_no_keyframe():
    empty = CornersEvent(ns(2.03), ns(2.03), "/tags", "cam", ())
    steps = run(stepper(), in_order_of_receipt([odometry(t) for t in times(1, 3, 20)], [empty]))
    assert all(step.stamp_ns != ns(2.03) for step in steps)
    assert not any(step.sightings for step in steps)


def test_the_last_sightings_are_not_lost():
    events = [*[odometry(t) for t in times(1, 2, 20)], corners(1.96), corners(1.98)]
    steps = run(stepper(), events)
    check_steps(steps)
    assert [e.stamp_ns for step in steps for e in step.sightings] == [ns(1.96), ns(1.98)]


def test_other_events_are_ignored():
    target = stepper()
    assert target.push(image(1.0)) == []
    assert target.flush() == []


def test_a_sensor_that_is_always_late_is_waited_for():
    """Odometry that arrives, by its stamps, 0.3 s behind the camera is not lost for good."""
    odometries = [odometry(t, received=t + 0.3) for t in times(1, 21, 20)]
    tags = [corners(t, received=t) for t in times(1.01, 21, 30)]
    target = stepper(reorder_s=0.1)
    steps = run(target, in_order_of_receipt(odometries, tags))
    check_steps(steps)
    assert target.rejections["odometry.late"] <= 10
    assert any("/odom" in note and "waited for" in note for note in target.notes)
    held = {id(e) for step in steps for e in step.of(OdometryEvent)}
    assert len(held) >= len(odometries) - 10


def test_first_stamps_that_nothing_confirms_are_forgotten():
    target = stepper()
    steps = run(target, [odometry(5e8, received=1.0), *[odometry(t) for t in times(1.05, 4, 20)]])
    check_steps(steps)
    assert {step.segment for step in steps} == {0}
    assert steps[0].stamp_ns == ns(1.05)
    assert len(target.notes) == 1


def test_minimal_interval_of_zero_is_allowed():
    events = in_order_of_receipt([odometry(t) for t in times(1, 3, 20)], [corners(2.02), corners(2.02, received=2.1)])
    target = stepper(min_interval_s=0.0)
    steps = run(target, events)
    check_steps(steps, min_interval_s=1e-9)
    assert target.rejections == {"sightings.duplicate": 1}


@pytest.mark.parametrize("seed", range(15))
def test_whatever_comes_the_steps_are_sound(seed):
    """Random delays, losses, duplicates, strays and pauses: nothing is handed over twice or vanishes uncounted."""
    rng = np.random.default_rng(seed)
    events = robot(rng, seconds=20.0)
    chaos = []
    for event in events:
        if rng.random() < 0.05 or 106.0 < event.stamp_ns * 1e-9 < 106.0 + seed:
            continue
        received = event.received_ns + (ns(rng.exponential(0.4)) if rng.random() < 0.05 else 0)
        fields = {f.name: getattr(event, f.name) for f in dataclasses.fields(event)}
        moved = type(event)(**(fields | dict(received_ns=received)))
        chaos.append(moved)
        if rng.random() < 0.02:
            chaos.append(type(event)(**(fields | dict(received_ns=received + 1))))
        if rng.random() < 0.003:
            chaos.append(type(event)(**(fields | dict(stamp_ns=event.stamp_ns + ns(rng.uniform(1, 1e4))))))
    chaos.sort(key=lambda e: e.received_ns)
    target = stepper()
    steps = run(target, chaos)
    check_steps(steps)
    assert {step.segment for step in steps} == {0}
    given = sum(isinstance(e, CornersEvent) for e in chaos)
    handed = [id(e) for step in steps for e in step.sightings]
    assert len(handed) == len(set(handed))
    lost = sum(n for reason, n in target.rejections.items() if reason.startswith("sightings."))
    assert len(handed) + lost == given
    assert sum(target.rejections.values()) < 0.2 * len(chaos)
    assert same(steps, run(stepper(), chaos))


def test_fault_24_memory_stays_bounded():
    target = stepper()
    sizes = []
    tracemalloc.start()
    try:
        for minute in range(12):
            for t in times(60.0 * minute + 1, 60.0 * minute + 61, 10):
                target.push(odometry(t))
                target.push(corners(t + 0.01))
                if round(t * 10) % 50 == 0:
                    target.push(odometry(t + 1e5, received=t))
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[-1] < 1.05 * sizes[2] + 20_000


@pytest.mark.parametrize("causal", [True, False])
def test_a_whole_recording_has_the_motion_within_a_silence_of_the_wheels(causal):
    """Commands go on for 4 s in which no joints come, and the wheels turn on.

    Who waits for no message measures those steps again.
    """
    heard = [t for t in times(100.0, 112.0, 20) if not 104.0 < t < 108.0]
    events = in_order_of_receipt(
        [joints(t, t - 100.0, t - 100.0) for t in heard],
        [command(t, 0.1) for t in times(100.0, 112.0, 10)],
    )
    wheels = WheelMotion(WheelsConfig(source="ticks", left_radius=0.1, right_radius=0.1, track=0.3))
    unknown_s, again = 0.0, []
    steps = run(KeyframeBuilder(KeyframesConfig(), GateConfig(), 10.0, causal=causal), events)
    for step in steps:
        wheels.measure(step)
        unknown_s, again = max(unknown_s, wheels.unknown_s), again + wheels.measured_again
    assert ((unknown_s > 1.0), bool(again)) == (causal, causal)
    assert wheels.unknown_s == pytest.approx(0.0, abs=1e-9)
    assert sum(m.motion[0] for m in map(wheels.measure, steps) if m is not None) == pytest.approx(1.195, abs=0.01)


def test_a_source_of_a_whole_recording_that_ends_is_not_waited_for_to_the_end():
    events = in_order_of_receipt(
        [odometry(t, twist=(0.5, 0.1)) for t in times(100.0, 140.0, 20)], [imu(t) for t in times(100.0, 110.0, 50)]
    )
    builder = KeyframeBuilder(KeyframesConfig(), GateConfig(), 10.0, causal=False)
    late_s = [(e.stamp_ns - s.stamp_ns) * 1e-9 for e in events for s in builder.push(e)]
    assert 9.0 < max(late_s) < 11.0
    assert late_s[-1] < 11.0
