"""Late, doubled, lost, out of order, in bursts, with clocks reset, twice over: a live run goes on and stays right."""

import dataclasses
import re

import numpy as np
import pytest
from live_feed import ROLES, errors, feed, in_order, live_in, received
from robot_world import START_NS, World, beacons, config, room

from fgloc.config import Config, LiveConfig
from fgloc.live import Live
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Mode

SECOND = 1_000_000_000
SECONDS = 10.0


@pytest.fixture(scope="module")
def world():
    return World(room(), seed=5, seconds=SECONDS, rate=5)


@pytest.fixture(scope="module")
def orderly(world):
    with live_in(world) as live:
        made = feed(live, world.events())
    return errors(world, made).mean()


def after(event) -> float:
    """When an event is received [s]."""
    return (event.received_ns - START_NS) * 1e-9


def disorder(name, events, rng):
    """The events as they arrive where this goes wrong."""
    if name == "late":
        return [received(e, 0.25) if rng.random() < 0.05 else e for e in events]
    if name == "shuffled":
        return [received(e, rng.uniform(0.0, 0.06)) for e in events]
    if name == "doubled":
        return events + [received(e, rng.uniform(0.0, 0.3)) for e in events if rng.random() < 0.2]
    if name == "lost":
        return [e for e in events if rng.random() > 0.1]
    if name == "late camera":
        return [received(e, 0.3) if isinstance(e, CornersEvent) else e for e in events]
    if name == "stall":
        return [received(e, 6.0 - after(e)) if 4.5 < after(e) < 6.0 else e for e in events]
    if name == "stall of topics":
        order = {"/tags": 0.02, "/odom": 0.0, "/cmd_vel": 0.01}
        held = [received(e, 6.0 + order[e.topic] - after(e)) if 4.5 < after(e) < 6.0 else e for e in events]
        return held
    raise ValueError(name)


@pytest.mark.parametrize("name", ["late", "shuffled", "doubled", "lost", "late camera", "stall", "stall of topics"])
def test_what_goes_wrong_on_the_way_hardly_shows(name, world, orderly):
    events = in_order(disorder(name, world.events(), np.random.default_rng(2)))
    with live_in(world) as live:
        made = feed(live, events)
        status = live.status()
    stamps = [e.stamp_ns for e in made]
    assert stamps == sorted(set(stamps))
    assert not [note for note in status.notes if "jumped" in note]
    assert errors(world, made).mean() < 1.3 * orderly + 0.002
    assert made[-1].mode is Mode.OK
    assert len(made) > 35


def test_the_reordering_delay_follows_what_is_measured(world):
    """A camera that is 300 ms late is waited for; while it is on time the delay is a camera's period at most."""
    delays = {}
    for late_s in (0.0, 0.3):
        events = in_order(received(e, late_s) if isinstance(e, CornersEvent) else e for e in world.events())
        with live_in(world) as live:
            measured = []
            live.subscribe(lambda _, live=live, measured=measured: measured.append(live.status().reordering_s))
            feed(live, events)
        delays[late_s] = np.median(measured)
    assert delays[0.0] < 0.15
    assert 0.2 < delays[0.3] < 0.5


def test_a_publisher_that_restarts_with_its_clock_reset_goes_on(world, orderly):
    """The base's driver is away for half a second; its clock then begins at zero."""

    def restarted(event):
        if isinstance(event, OdometryEvent) and after(event) >= 5.0:
            return dataclasses.replace(event, stamp_ns=event.stamp_ns - START_NS - 5 * SECOND + 1)
        return event

    events = [restarted(e) for e in world.events() if not (isinstance(e, OdometryEvent) and 5.0 <= after(e) < 5.5)]
    with live_in(world) as live:
        made = feed(live, events)
        notes = live.status().notes
    assert [n for n in notes if re.match(r"/odom: .*\bclock\b", n)]
    assert not [n for n in notes if "clock jumped" in n]
    late = [e for e in made if e.stamp_ns > START_NS + 6.5 * SECOND]
    assert len(late) > 12
    assert {e.mode for e in late} == {Mode.OK}
    assert errors(world, late).mean() < 1.5 * orderly + 0.002


def test_after_a_jump_of_the_common_clock_the_robot_is_found_again(world):
    """Simulated time starts over: nothing connects what was with what comes."""

    def jumped(event):
        shift = 1000 * SECOND if after(event) >= 6.0 else 0
        return dataclasses.replace(event, stamp_ns=event.stamp_ns - shift, received_ns=event.received_ns + shift // 500)

    with live_in(world) as live:
        made = feed(live, [jumped(e) for e in world.events()])
        notes = live.status().notes
    assert [n for n in notes if re.search(r"\bclock\b.* (1000\.0|999\.9) s\b", n)]
    again = [dataclasses.replace(e, stamp_ns=e.stamp_ns + 1000 * SECOND) for e in made if e.stamp_ns < START_NS]
    assert len(again) > 10
    assert again[-1].mode is Mode.OK
    assert errors(world, again[-10:]).max() < 0.06


def test_of_two_publishers_of_a_topic_the_first_is_used_while_it_speaks(world, orderly):
    """A joystick's node publishes zeros on the same topic as the controller, and goes on when that ends."""
    with live_in(world) as live:
        made = []
        live.subscribe(made.append)
        for event in world.events():
            if isinstance(event, OdometryEvent):
                wrong = dataclasses.replace(event, stamp_ns=event.stamp_ns + 1, linear=np.zeros(3), angular=np.zeros(3))
                live.push(event, "base")
                live.push(wrong, "ghost")
            else:
                live.push(event)
        assert live.wait(60.0)
        status = live.status()
    assert status.dropped["odometry"] == sum(isinstance(e, OdometryEvent) for e in world.events())
    assert [n for n in status.notes if n.startswith("/odom: two publishers")]
    assert errors(world, made).mean() == pytest.approx(orderly)


def test_another_publisher_takes_over_once_the_first_is_gone(world):
    with live_in(world) as live:
        for event in world.events():
            live.push(event, "first" if after(event) < 5.0 else "second")
        assert live.wait(60.0)
        status = live.status()
    assert status.dropped["odometry"] == pytest.approx(20, abs=1)  # of the second before that was clear


def test_a_player_that_is_started_again_is_heard_at_once(world):
    """The clock of all starts over with it, by more than the silence that ends a publisher."""

    def earlier(event, ns):
        return dataclasses.replace(event, stamp_ns=event.stamp_ns - ns, received_ns=event.received_ns - ns)

    events = list(world.events())
    with live_in(world) as live:
        for event in [e for e in events if after(e) < 6.0]:
            live.push(event, "first")
        for event in [e for e in events if after(e) >= 6.0]:
            live.push(earlier(event, 5 * SECOND), "second")
        assert live.wait(60.0)
        status = live.status()
    assert not status.dropped.get("odometry")
    assert not [n for n in status.notes if "two publishers" in n]


def test_a_second_topic_of_a_role_is_not_mixed_in(world, orderly):
    def twin(event):
        return dataclasses.replace(event, topic="/other_odom", linear=-event.linear, stamp_ns=event.stamp_ns + 1)

    both = [e for event in world.events() for e in ([event, twin(event)] if event.topic == "/odom" else [event])]
    with live_in(world) as live:
        made = feed(live, both)
        status = live.status()
    assert [n for n in status.notes if re.match(r"/other_odom: .*\bodometry\b", n)]
    assert status.dropped["odometry"] == 200
    assert errors(world, made).mean() == pytest.approx(orderly)


def test_the_configured_topic_is_used_whichever_comes_first(world, orderly):
    def twin(event):
        return dataclasses.replace(event, topic="/other_odom", linear=-event.linear)

    both = [e for event in world.events() for e in ([twin(event), event] if event.topic == "/odom" else [event])]
    settings = config(recording={"topics": {"odometry": "/odom", "command": "none"}})
    with live_in(world, settings, roles=("odometry", "sightings")) as live:
        made = feed(live, both)
        status = live.status()
    assert not [n for n in status.notes if "second topic" in n]
    assert status.dropped == {"odometry": 200, "command": 100}
    assert errors(world, made).mean() < 1.3 * orderly + 0.002


def test_wheels_and_an_arm_may_share_a_topic():
    world = World(beacons(), seconds=6.0)
    radius, track, angle, events = 0.05, 0.3, np.zeros(2), []
    settings = config(wheels={"source": "ticks", "left_radius": radius, "right_radius": radius, "track": track})
    for event in world.events():
        if isinstance(event, OdometryEvent):
            v, w = event.linear[0], event.angular[2]
            angle = angle + 0.05 * np.array([v - 0.5 * track * w, v + 0.5 * track * w]) / radius
            names, stamp = ("left_wheel", "right_wheel"), event.stamp_ns
            events.append(JointsEvent(stamp, stamp, "/joints", names, angle, np.zeros(2), np.zeros(2)))
            events.append(JointsEvent(stamp + 1, stamp, "/joints", ("arm",), np.zeros(1), np.zeros(1), np.zeros(1)))
        elif not isinstance(event, ControlEvent):
            events.append(event)
    with Live(settings, world.map, roles=("joints", "sightings")) as live:
        made = []
        live.subscribe(made.append)
        for event in events:
            live.push(event, "arm" if isinstance(event, JointsEvent) and event.names == ("arm",) else "base")
        assert live.wait(60.0)
        assert live.status().dropped == {}
    assert errors(world, made).mean() < 0.08


def test_in_simulated_time_all_goes_by_the_stamps():
    """Stamps begin at a second, receive times are of the wall; simulated time runs at a third."""
    world = World(beacons(), seconds=8.0, start_ns=SECOND)
    wall = 1_700_000_000 * SECOND
    events = [dataclasses.replace(e, received_ns=wall + 3 * e.stamp_ns) for e in world.events()]
    with Live(config(), world.map, roles=ROLES) as live:
        made = feed(live, events)
        assert live.pose_at().stamp_ns <= 9 * SECOND
        assert not [n for n in live.status().notes if "clock" in n]
    assert errors(world, made).mean() < 0.08


def test_an_unknown_role_is_waited_for_no_longer_than_told():
    world = World(beacons(), seconds=6.0)
    with Live(Config(live=LiveConfig(startup_s=1.5)), world.map, roles=("odometry", "imu")) as live:
        events = world.events()
        early = [e for e in events if after(e) < 1.4]
        feed(live, early)
        assert [what.split(":")[0] for what in live.status().waiting_for] == ["imu"]
        assert not live.status().running
        made = feed(live, events[len(early) :])
        assert live.status().running
    assert made[-1].mode is Mode.OK
