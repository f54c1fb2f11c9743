"""Which joints are wheels, by their names."""

import pytest

from fgloc.sensors.wheels.sensor import WheelPair, wheel_pair


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
