"""After the robot got lost: it is looked for on the whole map, and nothing believed before stands in the way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from robot_world import points

import fgloc.estimation.place
from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.localizer import Localizer
from fgloc.estimation.pose_fit import fit_pose
from fgloc.sensors.equipment import MotionSensors, PoseSensors
from fgloc.sensors.measurements import FrameMeasurement, PointMeasurement
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Estimate, Landmark, LandmarkMap, Mode, MotionMeasurement, Step

STEP_NS = 100_000_000
PLACES = ((4.0, 3.0), (-3.0, 4.0), (-4.0, -2.0), (3.0, -4.0), (9.0, 2.0))
MAP = points(PLACES)
_WALL = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a marker that faces -x
MOTION = np.array([0.02, 0.0, 0.0])


class Wheels(WheelMotion):
    """Exact motion of a robot that drives straight on."""

    def __init__(self) -> None:
        super().__init__(Config().wheels)

    def twist(self, step: Step, at_ns: int) -> np.ndarray:
        return MOTION * (1e9 / STEP_NS)

    def motion_between(self, step: Step, start_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        return se2.exp(MOTION * ((end_ns - start_ns) / STEP_NS)), np.eye(3) * 1e-8

    def measure(self, step: Step) -> MotionMeasurement:
        return MotionMeasurement("wheels", step.start_ns, step.stamp_ns, MOTION, np.diag([1e-6, 1e-6, 1e-6]))


class Beacons:
    """Exact ranges and bearings."""

    sees_corners = False
    camera_names = ()

    def camera_name(self, event: RangeBearingEvent) -> str:
        return ""

    def measure(self, event: RangeBearingEvent) -> tuple[PointMeasurement, ...]:
        cov = np.diag([1e-4, 1e-3])
        return tuple(
            PointMeasurement(event.stamp_ns, s.landmark_id, s.range_m, s.bearing_rad, cov) for s in event.sightings
        )


def localizer(adaptive: bool = True, **estimator) -> Localizer:
    settings = Config.model_validate({"estimator": estimator, "weights": {"adaptive": adaptive}})
    return Localizer(settings, MAP, MotionSensors(Wheels()), PoseSensors(Beacons()))


def step(index: int, truth, ids: tuple[int, ...], segment: int = 0, shift_ns: int = 0) -> Step:
    """The robot at ``truth`` sees these beacons."""
    stamp = 10**18 + index * STEP_NS + shift_ns
    seen = []
    for i in ids:
        x, y, _ = se2.between(truth, (*PLACES[i], 0.0))
        seen.append(RangeBearing(i, math.hypot(x, y), math.atan2(y, x)))
    event = RangeBearingEvent(stamp, stamp, "/landmarks", "base_link", tuple(seen))
    return Step(index, segment, stamp - STEP_NS, stamp, sightings=(event,) if seen else ())


def drive(run: Localizer, start, first: int, n: int) -> list[tuple[np.ndarray, Estimate | None]]:
    """Truth and estimate of n steps from a place, one beacon a step."""
    found = []
    truth = np.array(start, dtype=float)
    for k in range(first, first + n):
        truth = se2.compose(truth, MOTION)
        found.append((truth, run.update(step(k, truth, (k % len(PLACES),)))))
    return found


def test_a_lost_robot_is_not_put_back_to_the_initial_pose():
    run = localizer(initial_pose=(0.0, 0.0, 0.0))
    assert all(e is not None and e.mode is Mode.OK for _, e in drive(run, (0.0, 0.0, 0.0), 0, 20))
    after = drive(run, (2.0, 1.0, 2.0), 20, 80)  # somebody carried it away
    assert run.rejections["motion.jump"] == 1
    for truth, estimate in after[10:]:  # one beacon a step, and it takes several to tell the place
        assert estimate is not None
        assert estimate.mode is Mode.OK
        assert np.abs(se2.between(truth, estimate.pose)).max() < 0.05


@pytest.mark.parametrize(
    ("sigmas", "mode"), [((4.0, 0.1, 0.01), Mode.LOST), ((0.1, 0.1, 1.2), Mode.LOST), ((2.0, 2.0, 0.1), Mode.OK)]
)
def test_a_robot_is_lost_where_its_place_or_its_yaw_is_hardly_known(sigmas, mode):
    run = localizer(initial_pose=(0.0, 0.0, 0.0))
    drive(run, (0.0, 0.0, 0.0), 0, 20)
    run.estimator.belief.cov = np.diag(np.square(sigmas))
    assert run.update(step(20, (0.0, 0.0, 0.0), ())).mode is mode


def test_a_lost_robot_that_is_found_jumps_there_and_replays_nothing():
    run = localizer(initial_pose=(0.0, 0.0, 0.0))
    drive(run, (0.0, 0.0, 0.0), 0, 20)
    run.estimator.belief.cov = np.diag([16.0, 16.0, 1.0])  # nothing was seen for long
    found = [e for _, e in drive(run, (2.0, 1.0, 2.0), 20, 20) if e is not None]
    assert [d.reason for e in found for d in e.decisions if d.kind == "place"] == ["jump"]
    assert run.estimator.k == 39


@pytest.mark.parametrize(("adaptive", "reasons"), [(True, {""}), (False, {"gate"})])
def test_several_beacons_that_agree_on_a_place_nearby_overrule_the_wheels(adaptive, reasons):
    run = localizer(adaptive, initial_pose=(0.0, 0.0, 0.0))
    drive(run, (0.0, 0.0, 0.0), 0, 20)
    aside = np.array([0.6, -0.1, 0.1])  # by a slip of one step
    told = run.update(step(20, aside, (0, 1, 2)))
    assert {d.reason for d in told.decisions if d.landmark_id >= 0} == reasons
    assert (np.abs(se2.between(aside, told.pose)).max() < 0.01) == adaptive


def test_the_steps_before_the_first_pose_are_replayed_from_it():
    run = localizer()
    told = [e for _, e in drive(run, (0.0, 0.0, 0.0), 0, 20) if e is not None]
    assert not [d for e in told for d in e.decisions if d.reason == "jump"]
    assert len(told) < run.estimator.k + 1 == 20


def test_a_new_segment_does_not_go_on_from_where_the_robot_was_lost():
    run = localizer(initial_pose=(0.0, 0.0, 0.0))
    drive(run, (0.0, 0.0, 0.0), 0, 20)
    run.estimator.belief.cov = np.diag([16.0, 16.0, 1.0])  # nothing was seen for long
    lost = run.update(step(20, (0.0, 0.0, 0.0), ()))
    assert lost is not None
    assert lost.mode is Mode.LOST
    jumped = step(26, (0.0, 0.0, 0.0), (), segment=1, shift_ns=3600 * 10**9)
    assert run.update(jumped) is None


class Nonsense:
    """Poses of all markers, none of which is where the map has it."""

    sees_corners = False
    camera_names = ()

    def camera_name(self, event: RangeBearingEvent) -> str:
        return ""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)

    def measure(self, event: RangeBearingEvent) -> list[FrameMeasurement]:
        cov = np.diag([1e-4, 1e-4, 1e-3])
        places = self._rng.uniform(-3.0, 3.0, (len(PLACES), 3))
        return [FrameMeasurement(event.stamp_ns, i, place, cov) for i, place in enumerate(places)]


def test_the_search_does_not_grow_with_what_was_seen(monkeypatch):
    """On a wrong map no place ever explains the sightings; the search must not fall behind for it."""
    standing = LandmarkMap({i: Landmark(i, np.array([*p, 0.5]), _WALL, 0.2) for i, p in enumerate(PLACES)})
    run = Localizer(Config(), standing, MotionSensors(Wheels()), PoseSensors(Nonsense()))
    fits = []
    search = fgloc.estimation.place
    monkeypatch.setattr(search, "fit_pose", lambda *a: fits.append(len(a[1])) or fit_pose(*a))
    sums = []
    for k in range(40):
        fits.clear()
        assert run.update(step(k, np.zeros(3), (0,))) is None
        sums.append(sum(fits))
    assert 0 < max(sums) < 500  # sightings looked at in all fits of a step; one fit for each would be 40000 in the last
