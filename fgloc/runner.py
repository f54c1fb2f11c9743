"""One run: a recording goes in, a RunResult comes out. Batch replays the events and then smooths; online does not."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Literal

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
from fgloc.sensors.markers import Detector, detect_stream
from fgloc.sensors.remembered import RememberedDetections
from fgloc.smoothing import smooth_run
from fgloc.threads import one_blas_thread
from fgloc.types import (
    CornersEvent,
    Decision,
    Estimate,
    Event,
    ImageEvent,
    RunResult,
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


def find_beside(bag: Path, name: str) -> Path | None:
    """A file of this name beside the bag: in its folder, or in the folder that holds it."""
    folders = (bag, bag.parent) if bag.is_dir() else (bag.parent, bag.parent.parent)
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


@one_blas_thread
def run(
    recording_path: Path,
    map_path: Path | None,
    config: Config,
    mode: RunMode,
    progress: Progress | None = None,
    pace: float | None = None,
    on_step: Callable[[Step, Estimate | None], None] | None = None,
    events: EventFilter | None = None,
    sightings: EventFilter | None = None,
    detections: Path | None = None,
    check: bool = True,
) -> RunResult:
    """Localise one recording.

    Args:
        recording_path: any bag that `open_recording` reads.
        map_path: marker map; None: landmarks are estimated too.
        config: all settings.
        mode: "batch" smooths after the replay; "online" keeps the filtered estimates.
        progress: called now and then.
        pace: replay at this multiple of real time; None: as fast as possible.
        on_step: called after each step (online displays, benchmarks).
        events: filter of the recorded events (ablations).
        sightings: likewise, of the events once the markers are found: after detection, without images on the recorded.
        detections: file that remembers what was found in the images, for other runs of the same ones.
        check: look for gross mistakes of the set-up first, and run with those undone that are sure; afterwards, where a
            clock seems to be wrong, run again with it corrected, to see whether it is. Not done on filtered events.

    Raises:
        FglocError: the input cannot be used, or no pose was ever found.
    """
    began = time.perf_counter()
    check = check and events is None and sightings is None
    wrong = find_mistakes(recording_path, map_path, config) if check else Mistakes((), config)
    config = wrong.config
    with open_recording(recording_path, config.recording) as recording:
        parts = assemble(recording, map_path, config, mode == "batch" or map_path is None, wrong.landmark_map)
        memory = None
        if parts.detector is not None:
            memory = RememberedDetections(detections, parts.detector, wrong.detections, note=detections is not None)
        replay = _Replay(parts, recording.roles, memory, recording.duration_s, progress, pace, sightings)
        replay.run(recording.events() if events is None else events(recording.events()), on_step)
        if mode == "batch" or not replay.estimates:
            replay.make_up(parts.localizer.finish(replay.blind))
        if memory is not None:
            memory.save()
        hints, untried = _hints(recording, parts, replay)
        notes = (
            *hints,
            *recording.notes,
            *replay.clocks.notes,
            *parts.sentences,
        )
        rejections = replay.rejections()
        rejections.update({f"undecodable.{k}": v for k, v in recording.undecodable.items()})
        roles = recording.roles
    seen = sum(decision.landmark_id >= 0 for decision in replay.decisions)
    mistakes = (*wrong.sentences, *unused_sightings(rejections, roles, seen))
    if not replay.estimates:
        raise EstimatorError(" ".join([*mistakes, _never_found(replay, rejections), *hints, *untried]))
    try:
        smoothed = smooth_run(parts) if mode == "batch" else None
    except EstimatorError as error:
        raise EstimatorError(" ".join([*mistakes, _sentence(str(error)), *hints, *untried])) from error
    estimates = last_pass(replay.estimates if smoothed is None else smoothed.estimates)
    installed = parts.localizer.estimator.installed if smoothed is None else smoothed.installation
    found = installation_found(parts, roles, installed)
    tried = None
    if check and not wrong.sentences and on_step is None:
        trials = clock_trials(found, parts.diagnosis.clock_offsets(parts.wheels.source), config)
        tried = clock_note(trials, config, partial(_tried, recording_path, map_path, detections))
    notes = (
        *mistakes[len(wrong.sentences) :],
        *wrong.notes,
        *(() if tried is None else tried[:1]),
        *notes,
        *(() if smoothed is None else smoothed.notes),
        *_left_out(len(replay.estimates if smoothed is None else smoothed.estimates) - len(estimates)),
        *contradictions(found if tried is None else tried[1]),
    )
    return RunResult(
        trajectory=_trajectory(estimates),
        modes=tuple(e.mode for e in estimates),
        decisions=tuple(replay.decisions),
        counts=dict(parts.localizer.counts),
        rejections=dict(sorted(rejections.items())),
        notes=tuple(dict.fromkeys(map(_sentence, notes))),
        step_ms=np.array(replay.step_ms),
        wall_s=time.perf_counter() - began,
        truth=replay.truth.trajectory(),
        landmarks=parts.landmark_map if smoothed is None else smoothed.landmarks,
        spans=replay.spans(),
        source=recording_path,
        installation=found_values(
            parts.localizer.factors.installation, installed, parts.config, parts.camera, parts.landmark_map
        ),
        found=found,
        cost=None if smoothed is None else smoothed.cost,
        first_pose_s=replay.first_pose_s,
        mistakes=mistakes,
        config=config,
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
        roles: Mapping[Role, str],
        detector: Detector | None,
        duration_s: float,
        progress: Progress | None,
        pace: float | None,
        sightings: EventFilter | None,
    ) -> None:
        self._parts = parts
        self._detector = detector
        self._duration_s = duration_s
        self._progress = progress
        self._pace = pace
        self._sightings = sightings if sightings is not None else iter
        self._image_rejections: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._first_step_ns: int | None = None
        self.first_pose_s: float | None = None
        self.blind = True  # no image and no sighting was recorded, not even an unusable one
        self.activity = TopicActivity(roles)
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

    def run(self, events: Iterator[Event], on_step: Callable[[Step, Estimate | None], None] | None) -> None:
        """Localise, step by step."""
        for step in self.steps(events):
            start = time.perf_counter()
            estimate = self._parts.localizer.update(step)
            self.record(step, estimate, (time.perf_counter() - start) * 1e3)
            self._parts.diagnosis.observe(step, self._parts.wheels.measure(step))
            if on_step is not None:
                on_step(step, estimate)

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
            self.blind = self.blind and not isinstance(event, ImageEvent | SightingsEvent)
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
