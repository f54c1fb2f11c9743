"""Scores of one run with adaptive weights: errors, consistency, detected slip, named markers, recovery."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.adaptive_recordings import Recorded, slip_intervals
from fgloc import se2
from fgloc.ablation.failures import Kidnap, MovedMarker
from fgloc.config import Config
from fgloc.evaluation.metrics import Metrics, compute_metrics
from fgloc.runner import RunResult
from fgloc.sensors.failures import Failure
from fgloc.sensors.markers.images import CornersEvent
from fgloc.types import Decision, Event, FloatArray, Mode

_NOT_FOUND_BY_MOTION = {"", "distrusted", "overruled by sightings"}  # reasons that no detector gave
_NAMED = re.compile(r"[Mm]arker (\d+) does not stand where the map has it")
_LINGER_S = 0.5  # a slip that is flagged so long after its end was still found
_WINDOW_S = 2.0  # a flag may be of a slip, however short, so long before it: the detector's window
_STEP_S = 0.45  # flagged steps closer than this are of one flag
_OFF_M, _OFF_RAD = 0.3, 0.2  # nearer to the truth than this, a kidnapped robot is found again ...
_STAYS_S = 1.0  # ... if it stays so for this long


@dataclass(frozen=True, slots=True)
class Slips:
    """Detections of the slip detector in one run.

    Attributes:
        delays_s: from the true onset to the flag, of each slip that was found.
        found_m: distance that the wheels slipped, of each slip that was found.
        missed_m: likewise, of each that was not.
        false_alarms: flags without any slip in the detector's window.
        path_m: distance travelled.
    """

    delays_s: tuple[float, ...]
    found_m: tuple[float, ...]
    missed_m: tuple[float, ...]
    false_alarms: int
    path_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Figures:
    """Figures of one run; where no pose was ever found the errors are infinite."""

    seed: int
    ate_m: float  # mean distance from the truth, online
    yaw_deg: float
    nees_over_3: float
    batch_ate_m: float  # NaN if it was not smoothed
    batch_nees_over_3: float
    step_ms: FloatArray  # of the steps after the first pose
    named: frozenset[int]  # markers that the run named as moved
    moved: frozenset[int]  # those that do not
    slips: Slips | None
    found_again_s: float | None  # of a kidnapped robot
    rejections: Mapping[str, int]


def lost(seed: int) -> Figures:
    """Figures of a run that never found its first pose."""
    inf = float("inf")
    return Figures(seed, inf, inf, inf, inf, inf, np.zeros(0), frozenset(), frozenset(), None, None, {})


def score(
    recorded: Recorded,
    seed: int,
    config: Config,
    online: RunResult,
    batch: RunResult | None,
    chain: Sequence[Failure],
    events: Sequence[Event],
) -> Figures:
    """Figures of a run.

    Args:
        recorded: what was replayed.
        seed: of the failures.
        config: of the run.
        online: the estimates as they were made, with all decisions.
        batch: the smoothed run, if there is one.
        chain: the failures.
        events: that the localizer was given; only the sightings are looked at.
    """
    kidnapped = [failure.when.intervals[0][0] for failure in chain if isinstance(failure, Kidnap)]
    metrics = compute_metrics(online, config)
    smoothed = compute_metrics(batch, config) if batch is not None else None
    return Figures(
        seed=seed,
        ate_m=_known(metrics.ate_mean_m),
        yaw_deg=_known(metrics.yaw_mae_deg),
        nees_over_3=_known(metrics.nees_over_3),
        batch_ate_m=_batch(smoothed, "ate_mean_m"),
        batch_nees_over_3=_batch(smoothed, "nees_over_3"),
        step_ms=online.step_ms[len(online.step_ms) - len(online.trajectory) + 1 :],
        named=frozenset(int(i) for note in online.notes for i in _NAMED.findall(note)),
        moved=frozenset(i for failure in chain if isinstance(failure, MovedMarker) for i in failure.ids),
        slips=slips(recorded, online),
        found_again_s=found_again(recorded, online, kidnapped[0], events) if kidnapped else None,
        rejections=online.rejections,
    )


def slips(recorded: Recorded, online: RunResult) -> Slips:
    """Slips found and missed, and false alarms, by the flags and the simulator's slip."""
    rises = flags(recorded, online.decisions)
    true = slip_intervals(recorded)
    delays, found, missed = [], [], []
    for start, end in true:
        inside = (recorded.slip_s >= start) & (recorded.slip_s <= end)
        way = float(np.trapezoid(np.abs(recorded.slip[inside, 0]), recorded.slip_s[inside]))
        raised = [max(rise - start, 0.0) for rise, fall in rises if fall >= start and rise <= end + _LINGER_S]
        if raised:
            delays.append(min(raised))
            found.append(way)
        else:
            missed.append(way)
    slipping = recorded.slip_s[recorded.slipping]
    false = sum(not ((slipping > rise - _WINDOW_S) & (slipping <= fall)).any() for rise, fall in rises)
    return Slips(tuple(delays), tuple(found), tuple(missed), false, recorded.path_m)


def flags(recorded: Recorded, decisions: Sequence[Decision]) -> list[tuple[float, float]]:
    """Times [s from the start] at which the wheels were rejected, as other motion sources contradicted them.

    A flag counts from the step that raised it, not from the earlier ones that it revised.
    """
    raised, newest = [], 0
    for d in decisions:
        if d.kind != "wheels" or d.stamp_ns <= newest:
            continue  # an earlier step that is judged again
        newest = d.stamp_ns
        if d.reason not in _NOT_FOUND_BY_MOTION:
            raised.append(newest)
    out: list[tuple[float, float]] = []
    for stamp in raised:
        t = (stamp - recorded.start_ns) * 1e-9
        if out and t - out[-1][1] <= _STEP_S:
            out[-1] = (out[-1][0], t)
        else:
            out.append((t, t))
    return out


def found_again(recorded: Recorded, online: RunResult, kidnapped_s: float, events: Sequence[Event]) -> float:
    """Time [s] from the first marker after the robot was carried away until the estimate is right and stays so.

    If that never happens: until the end of the run; 0 if it sees no marker any more.
    """
    at_ns = recorded.start_ns + round(kidnapped_s * 1e9)
    sightings = (e.stamp_ns for e in events if isinstance(e, CornersEvent) and e.sightings and e.stamp_ns > at_ns)
    seen = min(sightings, default=None)
    if seen is None:
        return 0.0
    assert online.truth is not None
    truth = se2.interpolate(online.truth.stamps_ns, online.truth.poses, online.trajectory.stamps_ns)
    error = online.trajectory.poses - truth
    near = (np.hypot(*error[:, :2].T) < _OFF_M) & (np.abs(se2.wrap_array(error[:, 2])) < _OFF_RAD)
    near &= np.array([mode is not Mode.LOST for mode in online.modes])
    stamps = online.trajectory.stamps_ns
    bad = [int(a) for a, good in zip(stamps, near, strict=True) if a >= seen and not good]
    runs = [seen - 1, *bad, int(stamps[-1])]  # between two bad estimates lies a stretch of good ones
    for a, b in pairwise(runs):
        if b - a > _STAYS_S * 1e9:
            return (int(stamps[np.searchsorted(stamps, a, side="right")]) - seen) * 1e-9
    return float(stamps[-1] - seen) * 1e-9


def _batch(metrics: Metrics | None, name: str) -> float:
    return float("nan") if metrics is None else _known(getattr(metrics, name))


def _known(value: float | None) -> float:
    if value is None:
        raise ValueError("the run and the truth have no time in common; nothing can be compared")
    return value
