"""What a live run says of its sensors and of its own estimate while it goes on."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from live_feed import ROLES, exit_code, feed
from robot_world import SIGMA_BEARING, SIGMA_RANGE, START_NS, World, beacons, config, polar

from fgloc import se2
from fgloc.cli.terminal import EXIT_LOST
from fgloc.diagnosis.mistakes import Diagnosis
from fgloc.estimation.localizer import Localizer
from fgloc.frames import yaw_quaternion
from fgloc.live import Live
from fgloc.live.engine import LiveStatus
from fgloc.live.wire.node import described
from fgloc.recording.standard_messages import diagnostics
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Finding, Mode, Protection, Severity, SightingsEvent, Step

PATIENCE_S = 30.0


def swerving(stands_s: float = 0.0, seconds: float = 18.0):
    """Odometry at 20 Hz and sightings at 10 Hz of a robot that stands, then drives, turning either way."""
    rng, pose, made = np.random.default_rng(2), np.zeros(3), []
    for tick in range(round((stands_s + seconds) * 20)):
        t = 0.05 * tick - stands_s
        v, omega = (0.0, 0.0) if t < 0.0 else (0.3 + 0.2 * np.sin(0.9 * t), 0.25 + 0.5 * np.sin(0.6 * t))
        stamp = START_NS + tick * 50_000_000
        twist = np.array([v, 0.0, 0.0]), np.array([0.0, 0.0, omega])
        place = np.append(pose[:2], 0.0), yaw_quaternion(pose[2]), np.zeros((6, 6))
        made.append(OdometryEvent(stamp, stamp, "/odom", "odom", "base_link", *place, *twist, np.zeros((6, 6))))
        if tick % 2 == 0:
            seen = [(i, *polar(pose, landmark)) for i, landmark in beacons().landmarks.items()]
            noise = rng.normal(0.0, (SIGMA_RANGE, SIGMA_BEARING), (len(seen), 2))
            found = [RangeBearing(i, r + n, se2.wrap(b + m)) for (i, r, b), (n, m) in zip(seen, noise, strict=True)]
            made.append(RangeBearingEvent(stamp, stamp, "/landmarks", "base_link", tuple(found)))
        pose = se2.compose(pose, se2.exp((0.05 * v, 0.0, 0.05 * omega)))
    return made


def mirrored(event):
    """Bearings that count to the right."""
    if not isinstance(event, SightingsEvent):
        return event
    seen = tuple(dataclasses.replace(s, bearing_rad=-s.bearing_rad) for s in event.sightings)
    return dataclasses.replace(event, sightings=seen)


def named(live, code: str) -> Finding | None:
    """A finding of a live run, waited for."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        for finding in live.status().findings:
            if finding.code == code:
                return finding
        time.sleep(0.1)
    return None


def test_however_long_the_robot_stood_it_takes_twenty_seconds_of_motion_at_most():
    stands_s = 21.0  # a comparison while it stands tells nothing, and the next by time alone comes after 40 s
    diagnosis = Diagnosis(config(), beacons())
    made = swerving(stands_s, 16.0)
    for k, event in enumerate(map(mirrored, made)):
        diagnosis.add(event)
        if isinstance(event, OdometryEvent):
            step = Step(k, 0, event.stamp_ns - 50_000_000, event.stamp_ns)
            motion = 0.05 * np.array([event.linear[0], 0.0, event.angular[2]])
            diagnosis.observe(step, motion=motion)
            if diagnosis.findings(ended=False):
                break
    assert [f.code for f in diagnosis.found] == ["sightings.mirrored"]
    assert stands_s < (event.stamp_ns - START_NS) * 1e-9 < stands_s + 20.0


def test_each_event_is_compared_once(monkeypatch):
    add, added = Diagnosis.add, []
    monkeypatch.setattr(Diagnosis, "add", lambda self, event: (added.append(event), add(self, event))[1])
    events = swerving(seconds=2.0)
    with Live(config(), beacons(), roles=("odometry", "sightings")) as live:
        feed(live, events)
    assert [(type(e), e.stamp_ns) for e in added] == [(type(e), e.stamp_ns) for e in events]


def test_signals_are_compared_once_they_are_many_more_than_before_and_at_the_end():
    diagnosis, due = Diagnosis(config(), beacons()), []
    for event in swerving(seconds=50.0):
        diagnosis.add(event)
        if diagnosis.comparison() is not None:
            due.append((event.stamp_ns - START_NS) * 1e-9)
    assert due == pytest.approx([20.0, 40.0], abs=0.2)
    assert diagnosis.comparison(ended=True) is not None
    assert diagnosis.comparison(ended=True) is None


@pytest.mark.slow
def test_a_mirrored_sensor_is_named_live():
    with Live(config(), beacons(), roles=("odometry", "sightings")) as live:
        made = [mirrored(event) for event in swerving(seconds=26.0)]
        feed(live, made[: len(made) // 2])
        time.sleep(4.0)  # it is compared meanwhile; what little motion says has to be said twice
        feed(live, made[len(made) // 2 :])
        finding = named(live, "sightings.mirrored")
        status = live.status()
    assert finding is not None
    assert finding.severity is Severity.ERROR
    assert finding.lines
    assert status.findings[0].severity is Severity.ERROR
    assert finding.text in status.notes


def test_a_sound_live_run_has_nothing_to_say():
    with Live(config(), beacons(), roles=("odometry", "sightings")) as live:
        feed(live, swerving())
        time.sleep(3.0)
        findings = live.status().findings
    assert not [f for f in findings if f.severity is not Severity.NOTE]


def test_a_live_estimate_that_runs_away_is_replaced_by_odometry_and_named(monkeypatch):
    update = Localizer.update

    def broken(self, step):
        estimate = update(self, step)
        late = estimate is not None and step.stamp_ns > START_NS + 8_000_000_000
        return dataclasses.replace(estimate, pose=estimate.pose + np.array([1e6, 0.0, 0.0])) if late else estimate

    monkeypatch.setattr(Localizer, "update", broken)
    world = World(beacons(), seconds=15.0)
    with Live(config(), None, roles=ROLES) as live:
        made = feed(live, world.events())
        findings = live.status().findings
    assert "sanity.odometry" in {f.code for f in findings}
    assert made[-1].mode is Mode.DEAD_RECKONING
    assert np.hypot(*made[-1].pose[:2]) < 10.0


@pytest.mark.parametrize("severity", list(Severity))
def test_an_error_is_in_the_level_of_the_diagnostics_and_in_the_exit_code(severity):
    status = LiveStatus(mode=Mode.OK, findings=(Finding("sightings.mirrored", "It is mirrored.", severity),))
    message, values = described(status)
    assert ("It is mirrored." in message) == (severity is Severity.ERROR)
    assert any("sightings.mirrored" in key for key in values) == (severity is not Severity.NOTE)
    assert exit_code(status) == (EXIT_LOST if severity is Severity.ERROR else 0)
    wrong = severity is Severity.ERROR
    levels = [diagnostics(0, Mode.OK, "", {}, w)["status"][0]["level"] for w in (False, wrong)]
    assert (levels[0] != levels[1]) == wrong


def test_a_bound_above_the_limit_is_the_message_and_below_it_a_value():
    bound = Protection(np.array([0.2, 0.1, 0.03]), 0.23, "landmark 7", alert=True)
    message, values = described(LiveStatus(mode=Mode.OK, protection=bound))
    assert message.startswith("ALERT: ")
    assert "0.23 m" in message
    assert "landmark 7" in message
    assert (values["bound along [m]"], values["bound by"]) == ("0.200", "landmark 7")
    calm = LiveStatus(mode=Mode.OK, protection=dataclasses.replace(bound, alert=False))
    assert described(calm)[0] == "OK"
    assert calm.alert == ""
