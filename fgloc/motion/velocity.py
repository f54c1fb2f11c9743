"""The paper's model: the velocity a moment later, rolled out."""

from __future__ import annotations

import numpy as np

from fgloc.errors import ModelError
from fgloc.motion.card import ModelCard
from fgloc.motion.commands import CommandTrack
from fgloc.motion.forms import (
    MotionPrediction,
    composed,
    duration_of,
    follow,
    gains,
    joint_of,
    noise_density,
    sub_steps,
)
from fgloc.motion.network import Network
from fgloc.motion.signals import Signals
from fgloc.types import CommandEvent, FloatArray


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
        self.joint = joint_of(card)
        self._network = network
        self._noise = card.noise
        self._delay, self._lag = card.lag.delay_s, np.array(card.lag.lag_s)
        self._scale = np.array(card.output_scale)
        self._gains = gains(card.kinematics)
        self._track: CommandTrack | None = None

    def predict(
        self,
        commands: tuple[CommandEvent, ...],
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
        twists[:, 0], twists[:, 2] = middles[:, 0] * dt, middles[:, 1] * dt
        variances = np.array([noise_density(self._noise, v, omega) for v, omega in middles.tolist()]) * dt
        return MotionPrediction(*composed(twists.tolist(), variances.tolist()), states[-1])

    def _roll(self, track: CommandTrack, start: float, duration: float, velocity: FloatArray) -> FloatArray:
        """Velocities ``(n + 1, 2)`` at the limits of the n sub-steps."""
        n = sub_steps(duration, self.card.dt_s)
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
