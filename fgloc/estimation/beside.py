"""Odometries beside the wheels during a run: read, compared with the other motion sources, left out while wrong.

Each is compared with what wheels, learned motion and gyro say together. Until it has been compared for some seconds of
driving it is not used: its covariance is not known yet. Then a source is left out

- where its own messages contradict each other (its pose jumps, or begins again at its origin),
- where its pose repeats exactly while the others moved: frozen,
- where the GLR test flags its difference to them (`fgloc.estimation.faults.GlrTest`), and sightings do not say that it
  is the wheels that are wrong.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fgloc import se2
from fgloc.config import WeightsConfig
from fgloc.estimation.faults import FaultAttribution, GlrTest
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import fuse_installed
from fgloc.graph.noise import COVARIANCE_FACTOR
from fgloc.sensors.odometry import BesideOdometry, BesideReading
from fgloc.types import FloatArray, MotionMeasurement, Step

_LEARNED_S = 5.0  # of driving, before a source is used: its covariance is known to a factor of two then
_MOVED_M, _MOVED_RAD = 0.1, 0.15  # that the others went while a pose repeated
_MOVES_M_S, _MOVES_RAD_S = 0.02, 0.05  # slower is no driving, by which a source could be compared
_STOOD = 0.25  # of the others' way: a source that went less stood still


@dataclass(slots=True)
class _State:
    """One source: the test of its difference, and how it has behaved so far."""

    test: GlrTest
    compared_s: float = 0.0
    still: FloatArray = field(default_factory=lambda: np.zeros(2))  # m, rad that the others went while it repeated ...
    still_steps: int = 0  # ... and for how many steps it has repeated
    differing_steps: int = 0  # of the running episode
    wheels_wrong: bool = False  # in the running episode, by sightings
    reason: str = ""  # of the running episode


@dataclass(frozen=True, slots=True)
class BesideVerdict:
    """Sources that are left out of the newest step with the reason, and of how many steps before it too."""

    rejected: dict[str, str] = field(default_factory=dict)
    span: int = 0


class OdometriesBeside:
    """All odometries beside the wheels.

    Attributes:
        flags: how often each was flagged, by "source.reason".
    """

    def __init__(
        self,
        config: WeightsConfig,
        sources: Sequence[BesideOdometry],
        factors: LandmarkFactors,
        attribution: FaultAttribution | None,
    ) -> None:
        """Set up for the sources of a run; ``attribution`` tells by sightings which source is wrong."""
        self.flags: Counter[str] = Counter()
        self._sources, self._factors, self._attribution = sources, factors, attribution
        self._states = {source.name: _State(GlrTest(config)) for source in sources}
        self._readings: dict[str, BesideReading] = {}

    def begin_segment(self) -> None:
        """Forget all messages, as nothing connects them with those to come."""
        for source in self._sources:
            source.reset()
            self._states[source.name].test.reset()

    def read(self, step: Step) -> tuple[MotionMeasurement, ...]:
        """Motion of each source that has been compared long enough, with its estimated covariance and constants."""
        self._readings, used = {}, []
        for source in self._sources:
            reading = source.read(step)
            if reading is None:
                continue
            motion = self._factors.installed(reading.motion, source.derivatives(step, reading.motion))
            reading = replace(reading, motion=motion)
            self._readings[source.name] = reading
            if self._states[source.name].compared_s >= _LEARNED_S:
                used.append(replace(reading.motion, cov=source.scale.factor * reading.motion.cov))
        return tuple(used)

    def judge(self, step: Step, others: Sequence[MotionMeasurement]) -> BesideVerdict:
        """Compare each source of the newest step with the factors of the other sources (none: nothing to compare)."""
        rejected: dict[str, str] = {}
        span = 0
        for source in self._sources:
            reading, state = self._readings.get(source.name), self._states[source.name]
            if reading is None:
                state.test.reset()
                continue
            if reading.wrong:
                rejected[source.name] = reading.wrong
                self.flags[f"{source.name}.{reading.wrong}"] += 1
                source.scale.interrupt()
                continue
            if not others or others[0].source == "unknown":
                continue
            name, why, since = self._compare(step, source, reading, state, others)
            if why:
                rejected[name] = why
                span = max(span, since)
        return BesideVerdict(rejected, span)

    def _compare(
        self,
        step: Step,
        source: BesideOdometry,
        reading: BesideReading,
        state: _State,
        others: Sequence[MotionMeasurement],
    ) -> tuple[str, str, int]:
        """Source that is wrong now, the reason ("": none is), and for how many steps that is news."""
        motion, cov, depends = fuse_installed(others)
        went = np.array([math.hypot(*motion[:2]), abs(motion[2])])
        own = reading.motion
        D = np.zeros((3, len(self._factors.installation)))
        for sign, by in ((-1.0, depends), (1.0, own.depends_on)):
            for name, (derivative, _) in by.items():
                if name in self._factors.installation.index:
                    D[:, self._factors.installation.index[name]] += sign * derivative
        known = self._factors.estimated.cov
        difference: FloatArray = se2.log(se2.between(motion, own.motion))
        learned = state.compared_s >= _LEARNED_S
        state.still = state.still + went if reading.repeats else np.zeros(2)
        state.still_steps = state.still_steps + 1 if reading.repeats else 0
        if (state.still > (_MOVED_M, _MOVED_RAD)).any():
            state.test.reset()
            source.scale.interrupt()
            return source.name, self._noted(source.name, state, "frozen"), state.still_steps
        moving = went[0] > _MOVES_M_S * step.dt or went[1] > _MOVES_RAD_S * step.dt
        verdict = None
        if learned:
            scaled = source.scale.factor * own.cov + cov
            verdict = state.test.judge(step.dt, difference, scaled, D, known)
        if (verdict is None or not verdict.flagged) and moving:
            source.scale.add(step.dt, difference, own.cov, cov + D @ known @ D.T)
            state.compared_s += step.dt
        if verdict is None or not verdict.flagged:
            state.reason, state.wheels_wrong = "", False
            return source.name, "", 0
        source.scale.interrupt()
        state.differing_steps = verdict.since or state.differing_steps + 1
        if state.wheels_wrong:
            return "wheels", "slip", 0
        found = None if self._attribution is None else self._attribution.contradicted(state.differing_steps)
        if found is not None and "wheels" in found.sources and source.name not in found.sources:
            state.wheels_wrong = True
            self.flags -= Counter({f"{source.name}.{state.reason}": 1})  # what it was taken for until now
            return "wheels", "slip", verdict.since or found.steps
        stood = np.hypot(*own.motion[:2]) < _STOOD * went[0] and abs(own.motion[2]) < max(_STOOD * went[1], 0.01)
        kind = state.reason or ("frozen" if stood else "jumped" if verdict.since == 1 else "deviates")
        return source.name, self._noted(source.name, state, kind), verdict.since

    def _noted(self, name: str, state: _State, reason: str) -> str:
        """The reason, which is counted once an episode."""
        if state.reason != reason:
            state.reason = reason
            self.flags[f"{name}.{reason}"] += 1
        return reason

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user: covariances that are too small, and sources that were not used."""
        compared = [source for source in self._sources if self._states[source.name].compared_s >= _LEARNED_S]
        found = [
            f"the covariance of {source.name} is taken times {source.scale.factor:.2g}, as it differs from the others"
            for source in compared
            if source.scale.factor > COVARIANCE_FACTOR
        ]
        found += [
            f"{source.name} was not used: it drove beside the other sources for less than {_LEARNED_S:g} s"
            for source in self._sources
            if source not in compared
        ]
        return tuple(found)
