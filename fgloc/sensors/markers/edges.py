"""Marker corners from straight lines along the marker's edges, to a few hundredths of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

BoolArray = NDArray[np.bool_]

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
_MIN_CROSSING = 0.2  # sine of the angle in which two edges meet

_SIGNS = np.array([1.0, -1.0])
_WITH_NEXT, _WITH_PREVIOUS = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])
_STEPS_ALONG = np.linspace(0.0, 1.0, _ALONG)
_STEPS_ACROSS = np.linspace(-1.0, 1.0, _ACROSS)
_MIDDLES = 0.5 * (_STEPS_ACROSS[1:] + _STEPS_ACROSS[:-1])


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
    found = corners.astype(np.float64)
    clear = np.arange(len(corners))  # markers with clear edges so far
    for _ in range(_ITERATIONS):
        if not len(clear):
            break
        moved, fits = _meeting_points(image, found[clear], cells)
        fits &= np.abs(moved - corners[clear]).max(axis=(1, 2)) <= _MAX_MOVE_PX
        found[clear[fits]] = moved[fits]
        found[clear[~fits]] = corners[clear[~fits]]
        clear = clear[fits]
    return found


def _meeting_points(image: GrayImage, corners: FloatArray, cells: int) -> tuple[FloatArray, BoolArray]:
    """Corners ``(m, 4, 2)`` one step better, and of which markers ``(m,)`` the edges are clear."""
    m = len(corners)
    # 1. Each edge is seen from its two ends: index [marker, edge, end].
    following = corners[:, _WITH_NEXT]
    sides = following - corners
    lengths = np.sqrt((sides * sides).sum(axis=2))
    clear = lengths.min(axis=1) >= _MIN_SIDE_PX
    lengths = np.where(clear[:, None], lengths, 1.0)
    along = sides / lengths[..., None]
    outward = np.stack([along[..., 1], -along[..., 0]], axis=2)
    starts = np.stack([corners, following], axis=2)
    near = np.minimum(1.5, 0.1 * lengths)
    s = near[..., None] + _STEPS_ALONG * (np.minimum(0.5 * lengths, _MAX_LENGTH_PX) - near)[..., None]
    half_width = np.clip(_CELL_SHARE * lengths / cells, 1.0, _MAX_HALF_WIDTH_PX)
    # 2. Profiles across the edges. Outwards they rise from black to white; falling parts belong to inner cells.
    on_edge = starts[:, :, :, None] + (_SIGNS[:, None] * s[:, :, None])[..., None] * along[:, :, None, None]
    across = (_STEPS_ACROSS * half_width[..., None])[..., None] * outward[:, :, None]
    points = on_edge[:, :, :, :, None] + across[:, :, None, None]
    flat = points.reshape(-1, _ACROSS, 2).astype(np.float32)
    levels = cv2.remap(image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rise = np.maximum(np.diff(np.asarray(levels, dtype=float).reshape(m, 4, 2, _ALONG, _ACROSS), axis=4), 0.0)
    rise = np.maximum(rise - _FLOOR * rise.max(axis=4, keepdims=True), 0.0)
    weights = rise.sum(axis=4)
    totals = weights.sum(axis=3)
    clear &= totals.min(axis=(1, 2)) > 0.0
    offsets = half_width[:, :, None, None] * (rise @ _MIDDLES) / np.maximum(weights, 1e-9)
    edge_points = on_edge + offsets[..., None] * outward[:, :, None, None]
    # 3. A line through each end's edge points: weighted total least squares.
    share = (weights / np.where(totals > 0.0, totals, 1.0)[..., None])[..., None]
    centers = (share * edge_points).sum(axis=3)
    spread = edge_points - centers[:, :, :, None]
    normals = _narrow_direction(np.swapaxes(share * spread, 3, 4) @ spread)
    # 4. A corner lies on the start of its edge and on the end of the one before.
    distances = (normals * centers).sum(axis=3)
    first, second = normals[:, :, 0], normals[:, _WITH_PREVIOUS, 1]
    a, b = distances[:, :, 0], distances[:, _WITH_PREVIOUS, 1]
    crossing = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    clear &= np.abs(crossing).min(axis=1) >= _MIN_CROSSING
    crossing = np.where(clear[:, None], crossing, 1.0)
    x = (a * second[..., 1] - b * first[..., 1]) / crossing
    y = (b * first[..., 0] - a * second[..., 0]) / crossing
    return np.stack([x, y], axis=2), clear


def _narrow_direction(cov: FloatArray) -> FloatArray:
    """Unit eigenvectors ``(..., 2)`` of symmetric ``(..., 2, 2)`` for the smaller eigenvalue."""
    angle = 0.5 * np.arctan2(2.0 * cov[..., 0, 1], cov[..., 0, 0] - cov[..., 1, 1])  # of the larger one
    return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
