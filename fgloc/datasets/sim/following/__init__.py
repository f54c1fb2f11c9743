"""The simulated robot drives itself along waypoints, guided by a pose that is estimated while it drives."""

from fgloc.datasets.sim.following.loop import Drive, follow
from fgloc.datasets.sim.following.path import WaypointPath, load_path
from fgloc.datasets.sim.following.poses import POSES, PoseName
from fgloc.datasets.sim.following.pursuit import Pursuit, PursuitSettings
from fgloc.datasets.sim.following.results import Followed

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
