"""Networks of motion in torch: displacements or velocities, their variance, and a recurrent trunk.

Each rolls out trajectories that a loss can compare; export hands the weights to fgloc.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from fgloc.errors import RecordingError
from fgloc.sensors.learned.card import CHANNELS, Kinematics, Lag, Signals
from fgloc.sensors.learned.network import calibrated, measured_twists, signal_features
from fgloc.types import FloatArray
from fgloc_training.config import NetworkConfig
from fgloc_training.data import Run

# --- Planar motion ----------------------------------------------------------------------------------------------------


def integrate(twists: Tensor) -> Tensor:
    """Compose exponentials of twists ``(b, n, 3)`` into poses ``(b, n, 3)``; the yaw is not wrapped."""
    yaw = torch.cumsum(twists[..., 2], dim=-1)
    middle = yaw - 0.5 * twists[..., 2]
    chord = torch.sinc(twists[..., 2] / (2 * torch.pi))  # sin(θ/2) / (θ/2): arc to chord
    c, s = torch.cos(middle) * chord, torch.sin(middle) * chord
    x = torch.cumsum(c * twists[..., 0] - s * twists[..., 1], dim=-1)
    y = torch.cumsum(s * twists[..., 0] + c * twists[..., 1], dim=-1)
    return torch.stack([x, y, yaw], dim=-1)


def relative(a: Tensor, b: Tensor) -> Tensor:
    """``T_a⁻¹ ∘ T_b`` of poses ``(..., 3)``; the yaw is not wrapped."""
    c, s = torch.cos(a[..., 2]), torch.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return torch.stack([c * dx + s * dy, c * dy - s * dx, b[..., 2] - a[..., 2]], dim=-1)


# --- Memory -----------------------------------------------------------------------------------------------------------


class Trunk(nn.Module):
    """A GRU over the commands of the age bins, oldest first; layers on its last state and the other inputs.

    Attributes:
        cell: the GRU.
        layers: linear ones with ReLU after each; perhaps none.
        width: of the output.
    """

    def __init__(self, n_bins: int, n_inputs: int, hidden: tuple[int, ...]) -> None:
        """Make the cell and the layers.

        Args:
            n_bins: age bins, of two commands each, with which the inputs begin, youngest first.
            n_inputs: all of them.
            hidden: units of the cell, then of the layers.
        """
        super().__init__()
        self._n_bins = n_bins
        self.cell = nn.GRU(2, hidden[0], batch_first=True)
        widths = [hidden[0] + n_inputs - 2 * n_bins, *hidden[1:]]
        parts: list[nn.Module] = []
        for n_in, n_out in pairwise(widths):
            parts += [nn.Linear(n_in, n_out), nn.ReLU()]
        self.layers = nn.Sequential(*parts)
        self.width = widths[-1]

    def forward(self, x: Tensor) -> Tensor:
        """Hidden values ``(..., width)`` of normalized inputs ``(..., in)``."""
        commands = x[..., : 2 * self._n_bins].reshape(-1, self._n_bins, 2).flip(1)
        _, last = self.cell(commands)
        state = last[0].reshape(*x.shape[:-1], -1)
        return self.layers(torch.cat([state, x[..., 2 * self._n_bins :]], dim=-1))

    def weights(self) -> dict[str, Tensor]:
        """Weights of the cell, by the names of the model file."""
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        return {f"gru.{name}": getattr(self.cell, f"{name}_l0") for name in names}


# --- Variance ---------------------------------------------------------------------------------------------------------

_START_SIGMAS = (1e-2, 1e-2, 3e-2)  # m, m, rad per √s


def variance_net(net: nn.Sequential, mean: Tensor, std: Tensor, neighbors: list[tuple[int, int]]) -> nn.Sequential:
    """The network, its first units started as the sizes of changes from age to age, then of the inputs themselves.

    Robots pick up changed commands at instants that nobody knows; steady ones they follow.

    Args:
        net: linear layers with ReLU between them, inputs to three log-variances per second.
        mean: ``(n,)`` with which the inputs are normalized.
        std: ``(n,)`` likewise.
        neighbors: columns of the same input at neighboring ages, the younger first.
    """
    first = net[0]
    rows: list[Tensor] = []
    offsets: list[float] = []
    for younger, older in [*neighbors, *((i, None) for i in range(len(mean)))]:
        row, offset = torch.zeros(len(mean)), float(mean[younger] / std[younger])
        row[younger] = 1.0
        if older is not None:
            row[older] = -float(std[older] / std[younger])
            offset -= float(mean[older] / std[younger])
        rows += [row, -row]
        offsets += [offset, -offset]
    n = min(first.out_features, len(rows))
    with torch.no_grad():
        first.weight[:n] = torch.stack(rows[:n])
        first.bias[:n] = torch.tensor(offsets[:n])
    at_start_variance(net[-1])
    return net


def at_start_variance(head: nn.Linear) -> nn.Linear:
    """Initialize the last layer so that the variance is the same everywhere."""
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.log(torch.tensor(_START_SIGMAS) ** 2))
    return head


# --- Networks ---------------------------------------------------------------------------------------------------------

_LEAST_STD = 1e-3  # of an input that does not change
_RATE_S = 0.2  # a robot's velocities change within about this time


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Several runs, one after the other; a window of steps must not cross from one to the next."""

    features: Tensor  # (n, ·) what the commands say at each step
    base: Tensor  # (n, 3) twist of the calibrated kinematics over each step
    poses: Tensor  # (n, 3) truth at the start of each step, float64
    velocities: Tensor  # (n, 2) v, ω at the start of each step
    dt_s: float


def mlp(widths: list[int]) -> nn.Sequential:
    """Linear layers with ReLU between them; the last starts small, so that training starts from the known part."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [nn.Linear(n_in, n_out), nn.ReLU()]
    last = layers[-2]
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*layers[:-1])


class Scaled(nn.Module):
    """A network with normalized inputs and scaled outputs; the figures are saved with it."""

    mean: Tensor
    std: Tensor
    scale: Tensor

    def scale_by(self, mean: ArrayLike, std: ArrayLike, scale: ArrayLike) -> None:
        """Take mean and standard deviation ``(n,)`` of the inputs, and the scale of the outputs."""
        for name, values in (("mean", mean), ("std", np.maximum(std, _LEAST_STD)), ("scale", scale)):
            self.register_buffer(name, torch.tensor(np.asarray(values), dtype=torch.float32))


class DisplacementNet(Scaled):
    """Residual twist on the best known kinematics; log-variances from a network of their own (gru: a layer)."""

    def __init__(
        self, config: NetworkConfig, kinematics: Kinematics, wheel_kinematics: Kinematics, runs: list[Run]
    ) -> None:
        """Take the normalization from the training runs."""
        super().__init__()
        self.config, self.kinematics, self.wheel_kinematics = config, kinematics, wheel_kinematics
        self.joints = runs[0].sensors.joints
        self.measured = tuple(name for name in CHANNELS if name in config.inputs)
        self._sideways = "sideways" in config.inputs
        self._gyro_columns = self._columns("gyro")
        features = np.concatenate([self._features(run) for run in runs])
        base = np.concatenate([self._base(run) for run in runs])
        actual = np.concatenate([run.velocities for run in runs])
        mean, std = features.mean(axis=0), features.std(axis=0)
        if "velocity" in config.inputs:
            mean = np.append(mean, [0.0, 0.0])
            std = np.append(std, (actual - base)[:, [0, 2]].std(axis=0))
        self.scale_by(mean, std, (actual - base).std(axis=0))
        if config.kind == "gru":
            self.trunk: Trunk | nn.Sequential = Trunk(len(config.edges_s) - 1, len(mean), config.hidden)
            self.mean_head = mlp([self.trunk.width, 3])[-1]
        else:
            net = mlp([len(mean), *config.hidden, 3])
            self.trunk, self.mean_head = net[:-1], net[-1]
        self.variance: nn.Sequential | nn.Linear
        if config.kind == "gru":
            self.variance = at_start_variance(nn.Linear(self.mean_head.in_features, 3))
        else:
            own = mlp([len(mean), *[config.variance_units] * len(config.hidden), 3])
            self.variance = variance_net(own, self.mean, self.std, self._neighbors())
            if "velocity" in config.inputs:  # which is not given while the variance is learned: it would stay random
                with torch.no_grad():
                    own[0].weight[:, -2:] = 0.0

    def _neighbors(self) -> list[tuple[int, int]]:
        """Columns of the same input at neighboring ages."""
        found, first = [], 0
        for ages, channels in [
            (len(self.config.edges_s) - 1, 2),
            *([(len(self.config.edges_s) - 1, 1)] if self._sideways else []),
            *((len(self.config.signal_edges_s), CHANNELS[name].width) for name in self.measured),
        ]:
            found += [(i, i + channels) for i in range(first, first + (ages - 1) * channels)]
            first += ages * channels
        return found

    def _features(self, run: Run) -> FloatArray:
        middles = run.times + 0.5 * run.dt_s
        told = run.track.means(middles[:, None] - np.array(self.config.edges_s), self._sideways)
        signals, edges = self._signals(run), np.array(self.config.signal_edges_s)
        parts = [told[..., :2].reshape(len(middles), -1), told[..., 2:].reshape(len(middles), -1)]
        for name in self.measured:
            signal = signals.named(name)
            if signal is None:
                raise RecordingError(f"{run.name}: the model is to read {name}, which the recording does not hold")
            parts.append(signal_features(signal, run.times, run.dt_s, edges))
        return np.concatenate(parts, axis=1)

    def _base(self, run: Run) -> FloatArray:
        base = _base(self.kinematics, run)
        measured_twists(base, self.wheel_kinematics, self._signals(run), run.times, run.dt_s)
        return base

    def _signals(self, run: Run) -> Signals:
        return run.sensors.signals(self.measured, run.origin_ns)

    def _columns(self, name: str) -> slice:
        """Columns of the features that hold a measured input; empty if it is not read."""
        first, ages = (2 + self._sideways) * (len(self.config.edges_s) - 1), len(self.config.signal_edges_s)
        for other in self.measured:
            width = CHANNELS[other].width * ages
            if other == name:
                return slice(first, first + width)
            first += width
        return slice(0, 0)

    def samples(self, runs: list[Run]) -> Samples:
        """Samples of runs, in order."""
        return _samples(runs, [self._features(run) for run in runs], [self._base(run) for run in runs])

    def inputs(
        self, samples: Samples, starts: Tensor, steps: int, rng: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor]:
        """Base twists ``(b, steps, 3)`` and normalized inputs ``(b, steps, ·)``.

        With ``rng``, half of the windows are given the velocity at their start, with noise (if the model reads it), and
        the gyro has a bias that is not known.
        """
        rows = starts[:, None] + torch.arange(steps)
        x, base = samples.features[rows], samples.base[rows]
        if rng is not None and self.config.gyro_bias_sigma > 0.0 and "gyro" in self.measured:
            bias = self.config.gyro_bias_sigma * torch.randn(len(starts), 1, generator=rng)
            x[..., self._gyro_columns] += bias[..., None]
            base[..., 2] += bias
        if "velocity" in self.config.inputs:
            innovation = torch.zeros(len(starts), steps, 2)
            if rng is not None:
                known = samples.velocities[starts] - samples.base[starts][:, [0, 2]]
                known = known + torch.randn(known.shape, generator=rng) * torch.tensor(self.config.velocity_sigma)
                known = known * (torch.rand(len(starts), 1, generator=rng) < 0.5)
                middles = (torch.arange(steps) + 0.5) * samples.dt_s
                innovation = known[:, None] * torch.exp(-middles / self.config.velocity_decay_s)[:, None]
            x = torch.cat([x, innovation], dim=-1)
        return base, (x - self.mean) / self.std

    def roll(self, samples: Samples, starts: Tensor, steps: int, rng: torch.Generator | None = None) -> Tensor:
        """Poses ``(b, steps, 3)`` after each step, seen from the start."""
        base, x = self.inputs(samples, starts, steps, rng)
        return integrate((base + self.scale * self.mean_head(self.trunk(x))) * samples.dt_s)

    def log_density(self, x: Tensor) -> Tensor:
        """Log-variances per second ``(..., 3)`` of normalized inputs."""
        if isinstance(self.variance, nn.Linear):
            with torch.no_grad():
                x = self.trunk(x)
        return self.variance(x)

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and biases; the last layer has the mean's rows, then the variance's.

        The two networks lie side by side in one: rows of both on the inputs, then blocks.
        """
        trunk = self.trunk.layers if isinstance(self.trunk, Trunk) else self.trunk
        mean = [*_linear(trunk), self.mean_head]
        if isinstance(self.variance, nn.Linear):
            last = [
                torch.cat([getattr(m, name) for m in (self.mean_head, self.variance)]) for name in ("weight", "bias")
            ]
            return [*((m.weight, m.bias) for m in mean[:-1]), (last[0], last[1])]
        pairs = list(zip(mean, _linear(self.variance), strict=True))
        weights = [torch.cat([m.weight for m in pairs[0]])]
        weights += [torch.block_diag(m.weight, v.weight) for m, v in pairs[1:]]
        return [(w, torch.cat([m.bias, v.bias])) for w, (m, v) in zip(weights, pairs, strict=True)]


def _linear(net: nn.Sequential) -> list[nn.Linear]:
    return [m for m in net if isinstance(m, nn.Linear)]


class NaiveNet(Scaled):
    """Model without weights: the velocities are the commanded ones, v = u."""

    def __init__(self, config: NetworkConfig) -> None:
        """Take the configuration."""
        super().__init__()
        self.config, self.kinematics, self.lag = config, Kinematics(), None
        self.scale_by((), (), ())

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """No layers."""
        return []


class VelocityNet(Scaled):
    """[v, ω] a step later from (v, ω, u_v, u_ω, Δt): a lag plus Δt times a network. Source: paper eq. 6, 10.

    Of a ``lag`` model there is no network, of an ``arx`` model it is one linear layer, and in the ``rate`` form no lag:
    the network is the acceleration.
    """

    def __init__(self, config: NetworkConfig, kinematics: Kinematics, lag: Lag | None, runs: list[Run]) -> None:
        """Take the normalization from the training runs."""
        super().__init__()
        self.config, self.kinematics, self.lag = config, kinematics, lag
        self._delay_s = kinematics.delay_s if lag is None else lag.delay_s
        commanded = np.concatenate([self._features(run) for run in runs])
        actual = np.concatenate([run.velocities[:, [0, 2]] for run in runs])
        dts = np.array([0.5, 1.0]) * config.dt_s  # the range that sub-steps will have
        mean = [*actual.mean(axis=0), *commanded.mean(axis=0), dts.mean()]
        std = [*actual.std(axis=0), *commanded.std(axis=0), dts.std()]
        rate = np.maximum(actual.std(axis=0), 1e-3) / (_RATE_S if lag is None else np.array(lag.lag_s))
        if config.kind == "lag":
            mean, std, rate = [], [], np.zeros(0)
        self.scale_by(mean, std, rate)
        hidden = () if config.kind == "arx" else config.hidden
        self.net = None if config.kind == "lag" else mlp([5, *hidden, 2])

    def _features(self, run: Run) -> FloatArray:
        limits = np.append(run.times, len(run.poses) * run.dt_s)
        return run.track.means(limits - self._delay_s)

    def samples(self, runs: list[Run]) -> Samples:
        """Samples of runs, in order."""
        aims = self.kinematics.model_copy(update={"delay_s": self._delay_s})
        return _samples(runs, [self._features(run) for run in runs], [_base(aims, run) for run in runs])

    def roll(self, samples: Samples, starts: Tensor, steps: int, rng: torch.Generator | None = None) -> Tensor:
        """Poses ``(b, steps, 3)`` after each step, seen from the start.

        With ``rng``, half of the batches take two samples at a time (then only every second pose moves freely), so that
        the model learns the meaning of Δt.
        """
        pair = 2 if rng is not None and steps % 2 == 0 and torch.rand(1, generator=rng).item() < 0.5 else 1
        dt = samples.dt_s * pair
        rows = starts[:, None] + torch.arange(steps)
        commanded, aims = (
            part.reshape(len(starts), steps // pair, pair, 2).mean(dim=2)
            for part in (samples.features[rows], samples.base[rows][..., [0, 2]])
        )
        keep = torch.ones(2) if self.lag is None else torch.exp(-dt / torch.tensor(self.lag.lag_s))
        state = samples.velocities[starts]
        dts = torch.full((len(starts), 1), dt)
        states = [state]
        for k in range(steps // pair):
            x = torch.cat([state, commanded[:, k], dts], dim=1)
            state = aims[:, k] + keep * (state - aims[:, k])
            if self.net is not None:
                state = state + dt * self.scale * self.net((x - self.mean) / self.std)
            states.append(state)
        velocity = torch.stack(states, dim=1)
        between = 0.5 * (velocity[:, :-1] + velocity[:, 1:]).repeat_interleave(pair, dim=1) * samples.dt_s
        return integrate(torch.stack([between[..., 0], torch.zeros_like(between[..., 0]), between[..., 1]], dim=-1))

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and biases."""
        return [] if self.net is None else [(m.weight, m.bias) for m in self.net if isinstance(m, nn.Linear)]


MotionNet = DisplacementNet | VelocityNet | NaiveNet


def _base(kinematics: Kinematics, run: Run) -> FloatArray:
    return calibrated(kinematics, run.track, np.append(run.times, len(run.poses) * run.dt_s))


def _samples(runs: list[Run], features: list[FloatArray], base: list[FloatArray]) -> Samples:
    def tensor(parts: list[FloatArray]) -> Tensor:
        return torch.tensor(np.concatenate(parts), dtype=torch.float32)

    return Samples(
        features=tensor(features),
        base=tensor(base),
        poses=torch.tensor(np.concatenate([run.poses for run in runs])),
        velocities=tensor([run.velocities[:, [0, 2]] for run in runs]),
        dt_s=runs[0].dt_s,
    )
