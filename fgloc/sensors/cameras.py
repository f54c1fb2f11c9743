"""Camera calibrations: CameraInfo, ROS and OpenCV calibration files, Kalibr; checked before they are used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fgloc.errors import CameraError
from fgloc.files.documents import Item, read_document
from fgloc.sensors.sighting_config import CameraConfig
from fgloc.types import Camera, CameraInfoEvent, FloatArray

# What ROS, OpenCV and Kalibr call the models. The number of coefficients tells plumb_bob and rational_polynomial apart.
_FISHEYE = ("equidistant", "fisheye")
_MODELS = ("plumb_bob", "radtan", "none", "rational_polynomial", *_FISHEYE)
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)


def camera_from_info(event: CameraInfoEvent, T_base_cam: FloatArray) -> Camera:
    """The camera that a CameraInfo describes, mounted at ``T_base_cam (4, 4)``.

    Raises:
        CameraError: K is zeros, not finite or has no positive focal length; unknown or impossible distortion.
    """
    source = f"{event.topic} (CameraInfo)"
    return _checked(
        source, (event.width, event.height), event.distortion_model, event.K, event.D, T_base_cam, event.frame_id
    )


def load_camera(path: Path, T_base_cam: FloatArray, name: str | None = None) -> Camera:
    """Read a calibration file: ROS (camera_calibration), OpenCV (FileStorage YAML) or Kalibr (camchain).

    Args:
        path: the file.
        T_base_cam: mounting ``(4, 4)`` of the optical frame.
        name: camera of a Kalibr file; None: the only one, or cam0.

    Raises:
        CameraError: the file is none of these, or its calibration cannot be used.
    """
    # FileStorage writes "%YAML:1.0" and "!!opencv-matrix", which YAML readers refuse.
    try:
        head = path.read_bytes()[:4096]
    except OSError as error:
        raise CameraError(f"{path}: cannot be read ({error.strerror}); give a calibration YAML file") from error
    if head.startswith(b"%YAML:") or b"opencv-matrix" in head:
        return _opencv(path, T_base_cam)
    root = read_document(path, CameraError)
    keys = dict(root.pairs())
    if "camera_matrix" in keys:
        return _ros(path, root, T_base_cam)
    cameras = {key: item for key, item in keys.items() if item.is_mapping and item.get("intrinsics") is not None}
    if cameras:
        return _kalibr(path, cameras, T_base_cam, name)
    raise CameraError(
        f"{path}: no calibration in it: expected camera_matrix (ROS, OpenCV) or cam0: intrinsics (Kalibr), "
        f"got the keys {', '.join(keys)}"
    )


def rescaled(camera: Camera, width: int, height: int) -> Camera:
    """The camera with its image scaled to ``width`` by ``height`` pixels; the distortion stays as it is.

    Raises:
        CameraError: the calibration's size is unknown, or the new one has another shape (it is cropped, not scaled).
    """
    if camera.width == 0 or camera.height == 0:
        raise CameraError(f"the calibration names no image size, so it cannot be scaled to {width}x{height}")
    sx, sy = width / camera.width, height / camera.height
    if abs(sx / sy - 1.0) > 0.01:
        raise CameraError(
            f"a calibration for {camera.width}x{camera.height} cannot be scaled to {width}x{height}: another shape "
            "means a crop; calibrate at this size"
        )
    K = camera.K.copy()
    K[0] *= sx
    K[1] *= sy
    K[0, 2] += 0.5 * sx - 0.5  # pixel centers are at whole numbers
    K[1, 2] += 0.5 * sy - 0.5
    note = f"The calibration for {camera.width}x{camera.height} pixels is scaled to {width}x{height}."
    return replace(camera, width=width, height=height, K=K, notes=(*camera.notes, note))


def corrected(camera: Camera, config: CameraConfig) -> Camera:
    """The camera with the focal length, principal point and distortion that the configuration gives."""
    K, D = camera.K.copy(), camera.D
    K[[0, 1], [0, 1]] *= config.focal_scale
    if config.cx_px is not None:
        K[0, 2] = config.cx_px
    if config.cy_px is not None:
        K[1, 2] = config.cy_px
    if (config.k1 is not None or config.k2 is not None) and pinhole(camera) is camera:
        D = np.concatenate([D, np.zeros(4)])[: max(4, len(D))]
        D[:2] = [D[0] if config.k1 is None else config.k1, D[1] if config.k2 is None else config.k2]
    return replace(camera, K=K, D=D)


def pinhole(camera: Camera) -> Camera:
    """The camera whose corners `undistort_points` gives: itself if k1, k2, p1, p2 explain it, else without distortion.

    The factor graph's camera (GTSAM's Cal3DS2) has these four coefficients only.
    """
    if camera.model == "plumb_bob" and (len(camera.D) < 5 or camera.D[4] == 0.0):
        return camera
    return replace(camera, model="plumb_bob", D=np.zeros(4))


def undistort_points(camera: Camera, corners: FloatArray) -> FloatArray:
    """Pixels ``(n, 2)`` of the recorded image in the image of `pinhole(camera)`; NaN where the lens model has none."""
    if pinhole(camera) is camera:
        return np.asarray(corners, dtype=np.float64)
    return _ideal_pixels(camera, corners)


def without_distortion(camera: Camera, corners: FloatArray) -> tuple[Camera, FloatArray]:
    """A camera without any distortion, and where pixels ``(n, 2)`` of the recorded image lie in its image."""
    return replace(camera, model="plumb_bob", D=np.zeros(4)), _ideal_pixels(camera, corners)


def _ideal_pixels(camera: Camera, corners: FloatArray) -> FloatArray:
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 1, 2)
    if camera.model == "equidistant":
        ideal = cv2.fisheye.undistortPoints(points, camera.K, camera.D, P=camera.K, criteria=_UNDISTORT)
    else:
        ideal = cv2.undistortPoints(points, camera.K, camera.D, P=camera.K, criteria=_UNDISTORT)
    found = np.asarray(ideal, dtype=np.float64).reshape(-1, 2)
    return np.where(np.abs(found) < 1e6, found, np.nan)  # OpenCV gives -1e6 for a ray beyond the lens


def _ros(path: Path, root: Item, T_base_cam: FloatArray) -> Camera:
    K = root.need("camera_matrix").need("data").numbers(9).reshape(3, 3)
    distortion = root.get("distortion_coefficients")
    D = np.zeros(0) if distortion is None else distortion.need("data").numbers()
    model, name = root.get("distortion_model"), root.get("camera_name")
    width, height = (root.need(key).integer() for key in ("image_width", "image_height"))
    frame = "" if name is None else name.text()
    return _checked(str(path), (width, height), "" if model is None else model.text(), K, D, T_base_cam, frame)


def _opencv(path: Path, T_base_cam: FloatArray) -> Camera:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        nodes = {
            key: storage.getNode(key)
            for key in ("camera_matrix", "distortion_coefficients", "image_width", "image_height", "fisheye_model")
        }
        K, D = (nodes[key].mat() for key in ("camera_matrix", "distortion_coefficients"))
        width, height, fisheye = (
            0 if nodes[key].empty() else int(nodes[key].real())
            for key in ("image_width", "image_height", "fisheye_model")
        )
    except (cv2.error, SystemError) as error:
        raise CameraError(f"{path}: not a calibration of OpenCV: {error}") from error
    if K is None:
        raise CameraError(f"{path}: no camera_matrix in it; expected a calibration file of OpenCV")
    coefficients = np.zeros(0) if D is None else np.asarray(D, dtype=np.float64)
    model = "fisheye" if fisheye else "plumb_bob"
    return _checked(str(path), (width, height), model, np.asarray(K, dtype=np.float64), coefficients, T_base_cam, "")


def _kalibr(path: Path, cameras: dict[str, Item], T_base_cam: FloatArray, name: str | None) -> Camera:
    chosen = name or ("cam0" if "cam0" in cameras else next(iter(cameras)))
    if chosen not in cameras:
        raise CameraError(f"{path}: no camera '{chosen}'; there are {', '.join(cameras)}")
    item = cameras[chosen]
    kind = item.need("camera_model").text()
    if kind != "pinhole":
        raise item.fail(f"camera_model '{kind}' is not supported; calibrate with pinhole-radtan or pinhole-equi")
    fx, fy, cx, cy = item.need("intrinsics").numbers(4)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    model, coefficients = item.get("distortion_model"), item.get("distortion_coeffs")
    D = np.zeros(0) if coefficients is None else coefficients.numbers()
    width, height = (int(v) for v in item.need("resolution").numbers(2))
    camera = _checked(str(path), (width, height), "" if model is None else model.text(), K, D, T_base_cam, "")
    if name is None and len(cameras) > 1:
        others = ", ".join(k for k in cameras if k != chosen)
        camera = replace(camera, notes=(*camera.notes, f"{path}: camera {chosen} is used, not {others}."))
    return camera


def _checked(
    source: str,
    size: tuple[int, int],
    model: str,
    K: FloatArray,
    D: FloatArray | Sequence[float],
    T_base_cam: FloatArray,
    frame_id: str,
) -> Camera:
    matrix, coefficients = np.asarray(K, dtype=np.float64), np.asarray(D, dtype=np.float64).ravel()
    if not matrix.any():
        raise CameraError(f"{source}: the camera matrix K is all zeros: the camera is not calibrated; calibrate it")
    if not (np.isfinite(matrix).all() and np.isfinite(coefficients).all()):
        raise CameraError(f"{source}: K or D is not finite: K {matrix.ravel().tolist()}, D {coefficients.tolist()}")
    if matrix[0, 0] <= 0.0 or matrix[1, 1] <= 0.0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise CameraError(
            f"{source}: K is {matrix.ravel().tolist()}, expected positive focal lengths and a last row of 0, 0, 1"
        )
    if not np.isfinite(T_base_cam).all():
        raise CameraError(f"{source}: the mounting T_base_cam is not finite: {np.asarray(T_base_cam).tolist()}")
    if model and model not in _MODELS:
        raise CameraError(f"{source}: distortion model '{model}' is not known; known are {', '.join(_MODELS)}")
    notes = []
    fisheye = model in _FISHEYE
    if len(coefficients) == 0:
        notes.append(f"{source}: no distortion coefficients; all are taken as zero.")
        coefficients = np.zeros(4)
    if len(coefficients) in (12, 14) and not coefficients[8:].any():
        coefficients = coefficients[:8]  # thin prism and tilt unused
    lengths = (4,) if fisheye else (4, 5, 8)
    if len(coefficients) not in lengths:
        raise CameraError(
            f"{source}: {len(coefficients)} distortion coefficients, '{model}' has {' or '.join(map(str, lengths))}"
        )
    own = "equidistant" if fisheye else "rational_polynomial" if len(coefficients) == 8 else "plumb_bob"
    width, height = size
    if width <= 0 or height <= 0:
        notes.append(f"{source}: no image size; it is not checked that the images have the calibration's size.")
        width = height = 0
    return Camera(width, height, own, matrix, coefficients, np.asarray(T_base_cam), frame_id, tuple(notes))
