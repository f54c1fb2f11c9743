"""The simulated robot drives itself along waypoints, guided by a pose that is estimated while it drives."""

from fgloc_datasets.sim.following.loop import POSES, Drive, Followed, PoseName, follow
from fgloc_datasets.sim.following.pursuit import Pursuit, PursuitSettings, WaypointPath, load_path

__all__ = [
    "POSES",
    "Drive",
    "Followed",
    "PoseName",
    "Pursuit",
    "PursuitSettings",
    "WaypointPath",
    "follow",
    "load_path",
]
