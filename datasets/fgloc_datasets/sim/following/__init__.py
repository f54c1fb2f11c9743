"""The simulated robot drives itself along waypoints, guided by a pose that is estimated while it drives."""

from fgloc_datasets.sim.following.loop import Drive, follow
from fgloc_datasets.sim.following.path import WaypointPath, load_path
from fgloc_datasets.sim.following.poses import POSES, PoseName
from fgloc_datasets.sim.following.pursuit import Pursuit, PursuitSettings
from fgloc_datasets.sim.following.results import Followed

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
