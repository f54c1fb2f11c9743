"""What came of a drive: its scores, and the files that are written of it."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import yaml

from fgloc.sensors.failures import Failure
from fgloc.types import FloatArray
from fgloc_datasets.sim.following.path import Curve, WaypointPath
from fgloc_datasets.sim.following.pursuit import State

REACHED_M = 0.10  # a waypoint is reached if the robot has come so near
_EVERY_M = 0.01  # of the true path, for means over its length
_COLUMNS = ("t", "x", "y", "yaw", "sigma", "v", "omega", "state", "true_x", "true_y", "true_yaw")


@dataclass(frozen=True, slots=True)
class Score:
    """How well a path was followed.

    Attributes:
        track_mm: mean distance of the true path from the waypoints' curve, over the length of the true path.
        worst_mm: the largest.
        reached: share of the waypoints that the robot has come within 10 cm of.
        arrived: whether the follower came to its end.
        seconds: until then, or until the time was over.
        pose_mm: mean distance of the pose that guided the robot from the truth.
        stopped_s: how long the robot stood or searched because it had no pose to drive by.
    """

    track_mm: float
    worst_mm: float
    reached: float
    arrived: bool
    seconds: float
    pose_mm: float | None
    stopped_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """One drive.

    Attributes:
        times_s: ``(n,)`` of the commands.
        poses: ``(n, 3)`` that the follower was given, NaN where there was none.
        sigmas_m: ``(n,)`` of their position.
        commands: ``(n, 2)`` v, omega.
        states: of the follower.
        true_poses: ``(n, 3)`` at the same times.
        true_path: ``(m, 3)`` x, y, z of the whole drive.
        score: how well.
    """

    times_s: FloatArray
    poses: FloatArray
    sigmas_m: FloatArray
    commands: FloatArray
    states: tuple[State, ...]
    true_poses: FloatArray
    true_path: FloatArray
    score: Score

    @classmethod
    def of(cls, curve: Curve, true: FloatArray, rows: FloatArray, states: tuple[State, ...]) -> Followed:
        """Score a drive.

        Args:
            curve: that was to be followed.
            true: ``(m, 7)`` position and quaternion at every tick.
            rows: ``(n, 7)`` of the loop, evenly over the ticks.
            states: ``(n,)``.
        """
        every = round((len(true) - 1) / max(len(rows) - 1, 1))
        at = true[: every * len(rows) : every]
        x, y, z, w = at[:, 3:].T
        true_poses = np.column_stack([at[:, :2], np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))])
        known = np.isfinite(rows[:, 1])
        errors = np.hypot(*(rows[known, 1:3] - true_poses[known, :2]).T)
        off = curve.distances(_evenly(true[:, :2]))
        waypoints = curve.points[curve.at_waypoints]
        nearest = [float(np.hypot(*(true[:, :2] - p).T).min()) for p in waypoints]
        waiting = np.array([s in (State.STOPPED, State.SEARCHING) for s in states])
        arrived = State.ARRIVED in states
        end = states.index(State.ARRIVED) if arrived else len(states) - 1
        score = Score(
            track_mm=1e3 * float(off.mean()),
            worst_mm=1e3 * float(off.max()),
            reached=float(np.mean(np.array(nearest) <= REACHED_M)),
            arrived=arrived,
            seconds=float(rows[end, 0]),
            pose_mm=1e3 * float(errors.mean()) if known.any() else None,
            stopped_s=float(waiting.sum() * (rows[1, 0] - rows[0, 0])),
        )
        return cls(rows[:, 0], rows[:, 1:4], rows[:, 4], rows[:, 5:], states, true_poses, true[:, :3], score)


def _evenly(places: FloatArray) -> FloatArray:
    """Places ``(m, 2)`` at even distances along a path ``(n, 2)``."""
    along = np.concatenate([[0.0], np.hypot(*np.diff(places, axis=0).T).cumsum()])
    at = np.arange(0.0, along[-1] + _EVERY_M, _EVERY_M)
    return np.column_stack([np.interp(at, along, places[:, k]) for k in range(2)])


def write_followed(
    followed: Followed, path: WaypointPath, pose: str, failures: Sequence[Failure], folder: Path
) -> None:
    """Write ``following.csv``, a row for each command, and ``following.yaml``: path, pose, failures and score."""
    with (folder / "following.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(_COLUMNS)
        for i, t in enumerate(followed.times_s):
            numbers = (*followed.poses[i], followed.sigmas_m[i], *followed.commands[i])
            true = [f"{v:.6f}" for v in followed.true_poses[i]]
            table.writerow([f"{t:.3f}", *(f"{v:.6f}" for v in numbers), followed.states[i].value, *true])
    content = {
        "pose": pose,
        "score": asdict(followed.score),
        "failures": [failure.model_dump(mode="json") for failure in failures],
        "path": path.model_dump(mode="json"),
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)
    (folder / "following.yaml").write_text(text, encoding="utf-8")
