"""Detections that are found once: many runs of one recording, as in a sweep, see the same images."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from fgloc.files.atomic import atomic_file
from fgloc.sensors.detection import Detector
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners

Detections = tuple[MarkerCorners, ...]
"""Of one image."""


class RememberedDetections:
    """Asks a detector only about images that no run before has asked about.

    What is remembered goes by the image's content: a result is the same whether it was remembered or found anew. The
    file is for one dictionary and one version of the detector, which its name has to tell. Images that cannot be
    decoded are not remembered. Several processes may use the file at once: what one of them fails to add is found anew.

    Attributes:
        found: what is not in the file, by image: ``known`` for another detector of the same images.
    """

    def __init__(
        self,
        path: Path | None,
        detector: Detector,
        known: Mapping[bytes, Detections] | None = None,
        note: bool = True,
    ) -> None:
        """Take what a file and an earlier run know.

        Args:
            path: file; None: nothing is written.
            detector: asked about all other images.
            known: found by a detector of the same dictionary; goes into the file as well.
            note: whether to remember what is found anew: memory grows with the images.
        """
        self.found: dict[bytes, Detections] = dict(known or {})
        self._path = path
        self._detector = detector
        self._note = note
        self._known = (_read(path) if path is not None else {}) | self.found

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; raises as the detector does."""
        key = _key(event)
        sightings = self._known.get(key)
        if sightings is None:
            sightings = self._detector.detect(event).sightings
            if self._note:
                self._known[key] = self.found[key] = sightings
        return CornersEvent(event.stamp_ns, event.received_ns, event.topic, event.frame_id, sightings)

    def save(self) -> None:
        """Add what was new to the file, if there is one.

        Raises:
            OutputError: it cannot be written.
        """
        if self._path is not None and self.found:
            _write(self._path, _read(self._path) | self.found)
            self.found.clear()


def _key(event: ImageEvent) -> bytes:
    form = f"{event.encoding} {event.compressed} {event.width} {event.height} {event.step} {event.is_bigendian}"
    digest = hashlib.sha256(form.encode())
    digest.update(event.data.tobytes())
    return digest.digest()


def _read(path: Path) -> dict[bytes, Detections]:
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


def _write(path: Path, known: dict[bytes, Detections]) -> None:
    found = [s for sightings in known.values() for s in sightings]
    with atomic_file(path, binary=True) as file:
        np.savez(
            file,
            keys=np.frombuffer(b"".join(known), dtype=np.uint8).reshape(len(known), 32),
            counts=np.array([len(sightings) for sightings in known.values()], dtype=np.int64),
            ids=np.array([s.landmark_id for s in found], dtype=np.int64),
            corners=np.array([s.corners_px for s in found], dtype=float).reshape(len(found), 4, 2),
        )
