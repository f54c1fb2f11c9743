"""The corners that a marker detector finds, without rendering: true corners through the true camera, and noise.

Good enough where a test or a drive is not about images: what a detector misses in a real image, for blur or at a
slant, is here a matter of size, angle and light alone, and no marker is hidden by the ground.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from fgloc.frames import quaternion_matrix
from fgloc.types import FloatArray
from fgloc_datasets.sim.camera import Shot, occluded, pose_at
from fgloc_datasets.sim.mjcf import camera_rotation, intrinsics
from fgloc_datasets.sim.physics import Log, Scene
from fgloc_datasets.sim.section import channel_rng

_NOISE_PX = 0.07  # of one coordinate; rendered and detected: 0.03 px near, 0.1 px far and moving
_LEAST_SIDE_PX = 14.0
_LARGEST_SLANT = math.radians(70.0)
_LEAST_LIGHT = 0.1  # of a well exposed image
_NEAR_M = 0.05


class CornerDetector:
    """Finds markers in shots, in order."""

    def __init__(self, scene: Scene, log: Log) -> None:
        """Take the markers where they hang."""
        camera = scene.scenario.camera
        assert camera is not None
        self._log, self._camera = log, camera
        self._rng = channel_rng(scene.seed, "corners")
        self._hidden = occluded(scene)
        self._markers = {i: (m.corners(), m.rotation[:, 2]) for i, m in scene.landmarks.landmarks.items()}
        self._R_base_cam = camera_rotation(camera)

    def find(self, shot: Shot) -> dict[int, FloatArray]:
        """Corners ``(4, 2)`` [px] by id, clockwise from the marker's top left."""
        bright = shot.light * shot.gain * shot.exposure_s / self._camera.exposure_s
        if bright < _LEAST_LIGHT:
            return {}
        position, quaternion = pose_at(self._log, shot.start_s + 0.5 * shot.exposure_s)
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
