"""Events of one recording on their way to steps and estimates, and what is noted on the way."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator

from fgloc.assembly import Assembly
from fgloc.intake.topic_activity import TopicActivity
from fgloc.intake.topic_clocks import TopicClocks
from fgloc.recording.reader import Recording
from fgloc.recording.truth import TruthTrack
from fgloc.replay.options import EventFilter, Progress, RunOptions
from fgloc.sensors.markers.detector import Detector, detect_stream
from fgloc.types import Decision, Estimate, Event, RawEvent, SensorEvent, SightingsEvent, Step, TopicTimes, TruthEvent


class Replay:
    """Events of one recording on their way to steps, and what is noted on the way."""

    def __init__(
        self,
        parts: Assembly,
        recording: Recording,
        detector: Detector | None,
        progress: Progress | None,
        options: RunOptions,
        causal: bool = False,
    ) -> None:
        """Take the parts of a run; ``causal``: what is given is what was known then, and is checked on the way."""
        self._parts = parts
        self._detector = detector
        self._causal = causal
        self._duration_s = recording.duration_s
        self._progress = progress
        self._pace = options.get("pace")
        self._on_step = options.get("on_step")
        self._events: EventFilter = options.get("events") or iter
        self._sightings: EventFilter = options.get("sightings") or iter
        self._image_rejections: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._first_step_ns: int | None = None
        self.first_pose_s: float | None = None
        self.no_landmark_sensor = True  # no image and no sighting was recorded, not even an unusable one
        self.activity = TopicActivity(recording.roles)
        self.clocks = TopicClocks()
        self.truth = TruthTrack(parts.config.truth, parts.config.gate.clock_back_s)
        self.estimates: list[Estimate] = []
        self.decisions: list[Decision] = []
        self.step_ms: list[float] = []

    def steps(self, events: Iterator[Event]) -> Iterator[Step]:
        """Gate, detect and cut into steps."""
        if self._detector is None:
            gated = self._gated(self._sightings(events))
        else:
            found = detect_stream(self._gated(events), self._detector, self._image_rejections)
            gated = self._regated(self._sightings(found))
        for event in gated:
            self.activity.record(event.topic, event.stamp_ns)
            self._parts.diagnosis.add(event)
            yield from self._parts.stepper.push(event)
        yield from self._parts.stepper.flush()

    def run(self, events: Iterator[Event]) -> None:
        """Localise, step by step."""
        for step in self.steps(self._events(events)):
            start = time.perf_counter()
            estimate = self._parts.localizer.update(step)
            by_hand = self._parts.localizer.motion.is_carried
            checked = self._parts.sanity.observe(step, estimate, by_hand=by_hand)
            estimate = checked if self._causal else estimate
            self.record(step, estimate, (time.perf_counter() - start) * 1e3)
            self._parts.diagnosis.observe(step, by_hand)
            if self._on_step is not None:
                self._on_step(step, estimate)

    def record(self, step: Step, estimate: Estimate | None, milliseconds: float) -> None:
        """Note one step's outcome."""
        self.step_ms.append(milliseconds)
        if self._first_step_ns is None:
            self._first_step_ns = step.stamp_ns
        if estimate is None:
            return
        if self.first_pose_s is None:
            self.first_pose_s = (step.stamp_ns - self._first_step_ns) * 1e-9
        self.estimates.append(estimate)
        self.decisions.extend(estimate.decisions)

    def make_up(self, estimates: list[Estimate]) -> None:
        """Note what only the end of the run made possible; it replaces nothing that was reported before."""
        self.decisions.extend(d for estimate in estimates for d in estimate.decisions)
        if not self.estimates:
            self.estimates = estimates

    def rejections(self) -> Counter[str]:
        """Everything rejected anywhere, by reason."""
        total = self._parts.rejections
        total.update(self._image_rejections)
        return total

    def spans(self, origin_ns: int = 0) -> dict[str, TopicTimes]:
        """When each topic had messages, in seconds from a time."""
        return self.activity.spans(origin_ns)

    def _gated(self, events: Iterator[Event]) -> Iterator[Event]:
        began = time.perf_counter()
        for event in self.clocks.corrected(events):
            if self._first_ns is None:
                self._first_ns = event.received_ns
            elapsed = (event.received_ns - self._first_ns) * 1e-9
            if self._pace is not None:
                time.sleep(max(0.0, elapsed / self._pace - (time.perf_counter() - began)))
            if self._progress is not None:
                self._progress(elapsed, self._duration_s)
            self.no_landmark_sensor = self.no_landmark_sensor and not isinstance(
                event, RawEvent | SightingsEvent | SensorEvent
            )
            passed = self._parts.gate.check(event)
            if isinstance(passed, TruthEvent):
                self.truth.add(passed)
                self.activity.present(passed.topic)
            elif passed is not None:
                yield passed

    def _regated(self, events: Iterator[Event]) -> Iterator[Event]:
        """Pass what the detector found through the gate."""
        for event in events:
            if isinstance(event, RawEvent):
                continue
            passed = self._parts.detections.check(event) if isinstance(event, SightingsEvent) else event
            if passed is not None:
                yield passed
