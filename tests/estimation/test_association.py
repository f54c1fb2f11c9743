"""What becomes of the sightings of one image, for a robot whose pose is given: accepted, rejected, or explained."""

from __future__ import annotations

import math

import numpy as np
import pytest
from exact import exact
from robot_world import START_NS, Chain, polar, project, standing

from fgloc.estimation import sightings as association
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.types import Decision, Landmark, LandmarkMap, Step

SURE, UNSURE = (0.001, 0.001, 0.001), (0.7, 0.7, 0.3)  # sigmas of the given pose: m, m, rad


def hanging(landmark_id: int, along: float) -> Landmark:
    """On a wall 3 m ahead."""
    return standing(landmark_id, 3.0, along, math.pi)


def row_of(*landmarks: Landmark) -> LandmarkMap:
    return LandmarkMap({m.landmark_id: m for m in landmarks}, "DICT_4X4_50")


ROW = row_of(*(hanging(i, -1.2 + 0.6 * i) for i in range(5)))


def image(world_map: LandmarkMap, *read: tuple[int, int], seen_from=(0.0, 0.0, 0.0)) -> CornersEvent:
    """Of these markers, each with the id that was read."""
    seen = tuple(MarkerCorners(said, project(np.array(seen_from), world_map.landmarks[true])) for true, said in read)
    return CornersEvent(START_NS, START_NS, "/tags", "cam", seen)


def judged(world_map: LandmarkMap, *events, at=(0.0, 0.0, 0.0), sigmas=SURE, settings=None) -> list[list[Decision]]:
    """The rows of ``steps.csv`` on the sightings of each event, of a localizer that is told its pose first."""
    localizer = Chain(settings or exact(), world_map).localizer
    localizer.restart_at(PoseWithCovariance(np.array(at), np.diag(np.square(sigmas))))
    rows, before_ns = [], START_NS
    for index, event in enumerate(events):
        estimate = localizer.update(Step(index, 0, before_ns, event.stamp_ns, sightings=(event,)))
        rows.append([d for d in estimate.decisions if d.landmark_id >= 0])
        before_ns = event.stamp_ns
    return rows


def accepted(rows: list[Decision]) -> list[int]:
    return sorted(d.landmark_id for d in rows if not d.reason)


@pytest.mark.parametrize("beside", [True, False], ids=["beside", "alone"])
def test_a_misread_marker_is_known_by_its_place_only_beside_another(beside):
    """A robot that was carried on by the spacing of equal markers must not take each of them for the next one."""
    (rows,) = judged(ROW, image(ROW, (1, 4), (2, 2)) if beside else image(ROW, (1, 2), (2, 3)))
    assert accepted(rows) == ([1, 2] if beside else [])
    assert {d.landmark_id: d.reason for d in rows if d.reason} == ({4: "misread"} if beside else {2: "gate", 3: "gate"})


def test_what_a_misread_marker_is_follows_from_the_others_where_the_pose_is_vague():
    """The robot is 0.6 m beside where it is said to be: from there marker 4 looks like marker 3."""
    walls = row_of(*ROW.landmarks.values(), standing(9, -3.0, 0.0, 0.0))
    (rows,) = judged(walls, image(walls, (1, 1), (2, 2), (4, 9)), at=(0.0, -0.6, 0.0), sigmas=(0.3, 0.3, 0.1))
    assert accepted(rows) == [1, 2, 4]


def test_of_two_markers_that_hang_there_neither_is_taken():
    twins = row_of(hanging(1, -0.4), hanging(2, 0.2), hanging(3, -0.401), hanging(4, 1.2))
    (rows,) = judged(twins, image(twins, (2, 2), (1, 4)))
    assert accepted(rows) == [2]
    assert [d.reason for d in rows] == ["", "gate"]


@pytest.mark.parametrize(("sigmas", "reasons"), [(SURE, ["gate"]), (UNSURE, [""])], ids=["sure", "unsure"])
def test_a_pose_that_is_not_well_known_excludes_little(sigmas, reasons):
    (rows,) = judged(ROW, image(ROW, (2, 2), seen_from=(0.0, 0.5, 0.1)), sigmas=sigmas)
    assert [d.reason for d in rows] == reasons
    assert [d.weight for d in rows] == [float(not reason) for reason in reasons]


def test_a_marker_behind_the_camera_is_rejected():
    (rows,) = judged(ROW, image(ROW, (2, 2)), at=(6.0, 0.0, 0.0), sigmas=(1.0, 1.0, 1.0))
    assert [d.reason for d in rows] == ["behind_camera"]


@pytest.mark.parametrize(("apart_s", "weight"), [(0.25, 0.25), (0.5, 0.5), (2.0, 1.0)])
def test_sightings_of_one_beacon_within_its_correlation_time_share_their_information(apart_s, weight):
    beacon = LandmarkMap({9: Landmark(9, np.array([3.0, 1.5, 0.0]), np.eye(3), 0.0)})
    seen = (RangeBearing(9, *polar((0.0, 0.0, 0.0), beacon.landmarks[9])),)
    stamps = (START_NS, START_NS + round(apart_s * 1e9))
    events = [RangeBearingEvent(stamp, stamp, "/landmarks", "base_link", seen) for stamp in stamps]
    first, later = judged(beacon, *events, settings=exact(landmarks={"repeat_s": 1.0}))
    assert [d.weight for d in (*first, *later)] == pytest.approx([1.0, weight])


def test_sightings_that_cannot_be_fused_agree_with_none(monkeypatch):
    monkeypatch.setattr(association, "correct", lambda *_: None)
    (rows,) = judged(ROW, image(ROW, (1, 1), (2, 2), (3, 3)), sigmas=UNSURE)
    assert [d.landmark_id for d in rows] == [1, 2, 3]


def test_the_work_for_a_burst_of_sightings_is_bounded(monkeypatch):
    """After a stall a step holds the images of seconds; an unsure pose excludes none of them, and one was misread."""
    corrections, correct = [], association.correct

    def counted(belief, known, measurements, *rest):
        corrections.append(len(measurements))
        return correct(belief, known, measurements, *rest)

    monkeypatch.setattr(association, "correct", counted)
    localizer = Chain(exact(), ROW).localizer
    localizer.restart_at(PoseWithCovariance(np.zeros(3), np.diag(np.square(UNSURE))))
    good, misread = image(ROW, *((i, i) for i in range(5))), image(ROW, (1, 2))
    step = Step(0, 0, START_NS, START_NS, sightings=(*[good] * 40, misread))
    decisions = [d for d in localizer.update(step).decisions if d.landmark_id >= 0]
    assert len(decisions) == 201
    assert len([d for d in decisions if not d.reason]) == 200
    assert len(corrections) < 100
    assert max(corrections) <= 16
