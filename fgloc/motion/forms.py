"""Identified motion models: from commands to the motion of the base over a step, with covariance.

Both forms cut a step into equal parts no longer than the card's ``dt_s`` and compose them, so that a step may last any
time and two halves give what the whole gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fgloc import se2
from fgloc.config import NoiseDensity
from fgloc.errors import ModelError
from fgloc.motion.card import Kinematics, ModelCard
from fgloc.motion.commands import CommandTrack
from fgloc.motion.joint import JointCalibration
from fgloc.motion.network import Network
from fgloc.types import CommandEvent, FloatArray

MIN_DENSITY = np.array([1e-3, 1e-3, 1e-3]) ** 2  # m²/s, m²/s, rad²/s: nobody knows motion better than this
_MAX_LOG_VARIANCE = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrediction:
    """``T_start_end`` of the base with right-perturbation covariance, and the body velocity at the end."""

    motion: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    velocity: FloatArray  # (2,) v [m/s], ω [rad/s]


class MotionModel(Protocol):
    """What the localizer knows of a learned model: its card, its calibration against the wheels, its predictions."""

    card: ModelCard
    joint: JointCalibration | None

    def predict(
        self, commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int, velocity: FloatArray | None
    ) -> MotionPrediction | None:
        """Motion over ``[start_ns, end_ns]``.

        Args:
            commands: in order of stamp, from ``card.history_s`` before the start (or the first there is) to the end.
            start_ns: start of the step.
            end_ns: its end.
            velocity: ``(2,)`` body velocity v, ω at the start, if known. None: what the commands before the start say.

        Returns:
            None if the network's output is not finite.

        Raises:
            ModelError: there is no command, or the step has no length.
        """
        ...


class VelocityModel:
    """The paper's model: [v, ω] rolled out, ``[v, ω]ₖ₊₁ = [v, ω]ₖ + Δt F(v, ω, u_v, u_ω, Δt)``, kinematics known.

    Source: paper eq. 9 and 10, written in the rate form of eq. 6, so that Δt may vary.
    """

    def __init__(self, card: ModelCard, network: Network) -> None:
        """Take a checked card and its network."""
        if card.noise is None:
            raise ModelError("a velocity model's card needs noise densities")
        self.card = card
        self.joint = _joint(card)
        self._network = network
        self._noise = card.noise
        self._scale = np.array(card.output_scale)

    def predict(
        self, commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int, velocity: FloatArray | None
    ) -> MotionPrediction | None:
        """See `MotionModel.predict`."""
        duration = _duration(commands, start_ns, end_ns)
        track = CommandTrack(commands, start_ns)
        if velocity is None:
            velocity = self._roll(track, -self.card.history_s, 0.0, np.zeros(2))[-1]
        states = self._roll(track, 0.0, duration, np.asarray(velocity, dtype=float))
        if not np.isfinite(states).all():
            return None
        dt = duration / (len(states) - 1)
        motion, cov = np.zeros(3), np.zeros((3, 3))
        for v, omega in 0.5 * (states[:-1] + states[1:]):
            part = se2.exp((v * dt, 0.0, omega * dt))
            cov = se2.compose_cov(cov, part, np.diag(noise_density(self._noise, v, omega) * dt))
            motion = se2.compose(motion, part)
        return MotionPrediction(motion, cov, states[-1])

    def _roll(self, track: CommandTrack, start_s: float, end_s: float, velocity: FloatArray) -> FloatArray:
        """Velocities ``(n + 1, 2)`` at the limits of the n sub-steps."""
        limits = _sub_steps(start_s, end_s, self.card.dt_s)
        dt = limits[1] - limits[0]
        kinematics = self.card.kinematics
        told = track.means(limits - kinematics.delay_s)
        states = np.empty((len(limits), 2))
        states[0] = velocity
        x = np.empty((1, 5), dtype=np.float32)
        x[0, 4] = dt
        for k in range(len(told)):
            x[0, :2] = states[k]
            x[0, 2:4] = told[k]
            states[k + 1] = states[k] + dt * self._scale * self._network(x)[0]
        return states


class DisplacementModel:
    """A residual twist on calibrated kinematics, from the recent commands alone, with its own log-variance.

    The twist at the middle of each sub-step follows from the mean commands of the card's age bins and, if the model was
    trained with it, from the velocity's innovation (known minus predicted at the start, fading with
    ``velocity_decay_s``); its integral is the displacement. Nothing is fed back, so errors do not feed themselves.

    Source: design.md §5.
    """

    def __init__(self, card: ModelCard, network: Network) -> None:
        """Take a checked card and its network."""
        self.card = card
        self.joint = _joint(card)
        self._network = network
        self._scale = np.array(card.output_scale)
        self._ages = np.array(card.edges_s)
        self._variance_scale = np.array(card.variance_scale)
        self._n_bins = 2 * (len(card.edges_s) - 1)

    def predict(
        self, commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int, velocity: FloatArray | None
    ) -> MotionPrediction | None:
        """See `MotionModel.predict`."""
        duration = _duration(commands, start_ns, end_ns)
        track = CommandTrack(commands, start_ns)
        limits = _sub_steps(0.0, duration, self.card.dt_s)
        dt = limits[1] - limits[0]
        twists, log_density = self._twists(track, limits, velocity)
        if not (np.isfinite(twists).all() and np.isfinite(log_density).all()):
            return None
        variances = np.exp(np.minimum(log_density, _MAX_LOG_VARIANCE)) * self._variance_scale
        variances = np.maximum(variances, MIN_DENSITY) * dt
        motion, cov = np.zeros(3), np.zeros((3, 3))
        for twist, variance in zip(twists * dt, variances, strict=True):
            part = se2.exp(twist)
            cov = se2.compose_cov(cov, part, np.diag(variance))
            motion = se2.compose(motion, part)
        return MotionPrediction(motion, cov, twists[-1, [0, 2]])

    def _twists(
        self, track: CommandTrack, limits: FloatArray, velocity: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Body twists ``(n, 3)`` at the middles of the sub-steps and log-variance densities ``(n, 3)``."""
        middles = 0.5 * (limits[:-1] + limits[1:])
        base = calibrated(self.card.kinematics, track, limits)
        x = np.zeros((len(middles), self.card.n_inputs), dtype=np.float32)
        x[:, : self._n_bins] = track.means(middles[:, None] - self._ages).reshape(len(middles), -1)
        if "velocity" in self.card.inputs and velocity is not None:
            fade = np.exp(-middles / self.card.velocity_decay_s)
            x[:, self._n_bins :] = fade[:, None] * (np.asarray(velocity) - base[0, [0, 2]])
        y = self._network(x).astype(np.float64)
        return base + self._scale * y[:, :3], y[:, 3:]


def calibrated(kinematics: Kinematics, track: CommandTrack, limits: FloatArray) -> FloatArray:
    """Mean body twists ``(n, 3)`` between limits [s] of the calibrated kinematics."""
    told = track.means(limits - kinematics.delay_s)
    twists = np.zeros((len(told), 3))
    twists[:, 0] = kinematics.scale_v * told[:, 0]
    twists[:, 2] = kinematics.scale_omega * told[:, 1] + kinematics.yaw_per_m * twists[:, 0]
    return twists


def noise_density(noise: NoiseDensity, v: float, omega: float) -> FloatArray:
    """Variances per second ``(3,)`` of x, y, yaw at a velocity."""
    v, omega = abs(v), abs(omega)
    turning = noise.xy_per_sqrt_rad**2 * omega + noise.xy_per_sqrt_s**2
    yaw = noise.yaw_per_sqrt_m**2 * v + noise.yaw_per_sqrt_rad**2 * omega + noise.yaw_per_sqrt_s**2
    return np.array([noise.x_per_sqrt_m**2 * v + turning, noise.y_per_sqrt_m**2 * v + turning, yaw])


def _joint(card: ModelCard) -> JointCalibration | None:
    return None if card.joint is None else JointCalibration(card.joint.W, card.joint.N, card.joint.C)


def _duration(commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int) -> float:
    if not commands:
        raise ModelError("no command to predict from; the step needs the last command at or before its start")
    if end_ns <= start_ns:
        raise ModelError(f"the step ends at {end_ns} ns, not after its start {start_ns} ns")
    return (end_ns - start_ns) * 1e-9


def _sub_steps(start_s: float, end_s: float, longest_s: float) -> FloatArray:
    """Limits ``(n + 1,)`` of the fewest equal parts no longer than the longest."""
    n = max(1, math.ceil((end_s - start_s) / longest_s - 1e-6))
    return np.linspace(start_s, end_s, n + 1)
