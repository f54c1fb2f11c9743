"""Copies of a robot's own messages with other stamps or frames do not move it; what only looks like one is used."""

import dataclasses

import numpy as np
import pytest
from event_makers import command, odometry
from live_feed import ROLES, errors, feed, in_order, live_in, received
from robot_world import START_NS, TURN, World, beacons, config, room

from fgloc.live import Live
from fgloc.sensors.gyro import ImuEvent
from fgloc.types import Mode, SightingsEvent

SECOND = 1_000_000_000
SECONDS = 10.0
WORLDS = {"markers": room, "beacons": beacons}


@pytest.fixture(scope="module", params=list(WORLDS))
def world(request):
    return World(WORLDS[request.param](), seed=5, seconds=SECONDS, rate=5)


@pytest.fixture(scope="module")
def orderly(world):
    with live_in(world) as live:
        made = feed(live, world.events())
        assert not copies_in(live)
    return errors(world, made).mean()


def copies_in(live) -> int:
    """Messages that were rejected as copies; the notes say so for the topic."""
    status = live.status()
    count = status.rejections.get("sightings.copy", 0)
    said = [note for note in status.notes if "repeat an earlier one to the digit" in note]
    assert bool(count) == bool(said)
    assert all(note.startswith(("/tags: ", "/landmarks: ")) for note in said)
    return count


def copied(event, back_s: float, now_ns: int):
    """The event, sent again now with a stamp so long ago."""
    return dataclasses.replace(event, stamp_ns=now_ns - round(back_s * SECOND), received_ns=now_ns)


def with_copies(events, back_s: float, each: int):
    """So many copies of each sightings message, with stamps before it, by whatever else comes until the next."""
    made, last, sent = [], None, 0
    for event in events:
        made.append(event)
        if isinstance(event, SightingsEvent):
            last, sent = (event, 0) if event.sightings else (None, 0)
        elif last is not None and sent < each:
            frame = last.frame_id if sent % 2 else f"{last.frame_id}_{sent}"
            made.append(dataclasses.replace(copied(last, back_s, event.received_ns), frame_id=frame))
            sent += 1
    return made


@pytest.mark.parametrize("back_s", [0.9, 4.0])
def test_copies_of_sightings_with_earlier_stamps_are_rejected_and_named(back_s, world, orderly):
    events = with_copies(world.events(), back_s, 8)
    sent = len(events) - len(world.events())
    assert sent > 150
    with live_in(world) as live:
        made = feed(live, events)
        assert copies_in(live) == sent
    assert {e.mode for e in made[5:]} == {Mode.OK}
    assert errors(world, made).mean() == pytest.approx(orderly)


def test_a_message_whose_stamp_a_stray_copy_took_is_known_to_copies(world):
    """A copy from 0.9 s ahead has the stamp of a later message, which is then a duplicate; its copies are found."""
    events = world.events()
    sightings = [e for e in events if isinstance(e, SightingsEvent) and e.sightings]
    pairs = [(a, b) for a in sightings for b in sightings[::3] if b.stamp_ns - a.stamp_ns == SECOND]
    early = [dataclasses.replace(a, stamp_ns=b.stamp_ns, received_ns=a.received_ns + 1) for a, b in pairs]
    late = [copied(e, 0.9, e.received_ns + 1) for e in sightings for _ in range(3)]
    with live_in(world) as live:
        made = feed(live, in_order([*events, *early, *late]))
        assert copies_in(live) == len(late)
        assert live.status().rejections["sightings.duplicate_stamp"] == len(early) > 10
    assert errors(world, made[5:]).max() < 0.15


def test_two_detectors_of_one_topic_with_other_delays_are_both_used(world, orderly):
    """Each sees at stamps of its own; one is 0.6 s slower, so that stamps go back at each of its messages."""
    by_s = 0.05
    later = World(world.map, seed=9, seconds=SECONDS, rate=5, start_ns=START_NS + round(by_s * SECOND), start_s=by_s)
    slow = [received(e, 0.6) for e in later.events() if isinstance(e, SightingsEvent)]
    with live_in(world) as live:
        made = feed(live, in_order([*world.events(), *slow]))
        assert not copies_in(live)
        assert live.status().rejections.get("sightings.late", 0) == 0
    assert errors(world, made).mean() < 1.2 * orderly + 0.002


def test_a_robot_that_stands_before_a_sensor_without_noise_repeats_itself(world):
    """Messages have the same values with other stamps, and overtake each other; none is lost."""
    still, made = None, []
    for event in world.events():
        if isinstance(event, SightingsEvent):
            still = still or event
            event = dataclasses.replace(still, stamp_ns=event.stamp_ns, received_ns=event.received_ns)
        elif event.topic == "/odom":
            event = dataclasses.replace(event, linear=np.zeros(3), angular=np.zeros(3))
        else:
            event = dataclasses.replace(event, v=0.0, omega=0.0)
        made.append(event)
    rng = np.random.default_rng(4)
    shuffled = in_order(received(e, rng.uniform(0.0, 0.06)) for e in made)
    with live_in(world) as live:
        poses = np.array([e.pose for e in feed(live, shuffled)])
        assert not copies_in(live)
        assert live.status().rejections.get("sightings.late", 0) == 0
    assert np.ptp(poses[5:, :2], axis=0).max() < 0.02


def test_a_recording_that_is_played_again_is_no_copy(world):
    """Events of a bag that is played twice, as by `ros2 bag play --loop`: the same stamps, received later."""
    events = [e for e in world.events() if e.stamp_ns < START_NS + 6 * SECOND]
    with live_in(world) as live:
        made = feed(live, [*events, *(received(e, 6.0) for e in events)])
        assert not copies_in(live)
    assert len(made) > 50
    assert errors(world, made[-20:]).max() < 0.15


def test_a_detector_whose_clock_jumps_once_goes_on(world, orderly):
    """Its clock is set back by 0.4 s in the middle and stays so, as by a first synchronisation."""

    def jumped(event):
        late = isinstance(event, SightingsEvent) and event.received_ns > START_NS + 5 * SECOND
        return received(event, 0.4) if late else event

    with live_in(world) as live:
        made = feed(live, in_order(map(jumped, world.events())))
        assert not copies_in(live)
        assert live.status().rejections.get("sightings.late", 0) == 0
    assert errors(world, made).mean() < 1.3 * orderly + 0.002


# --- Frames -----------------------------------------------------------------------------------------------------------


def imu(stamp_ns: int, rate: float, frame: str) -> ImuEvent:
    return ImuEvent(
        stamp_ns, stamp_ns, "/imu", frame, np.array([0.0, 0.0, rate]), np.array([0.0, 0.0, 9.81]), np.eye(3) * 1e-6
    )


def with_imu(world, until_s: float, ghosts: int, from_s: float = 0.0):
    """Events with an IMU at 20 Hz up to a time, and messages of another frame from a time on, so many to each."""
    made = [*world.events()]
    for k in range(round(SECONDS * 20)):
        stamp = START_NS + k * 50_000_000 + 1
        if k / 20 < until_s:
            made.append(imu(stamp, TURN, "base_link"))
        if k / 20 >= from_s:
            made += [imu(stamp + 1 + n * 1_000_000, 0.0 if ghosts > 1 else TURN, "other") for n in range(ghosts)]
    return in_order(made)


def test_an_imu_that_goes_on_is_not_replaced_by_one_of_another_frame_that_sends_more_often(world, orderly):
    with live_in(world, config(), roles=(*ROLES, "imu")) as live:
        made = feed(live, with_imu(world, SECONDS, 40))
        assert live.status().rejections["imu.frame"] == 40 * SECONDS * 20
    assert errors(world, made).mean() < 1.3 * orderly + 0.002


def test_an_imu_of_another_frame_takes_over_once_the_first_is_silent(world):
    with live_in(world, config(), roles=(*ROLES, "imu")) as live:
        made = feed(live, with_imu(world, 4.0, 1, from_s=4.0))
        assert 19 <= live.status().rejections["imu.frame"] <= 21
    assert made[-1].mode is Mode.OK


# --- Publishers -------------------------------------------------------------------------------------------------------


def test_of_two_publishers_the_first_is_used_until_it_has_been_silent_for_a_second():
    def odom(k):
        return odometry(1.0 + 0.25 * k)

    with Live(config(), beacons(), roles=ROLES) as live:
        used = [bool(live.push(odom(k), "b" if k in (1, 3) else "a")) for k in range(4)]
        assert used == [True, False, True, False]
        assert live.status().dropped["odometry"] == 2
        assert [bool(live.push(odom(k), name)) for k, name in ((6, "b"), (7, "a"), (8, "b"))] == [True, False, True]
        assert [bool(live.push(e, "c")) for e in (command(3.1), command(3.2))] == [True, True]  # another topic
