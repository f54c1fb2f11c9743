"""Surveys of unknown markers from their corners: in which frame, from how many recordings, and what is left out."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from refusal import refusal
from robot_world import CAMERA, SIGMA_PX, T_BASE_CAM, World, config, project, room, standing, truth_at
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner
from world_bags import write_world

from fgloc.calibration.survey import Distance, SurveyGraph, aligned, guess, mirrored, moved_by, planar_matrix, survey
from fgloc.cli import app
from fgloc.errors import ConfigError, MapError, RecordingError
from fgloc.evaluation.metrics import match_result
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.installation import MARKER, Installation
from fgloc.runner import run
from fgloc.sensors.maps import load_map, write_map
from fgloc.sensors.measurements import PixelMeasurement
from fgloc.types import LandmarkMap
from fgloc_datasets import SAMPLE

START = truth_at(0.0)
SIZE = 0.25


def settings(**sections):
    markers = {"default_size_m": SIZE, "dictionary": "DICT_4X4_50", "sigma_px": SIGMA_PX}
    return config(markers=markers | sections.pop("markers", {}), **sections)


def part(ids) -> LandmarkMap:
    """The room with these markers only."""
    return LandmarkMap({i: m for i, m in room().landmarks.items() if i in ids})


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("room"), World(room(), seed=1, seconds=22.0, rate=5))


@pytest.fixture(scope="module")
def short_bag(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("short"), World(room(), seed=1, seconds=3.0, rate=5))


@pytest.fixture(scope="module")
def found(bag):
    return survey([bag], settings())


def errors(landmarks: LandmarkMap, start=START):
    """Error of each marker: position [m] and rotation [rad] about its own axes ``(n, 6)``, and its sigmas."""
    T = np.linalg.inv(planar_matrix(start))
    rows, sigmas = [], []
    for i, m in landmarks.landmarks.items():
        true = room().landmarks[i]
        turned = Rotation.from_matrix((T[:3, :3] @ true.rotation).T @ m.rotation).as_rotvec()
        rows.append([*(m.position - (T @ [*true.position, 1.0])[:3]), *turned])
        sigmas.append(np.sqrt(np.diag(m.cov)))
    return np.array(rows), np.array(sigmas)


@pytest.mark.parametrize("least", [5, 6])
def test_a_marker_needs_as_many_views_as_are_asked_for(least):
    poses = np.array([truth_at(0.1 * k) for k in range(40)])
    corners = [project(pose, room().landmarks[2]) for pose in poses]
    rows = [k for k, one in enumerate(corners) if one is not None][:5]
    seen = [[PixelMeasurement(k, 2, corners[k], SIGMA_PX, CAMERA)] for k in rows]
    guesses, left_out = guess(poses[rows], seen, {2: SIZE}, least)
    assert (set(guesses), set(left_out)) == (({2}, set()) if least == 5 else (set(), {2}))


def test_places_and_directions_are_found(found):
    off, sigma = errors(found.landmarks)
    assert set(found.landmarks.landmarks) == set(room().landmarks)
    assert not found.left_out
    assert np.sqrt((off[:, :3] ** 2).sum(axis=1).mean()) < 0.04
    assert np.degrees(np.sqrt((off[:, 3:] ** 2).sum(axis=1).mean())) < 2.0
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.95
    assert sigma[:, :3].max() < 0.05


@pytest.mark.slow
def test_the_file_is_taken_as_it_is(bag, tmp_path):
    out = tmp_path / "map.yaml"
    given = ["--dictionary", "DICT_4X4_50", "--size", "0.25"]
    done = CliRunner().invoke(app, ["map", str(bag), "--out", str(out), *given])
    assert done.exit_code == 0, done.output
    assert "20 landmarks in" in done.output
    made = load_map(out)
    assert made.dictionary == "DICT_4X4_50"
    assert all(m.size_m == SIZE and m.cov.shape == (6, 6) for m in made.landmarks.values())
    result = run(bag, out, config(truth={"align": "se2"}), "batch")
    assert match_result(result, config(truth={"align": "se2"})).distances.mean() < 0.015


def test_writing_and_reading_keeps_the_map(found, tmp_path):
    write_map(found.landmarks, tmp_path / "map.yaml")
    again = load_map(tmp_path / "map.yaml")
    for i, m in found.landmarks.landmarks.items():
        assert np.array_equal(again.landmarks[i].cov, m.cov)
        assert np.allclose(again.landmarks[i].rotation, m.rotation, atol=1e-12)


@pytest.mark.slow
def test_several_bags_make_one_map(tmp_path):
    halves = [
        write_world(tmp_path / str(n), World(room(), seed=n, seconds=11.0, start_s=s, start_ns=(n + 1) * 10**18))
        for n, s in enumerate((0.0, 9.0))
    ]
    both = survey(halves, settings())
    alone = survey(halves[:1], settings())
    assert len(both.landmarks) > len(alone.landmarks)
    off, sigma = errors(both.landmarks)
    assert np.sqrt((off[:, :3] ** 2).sum(axis=1).mean()) < 0.04
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.95
    for i, m in alone.landmarks.landmarks.items():
        assert np.trace(both.landmarks.landmarks[i].cov) <= 1.001 * np.trace(m.cov)


def test_bags_that_share_no_marker_are_refused(tmp_path):
    bags = [
        write_world(tmp_path / str(n), World(part(ids), seconds=12.0))
        for n, ids in enumerate((range(5), range(10, 15)))
    ]
    with pytest.raises(RecordingError, match=r"\[10, 11, 12, 13, 14\].*\[0, 1, 2, 3, 4\]"):
        survey(bags, settings())


def test_given_markers_make_the_frame_and_are_refined(bag):
    rng = np.random.default_rng(5)
    sigmas = np.array([0.01] * 3 + [0.01] * 3)
    given = {}
    for i, m in part({0, 4, 9, 16}).landmarks.items():
        off = rng.normal(0.0, sigmas)
        turned = m.rotation @ Rotation.from_rotvec(off[3:]).as_matrix()
        given[i] = dataclasses.replace(m, position=m.position + off[:3], rotation=turned, cov=np.diag(sigmas**2))
    given[40] = standing(40, 9.0, 9.0, 0.0)
    made = survey([bag], settings(), LandmarkMap(given, "DICT_4X4_50"))
    assert made.landmarks.landmarks[40] is given[40]
    assert any("[40]" in note for note in made.notes)
    seen = LandmarkMap({i: m for i, m in made.landmarks.landmarks.items() if i != 40})
    off, sigma = errors(seen, np.zeros(3))
    assert np.sqrt((off[:, :3] ** 2).sum(axis=1).mean()) < 0.03
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.95
    assert all(np.trace(seen.landmarks[i].cov) < np.trace(m.cov) for i, m in given.items() if i != 40)
    assert not made.errors


def test_of_given_markers_the_one_that_is_moved_most_is_named_if_it_is_moved_too_far(short_bag):
    given = part({1, 2, 3, 4}).landmarks
    wrong = {**given, 3: dataclasses.replace(given[3], position=given[3].position + np.array([0.0, 0.3, 0.0]))}
    assert not survey([short_bag], settings(), LandmarkMap(given, "DICT_4X4_50")).errors
    (error,) = survey([short_bag], settings(), LandmarkMap(wrong, "DICT_4X4_50")).errors
    assert "marker 3 " in error


def test_a_camera_without_an_optical_frame_is_named_where_no_map_comes_of_it(bag, found):
    forward = {"sightings_pose": (*T_BASE_CAM[:3, 3], 0.0, 0.0, 0.0), "sightings_axes": "body"}
    assert not found.errors
    try:
        said = survey([bag], settings(recording=forward)).errors
    except RecordingError as error:
        said = (str(error),)
    assert [text for text in said if "recording.sightings_axes: optical" in text], said


def test_given_markers_that_cannot_be_where_they_are_said_to_be_are_named(bag, tmp_path):
    given = part({0, 4, 9, 16}).landmarks
    wrong = {**given, 4: dataclasses.replace(given[4], position=given[4].position + np.array([0.0, 0.3, 0.0]))}
    write_map(LandmarkMap(wrong, "DICT_4X4_50"), tmp_path / "given.yaml")
    out = tmp_path / "map.yaml"
    done = CliRunner().invoke(app, ["map", str(bag), "--anchor", str(tmp_path / "given.yaml"), "--out", str(out)])
    assert done.exit_code == 3, done.output
    assert "marker 4 " in done.output
    assert out.exists()


def test_sightings_alone_survey_and_locate(bag, tmp_path):
    """No wheels, no commands, no IMU: the robot's speed stays as it was for a while."""
    silent = dict.fromkeys(("odometry", "joints", "command", "imu"), "none")
    alone = settings(recording={"topics": silent}, truth={"align": "none"})
    made = survey([bag], alone, part({0, 4, 9, 16}))
    assert set(made.landmarks.landmarks) == set(room().landmarks)
    off, sigma = errors(made.landmarks, np.zeros(3))
    assert np.sqrt((off[:, :3] ** 2).sum(axis=1).mean()) < 0.06
    assert np.mean(np.abs(off) < 3.0 * sigma) > 0.95
    write_map(room(), tmp_path / "map.yaml")
    for mode in ("batch", "online"):
        result = run(bag, tmp_path / "map.yaml", alone, mode)
        assert match_result(result, alone).distances.mean() < 0.03
        assert not any("motion" in name for name in result.rejections)


def test_a_survey_on_uneven_ground_is_refused(bag):
    with pytest.raises(ConfigError, match="uneven"):
        survey([bag], settings(estimator={"ground": "uneven"}))


def test_a_measured_distance_sets_the_scale(bag, found):
    at = room().landmarks
    true = float(np.linalg.norm(at[2].position - at[12].position))
    made = survey([bag], settings(), distances=[Distance(2, 12, true)])
    a, b = made.landmarks.landmarks[2], made.landmarks.landmarks[12]
    assert np.linalg.norm(a.position - b.position) == pytest.approx(true, abs=0.005)
    assert not any("size" in note for note in made.notes)
    total = [sum(np.trace(m.cov[:3, :3]) for m in x.landmarks.landmarks.values()) for x in (made, found)]
    assert total[0] < total[1]


def test_a_distance_that_does_not_fit_is_told(tmp_path):
    bag = write_world(tmp_path, World(room(), seed=4, seconds=8.0, rate=5))
    known = survey([bag], settings()).landmarks.landmarks
    first, second = min(known), max(known)
    true = float(np.linalg.norm(known[first].position - known[second].position))
    made = survey([bag], settings(), distances=[Distance(first, second, 1.1 * true)])
    assert any(re.search(r"markers' size\b", note) for note in made.notes)


def test_markers_are_solved_again_from_where_they_were_found_until_they_stay_and_no_longer(tmp_path, monkeypatch):
    solved, moves, solve = [], [], SurveyGraph.solve

    class Counted(BatchSmoother):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            solved.append(self)

    def observed(self):
        solve(self)
        moves.extend(np.abs(self.belief.mean[k : k + 6]) for k, _ in self.installation.landmarks.values())

    monkeypatch.setattr("fgloc.calibration.survey.BatchSmoother", Counted)
    monkeypatch.setattr(SurveyGraph, "solve", observed)
    survey([write_world(tmp_path, World(room(), seed=4, seconds=4.0, rate=5))], settings())
    assert len(solved) < 6
    assert (np.max(moves, axis=0) < [1e-3] * 3 + [5e-3] * 3).all()


def test_a_distance_to_a_marker_that_was_not_seen_is_refused(bag):
    with pytest.raises(MapError, match=r"\b77\b"):
        survey([bag], settings(), distances=[Distance(2, 77, 3.0)])


def test_markers_seen_too_seldom_are_left_out_with_the_reason(tmp_path):
    class Rare(World):
        def _sightings(self, stamp):
            event = super()._sightings(stamp)
            odd = dataclasses.replace(event.sightings[0], landmark_id=33) if event.sightings else None
            few = (stamp - self.start_ns) in (1_000_000_000, 6_000_000_000)
            misread = stamp // 100_000_000 % 15 == 0 and len(event.sightings) > 1
            kept = event.sightings
            if misread:  # the first is read as another one that hangs elsewhere
                kept = (dataclasses.replace(kept[0], landmark_id=(kept[0].landmark_id + 7) % 20), *kept[1:])
            unique = {s.landmark_id: s for s in ((*kept, odd) if few and odd is not None else kept)}
            return dataclasses.replace(event, sightings=tuple(unique.values()))

    made = survey([write_world(tmp_path, Rare(room(), seed=3, seconds=22.0, rate=5))], settings())
    assert re.search(r"\b2\b.*\b3\b", made.left_out[33])  # times seen, and needed
    assert len(made.landmarks) >= 18
    off, _ = errors(made.landmarks)
    assert np.sqrt((off[:, :3] ** 2).sum(axis=1).mean()) < 0.04


def test_markers_whose_place_or_direction_is_hardly_known_are_left_out(tmp_path):
    bag = write_world(tmp_path, World(room(), seed=1, seconds=6.0, rate=5))
    made = survey([bag], settings(markers={"sigma_px": 3.0}))
    sigmas = np.array([np.sqrt(np.diag(m.cov)) for m in made.landmarks.landmarks.values()])
    assert sigmas[:, :3].max() < 0.1
    assert sigmas[:, 3:].max() < 0.2
    assert {1, 6} <= made.left_out.keys()


def test_a_marker_whose_place_is_known_and_its_direction_hardly_is_left_out(short_bag):
    made = survey([short_bag], settings(markers={"sigma_px": 2.5}), part({2, 3}))
    assert sorted(made.landmarks.landmarks) == [2, 3]
    known = re.search(r"\b(\d+) cm and (\d+) degrees", made.left_out[1])
    assert int(known[1]) < 9
    assert 11 < int(known[2]) < 20


def test_what_is_missing_is_said(bag, tmp_path):
    blind = write_world(tmp_path / "blind", World(room(), seconds=4.0), sightings=False)
    with refusal(RecordingError, blind):
        survey([blind], settings())
    with pytest.raises(ConfigError, match="--size"):
        survey([bag], settings(markers={"default_size_m": None}))


def test_images_without_a_dictionary_get_one_suggested(tmp_path):
    done = CliRunner().invoke(app, ["map", str(SAMPLE), "--size", "0.2", "--out", str(tmp_path / "map.yaml")])
    assert done.exit_code == 1
    assert "--dictionary DICT_4X4_50" in done.output


@pytest.mark.parametrize("text", ["1,2", "1,1,2.0", "1,2,-1", "a,2,3"])
def test_a_distance_that_is_none_is_refused(bag, tmp_path, text):
    done = CliRunner().invoke(
        app, ["map", str(bag), "--size", "0.25", "--distance", text, "--out", str(tmp_path / "m.yaml")]
    )
    assert done.exit_code == 1
    assert f"--distance {text}" in done.output


def test_anchors_need_markers(tmp_path):
    from robot_world import beacons

    bag = write_world(tmp_path, World(beacons(), seconds=3.0))
    done = CliRunner().invoke(app, ["map", str(bag), "--distance", "1,2,3", "--out", str(tmp_path / "m.yaml")])
    assert done.exit_code == 1
    assert "--distance" in done.output


def test_frames_are_aligned_though_some_markers_were_moved():
    motion = np.array([1.0, -2.0, 2.0])
    found = {i: np.linalg.inv(planar_matrix(motion)) @ matrix(m) for i, m in room().landmarks.items()}
    known = {i: matrix(m) for i, m in room().landmarks.items() if i < 12}
    for i in (0, 5, 7):
        known[i] = planar_matrix((1.0, 0.5, 1.0)) @ known[i]
    assert np.allclose(aligned(known, found), motion, atol=1e-9)
    assert aligned({}, found) is None


@pytest.mark.parametrize("apart_m", [None, 0.1])
def test_frames_are_aligned_by_the_directions_of_markers_that_hang_too_near_to_one_another(apart_m):
    motion = np.array([1.0, -2.0, 2.0])
    known = {0: matrix(standing(0, 3.0, 1.0, np.pi))}
    if apart_m is not None:
        known[1] = matrix(standing(1, 3.0, 1.0 + apart_m, np.pi))
    found = {i: np.linalg.inv(planar_matrix(motion)) @ T for i, T in known.items()}
    for i, T in found.items():
        T[:2, 3] += (0.03, -0.03)[i]
    made = aligned(known, found)
    assert made[2] == pytest.approx(motion[2], abs=0.02)
    assert made[:2] == pytest.approx(motion[:2], abs=0.2)


def test_frames_are_not_aligned_by_markers_of_which_most_were_moved_by_a_metre():
    rng, known = np.random.default_rng(6), {}
    for i, m in room().landmarks.items():
        known[i] = matrix(m)
        angle = rng.uniform(0.0, 2.0 * np.pi)
        known[i][:2, 3] += rng.uniform(1.0, 1.5) * np.array([np.cos(angle), np.sin(angle)])
    assert aligned(known, {i: matrix(m) for i, m in room().landmarks.items()}) is None


def test_a_marker_turned_the_wrong_way_is_found_again_from_the_other_side():
    true = standing(3, 2.0, 0.4, np.pi + 0.6)
    poses = np.array([[x, y, 0.1] for x in (0.0, 0.3) for y in (-0.4, 0.0, 0.3)])
    noise = np.random.default_rng(7).normal(0.0, 0.3, (len(poses), 4, 2))
    seen = [PixelMeasurement(0, 3, project(p, true) + n, 0.5, CAMERA) for p, n in zip(poses, noise, strict=True)]
    installation = Installation({f"map.3.{name}": 0.5 for name in MARKER})
    about = moved_by(true, np.array([0.2, -0.1, 0.1, 0.2, 0.2, -0.2]))
    wrong = mirrored(about, seen, poses, installation, np.zeros(6))
    right = mirrored(wrong.landmark, seen, poses, installation, np.zeros(6))
    assert wrong.gain < -20.0
    assert right.gain == pytest.approx(-wrong.gain, rel=0.01)
    assert np.linalg.norm(right.landmark.position - true.position) < 0.03
    assert Rotation.from_matrix(right.landmark.rotation.T @ true.rotation).magnitude() < 0.05


def matrix(landmark):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = landmark.rotation, landmark.position
    return T
