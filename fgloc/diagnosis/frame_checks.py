"""Frames that are not the map's: of a first pose that was given, and of the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.frames import quaternion_yaw
from fgloc.types import FloatArray, IntArray, TruthEvent

_SURE = 6.0  # sigmas of the given pose
_SLACK = (0.1, 0.1, 0.1)  # m, m, rad beside them
_FRAME_M = 0.3  # mean distance to the truth above which its frame is asked about: no run as installed errs by so much
_ALIGNED = 0.2  # share of that distance which may remain when the frames are brought together


def first_pose_sentence(config: Config, started: FloatArray) -> str | None:
    """The sentence on a first pose that was given and is not where the sightings put it; None if it is.

    Args:
        config: as the run uses it.
        started: ``(3,)`` where the sightings put the run's first pose.
    """
    given = config.estimator.initial_pose
    if given is None:
        return None
    apart = se2.log(se2.between(given, started))
    allowed = _SURE * np.array(config.estimator.initial_sigmas) + _SLACK
    if (np.abs(apart) <= allowed).all():
        return None
    x, y, yaw = started
    return (
        f"By the map and the sightings the run began at x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad, but "
        f"estimator.initial_pose says {given[0]:.2f}, {given[1]:.2f}, {given[2]:.2f}: the map is shifted by "
        f"{math.hypot(*apart[:2]):.2f} m and {math.degrees(abs(apart[2])):.0f}°, or the pose is wrong; shift the map "
        f"or set estimator.initial_pose: [{x:.3f}, {y:.3f}, {yaw:.4f}]."
    )


def truth_sentence(config: Config, truth: Sequence[TruthEvent], stamps_ns: IntArray, poses: FloatArray) -> str | None:
    """The sentence on a truth in another frame than the map's; None if it is in the map's, or fits neither way.

    Args:
        config: as the run uses it.
        truth: events of the excerpt.
        stamps_ns: ``(n,)`` of the poses.
        poses: ``(n, 3)`` by map and sightings.
    """
    if config.truth.align != "none" or len(truth) < 2:
        return None
    ordered = sorted(truth, key=lambda e: e.stamp_ns)
    at = np.array([e.stamp_ns for e in ordered], dtype=np.int64)
    there = (stamps_ns > at[0]) & (stamps_ns < at[-1])
    if there.sum() < 4:
        return None
    known = np.array([(*e.position[:2], quaternion_yaw(e.orientation)) for e in ordered])
    t = (stamps_ns[there] - at[0]) * 1e-9
    path = np.column_stack([np.interp(t, (at - at[0]) * 1e-9, known[:, k]) for k in (0, 1)])
    here = poses[there, :2]
    apart = float(np.hypot(*(path - here).T).mean())
    T = se2.rigid_if_spread(path, here)
    if apart < _FRAME_M or T is None:
        return None
    left = float(np.hypot(*(se2.placed(T, path) - here).T).mean())
    if left > _ALIGNED * apart:
        return None
    return (
        f"The truth is in another frame than the map, {apart:.2f} m away on average and {left:.3f} m once moved by x "
        f"{T[0]:.2f} m, y {T[1]:.2f} m, yaw {T[2]:.3f} rad: set truth.align: se2."
    )
