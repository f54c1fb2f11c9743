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
from fgloc.motion.network import Float32Array, Network
from fgloc.types import CommandEvent, FloatArray

MIN_DENSITY = np.array([1e-3, 1e-3, 1e-3]) ** 2  # m²/s, m²/s, rad²/s: nobody knows motion better than this
_MAX_LOG_VARIANCE = 10.0
_DISAGREEMENT_S = 1.0  # members differ for about this long at a time: a rate of spread s has the density 2 s² times it
_SMALL = 1e-9


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
    """The paper's model: ``[v, ω]ₖ₊₁ = F(v, ω, u_v, u_ω, Δt)``, rolled out, kinematics known.

    F is a first-order lag towards the calibrated commands plus Δt times a network, so that Δt may vary and the network
    starts from what is known.

    Source: paper eq. 9 and 10; the network's part in the rate form of eq. 6.
    """

    def __init__(self, card: ModelCard, network: Network) -> None:
        """Take a checked card and its network."""
        if card.noise is None or card.lag is None:
            raise ModelError("a velocity model's card needs noise densities and a lag")
        self.card = card
        self.joint = _joint(card)
        self._network = network
        self._noise = card.noise
        self._delay, self._lag = card.lag.delay_s, np.array(card.lag.lag_s)
        self._scale = np.array(card.output_scale)
        self._gains = _gains(card.kinematics)
        self._track: CommandTrack | None = None

    def predict(
        self, commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int, velocity: FloatArray | None
    ) -> MotionPrediction | None:
        """See `MotionModel.predict`."""
        duration = _duration(commands, start_ns, end_ns)
        track = self._track = _follow(self._track, commands)
        start = (start_ns - track.origin_ns) * 1e-9
        if velocity is None:
            velocity = self._roll(track, start - self.card.history_s, self.card.history_s, np.zeros(2))[-1]
        states = self._roll(track, start, duration, np.asarray(velocity, dtype=float))
        if not np.isfinite(states).all():
            return None
        dt = duration / (len(states) - 1)
        middles = 0.5 * (states[:-1] + states[1:])
        twists = np.zeros((len(middles), 3))
        twists[:, 0], twists[:, 2] = middles[:, 0] * dt, middles[:, 1] * dt
        variances = np.array([noise_density(self._noise, v, omega) for v, omega in middles.tolist()]) * dt
        return MotionPrediction(*_composed(twists, variances), states[-1])

    def _roll(self, track: CommandTrack, start: float, duration: float, velocity: FloatArray) -> FloatArray:
        """Velocities ``(n + 1, 2)`` at the limits of the n sub-steps."""
        n = _sub_steps(duration, self.card.dt_s)
        dt = duration / n
        told = track.means(start - self._delay + dt * np.arange(n + 1, dtype=np.float64))
        aims = (told @ self._gains)[:, ::2]
        keep = np.exp(-dt / self._lag)
        states = np.empty((n + 1, 2))
        states[0] = velocity
        x = np.empty((1, 5), dtype=np.float32)
        x[0, 4] = dt
        gain = dt * self._scale
        for k in range(n):
            x[0, :2] = states[k]
            x[0, 2:4] = told[k]
            states[k + 1] = aims[k] + keep * (states[k] - aims[k]) + gain * self._network(x)[0]
        return states


class DisplacementModel:
    """A residual twist on calibrated kinematics, from the recent commands alone, with its own log-variance.

    The twist at the middle of each sub-step follows from the mean commands of the card's age bins and, if the model was
    trained with it, from the velocity's innovation (known minus predicted at the start, fading with
    ``velocity_decay_s``); its integral is the displacement. Nothing is fed back, so errors do not feed themselves.
    An ensemble answers with its mean, and doubts where its members differ.

    Source: design.md §5.
    """

    def __init__(self, card: ModelCard, network: Network) -> None:
        """Take a checked card and its network."""
        self.card = card
        self.joint = _joint(card)
        self._network = network
        self._scale = np.array(card.output_scale)
        self._gains = _gains(card.kinematics)
        self._ages = np.array(card.edges_s)
        self._widths = np.diff(self._ages)
        self._log_scale = np.log(card.variance_scale)
        self._spread_gain = 2.0 * _DISAGREEMENT_S * np.array(card.variance_scale)
        self._n_bins = 2 * len(self._widths)
        self._plans: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = {}  # by number of sub-steps
        self._track: CommandTrack | None = None

    def predict(
        self, commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int, velocity: FloatArray | None
    ) -> MotionPrediction | None:
        """See `MotionModel.predict`."""
        duration = _duration(commands, start_ns, end_ns)
        track = self._track = _follow(self._track, commands)
        n = _sub_steps(duration, self.card.dt_s)
        dt = duration / n
        base, x = self._inputs(track, (start_ns - track.origin_ns) * 1e-9, dt, n, velocity)
        y = self._network(x).astype(np.float64)
        if not np.isfinite(y).all():
            return None
        residuals, log_variances = y[..., :3], y[..., 3:]
        log_variances += self._log_scale
        np.minimum(log_variances, _MAX_LOG_VARIANCE, out=log_variances)
        variances = np.exp(log_variances)
        if self.card.members > 1:
            spread = self._scale * residuals.std(axis=0)
            residuals = residuals.mean(axis=0)
            variances = variances.mean(axis=0) + self._spread_gain * spread**2
        np.maximum(variances, MIN_DENSITY, out=variances)
        twists = base + self._scale * residuals
        return MotionPrediction(*_composed(twists * dt, variances * dt), twists[-1, ::2])

    def _inputs(
        self, track: CommandTrack, start: float, dt: float, n: int, velocity: FloatArray | None
    ) -> tuple[FloatArray, Float32Array]:
        """Twists ``(n, 3)`` of the calibrated kinematics and inputs ``(n, ·)`` of the network, one row a sub-step."""
        plan = self._plans.get(n)
        if plan is None:
            plan = self._plans[n] = self._plan(n)
        slope, offset, means_of = plan
        means = means_of @ track.integrals(slope * dt + (offset + start)).T
        base = means[:n] @ self._gains / dt
        x = np.empty((n, self.card.n_inputs), dtype=np.float32)
        x[:, : self._n_bins] = means[n:].reshape(n, -1)
        if "velocity" in self.card.inputs:
            innovation = np.zeros(2) if velocity is None else np.asarray(velocity) - base[0, ::2]
            ages = dt * (np.arange(n) + 0.5)
            x[:, self._n_bins :] = np.exp(-ages / self.card.velocity_decay_s)[:, None] * innovation
        return base, x

    def _plan(self, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """How to ask a track once for all of n sub-steps.

        Returns:
            slope, offset: ``(m,)`` times to ask for are ``slope * dt + offset + start``.
            means_of: ``(n + n * bins, m)`` makes of the integrals at these times the told displacements of the
                sub-steps, then the mean commands of their age bins.
        """
        bins = len(self._widths)
        limits, middles = np.arange(n + 1.0), np.repeat(np.arange(n) + 0.5, bins + 1)
        slope = np.concatenate([limits, middles])
        offset = np.concatenate([np.full(n + 1, -self.card.kinematics.delay_s), np.tile(-self._ages, n)])
        means_of = np.zeros((n + n * bins, len(slope)))
        for i in range(n):
            means_of[i, [i, i + 1]] = -1.0, 1.0
            for j, width in enumerate(self._widths):
                first = n + 1 + i * (bins + 1) + j
                means_of[n + i * bins + j, [first, first + 1]] = 1.0 / width, -1.0 / width
        return slope, offset, means_of


def calibrated(kinematics: Kinematics, track: CommandTrack, limits: FloatArray) -> FloatArray:
    """Mean body twists ``(n, 3)`` between limits [s] of the calibrated kinematics."""
    return np.asarray(track.means(limits - kinematics.delay_s) @ _gains(kinematics))


def _gains(kinematics: Kinematics) -> FloatArray:
    """``(2, 3)``: commands (v, ω) times it are body twists."""
    v = kinematics.scale_v
    return np.array([[v, 0.0, kinematics.yaw_per_m * v], [0.0, 0.0, kinematics.scale_omega]])


def noise_density(noise: NoiseDensity, v: float, omega: float) -> tuple[float, float, float]:
    """Variances per second of x, y, yaw at a velocity."""
    v, omega = abs(v), abs(omega)
    turning = noise.xy_per_sqrt_rad**2 * omega + noise.xy_per_sqrt_s**2
    yaw = noise.yaw_per_sqrt_m**2 * v + noise.yaw_per_sqrt_rad**2 * omega + noise.yaw_per_sqrt_s**2
    return noise.x_per_sqrt_m**2 * v + turning, noise.y_per_sqrt_m**2 * v + turning, yaw


def _composed(twists: FloatArray, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motion ``(3,)`` and covariance ``(3, 3)`` of consecutive parts.

    Scalars, because a step has two or three parts: five times as fast here as `fgloc.se2` on small arrays.

    Args:
        twists: ``(n, 3)``, each held over its part, times the part's length.
        variances: ``(n, 3)`` of each part's right perturbation, independent.
    """
    x = y = yaw = 0.0
    xx = xy = xt = yy = yt = tt = 0.0
    for (vx, vy, turn), (qx, qy, qt) in zip(twists.tolist(), variances.tolist(), strict=True):
        sine, cosine = math.sin(turn), math.cos(turn)
        a, b = (sine / turn, (1.0 - cosine) / turn) if abs(turn) > _SMALL else (1.0, 0.5 * turn)
        px, py = a * vx - b * vy, b * vx + a * vy
        # 1. Pose: compose with the exponential of the twist
        c, s = math.cos(yaw), math.sin(yaw)
        x, y, yaw = x + c * px - s * py, y + s * px + c * py, yaw + turn
        # 2. Covariance: Ad(p⁻¹) P Ad(p⁻¹)ᵀ + Q. The lever arm first, then the rotation
        xx, xy, yy = (
            xx - 2.0 * py * xt + py * py * tt,
            xy + px * xt - py * yt - px * py * tt,
            yy + 2.0 * px * yt + px * px * tt,
        )
        xt, yt = xt - py * tt, yt + px * tt
        rxx = cosine * (cosine * xx + 2.0 * sine * xy) + sine * sine * yy
        rxy = (cosine * cosine - sine * sine) * xy + cosine * sine * (yy - xx)
        ryy = cosine * (cosine * yy - 2.0 * sine * xy) + sine * sine * xx
        xx, xy, yy = rxx + qx, rxy, ryy + qy
        xt, yt, tt = cosine * xt + sine * yt, cosine * yt - sine * xt, tt + qt
    return np.array([x, y, se2.wrap(yaw)]), np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]])


def _joint(card: ModelCard) -> JointCalibration | None:
    return None if card.joint is None else JointCalibration(card.joint.W, card.joint.N, card.joint.C)


def _duration(commands: tuple[CommandEvent, ...], start_ns: int, end_ns: int) -> float:
    if not commands:
        raise ModelError("no command to predict from; the step needs the last command at or before its start")
    if end_ns <= start_ns:
        raise ModelError(f"the step ends at {end_ns} ns, not after its start {start_ns} ns")
    return (end_ns - start_ns) * 1e-9


def _follow(track: CommandTrack | None, commands: tuple[CommandEvent, ...]) -> CommandTrack:
    return CommandTrack(commands) if track is None else track.following(commands)


def _sub_steps(duration: float, longest_s: float) -> int:
    """How many equal parts, no longer than the longest."""
    return max(1, math.ceil(duration / longest_s - 1e-6))
