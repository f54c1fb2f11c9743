"""The paper's model, the velocity a moment later, rolled out; and what it has to beat."""

from __future__ import annotations

import numpy as np

from fgloc.errors import ModelError
from fgloc.sensors.learned.card import ModelCard
from fgloc.sensors.learned.commands import CommandHistory
from fgloc.sensors.learned.forms import (
    MotionPrediction,
    calibrated,
    composed,
    duration_of,
    follow,
    gains,
    joint_of,
    noise_density,
    sub_steps,
)
from fgloc.sensors.learned.network import Answering
from fgloc.sensors.learned.signals import Signals
from fgloc.sensors.noise_density import NoiseDensity
from fgloc.types import ControlEvent, FloatArray


class NaiveModel:
    """The robot moves as commanded: v = u, in the model's kinematics. The baseline."""

    def __init__(self, card: ModelCard) -> None:
        """Take a checked card."""
        self.card = card
        self.joint = joint_of(card)
        self._noise = _noise(card)
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
        limits = (start_ns - track.origin_ns) * 1e-9 + duration / n * np.arange(n + 1, dtype=np.float64)
        twists = calibrated(self.card.kinematics, track, limits)
        return _prediction(twists, self._noise, duration / n, twists[-1, ::2])


class VelocityModel:
    """The paper's model: ``[v, ω]ₖ₊₁ = F(v, ω, u_v, u_ω, Δt)``, rolled out, kinematics known.

    F is a first-order lag towards the calibrated commands plus Δt times a network, so that Δt may vary and the network
    starts from what is known. A card without a lag has the velocity stay as it is instead: the rate form.

    Source: paper eq. 9 and 10; the network's part, and all of a ``rate`` model, in the form of eq. 6.
    """

    def __init__(self, card: ModelCard, network: Answering | None) -> None:
        """Take a checked card and its network; None for a ``lag`` model."""
        self.card = card
        self.joint = joint_of(card)
        self._network = network
        self._noise = _noise(card)
        self._lag = None if card.lag is None else np.array(card.lag.lag_s)
        self._delay = card.kinematics.delay_s if card.lag is None else card.lag.delay_s
        self._scale = np.array(card.output_scale)
        self._gains = gains(card.kinematics)
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
        start = (start_ns - track.origin_ns) * 1e-9
        if velocity is None:
            velocity = self._roll(track, start - self.card.history_s, self.card.history_s, np.zeros(2))[-1]
        states = self._roll(track, start, duration, np.asarray(velocity, dtype=float))
        if not np.isfinite(states).all():
            return None
        dt = duration / (len(states) - 1)
        middles = 0.5 * (states[:-1] + states[1:])
        twists = np.zeros((len(middles), 3))
        twists[:, ::2] = middles
        return _prediction(twists, self._noise, dt, states[-1])

    def _roll(self, track: CommandHistory, start: float, duration: float, velocity: FloatArray) -> FloatArray:
        """Velocities ``(n + 1, 2)`` at the limits of the n sub-steps."""
        n = sub_steps(duration, self.card.dt_s)
        dt = duration / n
        told = track.means(start - self._delay + dt * np.arange(n + 1, dtype=np.float64))
        aims = (told @ self._gains)[:, ::2]
        keep = np.ones(2) if self._lag is None else np.exp(-dt / self._lag)
        states = np.empty((n + 1, 2))
        states[0] = velocity
        x = np.empty((1, 5), dtype=np.float32)
        x[0, 4] = dt
        gain = dt * self._scale
        for k in range(n):
            states[k + 1] = aims[k] + keep * (states[k] - aims[k])
            if self._network is not None:
                x[0, :2] = states[k]
                x[0, 2:4] = told[k]
                states[k + 1] += gain * self._network(x)[0]
        return states


def _noise(card: ModelCard) -> NoiseDensity:
    if card.noise is None:
        raise ModelError(f"a {card.kind} model's card needs noise densities")
    return card.noise


def _prediction(twists: FloatArray, noise: NoiseDensity, dt: float, velocity: FloatArray) -> MotionPrediction:
    """Of body twists ``(n, 3)``, each held for dt."""
    variances = np.array([noise_density(noise, v, omega) for v, omega in twists[:, ::2].tolist()])
    return MotionPrediction(*composed((twists * dt).tolist(), (variances * dt).tolist()), velocity)
