"""Cameras, landmarks and their maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgloc.types.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Intrinsics and mounting.

    ``model`` is ``"plumb_bob"`` (D: k1 k2 p1 p2 [k3]), ``"rational_polynomial"`` (D: k1 k2 p1 p2 k3 k4 k5 k6) or
    ``"equidistant"`` (fisheye, D: k1 k2 k3 k4). A width and height of 0 say that the calibration names no image size.
    """

    width: int
    height: int
    model: str
    K: FloatArray  # (3, 3)
    D: FloatArray  # (n,)
    T_base_cam: FloatArray  # (4, 4), cam is the optical frame: z forward, x right, y down
    frame_id: str = ""
    notes: tuple[str, ...] = ()  # what was assumed when the calibration was read


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A marker or beacon of the map.

    ``size_m`` is the side of the black square, 0 if the landmark is a point; ``rotation`` is of the marker frame: x to
    the marker's right as seen, y to its top, z out of its face towards the viewer.
    """

    landmark_id: int
    position: FloatArray  # (3,) m in the map frame
    rotation: FloatArray  # (3, 3) R_map_marker; identity for a point
    size_m: float
    cov: FloatArray | None = None
    """Of x, y ``(2, 2)``, of x, y, z ``(3, 3)`` in the map frame, or ``(6, 6)`` of these and the rotation [rad] about
    the marker's own axes; None: not known."""

    def corners(self) -> FloatArray:
        """Corners ``(4, 3)`` in the map frame, in the order of MarkerCorners."""
        h = 0.5 * self.size_m
        local = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
        return np.asarray(self.position + local @ self.rotation.T)

    @property
    def planar(self) -> FloatArray:
        """``(3,)`` x, y, yaw: yaw of the face normal if the marker stands, of its x axis if it lies."""
        axis = self.rotation[:, 2] if abs(self.rotation[2, 2]) < 0.7 else self.rotation[:, 0]
        return np.array([self.position[0], self.position[1], np.arctan2(axis[1], axis[0])])


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """Landmarks by id; ``dictionary`` is OpenCV's name (``"DICT_4X4_50"``) or empty."""

    landmarks: Mapping[int, Landmark]
    dictionary: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()  # what was assumed or left out when the file was read

    def __contains__(self, landmark_id: int) -> bool:
        return landmark_id in self.landmarks

    def __len__(self) -> int:
        return len(self.landmarks)
