"""A robot on a circle that sees four beacons, as a bag with its map."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from robot_world import START_NS, points

from fgloc import se2
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter

BEACONS = {0: (3.0, 0.0), 1: (0.0, 3.0), 2: (-3.0, 0.0), 4: (0.0, -3.0)}


def write_circle(
    folder: Path,
    seconds: float = 10.0,
    sees: bool = True,
    truth: bool = True,
    start_ns: int = START_NS,
    late_s: float = 0.0,
) -> Path:
    """``bag`` with ``map.yaml`` beside it; stamps of the sightings are so much too early."""
    rng = np.random.default_rng(3)
    pose, odometry = np.array([1.0, 0.0, math.pi / 2]), np.zeros(3)
    with BagWriter(folder / "bag") as bag:
        for k in range(round(seconds * 20)):
            stamp = start_ns + k * 50_000_000
            bag.odometry("/odom", stamp, odometry, (0.4, 0.4))
            if truth:
                bag.planar_truth("/truth", stamp, pose)
            if sees and k % 5 == 0:
                seen = [sight(rng, pose, i) for i in BEACONS]
                bag.range_bearing("/landmarks", stamp - round(late_s * 1e9), seen, stamp)
            pose = se2.compose(pose, se2.exp((0.02, 0.0, 0.02)))
            wobble = rng.normal(0.0, 0.001, 2)
            odometry = se2.compose(odometry, se2.exp((0.02 + wobble[0], 0.0, 0.02 + wobble[1])))
    write_map(points(BEACONS), folder / "map.yaml")
    return folder / "bag"


def sight(rng: np.random.Generator, pose: np.ndarray, i: int) -> tuple[int, float, float]:
    """Beacon, its range and bearing with noise."""
    dx, dy = BEACONS[i][0] - pose[0], BEACONS[i][1] - pose[1]
    distance = math.hypot(dx, dy) + rng.normal(0.0, 0.05)
    return i, distance, se2.wrap(math.atan2(dy, dx) - pose[2] + rng.normal(0.0, 0.02))
