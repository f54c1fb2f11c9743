"""Image messages to grey levels, and the faults of images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fgloc.config import GateConfig
from fgloc.intake.validation import EventValidator
from fgloc.sensors.markers.images import ImageError, ImageEvent, decode
from fgloc.types import Grave


def message(data: Any, encoding: str, width: int = 0, height: int = 0, step: int = 0, big: bool = False) -> ImageEvent:
    raw = np.frombuffer(data, dtype=np.uint8) if isinstance(data, bytes) else np.ascontiguousarray(data).view(np.uint8)
    return ImageEvent(1, 1, "/image", "cam", encoding, width == 0, width, height, step, big, raw.reshape(-1))


def raw(array: NDArray[Any], encoding: str) -> ImageEvent:
    height, width = array.shape[:2]
    return message(array, encoding, width, height, array.strides[0])


@pytest.fixture
def gray(rng_images: np.random.Generator) -> NDArray[np.uint8]:
    smooth = cv2.GaussianBlur(rng_images.uniform(0, 255, (24, 36)).astype(np.float32), (0, 0), 3.0)
    return cv2.normalize(smooth, None, 10, 250, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.fixture
def rng_images() -> np.random.Generator:
    return np.random.default_rng(57)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1", "bgr8", "rgb8", "bgra8", "rgba8", "8UC3"])
def test_packed_encodings_give_the_gray_image(gray: NDArray[np.uint8], encoding: str) -> None:
    channels = {"m": 1, "8": 3 if encoding == "8UC3" else 1}.get(encoding[0], 4 if "a8" in encoding else 3)
    array = np.repeat(gray[:, :, None], channels, axis=2) if channels > 1 else gray
    assert np.abs(decode(raw(array, encoding)).astype(int) - gray).max() <= 1


def test_color_order_is_honored() -> None:
    red = np.zeros((4, 4, 3), dtype=np.uint8)
    red[:, :, 0] = 255
    assert decode(raw(red, "rgb8"))[0, 0] == 76  # ITU-R BT.601 weight of red
    assert decode(raw(red, "bgr8"))[0, 0] == 29  # of blue


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_agree_with_the_color_they_filter(pattern: str) -> None:
    color = {"r": 200, "g": 100, "b": 40}
    mosaic = np.tile(np.array([color[c] for c in pattern], dtype=np.uint8).reshape(2, 2), (8, 8))
    expected = 0.299 * 200 + 0.587 * 100 + 0.114 * 40
    assert abs(int(decode(raw(mosaic, f"bayer_{pattern}8"))[8, 8]) - expected) <= 2


@pytest.mark.parametrize(("encoding", "offset"), [("yuv422", 1), ("uyvy", 1), ("yuyv", 0), ("yuv422_yuy2", 0)])
def test_yuv_gives_its_luma(gray: NDArray[np.uint8], encoding: str, offset: int) -> None:
    packed = np.full((gray.shape[0], gray.shape[1], 2), 128, dtype=np.uint8)
    packed[:, :, offset] = gray
    assert np.array_equal(decode(raw(packed, encoding)), gray)


def test_rows_may_be_padded_and_the_last_one_need_not(gray: NDArray[np.uint8]) -> None:
    padded = np.pad(gray, ((0, 0), (0, 7)), constant_values=255)
    height, width = gray.shape
    whole = message(padded, "mono8", width, height, padded.shape[1])
    short = message(padded.tobytes()[:-7], "mono8", width, height, padded.shape[1])
    assert np.array_equal(decode(whole), gray)
    assert np.array_equal(decode(short), gray)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("encoding", ["jpeg", "rgb8; jpeg compressed bgr8", "png", ""])
def test_compressed_images_are_recognised_by_content(gray: NDArray[np.uint8], suffix: str, encoding: str) -> None:
    image = decode(message(cv2.imencode(suffix, gray)[1].tobytes(), encoding))
    assert image.shape == gray.shape
    assert np.abs(image.astype(float) - gray).mean() < 3.0


def test_exif_rotation_is_ignored(gray: NDArray[np.uint8]) -> None:
    jpeg = cv2.imencode(".jpg", gray)[1].tobytes()
    turned = bytes.fromhex("4578696600004d4d002a00000008000101120003000000010006000000000000")
    app1 = b"\xff\xe1" + (len(turned) + 2).to_bytes(2, "big") + turned
    assert decode(message(jpeg[:2] + app1 + jpeg[2:], "jpeg")).shape == gray.shape


def reason(event: ImageEvent) -> str:
    with pytest.raises(ImageError) as caught:
        decode(event)
    assert event.topic in str(caught.value)
    return caught.value.reason


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_fault_57_truncated_jpeg(gray: NDArray[np.uint8], share: float) -> None:
    jpeg = cv2.imencode(".jpg", gray)[1].tobytes()
    assert decode(message(jpeg, "jpeg")).shape == gray.shape
    assert reason(message(jpeg[: int(share * len(jpeg))], "jpeg")) == "truncated"


def test_fault_57_truncated_jpeg_with_a_whole_thumbnail(gray: NDArray[np.uint8]) -> None:
    jpeg = cv2.imencode(".jpg", gray)[1].tobytes()
    thumbnail = cv2.imencode(".jpg", gray[::4, ::4])[1].tobytes()
    app1 = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    whole = jpeg[:2] + app1 + jpeg[2:]
    assert decode(message(whole, "jpeg")).shape == gray.shape
    assert reason(message(whole[:-40], "jpeg")) == "truncated"


def test_fault_57_truncated_png(gray: NDArray[np.uint8]) -> None:
    png = cv2.imencode(".png", gray)[1].tobytes()
    assert reason(message(png[: len(png) // 2], "png")) == "truncated"


def test_fault_57_noise_is_not_an_image(rng_images: np.random.Generator) -> None:
    assert reason(message(rng_images.bytes(500), "jpeg")) == "undecodable"


def test_fault_58_empty_image_data() -> None:
    assert reason(message(b"", "jpeg")) == "empty"
    assert reason(message(b"", "mono8", 10, 10, 10)) == "empty"
    empty = ImageEvent(1, 1, "/image", "cam", "mono8", False, 0, 10, 0, False, np.zeros(10, dtype=np.uint8))
    assert reason(empty) == "empty"


def test_fault_58_size_mismatch(gray: NDArray[np.uint8]) -> None:
    height, width = gray.shape
    assert reason(message(gray.tobytes()[:-1], "mono8", width, height, width)) == "size"
    assert reason(message(gray, "mono8", width, height, width - 1)) == "size"


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("bits", "shift"), [(16, 8), (12, 4)])
def test_fault_59_16_bit_image_is_converted(gray: NDArray[np.uint8], order: str, bits: int, shift: int) -> None:
    wide = gray.astype(np.uint16) << shift
    height, width = gray.shape
    event = message(wide.astype(f"{order}u2"), "mono16", width, height, 2 * width, order == ">")
    assert wide.max() < 1 << bits
    assert np.array_equal(decode(event), gray)


def test_fault_59_16_bit_png_is_converted(gray: NDArray[np.uint8]) -> None:
    png = cv2.imencode(".png", gray.astype(np.uint16) << 8)[1].tobytes()
    assert np.array_equal(decode(message(png, "mono16; png compressed")), gray)


def test_fault_59_float_image_is_converted_or_refused(gray: NDArray[np.uint8]) -> None:
    assert np.array_equal(decode(raw((gray / 255.0).astype(np.float32), "32FC1")), gray)
    assert np.array_equal(decode(raw(gray.astype(np.float32), "32FC1")), gray)
    depth = np.full((4, 4), np.nan, dtype=np.float32)
    assert reason(raw(depth, "32FC1")) == "encoding"
    assert reason(raw(np.full((4, 4), 1200.0, dtype=np.float32), "32FC1")) == "encoding"


@pytest.mark.parametrize("encoding", ["32FC1; compressedDepth png", "16UC1; compressedDepth"])
def test_fault_59_compressed_depth_is_refused(encoding: str) -> None:
    assert reason(message(b"\x00" * 40, encoding)) == "encoding"


def test_fault_59_unknown_encoding_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ImageError, match=r"'tuv9'.*mono8.*yuv422") as caught:
        decode(message(b"\x00" * 16, "tuv9", 4, 4, 4))
    assert caught.value.reason == "encoding"


@pytest.mark.parametrize("compressed", [True, False])
def test_images_of_another_size_than_the_first_are_rejected_as_the_calibration_is_of_that(compressed: bool) -> None:
    """A camera whose resolution was changed had all its sightings gated, by a calibration that is not theirs."""
    checked = EventValidator(GateConfig())

    def shot(stamp_ns: int, width: int, height: int) -> ImageEvent:
        pixels = np.zeros((height, width), dtype=np.uint8)
        made = message(cv2.imencode(".jpg", pixels)[1], "jpeg") if compressed else raw(pixels, "mono8")
        return replace(made, stamp_ns=stamp_ns, received_ns=stamp_ns)

    verdicts = [checked.check(shot(k + 1, *size)) for k, size in enumerate([(64, 48), (64, 48), (32, 24), (64, 48)])]
    assert [verdict is not None for verdict in verdicts] == [True, True, False, True]
    assert checked.rejections == {"image.resized": 1}
    [note] = [note for note in checked.notes if "32x24" in note]
    assert "64x48" in note
    assert isinstance(note, Grave)
