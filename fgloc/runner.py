"""One run: a recording goes in, a RunResult comes out. Batch replays the events and then smooths; online does not."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypedDict, Unpack

import numpy as np

from fgloc.assembly import Assembly, assemble
from fgloc.calibration.clock_trials import clock_note, clock_trials
from fgloc.calibration.contradictions import contradictions
from fgloc.calibration.found import found_values
from fgloc.calibration.settings import installation_found
from fgloc.config import Config, Role
from fgloc.diagnosis.gross_mistakes import Mistakes, find_mistakes
from fgloc.diagnosis.image_checks import image_hints
from fgloc.diagnosis.unused_sightings import unused_sightings
from fgloc.errors import EstimatorError
from fgloc.intake.topic_activity import TopicActivity
from fgloc.intake.topic_clocks import TopicClocks
from fgloc.recording.reader import Recording, open_recording
from fgloc.recording.truth import TruthTrack
from fgloc.sensors.markers.detector import Detector, detect_stream
from fgloc.sensors.markers.events import CornersEvent, ImageEvent
from fgloc.sensors.markers.remembered import RememberedDetections
from fgloc.sensors.markers.tracking import TrackingDetector
from fgloc.smoothing import SmoothedRun, smooth_run
from fgloc.timing import one_blas_thread
from fgloc.types import (
    Decision,
    Estimate,
    Event,
    InstallationFound,
    RunResult,
    SensorEvent,
    SightingsEvent,
    Step,
    TopicTimes,
    Trajectory,
    TruthEvent,
)

RunMode = Literal["batch", "online"]
Progress = Callable[[float, float], None]
"""Called with seconds of the recording done, and its length."""
EventFilter = Callable[[Iterator[Event]], Iterator[Event]]
"""Changes, drops, adds or delays events; what comes after it does not know."""


class RunOptions(TypedDict, total=False):
    """What `run` takes besides, by keyword.

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


@one_blas_thread
def run(
    recording_path: Path,
    map_path: Path | None,
    config: Config,
    mode: RunMode,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Localise one recording.

    Args:
        recording_path: any bag that `open_recording` reads.
        map_path: marker map; None: landmarks are estimated too.
        config: all settings.
        mode: "batch" smooths after the replay; "online" keeps the filtered estimates.
        progress: called now and then.
        options: as `RunOptions` has them.

    Raises:
        FglocError: the input cannot be used, or no pose was ever found.
    """
    began = time.perf_counter()
    check = options.get("check", True) and options.get("events") is None and options.get("sightings") is None
    wrong = find_mistakes(recording_path, map_path, config) if check else Mistakes((), config)
    config = wrong.config
    with open_recording(recording_path, config.recording) as recording:
        parts = assemble(recording, map_path, config, mode == "batch" or map_path is None, wrong.landmark_map)
        replay = _replayed(recording, parts, mode, wrong, progress, options)
        outcome = _Outcome.of(recording, parts, replay, wrong)
    if not replay.estimates:
        raise EstimatorError(outcome.failed(_never_found(replay, outcome.rejections)))
    smoothed = _smoothed(parts, outcome) if mode == "batch" else None
    all_estimates = replay.estimates if smoothed is None else smoothed.estimates
    estimates = last_pass(all_estimates)
    installed = parts.localizer.estimator.installed if smoothed is None else smoothed.installation
    found, tried = installation_found(parts, outcome.roles, installed), None
    if check and not wrong.sentences and options.get("on_step") is None:
        trials = clock_trials(found, parts.diagnosis.clock_offsets(parts.wheels.source), config)
        tried = clock_note(trials, config, partial(_tried, recording_path, map_path, options.get("detections")))
    notes = _notes(wrong, outcome, smoothed, len(all_estimates) - len(estimates), *(tried or (None, found)))
    result = _result(parts, replay, outcome, estimates, smoothed)
    return replace(
        result,
        notes=notes,
        source=recording_path,
        config=config,
        found=found,
        wall_s=time.perf_counter() - began,
    )


def _notes(
    wrong: Mistakes,
    outcome: _Outcome,
    smoothed: SmoothedRun | None,
    left_out: int,
    tried: str | None,
    found: InstallationFound,
) -> tuple[str, ...]:
    """What the user should know, as sentences, the gravest first."""
    notes = (
        *outcome.mistakes[len(wrong.sentences) :],
        *wrong.notes,
        *(() if tried is None else (tried,)),
        *outcome.notes,
        *(() if smoothed is None else smoothed.notes),
        *_left_out(left_out),
        *contradictions(found),
    )
    return tuple(dict.fromkeys(map(_sentence, notes)))


def _replayed(
    recording: Recording,
    parts: Assembly,
    mode: RunMode,
    wrong: Mistakes,
    progress: Progress | None,
    options: RunOptions,
) -> _Replay:
    """Run all events through the localizer."""
    memory, file = None, options.get("detections")
    if parts.detector is not None:
        # What a file remembers must not depend on which images came before.
        detector = TrackingDetector(parts.detector) if file is None else parts.detector
        memory = RememberedDetections(file, detector, wrong.detections, note=file is not None)
    replay = _Replay(parts, recording, memory, progress, options)
    replay.run(recording.events())
    if mode == "batch" or not replay.estimates:
        replay.make_up(parts.localizer.finish(replay.blind))
    if memory is not None:
        memory.save()
    return replay


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What the replay found besides poses: read while the recording is open.

    Attributes:
        roles: topics by role.
        rejections: everything refused anywhere, by reason.
        mistakes: of the set-up, gross and sure; before the run and after it.
        hints: what surely does not fit together.
        untried: what seems to be wrong with the clocks, and was not tried.
        notes: what the user should know of the replay.
    """

    roles: Mapping[Role, str]
    rejections: Counter[str]
    mistakes: tuple[str, ...]
    hints: tuple[str, ...]
    untried: tuple[str, ...]
    notes: tuple[str, ...]

    @classmethod
    def of(cls, recording: Recording, parts: Assembly, replay: _Replay, wrong: Mistakes) -> _Outcome:
        """Collect it from the parts of a run."""
        hints, untried = _hints(recording, parts, replay)
        notes = (*hints, *recording.notes, *replay.clocks.notes, *parts.sentences)
        rejections = replay.rejections()
        rejections.update({f"undecodable.{k}": v for k, v in recording.undecodable.items()})
        seen = sum(decision.landmark_id >= 0 for decision in replay.decisions)
        mistakes = (*wrong.sentences, *unused_sightings(rejections, recording.roles, seen))
        return cls(recording.roles, rejections, mistakes, tuple(hints), tuple(untried), notes)

    def failed(self, why: str) -> str:
        """Message of a run that failed: what is wrong with the set-up, why it failed, what may be the cause."""
        return " ".join([*self.mistakes, why, *self.hints, *self.untried])


def _smoothed(parts: Assembly, outcome: _Outcome) -> SmoothedRun:
    try:
        return smooth_run(parts)
    except EstimatorError as error:
        raise EstimatorError(outcome.failed(_sentence(str(error)))) from error


def _result(
    parts: Assembly,
    replay: _Replay,
    outcome: _Outcome,
    estimates: list[Estimate],
    smoothed: SmoothedRun | None,
) -> RunResult:
    """The result of the replay and the smoothing; `run` adds the rest."""
    installed = parts.localizer.estimator.installed if smoothed is None else smoothed.installation
    return RunResult(
        trajectory=_trajectory(estimates),
        modes=tuple(e.mode for e in estimates),
        decisions=tuple(replay.decisions),
        counts=dict(parts.localizer.counts),
        rejections=dict(sorted(outcome.rejections.items())),
        notes=(),
        step_ms=np.array(replay.step_ms),
        wall_s=0.0,
        truth=replay.truth.trajectory(),
        landmarks=parts.landmark_map if smoothed is None else smoothed.landmarks,
        spans=replay.spans(),
        installation=found_values(
            parts.localizer.factors.installation, installed, parts.config, parts.camera, parts.landmark_map
        ),
        cost=None if smoothed is None else smoothed.cost,
        first_pose_s=replay.first_pose_s,
        mistakes=outcome.mistakes,
    )


def _hints(recording: Recording, parts: Assembly, replay: _Replay) -> tuple[list[str], list[str]]:
    """What does not fit together: surely, and what of the clocks is still to be tried."""
    hints = [*parts.diagnosis.notes(parts.wheels.source, offsets=False), *replay.activity.missing()]
    untried = [note for note in parts.diagnosis.notes(parts.wheels.source) if note not in hints]
    if parts.detector is not None and not parts.localizer.counts["corners"]:
        hints = [*image_hints(recording, parts.detector)[0], *hints]
    return hints, untried


def _left_out(poses: int) -> Iterator[str]:
    if poses:
        yield f"The clock jumped back: {poses} poses whose times came again are left out."


def _tried(recording: Path, map_path: Path | None, detections: Path | None, config: Config) -> RunResult:
    return run(recording, map_path, config, "batch", detections=detections, check=False)


class _Replay:
    """Events of one recording on their way to steps, and what is noted on the way."""

    def __init__(
        self,
        parts: Assembly,
        recording: Recording,
        detector: Detector | None,
        progress: Progress | None,
        options: RunOptions,
    ) -> None:
        self._parts = parts
        self._detector = detector
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
        self.blind = True  # no image and no sighting was recorded, not even an unusable one
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
            yield from self._parts.stepper.push(event)
        yield from self._parts.stepper.flush()

    def run(self, events: Iterator[Event]) -> None:
        """Localise, step by step."""
        for step in self.steps(self._events(events)):
            start = time.perf_counter()
            estimate = self._parts.localizer.update(step)
            self.record(step, estimate, (time.perf_counter() - start) * 1e3)
            self._parts.diagnosis.observe(step, self._parts.wheels.measure(step))
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
        """Note what only the end of the run made possible; it replaces nothing that was told before."""
        self.decisions.extend(d for estimate in estimates for d in estimate.decisions)
        if not self.estimates:
            self.estimates = estimates

    def rejections(self) -> Counter[str]:
        """Everything refused anywhere, by reason."""
        total = self._parts.rejections
        total.update(self._image_rejections)
        return total

    def spans(self) -> dict[str, TopicTimes]:
        """When each topic was heard, from the first estimate on."""
        return self.activity.spans(self.estimates[0].stamp_ns if self.estimates else 0)

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
            self.blind = self.blind and not isinstance(event, ImageEvent | SightingsEvent | SensorEvent)
            passed = self._parts.gate.check(event)
            if isinstance(passed, TruthEvent):
                self.truth.add(passed)
                self.activity.present(passed.topic)
            elif passed is not None:
                yield passed

    def _regated(self, events: Iterator[Event]) -> Iterator[Event]:
        """Pass what the detector found through the gate."""
        for event in events:
            if isinstance(event, ImageEvent):
                continue
            passed = self._parts.detections.check(event) if isinstance(event, CornersEvent) else event
            if passed is not None:
                yield passed


def _sentence(note: str) -> str:
    """With a capital, unless it begins with a name (of a topic, a file), and with a full stop."""
    first = note.split(maxsplit=1)[0]
    return (note[0].upper() + note[1:] if first.isalpha() else note) + ("" if note.endswith((".", "?", "!")) else ".")


def last_pass(estimates: list[Estimate]) -> list[Estimate]:
    """Estimates with increasing stamps: where the clock jumped back, the last pass over those times is kept."""
    kept: list[Estimate] = []
    for estimate in reversed(estimates):
        if not kept or estimate.stamp_ns < kept[-1].stamp_ns:
            kept.append(estimate)
    return kept[::-1]


def _trajectory(estimates: list[Estimate]) -> Trajectory:
    return Trajectory(
        np.array([e.stamp_ns for e in estimates], dtype=np.int64),
        np.array([e.pose for e in estimates]),
        np.array([e.cov for e in estimates]),
    )


def _never_found(replay: _Replay, rejections: Counter[str]) -> str:
    heard = ", ".join(f"{topic} {span.count}" for topic, span in replay.spans().items()) or "nothing"
    why = ", ".join(f"{reason} {n}" for reason, n in rejections.most_common(6)) or "nothing"
    return (
        f"the first pose was never found in {len(replay.step_ms)} steps. Heard: {heard}. Rejected: {why}. "
        "Check the map's ids and sizes, or give estimator.initial_pose."
    )
