"""A synthetic robot with gains, delay, lag and a speed that falls in turns: runs in memory and in bags."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgloc import se2
from fgloc.config import Config, WheelsConfig
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.types import ControlEvent, Event, FloatArray
from fgloc_datasets.bag import BagWriter
from fgloc_training.config import DataConfig
from fgloc_training.data import Run, SensorRecord, make_run

SECOND = 1_000_000_000
T0 = 1_700_000_000 * SECOND
RADIUS, TRACK, JOINTS = 0.05, 0.26, ("left_wheel", "right_wheel")
GAIN_V, GAIN_OMEGA, DELAY, TAU = 0.9, 1.05, 0.08, 0.15


def drive(rng: np.random.Generator, seconds: float) -> tuple[list[ControlEvent], np.ndarray, FloatArray]:
    """A robot with gains, delay and lag that also loses speed in turns: commands at 50 Hz, exact poses at 100 Hz."""
    dt = 0.01
    n = int(seconds / dt)
    t = np.arange(n) * dt
    levels = rng.uniform([0.0, -0.6], [0.3, 0.6], (int(seconds) + 2, 2))
    told = levels[(t[::2]).astype(int)]
    commands = [
        ControlEvent(T0 + round(s * SECOND), 0, "/cmd_vel", float(v), float(w))
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


def sensed(seed: int, seconds: float = 60.0, bias: float = 0.0) -> list[Event]:
    """IMU at 100 Hz and joints at 50 Hz of the robot that `drive` drives: its left wheel is 2 % larger than nominal."""
    _, stamps, poses = drive(np.random.default_rng(seed), seconds)
    forward = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    turned = np.diff(np.unwrap(poses[:, 2]), prepend=poses[0, 2])
    left, right = ((forward + side * 0.5 * TRACK * turned) / RADIUS for side in (-1.0, 1.0))
    angles = np.cumsum(np.column_stack([left / 1.02, right]), axis=0)
    out: list[Event] = []
    for k, stamp in enumerate(stamps.tolist()):
        rate = np.array([0.0, 0.0, turned[k] * 100.0 + bias])
        out.append(ImuEvent(stamp, stamp, "/imu", "imu", rate, np.zeros(3), np.zeros((3, 3))))
        if k % 2 == 0:
            effort = np.array([0.1 + angles[k, 0] % 0.3, 0.2])
            out.append(JointsEvent(stamp, stamp, "/joints", JOINTS, angles[k], np.zeros(2), effort))
    return out


def sensing(seed: int, seconds: float = 60.0, bias: float = 0.0) -> Run:
    """A run with all signals."""
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    geometry = {"left_radius": RADIUS, "right_radius": RADIUS, "track": TRACK}
    config = Config(wheels=WheelsConfig(source="ticks", **geometry))
    record = SensorRecord([*commands, *sensed(seed, seconds, bias)], config)
    return make_run(f"run{seed}", record, stamps, poses, 0.1, 2.0, DataConfig())


def synthetic(seed: int, seconds: float = 60.0, dt_s: float = 0.1, name: str = "") -> Run:
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    return make_run(name or f"run{seed}", commands, stamps, poses, dt_s, 2.0, DataConfig())


def write_bag(path: Path, seed: int, seconds: float) -> None:
    commands, stamps, poses = drive(np.random.default_rng(seed), seconds)
    with BagWriter(path) as bag:
        for c in commands:
            bag.command("/cmd_vel", c.stamp_ns, c.v, c.omega)
        for stamp, pose in zip(stamps[::2].tolist(), poses[::2], strict=True):
            bag.planar_truth("/truth", stamp, pose)
