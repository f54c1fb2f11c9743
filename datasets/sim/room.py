"""The marker map of a simulated room: upright markers along its walls."""

from __future__ import annotations

import numpy as np

from datasets.sim.scenario import World
from datasets.sim.section import channel_rng
from fgloc.types import Landmark, LandmarkMap

_FROM_CORNER_M = 0.35
_GAP_M = 0.002  # in front of the wall


def make_map(world: World, seed: int) -> LandmarkMap:
    """Markers at nearly even distances around the room, their ids, places and heights drawn by the seed."""
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
        marker_id = int(ids[i])
        landmarks[marker_id] = Landmark(marker_id, position.round(4), rotation, spec.size_m)
    return LandmarkMap(dict(sorted(landmarks.items())), spec.dictionary)
