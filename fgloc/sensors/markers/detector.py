"""Marker detection in images: ArUco and AprilTag, sub-pixel corners, and hints on why nothing is found."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

import cv2
import numpy as np
from cv2.typing import MatLike

from fgloc.config import MarkersConfig
from fgloc.sensors.markers.dictionaries import load_dictionary, suggest, turned_by_180
from fgloc.sensors.markers.edges import refine_corners
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.markers.images import GrayImage, ImageError, decode
from fgloc.types import Event, FloatArray

_LOOKAHEAD = 4  # images that may be detected before the consumer asks for them
_SECOND_LOOKS = 12  # small unreadable squares of an image that are enlarged and read again
_SECOND_LOOK_SIDE_PX = (6.0, 32.0)  # smaller ones cannot be read, larger ones needed no enlarging
_ENLARGE = 3
_HINT_RATIO = 2  # a changed image has to show more than this many times the markers to be worth a hint


class Detector(Protocol):
    """What finds markers in images."""

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; see `MarkerDetector.detect`."""
        ...


class MarkerDetector:
    """Finds the markers of one dictionary.

    Corners are in the order of MarkerCorners. AprilTags count as upright in the way that the AprilTag project prints
    them, whichever way the installed OpenCV draws them (before 5.1 it draws them turned by 180 degrees).

    Small squares that OpenCV finds but cannot read are enlarged and read once more: this finds markers of little more
    than one pixel per cell without correcting more wrong bits, which would let false markers in.
    """

    def __init__(self, dictionary: str, config: MarkersConfig) -> None:
        """Prepare detection.

        Args:
            dictionary: OpenCV's name ("DICT_4X4_50", "DICT_APRILTAG_36h11") or an OpenCV dictionary file (.yml).
            config: detection settings.

        Raises:
            ConfigError: there is no such dictionary; the names that there are are listed.
        """
        self._config = config
        self.dictionary = dictionary
        self._dictionary = load_dictionary(dictionary)
        self._cells = int(self._dictionary.markerSize) + 2
        self._turn = 2 if turned_by_180(dictionary) else 0
        self._first = cv2.aruco.ArucoDetector(self._dictionary, _parameters(smallest=0.03))
        self._second = cv2.aruco.ArucoDetector(self._dictionary, _parameters(smallest=1.0))

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image, ordered by id and place; an image without markers gives an event without sightings.

        Raises:
            ImageError: the image cannot be decoded.
        """
        found = self.find(decode(event))
        sightings = tuple(MarkerCorners(i, corners) for i, corners in found)
        return CornersEvent(event.stamp_ns, event.received_ns, event.topic, event.frame_id, sightings)

    def find(self, image: GrayImage) -> list[tuple[int, FloatArray]]:
        """Id and corners ``(4, 2)`` of each marker in a gray image, ordered by id, then from the left."""
        return self.read(image)[0]

    def read(self, image: GrayImage) -> tuple[list[tuple[int, FloatArray]], int]:
        """What `find` finds, and how many squares there were that could have been markers."""
        if min(image.shape) < 16:
            return [], 0
        corners, ids, rejected = self._first.detectMarkers(image)
        found = _pairs(ids, corners)
        found += self._look_again(image, rejected, found)
        refined = [(i, refine_corners(image, c, self._cells)) for i, c in found]
        turned = [(i, np.roll(c, self._turn, axis=0)) for i, c in refined]
        return sorted(turned, key=lambda f: (f[0], *f[1].mean(axis=0))), len(corners) + len(rejected)

    def diagnose(self, image: GrayImage) -> list[str]:
        """Hints, one sentence each, on an image in which fewer markers are found than there should be."""
        hints = []
        here = len(self.find(image))
        if len(self.find(np.ascontiguousarray(image[:, ::-1]))) > _HINT_RATIO * here:
            hints.append(
                "The markers are seen mirrored: the camera driver flips the image, or they were printed mirrored."
            )
        if len(self.find(255 - image)) > _HINT_RATIO * here:
            hints.append("The markers are seen inverted, white on black: print them black on white.")
        return hints

    def _look_again(
        self, image: GrayImage, rejected: Sequence[MatLike], found: Sequence[tuple[int, FloatArray]]
    ) -> list[tuple[int, FloatArray]]:
        """Markers among the small squares that could not be read."""
        more: list[tuple[int, FloatArray]] = []
        for square in _small_squares(rejected):
            center = square.mean(axis=0)
            if any(_inside(c, center) for _, c in [*found, *more]):
                continue
            reach = np.ptp(square, axis=0).max()
            low = np.maximum(np.floor(center - reach), 0).astype(int)
            high = np.minimum(np.ceil(center + reach).astype(int) + 1, image.shape[::-1])
            part = image[low[1] : high[1], low[0] : high[0]]
            large = cv2.resize(part, None, fx=_ENLARGE, fy=_ENLARGE, interpolation=cv2.INTER_CUBIC)
            corners, ids, _ = self._second.detectMarkers(large)
            for i, c in _pairs(ids, corners):
                original = (c + 0.5) / _ENLARGE - 0.5 + low
                if not any(_inside(k, original.mean(axis=0)) for _, k in [*found, *more]):
                    more.append((i, original))
        return more


def suggest_dictionary(images: Iterable[GrayImage]) -> str | None:
    """The smallest predefined dictionary that fits what is seen in the images, or None if that could be chance."""
    config = MarkersConfig()
    gray = list(images)

    def look(name: str) -> tuple[list[int], int]:
        detector = MarkerDetector(name, config)
        looks = [detector.read(image) for image in gray]
        return [i for found, _ in looks for i, _ in found], sum(squares for _, squares in looks)

    return suggest(look)


def use_one_thread() -> None:
    """Switch OpenCV's own threads off for the process: beside a detection thread they take the estimator's core."""
    cv2.setNumThreads(1)


def detect_stream(events: Iterable[Event], detector: Detector, rejections: Counter[str]) -> Iterator[Event]:
    """All events in their order, with a CornersEvent in the place of each image.

    Detection runs in one thread of its own, at most a few images ahead of the consumer; OpenCV releases Python's lock
    meanwhile. OpenCV's own threads are switched off for the process, so that the rest keeps its core.

    Args:
        events: any events; an image that cannot be decoded is left out.
        detector: not to be used elsewhere at the same time.
        rejections: counts images left out, as "image." and the reason.
    """
    use_one_thread()
    waiting: deque[Event | Future[CornersEvent]] = deque()
    images = 0
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="marker-detection")
    try:
        for event in events:
            if isinstance(event, ImageEvent):
                waiting.append(worker.submit(detector.detect, event))
                images += 1
            else:
                waiting.append(event)
            while waiting and (images > _LOOKAHEAD or not isinstance(waiting[0], Future) or waiting[0].done()):
                images -= isinstance(waiting[0], Future)
                yield from _resolved(waiting.popleft(), rejections)
        while waiting:
            yield from _resolved(waiting.popleft(), rejections)
    finally:
        worker.shutdown(wait=True, cancel_futures=True)


def _resolved(item: Event | Future[CornersEvent], rejections: Counter[str]) -> Iterator[Event]:
    if not isinstance(item, Future):
        yield item
        return
    try:
        yield item.result()
    except ImageError as error:
        rejections[f"image.{error.reason}"] += 1


def _parameters(smallest: float) -> cv2.aruco.DetectorParameters:
    """Detection settings; `smallest` is a marker's least perimeter in units of the image's longer side.

    The refinement window of half a cell (at most 10 pixels) is the largest that never reaches the next cell's edge; its
    corners are where the fit of the edges starts. Cells are sampled 8 pixels wide without the outer quarters, where
    blur mixes them with their neighbours.
    """
    p = cv2.aruco.DetectorParameters()
    p.minMarkerPerimeterRate = smallest
    p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    p.cornerRefinementWinSize = 10
    p.relativeCornerRefinmentWinSize = 0.5
    p.cornerRefinementMinAccuracy = 0.01
    p.perspectiveRemovePixelPerCell = 8
    p.perspectiveRemoveIgnoredMarginPerCell = 0.25
    return p


def _pairs(ids: MatLike | None, corners: Sequence[MatLike]) -> list[tuple[int, FloatArray]]:
    if ids is None:
        return []
    return [(int(i), np.asarray(c, dtype=np.float64).reshape(4, 2)) for i, c in zip(ids.ravel(), corners, strict=True)]


def _small_squares(rejected: Sequence[MatLike]) -> list[FloatArray]:
    """Squares ``(4, 2)`` worth a second look, largest first."""
    low, high = _SECOND_LOOK_SIDE_PX
    squares = [np.asarray(r, dtype=np.float64).reshape(4, 2) for r in rejected]
    sides = [np.linalg.norm(s - np.roll(s, 1, axis=0), axis=1) for s in squares]
    kept = [(float(e.sum()), s) for e, s in zip(sides, squares, strict=True) if low < e.min() and e.max() < high]
    return [s for _, s in sorted(kept, key=lambda item: -item[0])[:_SECOND_LOOKS]]


def _inside(corners: FloatArray, point: FloatArray) -> bool:
    return bool(cv2.pointPolygonTest(corners.astype(np.float32), (float(point[0]), float(point[1])), False) >= 0)
