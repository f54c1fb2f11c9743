"""What a judgement cost or saved: of the rows of ``steps.csv`` that it is made of, and the poses at their time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fgloc.types import Decision, Trajectory


def effect(kind: str, rows: Sequence[Decision], trajectory: Trajectory) -> str:
    """In words: what became of the pose by this judgement.

    Args:
        kind: of the judgement.
        rows: that it is made of, by time.
        trajectory: of the run.
    """
    return _EFFECTS.get(kind, _not_used)(rows, trajectory)


def plural(count: int, noun: str) -> str:
    """A number of things."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _not_used(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    return f"{plural(sum(d.weight == 0.0 for d in rows), 'sighting')} not used"


def _left_out(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    shifts = [d.shift_m for d in rows if math.isfinite(d.shift_m)]
    told = f"; would have moved the pose by {sum(shifts):+.3f} m forward" if shifts else ""
    return f"left out{told}"


def _gone_to(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    far = max((d.shift_m for d in rows if math.isfinite(d.shift_m)), default=math.nan)
    before = _sigma_m(trajectory, rows[0].stamp_ns, before=True)
    after = _sigma_m(trajectory, rows[-1].stamp_ns, before=False)
    moved = f"pose moved by {far:.2f} m; " if math.isfinite(far) else ""
    return f"{moved}position σ {_metres(before)} before, {_metres(after)} after"


def _held(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    far = max((d.shift_m for d in rows if math.isfinite(d.shift_m)), default=math.nan)
    told = f"sightings put the robot {far:.2f} m off; " if math.isfinite(far) else ""
    return f"{told}{_not_used([d for d in rows if d.landmark_id >= 0], trajectory)}"


def _travelled(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    first, end = np.searchsorted(trajectory.stamps_ns, [rows[0].stamp_ns, rows[-1].stamp_ns + 1])
    poses = trajectory.poses[max(first - 1, 0) : end]
    if len(poses) < 2:
        return ""
    way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    covs = None if trajectory.covs is None else trajectory.covs[max(first - 1, 0) : end]
    sigma = math.nan if covs is None else float(np.sqrt(covs[:, 0, 0] + covs[:, 1, 1]).max())
    return f"{way:.2f} m without a fix; position σ up to {_metres(sigma)}"


def _clock(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    return "no motion connects the poses before and after"


_EFFECTS: Mapping[str, Callable[[Sequence[Decision], Trajectory], str]] = {
    "motion_faulty": _left_out,
    "motion_overruled": _gone_to,
    "relocated": _gone_to,
    "initial_pose_contradicted": _held,
    "outage": _travelled,
    "lost": _travelled,
    "lifted": _travelled,
    "unconfirmed": _travelled,
    "clock_jump": _clock,
}


def _sigma_m(trajectory: Trajectory, stamp_ns: int, before: bool) -> float:
    """Of the position at the last pose before a time, or at the first one not before it."""
    at = int(np.searchsorted(trajectory.stamps_ns, stamp_ns)) - before
    if trajectory.covs is None or not 0 <= at < len(trajectory):
        return math.nan
    return math.sqrt(trajectory.covs[at, 0, 0] + trajectory.covs[at, 1, 1])


def _metres(value: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{1e3 * value:.1f} mm" if value < 0.1 else f"{value:.2f} m"
