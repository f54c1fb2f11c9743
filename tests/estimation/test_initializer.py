"""The first pose from sightings alone: found where they say enough, and not where they do not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from robot_world import CAMERA, config, polar, project, standing

from fgloc import se2
from fgloc.estimation.place import GlobalSearch, InitialPose
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.sensors.measurements import FrameMeasurement, PixelMeasurement, PointMeasurement
from fgloc.types import Landmark, LandmarkMap, MotionMeasurement, Step

TRUTH = np.array([0.4, -0.3, 0.35])
MOTION = np.array([0.08, 0.0, 0.04])
BEARING_RANGE_COV = np.diag([0.015, 0.06]) ** 2
STEP_NS = 200_000_000


def point(number: int, x: float, y: float) -> Landmark:
    return Landmark(number, np.array([x, y, 0.0]), np.eye(3), 0.0)


def landmark_map(*landmarks: Landmark) -> LandmarkMap:
    return LandmarkMap({m.landmark_id: m for m in landmarks})


def seen_point(pose, landmark: Landmark, noise=(0.0, 0.0)) -> PointMeasurement:
    r, bearing = polar(pose, landmark)
    return PointMeasurement(0, landmark.landmark_id, r + noise[0], bearing + noise[1], BEARING_RANGE_COV)


def seen_corners(pose, landmark: Landmark, noise=0.0) -> PixelMeasurement:
    return PixelMeasurement(0, landmark.landmark_id, project(pose, landmark) + noise, 0.5, CAMERA)


class Search:
    """An initializer fed with steps of equal motion."""

    def __init__(self, the_map: LandmarkMap, **sections) -> None:
        self.map = the_map
        self.initializer = GlobalSearch(config(**sections), the_map, LandmarkFactors(the_map))
        self.pose, self.stamp_ns = TRUTH, 0

    @property
    def next_pose(self):
        return se2.compose(self.pose, MOTION) if self.stamp_ns else self.pose

    def step(self, *sightings) -> InitialPose | None:
        """``sightings`` are functions of the true pose."""
        self.pose = self.next_pose
        self.stamp_ns += STEP_NS
        step = Step(0, 0, self.stamp_ns - STEP_NS, self.stamp_ns)
        motion = MotionMeasurement("wheels", step.start_ns, step.stamp_ns, MOTION, np.diag([0.003, 0.002, 0.004]) ** 2)
        return self.initializer.collect(step, [motion], [make(self.pose) for make in sightings])


def close(start: InitialPose | None, pose, metres: float, radians: float) -> bool:
    if start is None:
        return False
    x, y, yaw = np.abs(se2.log(se2.between(start.newest.pose, pose)))
    return math.hypot(x, y) < metres and yaw < radians


def test_one_marker_seen_clearly_gives_the_pose():
    rng = np.random.default_rng(1)
    marker = standing(3, 2.0, 0.4, math.pi + 0.5)
    search = Search(landmark_map(marker))
    start = search.step(lambda pose: seen_corners(pose, marker, rng.normal(0, 0.3, (4, 2))))
    assert close(start, TRUTH, *(3.5 * np.sqrt(np.diag(start.newest.cov))[1:]))
    assert close(start, TRUTH, 0.2, 0.1)
    assert not search.initializer.initializing
    assert len(start.steps) == 1


def test_fault_55_one_marker_far_and_frontal_is_deferred_until_another_is_seen():
    """Seen 7 px wide it says little of the robot's place around it: the first pose waits."""
    far, near = standing(3, 6.4, 1.0, math.pi + 0.1, 0.1), standing(4, 2.4, 0.9, math.pi + 0.6)
    search = Search(landmark_map(far, near))
    noise = np.random.default_rng(2).normal(0, 0.5, (4, 2))
    first = search.step(lambda pose: seen_corners(pose, far, noise))
    assert first is None
    assert close(search.step(lambda pose: seen_corners(pose, near, noise)), search.pose, 0.1, 0.05)


def test_two_landmarks_seen_at_different_steps_are_joined_by_the_motion():
    a, b = point(1, 3.0, 1.0), point(2, 1.0, 3.0)
    search = Search(landmark_map(a, b))
    assert search.step(lambda pose: seen_point(pose, a)) is None
    assert search.step() is None
    start = search.step(lambda pose: seen_point(pose, b))
    assert close(start, search.pose, 0.02, 0.02)
    assert [len(c.sightings) for c in start.steps] == [1, 0, 1]
    back = se2.compose(start.newest.pose, se2.inverse(se2.compose(MOTION, MOTION)))
    assert np.allclose(start.first.pose, back, atol=1e-9)


def test_a_marker_seen_beside_a_beacon_gives_the_pose():
    marker, beacon = standing(3, 2.0, 0.4, math.pi + 0.5), point(1, 3.0, 1.0)
    search = Search(landmark_map(marker, beacon))
    assert search.step(lambda pose: seen_point(pose, beacon)) is None
    assert close(search.step(lambda pose: seen_corners(pose, marker)), search.pose, 0.05, 0.05)


def test_fault_55_one_range_and_bearing_gives_no_pose_however_often():
    a = point(1, 3.0, 1.0)
    search = Search(landmark_map(a, point(2, 0.0, 5.0)))
    rng = np.random.default_rng(0)
    for _ in range(15):
        assert search.step(lambda pose: seen_point(pose, a, rng.normal(0, (0.06, 0.015)))) is None
    assert search.initializer.initializing


def test_marker_poses_give_the_pose_if_their_yaw_is_used():
    marker = standing(3, 2.0, 0.4, math.pi)
    cov = np.diag([0.05, 0.05, 0.05]) ** 2
    search = Search(landmark_map(marker, standing(4, -2.0, 0.4, 0.0)))
    start = search.step(
        lambda pose: FrameMeasurement(0, 3, se2.between(pose, marker.planar), cov),
        lambda pose: FrameMeasurement(0, 4, se2.between(pose, search_map(search, 4).planar), cov),
    )
    assert close(start, TRUTH, 1e-6, 1e-6)


def search_map(search: Search, number: int) -> Landmark:
    return search.map.landmarks[number]


def test_one_wrong_sighting_among_many_does_not_move_the_place():
    rng = np.random.default_rng(4)
    landmarks = [point(i, *rng.uniform(-4, 4, 2)) for i in range(6)]
    search = Search(landmark_map(*landmarks))
    makers = [lambda pose, m=m: seen_point(pose, m, rng.normal(0, (0.06, 0.015))) for m in landmarks[:5]]

    def wrong(pose):
        return PointMeasurement(0, 5, 1.5, -2.0, BEARING_RANGE_COV)

    assert not close(Search(landmark_map(*landmarks)).step(wrong, makers[0]), TRUTH, 0.5, 0.5)
    found = search.step(*makers, wrong) or search.step(*makers) or search.step(*makers)
    assert close(found, search.pose, 0.12, 0.04)


def test_two_equally_good_places_are_not_decided():
    """Two landmarks in a pair of twins: the same two sightings fit twice."""
    twins = [standing(i, 2.5, y, math.pi) for i, y in ((0, 0.4), (1, 40.4))]
    search = Search(landmark_map(*twins))

    def as_both(pose):
        return seen_corners(pose, twins[0])

    def as_other(pose):
        seen = seen_corners(pose, twins[0])
        return PixelMeasurement(0, 1, seen.corners_px, seen.sigma_px, seen.camera)

    assert search.step(as_both, as_other) is None
    assert search.step(as_both, as_other) is None
    assert search.initializer.initializing


def test_beacons_seen_longer_ago_than_steps_are_kept_still_tell_the_place():
    a, b = point(1, 3.0, 1.0), point(2, 1.0, 3.0)
    search = Search(landmark_map(a, b), estimator={"initialise_s": 1.0})
    search.step(lambda pose: seen_point(pose, a))
    for _ in range(6):
        search.step()
    start = search.step(lambda pose: seen_point(pose, b))
    assert close(start, search.pose, 0.05, 0.03)
    assert len(start.steps) == 6


def test_the_covariance_of_the_found_pose_is_that_of_its_spread():
    rng = np.random.default_rng(7)
    landmarks = [point(i, *p) for i, p in enumerate([(3.0, 1.0), (1.0, 3.0), (-2.0, -1.0), (2.0, -3.0)])]
    values = []
    for _ in range(40):
        search = Search(landmark_map(*landmarks))
        start = search.step(*(lambda pose, m=m: seen_point(pose, m, rng.normal(0, (0.06, 0.015))) for m in landmarks))
        error = se2.log(se2.between(start.newest.pose, TRUTH))
        values.append(float(error @ np.linalg.solve(start.newest.cov, error)))
    assert 3.0 * 0.6 < np.mean(values) < 3.0 * 1.5


@pytest.mark.parametrize("markers", [4, 12])
def test_on_a_wrong_map_the_search_stays_bounded(markers):
    """Nothing fits: what is kept, and so the work of a step, stops growing."""
    rng = np.random.default_rng(1)
    landmarks = [standing(i, *rng.uniform(-5, 5, 2), rng.uniform(-3, 3)) for i in range(markers)]
    real = [standing(i, 2.4, -0.2 + 1.2 * i / markers, math.pi) for i in range(markers)]
    search = Search(landmark_map(*landmarks), estimator={"initialise_s": 2.0})
    for k in range(15):
        visible = [m for m in real if project(search.next_pose, m) is not None]
        search.step(*(lambda pose, m=m: seen_corners(pose, m) for m in visible))
        assert len(search.initializer._steps) <= 11, k
    assert search.initializer.initializing


def test_two_beacons_are_taken_at_their_word_where_their_distance_is_that_of_the_map():
    """If one was moved, it is not: then a third decides, and the graph begins without what was moved."""
    a, b, c = point(1, 3.0, 1.0), point(2, 1.0, 3.0), point(3, -2.0, 2.0)
    search = Search(landmark_map(a, b, c))
    assert close(search.step(*(lambda pose, m=m: seen_point(pose, m) for m in (a, b))), search.pose, 0.02, 0.02)
    moved = point(2, 2.0, 1.5)
    search = Search(landmark_map(a, b, c))
    pair = [lambda pose: seen_point(pose, a), lambda pose: seen_point(pose, moved)]
    assert all(search.step(*pair) is None for _ in range(20))
    assert close(search.step(*pair, lambda pose: seen_point(pose, c)), search.pose, 0.05, 0.03)


def test_fault_51_beacons_that_contradict_one_another_begin_no_run():
    """All of them were moved, each to somewhere else: no two agree."""
    a, b, c = point(1, 3.0, 1.0), point(2, 1.0, 3.0), point(3, -2.0, 2.0)
    search = Search(landmark_map(a, b, c))
    stand = (point(1, 4.5, 1.0), point(2, 2.0, 1.5), point(3, -2.0, 3.5))
    seen = [lambda pose, m=m: seen_point(pose, m) for m in stand]
    assert all(search.step(*seen) is None for _ in range(40))


def test_what_was_refused_for_a_moment_is_nothing_to_a_later_search():
    """Long after it was explained by the next fix."""
    a, b, c = point(1, 3.0, 1.0), point(2, 1.0, 3.0), point(3, -2.0, 2.0)
    search = Search(landmark_map(a, b, c))
    tracked = PoseWithCovariance(np.array([9.0, 9.0, 0.0]), 1e-4 * np.eye(3))
    search.initializer.collect(Step(0, 0, 0, STEP_NS), [], [seen_point(TRUTH, c)], tracked=tracked)
    search.initializer.forget()
    search.stamp_ns = 3600 * 10**9
    start = search.step(lambda pose: seen_point(pose, a), lambda pose: seen_point(pose, b))
    assert close(start, search.pose, 0.04, 0.02)
