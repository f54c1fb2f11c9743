"""Camera calibrations: CameraInfo, ROS and OpenCV calibration files, Kalibr; checked before they are used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from fgloc import se2
from fgloc.config import CameraConfig
from fgloc.errors import CameraError
from fgloc.files.documents import Item, read_document
from fgloc.frames import homogeneous
from fgloc.types import Camera, CameraInfoEvent, FloatArray, Landmark

# What ROS, OpenCV and Kalibr call the models. The number of coefficients tells plumb_bob and rational_polynomial apart.
_FISHEYE = ("equidistant", "fisheye")
_MODELS = ("plumb_bob", "radtan", "none", "rational_polynomial", *_FISHEYE)
_UNDISTORT = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
_LARGEST_PX = 100_000  # no camera has more on a side


def camera_from_info(
    event: CameraInfoEvent, T_base_cam: FloatArray, size: tuple[int, int] | None = None, rectified: bool = False
) -> Camera:
    """The camera that a CameraInfo describes, mounted at ``T_base_cam (4, 4)``.

    Args:
        event: the message.
        T_base_cam: mounting of the optical frame.
        size: width and height of the images, which tell whether its region of interest and its binning are theirs;
            None: not known, they are.
        rectified: whether the images have no distortion: their focal length and principal point are those of P.

    Raises:
        CameraError: K is zeros, not finite or has no positive focal length; unknown or impossible distortion.

    Source: sensor_msgs/CameraInfo, whose K, P, width and height are of the full resolution.
    """
    K, D = np.array(event.K, dtype=np.float64), event.D
    if rectified and event.P is not None and event.P[:, :3].any():
        K, D = event.P[:, :3].copy(), np.zeros(4)
    full = event.width, event.height
    if size in (None, event.image_size) and event.image_size != full:
        first, share = np.array(event.roi[:2]), np.array(event.binning)
        K[:2, 2] = (K[:2, 2] - first + 0.5) / share - 0.5  # pixel centers are at whole numbers
        K[[0, 1], [0, 1]] /= share
        full = event.image_size
    model = "" if D is not event.D else event.distortion_model
    return _checked(f"{event.topic} (CameraInfo)", full, model, K, D, T_base_cam, event.frame_id)


def load_camera(path: Path, T_base_cam: FloatArray, topic: str | None = None) -> Camera:
    """Read a calibration file: ROS (camera_calibration), OpenCV (FileStorage YAML) or Kalibr (camchain).

    Args:
        path: the file.
        T_base_cam: mounting ``(4, 4)`` of the optical frame.
        topic: of the images: of several cameras in a Kalibr file the one with this ``rostopic``, else cam0, is meant.

    Raises:
        CameraError: the file is none of these, or its calibration cannot be used.
    """
    root = read_document(path, CameraError, remedy="give a calibration YAML file")
    keys = dict(root.pairs())
    if "camera_matrix" in keys and "distortion_model" not in keys and "camera_name" not in keys:
        return _opencv(path, root, T_base_cam)
    if "camera_matrix" in keys:
        return _ros(path, root, T_base_cam)
    cameras = {key: item for key, item in keys.items() if item.is_mapping and item.get("intrinsics") is not None}
    if cameras:
        return _kalibr(path, cameras, T_base_cam, topic)
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


def _opencv(path: Path, root: Item, T_base_cam: FloatArray) -> Camera:
    K = root.need("camera_matrix").need("data").numbers(9).reshape(3, 3)
    distortion, fisheye = root.get("distortion_coefficients"), root.get("fisheye_model")
    D = np.zeros(0) if distortion is None else distortion.need("data").numbers()
    width, height = (
        0 if item is None else round(item.number()) for item in map(root.get, ("image_width", "image_height"))
    )
    model = "fisheye" if fisheye is not None and fisheye.number() else "plumb_bob"
    return _checked(str(path), (width, height), model, K, D, T_base_cam, "")


def _kalibr(path: Path, cameras: dict[str, Item], T_base_cam: FloatArray, topic: str | None) -> Camera:
    topics = {name: item.get("rostopic") for name, item in cameras.items()}
    own = [name for name, its in topics.items() if its is not None and f"{topic}/".startswith(f"{its.text()}/")]
    chosen = own[0] if own else "cam0" if "cam0" in cameras else next(iter(cameras))
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
    if not own and len(cameras) > 1:
        others = ", ".join(k for k in cameras if k != chosen)
        note = f"{path}: camera {chosen} is used, not {others}: the images' topic is the rostopic of none."
        camera = replace(camera, notes=(*camera.notes, note))
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
    if not all(0 <= side <= _LARGEST_PX for side in size):
        raise CameraError(f"{source}: an image of {size[0]}x{size[1]} pixels; expected 0 to {_LARGEST_PX} on a side")
    if not matrix.any():
        raise CameraError(f"{source}: the camera matrix K is all zeros: the camera is not calibrated; give camera.file")
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


# --- poses of squares -------------------------------------------------------------------------------------------------

_MIN_DEPTH_M = 0.01
_EXPLAINED_PX = 3.0  # a surveyed map and a calibrated camera leave less
_ITERATIONS = 20
_SAME = 1e-3  # metres and radians: two refined poses nearer than this are one
_TILT_SIGMA = 1.0  # rad; what is known of a marker's orientation beforehand, so that a frontal view has a covariance


def marker_pose_candidates(
    camera: Camera, corners_px: FloatArray, size_m: float
) -> tuple[tuple[FloatArray, float], ...]:
    """Poses of one square marker that explain its corners, the better one first.

    A flat square seen with little perspective has two, mirrored about the line of sight.

    Args:
        camera: intrinsics; any lens model.
        corners_px: ``(4, 2)`` in the order of MarkerCorners.
        size_m: side.

    Returns:
        ``T_cam_marker (4, 4)`` and root mean square reprojection error [px], without distortion; up to two, none for
        degenerate corners.

    Source: Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109, 2014 (OpenCV's IPPE_SQUARE).
    """
    return _candidates(camera, np.asarray(corners_px, dtype=np.float64).tobytes(), size_m)


@lru_cache(maxsize=256)  # the estimator, its check and the diagnosis ask for the same markers
def _candidates(camera: Camera, corners_px: bytes, size_m: float) -> tuple[tuple[FloatArray, float], ...]:
    ideal, corners = without_distortion(camera, np.frombuffer(corners_px).reshape(4, 2))
    if not np.isfinite(corners).all():
        return ()
    # 1. Solve in a frame whose axes lie along the camera's: OpenCV turns the rotation into a vector and loses it where
    #    its angle is near 180 degrees, as that of an upright marker in an upright camera is.
    across = corners[1] - corners[0]
    quarter_turns = -round(math.atan2(across[1], across[0]) / (0.5 * math.pi))
    order = [(quarter_turns + k) % 4 for k in (3, 2, 1, 0)]
    turned = corners[order]  # from the bottom left, counter-clockwise in the image
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            _square(size_m), turned, ideal.K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:  # collinear corners
        return ()
    # 2. Turn back: half a turn about x, then as many quarter turns about z.
    c, s = round(math.cos(0.5 * math.pi * quarter_turns)), round(math.sin(0.5 * math.pi * quarter_turns))
    back = np.diag([1.0, -1.0, -1.0]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    found = []
    for r, t in zip(rotations, translations, strict=True):
        T = homogeneous(cv2.Rodrigues(r)[0] @ back, np.asarray(t, dtype=np.float64).ravel())
        points = _square(size_m) @ T[:3, :3].T + T[:3, 3]
        if np.isfinite(T).all() and points[:, 2].min() > _MIN_DEPTH_M:
            found.append((T, _rms(_project(ideal.K, points) - corners)))
    return tuple(sorted(found, key=lambda f: f[1]))


def marker_pose_cov(camera: Camera, T_cam_marker: FloatArray, size_m: float, sigma_px: float) -> FloatArray:
    """Covariance ``(6, 6)`` of a pose from four corners with this noise: first order, about one solution.

    Order: translation, then rotation, both as left perturbations in the camera's axes.
    """
    rotated = _square(size_m) @ T_cam_marker[:3, :3].T
    points = rotated + T_cam_marker[:3, 3]
    information = np.diag([0.0] * 3 + [_TILT_SIGMA**-2] * 3)
    for arm, point in zip(rotated, points, strict=True):
        J = _pixel_jacobian(camera.K, point) @ np.hstack([np.eye(3), -_cross(arm)])
        information += J.T @ J / sigma_px**2
    cov = np.linalg.inv(information)
    return np.asarray(0.5 * (cov + cov.T))


def planar_base_candidates(camera: Camera, corners: FloatArray, landmark: Landmark) -> list[tuple[FloatArray, float]]:
    """Poses of the base on the floor that explain one known marker's corners, the better one first.

    Both solutions for the marker are flattened, then refined with the base kept upright and on the floor: this uses
    what a single-marker pose does not know, and mostly tells the two apart.

    Args:
        camera: intrinsics and mounting; any lens model.
        corners: ``(4, 2)`` pixels in the order of MarkerCorners.
        landmark: the marker, with its size.

    Returns:
        ``T_map_base (3,)`` and root mean square reprojection error [px]; none if the marker is a point, or is nowhere
        before the camera.
    """
    if landmark.size_m <= 0.0:
        return []
    ideal, pixels = without_distortion(camera, corners)
    T_map_marker = homogeneous(landmark.rotation, landmark.position)
    T_cam_base = np.linalg.inv(camera.T_base_cam)
    found: list[tuple[FloatArray, float]] = []
    for T_cam_marker, _ in marker_pose_candidates(camera, corners, landmark.size_m):
        T = T_map_marker @ np.linalg.inv(T_cam_marker) @ T_cam_base
        start = np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])])
        refined = _refine(ideal, pixels, landmark.corners(), start)
        if refined is not None and not any(np.abs(se2.log(se2.between(p, refined[0]))).max() < _SAME for p, _ in found):
            found.append(refined)
    return sorted(found, key=lambda f: f[1])


def up_in_base(camera: Camera, seen: Sequence[tuple[FloatArray, Landmark]]) -> FloatArray | None:
    """The map's z axis ``(3,)`` in the base's axes, from several known markers in one image.

    Args:
        camera: intrinsics and mounting; any lens model.
        seen: corners ``(4, 2)`` [px] of each marker, in the order of MarkerCorners.

    Returns:
        None where no pose explains them.

    Source: Terzakis and Lourakis, "A consistently fast and globally optimal solution to the perspective-n-point
    problem", ECCV 2020 (OpenCV's SQPNP).
    """
    ideal, pixels = without_distortion(camera, np.vstack([corners for corners, _ in seen]))
    points = np.vstack([landmark.corners() for _, landmark in seen])
    if not np.isfinite(pixels).all() or any(landmark.size_m <= 0.0 for _, landmark in seen):
        return None
    try:
        found, r, t = cv2.solvePnP(points, pixels, ideal.K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return None
    if not found or not np.isfinite(r).all() or not np.isfinite(t).all():
        return None
    R_cam_map = cv2.Rodrigues(r)[0]
    in_cam = points @ R_cam_map.T + np.asarray(t).ravel()
    if in_cam[:, 2].min() < _MIN_DEPTH_M or _rms(_project(ideal.K, in_cam) - pixels) > _EXPLAINED_PX:
        return None
    return np.asarray(camera.T_base_cam[:3, :3] @ R_cam_map[:, 2])


def _refine(
    camera: Camera, pixels: FloatArray, corners_map: FloatArray, pose: FloatArray
) -> tuple[FloatArray, float] | None:
    """Levenberg–Marquardt over x, y, yaw on the reprojection of known points; None if they fall behind the camera."""
    T_cam_base = np.linalg.inv(camera.T_base_cam)
    R, t = T_cam_base[:3, :3], T_cam_base[:3, 3]

    def linearise(at: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        c, s = math.cos(at[2]), math.sin(at[2])
        base = (corners_map - [at[0], at[1], 0.0]) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        points = base @ R.T + t
        if points[:, 2].min() < _MIN_DEPTH_M:
            return None
        rows = []
        for (bx, by, _), point in zip(base, points, strict=True):
            moved = np.array([[-1.0, 0.0, by], [0.0, -1.0, -bx], [0.0, 0.0, 0.0]])  # of the point in the base
            rows.append(_pixel_jacobian(camera.K, point) @ R @ moved)
        return (_project(camera.K, points) - pixels).ravel(), np.vstack(rows)

    state = linearise(pose)
    damping = 1e-3
    for _ in range(_ITERATIONS):
        if state is None:
            return None
        residual, J = state
        normal = J.T @ J
        step = np.asarray(-np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), J.T @ residual))
        moved = se2.compose(pose, step)
        trial = linearise(moved)
        if trial is not None and trial[0] @ trial[0] < residual @ residual:
            pose, state, damping = moved, trial, 0.1 * damping
        else:
            damping *= 10.0
        if np.abs(step).max() < 1e-9 or damping > 1e12:
            break
    return None if state is None else (pose, _rms(state[0]))


def _square(size_m: float) -> FloatArray:
    h = 0.5 * size_m
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def _project(K: FloatArray, points: FloatArray) -> FloatArray:
    pixels = points @ K.T
    return np.asarray(pixels[:, :2] / pixels[:, 2:])


def _pixel_jacobian(K: FloatArray, point: FloatArray) -> FloatArray:
    """Derivative ``(2, 3)`` of the pixel by the point in the camera's frame."""
    x, y, z = point
    return np.asarray(K[:2, :2] @ np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]]))


def _cross(v: FloatArray) -> FloatArray:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rms(residuals: FloatArray) -> float:
    """Root mean square distance [px] of residuals ``(n, 2)`` or ``(2 n,)``."""
    return math.sqrt(float((np.asarray(residuals).reshape(-1, 2) ** 2).sum(axis=1).mean()))
