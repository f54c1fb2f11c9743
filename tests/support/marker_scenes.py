"""Images of markers with known pose and camera, rendered by homography with supersampling."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fgloc.frames import rpy_matrix
from fgloc.sensors.markers.images import ImageEvent
from fgloc.types import Camera, FloatArray, Landmark

# Optical axes in body axes: z forward, x right, y down (REP 103).
BODY_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# First row of bits of tag 0 as the AprilTag project prints it upright (apriltag-imgs: tag36h11, tag36_11_00000.png).
TAG36H11_0_TOP_ROW = (1, 1, 0, 1, 0, 1)


def transform(xyz: Sequence[float], rotation: FloatArray) -> FloatArray:
    """Homogeneous (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, xyz
    return T


def forward_camera(
    width: int = 640, height: int = 480, focal: float = 525.0, D: Sequence[float] = (), model: str = "plumb_bob"
) -> Camera:
    """A camera that looks ahead, 10 cm before the base and 25 cm up."""
    K = np.array([[focal, 0.0, width / 2 - 0.5], [0.0, focal, height / 2 - 0.5], [0.0, 0.0, 1.0]])
    return Camera(width, height, model, K, np.array(D, dtype=float), transform((0.1, 0.0, 0.25), BODY_OPTICAL))


def standing(landmark_id: int, xyz: Sequence[float], facing: float, size: float = 0.2) -> Landmark:
    """An upright marker whose face looks along this yaw [rad]."""
    c, s = np.cos(facing), np.sin(facing)
    rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])
    return Landmark(landmark_id, np.array(xyz, dtype=float), rotation, size)


def base_transform(pose: Sequence[float]) -> FloatArray:
    """T_map_base (4, 4) of x, y, yaw."""
    return transform((pose[0], pose[1], 0.0), rpy_matrix(0.0, 0.0, pose[2]))


def project(camera: Camera, pose: Sequence[float], points: FloatArray) -> FloatArray:
    """Pixels (n, 2) of map points (n, 3) seen from a base pose x, y, yaw, with the camera's distortion."""
    T_cam_map = np.linalg.inv(base_transform(pose) @ camera.T_base_cam)
    in_cam = points @ T_cam_map[:3, :3].T + T_cam_map[:3, 3]
    assert (in_cam[:, 2] > 0).all()
    zero = np.zeros(3)
    if camera.model == "equidistant":
        pixels, _ = cv2.fisheye.projectPoints(in_cam[:, None], zero, zero, camera.K, camera.D)
    else:
        pixels, _ = cv2.projectPoints(in_cam, zero, zero, camera.K, camera.D if camera.D.size else None)
    return np.asarray(pixels, dtype=float).reshape(-1, 2)


def texture(dictionary: str, marker_id: int, cell_px: int) -> NDArray[np.uint8]:
    """The marker, upright as its project prints it, with a quiet zone of one cell."""
    table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = table.markerSize + 2
    image = cv2.aruco.generateImageMarker(table, marker_id, cells * cell_px)
    if "APRILTAG" in dictionary:
        tag0 = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        row = cv2.aruco.generateImageMarker(tag0, 0, 8)[1, 1:7] // 255
        if tuple(row) != TAG36H11_0_TOP_ROW:
            image = np.rot90(image, 2)
    return cv2.copyMakeBorder(image, cell_px, cell_px, cell_px, cell_px, cv2.BORDER_CONSTANT, value=255)


def render(
    camera: Camera,
    pose: Sequence[float],
    landmarks: Sequence[Landmark],
    dictionary: str,
    rng: np.random.Generator | None = None,
    blur_px: float = 0.6,
    scale: int = 5,
) -> NDArray[np.uint8]:
    """What a camera without distortion sees, anti-aliased; with noise if rng is given."""
    canvas = np.full((camera.height * scale, camera.width * scale), 128.0, dtype=np.float32)
    fine = np.array([[scale, 0.0, (scale - 1) / 2], [0.0, scale, (scale - 1) / 2], [0.0, 0.0, 1.0]])
    T_cam_map = np.linalg.inv(base_transform(pose) @ camera.T_base_cam)
    for landmark in landmarks:
        picture = texture(dictionary, landmark.landmark_id, cell_px=40)
        n_px = picture.shape[0]
        cells = n_px // 40 - 2
        metre = landmark.size_m / (cells * 40)
        half = 0.5 * n_px - 0.5
        local = np.array([[metre, 0.0, -metre * half], [0.0, -metre, metre * half], [0.0, 0.0, 1.0]])
        T = T_cam_map @ transform(landmark.position, landmark.rotation)
        H = fine @ camera.K @ T[:3, [0, 1, 3]] @ local
        size = (canvas.shape[1], canvas.shape[0])
        seen = cv2.warpPerspective(picture.astype(np.float32), H, size, flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.ones_like(picture), H, size, flags=cv2.INTER_NEAREST) > 0
        canvas[mask] = seen[mask]
    image = cv2.resize(canvas * 0.75 + 30.0, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), blur_px)
    if rng is not None:
        image = image + rng.normal(0.0, 2.0, image.shape)
    return np.clip(image.round(), 0, 255).astype(np.uint8)


def image_event(image: NDArray[np.uint8], stamp_ns: int = 1_000_000_000) -> ImageEvent:
    """The image as a mono8 message."""
    height, width = image.shape
    return ImageEvent(
        stamp_ns, stamp_ns + 5_000_000, "/camera/image", "camera_optical", "mono8", False, width, height, width, False,
        image.reshape(-1),
    )  # fmt: skip
