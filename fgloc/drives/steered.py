"""Drives with a steered axle: cars (Ackermann, or a bicycle's model of them), and tricycles driven in front."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from fgloc.drives.base import LENGTH_SIGMA, ZERO_SIGMA, Equations, FloatArray, Metres, Place, Steered, as_many_as_wheels

_STRAIGHT = 1e-4  # of a sum of two tangents: below it both wheels point straight ahead
_RATIO_SIGMA = 0.02


class _Axle(Steered):
    """Base of drives with a rear axle that does not steer."""

    unequal: ClassVar[bool] = False
    wheelbase: Metres = Field(description="from rear to steered axle")
    steering_zero: float = Field(0.0, ge=-2, le=2, description="added to the angle")
    axle_x: Place = Field(0.0, description="x of the rear axle in the base frame")

    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigmas of radius, wheelbase, steering_ratio, steering_zero and axle_x."""
        return {
            "radius": LENGTH_SIGMA * self.radius,
            "wheelbase": LENGTH_SIGMA * self.wheelbase,
            "steering_ratio": _RATIO_SIGMA * abs(self.steering_ratio),
            "steering_zero": ZERO_SIGMA,
            "axle_x": 0.0,
        }

    def commanded(self, speed: float, angle: float) -> tuple[float, float, float]:
        """Twist [m/s, m/s, rad/s] at a speed [m/s] of the rear axle and an angle [rad] of the middle of the front."""
        omega = speed * math.tan(angle) / self.wheelbase
        return speed, -self.axle_x * omega, omega


class Ackermann(_Axle):
    """A car: wheels that do not steer drive, one or two in front steer.

    Speed and angle of an ``ackermann_msgs`` message are the joints ``speed`` (radius 1) and ``steering_angle``.
    """

    kind: Literal["ackermann"] = "ackermann"
    wheels: tuple[str, ...] = Field(("speed",), min_length=1, description="joints of the measured wheels")
    wheel_y: tuple[Place, ...] = Field((), description="of each, left of the middle; none: 0")
    steering_joints: tuple[str, ...] = Field(
        ("steering_angle",), min_length=1, max_length=2, description="one joint, or left and right"
    )
    radius: Metres = Field(1.0, description="of the wheels; 1: their rate is a speed in m/s")

    @property
    def driven(self) -> tuple[str, ...]:
        """Joints of the measured wheels."""
        return self.wheels

    @property
    def steered(self) -> tuple[str, ...]:
        """Joints of the steering."""
        return self.steering_joints

    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """Rows of each wheel along x, and of both axles, which do not move sideways."""
        n = len(rates)
        delta, by_zero, by_ratio = self._angle(angles)
        c, s, front = math.cos(delta), math.sin(delta), self.axle_x + self.wheelbase
        A, b = np.zeros((n + 2, 3)), np.zeros(n + 2)
        A[:n, 0], b[:n] = 1.0, self.radius * rates
        A[:n, 2] = -np.array(self.wheel_y or (0.0,) * n)
        A[n], A[n + 1] = (-s, c, c * front), (0.0, 1.0, self.axle_x)
        turned, longer, moved = (np.zeros((n + 2, 3)) for _ in range(3))
        turned[n] = -c, -s, -s * front
        longer[n, 2] = c
        moved[n, 2], moved[n + 1, 2] = c, 1.0
        A_by = {"steering_zero": by_zero * turned, "steering_ratio": by_ratio * turned}
        A_by |= {"wheelbase": longer, "axle_x": moved}
        return Equations(A, b, A_by, {"radius": np.append(rates, (0.0, 0.0))})

    def _angle(self, reported: FloatArray) -> tuple[float, float, float]:
        """Angle of a wheel in the middle of the front axle [rad], and its derivatives by steering_zero and _ratio.

        The cotangents of the left and the right angle are on both sides of the middle's, as far as each other.
        """
        each = self.steering_ratio * reported + self.steering_zero
        if len(each) == 1:
            return float(each[0]), 1.0, float(reported[0])
        left, right = np.tan(each).tolist()
        total = left + right
        if left * right <= 0.0 or abs(total) < _STRAIGHT:
            return float(each.mean()), 1.0, float(reported.mean())
        tangent = 2.0 * left * right / total
        by_tangents = 2.0 * np.array([right**2, left**2]) / total**2
        by_each = by_tangents * (1.0 + np.tan(each) ** 2) / (1.0 + tangent**2)
        return math.atan(tangent), float(by_each.sum()), float(by_each @ reported)

    @model_validator(mode="before")
    @classmethod
    def _alike(cls, content: object) -> object:
        if isinstance(content, dict) and content.get("wheel_y"):
            return as_many_as_wheels({"wheels": ("speed",)} | content, "wheel_y")
        return content


class Tricycle(_Axle):
    """One wheel in front that steers and drives, and an axle behind that does neither."""

    kind: Literal["tricycle"] = "tricycle"
    wheel: str = Field(description="joint of the wheel's rotation")
    steering_joint: str = Field(description="joint of its steering")

    @property
    def driven(self) -> tuple[str, ...]:
        """The wheel's joint."""
        return (self.wheel,)

    @property
    def steered(self) -> tuple[str, ...]:
        """The steering's joint."""
        return (self.steering_joint,)

    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """Rows of the wheel along and across the way it points, and of the rear axle."""
        delta = self.steering_ratio * float(angles[0]) + self.steering_zero
        c, s, front = math.cos(delta), math.sin(delta), self.axle_x + self.wheelbase
        A = np.array([[c, s, s * front], [-s, c, c * front], [0.0, 1.0, self.axle_x]])
        turned = np.array([[-s, c, c * front], [-c, -s, -s * front], [0.0, 0.0, 0.0]])
        longer = np.array([[0.0, 0.0, s], [0.0, 0.0, c], [0.0, 0.0, 0.0]])
        moved = longer + np.array([[0.0] * 3, [0.0] * 3, [0.0, 0.0, 1.0]])
        A_by = {"steering_zero": turned, "steering_ratio": float(angles[0]) * turned}
        A_by |= {"wheelbase": longer, "axle_x": moved}
        travel = np.array([float(rates[0]), 0.0, 0.0])
        return Equations(A, self.radius * travel, A_by, {"radius": travel})
