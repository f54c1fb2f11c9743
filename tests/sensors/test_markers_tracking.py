"""Markers followed from image to image: nothing is lost that a thorough search of every image finds."""

from pathlib import Path

import numpy as np
import pytest

from fgloc.config import load_config
from fgloc.recording.reader import open_recording
from fgloc.sensors.markers.config import MarkersConfig
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.events import ImageEvent
from fgloc.sensors.markers.images import decode
from fgloc.sensors.markers.tracking import TrackingDetector

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


def test_tracking_loses_nothing_and_finds_the_same_corners(images, detector):
    tracking, apart = TrackingDetector(detector), []
    for stamp_ns, image in images:
        whole, tracked = dict(detector.find(image)), dict(tracking.find(image, stamp_ns))
        assert whole.keys() <= tracked.keys()
        apart += [np.abs(tracked[i] - corners).max() for i, corners in whole.items()]
    assert len(apart) > 100
    assert np.median(apart) < 1e-3
    assert np.quantile(apart, 0.95) < 0.05
    assert tracking.counts["fast"] > 5 * tracking.counts["whole"] > 0


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


def test_a_marker_that_the_fast_search_misses_is_looked_for_where_it_was(images, detector, monkeypatch):
    fast = detector.find_fast
    monkeypatch.setattr(detector, "find_fast", lambda image: fast(image)[1:])
    tracking, several = TrackingDetector(detector), 0
    for stamp_ns, image in images[:20]:
        whole, tracked = {i for i, _ in detector.find(image)}, {i for i, _ in tracking.find(image, stamp_ns)}
        if len(whole) > 1:
            several += 1
            assert whole <= tracked
    assert several > 10
    assert tracking.counts["missing"] > 5


def test_after_a_gap_the_whole_image_is_searched(images, detector):
    tracking = TrackingDetector(detector)
    for k, (_, image) in enumerate(images[:4]):
        tracking.find(image, 2_000_000_000 * k)
    assert tracking.counts == {"whole": 4}
