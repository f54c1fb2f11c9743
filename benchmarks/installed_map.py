"""Maps for `benchmarks.installed`."""

from __future__ import annotations

from benchmarks.installed_recordings import installed
from datasets.sim.scenario import Control, Markers, Scenario, World

TOUR_S = 180.0
_TOUR = (
    (-1.8, -1.6), (-0.4, -1.5), (1.0, -1.5), (1.8, -0.5), (1.4, 1.2), (0.2, 1.6), (-0.3, 0.3), (-1.4, -0.2),
    (-1.8, 1.2), (-0.9, 1.7), (0.3, 0.5), (1.2, -0.5), (0.3, -1.2), (-1.0, -0.8),
)  # fmt: skip


def tour(made: Scenario) -> Scenario:
    """Three minutes around a room of 6 m."""
    changes = {
        "duration_s": TOUR_S,
        "start": (*_TOUR[0], 0.0),
        "world": World(size_m=(6.0, 6.0), markers=Markers(count=16)),
        "control": Control(waypoints=_TOUR, speed=0.42),
    }
    return installed(made).model_copy(update=changes)
