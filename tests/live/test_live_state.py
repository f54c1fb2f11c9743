"""Saved and resumed: the pose goes on over the time away, and what is damaged or foreign is refused."""

import dataclasses
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
from live_feed import ROLES, errors, feed, live_in
from robot_world import START_NS, World, beacons, config, nees, room
from wire import wait_until

from fgloc.errors import OutputError
from fgloc.live import Live
from fgloc.live.state import carried_over, fingerprint, read_state
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Mode, Step

GAP = (6.0, 9.0)  # s, nothing listens


@pytest.fixture(scope="module")
def world():
    return World(room(), seed=4, seconds=12.0)


def between(world, start, end):
    """The events of a time [s]."""
    return [e for e in world.events() if start <= (e.received_ns - START_NS) * 1e-9 < end]


@pytest.fixture(scope="module")
def saved(world, tmp_path_factory):
    """State after the first part of the drive."""
    path = tmp_path_factory.mktemp("state") / "state.json"
    with live_in(world, state=path) as live:
        feed(live, between(world, 0.0, GAP[0]))
    return path


def resumed(world, path, events, **options):
    """A second run from that state, and its notes."""
    with live_in(world, state=path, **options) as live:
        made = feed(live, events)
        notes = live.status().notes
    return made, notes


def known_m(note):
    """How well [m] the pose is known after the gap, by the note on it; None: not at all."""
    assert re.search(r"\b\d+\.\d s\b", note)  # the gap
    known = re.findall(r"(\d+\.\d+) m\b", note)
    return float(known[0]) if known else None


def copied(path, tmp_path):
    """The state, to be written over."""
    target = tmp_path / "state.json"
    target.write_bytes(path.read_bytes())
    return target


def test_while_the_odometry_goes_on_it_tells_the_motion_of_the_gap(world, saved, tmp_path):
    blind = [e for e in between(world, GAP[1], 10.0) if e.topic != "/tags"]
    made, notes = resumed(world, copied(saved, tmp_path), blind, roles=("odometry", "command"))
    assert known_m(notes[0]) < 0.2  # at its speed it may have gone a metre and more
    assert errors(world, made[:1])[0] < 0.1
    assert made[0].mode is Mode.OK
    assert nees(made[0], world.truth(made[0].stamp_ns)) < 12.0
    before = np.array(read_state(saved, fingerprint(world.map)).state.cov)
    assert np.trace(made[0].cov) > 2.0 * np.trace(before)


def test_with_sightings_it_goes_on_without_a_search(world, saved, tmp_path):
    made, notes = resumed(world, copied(saved, tmp_path), between(world, GAP[1], 12.0))
    assert {e.mode for e in made} == {Mode.OK}
    assert made[0].stamp_ns - START_NS < (GAP[1] + 0.3) * 1e9
    assert errors(world, made[1:]).max() < 0.08
    assert not [n for n in notes if "jumped" in n]


def test_an_odometry_that_was_set_to_zero_tells_nothing(world, saved, tmp_path):
    """It begins anew at the origin: taken at its word, it would put the robot back to where its frame began."""

    def zeroed(event):
        if not isinstance(event, OdometryEvent):
            return event
        moved = np.array([0.01 * (event.stamp_ns * 1e-9 - START_NS * 1e-9 - GAP[1]), 0.0, 0.0])
        return dataclasses.replace(event, position=moved, orientation=np.array([0.0, 0.0, 0.0, 1.0]))

    events = [zeroed(e) for e in between(world, GAP[1], 12.0)]
    made, notes = resumed(world, copied(saved, tmp_path), events)
    assert known_m(notes[0]) is None  # it may be anywhere that it can have driven to
    assert errors(world, made[5:]).max() < 0.1
    assert made[-1].mode is Mode.OK


def test_a_robot_that_stood_when_the_state_was_saved_may_drive_meanwhile(saved, world):
    """Nothing has measured the motion: it is capable of half a metre and half a radian in a second at least."""
    stood = read_state(saved, fingerprint(world.map)).state.model_copy(update={"fastest": (0.0, 0.0), "odometry": None})
    belief, _ = carried_over(stood, Step(0, 0, stood.stamp_ns, stood.stamp_ns + 10**9), config(), stood.saved_ns)
    added = np.sqrt(np.diag(belief.cov - np.array(stood.cov)))
    assert added == pytest.approx(0.5, rel=0.01)
    assert np.array_equal(belief.pose, stood.pose)


def test_after_a_long_time_the_map_is_searched(world, saved, tmp_path):
    """The robot was switched off overnight and carried; its odometry begins anew."""
    night = 36_000_000_000_000

    def next_day(event):
        later = dict(stamp_ns=event.stamp_ns + night, received_ns=event.received_ns + night)
        fresh = dict(frame_id="odom_2") if isinstance(event, OdometryEvent) else {}
        return dataclasses.replace(event, **later, **fresh)

    made, notes = resumed(world, copied(saved, tmp_path), [next_day(e) for e in between(world, 2.0, 6.0)])
    assert known_m(notes[0]) is None
    back = [dataclasses.replace(e, stamp_ns=e.stamp_ns - night) for e in made]
    assert errors(world, back[-10:]).max() < 0.06


def test_a_robot_that_was_carried_away_meanwhile_is_found_again(world, saved, tmp_path):
    """The odometry saw nothing of it: sightings contradict the resumed pose, and win."""
    carried = dataclasses.replace(world, kidnap_s=GAP[1])
    still = [e for e in between(carried, GAP[1], 12.0) if not isinstance(e, OdometryEvent)]
    still += [e for e in between(world, GAP[1], 12.0) if isinstance(e, OdometryEvent)]
    made, notes = resumed(carried, copied(saved, tmp_path), sorted(still, key=lambda e: e.received_ns))
    assert errors(carried, made[-10:]).max() < 0.06
    assert [n for n in notes if "jumped by" in n]


def test_what_was_learned_goes_on(world, tmp_path):
    """The gyro's bias, the installation, and a landmark that does not stand where the map has it."""
    events = between(world, 0.0, 6.0)
    rate = np.array([0.0, 0.0, 0.33 + 0.05])
    for k in range(600):
        stamp = START_NS + k * 10_000_000
        events.append(ImuEvent(stamp, stamp, "/imu", "base_link", rate, np.zeros(3), np.zeros((3, 3))))
    path, roles = tmp_path / "state.json", (*ROLES, "imu")
    with live_in(world, state=path, roles=roles) as live:
        feed(live, sorted(events, key=lambda e: e.received_ns))
        live._estimation.run.parts.localizer.sightings.modes.displacements[13] = np.array([0.4, -0.1])
        gyro = live._estimation.run.parts.localizer.motion.sources.gyro
        installed = live._estimation.run.parts.localizer.estimator.installed
    assert gyro.bias > 0.02
    with live_in(world, state=path, roles=roles) as live:
        feed(live, [e for e in events if (e.received_ns - START_NS) * 1e-9 < 0.3])
        parts = live._estimation.run.parts
        assert parts.localizer.motion.sources.gyro.bias == pytest.approx(gyro.bias, abs=0.01)
        assert parts.localizer.sightings.modes.excludes(13)
        now = np.diag(parts.localizer.estimator.installed.cov)
        assert (now <= np.diag(installed.cov) * (1.0 + 1e-6) + 1e-12).all()


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (lambda text: text[: len(text) // 2], "state.unreadable"),
        (lambda text: "", "state.unreadable"),
        (lambda text: "[1, 2]", "state.unreadable"),
        (lambda text: text.replace("0.", "1.", 1), "state.damaged"),
        (lambda text: json.dumps({"state": "{}", "sha256": "0"}), "state.damaged"),
    ],
)
def test_a_damaged_file_is_refused_and_replaced(world, saved, tmp_path, damage, code):
    path = copied(saved, tmp_path)
    path.write_text(damage(path.read_text(encoding="utf-8")), encoding="utf-8")
    read = read_state(path, fingerprint(world.map))
    assert (read.state, read.code) == (None, code)
    made, notes = resumed(world, path, between(world, GAP[1], 10.5))
    assert read.note in notes
    assert errors(world, made[-3:]).max() < 0.08
    assert read_state(path, fingerprint(world.map)).state is not None


def with_content(path, **changes):
    """The state with other values and a checksum that fits."""
    content = json.loads(json.loads(path.read_text(encoding="utf-8"))["state"])
    body = json.dumps(content | changes)
    checksum = hashlib.sha256(body.encode()).hexdigest()
    path.write_text(json.dumps({"state": body, "sha256": checksum}), encoding="utf-8")


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"version": 2}, "state.version"),
        ({"format": "another"}, "state.version"),
        ({"extra": 1}, "state.version"),
        ({"pose": [0.0, 0.0]}, "state.version"),
        ({"cov": [[1, 2, 0], [2, 1, 0], [0, 0, 1]]}, "state.covariance"),
        ({"cov": [[0, 0, 0], [0, 0, 0], [0, 0, 0]]}, "state.covariance"),
        ({"installation": {"names": ["a"], "mean": [0.0], "cov": [[1.0, 2.0]]}}, "state.covariance"),
    ],
)
def test_values_that_cannot_be_used_are_refused(world, saved, tmp_path, changes, code):
    path = copied(saved, tmp_path)
    with_content(path, **changes)
    read = read_state(path, fingerprint(world.map))
    assert (read.state, read.code) == (None, code)
    [key] = changes
    assert code != "state.version" or key in read.note


@pytest.mark.parametrize("off", [np.diag([-1.0] * 3), np.eye(3, k=1)], ids=["zero", "not symmetric"])
def test_a_covariance_that_is_none_is_refused(world, saved, tmp_path, off):
    path = copied(saved, tmp_path)
    with_content(path, cov=(np.eye(3) + off).tolist())
    assert read_state(path, fingerprint(world.map)).code == "state.covariance"


def test_landmarks_that_were_moved_are_saved(tmp_path):
    world, path = World(beacons(), seconds=2.0), tmp_path / "state.json"
    with live_in(world) as live:
        feed(live, world.events())
        live._estimation.run.parts.localizer.sightings.modes.displacements[3] = np.array([0.4, -0.1])
        assert live.save(path)
    assert read_state(path, fingerprint(world.map)).state.excluded == {3: (0.4, -0.1)}


def test_the_state_is_saved_while_the_run_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr("fgloc.live.engine._SAVE_EVERY_S", 0.05)
    world, path = World(beacons(), seconds=2.0), tmp_path / "state.json"
    with live_in(world, state=path) as live:
        feed(live, world.events())
        assert wait_until(path.exists, 10.0)


def test_a_state_of_another_map_is_refused(saved):
    read = read_state(saved, fingerprint(beacons()))
    assert (read.state, read.code) == (None, "state.other_map")
    assert str(saved) in read.note


def test_without_a_pose_an_old_state_is_kept(world, saved, tmp_path):
    """The robot is started and stopped at once: what an earlier run knew is not lost."""
    path = copied(saved, tmp_path)
    before = path.read_bytes()
    with live_in(world, state=path):
        pass
    assert path.read_bytes() == before


def test_a_file_that_cannot_be_written_is_told(world, tmp_path):
    target = tmp_path / "folder"
    target.mkdir()
    live = live_in(world, state=None)
    feed(live, between(world, 0.0, 3.0))
    with pytest.raises(OutputError, match=re.escape(str(target))):
        live.save(target)
    assert live.save(tmp_path / "state.json")
    live.close()


def test_killed_at_any_time_it_leaves_a_state_that_can_be_used(tmp_path):
    """kill -9 while the state is written again and again."""
    path = tmp_path / "state.json"
    code = f"""
        import sys
        sys.path[:0] = {[str(Path(__file__).parent.parent / "support")]!r}
        from pathlib import Path
        from live_feed import feed, live_in
        from robot_world import World, beacons
        live = live_in(World(beacons(), seconds=4.0))
        feed(live, World(beacons(), seconds=4.0).events())
        live.save(Path({str(path)!r}))
        print("driving", flush=True)
        while True:
            live.save(Path({str(path)!r}))
    """
    for wait in (0.02, 0.05):
        child = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True)
        assert child.stdout.readline() == "driving\n"
        try:
            child.wait(wait)
        except subprocess.TimeoutExpired:
            os.kill(child.pid, signal.SIGKILL)
        child.wait()
        child.stdout.close()
        assert child.returncode == -signal.SIGKILL
        read = read_state(path, fingerprint(beacons()))
        assert read.state is not None, read.note
        with Live(config(), beacons(), state=path, roles=ROLES) as live:
            made = feed(live, World(beacons(), seconds=6.0).events()[-60:])
        assert made[0].mode is Mode.OK
