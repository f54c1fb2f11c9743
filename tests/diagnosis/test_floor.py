"""A floor that is not flat is named: by the accelerometer, else by markers in images; a flat one is not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from fgloc.diagnosis.handling import FloorWatch
from fgloc.frames import rpy_matrix
from fgloc.graph.ground import GRAVITY
from fgloc.sensors.cameras import up_in_base
from fgloc.types import Camera, InertialReading, Landmark, Step

SECOND = 1_000_000_000
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Leaning:
    """An IMU, whose mounting is 3 degrees off, on a floor with this pitch by the time [s]; or its gyro is level."""

    def __init__(self, pitch, turns=True) -> None:
        self._pitch, self._turns = pitch, turns

    def measure(self, step: Step, twist) -> InertialReading:
        before, now = (self._pitch(stamp / SECOND) for stamp in (step.start_ns, step.stamp_ns))
        R = rpy_matrix(0.0, now, 0.0) @ rpy_matrix(0.05, 0.0, 0.0)
        turn = np.array([0.0, self._turns * (now - before)])
        return InertialReading(turn, 1e-6, R.T @ np.array([0.0, 0.0, GRAVITY]), 0.04, step.dt)

    def rates_at(self, events, at_ns: int) -> np.ndarray:
        return np.zeros(3)


class Wheels:
    def twist(self, step: Step, at_ns: int) -> np.ndarray:
        return np.zeros(3)


def sentence(pitch, turns=True, by_hand=lambda t: False) -> str | None:
    watch = FloorWatch(Leaning(pitch, turns), Wheels(), None, None)  # type: ignore[arg-type]
    for i in range(300):
        watch.observe(Step(i, 0, i * SECOND // 5, (i + 1) * SECOND // 5), by_hand(i / 5))
    return watch.sentence


def test_a_ramp_is_named_with_its_slope() -> None:
    found = sentence(lambda t: -np.radians(9.0) if 10.0 < t < 15.0 else 0.0)
    assert found is not None
    assert re.search(r" 9°.* 0°.*\bestimator\.ground: uneven\b", found)  # pitch and roll


def test_what_the_gyro_does_not_confirm_is_no_ramp() -> None:
    """A speed or clock that is off tilts the force of a robot that drives on a flat floor."""
    assert sentence(lambda t: -np.radians(9.0) if 10.0 < t < 15.0 else 0.0, turns=False) is None


def test_what_hands_do_is_no_ramp() -> None:
    """They are noticed half a second later."""

    def tilts(t: float) -> float:
        return -np.radians(9.0) * np.sin(2.0 * t) if 10.0 < t < 25.0 else 0.0

    assert sentence(tilts) is not None
    assert sentence(tilts, by_hand=lambda t: 10.6 < t < 25.6) is None


def test_a_flat_floor_is_not_named_however_the_imu_is_mounted() -> None:
    assert sentence(lambda t: 0.0) is None
    assert sentence(lambda t: np.radians(1.0) * np.sin(7.0 * t)) is None


def test_one_hard_knock_is_no_slope() -> None:
    assert sentence(lambda t: 0.4 if 20.0 < t < 20.9 else 0.0) is None


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.1, -0.2)])
def test_two_markers_tell_which_way_is_up(tilt) -> None:
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = FORWARD, (0.1, 0.0, 0.3)
    camera = Camera(640, 480, "plumb_bob", K, np.zeros(4), T)
    facing = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # back towards the robot
    facing = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    markers = [Landmark(i, np.array([3.0, y, z]), facing, 0.2) for i, (y, z) in enumerate(((0.5, 0.6), (-0.6, 0.3)))]
    R, rng = rpy_matrix(*tilt, 0.1), np.random.default_rng(1)
    seen = []
    for marker in markers:
        in_cam = ((marker.corners() - [0.0, 0.0, 0.1]) @ R - T[:3, 3]) @ FORWARD
        pixels = in_cam @ K.T
        seen.append((pixels[:, :2] / pixels[:, 2:] + rng.normal(0.0, 0.05, (4, 2)), marker))
    up = up_in_base(camera, seen)
    assert up is not None
    np.testing.assert_allclose(up, R.T @ [0.0, 0.0, 1.0], atol=0.01)
    elsewhere = replace(markers[1], position=np.array([2.0, -2.0, 1.5]))
    assert up_in_base(camera, [seen[0], (seen[1][0], elsewhere)]) is None
