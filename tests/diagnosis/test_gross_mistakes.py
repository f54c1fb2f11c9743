"""Gross mistakes of a set-up are named before the run, each with the line to be set, and none of a sound one."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from robot_world import CAMERA
from typer.testing import CliRunner

from fgloc import cli, se2
from fgloc.assembly import assemble
from fgloc.cli.terminal import EXIT_LOST, exit_code
from fgloc.config import Config, load_config, yaml_of
from fgloc.diagnosis.landmarks import first_pose_sentence
from fgloc.diagnosis.setup import Change, angle_of, by_places, check_fit, correction, gross, mirrored, swapped
from fgloc.diagnosis.setup_fit import EXTRAS, GRID_S, Motion, Picture, Setup, Stretch, laid, read_excerpt
from fgloc.diagnosis.signals import clock_sentence, other_clocks
from fgloc.diagnosis.truth import truth_sentence
from fgloc.evaluation.metrics import compute_metrics
from fgloc.frames import rpy_matrix
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensor_setup import base_up
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.maps import load_map, write_map
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.sensor import roll_over
from fgloc.types import Finding, Landmark, LandmarkMap, Severity
from fgloc_datasets.bag import BagWriter

SAMPLES = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples"
SAMPLE = SAMPLES / "installed_run"
START_NS = 1_700_000_000_000_000_000


class Looked:
    """An excerpt of a recording with its set-up."""

    def __init__(self, folder: Path, stretches: int) -> None:
        self.config = load_config(folder / "robot.yaml")
        with open_recording(folder / "bag", self.config.recording) as recording:
            parts = assemble(recording, folder / "map.yaml", self.config, keep_all=False)
            self.excerpt = read_excerpt(recording, self.config, parts.detector)
            self.up = base_up(recording, self.config)
        self.excerpt.pictures = self.excerpt.pictures[:stretches]
        self.landmarks, (self.camera,) = parts.landmark_map, parts.cameras

    def check(self, config=None, landmarks=None, camera=None, excerpt=None):
        """The check with some of the set-up replaced."""
        return check_fit(
            excerpt or self.excerpt,
            config or self.config,
            landmarks or self.landmarks,
            camera or self.camera,
            self.up,
            "image",
        )

    def wheels(self, **values) -> Config:
        """The configuration with these values of the wheels."""
        return self.config.model_copy(update={"wheels": self.config.wheels.model_copy(update=values)})


@pytest.fixture(scope="module")
def looked():
    return Looked(SAMPLE, stretches=3)


def sized(landmarks: LandmarkMap, factor: float) -> LandmarkMap:
    """The map with other sizes."""
    known = {i: dataclasses.replace(m, size_m=factor * m.size_m) for i, m in landmarks.landmarks.items()}
    return dataclasses.replace(landmarks, landmarks=known)


def value(pattern: str, sentence: str) -> float:
    """The number that a sentence has behind a pattern."""
    found = re.search(pattern + r" (-?[\d.]+\d)", sentence)
    assert found, sentence
    return float(found[1])


# --- by the fit of the excerpt ---


@pytest.mark.parametrize("name", ["installed_run", "patches_run"])
def test_a_sound_set_up_is_not_accused(name, looked):
    checked = (looked if name == "installed_run" else Looked(SAMPLES / name, stretches=5)).check()
    assert checked.fit is not None
    assert checked.correction is None


def test_a_set_up_is_not_judged_by_a_few_sightings(looked):
    some = [dataclasses.replace(p, seen=p.seen[:4]) for p in looked.excerpt.pictures[0][:4]]
    few = dataclasses.replace(looked.excerpt, pictures=[some])
    assert 8 <= sum(len(p.seen) for p in some) < 20
    checked = looked.check(excerpt=few)
    assert len(checked.stretches) == 1
    assert checked.fit is None


@pytest.mark.parametrize("factor", [0.95, 0.8])
def test_fault_40_wrong_marker_size(looked, factor):
    found = looked.check(landmarks=sized(looked.landmarks, factor)).correction
    assert value("set size:", found.finding.text) == pytest.approx(0.2, rel=0.02)
    assert next(iter(found.landmark_map.landmarks.values())).size_m == pytest.approx(0.2, rel=0.02)


@pytest.mark.parametrize(("stretches", "is_named"), [(1, False), (3, True)])
def test_a_mistake_is_named_only_where_the_excerpt_surely_shows_it(looked, stretches, is_named):
    larger = {
        i: dataclasses.replace(m, position=1.12 * m.position, size_m=1.12 * m.size_m)
        for i, m in looked.landmarks.landmarks.items()
    }
    some = dataclasses.replace(looked.excerpt, pictures=looked.excerpt.pictures[:stretches])
    checked = looked.check(landmarks=dataclasses.replace(looked.landmarks, landmarks=larger), excerpt=some)
    assert checked.fit is not None
    assert (checked.correction is not None) == is_named


def test_fault_40_calibration_of_another_resolution(looked):
    K = looked.camera.K * [[2.0], [2.0], [1.0]]
    found = looked.check(camera=dataclasses.replace(looked.camera, K=K)).correction
    assert value("camera.focal_scale:", found.finding.text) == pytest.approx(0.5, abs=0.01)
    assert found.config.camera.cx_px == pytest.approx(looked.camera.K[0, 2], abs=5.0)


def test_fault_40_calibration_without_distortion(looked):
    plain = dataclasses.replace(looked.camera, D=np.zeros(5))
    found = looked.check(camera=plain).correction
    assert value("camera.k1:", found.finding.text) == pytest.approx(looked.camera.D[0], abs=0.03)
    assert found.config.camera.k2 == pytest.approx(looked.camera.D[1], abs=0.05)


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        (rpy_matrix(0.0, 0.0, math.pi), "upside down"),
        (rpy_matrix(0.0, math.radians(12.0), 0.0), "further left"),  # its transform says: 12 degrees to the right
        (rpy_matrix(math.radians(15.0), 0.0, 0.0), "further down"),  # likewise up
    ],
    ids=["upside_down", "yawed", "pitched"],
)
def test_fault_46_turned_camera(looked, turn, words):
    T = looked.camera.T_base_cam.copy()
    T[:3, :3] = T[:3, :3] @ turn  # about the optical axes
    found = looked.check(camera=dataclasses.replace(looked.camera, T_base_cam=T)).correction
    assert words in found.finding.text
    true = looked.camera.T_base_cam[:3, :3]
    off = rpy_matrix(*found.config.recording.sightings_pose[3:]).T @ true @ rpy_matrix(-math.pi / 2, 0, -math.pi / 2).T
    assert math.acos(min(1.0, 0.5 * (np.trace(off) - 1.0))) < math.radians(1.5)


def test_exchanged_wheels(looked):
    given = looked.config.wheels
    found = looked.check(looked.wheels(left_joint=given.right_joint, right_joint=given.left_joint)).correction
    assert f"wheels.left_joint: {given.left_joint} and wheels.right_joint: {given.right_joint}" in found.finding.text
    assert found.config.wheels == given


@pytest.mark.parametrize("factor", [1.1, 2.0])
def test_wrong_radius(looked, factor):
    found = looked.check(looked.wheels(left_radius=0.05 * factor, right_radius=0.05 * factor)).correction
    assert value("wheels.left_radius:", found.finding.text) == pytest.approx(0.05, rel=0.03)
    assert found.config.wheels.right_radius == pytest.approx(0.05, rel=0.03)


def test_fault_52_mirrored_map(looked):
    found = looked.check(landmarks=mirrored(looked.landmarks)).correction
    assert found.finding.code == "map.mirrored"
    for i, m in looked.landmarks.landmarks.items():
        np.testing.assert_allclose(found.landmark_map.landmarks[i].corners(), m.corners(), atol=1e-9)


def test_exchanged_ids(looked):
    seen = [m.landmark_id for row in looked.excerpt.pictures for p in row for m in p.seen]
    a, b = sorted(sorted(set(seen), key=seen.count)[-2:])
    found = looked.check(landmarks=swapped(looked.landmarks, a, b)).correction
    assert found.finding.code == "map.ids"
    assert re.search(rf"\bids {a} \w+ {b}\b", found.finding.text)
    np.testing.assert_array_equal(found.landmark_map.landmarks[a].position, looked.landmarks.landmarks[a].position)


def test_fault_19_late_images(looked):
    late = 250_000_000
    pictures = [[Picture(p.stamp_ns + late, p.seen) for p in row] for row in looked.excerpt.pictures]
    found = looked.check(excerpt=dataclasses.replace(looked.excerpt, pictures=pictures)).correction
    assert value(r"stamp_offset_s: \{image:", found.finding.text) == pytest.approx(-0.25, abs=0.03)


@pytest.mark.parametrize(
    ("kind", "role"), [(JointsEvent, "joints"), (ImuEvent, "imu")], ids=["wheels_early", "gyro_early"]
)
def test_fault_19_clocks_of_wheels_and_gyro(looked, kind, role):
    signals = looked.excerpt.signals
    if kind is ImuEvent:
        signals = dataclasses.replace(signals, imu=[(row[0] - 0.2, *row[1:]) for row in signals.imu])
    else:
        early = [dataclasses.replace(e, stamp_ns=e.stamp_ns - 200_000_000) for e in signals.motion]
        signals = dataclasses.replace(signals, motion=early)
    found = looked.check(excerpt=dataclasses.replace(looked.excerpt, signals=signals)).correction
    assert value(rf"stamp_offset_s: \{{{role}:", found.finding.text) == pytest.approx(0.2, abs=0.03)


def test_the_motion_of_wheels_and_gyro_fits_poses_on_a_circle_only_if_they_are_those():
    step, times = np.array([0.02, 0.0, 0.03]), np.array([0.5, 1.5, 3.0, 3.6])
    stretch = Stretch(times, (), np.tile(step, (200, 1)), np.full(200, 0.03))
    motion, extras = Motion([stretch], np.eye(3), Config()), np.zeros(len(EXTRAS))
    poses = np.array([se2.exp(step * t / GRID_S) for t in times])
    np.testing.assert_allclose(se2.between_array(poses, motion.path(0, extras)), 0.0, atol=1e-4)
    for there, close in ((poses, True), (poses * [1.0, 1.0, 1.1], False)):
        residuals = [np.abs(r).max() for r, _, _ in motion.rows(there, extras, 3 * len(times))]
        assert [r < 0.05 for r in residuals] == [close] * len(residuals)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("yaw_per_m", 0.1, (1.0, 0.0, 0.1)), ("radius", 0.1, (math.exp(0.1), 0.0, 0.0)), ("track", 0.1, (1.0, 0.0, 0.0))],
)
def test_what_wheels_may_be_off_by_changes_their_motion(name, value, expected):
    stretch = Stretch(np.array([0.5, 1.5]), (), np.tile([0.02, 0.0, 0.0], (100, 1)), None)
    extras = np.where(np.array(EXTRAS) == name, value, 0.0)
    went, _, _ = Motion([stretch], np.eye(3), Config()).between(extras)
    np.testing.assert_allclose(went[0], se2.exp(np.array(expected)), atol=1e-3)


def test_a_path_is_laid_onto_the_map_by_the_sightings_that_agree():
    rng, true = np.random.default_rng(8), np.array([1.0, -2.0, 0.7])
    path = np.column_stack([np.linspace(0.0, 2.0, 30), np.zeros(30), np.linspace(0.0, 1.0, 30)])
    seen = np.array([[r * math.cos(a), r * math.sin(a)] for r, a in rng.uniform((1.0, -1.0), (3.0, 1.0), (30, 2))])
    places = se2.placed(true, se2.placed(path, seen)) + rng.normal(0.0, 0.05, seen.shape)
    places[::6] += rng.normal(0.0, 2.0, (5, 2))  # of other markers
    assert np.abs(se2.between(true, laid(path, seen, places))).max() < 0.1
    assert laid(path[:3], seen[:3], places[:3]) is None


def test_a_rotation_matrix_that_is_rounded_has_an_angle():
    assert angle_of(np.eye(3) * (1.0 + 1e-12)) == 0.0
    assert angle_of(rpy_matrix(0.0, 0.0, math.pi) * (1.0 + 1e-12)) == pytest.approx(math.pi)
    assert angle_of(rpy_matrix(0.0, 0.3, 0.0)) == pytest.approx(0.3)


def test_wheels_without_noise_are_not_exact():
    noise = dict.fromkeys(Config().wheels.noise.model_dump(), 0.0)
    config = Config.model_validate({"wheels": {"noise": noise}})
    stretch = Stretch(np.array([0.5, 1.5]), (), np.tile([0.02, 0.0, 0.03], (100, 1)), None)
    _, sigmas, _ = Motion([stretch], np.eye(3), config).between(np.zeros(len(EXTRAS)))
    assert (sigmas > 0.0).all()


@pytest.mark.parametrize(
    ("kind", "lines", "value"),
    [
        ("radius", {"wheels.scale_v": 1.1, "wheels.scale_omega": 1.1}, 1.1),
        ("track", {"wheels.scale_omega": 1.0 / 1.1}, 1.1),
        ("odometry_frame", {"wheels.source": "pose"}, None),
    ],
)
def test_a_mistake_of_the_odometer_has_its_lines_and_its_factor(kind, lines, value):
    extras = np.where(np.array(EXTRAS) == kind, math.log(1.1), 0.0)
    setup = Setup(Config(), LandmarkMap({}), None, extras=extras)
    found = correction(Change(kind, setup), setup, "odometry", "image", "odometry").finding
    assert {key.removeprefix("expert."): yaml.safe_load(text) for key, text in found.lines.items()} == {
        key: pytest.approx(number, abs=1e-4) if isinstance(number, float) else number for key, number in lines.items()
    }
    assert found.value == (None if value is None else pytest.approx(value))


@pytest.mark.parametrize("kind", ["size", "track", "gyro_clock", "focal", "distortion", "mounting", "position"])
def test_what_an_ordinary_installation_is_off_by_is_no_mistake(kind):
    given = Setup(Config(), LandmarkMap({}), CAMERA)

    def off(by: float) -> Setup:
        K, T, D = CAMERA.K.copy(), CAMERA.T_base_cam.copy(), CAMERA.D.copy()
        if kind == "focal":
            K[0, 0] *= 1.0 + by
        elif kind == "distortion":
            D[0] += by
        elif kind == "position":
            T[2, 3] += by
        elif kind == "mounting":
            T[:3, :3] = T[:3, :3] @ rpy_matrix(by, 0.0, 0.0)
        name = "gyro_late_s" if kind == "gyro_clock" else kind
        extras = np.where(np.array(EXTRAS) == name, by, 0.0)
        return Setup(Config(), LandmarkMap({}), dataclasses.replace(CAMERA, K=K, T_base_cam=T, D=D), extras=extras)

    assert not gross(Change(kind, off(0.01)), given)
    assert gross(Change(kind, off(0.12)), given)


@pytest.mark.parametrize(
    ("code", "value", "ids", "position", "size"),
    [
        ("map.ids", 1.0, {0, 1}, 3.0, 0.2),
        ("map.unit", 0.01, {1, 2}, 0.03, 0.2),
        ("sightings.scale", 2.0, {1, 2}, 3.0, 0.4),
    ],
)
def test_a_map_is_compared_without_the_mistake_that_its_markers_places_show(code, value, ids, position, size):
    known = {i: Landmark(i, np.array([3.0, 1.0, 0.0]), np.eye(3), 0.2) for i in (1, 2)}
    _, undone = by_places(Finding(code, "", Severity.ERROR, value=value), LandmarkMap(known))
    assert undone.landmarks.keys() == ids
    assert [m.landmark_id for m in undone.landmarks.values()] == sorted(ids)
    assert all(m.position[0] == pytest.approx(position) for m in undone.landmarks.values())
    assert all(m.size_m == pytest.approx(size) for m in undone.landmarks.values())


def test_a_finding_that_is_none_of_a_map_changes_no_map():
    known = LandmarkMap({1: Landmark(1, np.zeros(3), np.eye(3), 0.2)})
    assert by_places(Finding("wheels.sign", "", Severity.ERROR, value=None), known) is None


# --- by the messages alone ---


def joints(angles: np.ndarray) -> list[JointsEvent]:
    """Messages of two wheels that turn alike."""
    names, none = ("left_wheel", "right_wheel"), np.zeros(0)
    return [
        JointsEvent(START_NS + k * 20_000_000, 0, "/joint_states", names, np.array([a, a]), none, none)
        for k, a in enumerate(angles)
    ]


@pytest.mark.parametrize("size", [2.0 * math.pi, 10.0])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_fault_25_roll_over(size, direction):
    angles = direction * np.cumsum(0.2 + 0.1 * np.sin(np.arange(600) / 40.0))
    found = roll_over(joints(np.mod(angles, size)), Config())
    assert found is not None
    assert found[0] == pytest.approx(size, rel=0.01)


def test_fault_25_an_encoder_that_restarts_does_not_roll_over():
    angles = np.cumsum(0.2 + 0.1 * np.sin(np.arange(600) / 40.0))
    angles[200:] -= angles[200]
    angles[450:] -= angles[450]
    assert roll_over(joints(angles), Config()) is None
    assert roll_over(joints(np.mod(angles, 6.0)), Config.model_validate({"wheels": {"angle_range": 6.0}})) is None


def test_a_silence_of_the_joints_is_no_roll_over():
    angles = np.cumsum(np.full(1100, 0.2))
    heard = joints(angles)
    assert roll_over(heard[:300] + heard[800:], Config()) is None


def test_stamps_of_another_clock():
    delays = {"joints": 0.003, "odometry": 0.002, "imu": 0.001, "image": 0.04}
    assert other_clocks(delays) == ()
    assert other_clocks({role: d + 3600.0 for role, d in delays.items()}) == ()  # the recorder's own
    delays["imu"] = -1000.0
    assert other_clocks(delays) == ("imu",)
    said = clock_sentence(("imu",), delays, ("image",))
    assert "imu are 1000 s ahead" in said
    assert "recording.received_stamps: [image, imu]" in said


def test_stamps_of_no_topic_are_set(tmp_path):
    received = 1_700_000_000_000_000_000
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(60):
            at = received + k * 50_000_000
            bag.odometry("/odom", 0, (0.02 * k, 0.0, 0.0), (0.4, 0.0), received_ns=at)
            bag.range_bearing(
                "/landmarks", 0, [(1, 4.0 - 0.02 * k, 0.0), (2, math.hypot(2.0, 3.0 - 0.02 * k), 0.6)], at
            )
    result = run(tmp_path / "bag", None, Config(), "batch")
    (named,) = [f for f in result.findings if f.code == "clock.received"]
    assert named.lines == {"recording.received_stamps": "[odometry, sightings]"}
    assert len(result.trajectory) > 10


# --- frames ---


def test_fault_52_map_shifted_against_the_given_first_pose():
    config = Config.model_validate({"estimator": {"initial_pose": [0.0, 0.0, 0.0]}})
    assert first_pose_sentence(config, np.array([0.2, -0.2, 0.1])) is None
    said = first_pose_sentence(config, np.array([2.0, -1.0, 0.0]))
    assert "2.24 m" in said
    assert "estimator.initial_pose: [2.000, -1.000, 0.0000]" in said
    assert first_pose_sentence(Config(), np.array([2.0, -1.0, 0.0])) is None


@pytest.mark.parametrize("coordinate", [0, 1, 2])
def test_a_given_first_pose_may_be_off_by_its_sigmas_and_a_little(coordinate):
    config = Config.model_validate({"estimator": {"initial_pose": [0.0, 0.0, 0.0], "initial_sigmas": [0.05] * 3}})
    for off, is_named in ((0.35, False), (0.45, True)):
        assert (first_pose_sentence(config, off * np.eye(3)[coordinate]) is not None) == is_named


def test_truth_in_another_frame():
    t = np.linspace(0.0, 20.0, 101)
    path = np.column_stack([2.0 * np.sin(0.3 * t), np.cos(0.5 * t), 0.1 * t])
    c, s = math.cos(0.7), math.sin(0.7)

    def truth(points: np.ndarray) -> np.ndarray:
        return np.column_stack([t, points, np.zeros(len(t))])

    moved = path[:, :2] @ np.array([[c, s], [-s, c]]) + [3.0, -1.0]
    said = truth_sentence(Config(), truth(moved), t[1:-1], path[1:-1])
    assert "set truth.align: se2" in said
    assert truth_sentence(Config(), truth(path[:, :2] + 0.1), t[1:-1], path[1:-1]) is None
    aligned = Config.model_validate({"truth": {"align": "se2"}})
    assert truth_sentence(aligned, truth(moved), t[1:-1], path[1:-1]) is None
    elsewhere = np.random.default_rng(0).normal(size=(len(t), 2))  # fits neither way: not a matter of frames
    assert truth_sentence(Config(), truth(elsewhere), t[1:-1], path[1:-1]) is None


# --- all of it ---


def test_a_run_names_the_mistake_first_and_is_made_without_it(looked, tmp_path):
    write_map(sized(load_map(SAMPLE / "map.yaml"), 0.95), tmp_path / "map.yaml")
    result = run(SAMPLE / "bag", tmp_path / "map.yaml", looked.config, "online")
    assert "set size: 0." in result.notes[0]
    assert result.mistakes == result.notes[:1]
    assert exit_code(result) == EXIT_LOST
    metrics = compute_metrics(result, result.config)
    assert tuple(f.text for f in metrics.findings if f.severity == "error") == result.mistakes
    assert metrics.ate_mean_m < 0.02
    assert metrics.nees_over_3 < 3.0


def test_info_names_the_mistake_first(looked, tmp_path):
    config = looked.wheels(left_joint="right_wheel_joint", right_joint="left_wheel_joint")
    (tmp_path / "robot.yaml").write_text(yaml_of(config, tmp_path))
    arguments = ["--map", str(SAMPLE / "map.yaml"), "--config", str(tmp_path / "robot.yaml")]
    shown = CliRunner().invoke(cli.app, ["info", str(SAMPLE / "bag"), *arguments])
    first = shown.output.partition("What looks wrong:\n")[2].splitlines()[0]
    assert "set wheels.left_joint: left_wheel_joint" in first
    assert shown.exit_code == EXIT_LOST


@pytest.mark.slow
@pytest.mark.parametrize(("bag", "of"), [("installed_run", "first_run"), ("first_run", "installed_run")])
def test_info_names_the_map_of_another_place(bag, of):
    arguments = ["--map", str(SAMPLES / of / "map.yaml"), "--config", str(SAMPLES / bag / "robot.yaml")]
    shown = CliRunner().invoke(cli.app, ["info", str(SAMPLES / bag / "bag"), *arguments])
    first = shown.output.partition("What looks wrong:\n")[2].splitlines()[0]
    assert str(SAMPLES / of / "map.yaml") in first
    assert shown.exit_code == EXIT_LOST


def test_info_of_a_sound_set_up_ends_with_0_and_of_one_that_cannot_run_with_1(tmp_path):
    sound = CliRunner().invoke(cli.app, ["info", str(SAMPLE / "bag"), "--config", str(SAMPLE / "robot.yaml")])
    assert sound.exit_code == 0
    (tmp_path / "robot.yaml").write_text("recording: {topics: {odometry: /odm}}")
    arguments = ["--map", str(SAMPLE / "map.yaml"), "--config", str(tmp_path / "robot.yaml")]
    unsettled = CliRunner().invoke(cli.app, ["info", str(SAMPLE / "bag"), *arguments])
    assert unsettled.exit_code == 1
    assert "/odm" in unsettled.output.partition("To be settled")[2].splitlines()[1]
    assert "nothing" not in unsettled.output
