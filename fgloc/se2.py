"""SE(2) in plain numpy: composition, exponential, logarithm, adjoint.

A pose or motion is ``(3,)``: x [m], y [m], yaw [rad]. The tangent order is x, y, yaw; perturbations act on the right
(in the body frame), as in GTSAM's ``Pose2``.

Source: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018, section on SE(2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Triple = Sequence[float] | FloatArray
_SMALL = 1e-9
DOF = 3  # of a pose or motion
ANY_YAW = math.pi**2 / 3.0  # rad²: variance of a yaw that may be any, with equal probability


def triple(values: Triple) -> tuple[float, float, float]:
    """Three numbers of an array ``(3,)`` as a tuple."""
    x, y, z = map(float, values)
    return x, y, z


def wrap(angle: float) -> float:
    """Wrap an angle [rad] into [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def wrap_array(angles: FloatArray) -> FloatArray:
    """Wrap angles [rad] of any shape into [-pi, pi)."""
    return np.asarray((np.asarray(angles, dtype=float) + math.pi) % (2.0 * math.pi) - math.pi)


def compose(a: Triple, b: Triple) -> FloatArray:
    """Compose two poses: ``T_a ∘ T_b``; the yaw is wrapped."""
    ax, ay, at = a
    bx, by, bt = b
    c, s = math.cos(at), math.sin(at)
    return np.array([ax + c * bx - s * by, ay + s * bx + c * by, wrap(at + bt)])


def compose_array(a: FloatArray, b: FloatArray) -> FloatArray:
    """`compose` of poses ``(n, 3)`` with others; either may be one pose ``(3,)``."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap_array(a[..., 2] + b[..., 2])], axis=-1)


def inverse(a: Triple) -> FloatArray:
    """Inverse pose ``T_a⁻¹``."""
    ax, ay, at = a
    c, s = math.cos(at), math.sin(at)
    return np.array([-c * ax - s * ay, s * ax - c * ay, wrap(-at)])


def between(a: Triple, b: Triple) -> FloatArray:
    """Pose of b seen from a, ``T_a⁻¹ ∘ T_b``."""
    return compose(inverse(a), b)


def between_array(a: FloatArray, b: FloatArray) -> FloatArray:
    """`between` of poses ``(n, 3)`` and others."""
    moved = turned(b[:, :2] - a[:, :2], -a[:, 2])
    return np.column_stack([moved, wrap_array(b[:, 2] - a[:, 2])])


def exp(twist: Triple) -> FloatArray:
    """Exponential map of (dx, dy, dyaw): the exact pose after constant body twist for unit time."""
    x, y, t = twist
    if abs(t) < _SMALL:
        a, b = 1.0, 0.5 * t
    else:
        a, b = math.sin(t) / t, (1.0 - math.cos(t)) / t
    return np.array([a * x - b * y, b * x + a * y, wrap(t)])


def exp_array(twists: FloatArray) -> FloatArray:
    """`exp` of twists ``(n, 3)``."""
    x, y, t = twists.T
    small = np.abs(t) < _SMALL
    safe = np.where(small, 1.0, t)
    a, b = np.where(small, 1.0, np.sin(safe) / safe), np.where(small, 0.5 * t, (1.0 - np.cos(safe)) / safe)
    return np.stack([a * x - b * y, b * x + a * y, wrap_array(t)], axis=1)


def log(pose: Triple) -> FloatArray:
    """Logarithm: the constant body twist that reaches the pose in unit time."""
    x, y, t = pose
    t = wrap(t)
    half = 0.5 * t
    a = 1.0 - half * half / 3.0 if abs(t) < 1e-5 else half / math.tan(half)
    return np.array([a * x + half * y, -half * x + a * y, t])


def adjoint(pose: Triple) -> FloatArray:
    """Adjoint ``(3, 3)``: moves a right perturbation through the pose, ``Ad(T) ξ = log(T exp(ξ) T⁻¹)``."""
    x, y, t = pose
    c, s = math.cos(t), math.sin(t)
    return np.array([[c, -s, y], [s, c, -x], [0.0, 0.0, 1.0]])


def right_jacobian(twist: Triple) -> FloatArray:
    """Right Jacobian ``(3, 3)`` of the exponential map: ``exp(ξ + δ) = exp(ξ) exp(J δ)`` for small δ.

    Source: Solà et al. 2018, equation 163.
    """
    x, y, t = twist
    if abs(t) < 1e-4:
        a, b, c, d = 1.0 - t * t / 6.0, 0.5 * t, t / 6.0, 0.5
    else:
        s, k = math.sin(t), 1.0 - math.cos(t)
        a, b, c, d = s / t, k / t, (t - s) / t**2, k / t**2
    return np.array([[a, b, c * x - d * y], [-b, a, c * y + d * x], [0.0, 0.0, 1.0]])


def compose_cov(cov_a: FloatArray, b: Triple, cov_b: FloatArray) -> FloatArray:
    """Covariance ``(3, 3)`` of ``T_a ∘ T_b`` for independent right perturbations of both.

    Source: first order, ``Ad(b⁻¹) Σ_a Ad(b⁻¹)ᵀ + Σ_b``.
    """
    ad = adjoint(inverse(b))
    return np.asarray(ad @ cov_a @ ad.T + cov_b)


def rotate_cov(cov: FloatArray, yaw: float) -> FloatArray:
    """Turn the x and y of a body-frame covariance ``(3, 3)`` into the frame in which the body has this yaw [rad]."""
    c, s = math.cos(yaw), math.sin(yaw)
    r = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(r @ cov @ r.T)


def interpolate(stamps_ns: NDArray[np.int64], poses: FloatArray, at_ns: NDArray[np.int64]) -> FloatArray:
    """Poses ``(m, 3)`` at the asked times, linear in x, y and in the shorter way round in yaw.

    Args:
        stamps_ns: ``(n,)`` increasing times of the known poses.
        poses: ``(n, 3)``.
        at_ns: ``(m,)`` times inside the known range; outside it the nearest pose is held.
    """
    origin = int(stamps_ns[0])
    known = (stamps_ns - origin) * 1e-9
    asked = (at_ns - origin) * 1e-9
    yaw = np.interp(asked, known, np.unwrap(poses[:, 2]))
    return np.column_stack(
        [np.interp(asked, known, poses[:, 0]), np.interp(asked, known, poses[:, 1]), wrap_array(yaw)]
    )


def rigid(source: FloatArray, target: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Pose ``(3,)`` that takes points ``(n, 2)`` to others, by weighted least squares.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991, without
    scale; in the plane the rotation has a closed form.
    """
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    a, b = source - share @ source, target - share @ target
    yaw = math.atan2(share @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), share @ (a * b).sum(axis=1))
    return np.append(share @ target - turned(share @ source, yaw), yaw)


def rigid_if_spread(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None, spread_m: float = 0.4
) -> FloatArray | None:
    """`rigid`; None where the targets' standard deviation is below ``spread_m``: they do not determine a direction."""
    if len(target) < 2 or float(target.var(axis=0).sum()) < spread_m**2:
        return None
    return rigid(source, target, weights)


def placed(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Points ``(n, 2)`` of the bodies' frames in the frame of their poses ``(n, 3)`` or ``(3,)``."""
    return np.asarray(poses[..., :2] + turned(points, poses[..., 2]))


def turned(points: FloatArray, yaw: FloatArray | float) -> FloatArray:
    """Points ``(..., 2)`` turned by angles ``(...)`` [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1]], axis=-1)
