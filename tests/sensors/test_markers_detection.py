"""Marker detection on rendered images whose truth is known, and the detection thread."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from marker_scenes import forward_camera, image_event, project, render, standing, texture
from refusal import refusal

from fgloc.config import MarkersConfig
from fgloc.errors import ConfigError
from fgloc.sensors.markers.detector import (
    MarkerDetector,
    detect_stream,
    dictionary_names,
    load_dictionary,
    suggest_dictionary,
)
from fgloc.sensors.markers.images import CornersEvent, ImageEvent
from fgloc.types import ControlEvent, Event

CAMERA = forward_camera()
DICTIONARIES = ["DICT_4X4_50", "DICT_6X6_250", "DICT_ARUCO_MIP_36h12", "DICT_APRILTAG_36h11", "DICT_APRILTAG_16h5"]


def detector(dictionary: str) -> MarkerDetector:
    return MarkerDetector(dictionary, MarkersConfig())


@pytest.mark.parametrize("dictionary", DICTIONARIES)
@pytest.mark.parametrize("distance", [1.0, 1.5, 3.0])
def test_corners_are_where_the_landmark_projects(dictionary: str, distance: float) -> None:
    """Order and place: the map's corners, projected from the true pose, are the detected ones."""
    rng = np.random.default_rng([len(dictionary), round(distance * 10)])
    errors = []
    for _ in range(4):
        pose = (rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1))
        marker = standing(int(rng.integers(30)), (distance + 0.1, 0.0, 0.3), np.pi + rng.uniform(-0.6, 0.6))
        found = detector(dictionary).detect(image_event(render(CAMERA, pose, [marker], dictionary, rng)))
        assert [s.landmark_id for s in found.sightings] == [marker.landmark_id]
        errors.append(found.sightings[0].corners_px - project(CAMERA, pose, marker.corners()))
    assert np.abs(errors).max() < 0.25
    assert np.sqrt((np.array(errors) ** 2).mean()) < 0.08


def test_apriltags_are_upright_as_the_apriltag_project_prints_them() -> None:
    """Tag 0 of tag36h11 has the code 0xd5d628584, from its top left corner, row by row (apriltag-imgs)."""
    code = [int(bit) for bit in f"{0xD5D628584:036b}"]
    tag = np.zeros((10, 10), dtype=np.uint8)
    tag[[0, -1]] = tag[:, [0, -1]] = 255
    tag[2:8, 2:8] = 255 * np.array(code, dtype=np.uint8).reshape(6, 6)
    image = cv2.copyMakeBorder(
        np.kron(tag, np.full((12, 12), 1, np.uint8)), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255
    )
    [(number, corners)] = detector("DICT_APRILTAG_36h11").find(image)
    assert number == 0
    assert np.abs(corners - [[71.5, 71.5], [167.5, 71.5], [167.5, 167.5], [71.5, 167.5]]).max() < 0.6


def test_every_predefined_dictionary_finds_its_own_markers() -> None:
    assert len(dictionary_names()) == 22
    for name in dictionary_names():
        last = len(load_dictionary(name).bytesList) - 1
        for number in (0, last):
            image = np.pad(texture(name, number, cell_px=10), 30, constant_values=255)
            assert [i for i, _ in detector(name).find(image)] == [number], name


def test_names_may_be_written_in_any_case() -> None:
    image = np.pad(texture("DICT_APRILTAG_36h11", 7, cell_px=10), 30, constant_values=255)
    assert [i for i, _ in detector("dict_apriltag_36H11").find(image)] == [7]


def test_unknown_dictionary_is_an_error_that_lists_the_names() -> None:
    with pytest.raises(ConfigError, match=r"'DICT_4X4_51'.*DICT_4X4_50.*DICT_APRILTAG_36h11"):
        detector("DICT_4X4_51")
    with refusal(ConfigError, "absent.yml", cause=FileNotFoundError):
        detector("absent.yml")


def test_small_markers_are_found_by_a_second_look() -> None:
    """Of markers with little more than a pixel per cell, most are found, none as another, corners within a pixel."""
    rng = np.random.default_rng(4)
    name, found, total, errors = "DICT_APRILTAG_36h11", 0, 12, []
    plain = cv2.aruco.ArucoDetector(load_dictionary(name), cv2.aruco.DetectorParameters())
    plainly = 0
    for _ in range(total):
        pose = (rng.uniform(-0.3, 0.0), rng.uniform(-0.1, 0.1), rng.uniform(-0.05, 0.05))
        marker = standing(int(rng.integers(500)), (9.0, 0.3, 0.3), np.pi + rng.uniform(-0.3, 0.3))
        image = render(CAMERA, pose, [marker], name, rng)
        truth = project(CAMERA, pose, marker.corners())
        assert np.ptp(truth[:, 1]) < 13.0
        seen = detector(name).find(image)
        assert all(i == marker.landmark_id for i, _ in seen)
        found += len(seen)
        errors += [c - truth for _, c in seen]
        plainly += plain.detectMarkers(image)[1] is not None
    assert found >= 0.7 * total > plainly
    assert np.sqrt((np.array(errors) ** 2).mean()) < 0.6


def test_image_without_markers_gives_an_event_without_sightings() -> None:
    for image in (np.full((480, 640), 128, np.uint8), np.zeros((3, 3), np.uint8)):
        event = image_event(image, 77)
        found = detector("DICT_4X4_50").detect(event)
        assert (found.stamp_ns, found.received_ns, found.frame_id) == (77, event.received_ns, "camera_optical")
        assert found.sightings == ()


def test_fault_42_wrong_dictionary_is_named() -> None:
    rng = np.random.default_rng(42)
    markers = [standing(i, (2.1, y, 0.3), np.pi) for i, y in ((3, 0.5), (17, 0.0), (61, -0.5))]
    image = render(CAMERA, (0.0, 0.0, 0.0), markers, "DICT_5X5_250", rng)
    assert detector("DICT_4X4_50").find(image) == []
    assert suggest_dictionary([image]) == "DICT_5X5_100"  # the smallest that has 61
    assert suggest_dictionary([render(CAMERA, (0, 0, 0), markers, "DICT_APRILTAG_36h11", rng)]) == "DICT_APRILTAG_36h11"
    assert suggest_dictionary([rng.integers(0, 255, (480, 640)).astype(np.uint8)]) is None


def test_fault_45_mirrored_image_gets_a_hint() -> None:
    markers = [standing(i, (2.1, y, 0.3), np.pi) for i, y in ((3, 0.5), (17, 0.0))]
    image = render(CAMERA, (0.0, 0.0, 0.0), markers, "DICT_5X5_50")
    assert detector("DICT_5X5_50").diagnose(image) == []
    [hint] = detector("DICT_5X5_50").diagnose(np.ascontiguousarray(image[:, ::-1]))
    assert "mirrored" in hint


def test_fault_47_inverted_print_gets_a_hint() -> None:
    markers = [standing(i, (2.1, y, 0.3), np.pi) for i, y in ((3, 0.5), (17, 0.0))]
    image = render(CAMERA, (0.0, 0.0, 0.0), markers, "DICT_5X5_50")
    [hint] = detector("DICT_5X5_50").diagnose(255 - image)
    assert "inverted" in hint


# --- the detection thread ---


def stream(images: int) -> Iterator[Event]:
    marker = standing(5, (1.5, 0.0, 0.3), np.pi)
    seen = render(CAMERA, (0.0, 0.0, 0.0), [marker], "DICT_4X4_50", scale=2)
    for k in range(images):
        stamp = 100 * k
        yield image_event(seen if k % 3 else np.full_like(seen, 90), stamp)
        yield from (ControlEvent(stamp + j, stamp + j, "/cmd", 0.1 * j, 0.0) for j in range(1, 4))


def test_stream_keeps_order_and_finds_what_plain_detection_finds() -> None:
    own = detector("DICT_4X4_50")
    rejections: Counter[str] = Counter()
    events = list(detect_stream(stream(9), detector("DICT_4X4_50"), rejections))
    assert [e.stamp_ns for e in events] == [e.stamp_ns for e in stream(9)]
    assert not rejections
    images = [e for e in stream(9) if isinstance(e, ImageEvent)]
    corners = [e for e in events if isinstance(e, CornersEvent)]
    assert [len(e.sightings) for e in corners] == [0, 1, 1] * 3
    for image, found in zip(images, corners, strict=True):
        for a, b in zip(own.detect(image).sightings, found.sightings, strict=True):
            assert np.array_equal(a.corners_px, b.corners_px)


def test_fault_57_stream_counts_what_it_cannot_decode_and_goes_on() -> None:
    jpeg = cv2.imencode(".jpg", np.full((60, 80), 100, np.uint8))[1].ravel()

    def compressed(data: np.ndarray, stamp: int) -> ImageEvent:
        return ImageEvent(stamp, stamp, "/image", "cam", "jpeg", True, 0, 0, 0, False, data)

    rejections: Counter[str] = Counter()
    events = [compressed(jpeg, 1), compressed(jpeg[:-30], 2), compressed(jpeg[:0], 3), compressed(jpeg, 4)]
    passed = list(detect_stream(events, detector("DICT_4X4_50"), rejections))
    assert [e.stamp_ns for e in passed] == [1, 4]
    assert rejections == {"image.truncated": 1, "image.empty": 1}


def test_stream_reads_only_a_few_images_ahead() -> None:
    read = 0

    def counting() -> Iterator[Event]:
        nonlocal read
        for event in stream(60):
            read += isinstance(event, ImageEvent)
            yield event

    events = detect_stream(counting(), detector("DICT_4X4_50"), Counter())
    for k, _ in zip(range(8), events, strict=False):
        assert read <= k // 4 + 6


def test_stream_hands_on_errors_of_its_source_and_stops_its_thread_when_left() -> None:
    def failing() -> Iterator[Event]:
        yield from stream(2)
        raise RuntimeError("bag ends")

    with pytest.raises(RuntimeError, match="bag ends"):
        list(detect_stream(failing(), detector("DICT_4X4_50"), Counter()))
    left = detect_stream(stream(20), detector("DICT_4X4_50"), Counter())
    next(left)
    left.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("marker-detection")]
