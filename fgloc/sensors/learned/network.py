"""Forms of identified motion models: networks in numpy, from inputs to the motion over a step with covariance.

All forms cut a step into equal parts no longer than the card's ``dt_s`` and compose them, so that a step may last any
time and two halves give what the whole gives.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fgloc import se2
from fgloc.errors import CovarianceError, ModelError
from fgloc.sensors.base import Signal
from fgloc.sensors.learned.card import Kinematics, ModelCard, Signals
from fgloc.types import ControlEvent, FloatArray, MotionMeasurement

Float32Array = NDArray[np.float32]


Answering = Callable[[Float32Array], Float32Array]
"""Any network: inputs ``(rows, in)`` to outputs ``(rows, out)``, or ``(members, rows, out)`` of an ensemble.

They are perhaps not finite; the next call overwrites them.
"""


class Network:
    """``y = scale (W_n relu(... relu(W_0 (x - mean) / std + b_0) ...) + b_n) + offset`` for a batch of rows.

    What is not a layer is folded into the first and the last. The members of an ensemble, stacked, answer in one call.
    Not for concurrent use: calls share buffers.
    """

    def __init__(
        self,
        layers: list[tuple[Float32Array, Float32Array]],
        mean: NDArray[np.float64],
        std: NDArray[np.float64],
        scale: NDArray[np.float64] | None = None,
        offset: NDArray[np.float64] | None = None,
    ) -> None:
        """Take the layers.

        Args:
            layers: (weight (out, in), bias (out,)) from input to output, of an ensemble each with a first axis more.
            mean: ``(in,)`` of the inputs.
            std: ``(in,)`` of the inputs.
            scale: ``(out,)`` of the outputs; None: 1.
            offset: ``(out,)`` added to the outputs after that; None: 0.
        """
        weights = [w.astype(np.float64) for w, _ in layers]
        biases = [b.astype(np.float64) for _, b in layers]
        weights[0] /= std
        biases[0] -= weights[0] @ mean
        if scale is not None:
            weights[-1] *= scale[:, None]
            biases[-1] *= scale
        if offset is not None:
            biases[-1] += offset
        with np.errstate(over="ignore"):
            self._weights = [np.ascontiguousarray(w.swapaxes(-1, -2), dtype=np.float32) for w in weights]
            self._biases = [b[..., None, :].astype(np.float32) for b in biases]
        self._buffers: dict[int, list[Float32Array]] = {}

    def __call__(self, x: Float32Array) -> Float32Array:
        """Outputs ``(rows, out)``, or ``(members, rows, out)``, of inputs ``(rows, in)``, perhaps not finite.

        The next call overwrites the result.
        """
        rows = len(x)
        buffers = self._buffers.get(rows)
        if buffers is None:
            buffers = [np.empty((*w.shape[:-2], rows, w.shape[-1]), dtype=np.float32) for w in self._weights]
            self._buffers[rows] = buffers
        last = len(buffers) - 1
        with np.errstate(over="ignore", invalid="ignore"):
            for i, (w, b, y) in enumerate(zip(self._weights, self._biases, buffers, strict=True)):
                np.matmul(x, w, out=y)
                np.add(y, b, out=y)
                if i < last:
                    np.maximum(y, 0.0, out=y)
                x = y
        return x


class RecurrentNetwork:
    """The commands of the age bins, oldest first, through the cell; its last state and the other inputs to the layers.

    Source: Cho et al. 2014, in the form of torch.nn.GRU.
    """

    def __init__(
        self,
        cell: Sequence[Float32Array],
        head: Network,
        n_bins: int,
        mean: NDArray[np.float64],
        std: NDArray[np.float64],
    ) -> None:
        """Take the parts.

        Args:
            cell: weights that read two numbers ``(3 h, 2)`` and the state ``(3 h, h)``, and the biases ``(3 h,)`` of
                both, in torch's layout: rows of the reset gate, the update gate, then the candidate.
            head: of the last state and the normalized other inputs.
            n_bins: age bins of two commands each, with which the inputs begin, youngest first.
            mean: ``(in,)`` of the inputs.
            std: ``(in,)`` of the inputs.
        """
        self._cell, self._head, self._n_bins = cell, head, n_bins
        self._mean, self._std = mean.astype(np.float32), std.astype(np.float32)

    def __call__(self, x: Float32Array) -> Float32Array:
        """Outputs ``(rows, out)`` of inputs ``(rows, in)``, perhaps not finite; the next call overwrites them."""
        weight_ih, weight_hh, bias_ih, bias_hh = self._cell
        width = len(bias_ih) // 3
        normal = (x - self._mean) / self._std
        state = np.zeros((len(x), width), dtype=np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self._n_bins - 1, -1, -1):
                read = normal[:, 2 * k : 2 * k + 2] @ weight_ih.T + bias_ih
                kept = state @ weight_hh.T + bias_hh
                gates = _sigmoid(read[:, : 2 * width] + kept[:, : 2 * width])
                reset, update = gates[:, :width], gates[:, width:]
                candidate = np.tanh(read[:, 2 * width :] + reset * kept[:, 2 * width :])
                state = candidate + update * (state - candidate)
        return self._head(np.concatenate([state, normal[:, 2 * self._n_bins :]], axis=1))


def _sigmoid(x: Float32Array) -> Float32Array:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)), dtype=np.float32)


_FOREVER_S = 1e4  # a last command holds on; who asks decides for how long
_MIN_CAPACITY = 4096


class CommandHistory:
    """Zero-order hold over commands, integrated once so that any mean over time is two look-ups.

    Before the first command the robot is taken to be at rest.
    """

    def __init__(self, commands: tuple[ControlEvent, ...], origin_ns: int | None = None) -> None:
        """Integrate the commands over time.

        Args:
            commands: at least one, in order of stamp.
            origin_ns: time zero of all the later questions; None: the first command's.
        """
        self.origin_ns = commands[0].stamp_ns if origin_ns is None else origin_ns
        n = len(commands)
        capacity = max(_MIN_CAPACITY, 2 * n)
        self._events = list(commands)
        self._times = np.empty(capacity)
        self._integrals = np.zeros(capacity, dtype=np.complex128)  # of v + iω: both by one interpolation
        self._sideways = np.zeros(capacity)  # of vy
        times = self._times[:n]
        times[:] = [c.stamp_ns - self.origin_ns for c in commands]
        times *= 1e-9
        steps = np.diff(times)
        np.cumsum(np.multiply([complex(c.v, c.omega) for c in commands[:-1]], steps), out=self._integrals[1:n])
        np.cumsum(np.multiply([c.vy for c in commands[:-1]], steps), out=self._sideways[1:n])
        self._extend(())

    def following(self, commands: tuple[ControlEvent, ...]) -> CommandHistory:
        """This track, extended by what is new in the next step's commands; a new one if they do not continue it."""
        last = self._events[-1]
        i = len(commands) - 1
        while i >= 0 and commands[i] is not last:
            i -= 1
        first = len(self._events) - 1 - i  # our index of commands[0], if they are the same
        full = len(self._events) + len(commands) - i >= len(self._times)
        if i < 0 or first < 0 or self._events[first] is not commands[0] or full:
            return CommandHistory(commands)
        self._extend(commands[i + 1 :])
        return self

    def integrals(self, times_s: FloatArray, sideways: bool = False) -> FloatArray:
        """Integrals of v and ω ``(..., 2)``, or of v, ω and vy ``(..., 3)``, up to times ``(...)`` since the origin."""
        n = len(self._events) + 1
        integrals = np.interp(times_s, self._times[:n], self._integrals[:n])
        told = integrals.view(np.float64).reshape(*times_s.shape, 2)
        if not sideways:
            return told
        return np.concatenate([told, np.interp(times_s, self._times[:n], self._sideways[:n])[..., None]], axis=-1)

    def means(self, limits_s: FloatArray, sideways: bool = False) -> FloatArray:
        """Mean (v, ω), or (v, ω, vy), between neighboring limits.

        Args:
            limits_s: ``(..., m)`` times since the origin, strictly monotonic along the last axis.
            sideways: whether vy is asked for.

        Returns:
            ``(..., m - 1, 2)`` or ``(..., m - 1, 3)``.
        """
        return np.asarray(np.diff(self.integrals(limits_s, sideways), axis=-2) / np.diff(limits_s)[..., None])

    def _extend(self, events: tuple[ControlEvent, ...]) -> None:
        """Append, then one more entry, overwritten by the next command: the last one holds.

        In plain floats: reading single elements of arrays would take most of the time.
        """
        times, integrals, sideways = self._times, self._integrals, self._sideways
        k, last = len(self._events), self._events[-1]
        t, integral, left = float(times[k - 1]), complex(integrals[k - 1]), float(sideways[k - 1])
        for event in events:
            now = (event.stamp_ns - self.origin_ns) * 1e-9
            integral, left, t = integral + complex(last.v, last.omega) * (now - t), left + last.vy * (now - t), now
            times[k], integrals[k], sideways[k] = t, integral, left
            k, last = k + 1, event
        self._events.extend(events)
        times[k] = t + _FOREVER_S
        integrals[k] = integral + complex(last.v, last.omega) * _FOREVER_S
        sideways[k] = left + last.vy * _FOREVER_S


# Of the norms of the gain and of the correlation: at 1 one of the two would add no information and its covariance would
# be singular; near it their difference would be blown up.
MAX_GAIN = 0.95


class JointCalibration:
    """Correlation of the errors of wheel odometry (W) and of learned motion (N).

    Kept as the dimensionless ``R = L_n⁻¹ C L_w⁻ᵀ`` with the Cholesky factors of N and W, so that a calibration from
    long windows serves a step of any length and any predicted covariance: ``C = L_n R L_wᵀ`` of that step.

    Source: conditional mean of the joint Gaussian.
    """

    def __init__(self, W: ArrayLike, N: ArrayLike, C: ArrayLike) -> None:
        """Take covariances estimated over windows.

        Args:
            W: ``(3, 3)`` of the wheels' error.
            N: ``(3, 3)`` of the learned motion's error.
            C: ``(3, 3)`` E[e_n e_wᵀ].

        Raises:
            CovarianceError: W or N is not a covariance, or the three are not a joint one.
        """
        L_w, L_n = _cholesky(np.asarray(W, dtype=float), "W"), _cholesky(np.asarray(N, dtype=float), "N")
        self.correlation = np.linalg.solve(L_n, np.linalg.solve(L_w, np.asarray(C, dtype=float).T).T)
        norm = float(np.linalg.norm(self.correlation, 2))
        if not norm <= 1.0 + 1e-9:
            raise CovarianceError(
                f"W, N and C are not a joint covariance: their correlation has norm {norm:.4g}, expected at most 1; "
                "estimate the three from the same windows"
            )
        if norm > MAX_GAIN:
            self.correlation *= MAX_GAIN / norm
        self._last: tuple[FloatArray, FloatArray, FloatArray] | None = None  # covariances and gain

    def gain(self, W: FloatArray, N: FloatArray) -> FloatArray:
        """K = C W⁻¹ ``(3, 3)`` for a step with these covariances.

        Shrunk until its norm, in units of the wheels' sigmas, is at most 0.95.
        """
        last = self._last  # it is asked for twice in most steps; other threads ask too
        if last is None or last[0] is not W or last[1] is not N:
            L_w, L_n = _cholesky(W, "the wheels' covariance"), _cholesky(N, "the learned covariance")
            last = self._last = W, N, self._gain(L_w, L_n)
        return last[2]

    def difference_cov(self, W: FloatArray, N: FloatArray) -> FloatArray:
        """Covariance ``(3, 3)`` of the difference of the two motions over a step: W + N - C - Cᵀ."""
        C = self.gain(W, N) @ W
        return W + N - C - C.T

    def decorrelate(self, wheels: MotionMeasurement, learned: MotionMeasurement) -> MotionMeasurement:
        """The learned measurement that may enter beside the unchanged wheels' as if independent.

        Raises:
            CovarianceError: a covariance is not one.
            ValueError: the two measure different steps.
        """
        if (wheels.start_ns, wheels.stamp_ns) != (learned.start_ns, learned.stamp_ns):
            raise ValueError(
                f"wheels measure [{wheels.start_ns}, {wheels.stamp_ns}] ns, learned motion [{learned.start_ns}, "
                f"{learned.stamp_ns}] ns; only measurements of one step can be decorrelated"
            )
        K = self.gain(wheels.cov, learned.cov)
        inverse = np.linalg.inv(np.eye(3) - K)
        difference = se2.log(se2.between(wheels.motion, learned.motion))
        motion = se2.compose(wheels.motion, se2.exp(inverse @ difference))
        cov = inverse @ (learned.cov - K @ wheels.cov @ K.T) @ inverse.T
        depends = {}
        for name in {**wheels.depends_on, **learned.depends_on}:
            by_wheels, assumed = wheels.depends_on.get(name, (np.zeros(3), None))
            by_learned, also = learned.depends_on.get(name, (np.zeros(3), None))
            value = assumed if assumed is not None else also
            assert value is not None
            depends[name] = by_wheels + inverse @ (by_learned - by_wheels), value
        return replace(learned, motion=motion, cov=0.5 * (cov + cov.T), depends_on=depends)

    def _gain(self, L_w: FloatArray, L_n: FloatArray) -> FloatArray:
        scaled = np.linalg.solve(L_w, L_n @ self.correlation)  # K as the wheels' sigmas see it
        if np.vdot(scaled, scaled) > MAX_GAIN**2:  # else the norm, which is not above Frobenius', is small enough
            scaled *= MAX_GAIN / max(float(np.linalg.norm(scaled, 2)), MAX_GAIN)
        return np.asarray(L_w @ np.linalg.solve(L_w.T, scaled.T).T)


def _cholesky(cov: FloatArray, name: str) -> FloatArray:
    try:
        if not np.isfinite(cov).all():
            raise np.linalg.LinAlgError("not finite")
        return np.asarray(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError as error:
        raise CovarianceError(f"{name} is not positive definite ({error}): {cov.tolist()}") from error


_SMALL = 1e-9
Triple = Sequence[float]  # of x, y and yaw


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrediction:
    """``T_start_end`` of the base with right-perturbation covariance, and the body velocity at the end."""

    motion: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    velocity: FloatArray  # (2,) v [m/s], ω [rad/s]


class MotionModel(ABC):
    """A learned model: its card, its calibration against the wheels, and its predictions."""

    def __init__(self, card: ModelCard) -> None:
        """Take a checked card."""
        self.card = card
        self.joint = None if card.joint is None else JointCalibration(card.joint.W, card.joint.N, card.joint.C)
        self._track: CommandHistory | None = None

    def predict(
        self,
        commands: tuple[ControlEvent, ...],
        start_ns: int,
        end_ns: int,
        velocity: FloatArray | None,
        signals: Signals | None = None,
    ) -> MotionPrediction | None:
        """Motion over ``[start_ns, end_ns]``.

        Args:
            commands: in order of stamp, from ``card.history_s`` before the start (or the first there is) to the end.
            start_ns: start of the step.
            end_ns: its end.
            velocity: ``(2,)`` body velocity v, ω at the start, if known. None: by the commands before the start.
            signals: what was measured, if the model reads any of it.

        Returns:
            None if the network's output is not finite.

        Raises:
            ModelError: there is no command, the step has no length, or a signal that the model reads is not given.
        """
        if not commands:
            raise ModelError("no command to predict from; the step needs the last command at or before its start")
        if end_ns <= start_ns:
            raise ModelError(f"the step ends at {end_ns} ns, not after its start {start_ns} ns")
        self._track = CommandHistory(commands) if self._track is None else self._track.following(commands)
        duration = (end_ns - start_ns) * 1e-9
        return self._predict(self._track, start_ns, duration, velocity, signals or Signals(start_ns))

    @abstractmethod
    def _predict(
        self, track: CommandHistory, start_ns: int, duration: float, velocity: FloatArray | None, signals: Signals
    ) -> MotionPrediction | None:
        """Motion over a duration [s], by the track of the commands; the rest as `predict` has it."""


def calibrated(kinematics: Kinematics, track: CommandHistory, limits: FloatArray) -> FloatArray:
    """Mean body twists ``(n, 3)`` between limits [s] of the calibrated kinematics."""
    means = track.means(limits - kinematics.delay_s, kinematics.scale_vy > 0.0)
    return np.asarray(means @ gains(kinematics))


def gains(kinematics: Kinematics) -> FloatArray:
    """``(2, 3)``: commands (v, ω) times it are body twists; ``(3, 3)`` of a robot that is commanded sideways."""
    v, left = kinematics.scale_v, kinematics.scale_vy
    rows = [[v, 0.0, kinematics.yaw_per_m * v], [0.0, 0.0, kinematics.scale_omega], [0.0, left, 0.0]]
    return np.array(rows if left > 0.0 else rows[:2])


def composed(twists: Iterable[Triple], variances: Iterable[Triple]) -> tuple[FloatArray, FloatArray]:
    """Motion ``(3,)`` and covariance ``(3, 3)`` of consecutive parts.

    Scalars, because a step has two or three parts: five times as fast here as `fgloc.se2` on small arrays.

    Args:
        twists: of each part, held over it, times its length.
        variances: of x, y and yaw of each part's right perturbation, independent.
    """
    x = y = yaw = 0.0
    xx = xy = xt = yy = yt = tt = 0.0
    for (vx, vy, turn), (qx, qy, qt) in zip(twists, variances, strict=True):
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


def sub_steps(duration: float, longest_s: float) -> int:
    """Number of equal parts of a duration [s], none of which is longer than ``longest_s``."""
    return max(1, math.ceil(duration / longest_s - 1e-6))


class NaiveModel(MotionModel):
    """The robot moves as commanded: v = u, in the model's kinematics. The baseline."""

    def _predict(
        self, track: CommandHistory, start_ns: int, duration: float, velocity: FloatArray | None, signals: Signals
    ) -> MotionPrediction | None:
        n = sub_steps(duration, self.card.dt_s)
        limits = (start_ns - track.origin_ns) * 1e-9 + duration / n * np.arange(n + 1, dtype=np.float64)
        twists = calibrated(self.card.kinematics, track, limits)
        return _prediction(twists, self.card, duration / n, twists[-1, ::2])


class VelocityModel(MotionModel):
    """The paper's model: ``[v, ω]ₖ₊₁ = F(v, ω, u_v, u_ω, Δt)``, rolled out, kinematics known.

    F is a first-order lag towards the calibrated commands plus Δt times a network, so that Δt may vary and the network
    starts from what is known. A card without a lag has the velocity stay as it is instead: the rate form.

    Source: paper eq. 9 and 10; the network's part, and all of a ``rate`` model, in the form of eq. 6.
    """

    def __init__(self, card: ModelCard, network: Answering | None) -> None:
        """Take a checked card and its network; None for a ``lag`` model."""
        super().__init__(card)
        self._network = network
        self._lag = None if card.lag is None else np.array(card.lag.lag_s)
        self._delay = card.kinematics.delay_s if card.lag is None else card.lag.delay_s
        self._scale = np.array(card.output_scale)
        self._gains = gains(card.kinematics)

    def _predict(
        self, track: CommandHistory, start_ns: int, duration: float, velocity: FloatArray | None, signals: Signals
    ) -> MotionPrediction | None:
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
        return _prediction(twists, self.card, dt, states[-1])

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


def _prediction(twists: FloatArray, card: ModelCard, dt: float, velocity: FloatArray) -> MotionPrediction:
    """Motion of body twists ``(n, 3)``, each held for ``dt`` [s], with covariance by the card's densities."""
    assert card.noise is not None  # the card was checked
    variances = np.array([card.noise.per_second(v, omega) for v, omega in twists[:, ::2].tolist()])
    return MotionPrediction(*composed((twists * dt).tolist(), (variances * dt).tolist()), velocity)


_MIN_DENSITY = 1e-8  # m²/s, m²/s, rad²/s: nobody knows motion better than this
_MAX_LOG_VARIANCE = 10.0
_DISAGREEMENT_S = 1.0  # members differ for about this long at a time: a rate of spread s has the density 2 s² times it


class DisplacementModel(MotionModel):
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
        super().__init__(card)
        self._network = network
        self._gains = gains(card.kinematics)
        self._ages = np.array(card.edges_s)
        self._widths = np.diff(self._ages)
        self._signal_edges = np.array(card.signal_edges_s)
        self._n_inputs = card.n_inputs
        self._reads_velocity = "velocity" in card.inputs
        self._spread_gain = 2.0 * _DISAGREEMENT_S * np.array(card.variance_scale)
        self._sideways = "sideways" in card.inputs
        self._n_bins = 2 * len(self._widths)
        self._n_told = card.n_commands * len(self._widths)
        self._plans: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = {}  # by number of sub-steps

    def _predict(
        self, track: CommandHistory, start_ns: int, duration: float, velocity: FloatArray | None, signals: Signals
    ) -> MotionPrediction | None:
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
        """Twists of the calibrated kinematics times dt ``(n, 3)``, and inputs by the commands, one row per sub-step."""
        plan = self._plans.get(n)
        if plan is None:
            plan = self._plans[n] = self._plan(n)
        slope, offset, means_of = plan
        means = means_of @ track.integrals(slope * dt + (offset + start), self._sideways)
        x = np.empty((n, self._n_inputs), dtype=np.float32)
        x[:, : self._n_bins] = means[n:, :2].reshape(n, -1)
        if self._sideways:
            x[:, self._n_bins : self._n_told] = means[n:, 2].reshape(n, -1)
        return means[:n] @ self._gains, x

    def _measured(self, base: FloatArray, x: Float32Array, signals: Signals, start_ns: int, dt: float) -> None:
        """Fill the network's inputs from signals, and replace the twists that signals measure better than commands."""
        n, at = len(base), self._n_told
        starts = (start_ns - signals.origin_ns) * 1e-9 + dt * np.arange(n, dtype=np.float64)
        for name in self.card.measured:
            signal = signals.named(name)
            if signal is None:
                raise ModelError(f"the model reads {name}, which the step has not; its inputs are {self.card.inputs}")
            features = signal_features(signal, starts, dt, self._signal_edges)
            x[:, at : at + features.shape[1]] = features
            at += features.shape[1]
        base /= dt
        measured_twists(base, self.card.wheel_kinematics, signals, starts, dt)
        base *= dt

    def _plan(self, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Linear maps by which one look-up in a track of commands serves n sub-steps.

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
    """Replace the twists ``(n, 3)`` of sub-steps by measured ones: all of them by wheels, the yaw rate by a gyro."""
    limits = np.column_stack([starts, starts + dt])
    wheels, rate = signals.named("wheels"), signals.named("gyro")
    if wheels is not None:
        base[:] = wheels.means(limits - wheel_kinematics.delay_s)[:, 0] @ gains(wheel_kinematics)
    if rate is not None:
        base[:, 2] = rate.means(limits)[:, 0, 0]
