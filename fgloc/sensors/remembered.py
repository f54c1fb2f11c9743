"""Detections that are found once: many runs of one recording, as in a sweep, see the same images."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from fgloc.recording.outputs import atomic_file
from fgloc.sensors.markers import Detector
from fgloc.types import CornersEvent, ImageEvent, MarkerCorners

Detections = tuple[MarkerCorners, ...]
"""Of one image."""


class RememberedDetections:
    """Asks a detector only about images that no run before has asked about.

    What is remembered goes by the image's content: a result is the same whether it was remembered or found anew. The
    file is for one dictionary and one version of the detector, which its name has to tell. Images that cannot be
    decoded are not remembered. Several processes may use the file at once: what one of them fails to add is found anew.
    """

    def __init__(self, path: Path, detector: Detector) -> None:
        self._path = path
        self._detector = detector
        self._known = _read(path)
        self._new: dict[bytes, tuple[MarkerCorners, ...]] = {}

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; raises as the detector does."""
        key = _key(event)
        sightings = self._known.get(key)
        if sightings is None:
            sightings = self._known[key] = self._new[key] = self._detector.detect(event).sightings
        return CornersEvent(event.stamp_ns, event.received_ns, event.topic, event.frame_id, sightings)

    def save(self) -> None:
        """Add what was new to the file.

        Raises:
            OutputError: it cannot be written.
        """
        if self._new:
            _write(self._path, _read(self._path) | self._new)
            self._new.clear()


def _key(event: ImageEvent) -> bytes:
    form = f"{event.encoding} {event.compressed} {event.width} {event.height} {event.step} {event.is_bigendian}"
    digest = hashlib.sha256(form.encode())
    digest.update(event.data.tobytes())
    return digest.digest()


def _read(path: Path) -> dict[bytes, tuple[MarkerCorners, ...]]:
    """What a file holds; nothing if there is none, or none that can be read."""
    try:
        with path.open("rb") as content, np.load(content, allow_pickle=False) as file:
            keys, counts, ids, corners = (file[name] for name in ("keys", "counts", "ids", "corners"))
    except (OSError, ValueError, KeyError, BadZipFile, EOFError):
        return {}
    sightings = [MarkerCorners(i, c) for i, c in zip(ids.tolist(), corners, strict=True)]
    ends = np.cumsum(counts).tolist()
    return {
        key.tobytes(): tuple(sightings[end - count : end])
        for key, count, end in zip(keys, counts.tolist(), ends, strict=True)
    }


def _write(path: Path, known: dict[bytes, tuple[MarkerCorners, ...]]) -> None:
    found = [s for sightings in known.values() for s in sightings]
    with atomic_file(path, binary=True) as file:
        np.savez(
            file,
            keys=np.frombuffer(b"".join(known), dtype=np.uint8).reshape(len(known), 32),
            counts=np.array([len(sightings) for sightings in known.values()], dtype=np.int64),
            ids=np.array([s.marker_id for s in found], dtype=np.int64),
            corners=np.array([s.corners_px for s in found], dtype=float).reshape(len(found), 4, 2),
        )


class NotedDetector:
    """Searches images and notes what it found, for a run that comes to the same images."""

    def __init__(self, detector: Detector, found: dict[tuple[int, int], Detections]) -> None:
        """Note into ``found``, by receive time and number of bytes."""
        self._detector, self._found = detector, found

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; raises as the detector does."""
        key = event.received_ns, len(event.data)
        if key not in self._found:
            self._found[key] = self._detector.detect(event).sightings
        return _event(event, self._found[key])


class FoundBefore:
    """Searches only images in which nothing was found before."""

    def __init__(self, detector: Detector, found: Mapping[tuple[int, int], Detections]) -> None:
        """Take what a `NotedDetector` of the same dictionary has found."""
        self._detector, self._found = detector, found

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; raises as the detector does."""
        known = self._found.get((event.received_ns, len(event.data)))
        return self._detector.detect(event) if known is None else _event(event, known)


def _event(event: ImageEvent, sightings: Detections) -> CornersEvent:
    return CornersEvent(event.stamp_ns, event.received_ns, event.topic, event.frame_id, sightings)
