"""Which motion sources are rejected, step by step, and since when."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field, replace

import numpy as np

from fgloc.config import WeightsConfig
from fgloc.graph.noise_budget import NoiseBudget
from fgloc.robust.glr_test import GlrTest
from fgloc.robust.motion_sources import MotionSources
from fgloc.robust.source_difference import source_difference
from fgloc.sensors import registry
from fgloc.types import FloatArray, MotionReadings, Step

_MOVED = 0.25  # of the reference source's travel: a wheel that turned less than this while it did more stood still
_LEAST_M = 0.03  # of a wheel's travel: less is no evidence
_EVIDENCE_S = 1.0  # of travel from which the kind of failure is determined


@dataclass(frozen=True, slots=True)
class FaultVerdict:
    """What the test makes of the motion sources.

    Attributes:
        budget: which of them are rejected and why, or the scale on their covariances.
        span: for how many of the newest steps, this one included, it holds.
        nis: of the difference of wheels and reference source over the least likely window; NaN without one.
        threshold: that ``nis`` is held against.
    """

    budget: NoiseBudget = field(default_factory=NoiseBudget)
    span: int = 1
    nis: float = math.nan
    threshold: float = math.nan


class MotionFaultMonitor:
    """Tests wheels against their reference source; known failures are taken as given.

    Attributes:
        flags: how often each source was flagged, by "source.reason".
    """

    def __init__(self, config: WeightsConfig, sources: MotionSources, track_m: float | None) -> None:
        """Set up.

        Args:
            config: thresholds, and known failures.
            sources: gives the difference of two readings with its covariance.
            track_m: distance of the wheels, to distinguish left from right; None: unknown.
        """
        self.flags: Counter[str] = Counter()
        self._config = config
        self._sources = sources
        self._track_m = track_m
        self._glr = GlrTest(config)
        self._travels: deque[tuple[float, FloatArray, FloatArray]] = deque()  # dt, motion of wheels and reference
        self._first_ns: int | None = None  # of the run
        self._reason = "slip"

    def begin(self, step: Step) -> None:
        """The first step of the run, or of a segment."""
        if self._first_ns is None:
            self._first_ns = step.start_ns
        self.reset()

    def reset(self) -> None:
        """Nothing connects what comes with what was."""
        self._glr.reset()
        self._travels.clear()

    def judge(self, step: Step, readings: MotionReadings) -> FaultVerdict:
        """Take in the readings of a step that follows the last one."""
        rejected = self._known_failures(step)
        if registry.motion_names().odometer in rejected:  # nothing to be found out
            self.reset()
        readings = replace(readings, **dict.fromkeys(rejected))
        difference = source_difference(readings, self._sources) if self._config.adaptive else None
        if difference is None:
            return FaultVerdict(NoiseBudget(rejected))
        verdict = self._glr.judge(
            step.dt, difference.value, difference.cov, difference.by_installation, difference.installation_cov
        )
        self._travelled(step.dt, readings)
        if not verdict.flagged:
            budget = NoiseBudget(rejected, verdict.scale)
            return FaultVerdict(budget, verdict.span, verdict.nis, verdict.bound)
        if verdict.since:
            self._reason = "slip"
        reason = self._failure(verdict.since)
        if verdict.since or reason != self._reason:
            self.flags[f"{registry.motion_names().odometer}.{reason}"] += 1
            if not verdict.since:  # the same failure, seen better now
                self.flags -= Counter({f"{registry.motion_names().odometer}.{self._reason}": 1})
            self._reason = reason
        budget = NoiseBudget({registry.motion_names().odometer: reason, **rejected})
        return FaultVerdict(budget, max(verdict.since, 1), verdict.nis, verdict.bound)

    def _known_failures(self, step: Step) -> dict[str, str]:
        start = (step.start_ns - (self._first_ns or 0)) * 1e-9
        end = start + step.dt
        return {d.source: "distrusted" for d in self._config.distrust if start < d.end_s and end > d.start_s}

    def _travelled(self, dt: float, readings: MotionReadings) -> None:
        reference = readings.learned or readings.gyro
        if readings.wheels is None or reference is None:
            return
        self._travels.append((dt, readings.wheels.motion, reference.motion))
        while sum(t for t, _, _ in self._travels) - self._travels[0][0] > _EVIDENCE_S:
            self._travels.popleft()

    def _failure(self, since: int) -> str:
        """What kind of failure it looks like: which wheel stood still while the robot went on."""
        newest = list(self._travels)[-since:] if since else list(self._travels)
        half = 0.5 * (self._track_m or 0.0)

        def sides(motion: FloatArray) -> FloatArray:
            return np.array([motion[0] - half * motion[2], motion[0] + half * motion[2]])

        by_wheels = sum((np.abs(sides(w)) for _, w, _ in newest), np.zeros(2))
        did = sum((np.abs(sides(n)) for _, _, n in newest), np.zeros(2))
        stood = (by_wheels < _MOVED * did) & (did > _LEAST_M)
        if stood.all():
            return "frozen"
        if self._track_m is None or not stood.any():
            return self._reason if not since else "slip"
        return "left_wheel_dead" if stood[0] else "right_wheel_dead"
