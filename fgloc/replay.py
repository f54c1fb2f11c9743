"""One recording through the loop: options of a run, its events on their way to steps and estimates, batch smoothing."""

from __future__ import annotations

import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypedDict

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.config import Role
from fgloc.graph.batch import BatchSmoother, Smoothed, of_whole_run
from fgloc.graph.contradictions import Contradiction, as_given, smoothed_within_priors, spread
from fgloc.graph.ground import ground_at
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.intake.clocks import TopicClocks
from fgloc.recording.reader import Recording
from fgloc.recording.truth import TruthTrack
from fgloc.sensors.markers.detector import Detector, detect_stream
from fgloc.types import (
    Decision,
    Estimate,
    Event,
    FloatArray,
    Ground,
    LandmarkMap,
    RawEvent,
    SensorEvent,
    SightingsEvent,
    Step,
    TopicTimes,
    TruthEvent,
)

# --- Options of a run -------------------------------------------------------------------------------------------------

RunMode = Literal["batch", "online"]
Progress = Callable[[float, float], None]
"""Called with seconds of the recording done, and its length."""
EventFilter = Callable[[Iterator[Event]], Iterator[Event]]
"""Changes, drops, adds or delays events; what comes after it does not know."""


class RunOptions(TypedDict, total=False):
    """Further options of `run`, by keyword.

    Attributes:
        pace: replay at this multiple of real time; None: as fast as possible.
        on_step: called after each step (online displays, benchmarks).
        events: filter of the recorded events (ablations).
        sightings: likewise, of the events once the markers are found: after detection, without images on the recorded.
        detections: file that remembers what was found in the images, for other runs of the same ones.
        check: look for gross mistakes of the set-up first, and run with those undone that are sure; afterwards, where a
            clock seems to be wrong, run again with it corrected, to see whether it is. True if not given; not done on
            filtered events.
    """

    pace: float | None
    on_step: Callable[[Step, Estimate | None], None] | None
    events: EventFilter | None
    sightings: EventFilter | None
    detections: Path | None
    check: bool


# --- When topics had messages -----------------------------------------------------------------------------------------

_MOST = 100_000  # times kept of a topic; of more, every second is dropped


class TopicActivity:
    """Records when messages came. An expected topic without any hints at a mismatch that no error reports.

    Example:
        >>> activity = TopicActivity({"imu": "/imu", "odometry": "/odom"})
        >>> activity.record("/odom", 1_000_000_000)
        >>> [sentence.split(":")[0] for sentence in activity.missing()]
        ['/imu (imu)']
    """

    def __init__(self, expected: Mapping[Role, str]) -> None:
        """Begin without messages; ``expected``: topic of each role that is to be used."""
        self._expected = dict(expected)
        self._topics: dict[str, _Times] = {}
        self._without = set(expected.values())

    def record(self, topic: str, stamp_ns: int) -> None:
        """Record a message that could be used."""
        times = self._topics.get(topic)
        if times is None:
            times = self._topics[topic] = _Times()
            self._without.discard(topic)
        times.add(stamp_ns)

    def present(self, topic: str) -> None:
        """Record that a topic has messages, without their times."""
        self._without.discard(topic)

    def missing(self) -> tuple[str, ...]:
        """A sentence for each expected topic without a usable message so far.

        A live adapter asks this once the streams should have begun (a few seconds after subscribing), and again at the
        end.
        """
        return tuple(
            f"{topic} ({role}): no usable message has arrived. It is not published, all of its messages were rejected, "
            "or (live, and when recording) the quality of service does not match: subscribe with reliability "
            "best effort and durability volatile."
            for role, topic in self._expected.items()
            if topic in self._without
        )

    def spans(self, origin_ns: int) -> dict[str, TopicTimes]:
        """When each topic had messages, in seconds from a time."""
        return {topic: times.since(origin_ns) for topic, times in sorted(self._topics.items())}


class _Times:
    """Stamps of one topic: all, until they are too many."""

    def __init__(self) -> None:
        self._kept = array("q")
        self._every = 1
        self._count = 0
        self._newest = 0
        self._longest = 0

    def add(self, stamp_ns: int) -> None:
        if self._count and stamp_ns > self._newest:
            self._longest = max(self._longest, stamp_ns - self._newest)
        self._newest = max(self._newest, stamp_ns)
        if self._count % self._every == 0:
            self._kept.append(stamp_ns)
        self._count += 1
        if len(self._kept) > _MOST:
            self._kept = self._kept[::2]
            self._every *= 2

    def since(self, origin_ns: int) -> TopicTimes:
        seconds = np.asarray((np.array(self._kept, dtype=np.int64) - origin_ns) * 1e-9, dtype=np.float64)
        return TopicTimes(seconds, self._count, self._every, self._longest * 1e-9)


# --- Replay -----------------------------------------------------------------------------------------------------------


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
        """Use the parts of a run; ``causal``: estimates are those known at the time, checked on the way."""
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
        self._image_role = partial(parts.config.recording.topics.role_on, base="image")
        self._first_ns: int | None = None
        self.first_step_ns: int | None = None
        self.first_pose_s: float | None = None
        # a sensor that is not built, as a setting of it is missing, tells no place
        self._seeing = RawEvent | SightingsEvent | SensorEvent if parts.sensors else RawEvent | SightingsEvent
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
            found = detect_stream(self._gated(events), self._detector, self._image_rejections, self._image_role)
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
        if self._progress is not None:  # the last message is somewhat before the end
            self._progress(self._duration_s, self._duration_s)

    def record(self, step: Step, estimate: Estimate | None, milliseconds: float) -> None:
        """Note the outcome and the time [ms] of one step."""
        self.step_ms.append(milliseconds)
        if self.first_step_ns is None:
            self.first_step_ns = step.stamp_ns
        if estimate is None:
            return
        if self.first_pose_s is None:
            self.first_pose_s = (step.stamp_ns - self.first_step_ns) * 1e-9
        self.estimates.append(estimate)
        self.decisions.extend(estimate.decisions)

    def make_up(self, estimates: list[Estimate]) -> None:
        """Add estimates that only the end of the run made possible; they replace none that was reported before."""
        self.decisions.extend(d for estimate in estimates for d in estimate.decisions)
        if not self.estimates:
            self.estimates = estimates

    def rejections(self) -> Counter[str]:
        """Everything rejected anywhere, by reason."""
        total = self._parts.rejections
        total.update(self._image_rejections)
        return total

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
            self.no_landmark_sensor = self.no_landmark_sensor and not isinstance(event, self._seeing)
            passed = self._parts.gate.check(event)
            if isinstance(passed, TruthEvent):
                self.truth.add(passed)
                self.activity.present(passed.topic)
            elif passed is not None:
                if isinstance(passed, RawEvent):  # it arrived, even if none of its markers is on the map
                    self.activity.present(passed.topic)
                yield passed

    def _regated(self, events: Iterator[Event]) -> Iterator[Event]:
        """Pass what the detector found through the gate."""
        for event in events:
            if isinstance(event, RawEvent):
                continue
            passed = self._parts.detections.check(event) if isinstance(event, SightingsEvent) else event
            if passed is not None:
                yield passed


# --- Smoothing --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedRun:
    """Estimates at every keyframe, with the modes they had online, and what else came out."""

    estimates: list[Estimate]
    landmarks: LandmarkMap | None  # given or estimated
    notes: tuple[str, ...]
    parameters: Installation
    installation: InstallationEstimate  # of these
    cost: float
    contradiction: Contradiction | None = None  # constants that are not used as they were found


def smooth_run(parts: Assembly) -> SmoothedRun:
    """Smooth a run that was replayed with ``keep_all``.

    Args:
        parts: the run's parts; the localizer's log is read.

    Raises:
        EstimatorError: the graph cannot be solved.
    """
    localizer, config = parts.localizer, parts.config
    log = localizer.estimator.log
    probability = config.estimator.gate_probability
    factors = of_whole_run(log, localizer.factors)
    solver, contradiction = smoothed_within_priors(log, factors, config.batch, probability)
    result, installed = solver.result(), solver.installed()
    if contradiction is not None:
        # a view of `ground_covs`, where there is one
        result.covs[:] += spread(result.poses, contradiction.rivals or ())
        installed = as_given(installed, factors.installation, contradiction.names)
    added = log.added_covs()
    grounds = _ground(solver, result, added)
    estimates = [
        Estimate(frame.stamp_ns, pose, se2.rotate_cov(cov + more, float(pose[2])), frame.mode, (), ground)
        for frame, pose, cov, more, ground in zip(solver.frames, result.poses, result.covs, added, grounds, strict=True)
    ]
    landmarks = parts.landmark_map
    if landmarks is None and result.landmarks:
        landmarks = LandmarkMap(result.landmarks, source="estimated")
    notes = (f"Batch: {len(estimates)} keyframes, cost {result.error:.1f}.",)
    return SmoothedRun(estimates, landmarks, notes, factors.installation, installed, solver.cost(), contradiction)


def _ground(solver: BatchSmoother, result: Smoothed, added: Sequence[FloatArray]) -> Iterator[Ground | None]:
    """Ground of each keyframe; None: the floor is flat."""
    if result.ground is None or result.ground_covs is None:
        yield from (None for _ in solver.frames)
        return
    for frame, pose, ground, cov, more in zip(
        solver.frames, result.poses, result.ground, result.ground_covs, added, strict=True
    ):
        whole = cov.copy()
        whole[:3, :3] += more
        found = ground_at(ground, whole, float(pose[2]))
        by_clock = frame.ground_clock_cov
        yield found if by_clock is None else replace(found, cov=found.cov + by_clock)
