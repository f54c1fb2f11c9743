"""Recordings of the synthetic worlds, with map and truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from robot_world import CAMERA, T_BASE_CAM, World
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent
from fgloc_datasets.bag import BagWriter


def write_world(folder: Path, *worlds: World, body=(0.0, 0.0, 0.0), sightings: bool = True) -> Path:
    """``bag`` of worlds with beacons or markers, one after the other, with ``map.yaml`` beside it.

    Args:
        folder: where to.
        worlds: drives; the first one's map is written.
        body: pose of the tracked body in the base: the truth's topic gives the body's pose.
        sightings: whether the sightings are written.
    """
    received = 0
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
                    bag.odometry("/odom", stamp, pose, (event.linear[0], event.angular[2]), received)
                    x, y, yaw = se2.compose(pose, body)
                    bag.truth("/truth", stamp, (x, y, 0.0), (0, 0, math.sin(yaw / 2), math.cos(yaw / 2)), received)
                elif isinstance(event, ControlEvent):
                    bag.command("/cmd_vel", stamp, event.v, event.omega, received)
                elif isinstance(event, RangeBearingEvent) and sightings:
                    seen = [(s.landmark_id, s.range_m, s.bearing_rad) for s in event.sightings]
                    bag.range_bearing("/landmarks", stamp, seen, received)
                elif isinstance(event, CornersEvent) and sightings:
                    tags = [(s.landmark_id, s.corners_px) for s in event.sightings]
                    bag.write("/tags", "apriltag_msgs/msg/AprilTagDetectionArray", _tags(bag, stamp, tags), received)
    write_map(worlds[0].map, folder / "map.yaml")
    return folder / "bag"


def _tags(bag: BagWriter, stamp: int, tags):
    """Corners in the order of the AprilTag library, pixel centres at halves."""
    m = bag.make
    detections = []
    for number, corners in tags:
        points = [m("apriltag_msgs/msg/Point", x=float(x), y=float(y)) for x, y in corners[[3, 2, 1, 0]] + 0.5]
        x, y = corners.mean(axis=0) + 0.5
        detections.append(
            m(
                "apriltag_msgs/msg/AprilTagDetection",
                family="tag36h11",
                id=int(number),
                hamming=0,
                goodness=0.0,
                decision_margin=50.0,
                centre=m("apriltag_msgs/msg/Point", x=float(x), y=float(y)),
                corners=points,
                homography=np.zeros(9),
            )
        )
    sec, nanosec = divmod(stamp, 1_000_000_000)
    header = m("std_msgs/msg/Header", stamp=m("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec), frame_id="cam")
    return m("apriltag_msgs/msg/AprilTagDetectionArray", header=header, detections=detections)
