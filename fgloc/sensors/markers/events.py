"""Images, and the markers that are found in them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fgloc.types import FloatArray, RawEvent, Sighting, SightingsEvent


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvent(RawEvent):
    """``sensor_msgs/Image`` or ``CompressedImage``, not decoded."""

    encoding: str  # ROS encoding ("mono8", "bgr8", ...); for a compressed image its format ("jpeg", "png", ...)
    compressed: bool
    width: int  # 0 if compressed
    height: int
    step: int  # bytes per row; 0 if compressed
    is_bigendian: bool
    data: NDArray[np.uint8]  # (n,)

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height; None of a compressed image."""
        return None if self.compressed else (self.width, self.height)

    @property
    def empty(self) -> bool:
        """Whether it has no pixels."""
        return len(self.data) == 0

    def decoded_size(self) -> tuple[int, int] | None:
        """Width and height of the decoded image; None if it cannot be decoded."""
        from fgloc.sensors.markers.images import ImageError, decode  # OpenCV takes a while to load

        try:
            height, width = decode(self).shape
        except ImageError:
            return None
        return width, height


@dataclass(frozen=True, slots=True, eq=False)
class MarkerCorners(Sighting):
    """One marker in one image. Corners: top-left, top-right, bottom-right, bottom-left of the upright marker."""

    corners_px: FloatArray  # (4, 2) u, v in the recorded (distorted) image

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """On each coordinate of each corner."""
        if not (sigma := sigmas["corner_px"]):
            return self
        return replace(self, corners_px=self.corners_px + rng.normal(0.0, sigma, self.corners_px.shape))


@dataclass(frozen=True, slots=True, eq=False)
class CornersEvent(SightingsEvent):
    """Markers found in one image: ``apriltag_msgs/AprilTagDetectionArray``, or our detector on an ImageEvent."""

    in_pixels: ClassVar[bool] = True

    sightings: tuple[MarkerCorners, ...]
