"""OpenCV's ArUco detector: its settings, and what it returns in fgloc's form."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from cv2.typing import MatLike

from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

Found = list[tuple[int, FloatArray]]
"""Id and corners ``(4, 2)`` of markers."""

SMALLEST = 0.03  # perimeter of the smallest marker, in units of the image's longer side
ALL_WINDOWS = (3, 23, 10)  # of the adaptive threshold [px]: smallest, largest, step
_SUBPIX_WINDOW_PX, _SUBPIX_SHARE = 10, 0.5  # half the window of a corner: at most, and as a share of a cell
_SUBPIX_STOP = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 30, 0.01)


def parameters(windows: tuple[int, int, int], smallest: float = SMALLEST) -> cv2.aruco.DetectorParameters:
    """Detection settings.

    Cells are sampled 8 pixels wide without the outer quarters, where blur mixes them with their neighbours.

    Args:
        windows: of the adaptive threshold [px]: smallest, largest, step.
        smallest: least perimeter of a marker, in units of the image's longer side.
    """
    p = cv2.aruco.DetectorParameters()
    p.adaptiveThreshWinSizeMin, p.adaptiveThreshWinSizeMax, p.adaptiveThreshWinSizeStep = windows
    p.minMarkerPerimeterRate = smallest
    p.cornerRefinementWinSize = _SUBPIX_WINDOW_PX
    p.relativeCornerRefinmentWinSize = _SUBPIX_SHARE
    p.cornerRefinementMinAccuracy = _SUBPIX_STOP[2]
    p.perspectiveRemovePixelPerCell = 8
    p.perspectiveRemoveIgnoredMarginPerCell = 0.25
    return p


def pairs(ids: MatLike | None, corners: Sequence[MatLike]) -> Found:
    """Id with corners of each marker."""
    if ids is None:
        return []
    return [(int(i), np.asarray(c, dtype=np.float64).reshape(4, 2)) for i, c in zip(ids.ravel(), corners, strict=True)]


def inside(corners: FloatArray, point: FloatArray) -> bool:
    """Whether a point is in a quadrilateral."""
    return bool(cv2.pointPolygonTest(corners.astype(np.float32), (float(point[0]), float(point[1])), False) >= 0)


def in_order(found: Found) -> Found:
    """By id, then from the left."""
    return sorted(found, key=lambda f: (f[0], *f[1].mean(axis=0)))


def subpixel(image: GrayImage, corners: FloatArray, cells: int) -> FloatArray:
    """Corners ``(n, 4, 2)``, given to a pixel or two, as OpenCV's detector itself refines them.

    The window of half a cell (at most 10 pixels) is the largest that never reaches the next cell's edge.

    Args:
        image: gray levels.
        corners: of n markers.
        cells: of a side, with the black border.
    """
    start = corners.astype(np.float32)
    sides = start[:, [1, 2, 3, 0]] - start
    cell = np.sqrt((sides * sides).sum(axis=2)).sum(axis=1) / (4 * cells)
    halves = np.minimum(np.maximum(np.rint(_SUBPIX_SHARE * cell), 1), _SUBPIX_WINDOW_PX).astype(int)
    exact = np.empty(start.shape)
    for half in set(halves.tolist()):
        same = halves == half
        found = cv2.cornerSubPix(image, start[same].reshape(-1, 1, 2), (half, half), (-1, -1), _SUBPIX_STOP)
        exact[same] = found.reshape(-1, 4, 2)
    return exact
