"""Markers of another size than they are taken to have: their direction fits, their distance is off by a factor."""

from __future__ import annotations

import math

import numpy as np

from fgloc.sensors.checks import listed
from fgloc.types import Finding, FloatArray, IntArray, Severity

_FEWEST = 10  # sightings of a marker
_OTHER = 0.15  # logarithm of a size: less is not told from a wrong place
_SCATTER = 0.25  # share of that by which single sightings deviate, at most (median)
_ASIDE_RAD = 0.05  # median angle from where the map has it, at most
_NEARER = 1.3  # ratio of its largest to its smallest distance, at least: what hangs elsewhere is off by a way instead
_LEAST_M = 1e-3  # of a distance: a detector that fails may say that the marker is where the camera is
_ALIKE = 0.05  # logarithm by which markers of one size differ


def marker_sizes(ids: IntArray, seen: FloatArray, expected: FloatArray, sizes: dict[int, float]) -> tuple[Finding, ...]:
    """Findings on markers that are larger or smaller than the map, or the detector, says.

    Args:
        ids: ``(m,)`` of the markers of sightings.
        seen: ``(m, 2)`` where each is by its image, from the camera [m].
        expected: ``(m, 2)`` where it is by the map and the run's pose.
        sizes: side of each marker by the map [m].
    """
    factors = {i: f for i in sizes if (f := _factor(seen[ids == i], expected[ids == i])) is not None}
    found = []
    while factors:
        first = min(factors)
        one, size = factors[first], sizes[first]
        alike = [i for i, f in factors.items() if abs(math.log(f / one)) < _ALIKE and sizes[i] == size]
        factor = float(np.median([factors.pop(i) for i in alike]))
        s, their = ("s", "their") if len(alike) > 1 else ("", "its")
        text = (
            f"Marker{s} {listed(alike)}: by the images {their} side is {factor * size:.2g} m, by the map {size:.4g} m: "
            f"{their} direction fits the map, {their} distance does not. Measure {their} side, and set it in the map, "
            "or in the detector that reports poses."
        )
        found.append(Finding("map.sizes", text, Severity.WARNING, value=factor))
    return tuple(found)


def _factor(seen: FloatArray, expected: FloatArray) -> float | None:
    """True size of a marker over the given one, by its sightings ``(m, 2)``; None: nothing shows another one."""
    if len(seen) < _FEWEST:
        return None
    a, b = (p[:, 0] + 1j * p[:, 1] for p in (seen, expected))
    own, distances = (np.maximum(np.abs(p), _LEAST_M) for p in (a, b))
    logs = np.log(distances / own)
    aside, log = float(np.median(np.abs(np.angle(b * a.conj())))), float(np.median(logs))
    if abs(log) < _OTHER or aside > _ASIDE_RAD or distances.max() < _NEARER * distances.min():
        return None
    return math.exp(log) if float(np.median(np.abs(logs - log))) < _SCATTER * abs(log) else None
