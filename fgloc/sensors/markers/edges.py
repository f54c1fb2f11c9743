"""Marker corners from straight lines along the marker's edges, to a few hundredths of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]

_ALONG = 12  # profiles on the part of an edge that belongs to a corner
_ACROSS = 11  # samples of a profile
_MAX_LENGTH_PX = 24.0  # of that part: a lens bends longer ones
_MIN_SIDE_PX = 6.0
_MAX_HALF_WIDTH_PX = 3.0
_CELL_SHARE = 0.7  # of a cell that a profile reaches to either side
_ITERATIONS = 2
_MOST_AT_ONCE = 128  # markers; OpenCV's remap takes 32767 rows
_MAX_MOVE_PX = 2.5
_FLOOR = 0.1  # of a profile's steepest place; what is flatter is noise
_TINY = 1e-9  # in place of a weight of zero
_MIN_CROSSING = 0.2  # sine of the angle in which two edges meet

_WITH_NEXT, _WITH_PREVIOUS = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])
_STEPS_ALONG = np.linspace(0.0, 1.0, _ALONG)
_STEPS_ACROSS = np.linspace(-1.0, 1.0, _ACROSS)
_SUM_AND_MOMENT = np.stack([np.ones(_ACROSS - 1), 0.5 * (_STEPS_ACROSS[1:] + _STEPS_ACROSS[:-1])]).astype(np.float32)


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
    given = np.ascontiguousarray(corners, dtype=np.float64).view(np.complex128)[..., 0]
    found = given.copy()
    clear = np.arange(len(given))  # markers with clear edges so far
    for _ in range(_ITERATIONS):
        if not len(clear):
            break
        moved, fits = _meeting_points(image, found[clear], cells)
        move = moved - given[clear]
        fits &= np.maximum(np.abs(move.real), np.abs(move.imag)).max(axis=1) <= _MAX_MOVE_PX
        found[clear] = np.where(fits[:, None], moved, given[clear])
        clear = clear[fits]
    return found[..., None].view(np.float64)


def _meeting_points(image: GrayImage, corners: ComplexArray, cells: int) -> tuple[ComplexArray, BoolArray]:
    """Corners ``(m, 4)`` one step better, and of which markers ``(m,)`` the edges are clear.

    Points and directions of the image are complex numbers x + iy: numpy takes half as many calls as for pairs.
    """
    # 1. Each edge is seen from its two ends: index [marker, edge, end, place along it].
    following = corners[:, _WITH_NEXT]
    sides = following - corners
    lengths = np.abs(sides)
    clear = lengths.min(axis=1) >= _MIN_SIDE_PX
    lengths = np.maximum(lengths, 1.0)
    along = sides / lengths
    near = np.minimum(1.5, 0.1 * lengths)
    reach = np.minimum(0.5 * lengths, _MAX_LENGTH_PX) - near
    s = along[..., None] * (near[..., None] + _STEPS_ALONG * reach[..., None])
    half_width = np.minimum(np.maximum(_CELL_SHARE * lengths / cells, 1.0), _MAX_HALF_WIDTH_PX)
    outward = half_width * (-1j * along)
    on_edge = np.empty((len(corners), 4, 2, _ALONG), dtype=np.complex128)
    np.add(corners[..., None], s, out=on_edge[:, :, 0])
    np.subtract(following[..., None], s, out=on_edge[:, :, 1])
    # 2. Profiles across the edges. Outwards they rise from black to white; falling parts belong to inner cells.
    across = (_STEPS_ACROSS[:, None, None] * outward).astype(np.complex64)
    points = on_edge.astype(np.complex64) + across[..., None, None]
    places = points.view(np.float32).reshape(_ACROSS, -1, 2)
    levels = cv2.remap(image, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    rise = cv2.subtract(levels[1:], levels[:-1], dtype=cv2.CV_32F)
    rise = np.maximum(rise - np.float32(_FLOOR) * rise.max(axis=0), np.float32(0.0))
    weights, moments = (_SUM_AND_MOMENT @ rise).reshape(2, *on_edge.shape)
    totals = weights.sum(axis=3)
    clear &= totals.min(axis=(1, 2)) > 0.0
    edge_points = on_edge + outward[:, :, None, None] * (moments / np.maximum(weights, _TINY))
    # 3. A line through each end's edge points: weighted total least squares. The square root of the second moment, of
    # which the real part is xx - yy and the imaginary part 2 xy, points along the line.
    share = weights / np.maximum(totals, _TINY)[..., None]
    centers = (share * edge_points).sum(axis=3)
    spread = edge_points - centers[..., None]
    directions = np.sqrt((share * spread * spread).sum(axis=3))
    directions /= np.maximum(np.abs(directions), _TINY)
    # 4. A corner lies on the start of its edge and on the end of the one before.
    first, second = directions[:, :, 0], directions[:, _WITH_PREVIOUS, 1]
    crossing = _cross(first, second)
    clear &= np.abs(crossing).min(axis=1) >= _MIN_CROSSING
    from_first = _cross(centers[:, _WITH_PREVIOUS, 1] - centers[:, :, 0], second)
    return centers[:, :, 0] + first * (from_first / np.where(clear[:, None], crossing, 1.0)), clear


def _cross(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Cross product of vectors of the plane."""
    return np.asarray((a.conj() * b).imag)
