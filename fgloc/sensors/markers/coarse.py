"""A search of the whole image at half the resolution: a fifth of the time. Corners are those of the full one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike

from fgloc.sensors.markers.aruco import SMALLEST, Found, parameters, subpixel
from fgloc.sensors.markers.codes import Codes
from fgloc.sensors.markers.edges import refine_all
from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

_SCALE = 2  # full pixels in one of the coarse search
_WINDOW_PX = 5  # of the adaptive threshold, in coarse pixels
_LEAST_CELL_PX = 1.0  # coarse pixels
_APART = 0.05  # of a square's outline: outlines of one and the same square are nearer to each other
_CLEAR_CELL_PX = 2.5  # full pixels: narrower cells are not read for sure from corners that are a pixel off
_SURE_PX = 1.0  # corners that their edges move farther may not be those of these edges


class CoarseSearch:
    """Finds markers of which a cell is at least some two pixels wide."""

    def __init__(self, dictionary: Any, turn: int) -> None:
        """Prepare the search.

        Args:
            dictionary: OpenCV's.
            turn: places by which to roll OpenCV's corners.
        """
        self._cells = int(dictionary.markerSize) + 2
        self._turn = turn
        self._codes = Codes(dictionary)
        self._shape: tuple[int, ...] = ()
        # OpenCV is to find squares only: with a single code, which it looks for in vain or not.
        single = cv2.aruco.Dictionary(dictionary.bytesList[:1], dictionary.markerSize, 0)
        self._squares = cv2.aruco.ArucoDetector(single, self._parameters())

    def find(self, image: GrayImage) -> tuple[Found, list[FloatArray]]:
        """Markers of a gray image, in no order, and squares ``(4, 2)`` to be read closely.

        A marker of which the corners are in doubt is among the squares; those of the others are within some hundredths
        of a pixel of what `MarkerDetector.find` gives.
        """
        half = cv2.resize(image, None, fx=1.0 / _SCALE, fy=1.0 / _SCALE, interpolation=cv2.INTER_AREA)
        if half.shape != self._shape:
            self._shape = half.shape
            self._squares.setDetectorParameters(self._parameters())
        with_code, _, others = self._squares.detectMarkers(half)
        seen = [*with_code, *others]
        if not seen:
            return [], []
        squares = _in_full_pixels(seen)
        codes = self._codes.read(image, squares)
        doubtful = self._too_small(squares, {k for k, _, _ in codes})
        if not codes:
            return [], doubtful
        guesses = subpixel(image, np.array([np.roll(squares[k], turns, axis=0) for k, _, turns in codes]), self._cells)
        edges = refine_all(image, guesses, self._cells)
        moved = np.abs(edges - guesses).max(axis=(1, 2)).tolist()
        found = []
        for move, (_, marker_id, _), exact in zip(moved, codes, edges, strict=True):
            if 0.0 < move <= _SURE_PX:  # unclear edges leave the guess as it is
                found.append((marker_id, np.roll(exact, self._turn, axis=0)))
            else:
                doubtful.append(exact)
        return found, doubtful

    def _too_small(self, squares: FloatArray, read: set[int]) -> list[FloatArray]:
        """Squares that were not read, of which the cells would be narrower than an error of their corners allows."""
        if len(read) == len(squares):
            return []
        sides = np.abs(squares - squares[:, [1, 2, 3, 0]]).max(axis=2).min(axis=1)
        return [squares[k] for k in np.flatnonzero(sides < _CLEAR_CELL_PX * self._cells).tolist() if k not in read]

    def _parameters(self) -> cv2.aruco.DetectorParameters:
        """Detection settings for the present size of images."""
        least_px = 4 * self._cells * _LEAST_CELL_PX
        p = parameters((_WINDOW_PX, _WINDOW_PX, 1), max(SMALLEST, least_px / max(self._shape, default=1)))
        p.minDistanceToBorder = 1
        p.minMarkerDistanceRate = _APART
        p.perspectiveRemovePixelPerCell, p.perspectiveRemoveIgnoredMarginPerCell = 1, 0.0
        return p


def _in_full_pixels(corners: Sequence[MatLike]) -> FloatArray:
    """Squares ``(n, 4, 2)`` of the coarse search, in the image's pixels.

    OpenCV's contours go through the outermost pixels of what is black, half a pixel inside its edge.
    """
    points = np.concatenate(corners).astype(np.float64).view(np.complex128)[..., 0]  # x + iy
    sides = points - points[:, [1, 2, 3, 0]]
    units = sides / np.abs(sides)
    points += 0.5 * (units - units[:, [3, 0, 1, 2]])
    return np.asarray(_SCALE * points[..., None].view(np.float64) + 0.5 * (_SCALE - 1))
