"""Sightings that contradict the pose: jumps are told, and a first pose that was given is not overridden in silence."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from robot_world import START_NS, Chain, World, beacons, config, position_error, room, truth_at

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.graph.batch import BatchSmoother
from fgloc.types import LandmarkMap, Mode

MAPS = {"corners": room, "beacons": beacons}
SHIFT = np.array([0.8, -0.3, 0.0])  # 0.85 m


def shifted(landmark_map: LandmarkMap, by=SHIFT) -> LandmarkMap:
    moved = {i: replace(lm, position=lm.position + by) for i, lm in landmark_map.landmarks.items()}
    return LandmarkMap(moved, landmark_map.dictionary)


def seconds(estimate) -> float:
    return (estimate.stamp_ns - START_NS) * 1e-9


def drive(kind: str, by=SHIFT, initial: bool = True, keep_all: bool = False, **world):
    """The robot is given its true first pose and a map that is shifted as a whole."""
    true_map = MAPS[kind]()
    settings = config(
        estimator={"initial_pose": tuple(truth_at(0.0)), "initial_sigmas": (0.02, 0.02, 0.02)} if initial else {}
    )
    made = World(true_map, **world)
    chain = Chain(settings, shifted(true_map, by), keep_all=keep_all)
    return made, chain, chain.run(made.events())


def leaps(estimates) -> list[float]:
    """Distance from each pose to the next [m]; the robot goes 0.08 m at the most."""
    return [position_error(b, a.pose) for a, b in itertools.pairwise(estimates)]


@pytest.mark.parametrize("kind", MAPS)
def test_fault_52_a_map_shifted_as_a_whole_against_the_given_first_pose(kind):
    world, chain, estimates = drive(kind, seconds=16.0)
    assert max(leaps(estimates)) < 0.1  # no snap
    assert max(position_error(e, world.truth(e.stamp_ns)) for e in estimates) < 0.25
    assert {e.mode for e in estimates if seconds(e) > 2.5} == {Mode.DEAD_RECKONING}
    decisions = [d for e in estimates for d in e.decisions]
    refused = [d for d in decisions if d.landmark_id >= 0]
    assert len(refused) > 50
    assert all(d.reason and d.weight == 0.0 for d in refused)
    (told,) = [d for d in decisions if d.kind == "place"]
    assert told.reason == "contradicts initial_pose"
    assert told.weight == 0.0
    far = math.hypot(*chain.localizer.tracking.initial_pose_conflict[:2])
    assert far == pytest.approx(np.hypot(*SHIFT[:2]), abs=0.1)
    (note,) = chain.localizer.notes  # of single markers that seem to be moved not a word
    assert "estimator.initial_pose" in note
    assert f"{far:.2f} m" in note


def test_fault_52_the_batch_does_not_snap_either():
    _, chain, estimates = drive("beacons", seconds=8.0, keep_all=True)
    localizer = chain.localizer
    result = BatchSmoother(localizer.estimator.log, localizer.factors, BatchConfig(), 0.9999).result()
    apart = [np.hypot(*(a - b.pose)[:2]) for a, b in zip(result.poses, estimates, strict=True)]
    assert max(apart) < 0.05


def test_fault_52_without_a_given_pose_the_map_is_all_there_is():
    world, chain, estimates = drive("corners", initial=False, seconds=4.0)
    there = [se2.compose((*SHIFT[:2], 0.0), world.truth(e.stamp_ns)) for e in estimates]
    assert np.mean([position_error(e, pose) for e, pose in zip(estimates, there, strict=True)]) < 0.01
    assert {e.mode for e in estimates} == {Mode.OK}
    assert not chain.localizer.notes


def test_a_given_pose_that_is_right_is_confirmed_and_then_no_better_than_any_other():
    """A kidnapped robot is found although its first pose was given, and the jump is told."""
    world, chain, estimates = drive("corners", 0.0 * SHIFT, seconds=14.0, kidnap_s=10.0)
    decisions = [d for e in estimates for d in e.decisions]
    (told,) = [d for d in decisions if d.kind == "place"]
    assert told.reason == "jump"
    assert told.nis > 1000.0
    (e,) = [e for e in estimates if told in e.decisions]
    assert told.step == chain.localizer.estimator.k - len(estimates) + 1 + estimates.index(e)
    assert any(d.reason == "behind_camera" for d in e.decisions)  # what was refused is told beside it
    (leap,) = [i for i, far in enumerate(leaps(estimates)) if far > 0.3]
    assert estimates[leap + 1] is e
    assert [n for n in chain.localizer.notes if re.search(r"jumped\b.* 2\.4", n)]  # across the circle
    assert np.mean([position_error(e, world.truth(e.stamp_ns)) for e in estimates if seconds(e) > 10.5]) < 0.01


def test_a_given_pose_first_judged_after_dead_reckoning_does_not_hold():
    """Then it may be the motion that is wrong; the robot is found, and the jump is told."""
    true_map = room()
    settings = config(estimator={"initial_pose": tuple(truth_at(0.0))})
    world = World(true_map, seconds=14.0, blind=((0.0, 8.0),), kidnap_s=4.0)  # carried off in the dark
    chain = Chain(settings, true_map)
    estimates = chain.run(world.events())
    assert chain.localizer.rejections["motion.jump"] == 1
    assert position_error(estimates[-1], world.truth(estimates[-1].stamp_ns)) < 0.02
    assert any(d.reason == "jump" for e in estimates for d in e.decisions)


def test_many_jumps_are_told_shortly():
    true_map = room()
    chain = Chain(config(), true_map)
    for leg in range(6):
        start_s = 40.0 * leg + (0.5 * math.pi / 0.33) * leg
        events = World(true_map, seed=leg, seconds=3.0, start_ns=START_NS + leg * 3 * 10**9, start_s=start_s).events()
        for event in events:
            chain._update(chain.stepper.push(event))
    jumps = chain.localizer.rejections["motion.jump"]
    assert jumps >= 4
    (note,) = [n for n in chain.localizer.notes if "jumped by" in n]
    assert note.endswith(f", and {jumps - 1} times more")
