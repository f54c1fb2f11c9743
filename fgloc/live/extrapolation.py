"""Poses between and beyond keyframes: the newest estimate, propagated by the motion sources as the estimator would."""

from __future__ import annotations

import copy
import threading
from bisect import bisect_left, bisect_right, insort
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.config import Config
from fgloc.errors import FglocError
from fgloc.estimation.motion import MotionSources, source_difference
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.ground import predict, spatial
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import NoiseBudget
from fgloc.intake.clocks import ClockGuard, ClockVerdict
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.gyro import Attitude, Gyro
from fgloc.sensors.learned.network import JointCalibration
from fgloc.sensors.learned.sensor import LearnedMotion
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.stats import chi2_bound
from fgloc.types import (
    ControlEvent,
    Estimate,
    Event,
    FloatArray,
    Ground,
    InertialEvent,
    Mode,
    MotionEvent,
    MotionReadings,
    Step,
)

# --- Anchors: a keyframe's estimate, and the motion sources as they were then -----------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class MotionParts:
    """Parts of a run from which its motion sources are built. Can be pickled."""

    config: Config
    installation: Installation  # the parameters that motions may depend on
    joint: JointCalibration | None
    model: Any  # of the learned motion
    attitude: Attitude | None = None  # on uneven ground
    signals_back_ns: int = 0  # how far before a keyframe the learned motion reads measured signals


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """A keyframe to propagate from. Can be pickled."""

    segment: int
    stamp_ns: int
    belief: PoseWithCovariance  # with the installation of `MotionParts`
    known: InstallationEstimate  # likewise
    added_cov: FloatArray  # (3, 3) in the body frame, of what is reported beside the estimator's
    mode: Mode
    since_fix_s: float
    budget: NoiseBudget
    gyro: Gyro | None
    learned: LearnedMotion | None  # without its model, and without the events that it has read


class Outlet(Protocol):
    """Receiver of the results of a live run; called in its estimation thread."""

    def built(self, parts: MotionParts) -> None:
        """Handle that the parts of the run have been built, perhaps not for the first time."""
        ...

    def estimated(self, anchor: Anchor, estimate: Estimate) -> None:
        """Handle the estimate of a keyframe."""
        ...

    def failed(self, error: FglocError) -> None:
        """Handle that the run cannot go on."""
        ...


class Anchors:
    """Makes the anchors of a run's estimates.

    Attributes:
        parts: what goes with all of them.
    """

    def __init__(self, parts: Assembly) -> None:
        """Take the parts of the run."""
        installation = parts.localizer.factors.installation
        self._run = parts
        self._rows = installation.motion_rows
        sigmas = {installation.names[i]: float(installation.sigmas[i]) for i in self._rows}
        sources = parts.localizer.motion.sources
        learned = parts.learned
        self.parts = MotionParts(
            parts.config,
            Installation(sigmas),
            sources.rules.joint,
            None if learned is None else learned.model,
            sources.attitude,
            0 if learned is None else learned.signals_back_ns,
        )

    def make(self, step: Step, estimate: Estimate) -> Anchor:
        """Anchor of the estimate that the run's last step led to."""
        localizer = self._run.localizer
        estimator, installation = localizer.estimator, localizer.factors
        frame = estimator.log.keyframes.get(estimator.k)
        gyro, learned = localizer.motion.sources.gyro, self._run.learned
        body = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
        same_time = frame is not None and frame.stamp_ns == estimate.stamp_ns
        # Another pose is of the odometry that stands in for the estimate (`fgloc.diagnosis.sanity`), or in the frame of
        # a map that was moved (`fgloc.estimation.localizer.MapFrame`)
        if frame is not None and same_time and np.array_equal(frame.belief.pose, estimate.pose):
            belief = frame.belief
            known = belief.installation or installation.estimated
            budget = replace(frame.budget, overruled_cov=None)  # that is of one step alone
        else:
            belief, known = PoseWithCovariance(estimate.pose, body), installation.estimated
            budget = NoiseBudget()
        return Anchor(
            segment=step.segment,
            stamp_ns=estimate.stamp_ns,
            belief=self._of_motion(belief),
            known=self._belief_of_motion(known),
            added_cov=body - belief.cov,
            mode=estimate.mode,
            since_fix_s=localizer.tracking.since_fix_s,
            budget=budget,
            gyro=None if gyro is None else gyro.fork(),
            learned=None if learned is None else learned.fork(None, {}),
        )

    def _of_motion(self, belief: PoseWithCovariance) -> PoseWithCovariance:
        cross = None if belief.cross is None else belief.cross[:, self._rows]
        known = None if belief.installation is None else self._belief_of_motion(belief.installation)
        return PoseWithCovariance(belief.pose, belief.cov, cross, known)

    def _belief_of_motion(self, known: InstallationEstimate) -> InstallationEstimate:
        return InstallationEstimate(known.mean[self._rows], known.cov[np.ix_(self._rows, self._rows)])


# --- Extrapolation ----------------------------------------------------------------------------------------------------

HISTORY_S = 5.0  # poses further back than this are not given
_BEFORE_NS = 500_000_000  # motion events this long before a keyframe tell how it was moving then
_PIECE_NS = 1_000_000_000  # motion models are made for steps up to this
_FURTHEST_NS = 10_000_000_000  # beyond the newest message: nothing is known of the motion since

_CONTRADICTION = chi2_bound(0.99, 3)  # of wheels and learned motion; where they are rejected in error, little is lost
_MOST_EVENTS = 8192  # of one kind

_Events = Mapping[type[MotionEvent], Sequence[MotionEvent]]


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """An anchor, with wheels that have read the events which were asked for so far."""

    anchor: Anchor
    parts: MotionParts  # those of the run when it was made
    factors: LandmarkFactors  # of these parts; hold what is known of the installation
    wheels: WheelMotion

    @property
    def stamp_ns(self) -> int:
        return self.anchor.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class LivePose:
    """Pose ``T_map_base`` at a time, propagated by the motion sources from the last keyframe at or before it."""

    stamp_ns: int
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3) in the map frame
    mode: Mode
    keyframe_ns: int  # stamp of the keyframe that it was propagated from
    ground: Ground | None = None  # height, roll and pitch; None: the floor is flat


class Extrapolator:
    """Keeps the newest keyframes and motion events; thread-safe.

    Every question is answered anew from the events themselves: nothing that was extrapolated enters the estimate.
    """

    def __init__(self, config: Config) -> None:
        """Start without parts, anchors and events."""
        self._lock = threading.Lock()  # of what is kept
        self._asked = threading.Lock()  # of what carries on
        self._config = config
        self._parts: tuple[MotionParts, LandmarkFactors] | None = None
        self._history_ns = round(config.keyframes.history_s * 1e9)
        self._kept_ns = max(self._history_ns, _BEFORE_NS)
        self._clock = ClockGuard(config.gate)
        self._events: defaultdict[type[MotionEvent], list[MotionEvent]] = defaultdict(list)  # by class and stamp
        self._anchors: deque[_Held] = deque()
        self._segment = -1
        self._newest_ns = 0

    def begin(self, parts: MotionParts) -> None:
        """Use newly built parts of the run; earlier anchors are forgotten."""
        parts = replace(parts, model=copy.deepcopy(parts.model))  # it writes into buffers of its own
        with self._lock:
            self._kept_ns = max(self._history_ns, _BEFORE_NS, parts.signals_back_ns)
            self._parts = parts, LandmarkFactors(None, parts.installation)
            self._anchors.clear()

    def add(self, event: MotionEvent) -> None:
        """Add a motion event that passed the gate."""
        with self._lock:
            for verdict, judged in self._clock.judge(event):
                if verdict is ClockVerdict.OUTLIER:
                    continue
                if verdict is ClockVerdict.STARTS:
                    for events in self._events.values():
                        events.clear()
                    self._anchors.clear()
                    self._newest_ns = 0
                assert isinstance(judged, MotionEvent)
                insort(self._events[type(judged)], judged, key=_stamp)
                self._newest_ns = max(self._newest_ns, judged.stamp_ns)
            events = self._events[type(event)]
            if len(events) > _MOST_EVENTS:  # no keyframe has come for long
                del events[: _MOST_EVENTS // 2]

    def anchor(self, anchor: Anchor) -> None:
        """Propagate from this anchor from now on."""
        with self._lock:
            assert self._parts is not None
            if anchor.segment != self._segment:
                self._anchors.clear()
                self._segment = anchor.segment
            self._anchors.append(_Held(anchor, *self._parts, WheelMotion(self._config.wheels)))
            while self._anchors[0].stamp_ns < anchor.stamp_ns - HISTORY_S * 1e9:
                self._anchors.popleft()
            for events in self._events.values():
                del events[: max(bisect_right(events, self._anchors[0].stamp_ns - self._kept_ns, key=_stamp) - 1, 0)]

    def pose_at(self, stamp_ns: int | None) -> LivePose | None:
        """Pose at a time (None: at that of the newest motion event); None while no pose is known then."""
        with self._lock:
            if not self._anchors:
                return None
            newest = max(self._newest_ns, self._anchors[-1].stamp_ns)
            at_ns = newest if stamp_ns is None else stamp_ns
            k = bisect_right(self._anchors, at_ns, key=lambda a: a.stamp_ns) - 1
            if k < 0 or at_ns > newest + _FURTHEST_NS:
                return None
            held = self._anchors[k]
            step, past = self._step(held.anchor, at_ns), self._past(held)
        anchor = held.anchor
        with self._asked:
            belief, mode = self._carried(held, step, past), anchor.mode
        since_fix_s = anchor.since_fix_s + step.dt
        if mode is Mode.OK and since_fix_s > self._config.estimator.dead_reckoning_after_s:
            mode = Mode.DEAD_RECKONING
        cov = se2.rotate_cov(belief.cov + anchor.added_cov, float(belief.pose[2]))
        ground = spatial(belief, held.factors.installation, anchor.added_cov)
        return LivePose(at_ns, belief.pose, cov, mode, anchor.stamp_ns, ground)

    def _step(self, anchor: Anchor, end_ns: int) -> Step:
        """Step from the anchor to a time, with motion events from a while before it to the first one after its end."""
        start_ns = anchor.stamp_ns
        return Step(
            0,
            anchor.segment,
            start_ns,
            end_ns,
            {kind: self._window(kind, start_ns - self._back_ns(kind), end_ns) for kind in self._events},
        )

    def _past(self, held: _Held) -> _Events:
        """Events of the measured signals that the learned motion reads before the anchor, by class."""
        back_ns = held.parts.signals_back_ns
        if not back_ns:
            return {}
        return {kind: self._window(kind, held.stamp_ns - back_ns, held.stamp_ns) for kind in self._events}

    def _back_ns(self, kind: type[MotionEvent]) -> int:
        """Time before a step [ns] for which events of a class are used; 0 for the IMU's, integrated from end to end."""
        if issubclass(kind, ControlEvent):
            return self._history_ns
        return 0 if issubclass(kind, InertialEvent) else _BEFORE_NS

    def _window(self, kind: type[MotionEvent], start_ns: int, end_ns: int) -> tuple[MotionEvent, ...]:
        """Events inside in order of stamp, with the last one up to the start and the first one from the end on."""
        events = self._events[kind]
        first = max(bisect_right(events, start_ns, key=_stamp) - 1, 0)
        return tuple(events[first : bisect_left(events, end_ns, key=_stamp) + 1])

    def _carried(self, held: _Held, step: Step, past: _Events) -> PoseWithCovariance:
        anchor, parts, factors = held.anchor, held.parts, held.factors
        factors.estimated = anchor.known
        sensors = MotionSensors(
            held.wheels,
            None if anchor.learned is None or parts.model is None else anchor.learned.fork(parts.model, past),
            parts.joint,
            None if anchor.gyro is None else anchor.gyro.fork(),
            parts.attitude,
        )
        sources = MotionSources(self._config, sensors, factors)
        belief, start_ns = anchor.belief, step.start_ns
        while start_ns < step.stamp_ns:
            end_ns = min(start_ns + _PIECE_NS, step.stamp_ns)
            piece = _piece(step, start_ns, end_ns)
            readings = sources.read(piece, anchor.since_fix_s + (start_ns - step.start_ns) * 1e-9)
            budget = _without_slip(anchor.budget, readings, sources)
            motions = budget.combine(readings, sources.rules) or [sources.unknown(piece, readings)]
            known = anchor.known if belief.installation is None else belief.installation
            belief = predict(belief, known, factors.installation, motions)
            start_ns = end_ns
        return belief


def _without_slip(budget: NoiseBudget, readings: MotionReadings, sources: MotionSources) -> NoiseBudget:
    """Noise budget without the wheels if they contradict the learned motion: a slip that began after the keyframe.

    The test that flags slips (`MotionFaultMonitor`) sees whole steps only.
    """
    if readings.learned is None or not sources.learned_is_independent or "learned" in budget.rejected:
        return budget
    difference = source_difference(readings, sources)
    if difference is None:
        return budget
    d, D = difference.value, difference.by_installation
    cov = difference.cov * max(budget.scale, 1.0) + D @ difference.installation_cov @ D.T
    if float(d @ np.linalg.solve(cov, d)) <= _CONTRADICTION:
        return budget
    return replace(budget, rejected={**budget.rejected, "wheels": "slip"})


def _stamp(event: Event) -> int:
    return event.stamp_ns


def _piece(step: Step, start_ns: int, end_ns: int) -> Step:
    """Part of a step with all of its events but those of the IMU, which are integrated from end to end."""
    if (start_ns, end_ns) == (step.start_ns, step.stamp_ns):
        return step
    motion = dict(step.motion)
    for kind, events in step.motion.items():
        if issubclass(kind, InertialEvent):
            first = max(bisect_right(events, start_ns, key=_stamp) - 1, 0)
            motion[kind] = events[first : bisect_left(events, end_ns, key=_stamp) + 1]
    return Step(0, step.segment, start_ns, end_ns, motion)
