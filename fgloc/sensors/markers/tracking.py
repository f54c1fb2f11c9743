"""Markers followed from image to image: a coarse search of the whole image, then parts of it at full resolution.

Read closely are the parts where the coarse search saw a square that it could not read, and where a marker was in the
last image that it did not find. The whole image is searched at full resolution where this finds nothing although there
were markers, and every so many images.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable

import numpy as np

from fgloc.sensors.markers.aruco import Found, in_order
from fgloc.sensors.markers.detector import Box, MarkerDetector
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.markers.images import GrayImage, decode
from fgloc.types import FloatArray

_EVERY = 30  # images from one search of the whole image at full resolution to the next
_EVERY_WITHOUT = 4  # likewise, while there are no markers
_MOST_SHARE = 0.5  # of the image that is read in parts; beyond that, all of it costs no more
_MAX_GAP_NS = 1_000_000_000  # markers that were seen longer ago are not looked for
_ROOM_PX = 16.0  # around a marker, for the detector's widest threshold and contours that touch the part's border
_ROOM_SHARE = 0.5  # of its side, for motion that differs from that of the other markers
_MARGIN_PX = 12.0  # of that room: for the widest threshold alone
_BORDER_PX = 2.0  # squares that come nearer to the image's border are cut by it


class TrackingDetector:
    """Finds the markers of a camera's images, which have to come in their order.

    Attributes:
        counts: images searched at full resolution ("whole"), coarsely ("coarse"), and the latter's parts that were read
            at full resolution ("parts").
    """

    def __init__(self, detector: MarkerDetector) -> None:
        """Take a detector, which may be used elsewhere too."""
        self.counts: Counter[str] = Counter()
        self._detector = detector
        self._coarse = detector.coarse()
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
        known = self._last if image.shape == self._shape else []
        follows = image.shape == self._shape and 0 <= stamp_ns - self._last_ns <= _MAX_GAP_NS
        self._since_whole += 1
        found = None
        if follows and self._since_whole < (_EVERY if known else _EVERY_WITHOUT):
            self.counts["coarse"] += 1
            found = self._coarsely(image, known)
        if found is None:
            self.counts["whole"] += 1
            self._since_whole = 0
            found = self._detector.find(image)
        self._last, self._last_ns, self._shape = found, stamp_ns, image.shape
        return found

    def _coarsely(self, image: GrayImage, known: Found) -> Found | None:
        """What a coarse search and a close look at some parts find; None if the whole image is to be searched."""
        found, squares = self._coarse.find(image)
        missing, moved = _compare(known, found)
        if missing:
            shift = np.median(moved, axis=0) if moved else np.zeros(2)
            squares += [corners + shift for corners in missing]
        parts = _parts(squares, found, image.shape) if squares else []
        if sum((right - left) * (bottom - top) for left, top, right, bottom in parts) > _MOST_SHARE * image.size:
            return None
        for part in parts:
            self.counts["parts"] += 1
            read = self._detector.find_within(image, part)
            found += [(i, c) for i, c in read if not any(i == j and _near(c, d) for j, d in found)]
        return None if known and not found else in_order(found)


def _compare(known: Found, found: Found) -> tuple[list[FloatArray], list[FloatArray]]:
    """Corners of the last image's markers that are missing now, and how far those that are not have moved ``(2,)``."""
    left: dict[int, deque[FloatArray]] = {}
    for i, corners in found:
        left.setdefault(i, deque()).append(corners)
    missing, moved = [], []
    for i, corners in known:
        if left.get(i):
            moved.append(left[i].popleft()[0] - corners[0])
        else:
            missing.append(corners)
    return missing, moved


def _parts(squares: Iterable[FloatArray], found: Found, shape: tuple[int, ...]) -> list[Box]:
    """The parts of an image in which squares are to be read, but for those of markers that were found."""
    size = np.array([shape[1], shape[0]])
    parts: list[Box] = []
    for square in squares:
        low, high = square.min(axis=0), square.max(axis=0)
        leaves = (low < _BORDER_PX).any() or (high > size - 1.0 - _BORDER_PX).any()
        if leaves or any(_near(c, square) for _, c in found) or any(_contains(p, low, high) for p in parts):
            continue
        parts.append(_box_around(low, high, size))
    return parts


def _contains(part: Box, low: FloatArray, high: FloatArray) -> bool:
    """Whether a part holds a square with the room that a search of it needs."""
    return bool((low - part[:2] >= _MARGIN_PX).all() and (part[2:] - high > _MARGIN_PX).all())


def _box_around(low: FloatArray, high: FloatArray, size: FloatArray) -> Box:
    """The part of an image around a square."""
    room = _ROOM_PX + _ROOM_SHARE * float((high - low).max())
    left, top = np.maximum(np.floor(low - room), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high + room) + 1, size).astype(int).tolist()
    return left, top, right, bottom


def _near(a: FloatArray, b: FloatArray) -> bool:
    """Whether two quadrilaterals are one and the same marker."""
    side = float(np.linalg.norm(a - np.roll(a, 1, axis=0), axis=1).max())
    return bool(np.linalg.norm(a.mean(axis=0) - b.mean(axis=0)) < 0.5 * side)
