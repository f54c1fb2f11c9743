"""Landmarks that were moved are named, left out, and what they did to the pose is taken back; misread ids name none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from exact import exact
from robot_world import Chain, World, beacons, config, position_error, room

from fgloc import se2
from fgloc.estimation.landmark_modes import MOVED, rotation_cov
from fgloc.frames import rpy_matrix
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.types import Event, LandmarkMap

COARSE = {"range_sigma_m": 0.2, "bearing_sigma_rad": 0.05}  # of which one sighting cannot show half a metre


def moved(world: LandmarkMap, *ids: int, dx: float = 0.4, dy: float = -0.3, turned: float = 0.0) -> LandmarkMap:
    shown = dict(world.landmarks)
    for i in ids:
        there, turn = shown[i], rpy_matrix(0.0, 0.0, turned)
        shown[i] = replace(there, position=there.position + np.array([dx, dy, 0.0]), rotation=turn @ there.rotation)
    return LandmarkMap(shown)


def misread(events: list[Event], ids: list[int], share: float, seed: int) -> list[Event]:
    """The events, this share of their sightings with another id."""
    rng = np.random.default_rng(seed)

    def read(i: int) -> int:
        return int(rng.choice([other for other in ids if other != i])) if rng.uniform() < share else i

    out: list[Event] = []
    for e in events:
        if isinstance(e, RangeBearingEvent | CornersEvent):
            e = replace(e, sightings=tuple(replace(s, landmark_id=read(s.landmark_id)) for s in e.sightings))
        out.append(e)
    return out


@cache
def of_moved_beacon(landmark_id: int):
    world = beacons()
    return of_beacons(world, moved(world, landmark_id), seed=landmark_id, **COARSE)


def of_beacons(world: LandmarkMap, shown: LandmarkMap | None, seed: int, **landmarks):
    made = World(world, seed=seed, seconds=40.0, rate=5, shown=shown)
    chain = Chain(config(landmarks=landmarks), world)
    return made, chain, chain.run(made.events())


def named(chain: Chain) -> dict[int, np.ndarray]:
    return chain.localizer.sightings.modes.displacements


@pytest.mark.parametrize("landmark_id", [0, 5])
def test_fault_51_a_beacon_moved_by_less_than_a_sighting_shows_is_named_and_its_harm_undone(landmark_id):
    made, chain, estimates = of_moved_beacon(landmark_id)
    assert list(named(chain)) == [landmark_id]
    assert named(chain)[landmark_id] == pytest.approx((0.4, -0.3), abs=0.15)
    (told,) = [d for e in estimates for d in e.decisions if d.reason == "landmark_moved"]
    assert told.landmark_id == landmark_id
    assert chain.localizer.rejections["sightings.gate"] < 5  # it was not the gate that found it
    late = [position_error(e, made.truth(e.stamp_ns)) for e in estimates if e.stamp_ns > told.stamp_ns]
    assert np.mean(late) < 0.07
    log = chain.localizer.estimator.log.keyframes.values()
    assert not any(s.measurement.landmark_id == landmark_id for frame in log for s in frame.sightings)
    assert all(-np.pi <= e.pose[2] < np.pi for e in estimates)


def test_without_the_moved_beacon_the_covariance_is_honest_at_once():
    nees = []
    for landmark_id in (0, 5):
        made, _, estimates = of_moved_beacon(landmark_id)
        at = next(i for i, e in enumerate(estimates) if any(d.reason == "landmark_moved" for d in e.decisions))
        for e in estimates[at : at + 3]:
            miss = se2.log(se2.between(e.pose, made.truth(e.stamp_ns)))
            cov = se2.rotate_cov(e.cov, -float(e.pose[2]))
            nees.append(float(miss @ np.linalg.solve(cov, miss)))
    assert np.mean(nees) / 3 < 3.1  # χ² of 6 degrees of freedom (two runs), 99.5 %


@pytest.mark.parametrize("settings", [COARSE, {"repeat_s": 5.0, "range_scale_sigma": 0.02}])
def test_in_a_run_where_nothing_was_moved_nobody_is_named(settings):
    _, chain, estimates = of_beacons(beacons(), None, 1, **settings)
    assert not named(chain)
    assert not any(d.reason == "landmark_moved" for e in estimates for d in e.decisions)


@pytest.mark.parametrize("settings", [{}, COARSE])
def test_fault_49_beacons_that_are_misread_name_nobody(settings):
    world = beacons()
    made = World(world, seed=4, seconds=40.0, rate=5)
    chain = Chain(config(landmarks=settings), world)
    chain.run(misread(made.events(), sorted(world.landmarks), 0.3, seed=4))
    assert not named(chain)


def test_fault_49_markers_that_are_misread_name_nobody():
    world = room()
    chain = Chain(exact(), world)
    chain.run(misread(World(world, seed=5, rate=5).events(), sorted(world.landmarks), 0.3, seed=5))
    assert chain.localizer.rejections["sightings.misread"] > 20
    assert not named(chain)


def test_repeated_sightings_share_their_information_and_are_refused_all_the_same():
    """The covariance that repeated sightings share says nothing of how far off one of them may be."""
    world = beacons()
    _, chain, _ = of_beacons(world, moved(world, 2, dx=0.5, dy=-0.4), seed=2, repeat_s=20.0)
    assert list(named(chain)) == [2]


def test_fault_51_two_markers_that_were_moved_one_of_them_turned_are_both_named():
    world = room()
    shown = moved(moved(world, 2, dx=0.0, dy=0.4), 7, dx=-0.3, dy=0.2, turned=0.2)
    made = World(world, seconds=20.0, rate=5, shown=shown)
    chain = Chain(exact(), world)
    estimates = chain.run(made.events())
    assert set(named(chain)) == {2, 7}
    assert named(chain)[2] == pytest.approx((0.0, 0.4), abs=0.06)
    assert named(chain)[7] == pytest.approx((-0.3, 0.2), abs=0.15)  # some of it may be the turn
    assert np.mean([position_error(e, made.truth(e.stamp_ns)) for e in estimates]) < 0.006


def test_fault_51_a_marker_that_is_moved_during_the_run_is_named_and_the_pose_keeps_what_it_told_before():
    world = room()
    early = World(world, seconds=22.0, rate=5)
    late = World(world, seconds=27.0, rate=5, seed=1, shown=moved(world, 7))
    at = early.start_ns + 22 * 10**9
    events = [e for e in early.events() if e.stamp_ns < at] + [e for e in late.events() if e.stamp_ns >= at]
    chain = Chain(exact(), world)
    estimates = chain.run(events)
    assert list(named(chain)) == [7]
    assert named(chain)[7] == pytest.approx((0.4, -0.3), abs=0.05)
    assert np.mean([position_error(e, late.truth(e.stamp_ns)) for e in estimates]) < 0.006


def test_fault_51_a_moved_marker_that_is_put_back_is_used_again():
    world = room()
    early = World(world, seconds=22.0, rate=5, shown=moved(world, 7, dx=0.5, dy=-0.2))
    late = World(world, seconds=27.0, rate=5, seed=1)
    at = early.start_ns + 22 * 10**9
    events = [e for e in early.events() if e.stamp_ns < at] + [e for e in late.events() if e.stamp_ns >= at]
    chain = Chain(exact(), world)
    estimates = chain.run(events)
    reasons = [(e.stamp_ns, d.reason) for e in estimates for d in e.decisions if d.landmark_id == 7]
    assert sum(reason == "quarantined" for stamp, reason in reasons if stamp < at) > 3
    assert not named(chain)
    assert {reason for _, reason in reasons[-10:]} == {""}
    assert np.mean([position_error(e, late.truth(e.stamp_ns)) for e in estimates]) < 0.006


def test_what_a_displacement_does_to_the_estimate_is_predicted():
    """The same sightings with a map in which one beacon stands 2 cm off: the pose changes by what M says."""
    world, shift = beacons(), np.array([0.02, -0.01])
    made = World(world, seconds=12.0, rate=5)
    settings = config(landmarks={"bearing_bias_sigma_rad": 0.0, "range_scale_sigma": 0.0})
    there, here = Chain(settings, moved(world, 3, dx=shift[0], dy=shift[1])), Chain(settings, world)
    events = made.events()
    right, wrong = there.run(events)[-1], here.run(events)[-1]
    modes = here.localizer.sightings.modes
    error = se2.log(se2.between(wrong.pose, right.pose))
    told = modes.sensitivity(3)[:3] @ shift
    assert np.abs(error).max() > 1e-3
    assert told == pytest.approx(error, abs=0.1 * float(np.abs(error).max()))


def test_a_marker_that_was_moved_may_have_been_turned_and_hung_higher_but_its_place_is_the_hypothesis():
    alone = [float(rotation_cov(np.eye(14)[[3 + i]], (1, 6))[0, 0]) for i in range(8)]  # rows of pose, another, marker
    assert np.array(alone) == pytest.approx([0.0, 0.0, 0.0, MOVED**2, MOVED**2, MOVED**2, MOVED**2, 0.0])


def test_of_more_landmarks_than_there_are_hypotheses_those_seen_last_are_followed(monkeypatch):
    monkeypatch.setattr("fgloc.estimation.landmark_modes.MOST_HYPOTHESES", 6)
    world = room()
    made = World(world, seconds=22.0, rate=5, shown=moved(world, 7))
    chain = Chain(exact(), world)
    chain.run(made.events())
    assert list(named(chain)) == [7]


@pytest.mark.parametrize(("size_m", "off_m", "is_named"), [(0.06, 0.17, False), (0.06, 0.3, True), (0.2, 0.17, True)])
def test_a_small_marker_is_named_only_if_one_sighting_can_show_it(size_m, off_m, is_named):
    """A few tenths of a pixel, the same in all images, put a marker of 8 px that far off, however many there are."""
    landmarks = dict(room().landmarks)
    landmarks[2] = replace(landmarks[2], size_m=size_m)
    world = LandmarkMap(landmarks, "DICT_4X4_50")
    made = World(world, seconds=14.0, rate=5, shown=moved(world, 2, dx=off_m, dy=0.0), seed=3)
    chain = Chain(config(markers={"sigma_px": 0.3}), world)
    chain.run(made.events())
    assert (2 in named(chain)) == is_named


def test_what_a_moved_beacon_did_to_the_pose_is_no_speed_of_a_robot_that_nothing_measures():
    """Its speed is that of the fixes; the one that takes the harm back goes half a metre aside."""
    world = beacons()
    made = World(world, seconds=6.0, rate=5, shown=moved(world, 0, dx=0.6, dy=-0.6))
    chain = Chain(config(wheels={"source": "none"}, landmarks=COARSE), world, unmeasured=True)
    estimates = chain.run(e for e in made.events() if isinstance(e, RangeBearingEvent))
    told_ns = next(e.stamp_ns for e in estimates for d in e.decisions if d.reason == "landmark_moved")
    after = [f for f in chain.localizer.estimator.log.keyframes.values() if f.stamp_ns > told_ns][:5]
    assert [m.source for f in after for m in f.motions] == ["unknown"] * 5
    assert max(abs(f.motions[0].motion[1]) for f in after) < 0.06
