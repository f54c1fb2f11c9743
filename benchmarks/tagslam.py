"""A hand-held camera and nothing else: TagSLAM's tests 1, 13 and 17, on the tags as TagSLAM has them.

- ``tagslam.N.MODE.median_mm``: distance in space of the camera (17: of its rig) from TagSLAM's own poses, which are no
  truth. Calibration and mounting are those of the set, without uncertainty, as TagSLAM took them; ``estimator.ground``
  is uneven, heights count from the first pose. The other tests have several cameras, stairs, no motion, or a reference
  of two poses.
"""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from benchmarks.common import DATA, Row, main, not_run, stamp_of
from fgloc.config import load_config
from fgloc.runner import run
from fgloc.sensors.maps import write_map
from fgloc.types import FloatArray, Landmark, LandmarkMap

_SIZE_M = {1: 0.225, 13: 0.12, 17: 0.16}
_MOUNTED = {17: [0.1, 0.0, 0.0, 0.0, 0.0, np.pi / 2]}  # elsewhere the rig is the camera
_SURE = ("position_sigma_m", "rotation_sigma_rad", "focal_sigma", "principal_sigma_px", "distortion_sigma")
_MODES = ("batch", "online")


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the tests; a quick run has the shortest alone."""
    tests = (1,) if quick else tuple(_SIZE_M)
    if not (DATA / "tagslam").is_dir():
        names = [f"tagslam.{test}.{mode}.median_mm" for test in tests for mode in _MODES]
        yield from not_run(names, f"no {DATA / 'tagslam'}; set FGLOC_REAL_DATA")
        return
    for test in tests:
        with TemporaryDirectory(prefix="fgloc-tagslam-") as folder:
            yield from _rows(test, DATA / "tagslam" / f"test_{test}", Path(folder))


def _rows(test: int, source: Path, folder: Path) -> Iterator[Row]:
    bags = [folder / f"{name}.bag" for name in ("tag_detections", "reference")]
    for bag in bags:
        bag.write_bytes(bz2.decompress((source / f"{bag.name}.bz2").read_bytes()))
    tags, stamps, places = _reference(bags[1])
    level = places[0, 2]
    landmarks = {
        i: Landmark(i, T[:3, 3] - [0.0, 0.0, level], T[:3, :3], _SIZE_M[test]) for i, T in sorted(tags.items())
    }
    write_map(LandmarkMap(landmarks), folder / "map.yaml")
    camera = yaml.safe_load((source / "cameras.yaml").read_text("utf-8"))["cam0"]
    _describe(folder, camera, _MOUNTED.get(test, [0.0] * 6))
    for mode in _MODES:
        found = run(bags[0], folder / "map.yaml", load_config(folder / "robot.yaml"), mode, check=False).trajectory
        assert found.ground is not None
        ours = np.column_stack([found.poses[:, :2], found.ground[:, 0] + level])
        theirs = np.column_stack([np.interp(found.stamps_ns, stamps, column) for column in places.T])
        off = 1e3 * np.linalg.norm(ours - theirs, axis=1)
        yield Row(f"tagslam.{test}.{mode}.median_mm", float(np.median(off)), float(off.std()), len(off), "mm")


def _reference(bag: Path) -> tuple[dict[int, FloatArray], FloatArray, FloatArray]:
    """``T_map_tag (4, 4)`` by id, and stamps [ns] and places ``(n, 3)`` of the rig."""
    parents: dict[str, tuple[str, FloatArray]] = {}
    stamps, places = [], []
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/tf":
                for one in message.transforms:
                    T = _matrix(one.transform.translation, one.transform.rotation)
                    parents[one.child_frame_id] = one.header.frame_id, T
            else:
                pose = message.pose.pose
                stamps.append(stamp_of(message.header))
                places.append(_matrix(pose.position, pose.orientation)[:3, 3])
    tags = {}
    for name in parents:
        if name.startswith("tag_"):
            T, frame = np.eye(4), name
            while frame in parents:
                frame, step = parents[frame]
                T = step @ T
            tags[int(name[4:])] = T
    return tags, np.array(stamps), np.array(places)


def _matrix(position: Any, orientation: Any) -> FloatArray:
    T = np.eye(4)
    q = orientation
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def _describe(folder: Path, camera: dict[str, Any], mounted: list[float]) -> None:
    """Write robot.yaml and the camera's calibration."""
    fx, fy, cx, cy = camera["intrinsics"]
    distortion = camera["distortion_coeffs"]
    calibration = {
        "image_width": camera["resolution"][0],
        "image_height": camera["resolution"][1],
        "camera_matrix": {"rows": 3, "cols": 3, "data": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]},
        "distortion_model": "equidistant" if camera["distortion_model"] == "equidistant" else "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": distortion},
    }
    robot = {
        "camera": {"file": "camera.yaml"},
        "recording": {"sightings_pose": [float(v) for v in mounted]},
        "estimator": {"ground": "uneven"},
        "expert": {"camera": dict.fromkeys(_SURE, 0.0)},
    }
    (folder / "camera.yaml").write_text(yaml.safe_dump(calibration), "utf-8")
    (folder / "robot.yaml").write_text(yaml.safe_dump(robot), "utf-8")


if __name__ == "__main__":
    main(measure, __doc__ or "")
