"""The benchmark of installations: its scores are right on runs whose outcome is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import installed, replays
from benchmarks.installed import CASES, Cell
from benchmarks.recordings import Take
from benchmarks.replays import floor
from benchmarks.scores import (
    Errors,
    Scores,
    Slips,
    errors,
    found_errors,
    inside,
    kept_scores,
    lost_share,
    map_over_survey,
    places_in,
    refused_share,
    truth_values,
)
from benchmarks.textbook import PIPELINES, Textbook
from fgloc.config import Config, WheelsConfig
from fgloc.runner import RunResult
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import Camera, Decision, Landmark, LandmarkMap, Mode, Step, Trajectory, by_class

SECOND = 1_000_000_000
INSTALLED = {
    "camera": {
        "position": [0.11, 0.0, 0.25],
        "rpy": [0.0, 0.01, 3.14],
        "focal_px": 528.0,
        "principal_px": [321.0, 239.0],
        "distortion": [-0.12, 0.04, 0.0, 0.0, 0.0],
        "time_offset_s": 0.015,
    },
    "wheels": {"left_radius": 0.0505, "right_radius": 0.0495, "track": 0.2626, "time_offset_s": -0.004},
    "imu": {"rpy": [0.0, 0.0, 0.0], "gyro_scale": 1.004, "time_offset_s": 0.001},
    "map": {
        "landmarks": [
            {"id": 3, "position": [1.0, 2.0, 0.3], "quaternion": [0.0, 0.0, 0.0, 1.0], "size": 0.2},
            {"id": 4, "position": [2.0, 2.0, 0.3], "quaternion": [0.0, 0.0, 0.0, 1.0], "size": 0.2},
        ]
    },
    "believed": {
        "camera": {"focal_px": 525.0},
        "wheels": {"left_radius": 0.05, "right_radius": 0.05, "track": 0.26},
    },
}


def result(errors_xyyaw, sigmas=(0.1, 0.1, 0.1)):
    """A run that is off by this much at each second."""
    n = len(errors_xyyaw)
    stamps = np.arange(n) * SECOND
    truth = np.zeros((n, 3))
    covs = np.tile(np.diag(np.square(sigmas)), (n, 1, 1))
    estimate = Trajectory(stamps, truth + errors_xyyaw, covs)
    return RunResult(estimate, (), (), {}, {}, (), np.ones(n), 1.0, truth=Trajectory(stamps, truth))


def landmark_map(**shifts):
    """The survey: markers 3 and 4, shifted along x."""
    true = {m["id"]: np.array(m["position"]) for m in INSTALLED["map"]["landmarks"]}
    places = {i: place + np.array([shifts.get(f"m{i}", 0.0), 0.0, 0.0]) for i, place in true.items()}
    return LandmarkMap({i: Landmark(i, place, np.eye(3), 0.2) for i, place in places.items()})


def scores(ate=1.0, batch=1.0, nees=1.0, **changes):
    return Scores(Errors(ate, 0.1, nees), Errors(batch, 0.1, nees), 100, 0.0, 0.0, (1.0, 2.0), **changes)


def decision(kind, reason=""):
    return Decision(0, 0, kind, -1, 0.0, 0.0, 2, 0.0 if reason else 1.0, reason)


def test_errors_are_means_and_the_unknown_time_is_not_asked_for_honesty():
    off = np.array([[0.03, 0.04, 0.0], [0.0, 0.0, 0.1], [3.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    found = errors(result(off), Config(), (2 * SECOND, 3 * SECOND))
    assert found.ate_mm == pytest.approx((50.0 + 0.0 + 5000.0 + 0.0) / 4)
    assert found.yaw_deg == pytest.approx(math.degrees(0.1) / 4)
    assert found.nees_over_3 == pytest.approx((0.25 + 1.0 + 0.0) / 3 / 3)
    assert errors(result(off), Config()).nees_over_3 == pytest.approx((0.25 + 1.0 + 2500.0) / 4 / 3)


def test_a_run_without_truth_cannot_be_scored():
    with pytest.raises(ValueError, match="truth"):
        errors(replace(result(np.zeros((3, 3))), truth=None), Config())


def test_a_robot_that_was_carried_away_may_be_lost_until_a_second_after_it_sees():
    stamps = np.arange(8) * SECOND
    modes = [Mode.OK, Mode.LOST, Mode.LOST, Mode.LOST, Mode.LOST, Mode.LOST, Mode.DEAD_RECKONING, Mode.OK]
    assert lost_share(modes, stamps) == pytest.approx(5 / 8)
    assert lost_share(modes, stamps, (2 * SECOND, 4 * SECOND)) == pytest.approx(2 / 8)


def test_only_sightings_are_refused():
    rows = [decision("corners"), decision("corners", "nis"), decision("wheels", "slip"), decision("range_bearing")]
    assert refused_share(rows) == pytest.approx(1 / 3)
    assert math.isnan(refused_share([decision("wheels")]))


def test_the_truth_has_the_names_of_the_documentation():
    truth = truth_values(INSTALLED)
    assert truth["camera.time_offset_s"] == pytest.approx(0.014)
    assert truth["wheels.time_offset_s"] == pytest.approx(-0.005)
    assert truth["camera.focal_scale"] == pytest.approx(528.0 / 525.0)
    assert truth["wheels.radius_scale"] == pytest.approx(1.0)
    assert truth["wheels.radius_ratio"] == pytest.approx(0.0505 / 0.0495)
    assert truth["wheels.track_scale"] == pytest.approx(1.01)
    assert truth["gyro.scale"] == 1.004
    assert (truth["camera.x"], truth["camera.pitch"], truth["camera.cy_px"], truth["map.3.y"]) == (0.11, 0.01, 239, 2)


def test_what_is_found_has_an_error_and_angles_wrap():
    found = found_errors({"camera.yaw": (-3.14, 0.001), "wheels.track_scale": (1.013, 0.002)}, INSTALLED)
    assert found["camera.yaw"] == pytest.approx((math.tau - 6.28, 0.001))
    assert found["wheels.track_scale"] == pytest.approx((0.003, 0.002))
    assert inside(found) == [False, True]
    with pytest.raises(ValueError, match=r"camera\.mood: not in"):
        found_errors({"camera.mood": (1.0, 1.0)}, INSTALLED)


def test_markers_of_which_nothing_is_said_stay_where_the_survey_has_them():
    survey = landmark_map(m3=0.03, m4=0.04)
    found = {"map.3.x": (1.0, 0.001), "map.3.y": (2.0, 0.001), "map.3.z": (0.3, 0.001), "map.4.x": (2.0, 0.001)}
    places = places_in(found)
    assert list(places) == [3]
    assert map_over_survey(places, survey, INSTALLED) == pytest.approx(0.04 / 0.05)
    assert map_over_survey({}, survey, INSTALLED) is None
    assert map_over_survey(places, landmark_map(), INSTALLED) is None


def test_scores_come_back_from_the_cache_as_they_were(tmp_path, monkeypatch):
    monkeypatch.setattr(replays, "cache_folder", lambda: tmp_path)
    slips = Slips((0.2,), (0.05,), (), 1, 3.0)
    made = scores(found={"camera.yaw": (0.1, 0.2)}, textbook_mm={"corners": 3.0}, slips=slips, moved=(3,), failed="no")
    kept_scores("made", lambda: made)
    kept_scores("none", Scores)
    assert kept_scores("made", Scores) == made
    none = kept_scores("none", lambda: made)
    assert none.online is None
    assert math.isnan(none.lost_share)


def row(row_id, found):
    wanted = next(w for w in installed.wanted() if w.id == row_id)
    return wanted.row(row_id, found)


def test_rows_are_means_percentiles_and_root_mean_squares():
    found = [
        scores(ate=1.0, nees=0.5, found={"camera.yaw": (0.01, 0.001), "gyro.scale": (0.0, 1.0)}),
        scores(ate=3.0, nees=1.5, found={"camera.yaw": (-0.03, 0.02), "gyro.scale": (0.0, 1.0)}),
    ]
    made = row("none.online.ate_mm", found)
    assert (made.value, made.spread, made.n, made.unit) == (2.0, 1.0, 2, "mm")
    assert row("slip.batch.nees_over_3", found).value == 1.0
    assert row("none.update_median_ms", found).value == 1.5
    assert row("found.camera_yaw_deg", found).value == pytest.approx(math.degrees(math.sqrt(0.0005)))
    assert row("found.coverage3", found).value == 0.75


def test_a_row_says_why_it_has_no_value():
    assert row("found.track_percent", [scores(), scores()]).reason.startswith("in 2 of 2 runs: ")
    failed = [scores(), Scores(failed="EstimatorError: lost")]
    assert row("none.online.ate_mm", failed).reason == "in 1 of 2 runs: EstimatorError: lost"
    unsmoothed = [scores(), replace(scores(), batch=None, batch_failed="EstimatorError: no")]
    assert row("none.batch.ate_mm", unsmoothed).reason == "in 1 of 2 runs: EstimatorError: no"
    assert row("none.online.ate_mm", unsmoothed).value == 1.0


def test_the_best_pipeline_of_the_textbook_is_that_with_the_least_mean():
    found = [
        scores(ate=2.0, textbook_mm={"marker_poses": 9.0, "corners": 1.0, "corners_rules": 4.0}),
        scores(ate=2.0, textbook_mm={"marker_poses": 9.0, "corners": 100.0, "corners_rules": 8.0}),
    ]
    made = row("textbook.none.best_over_fgloc", found)
    assert (made.value, made.spread, made.n) == (3.0, 1.0, 2)


def test_ids_are_unique_and_cells_are_ordered_by_recording():
    ids = [w.id for w in installed.wanted()]
    assert len(ids) == len(set(ids))
    assert {f"{case}.online.nees_over_3" for case in CASES} < set(ids)
    assert floor("dark60") == "patches"
    assert Cell(Take("found", "patches", "test", 61), "none") < Cell(Take("perfect", "patches", "test", 61), "none")


# --- The textbook -----------------------------------------------------------------------------------------------------

LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]])
CAMERA = Camera(
    640, 480, "plumb_bob", np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), np.zeros(5), LOOKS_AHEAD
)
FACING = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # towards the robot that drives along x
WALL = LandmarkMap({i: Landmark(i, np.array([4.0, y, 0.4]), FACING, 0.2) for i, y in enumerate((-0.5, 0.6))})
WHEELS = WheelsConfig(
    source="ticks", left_joint="left", right_joint="right", left_radius=0.05, right_radius=0.05, track=0.26
)


def drive(seconds=10.0, speed=0.2, slip=(), carried_m=0.0, carried_s=math.inf):
    """Steps of 0.2 s straight ahead; in ``slip`` the right wheel runs away, and the robot may be put ahead once."""
    out, left, right, x = [], 0.0, 0.0, 0.0
    truth = []
    for k in range(1, round(seconds / 0.2) + 1):
        start, end = (k - 1) * SECOND // 5, k * SECOND // 5
        joints = []
        for i in range(5):
            at = start + i * SECOND // 20
            joints.append(
                JointsEvent(at, at, "/joints", ("left", "right"), np.array([left, right]), np.empty(0), np.empty(0))
            )
            if i < 4:
                left += 0.05 * speed / 0.05
                right += 0.05 * speed / 0.05 * (3.0 if any(a <= k * 0.2 <= b for a, b in slip) else 1.0)
        x += 0.2 * speed + (carried_m if math.isclose(k * 0.2, carried_s) else 0.0)
        gyro = tuple(
            ImuEvent(start + i * SECOND // 50, 0, "/imu", "imu", np.zeros(3), np.zeros(3), np.eye(3)) for i in range(11)
        )
        seen = tuple(
            MarkerCorners(i, project(landmark, x)) for i, landmark in WALL.landmarks.items() if x < landmark.position[0]
        )
        event = CornersEvent(end, end, "/image", "cam", seen)
        out.append(Step(k, 0, start, end, by_class((*joints, *gyro)), (event,)))
        truth.append(x)
    return out, np.array(truth)


def project(landmark, x):
    T = np.linalg.inv(LOOKS_AHEAD)
    points = (landmark.corners() - [x, 0.0, 0.0]) @ T[:3, :3].T + T[:3, 3]
    pixels = points @ CAMERA.K.T
    return pixels[:, :2] / pixels[:, 2:]


def farthest(pipeline, steps, truth):
    estimates = Textbook(pipeline, WALL, CAMERA, WHEELS).run(steps)
    assert len(estimates) == len(steps)
    return np.abs(np.array([e.pose[0] for e in estimates]) - truth)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_the_textbook_follows_a_drive(pipeline):
    steps, truth = drive()
    assert farthest(pipeline, steps, truth).max() < 0.005


def test_the_rule_for_the_gyro_drops_wheels_that_slip():
    steps, truth = drive(slip=[(4.0, 6.0)])
    off = {pipeline: farthest(pipeline, steps, truth).max() for pipeline in ("corners", "corners_rules")}
    assert off["corners_rules"] < 0.005
    assert off["corners_rules"] < off["corners"]


def test_the_rule_for_refused_markers_starts_again():
    steps, truth = drive(seconds=12.0, carried_m=1.2, carried_s=4.0)
    off = farthest("corners_rules", steps, truth)
    assert off[20] > 0.5
    assert off[-20:].max() < 0.005
