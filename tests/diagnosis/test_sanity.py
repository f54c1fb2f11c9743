"""An estimate that explains a recording worse than odometry alone is not given; a sound one is never doubted."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from robot_world import points, polar

from fgloc import se2
from fgloc.ablation.failures import events_of
from fgloc.cli.terminal import EXIT_LOST, exit_code
from fgloc.config import Config, config_of, load_config
from fgloc.diagnosis import sanity
from fgloc.diagnosis.sanity import Placed, Track, Watch, chained, compared, gyro_agrees, judged
from fgloc.errors import FglocError
from fgloc.estimation.localizer import Localizer
from fgloc.evaluation.metrics import compute_metrics
from fgloc.runner import run
from fgloc.sensors.base import with_values
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, Estimate, Mode, MotionMeasurement, Protection, Severity, Step
from fgloc_datasets.bag import BagWriter

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
TICK_NS = SECOND // 5
BEACONS = {1: np.array([3.0, 1.0]), 2: np.array([-1.0, 3.0]), 3: np.array([-2.0, -2.0]), 4: np.array([2.0, -3.0])}
STEP_COV = np.diag([0.004, 0.003, 0.008]) ** 2


def driven(n=400, seed=3):
    """True poses, the odometry's motions with noise and the sightings of a robot on a winding way."""
    rng = np.random.default_rng(seed)
    poses, motions = [np.zeros(3)], [np.zeros(3)]
    for k in range(1, n):
        true = np.array([0.06, 0.0, 0.05 + 0.06 * math.sin(0.07 * k)])
        poses.append(se2.compose(poses[-1], true))
        motions.append(true + rng.normal(0.0, [0.002, 0.001, 0.003]))
    return np.array(poses), np.array(motions), rng


def track_of(poses, motions, rng, known=True, ids=(1, 2, 3, 4), mirror=1.0):
    n = len(poses)
    seen = [(k, i) for k in range(0, n, 2) for i in ids]
    places = np.array([se2.compose(se2.inverse(poses[k]), (*BEACONS[i], 0.0))[:2] for k, i in seen]).reshape(-1, 2)
    places = places * [1.0, mirror] + rng.normal(0.0, 0.02, places.shape)
    stamps = T0 + np.arange(n) * TICK_NS
    return Track(
        stamps,
        np.ones(n, dtype=np.int64),
        motions,
        np.tile(STEP_COV, (n, 1, 1)),
        np.array([stamps[k] for k, _ in seen], dtype=np.int64),
        np.array([i for _, i in seen], dtype=np.int64),
        places,
        np.zeros((len(seen), 2)),
        np.full(len(seen), 0.05),
        BEACONS if known else None,
        0.01,
        0.01,
    )


def estimates(track, poses):
    return [Estimate(int(t), p, np.eye(3) * 1e-4) for t, p in zip(track.stamps_ns, poses, strict=True)]


def codes(verdict):
    return [finding.code for finding in verdict.findings]


@pytest.mark.parametrize("known", [True, False])
def test_a_sound_estimate_is_not_doubted(known):
    poses, motions, rng = driven()
    track = track_of(poses, motions, rng, known)
    verdict = judged(track, estimates(track, poses))
    assert not verdict.findings
    assert verdict.simpler is None
    assert len(verdict.odometry) == len(poses)


def test_slip_is_not_held_against_the_estimate():
    poses, motions, rng = driven()
    motions[100:180, 0] += 0.08  # the wheels spin for a fifth of the run
    for known in (True, False):
        track = track_of(poses, motions, rng, known)
        assert not judged(track, estimates(track, poses)).findings


def test_wheels_of_a_wrong_size_do_not_outweigh_a_surveyed_map():
    poses, motions, rng = driven()
    motions[:, :2] *= 3.28
    track = track_of(poses, motions, rng)
    assert judged(track, estimates(track, poses)).simpler is None


def test_a_runaway_scale_gives_odometry_instead():
    poses, motions, rng = driven()
    track = track_of(poses, motions, rng, known=False)
    far = poses * [-3657.0, -3657.0, 1.0]
    verdict = judged(track, estimates(track, far))
    assert codes(verdict) == ["sanity.odometry"]
    given = np.array([e.pose for e in verdict.simpler])
    assert np.hypot(*(given - poses)[:, :2].T).max() < 1.0
    assert all(e.mode is Mode.DEAD_RECKONING for e in verdict.simpler)


def test_without_a_map_the_wheels_are_the_measure_of_length():
    poses, motions, rng = driven()
    track = track_of(poses, motions, rng, known=False)
    assert codes(judged(track, estimates(track, poses * [1.11, 1.11, 1.0]))) == ["sanity.odometry"]


@pytest.mark.parametrize(("sigma", "code"), [(0.01, "sanity.odometry"), (0.05, "sanity.unsure")])
def test_wheels_that_are_hardly_known_are_no_measure_of_length(sigma, code):
    poses, motions, rng = driven()
    track = dataclasses.replace(track_of(poses, motions, rng, known=False), scale_sigma=sigma)
    assert codes(judged(track, estimates(track, poses * [1.06, 1.06, 1.0]))) == [code]


def test_a_landmark_that_was_seen_once_explains_nothing_without_a_map():
    poses, motions, rng = driven(100)
    track = track_of(poses, motions, rng, known=False)
    once = dataclasses.replace(track, ids=np.where(np.arange(len(track.ids)) % 2, 100 + np.arange(len(track.ids)), 1))
    assert compared(once, poses * [9.0, 9.0, 1.0], None).explained < 0.2


def test_poses_that_are_not_finite_are_not_given():
    poses, motions, rng = driven()
    track = track_of(poses, motions, rng, ids=())
    lost = poses.copy()
    lost[50:, 0] = np.nan
    verdict = judged(track, estimates(track, lost))
    assert codes(verdict) == ["sanity.odometry"]
    assert np.isfinite([e.pose for e in verdict.simpler]).all()
    assert (np.linalg.eigvalsh([e.cov for e in verdict.simpler])[:, 0] > 0.0).all()


def test_an_estimate_that_stands_while_the_wheels_drive_needs_a_sighting():
    poses, motions, rng = driven()
    track = track_of(poses, motions, rng, known=False, ids=())
    stuck = poses.copy()
    stuck[100:, :2] = stuck[100, :2]
    assert codes(judged(track, estimates(track, stuck))) == ["sanity.odometry"]


@pytest.mark.parametrize("most", [3000, 150])  # poses of the textbook's smoother: of 600 keyframes all, or some
def test_the_textbook_is_given_where_it_alone_explains_the_sightings(monkeypatch, most):
    monkeypatch.setattr(sanity, "_MOST_POSES", most)
    poses, motions, rng = driven(600)
    motions[:, 2] += 0.004  # odometry alone drifts off
    track = track_of(poses, motions, rng)
    wrong = poses + np.array([1.5, 0.0, 0.0])
    verdict = judged(track, estimates(track, wrong))
    assert codes(verdict) == ["sanity.textbook"]
    given = np.array([e.pose for e in verdict.simpler])
    assert np.hypot(*(given - poses[:: 600 // min(most, 600)])[:, :2].T).max() < 0.1


def test_odometry_in_place_of_the_estimate_has_an_honest_covariance():
    nees = []
    for seed in range(12):
        poses, motions, rng = driven(seed=seed)
        motions[:, 0] *= 1.0 + rng.normal(0.0, 0.01)
        track = track_of(poses, motions, rng, known=False, ids=())
        far = poses * [9.0, 9.0, 1.0]
        last = judged(track, estimates(track, far)).simpler[-1]
        off = last.pose - poses[-1]
        off[2] = se2.wrap(off[2])
        nees.append(off @ np.linalg.solve(last.cov, off) / 3.0)
    assert 0.02 < np.mean(nees) < 2.0


def test_the_odometry_adds_up_motions_to_the_side_too_and_stands_where_one_is_not_known():
    poses, motions, rng = driven(50)
    motions[:, 1] = 0.03
    joined = np.ones(50, dtype=np.int64)
    joined[20] = 0
    track = dataclasses.replace(track_of(poses, motions, rng, ids=()), joined=joined)
    expected = [np.zeros(3)]
    for k in range(1, 50):
        expected.append(se2.compose(expected[-1], motions[k] * joined[k]))
    np.testing.assert_allclose(chained(track), expected, atol=1e-9)


@pytest.mark.parametrize("coordinate", [0, 2], ids=["way", "turn"])
def test_odometry_is_as_uncertain_as_the_wheels_scales_times_the_way(coordinate):
    motions = np.zeros((200, 3))
    motions[1:, coordinate] = 0.1
    track = dataclasses.replace(
        track_of(np.zeros((200, 3)), motions, np.random.default_rng(0), ids=()), covs=np.zeros((200, 3, 3))
    )
    given = judged(track, estimates(track, np.cumsum(motions, axis=0))).odometry
    grown = given.covs[-1] - given.covs[0]
    assert math.sqrt(grown[coordinate, coordinate]) == pytest.approx(0.01 * 19.9, rel=0.01)


def watched(poses, given, motions, seen=None, mapped=True):
    """Estimates that a watch returns, one for each step; ``seen``: of each step."""
    watch, out = Watch(mapped, Config()), []
    for k in range(len(poses)):
        stamp = T0 + k * TICK_NS
        step = Step(k, 0, stamp - TICK_NS, stamp)
        measured = MotionMeasurement("wheels", step.start_ns, stamp, motions[k], STEP_COV)
        bound = Protection(np.full(3, 0.05), 0.05, "noise")
        estimate = Estimate(stamp, given[k], np.eye(3) * 1e-4, protection=bound)
        out.append(watch.checked(step, measured, k > 0, estimate, [] if seen is None else seen[k]))
    return watch, out


def test_a_watch_leaves_sound_estimates_as_they_are():
    poses, motions, _ = driven()
    watch, out = watched(poses, poses, motions, mapped=False)
    assert not watch.findings()
    assert all(np.array_equal(e.pose, p) for e, p in zip(out, poses, strict=True))


def test_a_watch_carries_the_last_sane_pose_on_and_ends_when_the_estimate_is_sane_again():
    poses, motions, _ = driven()
    given = poses.copy()
    given[200:300, 0] += 1e6
    watch, out = watched(poses, given, motions, mapped=False)
    off = np.array([math.hypot(*(e.pose - p)[:2]) for e, p in zip(out, poses, strict=True)])
    assert off.max() < 0.5
    assert {e.mode for e in out[200:215]} == {Mode.DEAD_RECKONING}
    assert all(e.protection.alert and e.protection.position_m == math.inf for e in out[200:215])
    assert not out[199].protection.alert
    assert np.trace(out[214].cov) > np.trace(out[201].cov)
    assert [f.code for f in watch.findings()] == ["sanity.odometry"]


def test_a_watch_forgets_what_was_sound_more_than_two_minutes_ago():
    """After five minutes the estimate is twice as fast as the odometry, for two."""
    poses, motions, _ = driven(n=2100)
    given = list(poses[:1500])
    for motion in motions[1500:]:
        given.append(se2.compose(given[-1], motion * [2.0, 1.0, 1.0]))
    _, out = watched(poses, np.array(given), motions, mapped=False)
    assert all(e.mode is not Mode.DEAD_RECKONING for e in out[:1500])
    assert out[-1].mode is Mode.DEAD_RECKONING


def test_a_watch_still_sees_an_estimate_depart_after_poses_that_are_not_finite():
    poses, motions, _ = driven(n=1400)
    given = list(poses[:400])
    for motion in motions[400:]:
        given.append(se2.compose(given[-1], motion * [2.0, 1.0, 1.0]))
    given = np.array(given)
    given[600:660] = math.nan
    _, out = watched(poses, given, motions)
    assert out[1100].mode is Mode.DEAD_RECKONING
    assert np.isfinite([e.pose for e in out]).all()


def test_a_watch_is_causal():
    poses, motions, _ = driven()
    given = poses.copy()
    given[200:, 0] += 1e6
    _, whole = watched(poses, given, motions, mapped=False)
    _, part = watched(poses[:250], given[:250], motions[:250], mapped=False)
    assert all(np.array_equal(a.pose, b.pose) for a, b in zip(whole[:250], part, strict=True))


def seen_from(poses, landmark=(5.0, 4.0), off=(0.0, 0.0)):
    """One sighting of a landmark by each pose; ``off`` from where it is."""
    places = [se2.placed(se2.inverse(pose), np.array(landmark)) + off for pose in poses]
    return [[Placed(place, np.array(landmark), 0.05)] for place in places]


def test_a_watch_gives_the_odometry_where_it_explains_the_sightings_and_the_estimate_does_not():
    poses, motions, _ = driven()
    given = poses + np.linspace(0.0, 5.0, len(poses))[:, None] * [1.0, 0.0, 0.0]
    watch, out = watched(poses, given, motions, seen_from(poses))
    assert watch.findings()
    assert math.hypot(*(out[-1].pose - poses[-1])[:2]) < math.hypot(*(given[-1] - poses[-1])[:2])


def test_a_watch_gives_the_odometry_that_explains_more_than_an_estimate_that_explains_some():
    poses, motions, _ = driven()
    given = poses + np.linspace(0.0, 10.0, len(poses))[:, None] * [1.0, 0.0, 0.0]
    true, as_given = seen_from(poses), seen_from(given)
    watch, _ = watched(poses, given, motions, [as_given[k] if k % 3 == 0 else true[k] for k in range(len(poses))])
    assert watch.findings()


def test_a_watch_gives_the_odometry_where_sightings_contradict_both():
    poses, motions, _ = driven()
    watch, _ = watched(poses, poses, motions, seen_from(poses, off=(2.0, 0.0)))
    assert watch.findings()


def test_a_watch_leaves_an_estimate_that_explains_few_sightings_where_the_odometry_explains_fewer():
    """More than half of the ids are misread since the wheels slipped."""
    poses, motions, _ = driven(n=2000)  # the slip is forgotten after two minutes, and the ids stay misread
    motions = motions.copy()
    motions[300:320] += [0.1, 0.0, 0.05]
    right, wrong = seen_from(poses), seen_from(poses, off=(2.0, 0.0))
    mixed = [right[k] if k < 330 or k % 5 in (0, 2) else wrong[k] for k in range(len(poses))]
    watch, out = watched(poses, poses, motions, mixed)
    assert not watch.findings()
    assert all(e.protection.position_m < 1.0 for e in out)


def test_a_gyro_of_another_axis_does_not_agree():
    turns = np.array([0.05, -0.03] * 100)
    turns[:100] += 0.05
    assert gyro_agrees(turns, turns * 1.02)
    assert not gyro_agrees(turns, np.zeros(200))


# --- whole runs ---


def bag(folder, n=300, topics=("odometry", "sightings", "truth"), moving=True, hz=10.0):
    """A drive with sightings of the beacons and the truth."""
    with BagWriter(folder / "bag", storage="mcap") as out:
        for k in range(n):
            stamp = T0 + round(k * SECOND / hz)
            speed, turn = (0.3, 0.25) if moving else (0.0, 0.0)
            angle = turn * k / hz
            x, y = (speed / turn * math.sin(angle), speed / turn * (1 - math.cos(angle))) if moving else (0.0, 0.0)
            pose = (x, y, angle)
            if "odometry" in topics:
                covs = (np.eye(6) * 1e-3, np.eye(6) * 1e-3)
                out.odometry("/odom", stamp, pose, (speed, turn), stamp, covs)
            if "imu" in topics:
                out.imu("/imu", stamp, (0.0, 0.0, turn), (0.0, 0.0, 9.81), stamp)
            if "truth" in topics:
                out.planar_truth("/truth", stamp, pose)
            if "sightings" in topics:
                seen = []
                for i, m in points(BEACONS).landmarks.items():
                    seen.append((i, *polar(pose, m)))
                out.range_bearing("/landmarks", stamp, seen, stamp)
    return folder / "bag"


@pytest.mark.parametrize("mode", ["batch", "online"])
def test_a_run_that_is_broken_gives_odometry_and_exit_code_3(tmp_path, monkeypatch, mode):
    path = bag(tmp_path)
    if mode == "online":
        update = Localizer.update

        def broken(self, step):
            estimate = update(self, step)
            late = estimate is not None and step.stamp_ns > T0 + 5 * SECOND
            return dataclasses.replace(estimate, pose=estimate.pose * 1e6) if late else estimate

        monkeypatch.setattr(Localizer, "update", broken)
    else:
        import fgloc.runner as runner

        smooth = runner.smooth_run

        def runaway(parts):
            smoothed = smooth(parts)
            far = [dataclasses.replace(e, pose=e.pose * [-3657.0, 3657.0, 1.0]) for e in smoothed.estimates]
            return dataclasses.replace(smoothed, estimates=far)

        monkeypatch.setattr(runner, "smooth_run", runaway)
    config = Config.model_validate({"truth": {"align": "se2"}})
    result = run(path, None, config, mode, check=False)
    assert "sanity.odometry" in {f.code for f in result.findings}
    assert exit_code(result) == EXIT_LOST
    metrics = compute_metrics(result, config)
    assert metrics.ate_rmse_m < 0.3
    assert metrics.odometry.ate_rmse_m < 0.3


def test_wheels_that_report_once_a_second_are_not_held_against_the_estimate_in_the_dark():
    """A watch that took the steps between two readings for a robot that stands gave the odometry, 0.6 m off."""
    folder = Path(__file__).parents[2] / "datasets" / "samples" / "installed_run"
    config = with_values(load_config(folder / "robot.yaml"), "motion", {"model": None})

    def slowly(events):
        begun, heard = None, -math.inf
        for event in events:
            begun = event.stamp_ns if begun is None else begun
            seconds = (event.stamp_ns - begun) * 1e-9
            wheels = isinstance(event, JointsEvent)
            if (
                seconds > 30.0
                or (wheels and seconds < heard + 0.999)
                or isinstance(event, ControlEvent | OdometryEvent)
            ):
                continue
            heard = seconds if wheels else heard
            if seconds < 10.0 or not isinstance(event, events_of("camera")):
                yield event

    result = run(folder / "bag", folder / "map.yaml", config, "online", events=slowly)
    assert "sanity.odometry" not in {finding.code for finding in result.findings}
    assert compute_metrics(result, result.config).ate_mean_m < 0.1


def test_a_sound_run_has_the_figures_of_odometry_alone_and_no_finding(tmp_path):
    config = Config.model_validate({"truth": {"align": "se2"}})
    result = run(bag(tmp_path), None, config, "batch")
    assert not [f for f in result.findings if f.code.startswith("sanity")]
    assert compute_metrics(result, config).odometry.ate_rmse_m < 0.05


@pytest.mark.parametrize("key", ["range_scale_sigma", "bearing_bias_sigma_rad", "time_offset_sigma_s"])
def test_an_uncertainty_without_effect_is_said(tmp_path, key):
    path, said = bag(tmp_path, 100), {}
    for given in (0.2, 0.0, None):
        config = Config.model_validate({} if given is None else {"landmarks": {key: given}})
        result = run(path, None, config, "online", check=False)
        said[given] = any(f"landmarks.{key}" in f.text for f in result.findings)
    assert said == {0.2: True, 0.0: False, None: False}


# --- bad input: a sentence or figures that mean something, never others ---


@pytest.mark.parametrize("mode", ["batch", "online"])
@pytest.mark.parametrize(
    "asked",
    [
        {"n": 300, "moving": False},  # static
        {"n": 20},  # 2 s
        {"n": 100, "topics": ("odometry",)},  # of one sensor
        {"n": 100, "topics": ("sightings",)},
        {"n": 1},
        {"n": 0},  # silent
    ],
    ids=["static", "2s", "odometry", "sightings", "one", "silent"],
)
def test_bad_input_ends_with_a_sentence_or_with_poses_that_mean_something(tmp_path, mode, asked):
    config = Config.model_validate({"truth": {"align": "se2"}})
    try:
        result = run(bag(tmp_path, **asked), None, config, mode)
    except FglocError as error:
        message = str(error)
        if not message:
            raise
        return
    assert not [f for f in result.findings if f.code.startswith("sanity")]
    poses = result.trajectory.poses
    assert np.isfinite(poses).all()
    seconds = asked["n"] / 10.0
    assert np.hypot(*poses[:, :2].T).max() < (0.1 if asked.get("moving") is False else 0.3 * seconds + 0.5)
    compute_metrics(result, config)


@pytest.mark.parametrize("mode", ["batch", "online"])
@pytest.mark.parametrize(
    ("asked", "code"),
    [({"n": 1, "topics": ("odometry",)}, "run.short"), ({"n": 100, "topics": ("imu",)}, "motion.unmeasured")],
    ids=["one pose", "imu"],
)
def test_figures_that_mean_nothing_are_an_error(tmp_path, mode, asked, code):
    result = run(bag(tmp_path, **asked), None, Config(), mode)
    assert result.findings[0].code == code
    assert result.findings[0].severity is Severity.ERROR


@pytest.mark.parametrize("mode", ["batch", "online"])
def test_wheels_whose_messages_are_all_refused_measure_nothing(tmp_path, mode):
    with BagWriter(tmp_path / "ticks") as writer:
        for k in range(200):
            stamp = 1_700_000_000_000_000_000 + k * 50_000_000
            ticks = 5000.0 * k  # of a motor, not radians
            writer.joints("/joint_states", stamp, ("left_wheel", "right_wheel"), (ticks, ticks), (1e5, 1e5))
    wheels = {"left_joint": "left_wheel", "right_joint": "right_wheel", "left_radius": 0.05, "right_radius": 0.05}
    config = Config.model_validate({"wheels": {"track": 0.3, "source": "ticks", **wheels}})
    result = run(tmp_path / "ticks", None, config, mode)
    assert [f.code for f in result.findings[:2]] == ["wheels.ticks", "motion.unmeasured"]
    assert exit_code(result) == EXIT_LOST


def test_a_sensor_without_its_settings_leaves_a_run_on_a_map_its_odometry(tmp_path):
    with BagWriter(tmp_path / "ranges") as writer:
        for k in range(300):
            stamp = 1_700_000_000_000_000_000 + k * 100_000_000
            writer.odometry("/odom", stamp, (0.02 * k, 0.0, 0.0), (0.2, 0.0))
            writer.range_reading("/ranges", stamp, 2.0, "anchor_1")
    (tmp_path / "map.yaml").write_text("landmarks:\n- {id: 1, position: [0, 0, 0]}\n- {id: 2, position: [3, 0, 0]}\n")
    result = run(tmp_path / "ranges", tmp_path / "map.yaml", config_of({}), "batch")
    assert result.findings[0].code == "map.unused"
    assert "uwb.anchors" in result.findings[0].text
    assert np.hypot(*(result.trajectory.poses[-1] - result.trajectory.poses[0])[:2]) == pytest.approx(6.0, abs=0.2)


@pytest.mark.parametrize("topics", [("imu", "sightings"), ("imu", "odometry")])
def test_an_imu_beside_a_sensor_of_position_or_way_is_enough(tmp_path, topics):
    result = run(bag(tmp_path, n=100, topics=topics), None, Config(), "online")
    assert "motion.unmeasured" not in [finding.code for finding in result.findings]


@pytest.mark.slow
def test_twenty_hours_at_a_low_rate(tmp_path):
    config = Config.model_validate({"keyframes": {"max_interval_s": 60.0}, "wheels": {"hold_s": 60.0}})
    result = run(bag(tmp_path, n=1200, hz=1.0 / 60.0, topics=("odometry",)), None, config, "online")
    assert np.isfinite(result.trajectory.poses).all()
    assert not [f for f in result.findings if f.code.startswith("sanity")]
