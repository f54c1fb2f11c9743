"""Where the robot is after a time away: the saved pose, and what is known of the motion since."""

from __future__ import annotations

import math

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.state import OdometryState, RunState, row3
from fgloc.types import FloatArray, Mode, MotionEvent, Step

_KNOWN = (Mode.OK, Mode.DEAD_RECKONING)  # modes whose pose is worth going on from
_USELESS_M, _USELESS_RAD = 3.0, 0.7  # sigmas above which the map is searched anyway
_LEAST_SPEED, _LEAST_TURN = 0.5, 0.5  # m/s, rad/s that a robot is capable of at least
_HASTE = 1.5  # times its fastest: an odometry that went further than this was set anew
_AT_ORIGIN_M, _AT_ORIGIN_RAD = 0.05, 0.05  # an odometry this near to zero has perhaps just been started
_STAMP_S = 0.02  # how far the odometry's pose and the saved one may be apart in time


def odometry_state(event: MotionEvent) -> OdometryState | None:
    """What is saved of a motion event; None if it gives no pose."""
    told = event.odometer
    if told is None or not np.isfinite(told.pose).all():
        return None
    return OdometryState(topic=event.topic, frame_id=told.frame_id, stamp_ns=event.stamp_ns, pose=row3(told.pose))


def carried_over(state: RunState, step: Step, config: Config, wall_ns: int) -> tuple[PoseWithCovariance | None, str]:
    """The pose at the first step of a new run.

    Args:
        state: what the last run saved.
        step: the first one.
        config: error model of the odometer.
        wall_ns: wall clock at the step; gives the time away if the stamps' clock was set back.

    Returns:
        The pose, or None if too little is known of it; and a sentence on what was done.
    """
    gap_s = (step.stamp_ns - state.stamp_ns) * 1e-9
    if gap_s < 0.0:
        gap_s = max((wall_ns - state.saved_ns) * 1e-9, 0.0)
    if state.mode not in _KNOWN:
        return None, f"Resumed {gap_s:.1f} s later, without a pose: the last run was {state.mode}."
    saved = PoseWithCovariance(np.array(state.pose), np.array(state.cov))
    motion = _by_odometry(state, step, gap_s)
    if motion is not None:
        cov, how = _odometry_cov(state, motion, gap_s, config), "the odometry went on and has measured the motion since"
    else:
        motion, how = np.zeros(3), "nothing has measured the motion since"
        speed, turn = max(state.fastest[0], _LEAST_SPEED), max(state.fastest[1], _LEAST_TURN)
        cov = np.diag(np.square([speed * gap_s, speed * gap_s, turn * gap_s]) + 1e-9)
    ad = se2.adjoint(se2.inverse(motion))
    belief = PoseWithCovariance(se2.compose(saved.pose, motion), ad @ saved.cov @ ad.T + cov)
    x, y, yaw = np.sqrt(np.diag(belief.cov))
    if max(x, y) > _USELESS_M or yaw > _USELESS_RAD:
        return None, f"Resumed {gap_s:.1f} s later; {how}, so the pose is searched for on the whole map."
    return belief, f"Resumed {gap_s:.1f} s later; {how}: the pose is known to {math.hypot(x, y):.2f} m, {yaw:.2f} rad."


def _by_odometry(state: RunState, step: Step, gap_s: float) -> FloatArray | None:
    """``T_saved_now (3,)`` by the odometry's pose, if its frame went on."""
    saved = state.odometry
    if saved is None:
        return None
    told = [(e.stamp_ns, e.odometer) for events in step.motion.values() for e in events if e.topic == saved.topic]
    poses = [(at, p) for at, p in told if p is not None and p.frame_id == saved.frame_id and np.isfinite(p.pose).all()]
    if not poses:
        return None
    at_ns, now_told = min(poses, key=lambda found: abs(found[0] - step.stamp_ns))
    twist = np.array(state.twist)
    then = se2.compose(np.array(saved.pose), se2.exp(twist * (state.stamp_ns - saved.stamp_ns) * 1e-9))
    now_twist = np.where(np.isfinite(now_told.twist), now_told.twist, 0.0)
    now = se2.compose(now_told.pose, se2.exp(now_twist * (step.stamp_ns - at_ns) * 1e-9))
    if _at_origin(now) and not _at_origin(then):
        return None
    motion = se2.between(then, now)
    within_s = gap_s + 1.0
    if math.hypot(*motion[:2]) > _HASTE * max(state.fastest[0], _LEAST_SPEED) * within_s:
        return None
    return None if abs(motion[2]) > max(_HASTE * max(state.fastest[1], _LEAST_TURN) * within_s, math.pi) else motion


def _odometry_cov(state: RunState, motion: FloatArray, gap_s: float, config: Config) -> FloatArray:
    """Covariance ``(3, 3)`` of that motion: along a path that is as long as the speed before suggests, or the chord."""
    errors = config.wheels
    noise = errors.noise
    speed, turn = math.hypot(*state.twist[:2]), abs(state.twist[2])
    path = max(math.hypot(*motion[:2]), speed * gap_s)
    turned = max(abs(float(motion[2])), turn * gap_s)
    yaw = noise.yaw_per_sqrt_m**2 * path + noise.yaw_per_sqrt_rad**2 * turned + noise.yaw_per_sqrt_s**2 * gap_s
    yaw += (errors.turn_scale_sigma * turned) ** 2 + (errors.yaw_per_m_sigma * path) ** 2 + (_STAMP_S * turn) ** 2
    common = noise.xy_per_sqrt_rad**2 * turned + noise.xy_per_sqrt_s**2 * gap_s
    common += (errors.scale_sigma * path) ** 2 + (_STAMP_S * speed) ** 2 + yaw * path**2 / 3.0
    x = noise.x_per_sqrt_m**2 * path + common
    y = noise.y_per_sqrt_m**2 * path + common
    return np.diag([x, y, yaw]) + 1e-9 * np.eye(3)


def _at_origin(pose: FloatArray) -> bool:
    return bool(math.hypot(pose[0], pose[1]) < _AT_ORIGIN_M and abs(pose[2]) < _AT_ORIGIN_RAD)
