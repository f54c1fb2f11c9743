"""Physics: a scenario and a seed in, a log of everything that happened out.

The log is filled tick by tick, so that a controller may read the robot's sensors while it drives.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, fields
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from fgloc.drives.sides import SkidSteer
from fgloc.errors import FglocError
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.types import FloatArray, LandmarkMap
from fgloc_datasets.sim.control import Driver
from fgloc_datasets.sim.drives import (
    Command,
    rolled,
    rows,
    steering_angles,
    steering_names,
    true,
    twists,
    wheel_names,
    wheels,
    within,
)
from fgloc_datasets.sim.installed import Installed, install, survey, true_robot
from fgloc_datasets.sim.scenario import Robot, Scenario
from fgloc_datasets.sim.scene import Ground, build_model, make_ground, make_map

TICK_S = 0.005
_SETTLE_S = 0.5
_DIVERGED = 1e3  # m/s or rad/s
SLIP_M_S = 0.03  # a wheel slips if its circumference differs from the ground by more than this


class SimulationError(FglocError):
    """A run that cannot be simulated."""


@dataclass(slots=True, eq=False)
class Log:
    """State of the robot every TICK_S, from time 0 on. The base frame is on the floor (`Robot`); wheels: driven ones.

    While the robot drives, the first ``ticks`` rows are filled; times are known from the start.
    """

    stamps_s: FloatArray  # (n,)
    positions: FloatArray  # (n, 3) m in the map
    quaternions: FloatArray  # (n, 4) x y z w, R_map_base
    velocities: FloatArray  # (n, 3) m/s of the base's origin, in the map
    rates: FloatArray  # (n, 3) rad/s, in the base
    wheel_angles: FloatArray  # (n, wheels) rad
    wheel_rates: FloatArray  # (n, wheels) rad/s
    torques: FloatArray  # (n, wheels) Nm, at the wheel
    steering: FloatArray  # (n, k) rad, as the steering reports it
    commands: FloatArray  # (m, 5) t [s] and the fields of `Command`
    ticks: int

    def part(self, rows: slice) -> Log:
        """Some rows of the log, with all commands."""
        parts = {name: getattr(self, name)[rows] for name in _PER_TICK}
        return Log(**parts, commands=self.commands, ticks=len(parts["stamps_s"]))


_PER_TICK = tuple(field.name for field in fields(Log) if field.name not in ("commands", "ticks"))


class Controller(Protocol):
    """Source of the robot's commands."""

    def command(self, t: float, pose: tuple[float, float, float]) -> Command | None:
        """Command at time t [s], asked in order of time; the true pose is x, y [m], yaw [rad]. None ends the run."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Simulated world of a scenario and a seed: model, ground, markers, and the installation."""

    scenario: Scenario  # its robot with the radii and track that it really has
    seed: int
    ground: Ground
    landmarks: LandmarkMap  # where the markers hang
    surveyed: LandmarkMap  # where the map says that they hang
    installed: Installed
    model: mujoco.MjModel


def make_scene(scenario: Scenario, seed: int) -> Scene:
    """Lay out the room, install robot and markers, and compile the model."""
    ground = make_ground(scenario.world, seed)
    landmarks = make_map(scenario.world, seed)
    surveyed = survey(scenario.installation, seed, landmarks)
    installed = install(scenario, seed, landmarks)
    if scenario.installation is not None:
        scenario = scenario.model_copy(update={"robot": true_robot(scenario.robot, installed.wheels)})
    return Scene(scenario, seed, ground, landmarks, surveyed, installed, build_model(scenario, ground, landmarks))


def simulate(scene: Scene) -> Log:
    """Drive through the scenario. The same scene gives the same log, bit for bit, on the same version of MuJoCo.

    Raises:
        SimulationError: the physics diverged.
    """
    return Simulation(scene).run(Driver(scene.scenario, scene.seed))


class Simulation:
    """One run of a scene.

    Attributes:
        log: of what has happened so far.
    """

    def __init__(self, scene: Scene) -> None:
        """Put the robot at its start."""
        scenario, model, robot = scene.scenario, scene.model, scene.scenario.robot
        self._scene, self._data = scene, mujoco.MjData(model)
        self._names = wheel_names(robot)
        joints = [model.joint(name).id for name in self._names]
        self._wheel_q, self._wheel_v = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._steering_q = model.jnt_qposadr[[model.joint(name).id for name in steering_names(robot)]]
        qpos = self._data.qpos
        qpos[:2] = scenario.start[:2]
        qpos[2] = scene.ground.height_at(*scenario.start[:2], reach_m=0.2)
        qpos[3:7] = np.roll(yaw_quaternion(scenario.start[2]), 1)
        self._regulator = Regulator(robot)
        self._every_command = round(1.0 / scenario.rates.command / TICK_S)
        n, driven = round(scenario.duration_s / TICK_S) + 1, len(self._names)
        self._q, self._v = np.empty((n, model.nq)), np.empty((n, model.nv))
        commands = np.zeros((-(-n // self._every_command), 1 + len(Command._fields)))
        commands[:, 0] = [tick * TICK_S for tick in range(0, n, self._every_command)]
        self.log = Log(
            stamps_s=np.arange(n) * TICK_S,
            positions=self._q[:, :3],
            quaternions=np.empty((n, 4)),
            velocities=self._v[:, :3],
            rates=self._v[:, 3:6],
            wheel_angles=np.empty((n, driven)),
            wheel_rates=np.empty((n, driven)),
            torques=np.empty((n, driven)),
            steering=np.empty((n, len(self._steering_q))),
            commands=commands,
            ticks=0,
        )

    def run(self, controller: Controller) -> Log:
        """Drive until the scenario's time is over or the controller ends the run.

        Raises:
            SimulationError: the physics diverged.
        """
        scene, data, robot = self._scene, self._data, self._scene.scenario.robot
        substeps = round(TICK_S / robot.contact.timestep_s)
        every_regulation = round(1.0 / robot.motor.regulator_hz / TICK_S)
        delay = round(robot.command_delay_s / TICK_S)
        delayed: deque[tuple[int, Command]] = deque()
        set_point = Command(0.0, 0.0)
        tyres = self._tyres()
        for tick in range(-round(_SETTLE_S / TICK_S), len(self._q)):
            if tick >= 0:
                self._record(tick)
                if tick % self._every_command == 0:
                    wanted = controller.command(tick * TICK_S, _planar(data.qpos))
                    if wanted is None:
                        break
                    self.log.commands[tick // self._every_command, 1:] = wanted
                    delayed.append((tick + delay, wanted))
                while delayed and delayed[0][0] <= tick:
                    set_point = delayed.popleft()[1]
            if tick % every_regulation == 0:
                self._regulate(tick, set_point)
            for frictions, place in tyres:  # that of the floor under each wheel
                mu = scene.ground.mu_at(place[0], place[1])
                for friction in frictions:
                    friction[0] = mu
            mujoco.mj_step(scene.model, data, nstep=substeps)
        q, v = self._q[: self.log.ticks], self._v[: self.log.ticks]
        if not (np.isfinite(q).all() and np.abs(v).max() < _DIVERGED):
            name = scene.scenario.name
            raise SimulationError(f"{name}, seed {scene.seed}: the physics diverged; use a smaller timestep_s")
        return self.log

    def _tyres(self) -> list[tuple[list[FloatArray], FloatArray]]:
        """Frictions of each wheel's tyre or rollers, and its place, as MuJoCo holds them."""
        model = self._scene.model
        named = {model.geom(i).name: i for i in range(model.ngeom)}
        out = []
        for wheel in wheels(self._scene.scenario.robot):
            name = wheel.joint.removesuffix("_joint")
            touching = [i for n, i in named.items() if n.startswith(f"{name}_roller")] or [named[name]]
            out.append(([model.geom_friction[i] for i in touching], self._data.geom_xpos[named[name]]))
        return out

    def _record(self, tick: int) -> None:
        data, log = self._data, self.log
        self._q[tick], self._v[tick] = data.qpos, data.qvel
        log.quaternions[tick, :3], log.quaternions[tick, 3] = data.qpos[4:7], data.qpos[3]
        log.wheel_angles[tick], log.wheel_rates[tick] = data.qpos[self._wheel_q], data.qvel[self._wheel_v]
        log.torques[tick] = data.actuator_force[: len(self._names)]
        robot = self._scene.scenario.robot
        log.steering[tick] = (data.qpos[self._steering_q] - robot.steering_zero_rad) / robot.steering_ratio
        log.ticks = tick + 1

    def _regulate(self, tick: int, set_point: Command) -> None:
        robot, payload, ctrl = self._scene.scenario.robot, self._scene.scenario.robot.payload, self._data.ctrl
        driven = len(self._names)
        ctrl[:driven] = self._regulator.volts(set_point, self._data.qpos[self._wheel_q].tolist())
        for i, angle in enumerate(self._regulator.steering):
            ctrl[driven + i] = robot.steering_zero_rad + robot.steering_ratio * angle
        if payload is not None:
            moved = tick * TICK_S > payload.shift_at_s
            ctrl[-1] = math.dist(payload.start, payload.end) if moved else 0.0


class Regulator:
    """The regulator of all wheels: PI on encoder speeds, slew-limited set point.

    Attributes:
        steering: set points of the steering [rad], left and right; empty if there is none.
    """

    def __init__(self, robot: Robot) -> None:
        """Start at rest."""
        self._robot = robot
        self._rows = rows(robot)
        self.steering = steering_angles(robot, 0.0)
        self._dt = 1.0 / robot.motor.regulator_hz
        self._per_rad = robot.ticks_per_turn / (2.0 * math.pi)
        self._ticks: list[int] | None = None
        self._integrals = [0.0] * len(self._rows)
        self._v = self._omega = self._vy = self._angle = 0.0

    def volts(self, set_point: Command, angles: list[float]) -> list[float]:
        """Motor voltages for a set point and the wheels' angles [rad] now."""
        robot, motor, dt = self._robot, self._robot.motor, self._dt
        self._v = _slew(self._v, set_point.v, robot.max_acceleration * dt)
        self._vy = _slew(self._vy, set_point.vy, robot.max_acceleration * dt)
        if robot.kind == "ackermann":  # the wheels go as they are steered
            self._angle = _slew(self._angle, set_point.steering, robot.steering_rad_s * dt)
            self.steering = steering_angles(robot, self._angle)
            self._omega = self._v * math.tan(self._angle) / (robot.wheelbase_m * robot.wheelbase_scale)
        else:
            self._omega = _slew(self._omega, set_point.omega, robot.max_angular_acceleration * dt)
        ticks = [math.floor(a * self._per_rad) for a in angles]
        before = ticks if self._ticks is None else self._ticks
        self._ticks = ticks
        supply = motor.supply_v
        wanted = [(self._v + aside * self._vy + self._omega * arm) / robot.radius_m for aside, arm in self._rows]
        errors = [wanted[i] - (ticks[i] - before[i]) / self._per_rad / dt for i in range(len(wanted))]
        if robot.kind == "ackermann":  # a differential gear: both wheels are driven alike
            errors = [sum(errors) / len(errors)] * len(errors)
        out = []
        for i, error in enumerate(errors):
            self._integrals[i] = within(self._integrals[i] + motor.ki * error * dt, supply)
            out.append(within(motor.kp * error + self._integrals[i], supply))
        return out


def base_twist(log: Log) -> FloatArray:
    """True body twist ``(n, 3)``: forward and sideways speed [m/s], yaw rate [rad/s]."""
    x, y, z, w = log.quaternions.T
    forward = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1)
    left = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1)
    v = log.velocities
    return np.column_stack([(forward * v).sum(1), (left * v).sum(1), log.rates[:, 2]])


def wheel_twist(log: Log, robot: Robot) -> FloatArray:
    """Body twist ``(n, 3)`` vx, vy, ω that wheels and steering mean if no wheel slips, with their true geometry."""
    return twists(robot, true(robot), robot.track_m, rolled(robot, log.wheel_rates), log.steering)


def slipping(log: Log, robot: Robot) -> NDArray[np.bool_]:
    """Whether any wheel's circumference moves over the ground, ``(n,)``."""
    twist, drive = base_twist(log), true(robot)
    if drive is None or isinstance(drive, SkidSteer):
        difference = twist - wheel_twist(log, robot)
        turn = 0.5 * robot.track_m * difference[:, 2]
        worst = np.maximum(np.abs(difference[:, 0] - turn), np.abs(difference[:, 0] + turn))
        return np.asarray(worst > SLIP_M_S)
    rates = rolled(robot, log.wheel_rates)
    made = [drive.equations(row, angles) for row, angles in zip(rates, log.steering, strict=True)]
    over = np.array([np.abs(e.A @ true_twist - e.b).max() for e, true_twist in zip(made, twist, strict=True)])
    return over > SLIP_M_S


def _planar(qpos: FloatArray) -> tuple[float, float, float]:
    w, x, y, z = qpos[3:7]
    return float(qpos[0]), float(qpos[1]), quaternion_yaw((x, y, z, w))


def _slew(now: float, wanted: float, step: float) -> float:
    return min(max(wanted, now - step), now + step)
