"""Drives for a survey: recordings replayed without a map, so that their poses and sightings are at hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fgloc.assembly import Assembly, assemble
from fgloc.config import Config
from fgloc.errors import ConfigError, RecordingError
from fgloc.graph.measurement_log import Keyframe
from fgloc.recording.reader import Recording, open_recording
from fgloc.replay.options import Progress
from fgloc.replay.smoothing import smooth_run
from fgloc.sensors import registry
from fgloc.sensors.detection import detect_stream
from fgloc.sensors.equipment import MotionSensors, PoseSensors
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.motion_compensation import MotionCompensation
from fgloc.types import Event, FloatArray, Landmark, LandmarkMap, PixelMeasurement, RawEvent, SightingsEvent

_SHARP_PX = 30.0  # side from which a marker's corners are as good as they get


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """One recording, its trajectory known from odometry and from single views of the markers.

    Attributes:
        bag: the recording.
        parts: of the run without a map.
        frames: its keyframes, in order.
        poses: ``(n, 3)`` smoothed; the first one is the origin.
        sightings: of each marker, by id.
        notes: what the user should know.
    """

    bag: Path
    parts: Assembly
    frames: list[Keyframe]
    poses: FloatArray
    sightings: Mapping[int, int]
    notes: tuple[str, ...]

    def measure(self, sizes: Mapping[int, float], offset_s: float = 0.0) -> list[list[PixelMeasurement]]:
        """Corners of these markers as seen from each keyframe.

        Args:
            sizes: side of each marker [m].
            offset_s: how late the stamps of images are, as far as is known.
        """
        named = LandmarkMap({i: Landmark(i, np.zeros(3), np.eye(3), size) for i, size in sizes.items()})
        config = self.parts.config
        sensor, wheels = LandmarkSensor(config, named, self.parts.camera, None), registry.odometer().build(config)
        motion = MotionSensors(wheels, gyro=self.parts.localizer.motion.sources.gyro)
        moved = MotionCompensation(PoseSensors(sensor), motion, config.camera.time_jitter_s)
        seen: list[list[PixelMeasurement]] = []
        for frame in self.frames:
            found = []
            if frame.step is not None:
                wheels.measure(frame.step)
                found = [m for m in moved.measure(frame.step, offset_s) if isinstance(m, PixelMeasurement)]
            seen.append([replace(m, sigma_px=m.sigma_px * _coarseness(m.corners_px)) for m in found])
        return seen


def sees_corners(bag: Path, config: Config) -> bool:
    """Whether landmarks are seen as markers in images, or as their corners."""
    with open_recording(bag, config.recording) as recording:
        if "image" in recording.roles:
            return True
        if "sightings" not in recording.roles:
            return False
        first = next((e for e in recording.events() if isinstance(e, SightingsEvent)), None)
        return first is not None and first.in_pixels


def drive(bag: Path, config: Config, progress: Progress | None = None) -> Drive:
    """Replay and smooth a recording without a map.

    Args:
        bag: with images, or corners of markers.
        config: with dictionary (for images) and size of the markers.
        progress: called now and then.

    Raises:
        ConfigError: no dictionary, or no size.
        RecordingError: neither images nor corners, or no marker in them.
        EstimatorError: no trajectory was found.
    """
    with open_recording(bag, config.recording) as recording:
        _check(bag, recording, config)
        parts = assemble(recording, None, config, keep_all=True)
        unreadable: Counter[str] = Counter()
        seen: Counter[int] = Counter()
        for event in _checked(recording, parts, unreadable, progress):
            if isinstance(event, SightingsEvent) and event.in_pixels:
                seen.update(s.landmark_id for s in event.sightings)
            for step in parts.stepper.push(event):
                parts.localizer.update(step)
        for step in parts.stepper.flush():
            parts.localizer.update(step)
        parts.localizer.finish(False)
        notes = (*recording.notes, *parts.gate.notes)
    if not seen:
        raise RecordingError(
            f"{bag}: no marker was seen{_in_images(parts)}; see `fgloc info {bag}`, and markers.dictionary"
        )
    estimates = smooth_run(parts).estimates
    frames = list(parts.localizer.estimator.log.keyframes.values())
    return Drive(bag, parts, frames, np.array([e.pose for e in estimates]), dict(sorted(seen.items())), notes)


def _checked(
    recording: Recording, parts: Assembly, unreadable: Counter[str], progress: Progress | None
) -> Iterator[Event]:
    """Events that passed the gate, images replaced by the corners of the markers in them."""

    def gated() -> Iterator[Event]:
        start_ns = recording.span_ns[0]
        for event in recording.events():
            if progress is not None:
                progress((event.received_ns - start_ns) * 1e-9, recording.duration_s)
            passed = parts.gate.check(event)
            if passed is not None:
                yield passed

    if parts.detector is None:
        yield from gated()
        return
    for event in detect_stream(gated(), parts.detector, unreadable):
        passed = parts.detections.check(event) if isinstance(event, SightingsEvent) else event
        if passed is not None and not isinstance(passed, RawEvent):
            yield passed


def _check(bag: Path, recording: Recording, config: Config) -> None:
    if not {"image", "sightings"} & set(recording.roles):
        raise RecordingError(f"{bag}: no images and no corners of markers: nothing to survey; see `fgloc info {bag}`")
    if "image" in recording.roles and not registry.raw_landmarks().dictionary(config):
        fitting = registry.raw_landmarks().fitting_dictionary(recording)
        listed = (
            f"what is seen fits {fitting}: --dictionary {fitting}" if fitting else "such as --dictionary DICT_4X4_50"
        )
        raise ConfigError(f"{bag}: no marker dictionary; {listed}, or markers.dictionary in --config")
    if registry.raw_landmarks().size(config) is None:
        raise ConfigError(
            f"{bag}: the distance of markers follows from their size: give the side of the black square in "
            "metres, --size 0.16, or markers.default_size_m in --config"
        )


def _coarseness(corners: FloatArray) -> float:
    """On the noise of the corners ``(4, 2)`` of a marker seen small or from the side.

    Blur then shifts its edges by what the cells beside them are, alike in all views from there: with this the
    directions of a simulated survey are a third better.
    """
    side = float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())
    return max(1.0, (_SHARP_PX / max(side, 1.0)) ** 2)


def _in_images(parts: Assembly) -> str:
    return "" if parts.detector is None else f" with {parts.detector.dictionary} in the images"
