"""Constants of MRCLAM's robots, each robot's from the other robots only: ``fgloc convert mrclam SRC --fit``.

The response to commands and the sightings' constants are fitted for each robot against its truth, on the error of
2 s of driving and on the error of each sighting, with a Cauchy loss. Robot k's row holds the *median* over the other
four. Noise is what remains in the other four when each of them is predicted from the three left: so it holds the spread
between robots too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize, nnls

from fgloc import se2
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.mrclam_run import Calibration, Run

_STEP_S = 0.02
_HOLD_S = 1.1
_TRUTH_GAP_S = 0.2
_FIT_WINDOW_S, _FIT_STRIDE_S = 2.0, 0.5
_NOISE_WINDOW_S, _NOISE_STRIDE_S = 5.0, 2.5  # about the time between two fixes
_GROSS_RANGE_M, _GROSS_BEARING_RAD = 1.0, 0.15
_DENSITIES = (
    "x_per_sqrt_m",
    "y_per_sqrt_m",
    "yaw_per_sqrt_m",
    "xy_per_sqrt_rad",
    "yaw_per_sqrt_rad",
    "xy_per_sqrt_s",
    "yaw_per_sqrt_s",
)
_LEAST_DENSITY = np.array([0, 0, 0, 0, 0, 0.001, 0.002])  # at rest: the logs hardly show any, a bump would
_RESPONSE = ("scale_v", "scale_omega", "delay_s", "yaw_per_m")
_SENSOR = ("range_scale", "camera_x", "bearing_bias_rad", "latency_s")


def left_out(runs: Mapping[int, Run]) -> dict[int, Calibration]:
    """For each robot the constants that the other robots suggest; at least three robots."""
    drives = {k: _Drive(run) for k, run in runs.items()}
    response = {k: drive.fit() for k, drive in drives.items()}
    sensor = {k: fit_sensor(run) for k, run in runs.items()}
    return {k: _row(k, runs, drives, response, sensor) for k in runs}


def fit_sensor(run: Run) -> FloatArray:
    """Range scale, camera x [m], bearing bias [rad] and latency [s] of one robot's sightings ``(4,)``."""
    start = np.array([1.0, 0.0, 0.0, 0.04])
    used = _usable(run, start)

    def residuals(q: FloatArray) -> FloatArray:
        e = _all_errors(run, q)[used]
        return np.asarray((e[:, :2] / np.column_stack([0.008 * e[:, 2], np.full(len(e), 0.006)])).ravel())

    fit = least_squares(residuals, start, loss="cauchy", diff_step=1e-3, x_scale=[0.01, 0.05, 0.01, 0.05])
    return np.asarray(fit.x)


def sighting_errors(run: Run, sensor: FloatArray) -> FloatArray:
    """Range error [m], bearing error [rad] and true range [m] of the sightings that have a truth, without gross errors.

    Args:
        run: a robot's run.
        sensor: range scale, camera x, bearing bias, latency.
    """
    return np.asarray(_all_errors(run, sensor)[_usable(run, sensor)])


def _all_errors(run: Run, sensor: FloatArray) -> FloatArray:
    """As `sighting_errors`, of every sighting, across gaps of the truth too."""
    scale, camera_x, bias, latency = sensor
    at = run.sightings_ns - int(latency * 1e9)
    pose = se2.interpolate(run.truth_ns, run.truth, at)
    landmark = np.array([run.landmarks[int(i)] for i in run.subjects])
    d = landmark - pose[:, :2]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = c * d[:, 0] + s * d[:, 1] - camera_x, c * d[:, 1] - s * d[:, 0]
    bearing = run.sightings[:, 1] - bias
    range_error = run.sightings[:, 0] * scale / np.cos(bearing) - np.hypot(x, y)
    return np.column_stack([range_error, se2.wrap_array(bearing - np.arctan2(y, x)), np.hypot(x, y)])


def _usable(run: Run, sensor: FloatArray) -> NDArray[np.bool_]:
    errors = _all_errors(run, sensor)
    small = (abs(errors[:, 0]) < _GROSS_RANGE_M) & (abs(errors[:, 1]) < _GROSS_BEARING_RAD)
    return np.asarray(small & _has_truth(run.truth_ns, run.sightings_ns - int(sensor[3] * 1e9)))


def _row(
    k: int,
    runs: Mapping[int, Run],
    drives: Mapping[int, _Drive],
    response: Mapping[int, FloatArray],
    sensor: Mapping[int, FloatArray],
) -> Calibration:
    others = [j for j in runs if j != k]

    def without(table: Mapping[int, FloatArray], j: int) -> FloatArray:
        return np.median([table[i] for i in others if i != j], axis=0)

    drift = [drives[j].noise_samples(without(response, j)) for j in others]
    density = _densities(np.concatenate([e for e, _ in drift]), np.concatenate([m for _, m in drift], axis=1))
    density = np.maximum(density, _LEAST_DENSITY)
    seen = np.concatenate([sighting_errors(runs[j], without(sensor, j)) for j in others])
    growth, _ = nnls(np.column_stack([np.ones(len(seen)), seen[:, 2]]), 1.2533 * abs(seen[:, 0]))  # E|e| to sigma
    constants = {
        **dict(zip(_RESPONSE, without(response, k), strict=True)),
        **dict(zip(_DENSITIES, density, strict=True)),
        **dict(zip(_SENSOR, without(sensor, k), strict=True)),
        "range_sigma_m": max(growth[0], 0.02),
        "range_sigma_per_m": growth[1],
        "bearing_sigma_rad": _clipped_rms(seen[:, 1]),
    }
    return Calibration(**{name: float(f"{value:.4g}") for name, value in constants.items()})


class _Drive:
    """One robot's commands and truth on a common grid of time."""

    def __init__(self, run: Run) -> None:
        first = max(int(run.truth_ns[0]), int(run.commands_ns[0])) + 3_000_000_000
        last = min(int(run.truth_ns[-1]), int(run.commands_ns[-1])) - 1_000_000_000
        self._grid = np.arange(first, last, int(_STEP_S * 1e9), dtype=np.int64)
        self._truth = se2.interpolate(run.truth_ns, run.truth, self._grid)
        self._truth[:, 2] = np.unwrap(self._truth[:, 2])
        unknown = ~_has_truth(run.truth_ns, self._grid)
        self._unknown_before = np.concatenate([[0], np.cumsum(unknown)])
        self._driven = _held_integral(run.commands_ns, run.commands)

    def fit(self) -> FloatArray:
        """Gains of v and omega, delay [s] and yaw per metre [rad/m] ``(4,)``."""
        fit = least_squares(
            lambda q: (self.errors(q, _FIT_WINDOW_S, _FIT_STRIDE_S)[0] / [0.02, 0.02, 0.04]).ravel(),
            [0.95, 0.95, 0.2, 0.0],
            loss="cauchy",
            diff_step=1e-3,
            x_scale=[0.05, 0.05, 0.05, 0.02],
        )
        return np.asarray(fit.x)

    def errors(self, response: FloatArray, window_s: float, stride_s: float) -> tuple[FloatArray, IntArray, IntArray]:
        """Errors ``(n, 3)`` of the motion over windows, in the frame of their ends; where the windows begin and end."""
        poses = self._integrate(response)[0]
        begin, end = self._windows(window_s, stride_s)
        predicted, true = _relative(poses, begin, end), _relative(self._truth, begin, end)
        d = true - predicted
        c, s = np.cos(predicted[:, 2]), np.sin(predicted[:, 2])
        error = np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], se2.wrap_array(d[:, 2])])
        return error, begin, end

    def noise_samples(self, response: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Errors ``(n, 3)`` and, for each density, the covariance that its unit gives each window ``(7, n, 3, 3)``."""
        error, begin, end = self.errors(response, _NOISE_WINDOW_S, _NOISE_STRIDE_S)
        poses, v, omega = self._integrate(response)
        travelled = np.concatenate([[0.0], np.cumsum(abs(v) * _STEP_S)])
        turned = np.concatenate([[0.0], np.cumsum(abs(omega) * _STEP_S)])
        basis = np.zeros((len(_DENSITIES), len(begin), 3, 3))
        stride = 5
        for offset in range(0, int(end[0] - begin[0]), stride):
            a, b = begin + offset, np.minimum(begin + offset + stride, end)
            x, y, yaw = _relative(poses, a + stride // 2, end).T
            c, s = np.cos(yaw), np.sin(yaw)
            # Columns of Ad of the inverse motion to the window's end: what an error made here becomes there
            along = np.column_stack([c, -s, np.zeros_like(c)])
            across = np.column_stack([s, c, np.zeros_like(c)])
            turn = np.column_stack([s * x - c * y, c * x + s * y, np.ones_like(c)])
            xx, yy, tt = (e[:, :, None] * e[:, None, :] for e in (along, across, turn))
            metres, radians = travelled[b] - travelled[a], turned[b] - turned[a]
            seconds = (b - a) * _STEP_S
            parts = ((xx, metres), (yy, metres), (tt, metres), (xx + yy, radians), (tt, radians))
            for i, (shape, amount) in enumerate((*parts, (xx + yy, seconds), (tt, seconds))):
                basis[i] += shape * amount[:, None, None]
        return error, basis

    def _integrate(self, response: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        scale_v, scale_omega, delay, yaw_per_m = response
        ends = np.append(self._grid, self._grid[-1] + int(_STEP_S * 1e9)) - int(delay * 1e9)
        driven = np.diff(self._driven(ends), axis=0) / _STEP_S
        v = scale_v * driven[:, 0]
        omega = scale_omega * driven[:, 1] + yaw_per_m * v
        yaw = np.concatenate([[0.0], np.cumsum(omega * _STEP_S)])
        middle = 0.5 * (yaw[:-1] + yaw[1:])
        step = np.column_stack([v * np.cos(middle), v * np.sin(middle)]) * _STEP_S
        position = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
        return np.column_stack([position, yaw])[:-1], v, omega

    def _windows(self, window_s: float, stride_s: float) -> tuple[IntArray, IntArray]:
        n = round(window_s / _STEP_S)
        begin = np.arange(0, len(self._grid) - n, round(stride_s / _STEP_S), dtype=np.int64)
        begin = begin[self._unknown_before[begin + n] == self._unknown_before[begin]]
        return begin, begin + n


def _held_integral(stamps_ns: IntArray, values: FloatArray) -> Callable[[IntArray], FloatArray]:
    """Integral over time of values that hold until the next one, at most for a while; a function of the time."""
    dt = np.minimum(np.diff(stamps_ns) * 1e-9, _HOLD_S)
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * dt[:, None], axis=0)])
    origin = stamps_ns[0]
    start = (stamps_ns - origin) * 1e-9
    knots = np.column_stack([start[:-1], start[:-1] + dt]).ravel()
    at_knots = np.stack([total[:-1], total[1:]], axis=1).reshape(-1, values.shape[1])

    def integral(at_ns: IntArray) -> FloatArray:
        at = (at_ns - origin) * 1e-9
        return np.column_stack([np.interp(at, knots, column) for column in at_knots.T])

    return integral


def _has_truth(truth_ns: IntArray, at_ns: IntArray) -> NDArray[np.bool_]:
    after = np.clip(np.searchsorted(truth_ns, at_ns), 1, len(truth_ns) - 1)
    gap = (truth_ns[after] - truth_ns[after - 1]) * 1e-9
    return np.asarray((at_ns >= truth_ns[0]) & (at_ns <= truth_ns[-1]) & (gap < _TRUTH_GAP_S))


def _relative(poses: FloatArray, begin: IntArray, end: IntArray) -> FloatArray:
    """Motions ``(n, 3)`` between poses whose yaw is not wrapped."""
    d = poses[end] - poses[begin]
    c, s = np.cos(poses[begin, 2]), np.sin(poses[begin, 2])
    return np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0], d[:, 2]])


def _densities(errors: FloatArray, basis: FloatArray) -> FloatArray:
    """Densities ``(7,)`` under which the errors are likeliest (Gaussian), weakly drawn to 0.02 where nothing tells."""

    def cost(log_density: FloatArray) -> float:
        cov = np.tensordot(np.exp(2.0 * log_density), basis, 1) + 1e-10 * np.eye(3)
        nis = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(cov), errors)
        return float(0.5 * (np.linalg.slogdet(cov)[1] + nis).mean() + 1e-4 * ((log_density + 4.0) ** 2).sum())

    start = np.log([0.05, 0.01, 0.05, 0.01, 0.1, 0.002, 0.005])
    return np.asarray(np.exp(minimize(cost, start, method="L-BFGS-B", bounds=[(-9.0, 1.0)] * 7).x))


def _clipped_rms(errors: FloatArray) -> float:
    """RMS of errors, those beyond three robust sigmas counted as three: a robust kernel takes care of the rest."""
    limit = 3.0 * 1.4826 * np.median(abs(errors - np.median(errors))) + abs(np.median(errors))
    return float(np.sqrt((np.clip(errors, -limit, limit) ** 2).mean()))
