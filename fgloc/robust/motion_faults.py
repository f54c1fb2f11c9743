"""Which motion sources are rejected, step by step, and since when."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fgloc.config import WeightsConfig
from fgloc.graph.noise import NoiseBudget
from fgloc.robust.fault_attribution import Contradicted, FaultAttribution
from fgloc.robust.glr_test import GlrResult, GlrTest
from fgloc.robust.motion_sources import MotionSources
from fgloc.robust.source_difference import source_difference
from fgloc.sensors import registry
from fgloc.types import FloatArray, MotionReadings, Step

_MOVED = 0.25  # of the reference source's travel: a wheel that turned less stood still, one that lacks less turned
# Travel by the reference source from which a wheel is known to have turned or to have stood. Over a shorter way a robot
# slides on with its wheels at rest: 0.08 m from 0.4 m/s at a friction of 0.1.
_LEAST_M = 0.15
KNOWN = "distrusted"  # a failure that the configuration states
CONTRADICTED = "contradicted"  # by sightings: why a motion model is rejected


@dataclass(frozen=True, slots=True)
class FaultVerdict:
    """What the test makes of the motion sources.

    Attributes:
        budget: which of them are rejected and why, or the scale on their covariances.
        earlier: what was found out of the newest steps, this one included ...
        span: ... and of how many of them.
        nis: of the difference of wheels and reference source over the least likely window; NaN without one.
        threshold: that ``nis`` is held against.
    """

    budget: NoiseBudget = field(default_factory=NoiseBudget)
    earlier: NoiseBudget = field(default_factory=NoiseBudget)
    span: int = 1
    nis: float = math.nan
    threshold: float = math.nan


class MotionFaultMonitor:
    """Tests wheels against their reference source; known failures are taken as given.

    Where the two differ, wheels are taken to be wrong, unless sightings contradict the learned motion instead.

    Attributes:
        flags: how often wheels were flagged, by "source.reason".
        compared_s: for how long there was a motion model to be compared with the wheels [s] ...
        left_out_s: ... and for how long it was left out, as sightings contradict it.
    """

    def __init__(
        self,
        config: WeightsConfig,
        sources: MotionSources,
        track_m: float | None,
        attribution: FaultAttribution | None = None,
    ) -> None:
        """Set up.

        Args:
            config: thresholds, and known failures.
            sources: gives the difference of two readings with its covariance.
            track_m: distance of the wheels, to distinguish left from right; None: unknown.
            attribution: tells by sightings which of the two is wrong; None: always the wheels.
        """
        self.flags: Counter[str] = Counter()
        self.compared_s = self.left_out_s = 0.0
        self._config = config
        self._sources = sources
        self._attribution = attribution
        self._track_m = track_m
        self._glr = GlrTest(config)
        self._travels: deque[FloatArray] = deque()  # (5,): dt, ways of left and right wheel by wheels and by reference
        self._first_ns: int | None = None  # of the run
        self._wrong_before: dict[str, str] = {}  # as of the step before: sources, and why
        self._reason = "slip"  # of the wheels
        self._model_wrong_s = 0.0  # for how long the model is still left out
        self._tested_s = 0.0  # since a model that is left out was last tested
        self._differing_steps = 0  # for how many steps the two have differed

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
        readings = _without(readings, rejected)
        left_out = {registry.motion_names().model} if self._model_wrong_s > 0.0 else set()
        difference = None
        if self._config.adaptive:
            difference = source_difference(_without(readings, left_out), self._sources)
        verdict = GlrResult(False, 0, math.nan, math.nan)
        if difference is not None:
            verdict = self._glr.judge(
                step.dt, difference.value, difference.cov, difference.by_installation, difference.installation_cov
            )
            self._travelled(step.dt, readings)
        wrong, span = self._wrong_sources(step, readings, verdict)
        scale = 1.0 if verdict.flagged else verdict.scale
        self.compared_s += step.dt * (readings.learned is not None)
        self.left_out_s += step.dt * (registry.motion_names().model in wrong)
        budget, earlier = NoiseBudget({**wrong, **rejected}, scale), NoiseBudget(wrong if span else {}, scale)
        return FaultVerdict(budget, earlier, span or verdict.span, verdict.nis, verdict.bound)

    def _wrong_sources(self, step: Step, readings: MotionReadings, verdict: GlrResult) -> tuple[dict[str, str], int]:
        """The sources that are wrong with the reason, and of how many of the newest steps that is news."""
        names, since, was_left_out = registry.motion_names(), verdict.since, self._model_wrong_s > 0.0
        self._differing_steps = since or self._differing_steps + 1
        found = self._contradicted(step, readings, verdict)
        contradicted = frozenset() if found is None else found.sources
        if self._attribution is not None and names.model in contradicted:
            self._model_wrong_s = self._attribution.memory_s  # until it has agreed for as long: it mostly stays wrong
            if not was_left_out:
                self._glr.reset()  # wheels are compared with another source from now on
        elif found is not None:
            self._model_wrong_s = max(self._model_wrong_s - self._config.window_s, 0.0)
        if verdict.flagged:
            self._reason = self._failure(since)
        wrong = {names.model: CONTRADICTED} if self._model_wrong_s > 0.0 else {}
        by_default = verdict.flagged and (was_left_out or names.model not in contradicted)
        if names.odometer in contradicted or by_default:
            wrong[names.odometer] = self._reason
        before, self._wrong_before = self._wrong_before, wrong
        if verdict.flagged:
            self._count(before.get(names.odometer), wrong.get(names.odometer), since)
        news = names.odometer in contradicted or (names.model in contradicted and not was_left_out)
        if since or found is None or not news or before.keys() == wrong.keys():
            return wrong, since
        return wrong, found.steps

    def _contradicted(self, step: Step, readings: MotionReadings, verdict: GlrResult) -> Contradicted | None:
        """What sightings exclude; None: they cannot tell, or need not be asked.

        They are asked while wheels and learned motion differ; of a model that is left out, once every window.
        """
        if self._attribution is None or readings.learned is None:
            return None
        if self._model_wrong_s == 0.0:
            self._tested_s = 0.0
            return self._attribution.contradicted(self._differing_steps) if verdict.flagged else None
        self._tested_s += step.dt
        if self._tested_s < self._config.window_s:
            return None
        found = self._attribution.contradicted(None)
        if found is not None:
            self._tested_s = 0.0
        return found

    def _count(self, before: str | None, why: str | None, since: int) -> None:
        """Count a failure of the wheels that is new; one that is seen better now takes the place of the one before."""
        odometer = registry.motion_names().odometer
        if why is not None and (since or why != before):
            self.flags[f"{odometer}.{why}"] += 1
        if before is not None and not since and why != before:
            self.flags -= Counter({f"{odometer}.{before}": 1})

    def _known_failures(self, step: Step) -> dict[str, str]:
        start = (step.start_ns - (self._first_ns or 0)) * 1e-9
        end = start + step.dt
        return {d.source: KNOWN for d in self._config.distrust if start < d.end_s and end > d.start_s}

    def _travelled(self, dt: float, readings: MotionReadings) -> None:
        reference = readings.learned or readings.gyro
        if readings.wheels is None or reference is None:
            return
        self._travels.append(np.array([dt, *self._sides(readings.wheels.motion), *self._sides(reference.motion)]))
        total = np.sum(self._travels, axis=0)
        while len(self._travels) > 1 and (
            total[0] > self._config.window_s or (total[3:] - self._travels[0][3:] > _LEAST_M).all()
        ):
            total -= self._travels.popleft()

    def _failure(self, since: int) -> str:
        """What kind of failure it looks like: which wheel stood still while the robot went on, and which one turned."""
        if since:  # what was before is no evidence
            self._travels = deque(list(self._travels)[-since:])
        _, *ways = np.sum(self._travels, axis=0)
        by_wheels, did = np.reshape(ways, (2, 2))
        went = did > _LEAST_M
        stood, turned = went & (by_wheels < _MOVED * did), went & (by_wheels > (1.0 - _MOVED) * did)
        if stood.all():
            return "frozen"
        if self._track_m is not None and stood[0] and turned[1]:
            return "left_wheel_dead"
        if self._track_m is not None and stood[1] and turned[0]:
            return "right_wheel_dead"
        return "slip" if since else self._reason

    def _sides(self, motion: FloatArray) -> tuple[float, float]:
        """How far the left and the right wheel went [m]."""
        forward, turn = float(motion[0]), 0.5 * (self._track_m or 0.0) * float(motion[2])
        return abs(forward - turn), abs(forward + turn)


def _without(readings: MotionReadings, sources: Iterable[str]) -> MotionReadings:
    """The readings of the other sources."""
    gone: dict[str, Any] = dict.fromkeys(sources)
    return replace(readings, **gone)
