"""Recordings of every kind become the same events."""

from __future__ import annotations

import math
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from real_data import real_data
from recording_bags import START_NS, TICK_NS, storage_file, write_drive, write_ros1
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fgloc.config import Config, RecordingConfig, TopicsConfig
from fgloc.errors import RecordingError
from fgloc.recording.info import format_info, inspect
from fgloc.recording.messages import default_typestore
from fgloc.recording.reader import open_recording
from fgloc.sensors.marker_pose import MarkerPosesEvent
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent, Event, TransformEvent, TruthEvent
from fgloc_datasets.bag import BagWriter

DEFAULT = RecordingConfig()


def read(path: Path, config: RecordingConfig = DEFAULT) -> list[Event]:
    with open_recording(path, config) as recording:
        return list(recording.events())


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("single_file", [False, True])
def test_rosbag2_folder_and_file(tmp_path, storage, single_file):
    folder = write_drive(tmp_path / "run", storage)
    path = storage_file(folder) if single_file else folder
    with open_recording(path, DEFAULT) as recording:
        assert recording.kind == storage
        assert recording.roles == {
            "odometry": "/odom",
            "command": "/cmd_vel",
            "joints": "/joint_states",
            "camera_info": "/camera/camera_info",
            "sightings": "/landmarks",
            "truth": "/ground_truth/pose",
        }
        events = list(recording.events())
        assert recording.duration_s == pytest.approx(199 * TICK_NS * 1e-9 + 0.002)
        assert recording.notes == ()
        assert recording.undecodable == {}
        assert [t.count for t in recording.topics if t.role == "sightings"] == [40]
    assert Counter(type(e).__name__ for e in events) == {
        "OdometryEvent": 200,
        "ControlEvent": 200,
        "JointsEvent": 200,
        "TruthEvent": 200,
        "RangeBearingEvent": 40,
        "CameraInfoEvent": 1,
        "TransformEvent": 1,
    }
    received = [e.received_ns for e in events]
    assert received == sorted(received)
    odometry = [e for e in events if isinstance(e, OdometryEvent)][50]
    assert (odometry.stamp_ns, odometry.received_ns) == (START_NS + 50 * TICK_NS, START_NS + 50 * TICK_NS + 2_000_000)
    assert (odometry.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    np.testing.assert_allclose(odometry.position, [math.sin(1.0), 1 - math.cos(1.0), 0.0])
    np.testing.assert_allclose(odometry.orientation, [0, 0, math.sin(0.5), math.cos(0.5)])
    np.testing.assert_allclose(odometry.pose_cov, np.eye(6) * 1e-3)
    assert (odometry.linear[0], odometry.angular[2]) == (0.4, 0.4)
    sightings = next(e for e in events if isinstance(e, RangeBearingEvent)).sightings
    assert [(s.landmark_id, s.range_m, round(s.bearing_rad, 6)) for s in sightings] == [(1, 2.0, 0.1), (0, 3.0, -0.2)]


def test_ros1_bag_headerless_messages_take_receive_times(tmp_path):
    with open_recording(write_ros1(tmp_path / "run.bag"), DEFAULT) as recording:
        assert recording.kind == "ros1"
        assert recording.roles == {"odometry": "/odom", "command": "/cmd_vel", "truth": "/mocap/pose"}
        events = list(recording.events())
    assert Counter(type(e).__name__ for e in events) == {"OdometryEvent": 100, "ControlEvent": 100, "TruthEvent": 100}
    for event in events:
        delay = event.received_ns - event.stamp_ns
        assert delay == (1_000_000 if isinstance(event, OdometryEvent) else 0)
    truth = next(e for e in events if isinstance(e, TruthEvent))
    np.testing.assert_allclose(truth.orientation, [0, 0, math.sin(0.25), math.cos(0.25)])


def test_events_can_be_read_again(tmp_path):
    with open_recording(write_drive(tmp_path / "run", n=20), DEFAULT) as recording:
        first = [(e.received_ns, e.topic) for e in recording.events()]
        assert first == [(e.received_ns, e.topic) for e in recording.events()]


def test_received_stamps_and_offsets(tmp_path):
    folder = write_drive(tmp_path / "run", n=10)
    config = RecordingConfig(received_stamps=("odometry",), stamp_offset_s={"truth": -0.25, "odometry": 0.5})
    for event in read(folder, config):
        delay = event.stamp_ns - event.received_ns
        if isinstance(event, OdometryEvent):
            assert delay == 500_000_000
        elif isinstance(event, TruthEvent):
            assert delay == -252_000_000
        elif isinstance(event, ControlEvent):
            assert delay == -2_000_000


def test_transforms_are_events_and_a_tree(tmp_path):
    with open_recording(write_drive(tmp_path / "run", n=5), DEFAULT) as recording:
        (event,) = [e for e in recording.events() if isinstance(e, TransformEvent)]
        assert (event.parent, event.child, event.static) == ("base_link", "camera_optical", True)
        T = recording.frames.lookup("base_link", "camera_optical")
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.0, 0.3])
    np.testing.assert_allclose(T[:3, 2], [1, 0, 0], atol=1e-12)  # the optical axis looks forward


def write_sightings(folder: Path, message_type: str, make) -> Path:
    with BagWriter(folder) as bag:
        stamp = bag.make("builtin_interfaces/msg/Time", sec=5, nanosec=7)
        header = bag.make("std_msgs/msg/Header", stamp=stamp, frame_id="cam")
        bag.write("/seen", message_type, make(bag, header), START_NS)
    return folder


def make_pose(bag: BagWriter, x: float):
    m = bag.make
    pose = m(
        "geometry_msgs/msg/Pose",
        position=m("geometry_msgs/msg/Point", x=x, y=0.0, z=0.0),
        orientation=m("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    return m("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))


def test_apriltag_corners_are_put_in_opencv_order(tmp_path):
    def make(bag, header):
        m = bag.make
        # As the AprilTag library (3.4) reports an upright print that covers pixels 100 to 199
        corners = [m("apriltag_msgs/msg/Point", x=x, y=y) for x, y in ((100, 200), (200, 200), (200, 100), (100, 100))]
        tag = m(
            "apriltag_msgs/msg/AprilTagDetection",
            family="tag36h11",
            id=0,
            hamming=0,
            goodness=0.0,
            decision_margin=50.0,
            centre=m("apriltag_msgs/msg/Point", x=150.0, y=150.0),
            corners=corners,
            homography=np.zeros(9),
        )
        return m("apriltag_msgs/msg/AprilTagDetectionArray", header=header, detections=[tag])

    (event,) = read(write_sightings(tmp_path / "run", "apriltag_msgs/msg/AprilTagDetectionArray", make))
    assert isinstance(event, CornersEvent)
    assert (event.stamp_ns, event.frame_id) == (5_000_000_007, "cam")
    (tag,) = event.sightings
    assert tag.landmark_id == 0
    expected = [[99.5, 99.5], [199.5, 99.5], [199.5, 199.5], [99.5, 199.5]]  # from the top left on, pixel centres whole
    np.testing.assert_array_equal(tag.corners_px, expected)


def test_aruco_poses(tmp_path):
    def make(bag, header):
        markers = [
            bag.make("aruco_msgs/msg/Marker", header=header, id=i, pose=make_pose(bag, float(i)), confidence=1.0)
            for i in (0, 7)
        ]
        return bag.make("aruco_msgs/msg/MarkerArray", header=header, markers=markers)

    (event,) = read(write_sightings(tmp_path / "run", "aruco_msgs/msg/MarkerArray", make))
    assert isinstance(event, MarkerPosesEvent)
    assert [(s.landmark_id, s.position[0]) for s in event.sightings] == [(0, 0.0), (7, 7.0)]


SQUARE = [[100.0, 100.0], [200.0, 100.0], [200.0, 200.0], [100.0, 200.0]]  # clockwise from the top left


def fiducials(bag, header):
    vertices = {f"{axis}{i}": xy[k] for i, xy in enumerate(SQUARE) for k, axis in enumerate("xy")}
    seen = [bag.make("fiducial_msgs/msg/Fiducial", fiducial_id=7, direction=0, **vertices)]
    return bag.make("fiducial_msgs/msg/FiducialArray", header=header, image_seq=0, fiducials=seen)


def tagslam_corners(bag, header):
    def point(x: float, y: float):
        return bag.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)

    corners = [point(*SQUARE[i]) for i in (3, 2, 1, 0)]  # from the bottom left, counter-clockwise
    tag = dict(id=7, family="36h11", hamming=0, border=1, bits=6, center=point(150.0, 150.0), corners=corners)
    tags = [bag.make("apriltag_msgs/msg/Apriltag", **tag)]
    return bag.make("apriltag_msgs/msg/ApriltagArrayStamped", header=header, apriltags=tags)


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("fiducial_msgs/msg/FiducialArray", fiducials),
        ("apriltag_msgs/msg/ApriltagArrayStamped", tagslam_corners),
    ],
)
def test_corners_of_other_detectors_are_put_in_opencv_order(tmp_path, kind, make):
    (event,) = read(write_sightings(tmp_path / "run", kind, make))
    assert isinstance(event, CornersEvent)
    (tag,) = event.sightings
    assert tag.landmark_id == 7
    np.testing.assert_array_equal(tag.corners_px, SQUARE)


def aruco_opencv(bag, header):
    marker = bag.make("aruco_opencv_msgs/msg/MarkerPose", marker_id=7, pose=make_pose(bag, 2.0).pose)
    return bag.make("aruco_opencv_msgs/msg/ArucoDetection", header=header, markers=[marker], boards=[])


def ros2_aruco(bag, header):
    ids = np.array([7], dtype=np.int64)
    poses = [make_pose(bag, 2.0).pose]
    return bag.make("ros2_aruco_interfaces/msg/ArucoMarkers", header=header, marker_ids=ids, poses=poses)


def fiducial_transforms(bag, header):
    pose = make_pose(bag, 2.0).pose
    moved = bag.make("geometry_msgs/msg/Vector3", x=2.0, y=0.0, z=0.0)
    transform = bag.make("geometry_msgs/msg/Transform", translation=moved, rotation=pose.orientation)
    values = dict(fiducial_id=7, transform=transform, image_error=0.1, object_error=0.01, fiducial_area=900.0)
    seen = [bag.make("fiducial_msgs/msg/FiducialTransform", **values)]
    return bag.make("fiducial_msgs/msg/FiducialTransformArray", header=header, image_seq=0, transforms=seen)


def stamped_pose(bag, header):
    pose = make_pose(bag, 2.0)
    return bag.make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=pose)


def apriltag_ros(bag, header):
    kind, pose = "apriltag_ros/msg/AprilTagDetection", stamped_pose(bag, header)
    tags = [bag.make(kind, id=np.array(ids, np.int32), size=np.ones(len(ids)), pose=pose) for ids in ([7], [1, 2])]
    return bag.make("apriltag_ros/msg/AprilTagDetectionArray", header=header, detections=tags)


def isaac(bag, header):
    point = bag.make("geometry_msgs/msg/Point", x=1.0, y=1.0, z=0.0)
    values = dict(family="36h11", id=7, center=point, corners=[point] * 4, pose=stamped_pose(bag, header))
    tag = bag.make("isaac_ros_apriltag_interfaces/msg/AprilTagDetection", **values)
    return bag.make("isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray", header=header, detections=[tag])


def alvar(bag, header, *frames):
    """The array's own header names no frame, as that of the older nodes."""
    markers = []
    for frame in frames or ("cam",):
        own = bag.make("std_msgs/msg/Header", stamp=header.stamp, frame_id=frame)
        nowhere = bag.make("std_msgs/msg/Header", stamp=header.stamp, frame_id="")
        pose = bag.make("geometry_msgs/msg/PoseStamped", header=nowhere, pose=make_pose(bag, 2.0).pose)
        markers.append(bag.make("ar_track_alvar_msgs/msg/AlvarMarker", header=own, id=7, confidence=1, pose=pose))
    whole = bag.make("std_msgs/msg/Header", stamp=header.stamp, frame_id="")
    return bag.make("ar_track_alvar_msgs/msg/AlvarMarkers", header=whole, markers=markers)


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("apriltag_ros/msg/AprilTagDetectionArray", apriltag_ros),
        ("ar_track_alvar_msgs/msg/AlvarMarkers", alvar),
        ("isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray", isaac),
        ("aruco_opencv_msgs/msg/ArucoDetection", aruco_opencv),
        ("ros2_aruco_interfaces/msg/ArucoMarkers", ros2_aruco),
        ("fiducial_msgs/msg/FiducialTransformArray", fiducial_transforms),
    ],
)
def test_poses_of_other_detectors(tmp_path, kind, make):
    (event,) = read(write_sightings(tmp_path / "run", kind, make))
    assert isinstance(event, MarkerPosesEvent)
    (seen,) = event.sightings
    assert (seen.landmark_id, *seen.position, *seen.orientation) == (7, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert not seen.cov.any()
    assert event.frame_id == "cam"


def test_poses_of_one_message_in_two_frames_are_undecodable(tmp_path):
    kind = "ar_track_alvar_msgs/msg/AlvarMarkers"
    folder = write_sightings(tmp_path / "run", kind, lambda bag, header: alvar(bag, header, "left", "right"))
    with open_recording(folder, DEFAULT) as recording:
        assert list(recording.events()) == []
        assert recording.undecodable == {"/seen": 1}


def test_truth_as_a_transform(tmp_path):
    folder = tmp_path / "run"
    with BagWriter(folder) as bag:
        stamp = bag.make("builtin_interfaces/msg/Time", sec=5, nanosec=7)
        header = bag.make("std_msgs/msg/Header", stamp=stamp, frame_id="world")
        moved = bag.make("geometry_msgs/msg/Vector3", x=2.0, y=1.0, z=0.5)
        turned = bag.make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=1.0, w=0.0)
        value = bag.make("geometry_msgs/msg/Transform", translation=moved, rotation=turned)
        kind = "geometry_msgs/msg/TransformStamped"
        bag.write("/vicon/robot/robot", kind, bag.make(kind, header=header, child_frame_id="robot", transform=value), 1)
    (event,) = read(folder)
    assert isinstance(event, TruthEvent)
    assert (event.stamp_ns, *event.position, *event.orientation) == (5_000_000_007, 2.0, 1.0, 0.5, 0.0, 0.0, 1.0, 0.0)


def test_of_ids_and_poses_that_differ_in_number_nothing_is_used(tmp_path):
    def make(bag, header):
        ids = np.array([7, 8], dtype=np.int64)
        poses = [make_pose(bag, 2.0).pose]
        return bag.make("ros2_aruco_interfaces/msg/ArucoMarkers", header=header, marker_ids=ids, poses=poses)

    with open_recording(
        write_sightings(tmp_path / "run", "ros2_aruco_interfaces/msg/ArucoMarkers", make), DEFAULT
    ) as r:
        assert list(r.events()) == []
        assert r.undecodable == {"/seen": 1}


@pytest.mark.parametrize(
    ("class_id", "own_id", "expected"),
    [("7", "", 7), ("tag36h11:7", "", 7), ("marker_7", "3", 7), ("tag36h11", "12", 12), ("0", "", 0)],
)
def test_detection3d_ids(tmp_path, class_id, own_id, expected):
    (event,) = read(write_detections(tmp_path / "run", [(class_id, own_id), ("person", "")]))
    assert [s.landmark_id for s in event.sightings] == [expected]


def write_detections(folder: Path, ids: list[tuple[str, str]]) -> Path:
    def make(bag, header):
        m = bag.make
        detections = []
        for class_id, own_id in ids:
            hypothesis = m("vision_msgs/msg/ObjectHypothesis", class_id=class_id, score=1.0)
            result = m("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=make_pose(bag, 1.0))
            size = m("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
            box = m("vision_msgs/msg/BoundingBox3D", center=make_pose(bag, 0.0).pose, size=size)
            detections.append(m("vision_msgs/msg/Detection3D", header=header, results=[result], bbox=box, id=own_id))
        return m("vision_msgs/msg/Detection3DArray", header=header, detections=detections)

    return write_sightings(folder, "vision_msgs/msg/Detection3DArray", make)


def test_detections_without_numbers_are_counted_as_undecodable(tmp_path):
    with open_recording(write_detections(tmp_path / "run", [("person", "")]), DEFAULT) as recording:
        assert list(recording.events()) == []
        assert recording.undecodable == {"/seen": 1}


def test_embedded_definitions_win(tmp_path):
    """The older vision_msgs: results hold id, score and pose themselves."""
    store = get_typestore(Stores.ROS2_FOXY)
    old = {
        "vision_msgs/msg/ObjectHypothesisWithPose": (
            "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n"
        ),
        "vision_msgs/msg/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nstring tracking_id\n"
        ),
        "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    }
    for name, text in old.items():
        store.register(get_types_from_msg(text, name))
    t = store.types
    header = t["std_msgs/msg/Header"](stamp=t["builtin_interfaces/msg/Time"](sec=1, nanosec=0), frame_id="cam")
    pose = t["geometry_msgs/msg/Pose"](
        position=t["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0),
        orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    result = t["vision_msgs/msg/ObjectHypothesisWithPose"](
        id="42", score=1.0, pose=t["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    )
    detection = t["vision_msgs/msg/Detection3D"](header=header, results=[result], tracking_id="")
    message = t["vision_msgs/msg/Detection3DArray"](header=header, detections=[detection])
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/seen", "vision_msgs/msg/Detection3DArray", typestore=store)
        assert connection.msgdef.format == MessageDefinitionFormat.MSG
        writer.write(connection, START_NS, store.serialize_cdr(message, connection.msgtype))
    (event,) = read(tmp_path / "run")
    assert isinstance(event, MarkerPosesEvent)
    assert [s.landmark_id for s in event.sightings] == [42]
    np.testing.assert_array_equal(event.sightings[0].position, [1, 2, 3])


def test_undecodable_messages_are_skipped_and_counted(tmp_path):
    store = default_typestore()
    with Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        zero = store.types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        good = store.serialize_cdr(store.types["geometry_msgs/msg/Twist"](zero, zero), "geometry_msgs/msg/Twist")
        for k, raw in enumerate((good, b"", b"\x00\x01\x00\x00" + b"x" * 11, good)):
            writer.write(connection, START_NS + k, raw)
    with open_recording(tmp_path / "run", DEFAULT) as recording:
        for _ in range(2):
            assert len(list(recording.events())) == 2
            assert recording.undecodable == {"/cmd_vel": 2}


def test_split_recording_without_metadata_is_merged_in_order(tmp_path):
    whole = tmp_path / "whole"
    whole.mkdir()
    for k in (0, 1, 2):
        part = storage_file(write_drive(tmp_path / f"part{k}", n=20, start_ns=START_NS + k * 20 * TICK_NS))
        part.rename(whole / f"run_{(2, 10, 11)[k]}.mcap")
    with open_recording(whole, DEFAULT) as recording:
        received = [e.received_ns for e in recording.events() if isinstance(e, OdometryEvent)]
        assert received == [START_NS + k * TICK_NS + 2_000_000 for k in range(60)]
        assert recording.duration_s == pytest.approx(59 * 0.05 + 0.002)


@pytest.mark.parametrize("name", ["absent.bag", "notes.txt", "empty"])
def test_what_is_no_recording_is_refused_with_the_remedy(tmp_path, name):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"ROS 1 \.bag, a rosbag2 folder, an \.mcap or a \.db3"):
        open_recording(tmp_path / name, DEFAULT)


def test_a_folder_of_recordings_names_them(tmp_path):
    write_drive(tmp_path / "lab" / "run", n=10)
    write_ros1(tmp_path / "lab" / "old.bag", n=10)
    with pytest.raises(RecordingError, match=r" \S*lab/old\.bag, \S*lab/run$"):
        open_recording(tmp_path / "lab", DEFAULT)


def test_reading_is_fast(tmp_path):
    """60 000 odometry messages in a few seconds, decoding included."""
    with BagWriter(tmp_path / "run") as bag:
        for k in range(20_000):
            bag.odometry("/odom", START_NS + k * 1000, (0, 0, 0), (0, 0))
    start = time.process_time()
    assert len(read(tmp_path / "run")) == 20_000
    assert time.process_time() - start < 3.0


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("parts", "roles", "count"),
    [
        (
            ("pioneer_aruco", "duarte.bag"),
            {"odometry": "/pioneer/pose", "truth": "/mocap_node/Robot_1/ground_pose"},
            6022,
        ),
        (
            ("pioneer_aruco", "pinto1.bag"),
            {"odometry": "/pioneer/pose", "truth": "/mocap_node/Robot_1/ground_pose"},
            4759,
        ),
        (("turtlebot3", "rosbag2_2025_11_25-15_11_34"), {"odometry": "/odom", "sightings": "/camera/landmarks"}, 4208),
        (("turtlebot3", "rosbag2_2025_11_25-14_27_38"), {"odometry": "/odom", "command": "/cmd_vel"}, 3674),
        (("marker_images", "ubiquity", "aruco_images.bag"), {"image": "/raspicam_node/image/compressed"}, 16),
    ],
)
def test_real_recordings(parts, roles, count):
    with open_recording(real_data(*parts), DEFAULT) as recording:
        assert roles.items() <= recording.roles.items()
        assert sum(1 for _ in recording.events()) == count
        assert recording.undecodable == {}


@pytest.mark.real_data
def test_real_tf_tree():
    with open_recording(real_data("turtlebot3", "rosbag2_2025_11_06-17_25_46"), DEFAULT) as recording:
        T = recording.frames.lookup("base_footprint", "base_scan")
        assert T[2, 3] > 0.1  # the scanner stands on top
        with pytest.raises(RecordingError, match="moves"):
            recording.frames.lookup("odom", "base_scan")


def test_a_role_can_be_switched_off(tmp_path):
    config = RecordingConfig(topics=TopicsConfig(truth="none", sightings="none"))
    kinds = {type(e) for e in read(write_drive(tmp_path / "run", n=10), config)}
    assert not kinds & {TruthEvent, RangeBearingEvent}
    assert OdometryEvent in kinds


@pytest.mark.parametrize("mode", ["FILE", "MESSAGE", "STORAGE"])
def test_compressed_rosbag2(tmp_path, mode):
    store = default_typestore()
    writer = Writer(
        tmp_path / "run",
        version=9,
        storage_plugin=StoragePlugin.MCAP if mode == "STORAGE" else StoragePlugin.SQLITE3,
    )
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        zero = store.types["geometry_msgs/msg/Vector3"](x=0.25, y=0.0, z=0.0)
        raw = store.serialize_cdr(store.types["geometry_msgs/msg/Twist"](zero, zero), connection.msgtype)
        for k in range(10):
            writer.write(connection, START_NS + k, bytes(raw))
    events = read(tmp_path / "run")
    assert [e.v for e in events] == [0.25] * 10


@pytest.mark.parametrize("kind", ["ros1", "mcap", "sqlite3"])
def test_recording_without_messages(tmp_path, kind):
    if kind == "ros1":
        path = write_ros1(tmp_path / "run.bag", n=0)
    else:
        path = tmp_path / "run"
        with BagWriter(path, storage=kind):
            pass
    with open_recording(path, DEFAULT) as recording:
        assert list(recording.events()) == []
        assert recording.duration_s == 0.0
        assert recording.roles == {}
    info = inspect(path, Config())
    [lacking] = [f.text for f in info.found if f.code == "motion.unmeasured"]
    assert lacking in format_info(info)
