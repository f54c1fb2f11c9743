"""Recordings of the synthetic worlds, with map and truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from robot_world import CAMERA, T_BASE_CAM, TURN, World
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent
from fgloc_datasets.bag import BagWriter


def write_world(
    folder: Path,
    *worlds: World,
    body=(0.0, 0.0, 0.0),
    sightings: bool = True,
    leave_out=(),
    gyro_sigma: float | None = None,
) -> Path:
    """``bag`` of worlds with beacons or markers, one after the other, with ``map.yaml`` beside it.

    Args:
        folder: where to.
        worlds: drives; the first one's map is written.
        body: pose of the tracked body in the base: the truth's topic gives the body's pose.
        sightings: whether the sightings are written.
        leave_out: kinds of events that are not written; truth and gyro of their times are.
        gyro_sigma: noise of a gyro at 20 Hz [rad/s]; None: there is none.
    """
    received, rng = 0, np.random.default_rng(8)
    with BagWriter(folder / "bag") as bag:
        if worlds[0].sees_corners:
            bag.camera_info("/camera_info", worlds[0].start_ns, (640, 480), CAMERA.K, [0.0] * 4, frame_id="cam")
            turned = Rotation.from_matrix(T_BASE_CAM[:3, :3]).as_quat()
            bag.static_transform(worlds[0].start_ns, "base_link", "cam", T_BASE_CAM[:3, 3], turned)
        for world in worlds:
            behind = max(
                0, received + 50_000_000 - world.start_ns
            )  # its stamps may be set back, the recorder's are not
            for event in world.events():
                stamp, received = event.stamp_ns, event.received_ns + behind
                if isinstance(event, OdometryEvent):
                    pose = world.truth(stamp)
                    if OdometryEvent not in leave_out:
                        bag.odometry("/odom", stamp, pose, (event.linear[0], event.angular[2]), received)
                    if gyro_sigma is not None:
                        rate = (0.0, 0.0, TURN + rng.normal(0.0, gyro_sigma))
                        bag.imu("/imu", stamp, rate, (0.0, 0.0, 9.81), received, "base_link")
                    bag.planar_truth("/truth", stamp, se2.compose(pose, body), received)
                elif isinstance(event, ControlEvent) and ControlEvent not in leave_out:
                    bag.command("/cmd_vel", stamp, event.v, event.omega, received)
                elif isinstance(event, RangeBearingEvent) and sightings:
                    seen = [(s.landmark_id, s.range_m, s.bearing_rad) for s in event.sightings]
                    bag.range_bearing("/landmarks", stamp, seen, received)
                elif isinstance(event, CornersEvent) and sightings:
                    seen = {s.landmark_id: s.corners_px for s in event.sightings}
                    bag.corners("/tags", stamp, seen, received, "cam")
    write_map(worlds[0].map, folder / "map.yaml")
    return folder / "bag"
