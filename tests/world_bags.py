"""Recordings of the synthetic worlds, with map and truth."""

from __future__ import annotations

import math
from pathlib import Path

from robot_world import World

from datasets.bag import BagWriter
from fgloc import se2
from fgloc.sensors.maps import write_map
from fgloc.types import CommandEvent, OdometryEvent, RangeBearingEvent


def write_world(folder: Path, *worlds: World, body=(0.0, 0.0, 0.0), sightings: bool = True) -> Path:
    """``bag`` of worlds with beacons, one after the other, with ``map.yaml`` beside it.

    Args:
        folder: where to.
        worlds: drives; the first one's map is written.
        body: pose of the tracked body in the base: the truth's topic gives the body's pose.
        sightings: whether the beacons' sightings are written.
    """
    received = 0
    with BagWriter(folder / "bag") as bag:
        for world in worlds:
            behind = max(
                0, received + 50_000_000 - world.start_ns
            )  # its stamps may be set back, the recorder's are not
            for event in world.events():
                stamp, received = event.stamp_ns, event.received_ns + behind
                if isinstance(event, OdometryEvent):
                    pose = world.truth(stamp)
                    bag.odometry("/odom", stamp, pose, (event.linear[0], event.angular[2]), received)
                    x, y, yaw = se2.compose(pose, body)
                    bag.truth("/truth", stamp, (x, y, 0.0), (0, 0, math.sin(yaw / 2), math.cos(yaw / 2)), received)
                elif isinstance(event, CommandEvent):
                    bag.command("/cmd_vel", stamp, event.v, event.omega, received)
                elif isinstance(event, RangeBearingEvent) and sightings:
                    seen = [(s.landmark_id, s.range_m, s.bearing_rad) for s in event.sightings]
                    bag.range_bearing("/landmarks", stamp, seen, received)
    write_map(worlds[0].map, folder / "map.yaml")
    return folder / "bag"
