"""Mistakes of a recording and its set-up: before a run, while it goes on, and of what it dropped.

Before a run they are found in bounded time, with the settings that undo them. While it goes on the same engine compares
the signals so far, more and more of them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fgloc import se2
from fgloc.config import CAMERA_ROLES, Config, Role, base_role, camera_role
from fgloc.diagnosis.conventions import conventions
from fgloc.diagnosis.handling import FloorWatch
from fgloc.diagnosis.landmarks import first_pose_sentence
from fgloc.diagnosis.setup import Checked, by_places, check_fit, shown
from fgloc.diagnosis.setup_fit import Excerpt, ExcerptCollector, read_excerpt
from fgloc.diagnosis.signals import (
    SightingCollector,
    SignalCollector,
    Signals,
    clock_sentence,
    other_clocks,
)
from fgloc.diagnosis.truth import truth_sentence
from fgloc.errors import FglocError
from fgloc.recording.info import RecordingInfo, inspect_recording
from fgloc.recording.reader import Recording, open_recording
from fgloc.sensor_setup import SensorSetup, base_up, recorded_setup
from fgloc.sensors.base import with_values
from fgloc.sensors.cameras import marker_pose_candidates
from fgloc.sensors.markers.detector import RememberedDetections
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.wheels.sensor import mistakes
from fgloc.types import Camera, Event, Finding, FloatArray, LandmarkMap, Severity, SightingsEvent, Step, note, ordered

# --- Before a run -----------------------------------------------------------------------------------------------------

_MARKER_SHARE = 0.1  # of the images: in fewer, the dictionary or the images may be wrong
_FEWEST_IMAGES = 5
_MOST_IDS = 12  # that are named
_MOST_READINGS = 3  # of the recording, with stamps or mountings corrected in between
_OF_CAMERA = ("camera", "markers", "setup", "sightings")  # of codes of findings on what a camera sees
_OF_WHEELS = ("wheels.scale", "wheels.turn", "wheels.unit", "wheels.gear")
_MOST_TRAVEL_S = 30.0  # from the first motion to the first image in which the place is known


@dataclass(frozen=True, slots=True, eq=False)
class Mistakes:
    """Mistakes of a set-up, and the set-up with them undone.

    Attributes:
        findings: one for each mistake, with the line to be set; none on a sound set-up.
        config: with the mistakes undone.
        landmark_map: likewise; None: the file is taken as it is.
        checked: whether anything was looked for.
    """

    findings: tuple[Finding, ...]
    config: Config
    landmark_map: LandmarkMap | None = None
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
    findings: list[Finding] = []
    now, landmark_map = config, None
    for name in _seeing(path, config):
        found = _Search(path, map_path, now.of_camera(name), landmark_map)
        found.run()
        codes = {finding.code for finding in findings}  # of the motion, which every camera's search judges again
        again = zip(found.findings, of_camera(found.findings, name), strict=True)
        findings += [own for f, own in again if f.code not in codes or own != f]
        now, landmark_map = now.with_camera(name, found.config), found.landmark_map
    undone = now != config or landmark_map is not None
    if undone and any(finding.severity is Severity.ERROR for finding in findings):
        said = "This run was made as if the lines above were set: set them."
        if any(finding.code in _OF_WHEELS and not finding.lines for finding in findings):
            said += " What the truth alone says of the wheels is not applied."
        findings += note("setup.corrected", [said])
    return Mistakes(tuple(findings), now, landmark_map, checked=True)


def _seeing(path: Path, config: Config) -> tuple[str, ...]:
    """Names of the cameras that a recording has messages of, else of the first; ("",) where there are not several."""
    if not config.cameras:
        return ("",)
    with open_recording(path, config.recording) as recording:
        roles = recording.roles
    names = tuple(config.cameras)
    seeing = tuple(name for name in names if {camera_role(name, r) for r in ("image", "sightings")} & roles.keys())
    return seeing or names[:1]


def of_camera(findings: Iterable[Finding], name: str) -> list[Finding]:
    """Findings of a configuration with one of several cameras, by the keys that the configuration of all has."""
    if not name:
        return list(findings)
    keys = {
        "expert.camera.": f"cameras.{name}.",
        "camera.file": f"cameras.{name}.file",
        "recording.sightings_pose": f"cameras.{name}.pose",
        "recording.sightings_axes": f"cameras.{name}.axes",
        **{f"recording.topics.{role}": f"cameras.{name}.{role}" for role in CAMERA_ROLES},
        **{f"{before}{role}: ": f"{before}{name}/{role}: " for role in CAMERA_ROLES for before in ("{", ", ")},
        **{f"[{role}]": f"[{name}/{role}]" for role in CAMERA_ROLES},
    }

    def renamed(text: str) -> str:
        for key, own in keys.items():
            text = text.replace(key, own)
        return text

    made = []
    for finding in findings:
        text, lines = renamed(finding.text), {renamed(k): renamed(v) for k, v in finding.lines.items()}
        if text != finding.text or lines != finding.lines or finding.code.split(".")[0] in _OF_CAMERA:
            text = f"Camera {name}: {text[0].lower()}{text[1:]}"
        made.append(replace(finding, text=text, lines=lines))
    return made


def inspect_all(path: Path, map_path: Path | None, config: Config) -> RecordingInfo:
    """Report of `inspect` on a recording, read once, with the gross mistakes first among the findings.

    Raises:
        RecordingError: nothing can be read.
    """
    if len(config.cameras) > 1:
        with Recording(path, config.recording) as recording:
            info = inspect_recording(recording, config)
        try:
            found = () if info.problems else find_mistakes(path, map_path, config).findings
        except FglocError as error:
            return replace(info, problems=(str(error), *info.problems))
        return replace(info, found=ordered([*found, *info.found]))
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
    named = list(search.findings) or _other_ids(info.marker_ids, setup.landmark_map)
    of_map = () if setup.landmark_map is None else setup.landmark_map.notes
    return replace(info, found=ordered([*named, *info.found]), notes=(*of_map, *info.notes))


def _other_ids(seen: Collection[int], landmark_map: LandmarkMap | None) -> list[Finding]:
    """Finding that none of the landmarks that are seen is on the map; empty if one is, or if none is seen."""
    if not seen or landmark_map is None or any(number in landmark_map for number in seen):
        return []
    ids, known = (", ".join(map(str, sorted(n)[:_MOST_IDS])) or "none" for n in (seen, landmark_map.landmarks))
    text = (
        f"None of the ids that are seen ({ids}) is in the map, which has {known}: nothing tells where on it the robot "
        "is. Give the map of these markers, or run without one."
    )
    return [Finding("map.other_ids", text, Severity.ERROR)]


class _Search:
    """One search: reads the excerpt, again where a mistake of clocks or dictionary made it useless."""

    def __init__(
        self, path: Path, map_path: Path | None, config: Config, landmark_map: LandmarkMap | None = None
    ) -> None:
        self._path, self._map_path = path, map_path
        self.config = self._given = config
        self.landmark_map = self._begun_with = landmark_map
        self._setup: list[Finding] = []
        self._conventions: list[Finding] = []
        self._compared = False
        self.detections: dict[bytes, Any] = {}

    @property
    def findings(self) -> list[Finding]:
        """Everything that was found: conventions, then what the fits of the set-up name."""
        return [*self._conventions, *self._setup]

    def run(self) -> None:
        """Read the excerpt, and check it."""
        with open_recording(self._path, self.config.recording) as recording:
            self.go_on(recording, *self._read(recording))

    def begin(self, recording: Recording) -> tuple[SensorSetup, RememberedDetections | None]:
        """The sensors as configured, and a detector that remembers what it finds in the excerpt."""
        setup = recorded_setup(recording, self._map_path, self.config, self._begun_with)
        if setup.detector is None:
            return setup, None
        memory = setup.detector.remembering(setup.detector.following(), None, self.detections)
        self.detections = memory.found
        return setup, memory

    def go_on(self, recording: Recording, setup: SensorSetup, excerpt: Excerpt) -> None:
        """Check an excerpt that was read already, otherwise as `run`."""
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
        signals = excerpt.signals
        delays = signals.late_s()
        roles = other_clocks(delays)
        given = self.config.recording.received_stamps
        if roles and not set(roles) <= set(given):
            sentence = clock_sentence(roles, delays, given)
            self._correct("clock.received", sentence, "recording", received_stamps=(*given, *roles))
            return True
        if not self._compared:
            self._compared = True
            for mistake in mistakes(signals.motion, self.config):
                if mistake.values:  # counters that roll over are no motion to compare anything with
                    self._correct(mistake.code, mistake.sentence, mistake.section, **mistake.values)
            found = conventions(signals, self.config, parts.T_base_sensor, parts.imu_up, parts.landmark_map)
            self._conventions += found.findings
            read = (self.config.recording, self.config.map)
            changed, self.config = (found.config.recording, found.config.map) != read, found.config
            if changed:
                return True
        placed = bool({"image", "sightings"} & recording.roles.keys()) or self.config.motion.model is not None
        for mistake in mistakes(signals.motion, self.config):
            # without the wheels' motion landmarks alone still tell the pose
            severity = Severity.ERROR if mistake.grave and not placed else Severity.WARNING
            self._setup.append(Finding(mistake.code, mistake.sentence, severity))
        if parts.landmark_map is None:
            return False
        shown = self._shown(excerpt, parts)
        unseen = len(shown) >= _FEWEST_IMAGES and sum(shown) < _MARKER_SHARE * len(shown)
        if unseen and not self._images(recording, parts, any(shown)):
            return False
        if self.config.markers.dictionary != parts.config.markers.dictionary:
            self.detections.clear()
            parts, excerpt = self._read(recording)
        self._fit(recording, excerpt, parts)
        return False

    def _shown(self, excerpt: Excerpt, parts: SensorSetup) -> list[bool]:
        """Whether each image that was searched shows a marker of the map."""
        landmark_map = parts.landmark_map if parts.detector is not None else None
        if landmark_map is None:
            return []
        return [any(m.landmark_id in landmark_map for m in p.seen) for row in excerpt.pictures for p in row]

    def _images(self, recording: Recording, parts: SensorSetup, shown: bool) -> bool:
        """Report why next to no marker is found, or none is ``shown``; whether another dictionary finds them."""
        assert parts.detector is not None
        hints, fitting = parts.detector.hints(recording)
        vague = hints == (parts.detector.unseen,)  # the robot may begin where there are no markers
        if not (vague and shown):
            code, severity = "markers.unseen", Severity.WARNING if vague else Severity.ERROR
            self._setup += note(code if fitting is None else "markers.dictionary", hints, severity)
        if fitting is not None:
            self.config = with_values(self.config, "markers", {"dictionary": fitting})
        return fitting is not None

    def _fit(self, recording: Recording, excerpt: Excerpt, parts: SensorSetup) -> None:
        landmark_map = parts.landmark_map
        if not parts.cameras or landmark_map is None:
            return
        (camera,) = parts.cameras
        image: Role = "image" if parts.detector is not None else "sightings"
        up = base_up(recording, self.config)
        before, apart = self.config, [f for f in self._conventions if f.code in ("wheels.turn", "wheels.scale")]
        if apart:  # gyro and truth judge turn and way apart; images show both, and radii explain both
            as_given = before.wheels.model_copy(update={"scale_omega": self._given.wheels.scale_omega})
            before = before.model_copy(update={"wheels": as_given})
        checked = check_fit(excerpt, before, landmark_map, camera, up, image)
        if checked.correction is not None and checked.correction.config.wheels != before.wheels:
            self.config = before
            self._conventions = [f for f in self._conventions if f not in apart]
        elif before != self.config:
            checked = check_fit(excerpt, self.config, landmark_map, camera, up, image)
        if checked.poor or not checked.stretches:
            for finding, changed in self._map_by_places(excerpt, parts, up):
                again = check_fit(excerpt, self.config, changed, camera, up, image)
                if again.stretches and not again.poor:
                    self._setup.append(finding)
                    self.landmark_map = landmark_map = changed
                    checked = again
                    break
        if checked.unexplained:
            text = (
                f"What the camera saw does not fit {self._map_path}, and no single mistake of the set-up explains it: "
                "check that it is the map of this place, then the positions of its markers and the camera's transform."
            )
            self._setup.append(Finding("map.contradiction", text, Severity.ERROR))
        if checked.correction is not None:
            self._setup.append(checked.correction.finding)
            self.config, changed = checked.correction.config, checked.correction.landmark_map
            self.landmark_map = None if changed is landmark_map else changed
        if checked.corrected is not None:
            self._frames(excerpt, checked)

    def _map_by_places(
        self, excerpt: Excerpt, parts: SensorSetup, up: FloatArray | None
    ) -> Iterator[tuple[Finding, LandmarkMap]]:
        """Unit, mirror image or shifted ids of the map, by the markers' places that images show; the map without it."""
        (camera,), landmark_map = parts.cameras, parts.landmark_map
        assert landmark_map is not None
        config = with_values(self.config, "recording", {"sightings_axes": "optical"})
        corners = SightingCollector(config, landmark_map, (camera,), None, camera.T_base_cam)
        signals = replace(excerpt.signals, seen=[], spatial=True)
        for picture in (p for row in excerpt.pictures for p in row):
            event = CornersEvent(picture.stamp_ns, picture.stamp_ns, "", "", picture.seen)
            at_s = (picture.stamp_ns - signals.origin_ns) * 1e-9
            signals.seen.extend((at_s, s.landmark_id, *s.point.tolist()) for s in corners.sightings(event))
        found = conventions(signals, config, camera.T_base_cam, up, landmark_map).findings
        yield from filter(None, (by_places(finding, landmark_map) for finding in found))

    def _frames(self, excerpt: Excerpt, checked: Checked) -> None:
        assert checked.corrected is not None
        poses = checked.corrected.poses
        stamps = np.array([p.stamp_ns for s in checked.stretches for p in s.pictures], dtype=np.int64)
        times = np.asarray((stamps - excerpt.signals.origin_ns) * 1e-9, dtype=np.float64)
        started = self._started(excerpt.signals, times[0], poses[0])
        sentence = None if started is None else first_pose_sentence(self.config, started)
        if sentence is not None:
            self._correct("frame.first_pose", sentence, "estimator", initial_pose=None)
        sentence = truth_sentence(self.config, excerpt.signals.true_poses(), times, poses)
        if sentence is not None:
            self._correct("truth.frame", sentence, "truth", align="se2")

    def _started(self, signals: Signals, at_s: float, pose: FloatArray) -> FloatArray | None:
        """The pose at the run's start ``(3,)``, by the wheels, if that was not long before."""
        path = None if self.config.estimator.initial_pose is None else signals.path(self.config)
        if path is None or not 0.0 <= at_s - path.times[0] < _MOST_TRAVEL_S:
            return None
        first, now = path.at(np.array([path.times[0], at_s]))
        return se2.compose(pose, se2.between(now, first))

    def _correct(self, code: str, text: str, section: str, **values: object) -> None:
        lines = shown(section, {key: value for key, value in values.items() if value is not None})
        self._setup.append(Finding(code, text, Severity.ERROR, lines))
        self.config = with_values(self.config, section, values)


# --- While a run goes on ----------------------------------------------------------------------------------------------

_FIRST_S, _GROWTH = 20.0, 2.0  # signals of a first comparison, and how many times as much the next one needs
_FIRST_MOVING_S, _GROWTH_MOVING = 5.0, 1.15  # likewise, of motion: until `_FIRST_S` of it, ten more comparisons
_MOVES_M_S, _MOVES_RAD_S = 0.01, 0.02  # by the wheels: below, the robot stands
_SCALES = ("sightings.scale", "wheels.scale", "map.unit", "scales", "sightings.range")
_TURNED_RAD = 0.3  # of a camera: more than the turn by which wheels are off
_SPARSE_S = 0.09  # images closer than this to the one before add little information


class Diagnosis:
    """Signals of a run, collected in bounded memory and independently of the estimator.

    Each of several cameras is compared by itself, with the same signals of motion.
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        cameras: Sequence[Camera] = (),
        T_base_sensor: FloatArray | None = None,
        imu_up: FloatArray | None = None,
        floor: FloorWatch | None = None,
    ) -> None:
        """Set up for the sensors of a run.

        Args:
            config: as the run uses it.
            landmark_map: the known map; None if landmarks are estimated.
            cameras: of corners.
            T_base_sensor: ``(4, 4)`` of a sensor that reports ranges or marker poses, as `LandmarkSensor` takes it.
            imu_up: ``(3,)`` the base's z axis in the IMU's frame; None: there is no gyro.
            floor: watches whether it is flat; None: it may be as it is.
        """
        self._floor, self._moving_s = floor, 0.0
        self._camera_of = {topic: camera.name for camera in cameras if camera.name for topic in camera.topics}
        self._compared = {
            "" if camera is None else camera.name: _Compared(
                config if camera is None else config.of_camera(camera.name), landmark_map, camera, T_base_sensor, imu_up
            )
            for camera in cameras or (None,)
        }

    @property
    def found(self) -> tuple[Finding, ...]:
        """Findings of the last comparison; of little motion, of the last two alike."""
        return ordered([f for name, one in self._compared.items() for f in of_camera(one.found, name)])

    @property
    def mistakes(self) -> tuple[str, ...]:
        """Sentences on errors of the configuration that make the poses wrong: here, a floor that is not flat."""
        sentence = None if self._floor is None else self._floor.sentence
        return () if sentence is None else (sentence,)

    def add(self, event: Event) -> None:
        """Store the signals of an event before the gate, which may refuse it because of another unit."""
        of = self._camera_of.get(event.topic)
        for name, one in self._compared.items():
            if of in (None, name):
                one.add(event)

    def observe(self, step: Step, by_hand: bool = False, motion: FloatArray | None = None) -> None:
        """Watch the floor over a step.

        Args:
            step: as the localizer got it.
            by_hand: a person has the robot in hand.
            motion: ``(3,)`` by the wheels, which tells how much of the signals is of a robot in motion.
        """
        if self._floor is not None:
            self._floor.observe(step, by_hand)
        if motion is not None and (
            math.hypot(motion[0], motion[1]) > _MOVES_M_S * step.dt or abs(motion[2]) > _MOVES_RAD_S * step.dt
        ):
            self._moving_s += step.dt

    def findings(self, ended: bool = True) -> tuple[Finding, ...]:
        """Findings: signals of the sensors that do not fit together, each with its remedy.

        Args:
            ended: compare all signals; otherwise only once they are many more than those compared before.
        """
        comparison = self.comparison(ended)
        if comparison is not None:
            comparison()
        return self.found

    def comparison(self, ended: bool = False) -> Callable[[], None] | None:
        """A comparison to be made by any thread, of the signals so far; it sets `found`.

        Args:
            ended: as `findings` has it. None is given where no comparison is due.
        """
        due = [made for one in self._compared.values() if (made := one.comparison(ended, self._moving_s)) is not None]

        def compare() -> None:
            for made in due:
                made()

        return compare if due else None


class _Compared:
    """Signals of a run with one camera or none, and what the last comparison found.

    Corners of markers are compared as points in the camera's axes.
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        camera: Camera | None,
        T_base_sensor: FloatArray | None,
        imu_up: FloatArray | None,
    ) -> None:
        self._camera, self._map, self._up = camera, landmark_map, imu_up
        self._config, self._place = config, T_base_sensor
        if camera is not None:
            self._config = with_values(config, "recording", {"sightings_axes": "optical"})
            self._place = camera.T_base_cam
        cameras, place = ((), np.eye(4)) if camera is None else ((camera,), camera.T_base_cam)  # the camera's axes
        self._corners = SightingCollector(config, landmark_map, cameras, T_base_sensor, place)
        self._signals = SignalCollector(config)
        self._began_ns: int | None = None
        self._span_s, self._looked_s, self._compared_s = 0.0, -math.inf, 0.0
        self._compared_moving_s = 0.0
        self._codes: set[str] = set()  # found by the last comparison
        self.found: tuple[Finding, ...] = ()

    def add(self, event: Event) -> None:
        self._began_ns = event.received_ns if self._began_ns is None else self._began_ns
        if not self._signals.add(event):
            return
        self._span_s = (event.received_ns - self._began_ns) * 1e-9
        if not isinstance(event, SightingsEvent) or not event.in_pixels:
            return
        signals = self._signals.found
        at_s = (event.stamp_ns - signals.origin_ns) * 1e-9
        if abs(at_s - self._looked_s) >= _SPARSE_S:
            self._looked_s, signals.spatial = at_s, True
            signals.seen += [(at_s, i, *place.tolist()) for i, place in self._places(event)]

    def _places(self, event: SightingsEvent) -> list[tuple[int, FloatArray]]:
        """Id and place ``(3,)`` of markers in the camera's axes: without a map a run knows them in the base's plane."""
        size = self._config.markers.default_size_m
        if self._map is not None or self._camera is None or size is None:
            return [(s.landmark_id, s.point) for s in self._corners.sightings(event)]
        camera, seen = self._camera, [s for s in event.sightings if isinstance(s, MarkerCorners)]
        found = ((s.landmark_id, marker_pose_candidates(camera, s.corners_px, size)) for s in seen)
        return [(i, poses[0][0][:3, 3]) for i, poses in found if poses]

    def comparison(self, ended: bool, moving_s: float) -> Callable[[], None] | None:
        growth = _GROWTH_MOVING if self._compared_moving_s < _FIRST_S else _GROWTH
        enough = self._span_s >= max(_FIRST_S, _GROWTH * self._compared_s)
        enough |= moving_s >= max(_FIRST_MOVING_S, growth * self._compared_moving_s)
        if self._span_s <= self._compared_s or not (ended or enough):
            return None
        self._compared_s, self._compared_moving_s = self._span_s, moving_s
        now = self._signals.found
        signals = replace(now, **{f.name: copy.copy(getattr(now, f.name)) for f in fields(now)})
        little = not ended and 0.0 < moving_s < _FIRST_S
        return lambda: self._compare(signals, little)

    def _compare(self, signals: Signals, little: bool) -> None:
        found = conventions(signals, self._config, self._place, self._up, self._map)
        named = ordered(found.findings if self._camera is None else self._of_camera(found.findings))
        self.found = tuple(f for f in named if not little or f.code in self._codes)
        self._codes = {f.code for f in named}

    @staticmethod
    def _of_camera(findings: Iterable[Finding]) -> Iterator[Finding]:
        """Findings with the severity that corners of markers allow; wrong scales also name marker size, focal length.

        Small turns of the camera are left to the graph, and to the fit of corners before a run: at a marker's distance
        the wheels' own turn does the same.
        """
        for finding in findings:
            severity = min(finding.severity, Severity.WARNING)
            if finding.code == "sightings.mounting" and abs(finding.value or 0.0) < _TURNED_RAD:
                continue
            if finding.code not in _SCALES:
                yield replace(finding, severity=severity)
                continue
            said = finding.text.partition(": set ")[0].removesuffix(".")
            text = f"{said}; a wrong size of the markers or focal length does the same: measure them."
            yield replace(finding, text=text, lines={}, severity=severity)


# --- After a run ------------------------------------------------------------------------------------------------------

_CLOCK_REASONS = ("late", "future", "stray", "stamp_zero", "duplicate", "duplicate_stamp", "copy")


def unused_sightings(rejections: Mapping[str, int], roles: Mapping[Role, str], used: int) -> tuple[str, ...]:
    """A sentence if no sighting reached the estimator and stamps are the main reason.

    Args:
        rejections: of the run, by "sensor.reason".
        roles: topics in use.
        used: sightings that the estimator was given, whatever it made of them.
    """
    seeing = [role for kind in ("image", "sightings") for role in roles if base_role(role) == kind]
    if used or not seeing:
        return ()
    role = seeing[0]
    dropped = {k: n for k, n in rejections.items() if base_role(k.split(".")[0]) in ("sightings", "image") and n}
    by_clock = {k: n for k, n in dropped.items() if k.split(".", 1)[1] in _CLOCK_REASONS}
    if 2 * sum(by_clock.values()) <= sum(dropped.values()):
        return ()
    reasons = ", ".join(f"{name} {n}" for name, n in sorted(by_clock.items(), key=lambda item: -item[1]))
    return (
        f"None of the sightings on {roles[role]} was used, for their stamps do not fit the clock of the other topics "
        f"({reasons}): the run is dead reckoning. `fgloc info` compares the clocks; recording.received_stamps: "
        f"[{role}] takes the receive times instead.",
    )
