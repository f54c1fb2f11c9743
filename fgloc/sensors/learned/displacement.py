"""The displacement model: the motion over a short time at once, from what was commanded and measured around it."""

from __future__ import annotations

import math

import numpy as np

from fgloc.errors import ModelError
from fgloc.sensors.base import MotionRole
from fgloc.sensors.learned.card import Kinematics, ModelCard
from fgloc.sensors.learned.commands import CommandHistory
from fgloc.sensors.learned.forms import MotionPrediction, composed, duration_of, follow, gains, joint_of, sub_steps
from fgloc.sensors.learned.network import Answering, Float32Array
from fgloc.sensors.learned.signals import Signals
from fgloc.sensors.signals import Signal
from fgloc.types import ControlEvent, FloatArray

_MIN_DENSITY = 1e-8  # m²/s, m²/s, rad²/s: nobody knows motion better than this
_MAX_LOG_VARIANCE = 10.0
_DISAGREEMENT_S = 1.0  # members differ for about this long at a time: a rate of spread s has the density 2 s² times it


class DisplacementModel:
    """A residual twist on the best known kinematics, with its own log-variance.

    The twist of each sub-step follows from the mean commands of the card's age bins and, if the model was trained with
    them, from measured signals and the velocity's innovation (known minus predicted at the start, fading with
    ``velocity_decay_s``); its integral is the displacement. The kinematics are the calibrated commands; wheels that
    are read replace them, and a gyro that is read replaces the yaw rate. Nothing is fed back, so errors do not feed
    themselves.
    An ensemble predicts its members' mean; its variance grows where they differ.
    """

    def __init__(self, card: ModelCard, network: Answering) -> None:
        """Take a checked card and its network, which knows the card's scales of the outputs."""
        self.card = card
        self.joint = joint_of(card)
        self._network = network
        self._gains = gains(card.kinematics)
        self._ages = np.array(card.edges_s)
        self._widths = np.diff(self._ages)
        self._signal_edges = np.array(card.signal_edges_s)
        self._n_inputs = card.n_inputs
        self._reads_velocity = "velocity" in card.inputs
        self._spread_gain = 2.0 * _DISAGREEMENT_S * np.array(card.variance_scale)
        self._n_bins = 2 * len(self._widths)
        self._plans: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = {}  # by number of sub-steps
        self._track: CommandHistory | None = None

    def predict(
        self,
        commands: tuple[ControlEvent, ...],
        start_ns: int,
        end_ns: int,
        velocity: FloatArray | None,
        signals: Signals | None = None,
    ) -> MotionPrediction | None:
        """See `MotionModel.predict`."""
        duration = duration_of(commands, start_ns, end_ns)
        track = self._track = follow(self._track, commands)
        n = sub_steps(duration, self.card.dt_s)
        dt = duration / n
        base, x = self._inputs(track, (start_ns - track.origin_ns) * 1e-9, dt, n)
        if self.card.measured:
            self._measured(base, x, signals, start_ns, dt)
        if self._reads_velocity:
            innovation = np.zeros(2) if velocity is None else np.asarray(velocity) - base[0, ::2] / dt
            ages = dt * (np.arange(n) + 0.5)
            x[:, -2:] = np.exp(-ages / self.card.velocity_decay_s)[:, None] * innovation
        y: Float32Array | FloatArray = self._network(x)
        if self.card.members > 1:
            if not np.isfinite(y).all():
                return None
            y = self._pooled(y)
        twists, variances = [], []
        for (along, left, turn), (vx, vy, rate, log_x, log_y, log_yaw) in zip(base.tolist(), y.tolist(), strict=True):
            if not math.isfinite(vx + vy + rate + log_x + log_y + log_yaw):
                return None
            twists.append((along + vx * dt, left + vy * dt, turn + rate * dt))
            variances.append((_variance(log_x) * dt, _variance(log_y) * dt, _variance(log_yaw) * dt))
        along, _, turn = twists[-1]
        return MotionPrediction(*composed(twists, variances), np.array([along / dt, turn / dt]))

    def _pooled(self, y: Float32Array | FloatArray) -> FloatArray:
        """Mean and log-variances ``(n, 6)`` of the members' answers ``(members, n, 6)``."""
        answers = y.astype(np.float64)
        spread = answers[..., :3].std(axis=0)
        variances = np.exp(np.minimum(answers[..., 3:], _MAX_LOG_VARIANCE)).mean(axis=0)
        pooled = answers.mean(axis=0)
        np.log(variances + self._spread_gain * spread**2, out=pooled[:, 3:])
        return np.asarray(pooled)

    def _inputs(self, track: CommandHistory, start: float, dt: float, n: int) -> tuple[FloatArray, Float32Array]:
        """By the commands, one row a sub-step: twists of the calibrated kinematics times dt ``(n, 3)``, inputs."""
        plan = self._plans.get(n)
        if plan is None:
            plan = self._plans[n] = self._plan(n)
        slope, offset, means_of = plan
        means = means_of @ track.integrals(slope * dt + (offset + start))
        x = np.empty((n, self._n_inputs), dtype=np.float32)
        x[:, : self._n_bins] = means[n:].reshape(n, -1)
        return means[:n] @ self._gains, x

    def _measured(self, base: FloatArray, x: Float32Array, signals: Signals | None, start_ns: int, dt: float) -> None:
        """Replace what the signals know better than the commands, and hand them to the network."""
        n, at = len(base), self._n_bins
        start = 0.0 if signals is None else (start_ns - signals.origin_ns) * 1e-9
        starts = start + dt * np.arange(n, dtype=np.float64)
        for name in self.card.measured:
            signal = None if signals is None else signals.named(name)
            if signal is None:
                raise ModelError(f"the model reads {name}, which the step has not; its inputs are {self.card.inputs}")
            features = signal_features(signal, starts, dt, self._signal_edges)
            x[:, at : at + features.shape[1]] = features
            at += features.shape[1]
        if signals is not None:
            base /= dt
            measured_twists(base, self.card.wheel_kinematics, signals, starts, dt)
            base *= dt

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


def _variance(log_variance: float) -> float:
    return max(_MIN_DENSITY, math.exp(min(log_variance, _MAX_LOG_VARIANCE)))


def signal_features(signal: Signal, starts: FloatArray, dt: float, edges: FloatArray) -> FloatArray:
    """Means ``(n, ages · channels)`` of a signal over sub-steps and, before each, between the edges of ages.

    Args:
        signal: its time zero is that of the starts.
        starts: ``(n,)`` of the sub-steps [s].
        dt: their length.
        edges: ``(ages,)``, increasing from 0.
    """
    limits = np.empty((len(starts), 1 + len(edges)))
    limits[:, 0] = starts + dt
    np.subtract(starts[:, None], edges, out=limits[:, 1:])
    return signal.means(limits).reshape(len(starts), -1)


def measured_twists(
    base: FloatArray, wheel_kinematics: Kinematics, signals: Signals, starts: FloatArray, dt: float
) -> None:
    """Replace in the twists ``(n, 3)`` of sub-steps what the signals know better: wheels all, a gyro the yaw rate."""
    limits = np.column_stack([starts, starts + dt])
    wheels, rate = signals.of_role(MotionRole.ODOMETER), signals.of_role(MotionRole.RATE)
    if wheels is not None:
        base[:] = wheels.means(limits - wheel_kinematics.delay_s)[:, 0] @ gains(wheel_kinematics)
    if rate is not None:
        base[:, 2] = rate.means(limits)[:, 0, 0]
