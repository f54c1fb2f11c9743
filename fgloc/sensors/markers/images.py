"""Images, markers that were found in them, and grey levels of an image message."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from fgloc.errors import RecordingError
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
        """Width and height of the image; None if it is compressed."""
        return None if self.compressed else (self.width, self.height)

    def stated_size(self) -> tuple[int, int] | None:
        """Width and height by the message or the header of a JPEG or PNG; None: they are not there."""
        return self.size or next(_stated_sizes(self.data[:_HEADER_BYTES].tobytes()), None)

    @property
    def empty(self) -> bool:
        """Whether the image has no data."""
        return len(self.data) == 0

    def decoded_size(self) -> tuple[int, int] | None:
        """Width and height of the decoded image; None if it cannot be decoded."""
        image = decoded(self)
        return None if image is None else (image.shape[1], image.shape[0])


@dataclass(frozen=True, slots=True, eq=False)
class MarkerCorners(Sighting):
    """One marker in one image. Corners: top-left, top-right, bottom-right, bottom-left of the upright marker."""

    corners_px: FloatArray  # (4, 2) u, v in the recorded (distorted) image

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """Marker with Gaussian noise on each coordinate of its corners."""
        if not (sigma := sigmas["corner_px"]):
            return self
        return replace(self, corners_px=self.corners_px + rng.normal(0.0, sigma, self.corners_px.shape))


@dataclass(frozen=True, slots=True, eq=False)
class CornersEvent(SightingsEvent):
    """Markers found in one image, by another node's detector or by our own on an ImageEvent."""

    in_pixels: ClassVar[bool] = True

    sightings: tuple[MarkerCorners, ...]

    @classmethod
    def found_in(cls, image: ImageEvent, sightings: Iterable[MarkerCorners]) -> CornersEvent:
        """Markers that were found in an image."""
        return cls(image.stamp_ns, image.received_ns, image.topic, image.frame_id, tuple(sightings))


GrayImage = NDArray[np.uint8]

# ROS encoding -> (numpy type, channels, OpenCV conversion to gray after reduction to 8 bits)
_PACKED: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2GRAY),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2GRAY),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2GRAY),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2GRAY),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2GRAY),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2GRAY),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2GRAY),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2GRAY),
    "bgra16": ("u2", 4, cv2.COLOR_BGRA2GRAY),
    "rgba16": ("u2", 4, cv2.COLOR_RGBA2GRAY),
    "32FC1": ("f4", 1, None),
    "64FC1": ("f8", 1, None),
} | {
    f"bayer_{pattern}{bits}": (f"u{bits // 8}", 1, getattr(cv2, f"COLOR_Bayer{pattern.upper()}2GRAY"))
    for pattern in ("rggb", "bggr", "gbrg", "grbg")
    for bits in (8, 16)
}
# Two bytes a pixel; the luma is every second byte, starting here.
_LUMA_OFFSET = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
_PLANAR_LUMA = ("nv12", "nv21", "nv24")  # the luma plane comes first

_MAX_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])  # which `fgloc` sets
_MAX_SCANS = 64  # of a progressive JPEG; cameras write up to 12, and each of them goes over the whole image

_JPEG_START, _JPEG_END, _JPEG_SCAN = b"\xff\xd8", b"\xff\xd9", 0xDA
_JPEG_FRAMES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_HEADER_BYTES = 1 << 16  # of a JPEG or PNG, within which its size usually stands
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"


class ImageError(RecordingError):
    """One image cannot be decoded.

    Attributes:
        reason: short name to count by: "empty", "truncated", "size", "encoding", "undecodable".
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


def decode(event: ImageEvent) -> GrayImage:
    """Grey levels ``(h, w)`` of an image message, in the pixel grid that the camera recorded.

    16-bit images are brought to 8 bits by the highest bit in use (many cameras put 10 or 12 bits into 16); float images
    are accepted in 0..1 or 0..255. EXIF rotation is ignored: the calibration knows nothing of it.

    Raises:
        ImageError: no data, truncated, of another size than stated, or of an encoding that is no image.
    """
    if event.data.size == 0:
        raise ImageError("empty", f"{event.topic}: image without data")
    return _compressed(event) if event.compressed else _raw(event)


def decoded(event: ImageEvent) -> GrayImage | None:
    """Grey levels as `decode` gives them; None if the image cannot be decoded."""
    try:
        return decode(event)
    except ImageError:
        return None


def _compressed(event: ImageEvent) -> GrayImage:
    if "compresseddepth" in event.encoding.lower():
        raise ImageError(
            "encoding", f"{event.topic}: '{event.encoding}' holds depth, not an image; choose another topic"
        )
    data = event.data.tobytes()
    if data.startswith(_JPEG_START) and not _jpeg_ends(data):
        raise ImageError("truncated", f"{event.topic}: JPEG of {len(data)} bytes without an end marker")
    if data.startswith(_PNG_START) and _PNG_END not in data:
        raise ImageError("truncated", f"{event.topic}: PNG of {len(data)} bytes without an IEND chunk")
    for width, height in _stated_sizes(data):
        _check_pixels(event.topic, width, height)
    if data.startswith(_JPEG_START) and data.count(bytes((0xFF, _JPEG_SCAN))) > _MAX_SCANS:
        raise ImageError("undecodable", f"{event.topic}: JPEG of more than {_MAX_SCANS} scans")
    try:
        image = cv2.imdecode(event.data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError("undecodable", f"{event.topic}: '{event.encoding}' image: {error}") from error
    if image is None:
        raise ImageError(
            "undecodable", f"{event.topic}: '{event.encoding}' image of {len(data)} bytes is not decodable"
        )
    return _to_8_bits(np.asarray(image), event.topic)


def _jpeg_ends(data: bytes) -> bool:
    """Whether an end marker follows the start of the scan; one of a thumbnail in the header does not count."""
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return _JPEG_END in data  # not the usual structure: let the decoder judge
        kind = data[at + 1]
        if kind == _JPEG_SCAN:
            return data.find(_JPEG_END, at) >= 0
        if kind == 0xFF:  # fill byte
            at += 1
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return False


def _stated_sizes(data: bytes) -> Iterator[tuple[int, int]]:
    """Width and height as the headers of a PNG or JPEG have them; of another format OpenCV judges itself."""
    if data.startswith(_PNG_START):
        yield int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    at = 2 if data.startswith(_JPEG_START) else len(data)
    while at + 9 <= len(data) and data[at] == 0xFF and data[at + 1] != _JPEG_SCAN:
        kind = data[at + 1]
        if kind in _JPEG_FRAMES:
            yield int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 1 if kind == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4], "big")


def _check_pixels(topic: str, width: int, height: int) -> None:
    if width * height > _MAX_PIXELS:
        raise ImageError("size", f"{topic}: image of {width}x{height} pixels, expected at most {_MAX_PIXELS} in all")


def _raw(event: ImageEvent) -> GrayImage:
    if event.width == 0 or event.height == 0:
        raise ImageError("empty", f"{event.topic}: image of {event.width}x{event.height} pixels")
    _check_pixels(event.topic, event.width, event.height)
    encoding = event.encoding
    if encoding in _PACKED:
        kind, channels, conversion = _PACKED[encoding]
        dtype = np.dtype(kind).newbyteorder(">" if event.is_bigendian else "<")
        rows = _rows(event, event.width * channels * dtype.itemsize)
        pixels = rows.view(dtype).reshape(event.height, event.width, channels)
        pixels = pixels[:, :, 0] if channels == 1 else pixels
        gray = _to_8_bits(pixels, event.topic)
        return gray if conversion is None else np.asarray(cv2.cvtColor(gray, conversion), dtype=np.uint8)
    if encoding in _LUMA_OFFSET:
        return np.ascontiguousarray(_rows(event, 2 * event.width)[:, _LUMA_OFFSET[encoding] :: 2])
    if encoding in _PLANAR_LUMA:
        return _rows(event, event.width)
    known = ", ".join([*_PACKED, *_LUMA_OFFSET, *_PLANAR_LUMA])
    raise ImageError("encoding", f"{event.topic}: encoding '{encoding}' is not known; known are {known}")


def _rows(event: ImageEvent, row_bytes: int) -> GrayImage:
    """Bytes ``(h, row_bytes)`` without the padding at the end of each row."""
    step = event.step or row_bytes
    needed = step * (event.height - 1) + row_bytes  # the last row may lack its padding
    if step < row_bytes or event.data.size < needed:
        raise ImageError(
            "size",
            f"{event.topic}: {event.data.size} bytes with rows of {step} bytes; {event.width}x{event.height} "
            f"'{event.encoding}' needs rows of {row_bytes} and {needed} bytes",
        )
    strided = np.lib.stride_tricks.as_strided(
        np.ascontiguousarray(event.data), (event.height, row_bytes), (step, 1), writeable=False
    )
    return np.ascontiguousarray(strided)


def _to_8_bits(image: NDArray[np.generic], topic: str) -> GrayImage:
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image, dtype=np.uint8)
    if image.dtype.kind == "u":
        shift = max(0, int(image.max()).bit_length() - 8)
        return np.ascontiguousarray(image.astype(np.uint16) >> shift, dtype=np.uint8)
    low, high = float(image.min()), float(image.max())
    if not (math.isfinite(low) and math.isfinite(high)) or low < 0.0 or high > 255.0:
        raise ImageError(
            "encoding", f"{topic}: float image with values {low:g} to {high:g}, expected 0..1 or 0..255 (is it depth?)"
        )
    return np.asarray(image.astype(np.float64) * (255.0 if high <= 1.0 else 1.0)).round().astype(np.uint8)
