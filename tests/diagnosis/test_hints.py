"""A run in which no marker of the map is found says what may be wrong with the camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fgloc.config import Config, RecordingConfig
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.errors import EstimatorError
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.markers.images import ImageEvent, decode
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

SAMPLE = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples" / "first_run"


@pytest.fixture(scope="module")
def pictures():
    """Ten images of the sample, its camera and its map."""
    with open_recording(SAMPLE / "bag", RecordingConfig()) as recording:
        events = [e for e in recording.events() if isinstance(e, ImageEvent)]
    return [decode(e) for e in events[::30]]


def short_bag(folder: Path, pictures, change) -> Path:
    path = folder / "bag"
    with BagWriter(path) as bag:
        K = [[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]]
        bag.static_transform(10**18, "base_link", "camera_optical", [0, 0, 0.2], [-0.5, 0.5, -0.5, 0.5])
        for i, image in enumerate(pictures):
            stamp = 10**18 + i * 10**8
            bag.camera_info("/camera/camera_info", stamp, (640, 480), K, [0, 0, 0, 0, 0])
            bag.odometry("/odom", stamp, (0.0, 0.0, 0.0), (0.0, 0.0))
            coded = cv2.imencode(".png", np.ascontiguousarray(change(image)))[1].tobytes()
            bag.compressed_image("/camera/image/compressed", stamp, coded, "png")
    return path


@pytest.mark.parametrize(
    ("change", "expected"),
    [(lambda image: 255 - image, "^The markers are seen inverted"), (lambda image: image[:, ::-1], "seen mirrored")],
    ids=["fault_47_inverted_print", "fault_45_mirrored_image"],
)
def test_what_hides_the_markers_is_named_first(tmp_path, pictures, change, expected):
    bag = short_bag(tmp_path, pictures, change)
    with pytest.raises(EstimatorError, match=expected):
        run(bag, SAMPLE / "map.yaml", Config(), "online")


def test_fault_42_wrong_dictionary_is_named_and_the_fitting_one_taken(tmp_path, pictures):
    bag = short_bag(tmp_path, pictures, lambda image: image)
    wrong = Config.model_validate({"markers": {"dictionary": "DICT_6X6_50"}})
    result = run(bag, SAMPLE / "map.yaml", wrong, "online")
    assert result.notes[0].endswith("set markers.dictionary: DICT_4X4_50.")
    assert result.mistakes == result.notes[:1]
    assert result.config.markers.dictionary == "DICT_4X4_50"
    assert result.counts["corners"]


@pytest.mark.parametrize(
    ("change", "codes"), [(lambda image: image // 40, ["setup.unseen"]), (lambda image: image, [])]
)
def test_a_run_without_a_map_tells_of_images_that_show_no_marker(tmp_path, pictures, change, codes):
    bag = short_bag(tmp_path, pictures, change)
    sized = Config.model_validate({"markers": {"dictionary": "DICT_4X4_50", "default_size_m": 0.2}})
    found = run(bag, None, sized, "batch").findings
    assert [f.code for f in found if f.severity is Severity.WARNING and "unseen" in f.code] == codes


def test_info_with_a_map_tells_of_images_that_show_no_marker(tmp_path, pictures):
    bag = short_bag(tmp_path, pictures, lambda image: image // 40)
    found = inspect_all(bag, SAMPLE / "map.yaml", Config())
    assert [f.severity for f in found.found if f.code == "markers.unseen"] == [Severity.WARNING]
