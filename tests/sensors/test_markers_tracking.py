"""Markers followed from image to image: nothing is lost that a search of every image at full resolution finds."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fgloc.config import MarkersConfig, load_config
from fgloc.recording.reader import open_recording
from fgloc.sensors.markers.detector import MarkerDetector, TrackingDetector, load_dictionary
from fgloc.sensors.markers.edges import CoarseSearch, Codes
from fgloc.sensors.markers.images import ImageEvent, decode

SAMPLE = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples" / "first_run"


@pytest.fixture(scope="module")
def images():
    """Stamps and images of the first seconds of the bundled sample."""
    found = []
    with open_recording(SAMPLE / "bag", load_config(SAMPLE / "robot.yaml").recording) as recording:
        for event in recording.events():
            if isinstance(event, ImageEvent):
                found.append((event.stamp_ns, decode(event)))
            if len(found) == 60:
                return found
    return found


@pytest.fixture
def detector():
    return MarkerDetector("DICT_4X4_50", MarkersConfig())


def clear(found):
    """Ids of markers of which a cell is two pixels wide."""
    return {i for i, corners in found.items() if np.ptp(corners, axis=0).min() >= 12.0}


def test_tracking_loses_nothing_and_finds_the_same_corners(images, detector):
    tracking, apart = TrackingDetector(detector), []
    for stamp_ns, image in images:
        whole, tracked = dict(detector.find(image)), dict(tracking.find(image, stamp_ns))
        assert clear(whole) <= tracked.keys()
        apart += [np.abs(tracked[i] - corners).max() for i, corners in whole.items() if i in tracked]
    assert len(apart) > 100
    assert np.median(apart) < 0.005
    assert np.quantile(apart, 0.95) < 0.05
    assert tracking.counts["coarse"] > 20 * tracking.counts["whole"] > 0


def test_a_part_of_an_image_gives_the_same_corners_bit_by_bit(images, detector):
    compared = 0
    for _, image in images[::6]:
        for marker_id, corners in detector.find(image):
            low = np.maximum(corners.min(axis=0) - 40, 0).astype(int)
            high = np.minimum(corners.max(axis=0) + 41, image.shape[::-1]).astype(int)
            within = dict(detector.find_within(image, (*low.tolist(), *high.tolist())))
            assert np.array_equal(within[marker_id], corners)
            compared += 1
    assert compared > 10


def test_a_marker_that_the_coarse_search_misses_is_looked_for_where_it_was(images, detector, monkeypatch):
    tracking, several = TrackingDetector(detector), 0
    monkeypatch.setattr(
        CoarseSearch, "find", lambda search, image, find=CoarseSearch.find: (find(search, image)[0][1:], [])
    )
    for stamp_ns, image in images[:20]:
        whole, tracked = clear(dict(detector.find(image))), {i for i, _ in tracking.find(image, stamp_ns)}
        if len(whole) > 1:
            several += 1
            assert whole <= tracked
    assert several > 10
    assert tracking.counts["parts"] > 5


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_6X6_250", "DICT_APRILTAG_36h11"])
def test_a_code_is_read_at_any_turn_and_with_as_many_wrong_cells_as_opencv_reads(dictionary):
    own = load_dictionary(dictionary)
    codes, cells, rng = Codes(own), own.markerSize + 2, np.random.default_rng(5)
    for _ in range(40):
        marker_id, turns = int(rng.integers(len(own.bytesList))), int(rng.integers(4))
        bits = cv2.aruco.Dictionary.getBitsFromByteList(own.bytesList[marker_id][None], own.markerSize)
        wrong = rng.choice(bits.size, int(rng.integers(0, 6)), replace=False)
        bits.flat[wrong] ^= 1
        square = np.pad(np.rot90(bits, turns), 1)
        image = np.pad(np.kron(40 + 150 * square, np.ones((10, 10))), 20, constant_values=200).astype(np.uint8)
        low, high = 19.5, 19.5 + 10 * cells
        found = codes.read(image, np.array([[[low, low], [high, low], [high, high], [low, high]]]))
        known, expected, turned = own.identify(np.ascontiguousarray(np.rot90(bits, turns)), 0.6)
        if not known:
            assert found == []
        elif len(wrong) <= own.maxCorrectionBits // 2:  # with more, two codes may be equally near
            assert found == [(0, expected, turned)] == [(0, marker_id, turns)]


def test_noise_and_plain_squares_are_no_codes():
    rng = np.random.default_rng(6)
    square = np.array([[[20.0, 20.0], [80.0, 20.0], [80.0, 80.0], [20.0, 80.0]]])
    codes = Codes(load_dictionary("DICT_6X6_250"))
    for level in (0, 100, 255):
        assert codes.read(np.full((100, 100), level, np.uint8), square) == []
    for _ in range(20):
        assert codes.read(rng.integers(0, 256, (100, 100)).astype(np.uint8), square) == []


def test_after_a_gap_the_whole_image_is_searched(images, detector):
    tracking = TrackingDetector(detector)
    for k, (_, image) in enumerate(images[:4]):
        tracking.find(image, 2_000_000_000 * k)
    assert tracking.counts == {"whole": 4}
