"""Markers followed from image to image: a fast search of the whole image, and a thorough one where it missed a marker.

The thorough search is repeated for the whole image whenever the fast one finds nothing, and every few images.
"""

from __future__ import annotations

import math
from collections import Counter, deque

import numpy as np

from fgloc.sensors.markers.detector import Box, MarkerDetector
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.markers.images import GrayImage, decode
from fgloc.types import FloatArray

Found = list[tuple[int, FloatArray]]

_EVERY = 10  # images from one thorough search of the whole image to the next
_MAX_GAP_NS = 1_000_000_000  # markers that were seen longer ago are not looked for
_ROOM_PX = 16.0  # around a marker, for the detector's widest threshold and contours that touch the part's border
_ROOM_SHARE = 0.5  # of its side, for motion that differs from that of the other markers
_BORDER_PX = 4.0  # markers that come nearer to the image's border are about to leave it


class TrackingDetector:
    """Finds the markers of a camera's images, which have to come in their order.

    Attributes:
        counts: images searched thoroughly ("whole"), fast ("fast"), and markers looked for where they had been
            ("missing").
    """

    def __init__(self, detector: MarkerDetector) -> None:
        """Take a detector, which may be used elsewhere too."""
        self.counts: Counter[str] = Counter()
        self._detector = detector
        self._last: Found = []
        self._last_ns = -math.inf
        self._shape: tuple[int, ...] = ()
        self._since_whole = 0

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image, ordered by id and place; an image without markers gives an event without sightings.

        Raises:
            ImageError: the image cannot be decoded.
        """
        found = self.find(decode(event), event.stamp_ns)
        sightings = tuple(MarkerCorners(i, corners) for i, corners in found)
        return CornersEvent(event.stamp_ns, event.received_ns, event.topic, event.frame_id, sightings)

    def find(self, image: GrayImage, stamp_ns: int) -> Found:
        """Id and corners ``(4, 2)`` of each marker in a gray image, ordered by id, then from the left."""
        known = self._last if 0 <= stamp_ns - self._last_ns <= _MAX_GAP_NS and image.shape == self._shape else []
        self._since_whole += 1
        found: Found = []
        if known and self._since_whole < _EVERY:
            self.counts["fast"] += 1
            found = self._detector.find_fast(image)
        if not found:
            self.counts["whole"] += 1
            self._since_whole = 0
            found = self._detector.find(image)
        if known and found:
            found = self._with_missing(image, known, found)
        self._last, self._last_ns, self._shape = found, stamp_ns, image.shape
        return found

    def _with_missing(self, image: GrayImage, known: Found, found: Found) -> Found:
        """What was found, and markers of the last image that were not found but may still be in view."""
        missing, shift = _compare(known, found)
        more: Found = []
        for marker_id, corners in missing:
            box = _box_around(corners + shift, image.shape)
            if box is None:
                continue
            self.counts["missing"] += 1
            for i, c in self._detector.find_within(image, box):
                if i == marker_id and not any(i == j and _near(c, d) for j, d in (*found, *more)):
                    more.append((i, c))
        return sorted([*found, *more], key=lambda f: (f[0], *f[1].mean(axis=0))) if more else found


def _compare(known: Found, found: Found) -> tuple[Found, FloatArray]:
    """Markers that are missing now, and how far those that are not have moved ``(2,)``."""
    left: dict[int, deque[FloatArray]] = {}
    for i, corners in found:
        left.setdefault(i, deque()).append(corners)
    missing, moved = [], []
    for i, corners in known:
        if left.get(i):
            moved.append(left[i].popleft().mean(axis=0) - corners.mean(axis=0))
        else:
            missing.append((i, corners))
    return missing, np.median(moved, axis=0) if moved else np.zeros(2)


def _box_around(corners: FloatArray, shape: tuple[int, ...]) -> Box | None:
    """The part of an image around a marker; None if it is about to leave the image."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.array([shape[1], shape[0]])
    if (low < _BORDER_PX).any() or (high > size - 1.0 - _BORDER_PX).any():
        return None
    room = _ROOM_PX + _ROOM_SHARE * float((high - low).max())
    left, top = np.maximum(np.floor(low - room), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high + room) + 1, size).astype(int).tolist()
    return left, top, right, bottom


def _near(a: FloatArray, b: FloatArray) -> bool:
    """Whether two quadrilaterals are one and the same marker."""
    side = float(np.linalg.norm(a - np.roll(a, 1, axis=0), axis=1).max())
    return bool(np.linalg.norm(a.mean(axis=0) - b.mean(axis=0)) < 0.5 * side)
