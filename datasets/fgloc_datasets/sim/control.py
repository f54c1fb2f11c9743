"""Control functions vʲ(t) and the driver that keeps the robot inside the room.

Source: the paper's eq. 1: the robot is identified from a set of control functions that covers its velocities.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fgloc_datasets.sim.drives import Command, as_driven
from fgloc_datasets.sim.scenario import Control, ControlKind, Robot, Scenario, channel_rng

Wanted = tuple[float, float]  # speed [m/s], turn [rad/s]
Function = Callable[[float], Wanted]  # of the time within the segment [s]


def make_function(kind: ControlKind, robot: Robot, length_s: float, rng: np.random.Generator) -> Function:
    """One control function over ``length_s``, its parameters drawn within the robot's speed limits."""
    v_max, w_max = robot.max_v, robot.max_omega
    v = float(rng.uniform(0.3, 1.0) * v_max)
    w = float(rng.uniform(0.25, 0.8) * w_max * rng.choice([-1.0, 1.0]))
    if kind == "straight":
        return lambda t: (v, 0.0)
    if kind == "turns":
        return lambda t: (v, w)
    if kind == "spin":
        return lambda t: (0.0, w if t < 0.5 * length_s else -w)
    if kind == "steps":
        holds = rng.uniform(1.5, 3.5, 64).cumsum()
        values = [(float(a * v_max), float(b * w_max)) for a, b in rng.uniform((0.0, -0.7), (1.0, 0.7), (64, 2))]
        return lambda t: values[min(int(np.searchsorted(holds, t, side="right")), 63)]
    if kind == "ramps":
        period = float(rng.uniform(4.0, 8.0))
        return lambda t: (v_max * _triangle(t / period), w * (2.0 * _triangle(t / period / 1.7) - 1.0))
    if kind == "sines":
        a, b = (float(f) for f in rng.uniform(0.08, 0.4, 2))  # Hz
        return lambda t: (
            0.5 * v_max * (1.0 + 0.8 * math.sin(2 * math.pi * a * t)),
            w * math.sin(2 * math.pi * b * t),
        )
    if kind == "random_walk":
        return _random_walk(v_max, w_max, length_s, rng)
    if kind == "stop_and_go":
        go, rest = (float(s) for s in rng.uniform(1.0, 2.2, 2))
        turns = [float(x) for x in rng.uniform(-0.8, 0.8, 64) * w_max]
        v_go = max(v, 0.6 * v_max)

        def stop_and_go(t: float) -> Wanted:
            cycle, phase = divmod(t, go + rest)
            return (v_go, 0.6 * turns[int(cycle) % 64]) if phase < go else (0.0, 0.0)

        return stop_and_go
    if kind == "figure_eight":
        slow = 0.6 * v
        period = float(rng.uniform(5.0, 8.0))
        turn = min(2 * math.pi / period, w_max)
        return lambda t: (slow, turn if (t // period) % 2 == 0 else -turn)
    sign = math.copysign(1.0, w)
    return lambda t: (0.6 * v_max * min(1.0, t / length_s + 0.15), sign * w_max * (0.8 - 0.6 * t / length_s))  # spiral


class Driver:
    """Commands of the robot over time; near walls it is turned back.

    A robot that goes sideways changes its direction slowly, as drawn by the seed. The control function is open loop.
    Near a wall, and only while heading for it, the driver takes over, turns towards the middle of the room and gives
    back control: the recorded commands are those that were sent.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """Draw the functions of all segments."""
        self._control, self._robot = scenario.control, scenario.robot
        self._reach = 0.5 * np.asarray(scenario.world.size_m) - scenario.world.keep_off_m
        rng = channel_rng(seed, "control")
        kinds = self._control.functions
        n = math.ceil(scenario.duration_s / self._control.segment_s)
        self._functions = [
            make_function(kinds[i % len(kinds)], self._robot, self._control.segment_s, rng) for i in range(n)
        ]
        self._next_waypoint = 0
        self._turning_back = False
        self._steering = 0.0
        rng = channel_rng(seed, "sideways")
        self._aside = [(float(rng.uniform(0.04, 0.12)), float(rng.uniform(0.0, math.tau))) for _ in range(2)]

    def command(self, t: float, pose: tuple[float, float, float]) -> Command:
        """Command at time t [s] of a robot at x, y [m], yaw [rad]; to be asked in order of time."""
        if t < self._control.rest_s:
            return Command(0.0, 0.0)
        aside = 0.0  # direction of the motion from straight ahead [rad]
        if self._control.waypoints:
            v, omega = self._to_waypoint(self._control, pose)
        else:
            index = min(int(t / self._control.segment_s), len(self._functions) - 1)
            v, omega = self._functions[index](t - index * self._control.segment_s)
            if self._robot.kind == "mecanum":
                aside = sum(0.5 * _WIDEST * math.sin(math.tau * hz * t + phase) for hz, phase in self._aside)
            v, omega = self._keep_inside((pose[0], pose[1], pose[2] + aside), v, omega)
        command = as_driven(self._robot, v * math.cos(aside), omega, v * math.sin(aside), self._steering)
        self._steering = command.steering
        return command

    def _to_waypoint(self, control: Control, pose: tuple[float, float, float]) -> Wanted:
        target = control.waypoints[self._next_waypoint % len(control.waypoints)]
        if math.hypot(target[0] - pose[0], target[1] - pose[1]) < 0.25:
            self._next_waypoint += 1
            target = control.waypoints[self._next_waypoint % len(control.waypoints)]
        off = _bearing(pose, target)
        return control.speed * max(0.15, math.cos(off)) if abs(off) < 1.3 else 0.0, 1.6 * off

    def _keep_inside(self, pose: tuple[float, float, float], v: float, omega: float) -> Wanted:
        x, y, yaw = pose
        ahead = 0.35
        reach_x, reach_y = self._reach
        inside = abs(x + ahead * math.cos(yaw)) < reach_x and abs(y + ahead * math.sin(yaw)) < reach_y
        off = _bearing(pose, (0.0, 0.0))
        if self._turning_back:
            self._turning_back = abs(off) > 0.4 or not inside
        else:
            self._turning_back = not inside and abs(off) > 0.4
        if not self._turning_back:
            return v, omega
        turn = max(0.5, min(1.0, abs(off))) * math.copysign(0.7 * self._robot.max_omega, off)
        return (0.15 * self._robot.max_v if abs(off) < 1.2 else 0.0), turn


_WIDEST = 2.0  # rad: the most that a robot which goes sideways goes aside from straight ahead


def _bearing(pose: tuple[float, float, float], target: tuple[float, float]) -> float:
    """Direction of a target [rad] as seen from a pose, in (-π, π]."""
    angle = math.atan2(target[1] - pose[1], target[0] - pose[0]) - pose[2]
    return math.atan2(math.sin(angle), math.cos(angle))


def _triangle(t: float) -> float:
    """A wave of period 1 between 0 and 1."""
    return 1.0 - abs(2.0 * (t % 1.0) - 1.0)


def _random_walk(v_max: float, w_max: float, length_s: float, rng: np.random.Generator) -> Function:
    """An Ornstein–Uhlenbeck walk of both, sampled at 20 Hz."""
    n, dt, tau = int(length_s * 20) + 2, 0.05, 2.0
    walk = np.zeros((n, 2))
    for i in range(1, n):
        walk[i] = walk[i - 1] * (1 - dt / tau) + rng.normal(0, math.sqrt(2 * dt / tau), 2)
    v = np.clip(0.5 * v_max * (1 + 0.6 * walk[:, 0]), 0, v_max)
    w = np.clip(0.35 * w_max * walk[:, 1], -w_max, w_max)
    return lambda t: (float(v[min(int(t * 20), n - 1)]), float(w[min(int(t * 20), n - 1)]))
