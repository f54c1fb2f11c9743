"""Corners of markers: OpenCV's detection, refined by the markers' edges, and the coarse search between full ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

Found = list[tuple[int, FloatArray]]
"""Id and corners ``(4, 2)`` of markers."""

SMALLEST = 0.03  # perimeter of the smallest marker, in units of the image's longer side
ALL_WINDOWS = (3, 23, 10)  # of the adaptive threshold [px]: smallest, largest, step
_SUBPIX_WINDOW_PX, _SUBPIX_SHARE = 10, 0.5  # half the window of a corner: at most, and as a share of a cell
_SUBPIX_STOP = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 30, 0.01)


def detector_parameters(windows: tuple[int, int, int], smallest: float = SMALLEST) -> cv2.aruco.DetectorParameters:
    """Parameters of OpenCV's marker detection.

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
    """Pairs of id and corners ``(4, 2)``, one for each marker."""
    if ids is None:
        return []
    return [(int(i), np.asarray(c, dtype=np.float64).reshape(4, 2)) for i, c in zip(ids.ravel(), corners, strict=True)]


def inside(corners: FloatArray, point: FloatArray) -> bool:
    """Whether a point is in a quadrilateral."""
    return bool(cv2.pointPolygonTest(corners.astype(np.float32), (float(point[0]), float(point[1])), False) >= 0)


def in_order(found: Found) -> Found:
    """Markers sorted by id, then from the left."""
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


_IN_CELL = np.array([-0.15, 0.15])  # where a cell is sampled along each axis, from its middle, in cells
_MIN_CONTRAST = 10.0  # gray levels between black and white: twice OpenCV's minOtsuStdDev
_BORDER_ERRORS = 0.35  # white cells of the black border, in units of the cells inside: maxErroneousBitsInBorderRate
_CORRECTED = 0.6  # of the errors that the dictionary can correct: errorCorrectionRate


class Codes:
    """The codes of a dictionary, to be looked up for many squares at once.

    The rules are those of OpenCV's detector, which compares a square with one code after the other: for dictionaries of
    hundreds of codes this takes most of its time.
    """

    def __init__(self, dictionary: Any) -> None:
        """Take OpenCV's dictionary."""
        n = int(dictionary.markerSize)
        bits = [cv2.aruco.Dictionary.getBitsFromByteList(row[None], n) for row in dictionary.bytesList]
        turned = [np.rot90(code, turns) for code in bits for turns in range(4)]
        self._codes = (2.0 * np.array(turned, dtype=np.float32).reshape(-1, n * n) - 1.0).T  # white 1, black -1
        self._most_errors = int(int(dictionary.maxCorrectionBits) * _CORRECTED)
        self._most_in_border = int(_BORDER_ERRORS * n * n)
        place = np.arange((n + 2) ** 2).reshape(n + 2, n + 2)
        self._inner = place[1:-1, 1:-1].ravel()
        self._border = np.setdiff1d(place, self._inner)
        middles = np.arange(n + 2) + 0.5
        u = [(middles + shift) / (n + 2) for shift in _IN_CELL]
        grids = [np.meshgrid(across, down) for across in u for down in u]
        self._samples = np.array([[x.ravel(), y.ravel(), np.ones(x.size)] for x, y in grids]).swapaxes(0, 1)

    def read(self, image: GrayImage, squares: FloatArray) -> list[tuple[int, int, int]]:
        """Squares that are markers: their indices, ids, and the places by which their corners are to be rolled.

        Args:
            image: gray levels.
            squares: corners ``(n, 4, 2)``, clockwise, to a fraction of a cell.
        """
        levels = self._cell_levels(image, squares)
        threshold, contrast = _otsu(levels)
        good = contrast >= _MIN_CONTRAST
        good &= (levels[:, self._border] > threshold).sum(axis=1) <= self._most_in_border
        bits = np.where(levels[:, self._inner] > threshold, np.float32(1.0), np.float32(-1.0))
        agreement = bits @ self._codes  # equal cells less unequal ones
        best = agreement.argmax(axis=1)
        errors = 0.5 * (len(self._inner) - agreement[np.arange(len(best)), best])
        read = np.flatnonzero(good & (errors <= self._most_errors))
        return [(k, *divmod(code, 4)) for k, code in zip(read.tolist(), best[read].tolist(), strict=True)]

    def _cell_levels(self, image: GrayImage, squares: FloatArray) -> FloatArray:
        """Mean gray level ``(n, cells * cells)`` of the middle of each cell, row by row.

        Points of the image are complex numbers x + iy. Source: Heckbert, Fundamentals of Texture Mapping, 1989, 2.2.3.
        """
        corners = np.ascontiguousarray(squares, dtype=np.float64).view(np.complex128)[..., 0]
        first, second, third, fourth = corners.T
        along, down, skew = second - third, fourth - third, first - second + third - fourth
        area = cross(along, down)
        area += area == 0.0
        g, h = cross(skew, down) / area, cross(along, skew) / area
        above = np.array([second - first + g * second, fourth - first + h * fourth, first]).T
        below = np.array([g, h, np.ones(len(g))]).T
        samples = self._samples.reshape(3, -1)
        places = ((above @ samples) / (below @ samples)).astype(np.complex64)
        maps = places.view(np.float32).reshape(len(squares), -1, 2)
        levels = cv2.remap(image, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        return np.asarray(levels.reshape(len(squares), self._samples.shape[1], -1).mean(axis=1, dtype=np.float32))


def _otsu(levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The threshold ``(n, 1)`` of each row that separates two classes best, and how far these are apart ``(n,)``.

    Source: Otsu, IEEE Trans. SMC 9, 1979.
    """
    ordered = np.sort(levels, axis=1)
    n = ordered.shape[1]
    below = np.arange(1.0, n)
    sums = np.cumsum(ordered, axis=1)
    apart = (sums[:, -1:] * (below / n) - sums[:, :-1]) * (n / (below * (n - below)))  # of the classes' means
    split = np.argmax(apart * apart * (below * (n - below)), axis=1)
    rows = np.arange(len(ordered))
    return 0.5 * (ordered[rows, split] + ordered[rows, split + 1])[:, None], apart[rows, split]


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
        p = detector_parameters((_WINDOW_PX, _WINDOW_PX, 1), max(SMALLEST, least_px / max(self._shape, default=1)))
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
