"""Markers whose code was misread: known by where they hang, if that leaves no doubt."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from robot_world import START_NS, Chain, World, config, position_error, room, standing

from fgloc.sensors.markers.images import CornersEvent
from fgloc.types import Landmark, LandmarkMap

SHARE = 0.4


def hanging(landmark_id: int, along: float) -> Landmark:
    """On a wall 3 m ahead."""
    return standing(landmark_id, 3.0, along, math.pi)


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


@pytest.mark.parametrize("seed", [6, 8])
def test_a_robot_that_was_carried_away_is_found_among_misread_markers(seed):
    """Two that agree in two images are enough, whatever the misread ones say."""
    world = World(room(), seed=seed, seconds=13.0, kidnap_s=10.0)
    events, _ = misread(world.events(), sorted(room().landmarks), 0.3, seed=seed)
    _, estimates = follow(room(), events)
    after = [e for e in estimates if e.stamp_ns > START_NS + round(10.3e9)]
    assert len(after) > 20
    assert max(position_error(e, world.truth(e.stamp_ns)) for e in after) < 0.1


def test_sound_markers_are_not_read_again():
    _, estimates = follow(room(), World(room(), seed=2, seconds=8.0).events())
    assert not any(d.reason == "misread" for e in estimates for d in e.decisions)


@pytest.mark.parametrize(("images", "moves"), [(1, False), (3, True)])
def test_two_markers_in_a_row_that_are_misread_alike_move_no_robot_but_if_they_are_again(images, moves):
    """Every second marker of the row hangs as far from the next: their ids fit another place as well."""
    row = LandmarkMap({i: hanging(i, 0.5 * i - 3.0) for i in range(13)})
    made, left = [], images
    for event in World(row, seed=3, seconds=4.0).events():
        if isinstance(event, CornersEvent):
            seen = event.sightings[:2]
            if event.stamp_ns > START_NS + 2 * 10**9 and left and len(seen) == 2:
                left, seen = left - 1, [replace(s, landmark_id=s.landmark_id - 4) for s in seen]
            event = replace(event, sightings=tuple(seen))
        made.append(event)
    _, estimates = follow(row, made)
    assert any(d.reason == "jump" for e in estimates for d in e.decisions) == moves
