"""Alignment, cleaning of truths and the answer sheet of `benchmarks.field`."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from robot_world import points
from rosbags.highlevel import AnyReader

from benchmarks import field_recordings
from benchmarks.field import Outcome, ate, crash, distances
from benchmarks.field_changes import CHANGES, MAPS, changed
from benchmarks.field_peers import Heard, clean, textbook
from benchmarks.field_recordings import RECORDINGS, Recording
from benchmarks.field_sheet import SHEET, SOUND, Trap, false_findings, found, right_cause
from fgloc import se2
from fgloc.recording.messages import default_typestore
from fgloc.sensors.maps import write_map
from fgloc.types import Trajectory
from fgloc_datasets.convert import new_bag

ARM = np.array([0.12, -0.05])
T_MAP_TRUTH = np.array([2.0, -1.0, 0.8])


def curve(n=200):
    """A figure of eight: poses ``(n, 3)`` and stamps, 10 a second."""
    t = np.linspace(0.0, 2 * np.pi, n)
    x, y = 2.0 * np.sin(t), np.sin(2 * t)
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    return np.arange(n) * 100_000_000 + 10**18, np.column_stack([x, y, yaw])


def body(poses):
    """Places of a body at `ARM` on the robot, in a frame of the truth's own."""
    arms = np.array([se2.compose(pose, (*ARM, 0.0)) for pose in poses])
    moved = np.array([se2.compose(se2.inverse(T_MAP_TRUTH), pose) for pose in arms])
    return moved[:, :2]


def test_frame_and_lever_arm_of_the_truth_are_no_error():
    _, poses = curve()
    assert distances(poses, body(poses), align=True, lever=True).max() < 1e-9


@pytest.mark.parametrize(("align", "lever"), [(True, False), (False, True), (False, False)])
def test_what_is_not_fitted_is_an_error(align, lever):
    _, poses = curve()
    assert distances(poses, body(poses), align, lever).max() > 0.05


def test_a_drift_is_not_fitted_away():
    _, poses = curve()
    drifting = poses + np.column_stack([np.linspace(0.0, 0.5, len(poses)), np.zeros((len(poses), 2))])
    error = np.sqrt(np.mean(distances(drifting, body(poses), align=True, lever=True) ** 2))
    assert 0.05 < error < 0.5


def test_ate_compares_only_where_both_are_known():
    stamps, poses = curve()
    broken = poses.copy()
    broken[100:, 0] += 5.0
    known = Trajectory(stamps[:100], poses[:100])
    assert np.isnan(ate(Trajectory(stamps[:40], poses[:40]), known, stamps, False, False, False))  # too little
    assert ate(Trajectory(stamps, broken), known, stamps, align=False, lever=False, clock=False) < 1e-9
    assert np.isnan(ate(Trajectory(stamps[150:], poses[150:]), known, stamps, False, False, False))


def test_a_clock_is_fitted_only_if_it_is_free():
    stamps, poses = curve()
    late = Trajectory(stamps + 200_000_000, poses)
    assert ate(late, Trajectory(stamps, poses), stamps, True, False, clock=False) > 0.02
    assert ate(late, Trajectory(stamps, poses), stamps, True, False, clock=True) < 1e-6


def test_repeated_poses_and_glitches_of_a_truth_are_dropped():
    stamps, poses = curve()
    poses[50:60] = poses[50]
    poses[120, :2] += 3.0
    kept = set(clean(stamps, poses).stamps_ns.tolist())
    assert set(stamps.tolist()) - kept == {int(stamps[k]) for k in (*range(51, 60), 120)}


def test_the_textbook_corrects_an_odometry_by_the_map():
    stamps, poses = curve()
    places = {1: np.array([3.0, 2.0]), 2: np.array([-3.0, -2.0]), 3: np.array([0.0, 3.0])}
    heard = Heard(odometry=Trajectory(stamps, poses * [1.05, 1.0, 1.0]), truth=Trajectory(stamps, poses))
    for stamp, (x, y, yaw) in zip(stamps.tolist(), poses.tolist(), strict=True):
        for i, place in places.items():
            dx, dy = place - [x, y]
            heard.sightings.append((stamp, i, float(np.hypot(dx, dy)), se2.wrap(float(np.arctan2(dy, dx)) - yaw)))
    made = textbook(heard, places)
    assert made is not None
    for trajectory in made:
        error = ate(trajectory, heard.truth, stamps, align=False, lever=False, clock=False)
        assert error < 0.5 * ate(heard.odometry, heard.truth, stamps, align=True, lever=False, clock=False)


def run(code="", text="", value=None, info=""):
    finding = {"code": code, "text": text, "severity": "error", "value": value}
    return Outcome(said={"info": info}, codes={"batch": 3}, metrics={"batch": {"findings": [finding]}})


LATE = Trap("one", "late", r"clock\.imu", r"late by (?P<value>[\d.]+) s", 0.4, 0.05)


@pytest.mark.parametrize(
    ("outcome", "told"),
    [
        (run("clock.imu", "text", -0.42), True),  # signs are not compared
        (run("clock.imu", "text", 0.5), False),
        (run("clock.imu", "text"), False),  # no figure
        (run("clock.odometry", "text", 0.4), False),
        (run(info="found: The IMU is late by\n  0.38 s."), True),  # a wrapped line
        (run(info="found: The IMU is late by 0.2 s."), False),
    ],
)
def test_a_trap_is_found_by_its_code_or_sentence_with_its_figure(outcome, told):
    assert found(LATE, outcome) is told


def test_only_a_peculiarity_of_the_recording_is_a_right_cause():
    assert right_cause("duarte", [{"code": "sightings.axes", "text": ""}])
    assert not right_cause("duarte", [{"code": "run", "text": "No map."}, {"code": "sightings.axes", "text": ""}])
    assert not right_cause("plaza", [{"code": "sightings.axes", "text": ""}])
    assert not right_cause("duarte", [])


def test_a_finding_on_what_is_sound_is_false():
    assert false_findings("duarte", run("floor.uneven")) == ["duarte: floor.uneven"]
    assert false_findings("duarte", run("sightings.axes")) == []


def test_a_command_that_says_why_it_ended_is_no_crash():
    said = Outcome(said={"init": "error: no odometry", "info": "Traceback (most recent call last)\nValueError: error"})
    assert not crash(said, "init", 1)
    assert crash(said, "info", 1)


def test_the_sheet_is_of_recordings_and_no_trap_is_sound():
    names = {recording.name for recording in RECORDINGS}
    assert {row.recording for row in (*SHEET, *SOUND)} <= names
    for trap in SHEET:
        assert not trap.said or (trap.figure is not None) == ("(?P<value>" in re.compile(trap.said).pattern)
        assert trap.code or trap.said


def _small(_, out):
    """Twenty seconds of a circle at 5 Hz with sightings of three landmarks, and their map."""
    with new_bag(out, "mcap") as bag:
        for k in range(100):
            t, yaw = 10**18 + k * 2 * 10**8, 0.1 * k
            pose = (4.0 * math.sin(yaw), 4.0 * (1.0 - math.cos(yaw)), yaw)
            bag.odometry("/odom", t, pose, (2.0, 0.0, 0.5))
            bag.range_bearing("/landmarks", t, [(i, 3.0 + 0.01 * k, 0.2) for i in (1, 2, 3)])
            bag.planar_truth("/truth", t, pose)
    write_map(points({i: (i, 1.0) for i in (1, 2, 3)}), out / "map.yaml")


def _content(bag):
    with AnyReader([bag], default_typestore=default_typestore()) as reader:
        rows = [(c.topic, received, bytes(raw)) for c, received, raw in reader.messages()]
    return [row for row in rows if row[0] == "/truth"], [row for row in rows if row[0] != "/truth"]


SMALL = Recording("small", "", "", _small, "/truth", "map")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    out = tmp_path_factory.mktemp("plain")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(field_recordings, "DATA", out)
        return *_content(SMALL.bag(out)), (out / "map.yaml").read_text()


@pytest.mark.parametrize("name", [*CHANGES, *MAPS][::3])
def test_a_change_changes_what_is_sensed_or_the_map_and_never_the_truth(plain, tmp_path, monkeypatch, name):
    monkeypatch.setattr(field_recordings, "DATA", tmp_path)
    truth, sensed = _content(changed(SMALL, name, 1).bag(tmp_path))
    assert truth == plain[0]
    assert (sensed != plain[1]) == (name in CHANGES)
    assert ((tmp_path / "map.yaml").read_text() != plain[2]) == (name in MAPS)
