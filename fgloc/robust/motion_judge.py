"""Which motion enters the graph: the sources are read, tested against each other, and combined to factors.

Three things can be wrong with a motion, each with its own test: a source is faulty (`MotionFaultMonitor`), the robot
is carried (`LiftMonitor`), or sightings agree on a place nearby that the motion did not lead to
(`JudgedMotion.overruled`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from fgloc.config import Config
from fgloc.graph.estimators import Estimator
from fgloc.graph.measurement_log import Keyframe, PoseWithCovariance
from fgloc.graph.noise import COVARIANCE_FACTOR, NoiseBudget
from fgloc.robust.decision_log import flag_notes, motion_decisions
from fgloc.robust.fault_attribution import FaultAttribution
from fgloc.robust.lift import LiftMonitor
from fgloc.robust.motion_faults import KNOWN, FaultVerdict, MotionFaultMonitor
from fgloc.robust.motion_sources import MotionSources
from fgloc.sensors import registry
from fgloc.sensors.equipment import MotionSensors
from fgloc.types import Decision, FloatArray, MotionMeasurement, MotionReadings, Step

_CARRIED = "carried"  # why nothing of a robot that was lifted enters


@dataclass(frozen=True, slots=True, eq=False)
class JudgedMotion:
    """The motion over one step as it enters the graph.

    Attributes:
        factors: independent of each other; at least one.
        readings: what they were made of, to make them anew; empty if the robot was carried.
        budget: the noise that they were made with.
        verdict: on the sources, back to the onset of a fault.
        revisions: rows of ``steps.csv`` of earlier steps whose motion was combined anew.
    """

    factors: tuple[MotionMeasurement, ...]
    readings: MotionReadings
    budget: NoiseBudget
    verdict: FaultVerdict
    revisions: tuple[Decision, ...] = ()

    def overruled(self, cov: FloatArray) -> JudgedMotion:
        """The motion where sightings found it to be wrong: ``cov (3, 3)`` is added to each factor."""
        budget = replace(self.budget, overruled_cov=cov)
        return replace(self, factors=tuple(budget.overruled(m) for m in self.factors), budget=budget)

    def decisions(self, k: int) -> list[Decision]:
        """Rows of ``steps.csv``, with those of earlier steps first."""
        return motion_decisions(k, self.factors, self.readings, self.budget, self.verdict)


class MotionJudge:
    """Reads the motion sources of each step and decides what of them enters the graph.

    Attributes:
        sources: wheels, learned motion, gyro.
        rejections: steps without a usable motion, by reason.
    """

    def __init__(self, config: Config, sensors: MotionSensors, estimator: Estimator) -> None:
        """Take the sensors, and the estimator whose past motions are revised."""
        self.sources = MotionSources(config, sensors, estimator.factors)
        self.rejections: Counter[str] = Counter()
        self._estimator = estimator
        attribution = FaultAttribution(config, estimator) if self.sources.learned_is_independent else None
        self._faults = MotionFaultMonitor(config.weights, self.sources, sensors.wheels.track_m, attribution)
        self._lift = LiftMonitor(config.estimator.lag_s, None if sensors.gyro is None else sensors.gyro.up)
        self._signs: list[Decision] = []  # of a lift, in the newest step

    def begin_segment(self, step: Step) -> None:
        """The clock jumped, or this is the first step: nothing connects it to what was before."""
        self.sources.begin_segment()
        self._faults.begin(step)
        self._lift.reset()

    def begin_replay(self) -> None:
        """What comes next are earlier steps of the segment, collected until the first pose was known."""
        self.sources.begin_segment()
        self._lift.reset()

    def restart(self) -> None:
        """The pose was set anew: no motion led there."""
        self.sources.begin_segment()
        self._faults.reset()

    def read(self, step: Step, since_fix_s: float) -> MotionReadings:
        """Read every source once; one without data yields nothing.

        Args:
            step: the newest one.
            since_fix_s: time before it without a fix.
        """
        readings = self.sources.read(step, since_fix_s)
        self._signs = self._lift.observe(self._estimator.k + 1, step, readings)
        return readings

    def combine(
        self, step: Step, readings: MotionReadings, budget: NoiseBudget | None = None
    ) -> list[MotionMeasurement]:
        """Factors of a step: of the sources, or of a robot that is carried, or of one whose motion nothing measures."""
        if self._lift.carried:
            return [self.sources.unknown(step, readings, self._lift.carried_s(step))]
        made = (budget or NoiseBudget()).combine(readings, self.sources.rules)
        return made or [self.sources.unknown(step, readings)]

    def judge(self, step: Step, readings: MotionReadings) -> JudgedMotion:
        """Test the sources against each other, back to where they began to differ, and combine what is left of them."""
        verdict = self._faults.judge(step, readings)
        revisions = self._revise(verdict)
        factors = tuple(self.combine(step, readings, verdict.budget))
        if self._lift.carried:
            return JudgedMotion(factors, MotionReadings(), _carried(), verdict, revisions)
        if factors[0].source == "unknown":
            self.rejections["motion.silent"] += 1
        return JudgedMotion(factors, readings, verdict.budget, verdict, revisions)

    def commit(self, motion: JudgedMotion, fix: PoseWithCovariance | None, observes_yaw: bool) -> None:
        """The robot went on by a step: see `MotionSources.commit`."""
        if fix is not None:
            self.record_fix()
        self.sources.commit(motion.readings, fix, observes_yaw)

    def record_fix(self) -> None:
        """Sightings, or a given pose, tell where the robot is."""
        self._lift.fix()

    @property
    def is_carried(self) -> bool:
        """Whether the robot may be in the air, or was set down a short time ago."""
        return self._lift.carried

    def take_signs(self) -> list[Decision]:
        """Rows of ``steps.csv`` for signs of a lift in the newest step; each is given once."""
        signs, self._signs = self._signs, []
        return signs

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know of the sources, one sentence each."""
        return (*self._model_notes(), *flag_notes(self._faults.flags))

    @property
    def mistakes(self) -> tuple[str, ...]:
        """The sentence on a motion model that sightings contradict most of the time."""
        return self._model_notes() if self._faults.left_out_s > 0.5 * self._faults.compared_s else ()

    def _model_notes(self) -> tuple[str, ...]:
        left_out_s = self._faults.left_out_s
        return (registry.motion_model().left_out(left_out_s),) if left_out_s > 0.0 else ()

    def _revise(self, verdict: FaultVerdict) -> tuple[Decision, ...]:
        """Combine the motion of earlier steps anew, back to where the sources began to differ.

        Wheels that are wrong are left out; before that is certain, covariances are scaled.
        """
        if not verdict.earlier.rejected and verdict.earlier.scale < COVARIANCE_FACTOR:
            return ()
        log, newest = self._estimator.log.keyframes, self._estimator.k
        changed: dict[int, Sequence[MotionMeasurement]] = {}
        decisions: list[Decision] = []
        frames = (log[i] for i in range(newest - verdict.span + 2, newest + 1) if i in log)
        for frame in (f for f in frames if f.prior is None):
            revised = _revised(frame, verdict.earlier)
            if revised is None:
                continue
            frame.budget = revised
            if motions := revised.combine(frame.readings, self.sources.rules):
                changed[frame.k] = motions
                decisions += motion_decisions(frame.k, motions, frame.readings, revised, verdict)
        self._estimator.revise(changed)
        return tuple(decisions)


def _carried() -> NoiseBudget:
    names = registry.motion_names()
    return NoiseBudget({names.odometer: _CARRIED, names.model: _CARRIED})


def _revised(frame: Keyframe, now: NoiseBudget) -> NoiseBudget | None:
    """The budget of an earlier step by what is known now; None: it stays."""
    before = frame.budget
    if now.rejected:
        known = {name: why for name, why in before.rejected.items() if why in (KNOWN, _CARRIED)}
        if {**now.rejected, **known}.keys() == before.rejected.keys():
            return None
        return replace(before, rejected={**now.rejected, **known})
    if now.scale >= COVARIANCE_FACTOR * max(before.scale, 1.0):
        return replace(before, scale=now.scale)
    return None
