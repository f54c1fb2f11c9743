"""Which joints are wheels, by their names, and their radius and track, by an odometry."""

import math
from dataclasses import replace

import numpy as np
import pytest
from event_makers import joints, odometry

from fgloc.sensors.wheels.sensor import WheelPair, fit_geometry, wheel_pair


@pytest.mark.parametrize(
    ("names", "left", "right"),
    [
        (("left_wheel_joint", "right_wheel_joint"), "left_wheel_joint", "right_wheel_joint"),
        (("arm_left", "wheel_right", "wheel_left", "gripper"), "wheel_left", "wheel_right"),
        (("l_wheel", "r_wheel"), "l_wheel", "r_wheel"),
        (("wheel_l", "caster", "wheel_r"), "wheel_l", "wheel_r"),
    ],
)
def test_the_pair_is_found_by_name(names, left, right):
    assert wheel_pair(names) == WheelPair(left, right)


@pytest.mark.parametrize(
    "names",
    [
        (),
        ("wheel_0", "wheel_1"),
        ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"),
        ("left_wheel",),
        ("leftover", "brightness"),
    ],
)
def test_what_is_not_clear_is_left_to_the_user(names):
    assert wheel_pair(names) is None


RADIUS, TRACK = 0.033, 0.16


def driven(by_pose, heading_off=0.0):
    """Joints and odometry of a robot that speeds up and turns; only its pose, or only its twist, is the wheels'."""
    dt, yaw, place, turned = 0.05, 0.0, np.zeros(2), np.zeros(2)
    joint_events, odometry_events = [], []
    for k in range(400):
        v, omega = 0.1 + 0.1 * math.sin(0.3 * k * dt), 0.5 * math.sin(0.5 * k * dt)
        rates = (v + np.array([-0.5, 0.5]) * TRACK * omega) / RADIUS
        joint_events.append(joints(1.0 + k * dt, *turned, names=("left_wheel", "right_wheel")))
        pose, twist = ((*place, yaw), (0.95 * v, 1.05 * omega)) if by_pose else ((0.0, 0.0, 0.0), (v, omega))
        if heading_off:
            pose, twist = (*place, yaw + heading_off), (v, omega)
        odometry_events.append(odometry(1.0 + k * dt, pose, twist))
        heading = yaw + 0.5 * omega * dt
        place = place + v * dt * np.array([math.cos(heading), math.sin(heading)])
        yaw, turned = yaw + omega * dt, turned + rates * dt
    return joint_events, odometry_events


@pytest.mark.parametrize("by_pose", [True, False])
def test_radius_and_track_are_those_that_the_driver_sums_its_pose_up_with(by_pose):
    found = fit_geometry(WheelPair("left_wheel", "right_wheel"), *driven(by_pose))
    assert found.radii_m == pytest.approx((RADIUS, RADIUS), rel=0.005)
    assert found.track_m == pytest.approx(TRACK, rel=0.01)


@pytest.mark.parametrize("signs", [(-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_a_wheel_that_counts_backwards_has_a_negative_radius(signs):
    events, heard = driven(True)
    events = [replace(e, position=e.position * signs) for e in events]
    found = fit_geometry(WheelPair("left_wheel", "right_wheel"), events, heard)
    assert found.radii_m == pytest.approx((signs[0] * RADIUS, signs[1] * RADIUS), rel=0.005)
    assert found.track_m == pytest.approx(TRACK, rel=0.01)


def test_a_pose_whose_heading_is_not_its_way_tells_no_radius():
    found = fit_geometry(WheelPair("left_wheel", "right_wheel"), *driven(True, heading_off=0.2))
    assert found.radii_m == pytest.approx((RADIUS, RADIUS), rel=0.005)
    assert found.track_m == pytest.approx(TRACK, rel=0.01)
