"""Drives of the simulated robots: where their wheels stand, what their motors are told, what is written of them.

A differential and a skid-steer robot have wheels on two sides; a mecanum robot has four with rollers, an Ackermann one
drives its rear wheels and steers the front ones. The equations are those of `fgloc.drives`, once with the geometry that
the robot's driver believes, once with the true one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fgloc.drives.base import Drive
from fgloc.drives.sides import SkidSteer
from fgloc.drives.sliding import Mecanum
from fgloc.drives.steered import Ackermann
from fgloc.types import FloatArray
from fgloc_datasets.sim.scenario import Robot

_ROLLS_M_S = 1e-3  # below it a car's steering stays where it is


class Command(NamedTuple):
    """Command of a robot; it holds until the next."""

    v: float  # m/s, forward
    omega: float  # rad/s
    vy: float = 0.0  # m/s, to the left
    steering: float = 0.0  # rad, of an Ackermann robot; v and omega are what it makes of it


@dataclass(frozen=True, slots=True)
class Wheel:
    """A wheel: its joint, where its axle is in the base frame [m], and what moves it."""

    joint: str
    x: float
    y: float
    radius: float  # m, true
    driven: bool = True
    steered_by: str = ""  # joint
    rollers: float = 0.0  # of a mecanum wheel: y over x of the axis of the roller on the floor; 0: a tyre


def wheels(robot: Robot) -> tuple[Wheel, ...]:
    """All wheels, the driven ones first, left and right in turn."""
    half, radii = 0.5 * robot.track_m, [robot.radius_m * scale for scale in robot.radius_scale]
    sides = ("left", half, radii[0]), ("right", -half, radii[1])
    if robot.kind == "diff_drive":
        return tuple(Wheel(f"{side}_wheel_joint", 0.0, y, radius) for side, y, radius in sides)
    out = []
    ends = ("front", "rear") if robot.kind != "ackermann" else ("rear", "front")
    for end in ends:
        x = {"front": 1.0, "rear": 0.0 if robot.kind == "ackermann" else -1.0}[end] * robot.wheelbase_m
        for side, y, radius in sides:
            steered = robot.kind == "ackermann" and end == "front"
            out.append(
                Wheel(
                    f"{end}_{side}_wheel_joint",
                    x if robot.kind == "ackermann" else 0.5 * x,
                    y,
                    radius,
                    driven=not steered,
                    steered_by=f"{side}_steering_joint" if steered else "",
                    rollers=(1.0 if (end == "front") == (side == "right") else -1.0) * (robot.kind == "mecanum"),
                )
            )
    return tuple(out)


def wheel_names(robot: Robot) -> tuple[str, ...]:
    """Joint names of the driven wheels, which are measured: left and right in turn."""
    return tuple(wheel.joint for wheel in wheels(robot) if wheel.driven)


def steering_names(robot: Robot) -> tuple[str, ...]:
    """Joint names of the steering, left and right; empty if the robot has none."""
    return tuple(wheel.steered_by for wheel in wheels(robot) if wheel.steered_by)


# --- Equations --------------------------------------------------------------------------------------------------------


def believed(robot: Robot) -> Drive | None:
    """Drive with the geometry that the robot's driver and its owner believe; None: a differential robot's."""
    track, wheelbase = robot.track_m * robot.track_scale, robot.wheelbase_m * robot.wheelbase_scale
    return _drive(robot, track, wheelbase)


def true(robot: Robot) -> Drive | None:
    """Drive with the true geometry, but for the radii: `rolled` has them. None: a differential robot's."""
    made = _drive(robot, robot.track_m, robot.wheelbase_m)
    if not isinstance(made, Ackermann):
        return made
    return made.with_values({"steering_zero": robot.steering_zero_rad, "steering_ratio": robot.steering_ratio})


def _drive(robot: Robot, track: float, wheelbase: float) -> Drive | None:
    names, radius = wheel_names(robot), robot.radius_m
    if robot.kind == "mecanum":
        return Mecanum(wheels=names, radius=radius, half_sum=0.5 * (track + wheelbase))
    if robot.kind == "skid_steer":
        return SkidSteer(left=names[0::2], right=names[1::2], radius=radius, track=track)
    if robot.kind == "ackermann":
        return Ackermann(
            wheels=names,
            wheel_y=(0.5 * track, -0.5 * track),
            steering_joints=steering_names(robot),
            radius=radius,
            wheelbase=wheelbase,
        )
    return None


def settings(robot: Robot) -> Mapping[str, Any] | None:
    """Section ``wheels.drive`` of ``robot.yaml``; None: a differential robot needs none."""
    drive = believed(robot)
    return None if drive is None else {"kind": drive.kind, **drive.model_dump(mode="json", exclude_unset=True)}


def sides(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means of the left and of the right wheels, ``(n,)`` each."""
    return values[:, 0::2].mean(axis=1), values[:, 1::2].mean(axis=1)


def twists(robot: Robot, drive: Drive | None, track: float, rates: FloatArray, steering: FloatArray) -> FloatArray:
    """Body twists ``(n, 3)`` vx, vy [m/s], ω [rad/s] that wheels mean by a geometry.

    Args:
        robot: whose wheels they are.
        drive: of a robot that has not two sides of wheels.
        track: of one that has [m].
        rates: ``(n, wheels)`` of the driven wheels [rad/s], of the radius that the driver believes.
        steering: ``(n, k)`` [rad], as reported.
    """
    if isinstance(drive, SkidSteer) or drive is None:
        left, right = (of_side * robot.radius_m for of_side in sides(rates))
        return np.column_stack([0.5 * (left + right), np.zeros(len(left)), (right - left) / track])
    made = [drive.moves(row, angles)[0] for row, angles in zip(rates.tolist(), steering.tolist(), strict=True)]
    return np.array(made).reshape(-1, 3)


def rolled(robot: Robot, rates: FloatArray) -> FloatArray:
    """Rates ``(n, wheels)`` at which wheels of the believed radius would go as far as the true ones do."""
    return np.asarray(rates * np.tile(robot.radius_scale, rates.shape[1] // 2))


# --- Commands ---------------------------------------------------------------------------------------------------------


def as_driven(robot: Robot, v: float, omega: float, vy: float = 0.0, steering: float = 0.0) -> Command:
    """Command that a robot can follow for a wanted motion.

    One that does not go sideways leaves that out. A car turns no more sharply than its steering allows and not where it
    stands: it drives on for that.

    Args:
        robot: with its limits.
        v: forward [m/s].
        omega: turn [rad/s].
        vy: to the left [m/s].
        steering: angle of the command before [rad], which a car that is to stand keeps.
    """
    v, omega = within(v, robot.max_v), within(omega, robot.max_omega)
    if robot.kind == "mecanum":
        return Command(v, omega, within(vy, robot.max_v))
    if robot.kind != "ackermann":
        return Command(v, omega)
    wheelbase = robot.wheelbase_m * robot.wheelbase_scale
    sharpest = math.tan(robot.max_steering_rad) / wheelbase
    if abs(omega) > abs(v) * sharpest:
        v = math.copysign(min(abs(omega) / sharpest, robot.max_v), v)
    if abs(v) > _ROLLS_M_S:
        steering = within(math.atan(wheelbase * omega / v), robot.max_steering_rad)
    return Command(v, v * math.tan(steering) / wheelbase, 0.0, steering)


def rows(robot: Robot) -> list[tuple[float, float]]:
    """Speed of each driven wheel by motion to the left and by turning [m], as the driver believes."""
    drive = believed(robot)
    if isinstance(drive, Mecanum):
        A = drive.equations(np.zeros(4), np.zeros(0)).A
        return [(float(row[1]), float(row[2])) for row in A]
    arm = 0.5 * robot.track_m * robot.track_scale
    return [(0.0, -arm if "left" in name else arm) for name in wheel_names(robot)]


def steering_angles(robot: Robot, steering: float) -> tuple[float, ...]:
    """Angles [rad] of the left and the right steering, as the driver reports them, for one in the middle."""
    if robot.kind != "ackermann":
        return ()
    curvature = math.tan(steering) / (robot.wheelbase_m * robot.wheelbase_scale)
    half = 0.5 * robot.track_m * robot.track_scale
    return tuple(
        math.atan(robot.wheelbase_m * robot.wheelbase_scale * curvature / (1.0 - side * half * curvature))
        for side in (1.0, -1.0)
    )


def within(value: float, limit: float) -> float:
    """The value, or the limit of its sign where it is beyond."""
    return min(max(value, -limit), limit)
