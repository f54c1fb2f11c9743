"""Images of the simulated camera: MuJoCo's render through a lens, an exposure and a sensor; or corners without images.

Radiance is linear: sub-frames over the exposure are averaged, blurred by the lens, distorted, exposed and quantised.

`CornerDetector` gives the corners that a marker detector finds, without rendering: true corners through the true
camera, and noise. Good enough where a test or a drive is not about images: what a detector misses in a real image,
for blur or at a slant, is here a matter of size, angle and light alone, and no marker is hidden by the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from fgloc.errors import FglocError
from fgloc.frames import quaternion_matrix
from fgloc.types import FloatArray
from fgloc_datasets.sim.physics import TICK_S, Log, Scene
from fgloc_datasets.sim.scenario import FRONT, Camera, LightStep, channel_rng
from fgloc_datasets.sim.scene import camera_rotation, intrinsics, render_size

# --- Images -----------------------------------------------------------------------------------------------------------

Image = NDArray[np.uint8]
_REMEDY = "install libegl1 and libgl1-mesa-dri (EGL) or libosmesa6 (MUJOCO_GL=osmesa), or record without camera"
_SUBFRAMES = (4, 24)  # at least: they also smooth the edges; at most
_READ_SHARE = 0.3  # of the noise's variance at gain 1 and middle gray that does not depend on the light
_FIRST_FRAME_S = 0.1


class RenderError(FglocError):
    """No OpenGL to render with."""


@dataclass(frozen=True, slots=True)
class Shot:
    """Opening time of the shutter, and the settings of the automatic exposure."""

    start_s: float
    exposure_s: float
    gain: float
    light: float  # 1 is full

    @property
    def stamp_s(self) -> float:
        """Time of the image: the middle of the exposure."""
        return self.start_s + 0.5 * self.exposure_s


class Renderer:
    """Renders the scene from the robot's camera, undistorted and oversampled. Close it after use."""

    def __init__(self, scene: Scene, name: str = FRONT) -> None:
        """Open an off-screen context for the camera of this name.

        Raises:
            RenderError: no OpenGL library, or it cannot render off screen.
        """
        self._scene, self._data, self._name = scene, mujoco.MjData(scene.model), name
        self._width, self._height, _ = render_size(scene.scenario.cameras[name])
        try:
            self._renderer = mujoco.Renderer(scene.model, self._height, self._width)
        except Exception as error:  # every backend raises its own kind, down to AttributeError
            raise RenderError(f"no off-screen OpenGL ({type(error).__name__}: {error}); {_REMEDY}") from error
        self._pixels = np.empty((self._height, self._width, 3), np.uint8)

    def render(self, position: FloatArray, quaternion: FloatArray, shift_px: FloatArray) -> Image:
        """Radiance ``(height, width)`` seen from a pose of the base, the pixel grid shifted by a part of a pixel."""
        data = self._data
        data.qpos[:3], data.qpos[3:7] = position, np.roll(quaternion, 1)
        mujoco.mj_kinematics(self._scene.model, data)
        mujoco.mj_camlight(self._scene.model, data)
        self._renderer.update_scene(data, self._name)
        for camera in self._renderer.scene.camera:
            pixel = (camera.frustum_top - camera.frustum_bottom) / self._height
            camera.frustum_center += shift_px[0] * pixel
            camera.frustum_top -= shift_px[1] * pixel
            camera.frustum_bottom -= shift_px[1] * pixel
        self._renderer.render(out=self._pixels)
        return self._pixels[..., 0]

    def screen(self, marker_ids: set[int]) -> None:
        """Put screens in front of these markers and of no others."""
        for marker_id in self._scene.landmarks.landmarks:
            self._scene.model.geom(f"screen{marker_id}").rgba[3] = float(marker_id in marker_ids)

    def close(self) -> None:
        """Free the context."""
        self._renderer.close()


class Lens:
    """Point spread and distortion: from an oversampled pinhole render to the image."""

    def __init__(self, camera: Camera) -> None:
        """Prepare the lookup."""
        width, height, focal = render_size(camera)
        self._sigma = camera.blur_px * camera.oversampling
        u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
        pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
        rays = cv2.undistortPoints(
            pixels, intrinsics(camera), np.asarray(camera.distortion), None, None, None, criteria
        ).reshape(camera.height, camera.width, 2)
        at = rays * focal + (0.5 * width - 0.5, 0.5 * height - 0.5)
        self._maps = cv2.convertMaps(at.astype(np.float32), None, cv2.CV_32FC1)[:2]

    def image(self, radiance: NDArray[np.float32]) -> NDArray[np.float32]:
        """Image ``(height, width)`` of a render."""
        if self._sigma > 0:
            radiance = cv2.GaussianBlur(radiance, (0, 0), self._sigma)
        return np.asarray(cv2.remap(radiance, *self._maps, cv2.INTER_LINEAR))


def exposures(scene: Scene, log: Log, name: str = FRONT) -> Iterator[tuple[Shot, Callable[[], Image]]]:
    """All shots of a run, in order, each with the function that renders its image.

    It is to be called once the log reaches beyond the exposure, and before the next shot is asked for.

    Raises:
        RenderError: no OpenGL.
    """
    camera = scene.scenario.cameras[name]
    rng = channel_rng(scene.seed, name)
    lens = Lens(camera)
    hidden = occluded(scene)
    renderer = Renderer(scene, name)
    try:
        for shot in shots(scene, log, name):

            def take(shot: Shot = shot) -> Image:
                renderer.screen({m for ids, begin, end in hidden if begin <= shot.start_s < end for m in ids})
                image = lens.image(_expose(renderer, camera, log, shot.start_s, shot.exposure_s))
                image *= shot.light * shot.gain * shot.exposure_s / camera.exposure_s
                return _sense(image, camera.noise, shot.gain, rng)

            yield shot, take
    finally:
        renderer.close()


def shots(scene: Scene, log: Log, name: str = FRONT) -> Iterator[Shot]:
    """All shots of a run by one of its cameras, in order."""
    camera = scene.scenario.cameras[name]
    n = int((log.stamps_s[-1] - _FIRST_FRAME_S - camera.max_exposure_s) * camera.rate_hz) + 1
    wanted = camera.exposure_s  # exposure times gain that the automatic exposure has reached
    for k in range(n):
        start = _FIRST_FRAME_S + k / camera.rate_hz
        light = light_level(scene.scenario.world.light, start)
        follow = 1.0 - math.exp(-1.0 / camera.rate_hz / camera.exposure_lag_s)
        wanted *= (camera.exposure_s / light / wanted) ** follow if k > 0 else 1.0 / light
        exposure = min(wanted, camera.max_exposure_s)
        yield Shot(start, exposure, min(max(wanted / exposure, 1.0), camera.max_gain), light)


def light_level(steps: tuple[LightStep, ...], t: float) -> float:
    """Light at a time [s]; 1 before the first step."""
    level = 1.0
    for step in steps:
        if step.at_s <= t:
            level = step.level
    return level


def pose_at(log: Log, t: float) -> tuple[FloatArray, FloatArray]:
    """Position ``(3,)`` and quaternion ``(4,)`` at a time [s], between the log's ticks."""
    k = min(int(t / TICK_S), len(log.stamps_s) - 2)
    a = t / TICK_S - k
    q = (1 - a) * log.quaternions[k] + a * log.quaternions[k + 1]
    return (1 - a) * log.positions[k] + a * log.positions[k + 1], q / np.linalg.norm(q)


def _expose(renderer: Renderer, camera: Camera, log: Log, start: float, exposure: float) -> NDArray[np.float32]:
    tick = min(int(start / TICK_S), len(log.stamps_s) - 1)
    speed_px = camera.focal_px * (np.linalg.norm(log.rates[tick]) + np.linalg.norm(log.velocities[tick]))
    low, high = _SUBFRAMES
    n = low
    if camera.motion_blur:
        n = int(np.clip(math.ceil(speed_px * exposure / 0.8), low, high))
    shifts = _shifts(n)
    total = 0.0
    for i in range(n):
        at = start + exposure * ((i + 0.5) / n if camera.motion_blur else 0.5)
        total = total + renderer.render(*pose_at(log, at), shifts[i]).astype(np.float32)
    return np.asarray(total / n, dtype=np.float32)


def _shifts(n: int) -> FloatArray:
    """Places ``(n, 2)`` within a pixel, evenly spread, of mean zero [px]. Source: the R2 sequence of Roberts, 2018."""
    i = np.arange(1, n + 1)[:, None]
    points = (i * np.array([0.7548776662466927, 0.5698402909980532])) % 1.0
    return np.asarray(points - points.mean(axis=0))


def _sense(image: NDArray[np.float32], noise: float, gain: float, rng: np.random.Generator) -> Image:
    middle = 128.0
    variance = noise**2 * (_READ_SHARE * gain**2 + (1 - _READ_SHARE) * gain * image / middle)
    noisy = image + np.sqrt(variance) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def occluded(scene: Scene) -> list[tuple[set[int], float, float]]:
    """Ids of the occluded markers, start and end [s] of each occlusion."""
    rng = channel_rng(scene.seed, "occlusions")
    ids = np.array(list(scene.landmarks.landmarks))
    out = []
    for occlusion in scene.scenario.world.occlusions:
        chosen = rng.permutation(ids)[: math.ceil(occlusion.share * len(ids))]
        out.append(({int(i) for i in chosen}, occlusion.start_s, occlusion.end_s))
    return out


# --- Corners without images -------------------------------------------------------------------------------------------

_NOISE_PX = 0.07  # of one coordinate; rendered and detected: 0.03 px near, 0.1 px far and moving
_LEAST_SIDE_PX = 14.0
_LARGEST_SLANT = math.radians(70.0)
_LEAST_LIGHT = 0.1  # of a well exposed image
_NEAR_M = 0.05


class CornerDetector:
    """Finds markers in shots, in order."""

    def __init__(self, scene: Scene, log: Log, name: str = FRONT) -> None:
        """Take the markers at their true places."""
        camera = scene.scenario.cameras[name]
        self._log, self._camera = log, camera
        self._rng = channel_rng(scene.seed, "corners" if name == FRONT else f"corners of {name}")
        self._hidden = occluded(scene)
        self._markers = {i: (m.corners(), m.rotation[:, 2]) for i, m in scene.landmarks.landmarks.items()}
        self._R_base_cam = camera_rotation(camera)

    def find(self, shot: Shot) -> dict[int, FloatArray]:
        """Corners ``(4, 2)`` [px] by id, clockwise from the marker's top left."""
        bright = shot.light * shot.gain * shot.exposure_s / self._camera.exposure_s
        if bright < _LEAST_LIGHT:
            return {}
        position, quaternion = pose_at(self._log, shot.stamp_s)
        R_map_base = quaternion_matrix(quaternion)
        R_map_cam, eye = R_map_base @ self._R_base_cam, position + R_map_base @ self._camera.position
        hidden = {i for ids, begin, end in self._hidden if begin <= shot.start_s < end for i in ids}
        found = {}
        for marker_id, (corners, normal) in self._markers.items():
            seen = self._project((corners - eye) @ R_map_cam)
            towards = eye - corners.mean(axis=0)
            slant = math.acos(min(float(normal @ towards) / float(np.linalg.norm(towards)), 1.0))
            if marker_id not in hidden and slant < _LARGEST_SLANT and seen is not None:
                found[marker_id] = seen + self._rng.normal(0.0, _NOISE_PX, (4, 2))
        return found

    def _project(self, in_cam: FloatArray) -> FloatArray | None:
        """Pixels ``(4, 2)`` of points ``(4, 3)`` in the camera's frame; None: not wholly in the image, or too small."""
        camera = self._camera
        if in_cam[:, 2].min() < _NEAR_M or np.abs(in_cam[:, :2] / in_cam[:, 2:]).max() > 1.0:
            return None
        lens = np.asarray(camera.distortion)
        pixels = cv2.projectPoints(in_cam, np.zeros(3), np.zeros(3), intrinsics(camera), lens)[0][:, 0]
        inside = (pixels >= 1.0).all() and (pixels <= np.array([camera.width, camera.height]) - 2.0).all()
        side = np.linalg.norm(pixels - np.roll(pixels, 1, axis=0), axis=1).min()
        return np.asarray(pixels) if inside and side >= _LEAST_SIDE_PX else None
