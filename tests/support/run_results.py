"""A run's result made from formulas, for what comes after a run: metrics, plots, report."""

from pathlib import Path

import numpy as np

from fgloc.runner import RunResult
from fgloc.se2 import rotate_cov, wrap_array
from fgloc.types import Decision, Finding, Landmark, LandmarkMap, Mode, TopicTimes, Trajectory

START_NS = 1_700_000_000_000_000_000


REPORT_FILES = {
    "trajectory.tum",
    "truth.tum",
    "covariance.csv",
    "steps.csv",
    "metrics.json",
    "config.json",
    "trajectory.png",
    "timeline.png",
    "report.html",
}
"""Files of every run with a truth."""


def figure_eight(seed=0, n=300, truth=True, modes=None):
    """30 s of figure eights with an honest covariance; the truth is silent in the middle third."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    x, y = 3.0 * np.sin(0.2 * t), 1.8 * np.sin(0.4 * t)
    true = np.column_stack([x, y, np.arctan2(np.gradient(y), np.gradient(x))])
    sigma = 0.01 + 0.03 * np.abs(np.sin(0.1 * t))
    covs = np.array(
        [rotate_cov(np.diag([s**2, 4 * s**2, s**2]), yaw) for s, yaw in zip(sigma, true[:, 2], strict=True)]
    )
    poses = true + np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=(n, 3)))
    poses[:, 2] = wrap_array(poses[:, 2])
    stamps = START_NS + (100_000_000 * np.arange(n))
    known = np.r_[0 : n // 3, 2 * n // 3 : n]
    decisions = []
    for k in range(n):
        decisions.append(Decision(k, int(stamps[k]), "wheels", -1, 0.5, 0.3, 3, 1.0, ""))
        if k % 10 == 0:
            decisions.append(Decision(k, int(stamps[k]), "corners", k % 3, 9.0, 81.0, 8, 0.0, "gate"))
    return RunResult(
        trajectory=Trajectory(stamps, poses, covs),
        modes=tuple(modes or [Mode.OK] * n),
        decisions=tuple(decisions),
        counts={"wheels": n, "corners": 60},
        rejections={"sightings.gate": 30, "odometry.duplicate_stamp": 2},
        findings=(Finding("wheels.source", "The odometry's <twist> is zero while its pose moves."),),
        step_ms=np.linspace(0.5, 1.5, n),
        wall_s=10.0,
        truth=Trajectory(stamps[known], true[known]) if truth else None,
        landmarks=LandmarkMap(
            {0: _standing(0, 4.0, 0.0, np.pi), 7: Landmark(7, np.array([0.0, 2.6, 0.0]), np.eye(3), 0.0)}
        ),
        spans={
            "/odom": TopicTimes(np.arange(0.0, 30.0, 0.05), 600, 1, 0.05),
            "/camera": TopicTimes(np.r_[np.arange(0, 10, 0.1), np.arange(20, 30, 0.1)], 200, 1, 10.1),
        },
        source=Path("first_run"),
        first_pose_s=0.4,
    )


def _standing(landmark_id, x, y, yaw):
    face, up = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([0.0, 0.0, 1.0])
    return Landmark(landmark_id, np.array([x, y, 0.3]), np.column_stack([np.cross(up, face), up, face]), 0.2)
