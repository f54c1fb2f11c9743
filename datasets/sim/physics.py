"""Physics: a scenario and a seed in, a log of everything that happened out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from datasets.sim.control import Driver
from datasets.sim.ground import Ground, make_ground
from datasets.sim.mjcf import build_model, wheel_names
from datasets.sim.room import make_map
from datasets.sim.scenario import Robot, Scenario
from fgloc.frames import yaw_quaternion
from fgloc.types import FloatArray, LandmarkMap

TICK_S = 0.005
_SETTLE_S = 0.5
SLIP_M_S = 0.03  # a wheel slips if its circumference differs from the ground by more than this


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """State of the robot every TICK_S, from time 0 on. The base frame is on the floor between the wheels."""

    stamps_s: FloatArray  # (n,)
    positions: FloatArray  # (n, 3) m in the map
    quaternions: FloatArray  # (n, 4) x y z w, R_map_base
    velocities: FloatArray  # (n, 3) m/s of the base's origin, in the map
    rates: FloatArray  # (n, 3) rad/s, in the base
    wheel_angles: FloatArray  # (n, wheels) rad
    wheel_rates: FloatArray  # (n, wheels) rad/s
    torques: FloatArray  # (n, wheels) Nm, at the wheel
    commands: FloatArray  # (m, 3) t [s], v [m/s], omega [rad/s]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What a scenario and a seed make: model, ground and marker map."""

    scenario: Scenario
    seed: int
    ground: Ground
    landmarks: LandmarkMap
    model: mujoco.MjModel


def make_scene(scenario: Scenario, seed: int) -> Scene:
    """Lay out the room and compile the model."""
    ground = make_ground(scenario.world, seed)
    landmarks = make_map(scenario.world, seed)
    return Scene(scenario, seed, ground, landmarks, build_model(scenario, ground, landmarks))


def simulate(scene: Scene) -> Log:
    """Drive through the scenario. The same scene gives the same log, bit for bit, on the same version of MuJoCo."""
    scenario, model = scene.scenario, scene.model
    robot = scenario.robot
    data = mujoco.MjData(model)
    data.qpos[:3] = scenario.start[0], scenario.start[1], scene.ground.height_at(*scenario.start[:2], reach_m=0.2)
    data.qpos[3:7] = np.roll(yaw_quaternion(scenario.start[2]), 1)
    driver = Driver(scenario, scene.seed)
    regulator = Regulator(robot)
    wheels = _Wheels(model, robot)
    substeps = round(TICK_S / robot.contact.timestep_s)
    every_command = round(1.0 / scenario.rates.command / TICK_S)
    every_regulation = round(1.0 / robot.motor.regulator_hz / TICK_S)
    delay = round(robot.command_delay_s / TICK_S)
    n = round(scenario.duration_s / TICK_S) + 1
    state = np.empty((n, 13))
    wheel_state = np.empty((n, 3, len(wheels.joints)))
    commands: list[tuple[float, float, float]] = []
    heard: list[tuple[int, float, float]] = []
    set_point = (0.0, 0.0)
    for tick in range(-round(_SETTLE_S / TICK_S), n):
        if tick >= 0:
            state[tick, :7], state[tick, 7:] = data.qpos[:7], data.qvel[:6]
            wheel_state[tick] = wheels.read(data)
            if tick % every_command == 0:
                v, omega = driver.command(tick * TICK_S, _planar(data.qpos))
                commands.append((tick * TICK_S, v, omega))
                heard.append((tick + delay, v, omega))
            while heard and heard[0][0] <= tick:
                set_point = heard.pop(0)[1:]
        if tick % every_regulation == 0:
            volts = regulator.volts(set_point, data.qpos[wheels.q])
            data.ctrl[: len(volts)] = volts
            if robot.payload is not None:
                moved = tick * TICK_S > robot.payload.shift_at_s
                data.ctrl[-1] = math.dist(robot.payload.start, robot.payload.end) if moved else 0.0
        wheels.lay_friction(model, data, scene.ground)
        mujoco.mj_step(model, data, nstep=substeps)
    if not np.isfinite(state).all():
        raise FloatingPointError(f"{scenario.name}, seed {scene.seed}: the physics diverged; use a smaller timestep_s")
    return Log(
        stamps_s=np.arange(n) * TICK_S,
        positions=state[:, :3],
        quaternions=np.roll(state[:, 3:7], -1, axis=1),
        velocities=state[:, 7:10],
        rates=state[:, 10:],
        wheel_angles=wheel_state[:, 0],
        wheel_rates=wheel_state[:, 1],
        torques=wheel_state[:, 2],
        commands=np.array(commands),
    )


class Regulator:
    """The speed regulator of all wheels: PI on encoder speeds, slew-limited set point."""

    def __init__(self, robot: Robot) -> None:
        """Start at rest."""
        self._robot = robot
        self._sides = np.array([-1.0 if "left" in name else 1.0 for name in wheel_names(robot)])
        self._dt = 1.0 / robot.motor.regulator_hz
        self._tick = 2.0 * math.pi / robot.ticks_per_turn
        self._ticks: NDArray[np.float64] | None = None
        self._integral = np.zeros(len(self._sides))
        self._v = self._omega = 0.0

    def volts(self, set_point: tuple[float, float], angles: FloatArray) -> FloatArray:
        """Motor voltages for a set point (v, ω) and the wheels' angles [rad] now."""
        robot, motor = self._robot, self._robot.motor
        self._v = _slew(self._v, set_point[0], robot.max_acceleration * self._dt)
        self._omega = _slew(self._omega, set_point[1], robot.max_angular_acceleration * self._dt)
        wanted = (self._v + self._sides * self._omega * 0.5 * robot.track_m * robot.track_scale) / robot.radius_m
        ticks = np.floor(angles / self._tick)
        speeds = np.zeros_like(wanted) if self._ticks is None else (ticks - self._ticks) * self._tick / self._dt
        self._ticks = ticks
        error = wanted - speeds
        limit = motor.supply_v / max(motor.ki, 1e-9)
        self._integral = np.clip(self._integral + error * self._dt, -limit, limit)
        return np.clip(motor.kp * error + motor.ki * self._integral, -motor.supply_v, motor.supply_v)


class _Wheels:
    """Indices of the wheels in the model."""

    def __init__(self, model: mujoco.MjModel, robot: Robot) -> None:
        names = wheel_names(robot)
        self.joints = [model.joint(name).id for name in names]
        self.q = np.array([model.jnt_qposadr[j] for j in self.joints])
        self._v = np.array([model.jnt_dofadr[j] for j in self.joints])
        self._geoms = [model.geom(name.removesuffix("_joint")).id for name in names]
        self._n = len(names)

    def read(self, data: mujoco.MjData) -> FloatArray:
        """Angles, rates and motor torques, ``(3, wheels)``."""
        return np.stack([data.qpos[self.q], data.qvel[self._v], data.actuator_force[: self._n]])

    def lay_friction(self, model: mujoco.MjModel, data: mujoco.MjData, ground: Ground) -> None:
        """Give each wheel the friction of the floor under it."""
        for geom in self._geoms:
            x, y = data.geom_xpos[geom, :2]
            model.geom_friction[geom, 0] = ground.mu_at(x, y)


def base_twist(log: Log) -> FloatArray:
    """True body twist ``(n, 3)``: forward and sideways speed [m/s], yaw rate [rad/s]."""
    x, y, z, w = log.quaternions.T
    forward = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1)
    left = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1)
    v = log.velocities
    return np.column_stack([(forward * v).sum(1), (left * v).sum(1), log.rates[:, 2]])


def wheel_twist(log: Log, robot: Robot) -> FloatArray:
    """Body twist ``(n, 2)`` (v, ω) that the wheels' rates mean if no wheel slips, with their true radii."""
    left = log.wheel_rates[:, 0::2].mean(axis=1) * robot.radius_m * robot.radius_scale[0]
    right = log.wheel_rates[:, 1::2].mean(axis=1) * robot.radius_m * robot.radius_scale[1]
    return np.column_stack([0.5 * (left + right), (right - left) / robot.track_m])


def slipping(log: Log, robot: Robot) -> NDArray[np.bool_]:
    """Whether any wheel's circumference moves over the ground, ``(n,)``."""
    difference = base_twist(log)[:, [0, 2]] - wheel_twist(log, robot)
    turn = 0.5 * robot.track_m * difference[:, 1]
    worst = np.maximum(np.abs(difference[:, 0] - turn), np.abs(difference[:, 0] + turn))
    return np.asarray(worst > SLIP_M_S)


def _planar(qpos: FloatArray) -> tuple[float, float, float]:
    w, x, y, z = qpos[3:7]
    return float(qpos[0]), float(qpos[1]), math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _slew(now: float, wanted: float, step: float) -> float:
    return min(max(wanted, now - step), now + step)
