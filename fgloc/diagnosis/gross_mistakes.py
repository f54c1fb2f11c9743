"""Gross mistakes of a recording's set-up, found before the run in bounded time, with the settings that undo them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import Config, Role
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.excerpt import GRID_S, Excerpt, ExcerptCollector, read_excerpt, wheel_increments
from fgloc.diagnosis.frame_checks import first_pose_sentence, truth_sentence
from fgloc.diagnosis.raw_checks import clock_sentence, other_clocks
from fgloc.diagnosis.setup_check import Checked, check_fit
from fgloc.diagnosis.signals import read_signals
from fgloc.errors import FglocError
from fgloc.recording.info import RecordingInfo, inspect_recording
from fgloc.recording.reader import Recording, open_recording
from fgloc.sensor_setup import SensorSetup, base_up, recorded_setup
from fgloc.sensors import registry
from fgloc.sensors.detection import RememberingDetector
from fgloc.types import Finding, FloatArray, LandmarkMap, Severity, note, ordered

_MARKER_SHARE = 0.1  # of the images: in fewer, the dictionary or the images may be wrong
_FEWEST_IMAGES = 5
_MOST_READINGS = 3  # of the recording, with stamps or mountings corrected in between
_MOST_TRAVEL_S = 30.0  # from the first motion to the first image in which the place is known


@dataclass(frozen=True, slots=True, eq=False)
class Mistakes:
    """What is wrong with a set-up.

    Attributes:
        findings: one for each mistake, with the line to be set; none on a sound set-up.
        config: with the mistakes undone.
        landmark_map: likewise; None: the file is taken as it is.
        undone: whether ``config`` and ``landmark_map`` are not as they were given.
        checked: whether anything was looked for.
    """

    findings: tuple[Finding, ...]
    config: Config
    landmark_map: LandmarkMap | None = None
    undone: bool = False
    checked: bool = False

    @property
    def grave(self) -> bool:
        """Whether a mistake would make the poses wrong."""
        return any(finding.severity is Severity.ERROR for finding in self.findings)


def find_mistakes(path: Path, map_path: Path | None, config: Config) -> Mistakes:
    """Check an excerpt of a recording against what is given of map, camera, wheels, clocks and frames.

    Args:
        path: recording.
        map_path: map; None: only what needs none is checked.
        config: as given.

    Raises:
        FglocError: the input cannot be used, as `fgloc.runner.run` would raise too.
    """
    found = _Search(path, map_path, config)
    found.run()
    undone = found.config != config or found.landmark_map is not None
    findings = found.findings
    if undone and any(finding.severity is Severity.ERROR for finding in findings):
        findings += note("setup.corrected", ["This run was made with that corrected; correct it, too."])
    return Mistakes(tuple(findings), found.config, found.landmark_map, undone, checked=True)


def inspect_all(path: Path, map_path: Path | None, config: Config) -> RecordingInfo:
    """What `inspect` reports of a recording, with the gross mistakes first among the findings; it is read once.

    Raises:
        RecordingError: nothing can be read.
    """
    search = _Search(path, map_path, config)
    with Recording(path, config.recording) as recording:
        if recording.problems:
            return inspect_recording(recording, config)
        try:
            setup, detector = search.begin(recording)
        except FglocError as error:
            info = inspect_recording(recording, config)
            return replace(info, problems=(str(error), *info.problems))
        collector = ExcerptCollector(recording, config, detector)
        info = inspect_recording(recording, config, collector.add)
        try:
            search.go_on(recording, setup, collector.found)
        except FglocError as error:
            return replace(info, problems=(str(error), *info.problems))
    return replace(info, found=ordered([*search.findings, *info.found]))


class _Search:
    """One search: reads the excerpt, again where a mistake of clocks or dictionary made it useless."""

    def __init__(self, path: Path, map_path: Path | None, config: Config) -> None:
        self._path, self._map_path = path, map_path
        self.config = config
        self.landmark_map: LandmarkMap | None = None
        self.sentences: list[str] = []
        self._conventions: list[Finding] = []
        self._compared = False
        self.detections: dict[bytes, Any] = {}

    @property
    def findings(self) -> list[Finding]:
        """Everything that was found: conventions, then what the fits of the set-up name."""
        return [*self._conventions, *note("setup", self.sentences, Severity.ERROR)]

    def run(self) -> None:
        """Read the excerpt, and check it."""
        with open_recording(self._path, self.config.recording) as recording:
            self.go_on(recording, *self._read(recording))

    def begin(self, recording: Recording) -> tuple[SensorSetup, RememberingDetector | None]:
        """The sensors as configured, and a detector that remembers what it finds in the excerpt."""
        setup = recorded_setup(recording, self._map_path, self.config)[1]
        if setup.detector is None:
            return setup, None
        memory = setup.detector.remembering(setup.detector.following(), None, self.detections)
        self.detections = memory.found
        return setup, memory

    def go_on(self, recording: Recording, setup: SensorSetup, excerpt: Excerpt) -> None:
        """As `run`, of an excerpt that was read."""
        if not self._check(recording, setup, excerpt):
            return
        for _ in range(_MOST_READINGS):
            with open_recording(self._path, self.config.recording) as corrected:
                if not self._check(corrected, *self._read(corrected)):
                    return

    def _read(self, recording: Recording) -> tuple[SensorSetup, Excerpt]:
        setup, detector = self.begin(recording)
        return setup, read_excerpt(recording, self.config, detector)

    def _check(self, recording: Recording, parts: SensorSetup, excerpt: Excerpt) -> bool:
        """All checks, in the order in which one makes the next possible; whether stamps were corrected meanwhile."""
        roles = other_clocks(excerpt.delays)
        given = self.config.recording.received_stamps
        if roles and not set(roles) <= set(given):
            self.sentences.append(clock_sentence(roles, excerpt.delays, given))
            self._change("recording", received_stamps=(*given, *roles))
            return True
        if not self._compared:
            self._compared = True
            signals = read_signals(recording, self.config)
            found = conventions(signals, self.config, parts.T_base_sensor, parts.imu_up, parts.landmark_map)
            self._conventions += found.findings
            read = (self.config.recording, self.config.map)
            changed, self.config = (found.config.recording, found.config.map) != read, found.config
            if changed:
                return True
        for mistake in registry.raw_mistakes(excerpt.motion, self.config):
            self.sentences.append(mistake.sentence)
            self._change(mistake.section, **mistake.values)
        if parts.landmark_map is None:
            return False
        if self._unseen(excerpt, parts) and not self._images(recording, parts):
            return False
        if registry.raw_landmarks().dictionary(self.config) != registry.raw_landmarks().dictionary(parts.config):
            self.detections.clear()
            parts, excerpt = self._read(recording)
        self._fit(recording, excerpt, parts)
        return False

    def _unseen(self, excerpt: Excerpt, parts: SensorSetup) -> bool:
        """Whether images were searched and next to none shows a marker of the map."""
        assert parts.landmark_map is not None
        shown = [any(m.landmark_id in parts.landmark_map for m in p.seen) for row in excerpt.pictures for p in row]
        return parts.detector is not None and len(shown) >= _FEWEST_IMAGES and sum(shown) < _MARKER_SHARE * len(shown)

    def _images(self, recording: Recording, parts: SensorSetup) -> bool:
        """Report why no marker is found; whether another dictionary finds them."""
        assert parts.detector is not None
        hints, fitting = parts.detector.hints(recording)
        self.sentences += hints
        if fitting is not None:
            self._change("markers", dictionary=fitting)
        return fitting is not None

    def _fit(self, recording: Recording, excerpt: Excerpt, parts: SensorSetup) -> None:
        landmark_map, camera = parts.landmark_map, parts.camera
        if camera is None or landmark_map is None:
            return
        image: Role = "image" if parts.detector is not None else "sightings"
        up = base_up(recording, self.config)
        checked = check_fit(excerpt, self.config, landmark_map, camera, up, image)
        if checked.unexplained:
            self.sentences.append(
                f"What the camera saw does not fit {self._map_path}, and no single mistake of the set-up explains it: "
                "check that it is the map of this place, then the positions of its markers and the camera's transform."
            )
        if checked.correction is not None:
            self.sentences.append(checked.correction.sentence)
            self.config, changed = checked.correction.config, checked.correction.landmark_map
            self.landmark_map = None if changed is landmark_map else changed
        if checked.corrected is not None:
            self._frames(excerpt, checked)

    def _frames(self, excerpt: Excerpt, checked: Checked) -> None:
        assert checked.corrected is not None
        poses = checked.corrected.poses
        stamps = np.array([p.stamp_ns for s in checked.stretches for p in s.pictures], dtype=np.int64)
        started = self._started(excerpt, int(stamps[0]), poses[0])
        sentence = None if started is None else first_pose_sentence(self.config, started)
        if sentence is not None:
            self.sentences.append(sentence)
            self._change("estimator", initial_pose=None)
        sentence = truth_sentence(self.config, excerpt.truth, stamps, poses)
        if sentence is not None:
            self.sentences.append(sentence)
            self._change("truth", align="se2")

    def _started(self, excerpt: Excerpt, stamp_ns: int, pose: FloatArray) -> FloatArray | None:
        """The pose at the run's start ``(3,)``, by the wheels, if that was not long before."""
        first = min((e.stamp_ns for e in excerpt.motion), default=stamp_ns)
        if self.config.estimator.initial_pose is None or not 0 <= stamp_ns - first < _MOST_TRAVEL_S * 1e9:
            return None
        grid = np.append(np.arange(first, stamp_ns, round(GRID_S * 1e9)), stamp_ns)
        steps = wheel_increments(excerpt, self.config, grid) if len(grid) > 1 else None
        travelled = np.zeros(3)
        for step in () if steps is None else steps:
            travelled = se2.compose(travelled, se2.exp(step))
        return se2.compose(pose, se2.inverse(travelled))

    def _change(self, section: str, **values: object) -> None:
        part = getattr(self.config, section).model_copy(update=values)
        self.config = self.config.model_copy(update={section: part})
