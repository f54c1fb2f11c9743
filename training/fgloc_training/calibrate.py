"""Fits beside the network's weights: known kinematics before it, honest covariances after it, another robot's gains.

Covariances are fitted on recordings that the weights have not seen. `adapted` fits a trained model to another robot
of its kind, from a minute of its driving: only gains and pull move, as far as the errors are larger than the model
expects them to be, because robots of a kind differ in little else, and a minute holds too few turns to teach a
network anything but its accidents.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize
from scipy.signal import lfilter

from fgloc import se2
from fgloc.config import NoiseDensity
from fgloc.errors import RecordingError
from fgloc.sensors.base import Signal
from fgloc.sensors.learned.card import ErrorMemory, JointErrors, Kinematics, Lag, Matrix, ModelCard, Row
from fgloc.sensors.learned.network import CommandHistory, calibrated
from fgloc.sensors.learned.sensor import Tensors, model_of
from fgloc.types import FloatArray
from fgloc_training.config import AdaptationConfig, CalibrationConfig
from fgloc_training.data import Run
from fgloc_training.rollouts import Rollout, roll_model

# --- Kinematics, lag and noise ----------------------------------------------------------------------------------------

_ALMOST_ONE = 0.999
_FIELDS = tuple(NoiseDensity.model_fields)
_MIN_STEP_VARIANCE = 1e-12  # keeps a covariance definite where the robot rests
_MIN_DENSITY = 1e-4
_MIN_FACTOR = 1e-4
_MIN_LONG = 0.1  # of what short windows show: what cancels in the end still leaves doubt
_FIT_WINDOW_S = 2.0


def fit_kinematics(
    runs: list[Run], twists_of: Callable[[Run], CommandHistory | Signal] = lambda run: run.track, sideways: bool = False
) -> Kinematics:
    """Scale, pull to one side and delay that fit the true motion over two seconds best, in the least-squares sense.

    With ``sideways`` the scale of the commands to the left too.

    Shorter runs count whole. Over shorter times the robot's lag, which these kinematics do not know, would pass for a
    smaller scale.
    """

    def residuals(parameters: FloatArray) -> FloatArray:
        scale_v, scale_omega, yaw_per_m, delay = parameters
        parts = []
        for track, run, k, actual in windows:
            mean = track.means(np.column_stack([run.times[k], run.times[k + steps]]) - delay)[:, 0]
            v = scale_v * mean[:, 0]
            omega = scale_omega * mean[:, 1] + yaw_per_m * v
            parts += [(v - actual[:, 0]) / v_unit, (omega - actual[:, 1]) / omega_unit]
        return np.concatenate(parts)

    longest = max(len(run.poses) for run in runs) - 1
    steps = min(round(_FIT_WINDOW_S / runs[0].dt_s), max(1, 3 * longest // 4))
    windows = []
    for run in runs:
        k = run.starts(steps)
        forward = run.velocities[:, 0]
        travelled = np.concatenate([[0.0], np.cumsum(0.5 * (forward[1:] + forward[:-1]) * run.dt_s)])
        change = np.column_stack([travelled[k + steps] - travelled[k], run.poses[k + steps, 2] - run.poses[k, 2]])
        windows.append((twists_of(run), run, k, change / (steps * run.dt_s)))
    v_unit, omega_unit = np.maximum(1e-3, np.concatenate([actual for _, _, _, actual in windows]).std(axis=0))
    bounds = ([0.3, 0.3, -1.0, 0.0], [2.0, 2.0, 1.0, 1.0])
    fit = least_squares(residuals, [1.0, 1.0, 0.0, 0.2], bounds=bounds, diff_step=1e-2, x_scale=[1.0, 1.0, 0.1, 0.2])
    scale_v, scale_omega, yaw_per_m, delay_s = (float(value) for value in fit.x)
    scale_vy = _sideways_scale(runs, steps, delay_s) if sideways else 0.0
    return Kinematics(scale_v=scale_v, scale_omega=scale_omega, scale_vy=scale_vy, yaw_per_m=yaw_per_m, delay_s=delay_s)


def _sideways_scale(runs: list[Run], steps: int, delay_s: float) -> float:
    """Scale of the commands to the left, by the true motion over as many steps; 1 if none was commanded."""
    products = squares = 0.0
    for run in runs:
        k = run.starts(steps)
        left = np.concatenate([[0.0], np.cumsum(0.5 * (run.velocities[1:, 1] + run.velocities[:-1, 1]) * run.dt_s)])
        limits = np.column_stack([run.times[k], run.times[k + steps]]) - delay_s
        told = run.track.means(limits, sideways=True)[:, 0, 2]
        products += float(told @ (left[k + steps] - left[k])) / (steps * run.dt_s)
        squares += float(told @ told)
    return float(np.clip(products / squares, 0.3, 2.0)) if squares > 0.0 else 1.0


def fit_lag(runs: list[Run], kinematics: Kinematics) -> Lag:
    """Delay and time constants with which a first-order lag towards the scaled commands fits the true velocities."""

    def residuals(parameters: FloatArray) -> FloatArray:
        parts = []
        for run in runs:
            aims = calibrated(kinematics.model_copy(update={"delay_s": float(parameters[0])}), run.track, run.times)
            for axis, column in enumerate((0, 2)):
                keep = np.exp(-run.dt_s / parameters[1 + axis])
                state = lfilter([1.0 - keep], [1.0, -keep], aims[:, column])
                parts.append(((state - run.velocities[1:, column]) / units[axis])[run.valid[1:]])
        return np.concatenate(parts)

    units = [max(1e-3, float(np.concatenate([run.velocities[:, column] for run in runs]).std())) for column in (0, 2)]
    fit = least_squares(residuals, [0.1, 0.2, 0.2], bounds=([0.0, 0.02, 0.02], [1.0, 2.0, 2.0]), diff_step=1e-2)
    delay, lag_v, lag_omega = (float(value) for value in fit.x)
    return Lag(delay_s=delay, lag_s=(lag_v, lag_omega))


def fit_noise(rollouts: list[Rollout], config: CalibrationConfig) -> NoiseDensity:
    """Noise densities under which the errors over the calibration's horizons are most likely."""
    errors, parts = [], []
    for rollout in rollouts:
        for horizon in config.horizons_s:
            errors.append(rollout.errors(horizon))
            parts.append(np.stack([rollout.composed(b, horizon) for b in _noise_bases(rollout)], axis=1))
    start = np.full(len(_FIELDS), 1e-4)
    variances, _ = _most_likely(np.concatenate(errors), np.concatenate(parts), start)
    return NoiseDensity(**{n: max(_MIN_DENSITY, float(np.sqrt(v))) for n, v in zip(_FIELDS, variances, strict=True)})


def fit_variance(rollouts: list[Rollout], config: CalibrationConfig) -> tuple[Row, ErrorMemory]:
    """Factors on the predicted variances of x, y and yaw, and the memory under which the errors are most likely.

    What short and what long windows show add up, so for given time constants the likelihood has two coefficients for
    each axis. The rollouts' steps must be single sub-steps, whose covariance is diagonal.
    """
    errors, composed, lengths = [], [], []
    for rollout in rollouts:
        for horizon in (*config.short_s, *config.horizons_s):
            errors.append(rollout.errors(horizon))
            of_axes = [rollout.composed(_diagonal(rollout.covs[:, i, i], [i]), horizon) for i in range(3)]
            composed.append(np.stack(of_axes, axis=1))
            lengths.append(np.full(len(errors[-1]), horizon))
    e, basis, (window_s, of_window) = np.concatenate(errors), np.concatenate(composed), _distinct(lengths)

    def fitted(times_s: tuple[float, ...], start: FloatArray) -> tuple[FloatArray, float]:
        all_hidden = ErrorMemory(time_s=se2.triple(times_s), share=(_ALMOST_ONE,) * 3)
        shown = np.array([all_hidden.growth(horizon) for horizon in window_s])[of_window, :, None, None]
        of_short = _MIN_LONG * shown + 1.0 - shown
        return _most_likely(e, np.concatenate([shown * basis, of_short * basis], axis=1), start)

    # The best time constant for all axes, then each axis' own
    start = np.full(6, 0.5)
    times_s = min(((t, t, t) for t in config.memory_s), key=lambda times_s: fitted(times_s, start)[1])
    for axis in range(3):
        tried = [(*times_s[:axis], t, *times_s[axis + 1 :]) for t in config.memory_s]
        times_s = min(tried, key=lambda times_s: fitted(times_s, start)[1])
    best, _ = fitted(times_s, start)
    more, short = np.maximum(best, _MIN_FACTOR).reshape(2, 3)
    long = more + _MIN_LONG * short
    share = np.minimum(1.0 - short / long, _ALMOST_ONE)
    return se2.triple(long), ErrorMemory(time_s=se2.triple(times_s), share=se2.triple(share))


def fit_joint(learned: list[Rollout], wheels: list[Rollout], config: CalibrationConfig) -> JointErrors:
    """W, N, C of the errors over windows, each in units of its predicted covariance (its Cholesky factor).

    Args:
        learned: rollouts with the calibrated covariance.
        wheels: rollouts of the same runs with the wheels' covariance.
        config: length of the windows.
    """
    whitened = []
    for parts in (learned, wheels):
        white = []
        for rollout in parts:
            root = np.linalg.cholesky(rollout.end_covs(config.window_s))
            white.append(np.linalg.solve(root, rollout.errors(config.window_s)[..., None])[..., 0])
        whitened.append(np.concatenate(white))
    n, w = whitened
    return JointErrors(
        window_s=config.window_s, W=_rows(w.T @ w / len(w)), N=_rows(n.T @ n / len(n)), C=_rows(n.T @ w / len(n))
    )


def noise_covs(rollout: Rollout, noise: NoiseDensity) -> FloatArray:
    """Covariances ``(n, 3, 3)`` of the steps under noise densities."""
    parts = zip(_FIELDS, _noise_bases(rollout), strict=True)
    return np.asarray(sum(getattr(noise, name) ** 2 * basis for name, basis in parts))


def nis(errors: FloatArray, covs: FloatArray) -> FloatArray:
    """Normalized innovations squared ``(m,)``: eᵀP⁻¹e, 3 on average if the covariance is right."""
    return np.asarray(np.einsum("mi,mi->m", errors, np.linalg.solve(covs, errors[..., None])[..., 0]))


def _most_likely(e: FloatArray, basis: FloatArray, start: FloatArray) -> tuple[FloatArray, float]:
    """Non-negative coefficients ``(p,)`` of covariances that maximize the likelihood of errors.

    Args:
        e: ``(m, 3)`` errors.
        basis: ``(m, p, 3, 3)`` what a unit of each coefficient adds to the covariance of each error.
        start: ``(p,)`` to start from, positive.

    Returns:
        The coefficients and the mean negative log-likelihood.
    """

    def loss(log_parameters: FloatArray) -> tuple[float, FloatArray]:
        parameters = np.exp(log_parameters)
        cov = np.tensordot(parameters, basis, axes=(0, 1)) + _MIN_STEP_VARIANCE * np.eye(3)
        inverse = np.linalg.inv(cov)
        white = (inverse @ e[:, :, None])[:, :, 0]
        value = 0.5 * (np.einsum("mi,mi->m", e, white) + np.linalg.slogdet(cov)[1]).mean()
        outer = inverse - white[:, :, None] * white[:, None, :]
        gradient = 0.5 * np.einsum("mij,mpij->p", outer, basis, optimize=True) / len(e) * parameters
        return float(value), gradient

    result = minimize(loss, np.log(start), jac=True, method="L-BFGS-B", bounds=[(-30.0, 10.0)] * len(start))
    return np.asarray(np.exp(result.x)), float(result.fun)


def _distinct(parts: list[FloatArray]) -> tuple[FloatArray, NDArray[np.intp]]:
    values, index = np.unique(np.concatenate(parts), return_inverse=True)
    return values, index


def _noise_bases(rollout: Rollout) -> list[FloatArray]:
    """Covariances ``(n, 3, 3)`` of the steps by one unit of each squared density, in the order of `NoiseDensity`."""
    distance, yaw = np.hypot(rollout.motions[:, 0], rollout.motions[:, 1]), np.abs(rollout.motions[:, 2])
    amounts = {"m": distance, "rad": yaw, "s": np.full(len(yaw), rollout.step_s)}
    axes = {"x": [0], "y": [1], "xy": [0, 1], "yaw": [2]}
    named = [(name.split("_", 1)[0], name.rsplit("_", 1)[1]) for name in _FIELDS]
    return [_diagonal(amounts[per], axes[axis]) for axis, per in named]


def _diagonal(values: FloatArray, axes: list[int]) -> FloatArray:
    out = np.zeros((len(values), 3, 3))
    for axis in axes:
        out[:, axis, axis] = values
    return out


def _rows(matrix: FloatArray) -> Matrix:
    x, y, yaw = map(se2.triple, matrix)
    return x, y, yaw


# --- Adaptation to another robot --------------------------------------------------------------------------------------

_STEP_S = 0.2


def adapted(
    tensors: Tensors, card: ModelCard, runs: list[Run], config: AdaptationConfig, window_s: float | None = None
) -> ModelCard:
    """Card with the kinematics that are most probable after these runs; the weights stay unchanged.

    Args:
        tensors: the model's weights.
        card: the model's card; its covariance says how much of an error is chance.
        runs: of the new robot.
        config: how much robots of a kind differ, and the windows that are compared.
        window_s: other windows than the configuration's.

    Raises:
        RecordingError: no window has truth throughout.
    """
    window_s = config.window_s if window_s is None else window_s

    def moved(parameters: FloatArray) -> ModelCard:
        v, omega, pull = (parameters * np.array(config.sigmas)).tolist()
        k = card.kinematics
        kinematics = k.model_copy(
            update={
                "scale_v": k.scale_v * math.exp(v),
                "scale_omega": k.scale_omega * math.exp(omega),
                "yaw_per_m": k.yaw_per_m + pull,
            }
        )
        return card.model_copy(update={"kinematics": kinematics})

    def residuals(parameters: FloatArray) -> FloatArray:
        model = model_of(tensors, moved(parameters))
        white = [_whitened(roll_model(model, run, _STEP_S), window_s) for run in runs]
        return np.concatenate([*white, parameters])

    if len(residuals(np.zeros(3))) == 3:
        raise RecordingError(f"the recordings hold no {window_s:.0f} s of unbroken truth to adapt to; give longer ones")
    return moved(least_squares(residuals, np.zeros(3)).x)


def _whitened(rollout: Rollout, window_s: float) -> FloatArray:
    """Errors ``(n,)`` over windows side by side, whitened by the covariances that the model predicts."""
    k, _ = rollout.starts(window_s, window_s)
    every, _ = rollout.starts(window_s)
    picked = np.isin(every, k)
    if not picked.any():
        return np.zeros(0)
    roots = np.linalg.cholesky(rollout.end_covs(window_s)[picked])
    return np.asarray(np.linalg.solve(roots, rollout.errors(window_s)[picked][..., None])).ravel()
