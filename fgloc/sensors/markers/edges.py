"""Marker corners from straight lines along the marker's edges, to a few hundredths of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complexfloating]

_ALONG = 12  # profiles on the part of an edge that is used for a corner
_ACROSS = 11  # samples of a profile
_MAX_LENGTH_PX = 24.0  # of that part: a lens bends longer ones; a shorter edge belongs to both of its corners
_MIN_SIDE_PX = 6.0
_MAX_HALF_WIDTH_PX = 3.0
_CELL_SHARE = 0.7  # of a cell that a profile reaches to either side
_ITERATIONS = 2
_MOST_AT_ONCE = 128  # markers; OpenCV's remap takes 32767 rows
_MAX_MOVE_PX = 2.5
_FLOOR = 0.1  # of a profile's steepest place; what is flatter is noise
_MIN_VARIANCE = 1e-3  # of the places of edge points, weighted, in units of their range
_MIN_CROSSING = 0.2  # sine of the angle in which two edges meet

_SIGNS = np.array([1.0, -1.0])
_WITH_NEXT, _WITH_PREVIOUS = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])
_ALONG_STEPS = np.linspace(0.0, 1.0, _ALONG)
_ACROSS_STEPS = np.linspace(-1.0, 1.0, _ACROSS)
_SUM_AND_MOMENT = np.stack([np.ones(_ACROSS - 1), 0.5 * (_ACROSS_STEPS[1:] + _ACROSS_STEPS[:-1])]).astype(np.float32)
_POWERS = np.stack([np.ones(_ALONG), _ALONG_STEPS, _ALONG_STEPS**2], axis=1).astype(np.float32)


def refine_corners(image: GrayImage, corners: FloatArray, cells: int) -> FloatArray:
    """Corners ``(4, 2)`` where lines fitted to the marker's edges meet, or the given ones if the edges are unclear.

    As `refine_all`, of one marker.
    """
    return np.asarray(refine_all(image, corners[None], cells)[0])


def refine_all(image: GrayImage, corners: FloatArray, cells: int) -> FloatArray:
    """Corners ``(n, 4, 2)`` of several markers where lines fitted to the edges meet.

    A corner's own neighbourhood (OpenCV's cornerSubPix) draws blurred corners inwards: the marker looks smaller, hence
    farther, by 1 % at 35 pixels and 3 % at 18. Blur moves a straight edge to neither side. Each marker's result is
    the same whichever others there are; one whose edges are unclear keeps the corners that were given.

    Args:
        image: gray levels.
        corners: first guess ``(n, 4, 2)``, right to within a pixel or two, clockwise in the image.
        cells: of a side, with the black border.

    Source: the idea is that of AprilTag 3's edge refinement, Krogius et al., IROS 2019; own formulation.
    """
    if len(corners) > _MOST_AT_ONCE:
        first = refine_all(image, corners[:_MOST_AT_ONCE], cells)
        return np.asarray(np.vstack([first, refine_all(image, corners[_MOST_AT_ONCE:], cells)]))
    # Points and directions of the image are complex numbers x + iy: half as many calls of numpy as for pairs.
    given = np.ascontiguousarray(corners, dtype=np.float64).view(np.complex128)[..., 0]
    # 1. Each edge is seen from its two ends: index [marker, edge, end, place along it].
    following = given[:, _WITH_NEXT]
    sides = following - given
    lengths = np.abs(sides)
    clear = lengths.min(axis=1) >= _MIN_SIDE_PX
    lengths = np.maximum(lengths, 1.0)
    unit = sides / lengths
    near = np.minimum(1.5, 0.1 * lengths)
    reach = np.minimum(lengths - 2.0 * near, _MAX_LENGTH_PX)
    half_width = np.minimum(np.maximum(_CELL_SHARE * lengths / cells, 1.0), _MAX_HALF_WIDTH_PX)
    outward = (half_width * (-1j * unit))[..., None]
    starts = np.stack([given + near * unit, following - near * unit], axis=2)
    along = (reach * unit)[..., None] * _SIGNS
    places = starts[..., None] + along[..., None] * _ALONG_STEPS
    # 2. A line through the edge points of each end, offset + slope * place, seen again from where the first one was.
    across = (_ACROSS_STEPS[:, None, None, None, None] * outward[..., None]).astype(np.complex64)
    offset, slope, sharp = _lines(image, places, across)
    clear &= sharp
    for _ in range(_ITERATIONS - 1):
        shifts = offset[..., None] + slope[..., None] * _ALONG_STEPS
        more_offset, more_slope, sharp = _lines(image, places + outward[..., None] * shifts, across)
        offset, slope, clear = offset + more_offset, slope + more_slope, clear & sharp
    # 3. A corner lies on the start of its edge and on the end of the one before.
    moved, crossed = _meeting_points(starts + outward * offset, along + outward * slope)
    move = (moved - given).view(np.float64)
    clear &= crossed & (np.abs(move).max(axis=1) <= _MAX_MOVE_PX)
    return np.where(clear[:, None], moved, given)[..., None].view(np.float64)


def _meeting_points(origins: ComplexArray, directions: ComplexArray) -> tuple[ComplexArray, BoolArray]:
    """Where lines ``(m, 4, 2)``, of two ends of four edges, meet: corners ``(m, 4)``, and of which markers ``(m,)``."""
    first, second = directions[:, :, 0], directions[:, _WITH_PREVIOUS, 1]
    crossing = cross(first, second)
    least = _MIN_CROSSING * np.abs(first) * np.abs(second)
    clear = np.asarray((np.abs(crossing) >= least).all(axis=1))
    steps = cross(origins[:, _WITH_PREVIOUS, 1] - origins[:, :, 0], second) / np.where(clear[:, None], crossing, 1.0)
    return origins[:, :, 0] + first * steps, clear


def _lines(image: GrayImage, places: ComplexArray, across: ComplexArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Lines of edge points, offset at the first place and slope ``(m, 4, 2)``; of which markers ``(m,)`` all are clear.

    Offset and slope are in units of a profile's half width, per step from the first place to the last. Edge points are
    uncertain across the edge only: weighted least squares, with the rise of gray level as weight.

    Args:
        image: gray levels.
        places: middles ``(m, 4, 2, n)`` of the profiles.
        across: samples of a profile from its middle ``(k, m, 4, 1, 1)``, outwards.
    """
    # Outwards profiles rise from black to white; falling parts belong to inner cells.
    points = places.astype(np.complex64) + across
    maps = points.view(np.float32).reshape(_ACROSS, -1, 2)
    levels = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    rise = cv2.subtract(levels[1:], levels[:-1], dtype=cv2.CV_32F)
    rise = np.maximum(rise - np.float32(_FLOOR) * rise.max(axis=0), np.float32(0.0))
    sums = (_SUM_AND_MOMENT @ rise).reshape(2, *places.shape) @ _POWERS
    w, wx, wxx = np.moveaxis(sums[0].astype(np.float64), 3, 0)
    wy, wxy = np.moveaxis(sums[1, ..., :2].astype(np.float64), 3, 0)
    determinant = w * wxx - wx * wx
    sharp = determinant > _MIN_VARIANCE * w * w
    determinant = np.where(sharp, determinant, 1.0)
    offset = (wxx * wy - wx * wxy) / determinant
    slope = (w * wxy - wx * wy) / determinant
    return offset, slope, sharp.all(axis=(1, 2))


def cross(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Cross product of vectors of the plane."""
    return np.asarray((a.conj() * b).imag)
