"""Hits without identity: their names by a predicted pose, and the robot's place by their constellation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robot_world import config
from test_initializer import MOTION, TRUTH, landmark_map, point, seen_point

from fgloc import se2
from fgloc.estimation.sightings import Association
from fgloc.estimation.unnamed import AMBIGUOUS, UNMATCHED, Constellations, Naming
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.sensors.measurements import UNNAMED

PLACES = ((3.0, 1.0), (1.0, 3.0), (-2.0, 2.0), (-1.0, -3.0), (2.5, -2.0))
STILL = np.zeros((3, 3))


def points(*places):
    return landmark_map(*(point(i, *place) for i, place in enumerate(places)))


def hits(pose, *places):
    return [replace(seen_point(pose, point(UNNAMED, *place)), scan_ns=1) for place in places]


def placed(the_map, *seen, times=3, tracked=False):
    """The place by things at these places, each seen so often from the true pose."""
    constellations = Constellations(config(), the_map)
    for _ in range(times):
        constellations.take(hits(TRUTH, *seen))
    return constellations.place(10**9, tracked)


@pytest.mark.parametrize("seen", [PLACES, PLACES[:3], (*PLACES[:4], (4.0, 4.0), (0.5, -1.5))])
def test_a_constellation_of_beacons_tells_the_place(seen):
    found = placed(points(*PLACES), *seen)
    assert np.abs(se2.log(se2.between(TRUTH, found.pose))).max() < 1e-3
    assert np.sqrt(np.diag(found.cov)).max() < 0.1


@pytest.mark.parametrize(
    ("seen", "times"),
    [
        (PLACES, 2),
        (PLACES[:2], 3),
        ((*PLACES[:3], (4.0, 4.0), (0.5, -1.5), (-4.0, 0.5)), 3),
    ],
    ids=["seen twice", "two", "half"],
)
def test_hits_that_tell_too_little_tell_no_place(seen, times):
    assert placed(points(*PLACES), *seen, times=times) is None


def test_a_constellation_is_followed_while_the_robot_drives():
    constellations, pose = Constellations(config(), points(*PLACES)), TRUTH
    for _ in range(8):
        constellations.take(hits(pose, *PLACES))
        constellations.move(MOTION, STILL)
        pose = se2.compose(pose, MOTION)
    found = constellations.place(10**9, False)
    assert np.abs(se2.log(se2.between(pose, found.pose))).max() < 1e-3


def test_a_place_is_not_taken_while_another_explains_as_many_hits():
    """The second triangle is the first one elsewhere, a little larger, which fits worse and is not excluded."""
    triangle = np.array([[3.0, 1.0], [1.0, 3.0], [-2.0, 2.0]])
    again = 1.07 * (triangle - triangle.mean(axis=0)) + [20.0, 3.0]
    assert placed(points(*triangle, *again), *triangle) is None
    assert placed(points(*triangle, *(again + 30.0 * np.eye(3, 2))), *triangle) is not None


def named(sigmas, *seen, by=PLACES):
    """Ids of the hits that get a name, and the reasons of the others."""
    naming = Naming(config(), LandmarkFactors(points(*by)))
    found, nameless = naming.name(hits(TRUTH, *seen), PoseWithCovariance(TRUTH, np.diag(np.square(sigmas))))
    return sorted(m.landmark_id for m in found), [one.reason for one in nameless]


def test_a_hit_has_the_name_of_its_beacon():
    assert named((0.05, 0.05, 0.02), PLACES[3], PLACES[0], (0.0, 1.0)) == ([0, 3], [UNMATCHED])


def test_hits_without_a_name_are_counted_by_the_reason_and_are_rejected():
    association = Association(config(), LandmarkFactors(points(*PLACES)))
    at = PoseWithCovariance(TRUTH, np.diag(np.square((0.05, 0.05, 0.02))))
    accepted, rejected, decisions = association.judge(1, 10**9, hits(TRUTH, PLACES[3], PLACES[0], (0.0, 1.0)), at)
    assert sorted(s.measurement.landmark_id for s in accepted) == [0, 3]
    assert len(rejected) == 1
    assert [d.reason for d in decisions] == ["", "", UNMATCHED]
    assert list(association.rejections.values()) == [1]
    assert next(iter(association.rejections)).endswith(f".{UNMATCHED}")


def test_hits_that_are_surely_named_name_those_that_may_be_of_two():
    pair = ((-1.0, -3.0), (-1.5, -3.2))
    unsure, by = (0.3, 0.3, 0.1), (*PLACES[:3], *pair)
    assert named(unsure, pair[0], by=by) == ([], [AMBIGUOUS])
    assert named(unsure, *PLACES[:3], pair[0], by=by) == ([0, 1, 2, 3], [])
