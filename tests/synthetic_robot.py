"""A synthetic robot with gains, delay, lag and a speed that falls in turns: runs in memory and in bags."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from datasets.bag import BagWriter
from fgloc import se2
from fgloc.types import CommandEvent, FloatArray
from training.config import DataConfig
from training.data import Run, make_run

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
GAIN_V, GAIN_OMEGA, DELAY, TAU = 0.9, 1.05, 0.08, 0.15


def drive(rng: np.random.Generator, seconds: float) -> tuple[list[CommandEvent], np.ndarray, FloatArray]:
    """A robot with gains, delay and lag that also loses speed in turns: commands at 50 Hz, exact poses at 100 Hz."""
    dt = 0.01
    n = int(seconds / dt)
    t = np.arange(n) * dt
    levels = rng.uniform([0.0, -0.6], [0.3, 0.6], (int(seconds) + 2, 2))
    told = levels[(t[::2]).astype(int)]
    commands = [
        CommandEvent(T0 + round(s * SECOND), 0, "/cmd_vel", float(v), float(w))
        for s, (v, w) in zip(t[::2], told, strict=True)
    ]
    state, pose, poses = np.zeros(2), np.zeros(3), []
    for k in range(n):
        poses.append(pose)
        v, omega = told[max(0, k - round(DELAY / dt)) // 2]
        aim = np.array([GAIN_V * v * (1.0 - abs(omega)), GAIN_OMEGA * omega])
        state = state + dt / TAU * (aim - state)
        pose = se2.compose(pose, se2.exp((state[0] * dt, 0.0, state[1] * dt)))
    return commands, T0 + np.round(t * SECOND).astype(np.int64), np.array(poses)


def synthetic(seed: int, seconds: float = 60.0, dt_s: float = 0.1, name: str = "") -> Run:
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    return make_run(name or f"run{seed}", commands, stamps, poses, dt_s, 2.0, DataConfig())


def write_bag(path: Path, seed: int, seconds: float) -> None:
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    with BagWriter(path) as bag:
        for c in commands:
            bag.command("/cmd_vel", c.stamp_ns, c.v, c.omega)
        for stamp, (x, y, yaw) in zip(stamps[::2].tolist(), poses[::2], strict=True):
            bag.truth("/truth", stamp, [x, y, 0.0], [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
