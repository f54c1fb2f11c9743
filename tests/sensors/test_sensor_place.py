"""Where a sensor of ranges and bearings sits on the robot: from tf, however late it first speaks, or at the base."""

from __future__ import annotations

import re

import pytest

from fgloc.assembly import Assembly, assemble
from fgloc.config import Config
from fgloc.recording.reader import open_recording
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
K = [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]


def assembled(folder, frame="lidar", tf=True, images=False, first_ns=0, **topics) -> Assembly:
    with BagWriter(folder / "bag") as bag:
        if tf:
            bag.static_transform(START_NS, "base_link", "lidar", (0.3, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            bag.static_transform(START_NS, "base_link", "camera", (0.1, 0.0, 0.3), (-0.5, 0.5, -0.5, 0.5))
        for k in range(40):
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (0.0, 0.0, 0.0), (0.0, 0.0))
            if k * 50_000_000 >= first_ns:
                bag.range_bearing("/landmarks", stamp, [(1, 2.0, 0.0)], frame_id=frame)
            if images:
                bag.compressed_image("/camera/image/compressed", stamp, b"none", "jpeg", frame_id="camera")
                bag.camera_info("/camera/camera_info", stamp, (640, 480), K, [0.0] * 5, frame_id="camera")
    (folder / "map.yaml").write_text("dictionary: DICT_4X4_50\nlandmarks:\n  - {id: 1, position: [2.0, 0.0]}\n")
    config = Config.model_validate({"recording": {"topics": topics}})
    with open_recording(folder / "bag", config.recording) as recording:
        return assemble(recording, folder / "map.yaml", config, keep_all=False)


def measured_range(parts: Assembly) -> float:
    event = RangeBearingEvent(START_NS, START_NS, "/landmarks", "lidar", (RangeBearing(1, 2.0, 0.0),))
    (measurement,) = parts.landmarks.measure(event)
    return measurement.range_m


def test_the_transform_is_used_and_nothing_is_said(tmp_path):
    parts = assembled(tmp_path)
    assert measured_range(parts) == pytest.approx(2.3)
    assert not parts.notes


def test_a_sensor_that_first_speaks_late_has_its_place(tmp_path, monkeypatch):
    monkeypatch.setattr("fgloc.sensor_setup._SCAN_EVENTS", 20)
    assert measured_range(assembled(tmp_path, first_ns=1_500_000_000)) == pytest.approx(2.3)


def test_a_camera_beside_it_does_not_move_it(tmp_path):
    parts = assembled(tmp_path, images=True, image="/camera/image/compressed", sightings="/landmarks")
    assert measured_range(parts) == pytest.approx(2.3)


@pytest.mark.parametrize("frame", ["base_link", "/base_link"])
def test_sightings_in_the_base_frame_need_no_transform(tmp_path, frame):
    parts = assembled(tmp_path, frame=frame, tf=False)
    assert measured_range(parts) == pytest.approx(2.0)
    assert not parts.notes


def test_a_missing_transform_is_said(tmp_path):
    parts = assembled(tmp_path, tf=False)
    assert measured_range(parts) == pytest.approx(2.0)
    (note,) = parts.notes
    assert re.search(r"\bbase_link\b.*\blidar\b", note)
