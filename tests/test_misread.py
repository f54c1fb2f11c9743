"""Markers whose code was misread: known by where they hang, if that leaves no doubt."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from robot_world import CAMERA, SIGMA_PX, Chain, World, config, position_error, project, room, standing

from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.robust.association import Association
from fgloc.sensors.markers.events import CornersEvent
from fgloc.types import Landmark, LandmarkMap, PixelMeasurement

SHARE = 0.4


def hanging(landmark_id: int, along: float) -> Landmark:
    """On a wall 3 m ahead."""
    return standing(landmark_id, 3.0, along, math.pi)


def measured(world_map: LandmarkMap, landmark_id: int, read: int | None = None) -> PixelMeasurement:
    """As seen from the origin, and the id that was read."""
    corners = project(np.zeros(3), world_map.landmarks[landmark_id])
    return PixelMeasurement(10**9, landmark_id if read is None else read, corners, SIGMA_PX, CAMERA)


def misread(events, ids, share: float, seed: int = 5):
    """The events with other ids in a share of the sightings, and what each of them was."""
    rng, made, truth = np.random.default_rng(seed), [], {}
    for event in events:
        if isinstance(event, CornersEvent):
            seen = []
            for s in event.sightings:
                other = (
                    int(rng.choice([i for i in ids if i != s.landmark_id])) if rng.uniform() < share else s.landmark_id
                )
                truth.setdefault((event.stamp_ns, other), []).append(s.landmark_id)
                seen.append(replace(s, landmark_id=other))
            event = replace(event, sightings=tuple(seen))
        made.append(event)
    return made, truth


def follow(world_map, events, **weights):
    chain = Chain(config(weights=weights), world_map)
    return chain, chain.run(events)


def test_a_misread_marker_is_used_as_what_hangs_there():
    world = World(room(), seed=1, seconds=12.0)
    events, truth = misread(world.events(), sorted(room().landmarks), SHARE)
    chain, estimates = follow(room(), events)
    _, without = follow(room(), events, adaptive=False)
    told = [d for e in estimates for d in e.decisions]
    wrong = [d for d in told if d.reason == "misread"]
    assert len(wrong) > 100
    assert chain.localizer.rejections["sightings.misread"] == len(wrong)
    believed = {(d.stamp_ns, d.landmark_id) for d in told if d.kind == "corners" and not d.reason}
    hung = {(stamp, i) for (stamp, _), were in truth.items() for i in were}
    assert len(believed - hung) <= 0.01 * len(believed)  # what is believed was seen
    read = {(e.stamp_ns, d.landmark_id) for e in without for d in e.decisions if d.kind == "corners" and not d.reason}
    assert len(believed) > 1.3 * len(read)
    assert max(position_error(e, world.truth(e.stamp_ns)) for e in estimates[20:]) < 0.03  # nothing is taken as exact


def test_sound_markers_are_not_read_again():
    _, estimates = follow(room(), World(room(), seed=2, seconds=8.0).events())
    assert not any(d.reason == "misread" for e in estimates for d in e.decisions)


@pytest.mark.parametrize("believed", [True, False], ids=["beside a believed one", "alone"])
def test_without_another_that_is_believed_it_may_be_the_robot_that_is_elsewhere(believed):
    """A robot that was carried on by the spacing of equal markers must not take each of them for the next one."""
    row = LandmarkMap({i: hanging(i, -1.2 + 0.6 * i) for i in range(5)}, "DICT_4X4_50")
    seen = [measured(row, 1, read=4), measured(row, 2)] if believed else [measured(row, i, read=i + 1) for i in (1, 2)]
    weights = Association(config(), LandmarkFactors(row))
    sightings, refused, decisions = weights.judge(1, 10**9, seen, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-6))
    assert sorted(s.measurement.landmark_id for s in sightings) == ([1, 2] if believed else [])
    assert [d.reason for d in decisions if d.landmark_id in (3, 4)].count("misread") == believed
    assert len(refused) == (0 if believed else 2)


def test_of_two_that_hang_there_neither_is_taken():
    twins = [hanging(1, -0.4), hanging(2, 0.2), hanging(3, -0.401), hanging(4, 1.2)]
    row = LandmarkMap({m.landmark_id: m for m in twins}, "DICT_4X4_50")
    seen = [measured(row, 2), measured(row, 1, read=4)]
    weights = Association(config(), LandmarkFactors(row))
    sightings, _, decisions = weights.judge(1, 10**9, seen, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-6))
    assert [s.measurement.landmark_id for s in sightings] == [2]
    assert [d.reason for d in decisions] == ["", "gate"]
