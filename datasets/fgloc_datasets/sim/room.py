"""The marker map of a simulated room: upright markers along its walls, and others that are placed."""

from __future__ import annotations

import math

import numpy as np

from fgloc.frames import rpy_matrix
from fgloc.types import FloatArray, Landmark, LandmarkMap
from fgloc_datasets.sim.scenario import World
from fgloc_datasets.sim.section import channel_rng

_FROM_CORNER_M = 0.35
_GAP_M = 0.002  # in front of the wall


def make_map(world: World, seed: int) -> LandmarkMap:
    """Markers at nearly even distances around the room, their ids, places and heights drawn by the seed; and others."""
    rng = channel_rng(seed, "markers")
    spec = world.markers
    sx, sy = world.size_m
    runs = np.array([sx, sy, sx, sy]) - 2 * _FROM_CORNER_M
    ends = np.cumsum(runs)
    ids = rng.permutation(spec.count)
    landmarks = {}
    for i in range(spec.count):
        along = (i + 0.5 + rng.uniform(-0.2, 0.2)) * ends[-1] / spec.count
        wall = int(np.searchsorted(ends, along, side="right"))
        offset = along - (ends[wall] - runs[wall]) - 0.5 * runs[wall]  # from the wall's middle
        normal = np.array([(0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)][wall])
        up = np.array([0.0, 0.0, 1.0])
        right = np.cross(up, normal)
        depth = 0.5 * (sy if wall % 2 == 0 else sx) - _GAP_M
        position = -normal * depth - right * offset + up * rng.uniform(*spec.heights_m)
        rotation = np.column_stack([right, up, normal])
        if world.floor.tilt is not None:
            position = position + up * world.floor.tilt.height(position[0], position[1])
        marker_id = int(ids[i])
        landmarks[marker_id] = Landmark(marker_id, position.round(4), rotation, spec.size_m)
    for placed in spec.placed:
        rotation = _facing(placed.facing_deg, placed.elevation_deg, placed.roll_deg)
        landmarks[placed.id] = Landmark(placed.id, np.array(placed.position), rotation, spec.size_m)
    return LandmarkMap(dict(sorted(landmarks.items())), spec.dictionary)


def _facing(yaw_deg: float, elevation_deg: float, roll_deg: float) -> FloatArray:
    """``(3, 3)`` of a marker whose normal has this yaw and elevation, turned about it."""
    turn = rpy_matrix(0.0, -math.radians(elevation_deg), math.radians(yaw_deg))
    upright = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # its right, up and normal, facing x
    return np.asarray(turn @ upright @ rpy_matrix(0.0, 0.0, math.radians(roll_deg)))
