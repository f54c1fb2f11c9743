"""Poses between and beyond keyframes: the newest estimate, carried on by the motion sources as the estimator would."""

from __future__ import annotations

import copy
import threading
from bisect import bisect_left, bisect_right, insort
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.graph.installation import InstallationBelief
from fgloc.graph.joint import predict
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.intake.clock_guard import ClockGuard, ClockVerdict
from fgloc.live.status import LivePose
from fgloc.robust.motion_fusion import MotionFusion
from fgloc.sensors.gyro.rate import Gyro
from fgloc.sensors.learned.source import LearnedMotion
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent, Estimate, Event, FloatArray, InertialEvent, Mode, MotionEvent, Step

HISTORY_S = 5.0  # poses further back than this are not told
_BEFORE_NS = 500_000_000  # motion events this long before a keyframe tell how it was moving then
_PIECE_NS = 1_000_000_000  # motion models are made for steps up to this
_FURTHEST_NS = 10_000_000_000  # beyond the newest message: nothing is known of the motion since
_MOST_EVENTS = 8192  # of one kind


@dataclass(frozen=True, slots=True, eq=False)
class _Anchor:
    """A keyframe to carry on from: the estimate, and the motion sources as they were then."""

    stamp_ns: int
    belief: PoseWithCovariance
    known: InstallationBelief
    added_cov: FloatArray  # (3, 3) in the body frame, of what is reported beside the estimator's
    mode: Mode
    blind_s: float
    off: Mapping[str, str]
    scale: float
    gyro: Gyro | None
    learned: LearnedMotion | None
    wheels: WheelMotion  # has read the events that were asked for so far


class Extrapolator:
    """Keeps the newest keyframes and motion events; thread-safe.

    Every question is answered anew from the events themselves: nothing that was extrapolated enters the estimate.
    """

    def __init__(self, parts: Assembly) -> None:
        """Take the parts of the run."""
        self._lock = threading.Lock()  # of what is kept
        self._asked = threading.Lock()  # of the model
        self._parts = parts
        self._model = None if parts.learned is None else copy.deepcopy(parts.learned.model)
        self._config = parts.config
        self._history_ns = round(parts.config.keyframes.history_s * 1e9)
        self._kept_ns = max(self._history_ns, _BEFORE_NS)
        self._clock = ClockGuard(parts.config.gate)
        self._events: defaultdict[type[MotionEvent], list[MotionEvent]] = defaultdict(list)  # by class and stamp
        self._anchors: deque[_Anchor] = deque()
        self._segment = -1
        self._newest_ns = 0

    def add(self, event: MotionEvent) -> None:
        """Take in a motion event that passed the gate."""
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

    def anchor(self, step: Step, estimate: Estimate) -> None:
        """Carry on from here."""
        localizer = self._parts.localizer
        estimator, installation = localizer.estimator, localizer.factors
        frame = estimator.log.keyframes.get(estimator.k)
        gyro, learned = localizer.sources.gyro, self._parts.learned
        body = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
        if frame is not None and frame.stamp_ns == estimate.stamp_ns:
            belief = frame.belief
            known = belief.installation or installation.believed
            off, scale = frame.off, frame.scale
        else:
            belief, known, off, scale = PoseWithCovariance(estimate.pose, body), installation.believed, {}, 1.0
        made = _Anchor(
            stamp_ns=estimate.stamp_ns,
            belief=belief,
            known=known,
            added_cov=body - belief.cov,
            mode=estimate.mode,
            blind_s=localizer.blind_s,
            off=off,
            scale=scale,
            gyro=None if gyro is None else gyro.fork(),
            wheels=WheelMotion(self._config.wheels),
            learned=None if learned is None or self._model is None else learned.fork(self._model),
        )
        with self._lock:
            if step.segment != self._segment:
                self._anchors.clear()
                self._segment = step.segment
            self._anchors.append(made)
            while self._anchors[0].stamp_ns < made.stamp_ns - HISTORY_S * 1e9:
                self._anchors.popleft()
            for events in self._events.values():
                del events[: max(bisect_right(events, self._anchors[0].stamp_ns - self._kept_ns, key=_stamp) - 1, 0)]

    def pose_at(self, stamp_ns: int | None) -> LivePose | None:
        """The pose at a time; None: of the newest motion event. None is returned while no pose is known then."""
        with self._lock:
            if not self._anchors:
                return None
            newest = max(self._newest_ns, self._anchors[-1].stamp_ns)
            at_ns = newest if stamp_ns is None else stamp_ns
            k = bisect_right(self._anchors, at_ns, key=lambda a: a.stamp_ns) - 1
            if k < 0 or at_ns > newest + _FURTHEST_NS:
                return None
            anchor = self._anchors[k]
            step = self._step(anchor.stamp_ns, at_ns)
        with self._asked:
            belief, mode = self._carried(anchor, step), anchor.mode
        blind_s = anchor.blind_s + step.dt
        if mode is Mode.OK and blind_s > self._config.estimator.dead_reckoning_after_s:
            mode = Mode.DEAD_RECKONING
        cov = se2.rotate_cov(belief.cov + anchor.added_cov, float(belief.pose[2]))
        return LivePose(at_ns, belief.pose, cov, mode, anchor.stamp_ns)

    def _step(self, start_ns: int, end_ns: int) -> Step:
        """All motion events from a while before the start to the first one after the end."""
        return Step(
            0,
            0,
            start_ns,
            end_ns,
            {kind: self._window(kind, start_ns - self._back_ns(kind), end_ns) for kind in self._events},
        )

    def _back_ns(self, kind: type[MotionEvent]) -> int:
        """How far before a step its events are of use: those of an inertial unit are integrated from end to end."""
        if issubclass(kind, ControlEvent):
            return self._history_ns
        return 0 if issubclass(kind, InertialEvent) else _BEFORE_NS

    def _window(self, kind: type[MotionEvent], start_ns: int, end_ns: int) -> tuple[MotionEvent, ...]:
        """In order of stamp: events inside, the last one at or before the start, the first one at or after the end."""
        events = self._events[kind]
        first = max(bisect_right(events, start_ns, key=_stamp) - 1, 0)
        return tuple(events[first : bisect_left(events, end_ns, key=_stamp) + 1])

    def _carried(self, anchor: _Anchor, step: Step) -> PoseWithCovariance:
        parts, localizer = self._parts, self._parts.localizer
        sources = MotionFusion(
            self._config,
            anchor.wheels,
            None if anchor.learned is None else anchor.learned.fork(anchor.learned.model),
            localizer.sources.joint,
            None if anchor.gyro is None else anchor.gyro.fork(),
            localizer.factors,
        )
        belief, start_ns = anchor.belief, step.start_ns
        while start_ns < step.stamp_ns:
            end_ns = min(start_ns + _PIECE_NS, step.stamp_ns)
            piece = _piece(step, start_ns, end_ns)
            readings = sources.read(piece, anchor.blind_s + (start_ns - step.start_ns) * 1e-9)
            motions = sources.combine(readings, anchor.off, anchor.scale) or [sources.unknown(piece, readings)]
            belief = predict(belief, anchor.known, parts.localizer.factors.installation, motions)
            start_ns = end_ns
        return belief


def _stamp(event: Event) -> int:
    return event.stamp_ns


def _piece(step: Step, start_ns: int, end_ns: int) -> Step:
    """A part of a step with all of its events but those of the IMU, which are integrated from end to end."""
    if (start_ns, end_ns) == (step.start_ns, step.stamp_ns):
        return step
    motion = dict(step.motion)
    for kind, events in step.motion.items():
        if issubclass(kind, InertialEvent):
            first = max(bisect_right(events, start_ns, key=_stamp) - 1, 0)
            motion[kind] = events[first : bisect_left(events, end_ns, key=_stamp) + 1]
    return Step(0, 0, start_ns, end_ns, motion)
