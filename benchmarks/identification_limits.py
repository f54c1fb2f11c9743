"""Limits of MRCLAM's commands: rows of `benchmarks.identification`, and why its one-step errors have long tails.

The latency of each clear change of the turn command (the command steady for 0.4 s before and after) follows from the
yaw that the robot turned around it. It spreads evenly over a quarter of a second, unrelated to the latency before, to
gaps and to any fixed period: as of a driver that picks up the newest command now and then. ``limits.period_s`` is the
width of that spread (twice its interquartile range). ``limits.yaw_10s_deg`` and ``limits.kurtosis`` are the yaw error
over 10 s, and the excess kurtosis of that over 0.2 s, of the best possible predictor of such a robot: the same commands
picked up at other instants, against their mean. Neither depends on a model.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import kurtosis

from benchmarks.common import Row
from fgloc.types import FloatArray
from fgloc_datasets import mrclam

_GAIN = 0.93  # of the turn command
_CLEAR = 0.15  # rad/s, a change of command
_STEADY, _STEADY_S = 0.05, 0.4  # rad/s that the command may vary within this time before and after
_BEFORE_S, _AFTER_S = 0.1, 0.6  # the yaw is taken this long before and after a change
_DRAWS = 12
_GRID_S = 0.02


def measure(recorded: dict[str, mrclam.Run]) -> Iterator[Row]:
    """Yield the rows; means and spreads are over the robots."""
    rng = np.random.default_rng(0)
    periods, yaws, tails = [], [], []
    for run in recorded.values():
        times = (run.commands_ns - run.commands_ns[0]) * 1e-9
        low, high = np.percentile(_latencies(run, times), [25, 75])
        periods.append(2.0 * float(high - low))
        drawn = np.array([_turned(times, run.commands[:, 1], periods[-1], rng) for _ in range(_DRAWS)])
        yaws.append(float(np.degrees(np.abs(_apart(drawn, 10.0)).mean())))
        tails.append(float(kurtosis(_apart(drawn, 0.2).ravel())))
    for name, values, unit in (("period_s", periods, "s"), ("yaw_10s_deg", yaws, "deg"), ("kurtosis", tails, "")):
        yield Row(f"limits.{name}", float(np.mean(values)), float(np.std(values)), len(values), unit)


def _latencies(run: mrclam.Run, times: FloatArray) -> FloatArray:
    """Latency [s] of each clear change of the turn command."""
    truth_s, yaw = (run.truth_ns - run.commands_ns[0]) * 1e-9, np.unwrap(run.truth[:, 2])
    told, found = run.commands[:, 1], []
    for i in np.flatnonzero(np.abs(np.diff(told)) > _CLEAR):
        at, before, after = times[i + 1], told[i], told[i + 1]
        near = (times > at - _STEADY_S) & (times < at + _STEADY_S)
        expected = np.where(times[near] < at, before, after)
        if np.abs(told[near] - expected).max() > _STEADY or not truth_s[0] + 1.0 < at < truth_s[-1] - 1.0:
            continue
        turned = float(np.diff(np.interp([at - _BEFORE_S, at + _AFTER_S], truth_s, yaw))[0])
        found.append((before * _BEFORE_S + after * _AFTER_S - turned / _GAIN) / (after - before))
    return np.array(found)


def _turned(times: FloatArray, told: FloatArray, period_s: float, rng: np.random.Generator) -> FloatArray:
    """Yaw over time of a robot that picks up the newest command once a period, at any instant of it."""
    instants = np.arange(0.0, times[-1], period_s)
    instants += rng.uniform(0.0, period_s, len(instants)) + rng.uniform(0.0, period_s)
    picked = told[np.clip(np.searchsorted(times, instants, "right") - 1, 0, None)]
    grid = np.arange(0.0, times[-1], _GRID_S)
    held = picked[np.clip(np.searchsorted(instants, grid, "right") - 1, 0, None)]
    return np.asarray(np.cumsum(_GAIN * held) * _GRID_S)


def _apart(drawn: FloatArray, horizon_s: float) -> FloatArray:
    """Differences ``(draws, m)`` of the draws' turns over windows from their mean."""
    steps = round(horizon_s / _GRID_S)
    starts = np.arange(0, drawn.shape[1] - steps, round(1.0 / _GRID_S))
    turns = drawn[:, starts + steps] - drawn[:, starts]
    return np.asarray(turns - turns.mean(axis=0))
