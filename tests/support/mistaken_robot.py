"""A robot that drives to and fro among beacons, with one constant that is not as it was given."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from robot_world import NOISE, SIGMA_BEARING, SIGMA_RANGE, START_NS, beacons, polar

from fgloc import se2
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter

_LEG_S = 4.0  # after which speed and turn rate change


def write_mistaken(
    folder: Path,
    late_s: float = 0.0,
    range_scale: float = 1.0,
    wheels: float = 1.0,
    wheel_turn: float = 1.0,
    gyro: bool = False,
    sightings: bool = True,
    seconds: float = 80.0,
    seed: int = 0,
) -> Path:
    """``bag`` with ``map.yaml`` beside it.

    Args:
        folder: where to.
        late_s: how much later than the exposure the sightings' stamps are.
        range_scale: reported over true ranges.
        wheels: reported over true motion of the wheels.
        wheel_turn: reported over true turn of the wheels, besides.
        gyro: whether there is one.
        sightings: whether there are any.
        seconds: length.
        seed: of noise and drive.
    """
    rng = np.random.default_rng(seed)
    places = beacons(9)
    legs = rng.uniform([0.15, -0.9], [0.5, 0.9], (int(seconds / _LEG_S) + 1, 2))
    pose, spread = np.zeros(3), math.sqrt(0.3 / 0.05)
    moved: list[tuple[float, float]] = []
    delayed: list[tuple[int, list[tuple[int, float, float]]]] = []
    with BagWriter(folder / "bag") as bag:
        for tick in range(round(seconds * 100)):
            stamp = START_NS + tick * 10_000_000
            v, omega = legs[int(tick * 0.01 / _LEG_S)]
            omega += 0.5 * math.hypot(*pose[:2]) * math.sin(math.atan2(-pose[1], -pose[0]) - pose[2])  # back
            moved.append((v, omega))
            if tick % 5 == 0:
                mean_v, mean_omega = np.mean(moved[-6:-1] or moved, axis=0)  # of the interval that ends here
                reported_v = wheels * mean_v + rng.normal(0.0, NOISE["x_per_sqrt_m"] * spread)
                turn = wheels * wheel_turn * mean_omega + rng.normal(0.0, 0.2 * NOISE["yaw_per_sqrt_m"] * spread)
                bag.odometry("/odom", stamp, (0.0, 0.0, 0.0), (reported_v, turn))
            if gyro and tick % 2 == 0:
                bag.imu("/imu", stamp, (0.0, 0.0, omega + 0.005 + rng.normal(0.0, 0.004)), (0.0, v * omega, 9.81))
            if tick % 10 == 0:
                bag.planar_truth("/truth", stamp, pose)
                seen = []
                for i in rng.choice(9, 3, replace=False):
                    r, bearing = polar(pose, places.landmarks[int(i)])
                    measured = se2.wrap(bearing + rng.normal(0.0, SIGMA_BEARING))
                    seen.append((int(i), range_scale * r + rng.normal(0.0, SIGMA_RANGE), measured))
                delayed.append((stamp + round(late_s * 1e9), seen))
            while sightings and delayed and delayed[0][0] <= stamp:
                bag.range_bearing("/landmarks", *delayed.pop(0))
            pose = se2.compose(pose, se2.exp((0.01 * v, 0.0, 0.01 * omega)))
    write_map(places, folder / "map.yaml")
    return folder / "bag"
