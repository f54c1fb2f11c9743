"""Simulated positioning by radio: UWB ranges to anchors along the walls, and positions of a GNSS receiver.

Errors that last (no line of sight, multipath) come in stretches: a two-state Markov chain of the given share and mean
length, with one draw of the error for each stretch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from fgloc.frames import quaternion_matrix
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.sim.physics import Log
from fgloc_datasets.sim.scenario import Gnss, Scenario, Uwb
from fgloc_datasets.sim.section import channel_rng

Values = Callable[[int, int], FloatArray]
_SEMI_MAJOR_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563  # of the ellipsoid of WGS 84
_ITERATIONS = 8  # of the latitude; each gains two digits


def anchors(scenario: Scenario, uwb: Uwb) -> FloatArray:
    """Places ``(n, 3)`` in the map, evenly along the walls; anchor i has the number i + 1."""
    length, width = scenario.world.size_m
    along = (np.arange(uwb.anchors) + 0.5) / uwb.anchors * 2.0 * (length + width)
    places = np.zeros((uwb.anchors, 3))
    for i, s in enumerate(along):
        if s < length:
            x, y = s, 0.0
        elif s < length + width:
            x, y = length, s - length
        elif s < 2.0 * length + width:
            x, y = 2.0 * length + width - s, width
        else:
            x, y = 0.0, 2.0 * (length + width) - s
        places[i] = x - 0.5 * length, y - 0.5 * width, uwb.heights_m[i % 2]
    return places


def uwb_ranges(scenario: Scenario, uwb: Uwb, log: Log, seed: int) -> tuple[IntArray, IntArray, Values]:
    """Ticks of the log and numbers of the anchors, each ``(n,)``; and the ranges [m] of messages i to j."""
    rng = channel_rng(seed, "uwb")
    ticks = _ticks(log, uwb.rate_hz)
    which = np.arange(len(ticks)) % uwb.anchors
    places = anchors(scenario, uwb)
    seconds = log.stamps_s[ticks]
    excess = np.zeros(len(ticks))
    for anchor in range(uwb.anchors):
        mine = np.flatnonzero(which == anchor)
        stretch = _stretches(rng, seconds[mine], uwb.nlos_share, uwb.nlos_s)
        draws = rng.exponential(uwb.nlos_mean_m, int(stretch.max(initial=0)) + 1)
        excess[mine] = np.where(stretch > 0, draws[stretch], 0.0)
    noise = rng.normal(0.0, uwb.sigma_m, len(ticks))

    def ranges(first: int, last: int) -> FloatArray:
        these = slice(first, last)
        true = np.linalg.norm(_points(log, ticks[these], uwb.tag) - places[which[these]], axis=1)
        return np.asarray(np.maximum(true + excess[these] + noise[these], 0.1))

    return ticks, which + 1, ranges


def uwb_settings(scenario: Scenario, uwb: Uwb) -> dict[str, Any]:
    """Section ``uwb`` of ``robot.yaml``: what the installer surveyed, exactly."""
    places = {i + 1: [round(float(v), 4) for v in place] for i, place in enumerate(anchors(scenario, uwb))}
    return {"anchors": places, "tag": list(uwb.tag), "sigma_m": uwb.sigma_m}


def gnss_places(gnss: Gnss, log: Log, seed: int) -> tuple[IntArray, Values]:
    """Ticks of the log ``(n,)``; and latitude, longitude [degrees], altitude [m] ``(., 3)`` of messages i to j."""
    rng = channel_rng(seed, "gnss")
    ticks = _ticks(log, gnss.rate_hz)
    stretch = _stretches(rng, log.stamps_s[ticks], gnss.multipath_share, gnss.multipath_s)
    count = int(stretch.max(initial=0)) + 1
    far, direction = rng.exponential(gnss.multipath_mean_m, count), rng.uniform(-math.pi, math.pi, count)
    off = np.where(stretch > 0, far[stretch], 0.0)
    c, s = math.cos(gnss.yaw_rad), math.sin(gnss.yaw_rad)
    east, north = (rng.normal(0.0, gnss.sigma_m, len(ticks)) for _ in range(2))
    east, north = off * np.cos(direction[stretch]) + east, off * np.sin(direction[stretch]) + north

    def places(first: int, last: int) -> FloatArray:
        enu = _points(log, ticks[first:last], gnss.antenna) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
        enu[:, 0] += east[first:last]
        enu[:, 1] += north[first:last]
        return geodetic(enu, gnss.origin)

    return ticks, places


def gnss_settings(gnss: Gnss) -> dict[str, Any]:
    """Section ``gnss`` of ``robot.yaml``."""
    return {"origin": list(gnss.origin), "yaw_rad": gnss.yaw_rad, "antenna": list(gnss.antenna[:2])}


def geodetic(enu: FloatArray, origin: tuple[float, float, float]) -> FloatArray:
    """Latitude, longitude [degrees], altitude [m] ``(n, 3)`` of points east, north and up of an origin ``(n, 3)``.

    Source: NIMA TR8350.2; the latitude by fixed-point iteration.
    """
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    normal = _SEMI_MAJOR_M / math.sqrt(1.0 - e2 * math.sin(phi) ** 2)
    across, along = (normal + origin[2]) * math.cos(phi), (normal * (1.0 - e2) + origin[2]) * math.sin(phi)
    center = np.array([across * math.cos(lam), across * math.sin(lam), along])
    axes = np.array(
        [
            [-math.sin(lam), math.cos(lam), 0.0],
            [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)],
            [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)],
        ]
    )
    x, y, z = (center + enu @ axes).T
    p = np.hypot(x, y)
    latitude = np.arctan2(z, p * (1.0 - e2))
    altitude = np.zeros_like(p)
    for _ in range(_ITERATIONS):
        normals = _SEMI_MAJOR_M / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
        altitude = p / np.cos(latitude) - normals
        latitude = np.arctan2(z, p * (1.0 - e2 * normals / (normals + altitude)))
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude])


def _ticks(log: Log, rate_hz: float) -> IntArray:
    """Rows of the log at a rate."""
    wanted = np.arange(log.stamps_s[0] + 1.0 / rate_hz, log.stamps_s[-1], 1.0 / rate_hz)
    return np.asarray(np.unique(np.searchsorted(log.stamps_s, wanted).clip(max=len(log.stamps_s) - 1)))


def _points(log: Log, ticks: IntArray, offset: tuple[float, float, float]) -> FloatArray:
    """Places ``(n, 3)`` in the map of a point of the base."""
    turned = np.array([quaternion_matrix(q) @ np.array(offset) for q in log.quaternions[ticks]])
    return np.asarray(log.positions[ticks] + turned)


def _stretches(rng: np.random.Generator, seconds: FloatArray, share: float, mean_s: float) -> IntArray:
    """Number of the stretch that each time is in, from 1; 0: in none."""
    number = np.zeros(len(seconds), dtype=np.int64)
    if share <= 0.0 or not len(seconds):
        return number
    inside, count = bool(rng.uniform() < share), 0
    count += inside
    end = float(seconds[0])
    for i, at in enumerate(seconds):
        while at >= end:
            if i or end > seconds[0]:
                inside = not inside
                count += inside
            end += rng.exponential(mean_s if inside else mean_s * (1.0 - share) / share)
        number[i] = count if inside else 0
    return number
