"""Which way is up for the camera, by its transform and by the markers it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgloc.types import FloatArray, Landmark

_MIN_SEEN = 30
_AGREE = 0.95  # length of the mean of the unit vectors: less and they contradict each other
_MIN_OFF = math.radians(8.0)  # a marker's own tilt is read from its corners: not to a degree


@dataclass(frozen=True, slots=True, eq=False)
class Tilt:
    """How the camera is turned against its transform.

    Attributes:
        roll: [rad] about the viewing axis.
        pitch: [rad] of the viewing axis, upwards.
        place: ``T_base_cam (4, 4)`` that would be right.
    """

    roll: float
    pitch: float
    place: FloatArray


class UprightWitness:
    """Collects the map's vertical as the markers show it to the camera."""

    def __init__(self) -> None:
        self._sum = np.zeros(3)
        self._seen = 0

    def see(self, T_cam_marker: FloatArray, landmark: Landmark) -> None:
        """Take in a marker ``(4, 4)`` of the map, in the camera's axes."""
        self._sum += T_cam_marker[:3, :3] @ landmark.rotation[2]
        self._seen += 1

    def tilt(self, T_base_cam: FloatArray) -> Tilt | None:
        """How the camera is turned; None if it is as its transform says, or if that is not known."""
        length = float(np.linalg.norm(self._sum))
        if self._seen < _MIN_SEEN or length < _AGREE * self._seen:
            return None
        shown, expected = self._sum / length, T_base_cam[2, :3]
        if math.hypot(shown[0], shown[1]) < 0.2 or math.hypot(expected[0], expected[1]) < 0.2:
            return None  # looks straight up or down: there is no roll
        roll = math.atan2(shown[1], shown[0]) - math.atan2(expected[1], expected[0])
        roll = math.remainder(roll, 2.0 * math.pi)
        pitch = math.asin(np.clip(shown[2], -1.0, 1.0)) - math.asin(np.clip(expected[2], -1.0, 1.0))
        if max(abs(roll), abs(pitch)) < _MIN_OFF:
            return None
        # 1. Undo the roll about the viewing axis. 2. Pitch about the horizontal axis across it.
        c, s = math.cos(roll), math.sin(roll)
        R = T_base_cam[:3, :3] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        ahead = R[:, 2]
        across = np.cross(ahead, (0.0, 0.0, 1.0))
        place = T_base_cam.copy()
        place[:3, :3] = _about(across / np.linalg.norm(across), pitch) @ R
        return Tilt(roll, pitch, place)


def _about(axis: FloatArray, angle: float) -> FloatArray:
    """Rotation ``(3, 3)`` about a unit axis. Source: Rodrigues."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K)
