"""The codes of squares that may be markers, all of an image at once."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from fgloc.sensors.markers.edges import cross
from fgloc.sensors.markers.images import GrayImage
from fgloc.types import FloatArray

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
        """Which squares are markers: index, id, and by how many places their corners are to be rolled.

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
