"""Message types: the standard ones and the marker packages that standard distributions lack."""

from __future__ import annotations

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

# Public interface definitions of the packages named in the keys.
_DEFINITIONS = {
    "landmark_msgs/msg/Landmark": (
        "int32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\nfloat32 range\nfloat32 bearing\n"
    ),
    "landmark_msgs/msg/LandmarkArray": "std_msgs/Header header\nlandmark_msgs/Landmark[] landmarks\n",
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography\n"
    ),
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections\n"
    ),
    "aruco_msgs/msg/Marker": (
        "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence\n"
    ),
    "aruco_msgs/msg/MarkerArray": "std_msgs/Header header\naruco_msgs/Marker[] markers\n",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
}


def default_typestore(ros1: bool = False) -> Typestore:
    """Typestore for bags that carry no definitions: ROS 2 Humble (or ROS 1 Noetic) and the marker packages."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store
