"""Marker detection in images: ArUco and AprilTag, sub-pixel corners, and hints on why nothing is found."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike

from fgloc.config import Config
from fgloc.errors import ConfigError
from fgloc.sensors.detection import Detector, RememberingDetector
from fgloc.sensors.markers.aruco import ALL_WINDOWS, SMALLEST, Found, in_order, inside, pairs, parameters, subpixel
from fgloc.sensors.markers.coarse import CoarseSearch
from fgloc.sensors.markers.config import MarkersConfig
from fgloc.sensors.markers.dictionaries import load_dictionary, suggest, turned_by_180
from fgloc.sensors.markers.edges import refine_all
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.markers.images import GrayImage, decode
from fgloc.types import FloatArray, LandmarkMap

_LEAST_SIDE_PX = 16  # of an image
_SECOND_LOOKS = 12  # small unreadable squares of an image that are enlarged and read again
_SECOND_LOOK_SIDE_PX = (6.0, 32.0)  # smaller ones cannot be read, larger ones needed no enlarging
_ENLARGE = 3
_HINT_RATIO = 2  # a changed image has to show more than this many times the markers to be worth a hint


Box = tuple[int, int, int, int]
"""Part of an image [px]: left, top, and the first column and row beyond it."""


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
        self._whole = cv2.aruco.ArucoDetector(self._dictionary, parameters(ALL_WINDOWS))
        enlarged = parameters(ALL_WINDOWS, smallest=1.0)
        enlarged.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._second = cv2.aruco.ArucoDetector(self._dictionary, enlarged)

    def following(self) -> Detector:
        """A detector that follows the markers from image to image, which have to come in their order."""
        from fgloc.sensors.markers.tracking import TrackingDetector

        return TrackingDetector(self)

    def coarse(self) -> CoarseSearch:
        """A faster search, for images between those that this one searches."""
        return CoarseSearch(self._dictionary, self._turn)

    def remembering(self, detector: Detector, file: Path | None, known: Any, note: bool = True) -> RememberingDetector:
        """A detector that asks another one only about images that are not known, from a file or an earlier run."""
        from fgloc.sensors.markers.remembered import RememberedDetections

        return RememberedDetections(file, detector, known, note)

    def hints(self, recording: Any) -> tuple[tuple[str, ...], str | None]:
        """What may be wrong where no marker is found; see `fgloc.sensors.markers.hints.image_hints`."""
        from fgloc.sensors.markers.hints import image_hints

        return image_hints(recording, self)

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image, ordered by id and place; an image without markers gives an event without sightings.

        Raises:
            ImageError: the image cannot be decoded.
        """
        found = self.find(decode(event))
        sightings = tuple(MarkerCorners(i, corners) for i, corners in found)
        return CornersEvent(event.stamp_ns, event.received_ns, event.topic, event.frame_id, sightings)

    def find(self, image: GrayImage) -> Found:
        """Id and corners ``(4, 2)`` of each marker in a gray image, ordered by id, then from the left."""
        return self.read(image)[0]

    def read(self, image: GrayImage) -> tuple[Found, int]:
        """What `find` finds, and how many squares there were that could have been markers."""
        found, squares = self._search(image, None)
        return self._refined(image, found), squares

    def find_within(self, image: GrayImage, box: Box) -> Found:
        """As `find`, of a part of the image: markers in it that are wholly some ten pixels from its borders."""
        return self._refined(image, self._search(image, box)[0])

    def _search(self, image: GrayImage, box: Box | None) -> tuple[Found, int]:
        """Ids with corners in the whole image's pixels, not refined by their edges, and the number of squares."""
        left, top, right, bottom = box or (0, 0, image.shape[1], image.shape[0])
        part = np.ascontiguousarray(image[top:bottom, left:right])
        if min(part.shape) < _LEAST_SIDE_PX:
            return [], 0
        detector = self._whole
        if box is not None:
            smallest = SMALLEST * max(image.shape) / max(part.shape)
            detector = cv2.aruco.ArucoDetector(self._dictionary, parameters(ALL_WINDOWS, smallest))
        corners, ids, rejected = detector.detectMarkers(part)
        at = np.array([left, top], dtype=float)
        # From here on in the whole image, so that a part of it gives the same numbers.
        found: Found = []
        if ids is not None:
            exact = subpixel(image, np.concatenate(corners) + at, self._cells)
            found = [(int(i), c) for i, c in zip(ids.ravel(), exact, strict=True)]
        found += self._look_again(image, [square + at for square in rejected], found)
        return found, len(corners) + len(rejected)

    def _refined(self, image: GrayImage, found: Found) -> Found:
        """Corners from the markers' edges, in the order of `find`."""
        if not found:
            return []
        refined = refine_all(image, np.array([c for _, c in found]), self._cells)
        turned = [(i, np.roll(c, self._turn, axis=0)) for (i, _), c in zip(found, refined, strict=True)]
        return in_order(turned)

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

    def _look_again(self, image: GrayImage, rejected: Sequence[MatLike], found: Found) -> Found:
        """Markers among the small squares that could not be read."""
        more: Found = []
        for square in _small_squares(rejected):
            center = square.mean(axis=0)
            if any(inside(c, center) for _, c in [*found, *more]):
                continue
            reach = np.ptp(square, axis=0).max()
            low = np.maximum(np.floor(center - reach), 0).astype(int)
            high = np.minimum(np.ceil(center + reach).astype(int) + 1, image.shape[::-1])
            part = image[low[1] : high[1], low[0] : high[0]]
            large = cv2.resize(part, None, fx=_ENLARGE, fy=_ENLARGE, interpolation=cv2.INTER_CUBIC)
            corners, ids, _ = self._second.detectMarkers(large)
            for i, c in pairs(ids, corners):
                original = (c + 0.5) / _ENLARGE - 0.5 + low
                if not any(inside(k, original.mean(axis=0)) for _, k in [*found, *more]):
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


def configured_detector(config: Config, landmark_map: LandmarkMap | None) -> MarkerDetector:
    """The detector of the configured dictionary, or of the map's.

    Raises:
        ConfigError: neither names one.
    """
    dictionary = config.markers.dictionary or (landmark_map.dictionary if landmark_map is not None else "")
    if not dictionary:
        raise ConfigError("no marker dictionary: set markers.dictionary (such as DICT_4X4_50) in --config or the map")
    return MarkerDetector(dictionary, config.markers)


def _small_squares(rejected: Sequence[MatLike]) -> list[FloatArray]:
    """Squares ``(4, 2)`` worth a second look, largest first."""
    low, high = _SECOND_LOOK_SIDE_PX
    squares = [np.asarray(r, dtype=np.float64).reshape(4, 2) for r in rejected]
    sides = [np.linalg.norm(s - np.roll(s, 1, axis=0), axis=1) for s in squares]
    kept = [(float(e.sum()), s) for e, s in zip(sides, squares, strict=True) if low < e.min() and e.max() < high]
    return [s for _, s in sorted(kept, key=lambda item: -item[0])[:_SECOND_LOOKS]]
