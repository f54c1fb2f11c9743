"""Maps with more landmarks than can be states: those seen last are, the places of the others are noise."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from test_graph import break_down

from fgloc import se2
from fgloc.config import BatchConfig, Config, EstimatorConfig
from fgloc.graph.batch import BatchSmoother, of_whole_run
from fgloc.graph.estimators import ExtendedKalmanFilter, IncrementalEstimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import installation_of, is_vacant
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.state import InstallationState, resumed_installation
from fgloc.sensors.measurements import PointMeasurement
from fgloc.types import Landmark, LandmarkMap, MotionMeasurement

PLACED = 0.05  # m: sigma of the map
MOST = 12  # landmarks that are states, eight at first; about three are in view
SETTINGS = Config.model_validate({"map": {"position_sigma_m": PLACED}, "landmarks": {"range_scale_sigma": 0.0}})
R = np.diag([0.005, 0.01]) ** 2
STEP, Q = np.array([0.2, 0.0, 0.0]), np.diag([0.004, 0.002, 0.003]) ** 2


def corridor(n: int) -> LandmarkMap:
    """Beacons every metre, left and right in turn."""
    return LandmarkMap(
        {i: Landmark(i, np.array([1.0 * i, 2.0 - 4.0 * (i % 2), 0.0]), np.eye(3), 0.0) for i in range(n)}
    )


def driven(estimator, landmark_map: LandmarkMap, rng, given=True) -> list[tuple[np.ndarray, PoseWithCovariance]]:
    """True pose and belief at each step along the corridor, whose beacons are off by the sigma of the map."""
    true = {i: one.position[:2] + rng.normal(0.0, PLACED, 2) for i, one in landmark_map.landmarks.items()}
    truth, found = np.zeros(3), []
    estimator.start(0, PoseWithCovariance(truth, np.eye(3) * 1e-4))
    for k in range(1, 5 * (len(true) - 4)):
        truth = se2.compose(truth, STEP)
        measured = se2.compose(STEP, se2.exp(rng.multivariate_normal(np.zeros(3), Q)))
        seen = []
        for i, place in true.items():
            x, y, _ = se2.between(truth, (*place, 0.0))
            if 0.3 < x < 3.0:
                bearing, distance = rng.multivariate_normal((math.atan2(y, x), math.hypot(x, y)), R)
                m = PointMeasurement(k, i, float(distance), float(bearing), R)
                seen.append(estimator.factors.sighting(k, m, None))
        motion = MotionMeasurement("wheels", k - 1, k, measured, Q)
        if given:
            estimator.give_states(seen)
        found.append((truth, estimator.update(k * 10**8, 0.1, [motion], seen)))
    return found


def nees_over_3(found) -> float:
    errors = [(se2.log(se2.between(truth, belief.pose)), belief.cov) for truth, belief in found]
    return float(np.mean([e @ np.linalg.solve(cov, e) for e, cov in errors])) / 3.0


def test_a_landmark_takes_vacant_rows_and_gives_them_up_with_its_prior():
    held = dict(corridor(MOST + 2).landmarks)
    held[7] = replace(held[7], cov=np.array([[0.04, 0.01], [0.01, 0.09]]))
    made = installation_of(SETTINGS, LandmarkMap(held), False, most=MOST)
    constants = [name for name in made.names if not name.startswith("map.")]
    assert made.vacancies == 8
    assert not made.landmarks
    added = made.grow()
    assert made.vacancies == MOST
    assert added.stop - added.start == 2 * (MOST - 8)
    assert made.grow().stop == made.constants == len(made)  # no more than that
    n = len(made)
    assert set(made.stateless) == set(held)
    rows = made.occupy(7)
    assert made.landmarks == {7: (rows.start, 2)}
    assert made.names[rows] == ("map.7.x_m", "map.7.y_m")
    assert made.prior().cov[rows, rows] == pytest.approx(held[7].cov)
    assert made.vacate(7) == rows
    assert made.stateless[7] == pytest.approx(held[7].cov)
    assert all(is_vacant(name) for name in made.names[rows])
    assert len(set(made.names)) == len(made.index) == n
    assert [made.names[i] for i in made.motion_rows] == [name for name in constants if "sightings" not in name]


def test_markers_and_points_of_one_map_take_each_others_rows():
    held = {i: Landmark(i, np.array([1.0 * i, 0.0, 0.0]), np.eye(3), 0.2 if i < 8 else 0.0) for i in range(20)}
    made = installation_of(SETTINGS, LandmarkMap(held), True, most=MOST)
    for i in range(8):
        made.occupy(i)  # all markers; only points are left
    made.grow()
    for i in (9, 10, 11):
        made.occupy(i)
    for i in (9, 0):
        made.vacate(i)
    for i in (12, 0):
        made.occupy(i)
    taken = sorted((first, first + count) for first, count in made.landmarks.values())
    assert all(end <= after for (_, end), (after, _) in pairwise(taken))
    assert {count for i, (_, count) in made.landmarks.items() if i < 8} == {6}
    assert len(set(made.names)) == len(made)
    assert all(made.names[made.landmarks[i][0]] == f"map.{i}.x_m" for i in made.landmarks)


def test_forty_landmarks_are_states_all_the_time_and_of_more_forty_at_a_time():
    few, many = (installation_of(SETTINGS, corridor(n), False) for n in (40, 41))
    assert len(few.landmarks) == 40
    assert not few.stateless
    assert len(many.stateless) == 41
    assert many.most == 40


@pytest.mark.parametrize("kind", ["fixed_lag", "ekf"])
def test_covariances_along_a_large_map_are_right_with_no_more_states_than_are_allowed(kind):
    landmark_map, found, exact = corridor(4 * MOST), [], []
    for seed in range(3):
        for given, into in ((True, found), (False, exact)):
            factors = LandmarkFactors(landmark_map, installation_of(SETTINGS, landmark_map, False, most=MOST))
            if not given:
                factors.installation.stateless.clear()
            made = ExtendedKalmanFilter if kind == "ekf" else IncrementalEstimator
            estimator = made(EstimatorConfig(kind=kind, lag_s=2.0), factors)
            into += driven(estimator, landmark_map, np.random.default_rng(seed), given)
            states = factors.installation.landmarks
            assert (0 < len(states) <= MOST) == given
            assert not given or set(range(4 * MOST - 8, 4 * MOST - 5)) <= set(states)
    assert 0.6 < nees_over_3(found) < 1.5
    assert nees_over_3(exact) > 3.0  # what the map's sigma is ignored for


def test_the_whole_run_has_those_landmarks_as_states_that_were_seen():
    landmark_map = corridor(MOST + 10)
    factors = LandmarkFactors(landmark_map, installation_of(SETTINGS, landmark_map, False, most=MOST))
    estimator = IncrementalEstimator(EstimatorConfig(lag_s=2.0), factors, keep_all=True)
    found = driven(estimator, landmark_map, np.random.default_rng(5))
    whole = of_whole_run(estimator.log, factors)
    seen = {s.measurement.landmark_id for frame in estimator.log.keyframes.values() for s in frame.sightings}
    assert set(whole.installation.landmarks) == seen
    assert set(whole.installation.stateless) == set(landmark_map.landmarks) - seen
    assert not any(is_vacant(name) for name in whole.installation.names)
    result = BatchSmoother(estimator.log, whole, BatchConfig(), 1 - 1e-9).result()
    smoothed = [
        (truth, PoseWithCovariance(pose, cov))
        for (truth, _), pose, cov in zip(found, result.poses[1:], result.covs[1:], strict=True)
    ]
    assert nees_over_3(smoothed) < 1.8
    assert of_whole_run(estimator.log, whole).installation.landmarks == whole.installation.landmarks


def test_a_map_that_has_few_landmarks_has_all_as_states():
    landmark_map = corridor(MOST)
    factors = LandmarkFactors(landmark_map, installation_of(SETTINGS, landmark_map, False, most=MOST))
    assert len(factors.installation.landmarks) == MOST
    assert not factors.installation.stateless
    estimator = IncrementalEstimator(EstimatorConfig(), factors, keep_all=True)
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-4))
    assert estimator.give_states([]) == (slice(0, 0), [])
    assert of_whole_run(estimator.log, factors) is factors


@pytest.mark.parametrize(("kind", "made"), [("fixed_lag", IncrementalEstimator), ("ekf", ExtendedKalmanFilter)])
def test_landmarks_seen_from_a_first_pose_are_states(kind, made):
    landmark_map = corridor(4 * MOST)
    factors = LandmarkFactors(landmark_map, installation_of(SETTINGS, landmark_map, False, most=MOST))
    estimator, landmarks = made(EstimatorConfig(kind=kind), factors), factors.installation.landmarks
    seen = [factors.sighting(0, PointMeasurement(0, i, math.hypot(1.0, 2.0), -1.1, R), None) for i in (1, 2)]
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-4), seen[:1])
    assert landmarks.keys() == {1}
    estimator.give_states(seen)
    assert landmarks.keys() == {1, 2}


def test_a_saved_state_gives_the_landmarks_that_were_states_their_rows_again():
    def fresh():
        landmark_map = corridor(2 * MOST)
        return installation_of(SETTINGS, landmark_map, False, most=MOST)

    before, rng = fresh(), np.random.default_rng(0)
    for i in (9, 3, 12):
        before.occupy(i)
    before.vacate(3)
    A = rng.normal(size=(len(before), len(before)))
    saved = InstallationState(names=before.names, mean=rng.normal(size=len(before)).tolist(), cov=(A @ A.T).tolist())
    after = fresh()
    known = resumed_installation(saved, after)
    assert set(after.landmarks) == {9, 12}
    for name in before.names:
        if not is_vacant(name):
            assert known.mean[after.index[name]] == saved.mean[before.index[name]]
    a, b = after.index["map.12.y_m"], after.index["sightings.bearing_offset_rad"]
    assert known.cov[a, b] == saved.cov[before.index["map.12.y_m"]][before.index["sightings.bearing_offset_rad"]]
    other = installation_of(Config(), corridor(2 * MOST), True, most=MOST)
    assert resumed_installation(saved, other) is None


def seen_from_rest(breaks: bool, given: bool, most: int) -> PoseWithCovariance:
    """Belief of a robot that stands and sees two beacons from the seventh keyframe on."""
    landmark_map = corridor(4 * MOST)
    factors = LandmarkFactors(landmark_map, installation_of(SETTINGS, landmark_map, False, most=most))
    estimator = IncrementalEstimator(EstimatorConfig(), factors)
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.diag([0.5, 0.5, 0.1]) ** 2))
    motion = MotionMeasurement("wheels", 0, 1, np.zeros(3), Q)
    for k in range(1, 20):
        seen = [PointMeasurement(k, i, math.hypot(i, 2.0), math.atan2(2.0 - 4.0 * (i % 2), i), R) for i in (1, 2)]
        logged = [factors.sighting(k, m, None) for m in seen if k > 6]
        if given:
            estimator.give_states(logged)
        estimator.update(k * 10**8, 0.1, [motion], logged)
    if breaks:
        break_down(estimator)
    belief = estimator.update(20 * 10**8, 0.1, [motion], logged if breaks else ())
    assert estimator.rebuilt == breaks
    return belief


def test_a_landmark_that_becomes_a_state_counts_what_the_map_says_of_it_once():
    one_of_many, one_of_few = seen_from_rest(False, True, MOST), seen_from_rest(False, False, 4 * MOST)
    assert one_of_many.cov == pytest.approx(one_of_few.cov, rel=1e-3, abs=1e-9)


def test_a_window_that_is_built_again_keeps_what_the_map_says_of_landmarks_that_became_states_in_it():
    usual, rebuilt = (seen_from_rest(breaks, True, MOST) for breaks in (False, True))
    assert rebuilt.cov == pytest.approx(usual.cov, rel=1e-3, abs=1e-9)


def in_second_segment(kind: str, most: int, breaks: bool = False) -> PoseWithCovariance:
    """Belief of a robot that begins anew where it sees two beacons that it never saw, and later another one."""
    landmark_map, settings = corridor(4 * MOST), SETTINGS.model_copy(update={"estimator": EstimatorConfig(kind=kind)})
    factors = LandmarkFactors(landmark_map, installation_of(settings, landmark_map, False, most=most))
    estimator = (ExtendedKalmanFilter if kind == "ekf" else IncrementalEstimator)(settings.estimator, factors)
    motion = MotionMeasurement("wheels", 0, 1, np.zeros(3), Q)
    for k, ids in enumerate([(1,), (1,), (2, 3), (2, 3, 4), (2, 3, 4), (2, 3, 4)]):
        seen = [PointMeasurement(k, i, math.hypot(i, 2.0), math.atan2(2.0 - 4.0 * (i % 2), i), R) for i in ids]
        logged = [factors.sighting(k, m, None) for m in seen]
        if k in (0, 2):
            estimator.start(k * 10**8, PoseWithCovariance(np.zeros(3), np.diag([0.5, 0.5, 0.1]) ** 2), logged)
            continue
        if breaks and k == 5:
            break_down(estimator)
        estimator.give_states(logged)
        estimator.update(k * 10**8, 0.1, [motion], logged)
    assert estimator.rebuilt == breaks
    assert estimator.belief is not None
    return estimator.belief


@pytest.mark.parametrize(
    ("kind", "breaks"), [("fixed_lag", False), ("fixed_lag", True), ("isam2", False), ("isam2", True), ("ekf", False)]
)
def test_landmarks_that_become_states_in_a_second_segment_have_the_sigma_of_the_map(kind, breaks):
    one_of_many, one_of_few = (in_second_segment(kind, most, breaks) for most in (MOST, 4 * MOST))
    assert one_of_many.cov == pytest.approx(one_of_few.cov, rel=1e-3, abs=1e-9)


def test_a_filter_whose_earlier_motions_change_keeps_what_the_map_says_of_landmarks_that_became_states_since():
    landmark_map = corridor(4 * MOST)
    factors = LandmarkFactors(landmark_map, installation_of(SETTINGS, landmark_map, False, most=MOST))
    estimator = ExtendedKalmanFilter(EstimatorConfig(kind="ekf"), factors)
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.diag([0.5, 0.5, 0.1]) ** 2))
    motion = MotionMeasurement("wheels", 0, 1, np.zeros(3), Q)
    for k in range(1, 5):
        seen = [PointMeasurement(k, i, math.hypot(i, 2.0), math.atan2(2.0 - 4.0 * (i % 2), i), R) for i in (1, 2)]
        logged = [factors.sighting(k, m, None) for m in seen if k > 2]
        estimator.give_states(logged)
        before = estimator.update(k * 10**8, 0.1, [motion], logged)
    estimator.revise({k: [motion] for k in range(1, 5)})
    assert estimator.belief.cov == pytest.approx(before.cov, rel=1e-6)
