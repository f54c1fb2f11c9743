"""Ranges as drivers publish them: a topic for each anchor, other units, other numbers; each is read, or is named."""

import math

import numpy as np
import pytest

from fgloc import run
from fgloc.calibration.first_settings import first_settings
from fgloc.config import config_of
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.errors import EstimatorError, RecordingError
from fgloc.recording.reader import TopicInfo, open_recording, select_roles
from fgloc.sensors.uwb import UwbEvent
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
ANCHORS = {1: (-4.0, -4.0, 2.0), 2: (8.0, -4.0, 2.0), 3: (8.0, 8.0, 2.0), 4: (-4.0, 8.0, 2.0)}
RANGE = "sensor_msgs/msg/Range"


def write(folder, topic="/uwb/range", frame="anchor_{}", factor=1.0, beside=(), seconds=14.0):
    """A robot on a curve that bends both ways, its odometry 3 % long, and ranges of four anchors in turn at 10 Hz."""
    rng = np.random.default_rng(2)
    x = y = yaw = 0.0
    with BagWriter(folder / "bag") as bag:
        for k in range(round(seconds * 20.0)):
            v, w = 0.8, 0.5 * math.sin(0.05 * k * 2.0 * math.pi / 9.0) + 0.1
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (1.03 * x, 1.03 * y, yaw), (1.03 * v, w), stamp)
            if k % 2 == 0:
                i = k // 2 % 4 + 1
                reading = factor * (math.dist((x, y, 0.0), ANCHORS[i]) + rng.normal(0.0, 0.05))
                bag.range_reading(topic.format(i), stamp, reading, frame.format(i), stamp)
                for other in beside:
                    bag.range_reading(other, stamp, 1.0, "front", stamp)
            x, y, yaw = x + 0.05 * v * math.cos(yaw), y + 0.05 * v * math.sin(yaw), yaw + 0.05 * w
    return folder / "bag"


def settings(topic=None, **uwb):
    topics = {"odometry": "/odom"} | ({} if topic is None else {"uwb": topic})
    return config_of({"recording": {"topics": topics}, "uwb": {"anchors": ANCHORS} | uwb})


# --- Topics -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("names", ["/uwb/range_{}", "/dwm{}/range", "/uwb/0x{}a/range"])
def test_a_topic_for_each_anchor_is_read_with_the_others(tmp_path, names):
    bag = write(tmp_path, names)
    with open_recording(bag, settings().recording) as recording:
        assert [recording.role_of[names.format(i)] for i in ANCHORS] == ["uwb"] * 4
        assert any("differ by a number only" in note for note in recording.notes)
    if names.startswith("/uwb/range"):
        result = run(bag, None, settings(), "online")
        assert {f"uwb.{i}" for i in ANCHORS} <= result.counts.keys()


def test_a_pattern_names_several_topics(tmp_path):
    bag = write(tmp_path, "/uwb/range_{}", beside=("/sonar/left", "/sonar/right"), seconds=2.0)
    with open_recording(bag, settings("/uwb/*").recording) as recording:
        assert sorted(recording.role_of) == ["/odom", *(f"/uwb/range_{i}" for i in ANCHORS)]
    with pytest.raises(RecordingError, match=r"recording.topics.uwb: /radio/\* is not in the recording"):
        open_recording(bag, settings("/radio/*").recording)


def test_topics_of_which_some_may_be_others_are_an_error_only_where_anchors_are_given(tmp_path):
    bag = write(tmp_path, "/uwb/range_{}", beside=("/sonar/left",), seconds=2.0)
    with pytest.raises(RecordingError, match=r"5 topics could be the uwb: .*several by a pattern: /uwb/range_\*"):
        open_recording(bag, settings().recording)
    with open_recording(bag, settings(anchors={}).recording) as recording:
        assert "uwb" not in recording.roles
        assert any("could be it" in note for note in recording.notes)


def test_on_the_wire_topics_that_come_later_are_added():
    topics = settings().recording.topics
    found = [TopicInfo(f"/uwb/range_{i}", RANGE, 1) for i in (2, 1, 3)]
    assert select_roles(found[:1], topics, growing=True).roles == {"uwb": "/uwb/range_2"}
    selected = select_roles(found, topics, growing=True)
    assert (selected.roles, selected.also) == ({"uwb": "/uwb/range_1"}, {"/uwb/range_2": "uwb", "/uwb/range_3": "uwb"})
    waiting = select_roles([], settings("/uwb/*").recording.topics, growing=True)
    assert not waiting.roles
    assert not waiting.problems


def test_anchors_without_any_ranges_are_a_warning(tmp_path):
    bag = write(tmp_path, seconds=5.0)
    off = settings("none")
    assert "sensor.unheard" not in {f.code for f in inspect_all(bag, None, off).found}
    config = config_of({"recording": {"topics": {"odometry": "/odom"}}, "gnss": {"origin": (48.0, 11.0, 0.0)}})
    for found in (inspect_all(bag, None, config).found, run(bag, None, config, "online").findings):
        (finding,) = (f for f in found if f.code == "sensor.unheard")
        assert finding.severity is Severity.WARNING
        assert "gnss.origin is given, but no topic holds messages of gnss" in finding.text


# --- Units ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "unit"), [(1000.0, 0.001), (100.0, 0.01)])
def test_ranges_of_another_unit_are_named_and_the_run_is_made_with_it(tmp_path, factor, unit):
    bag = write(tmp_path, factor=factor)
    info = inspect_all(bag, None, settings())
    (finding,) = (f for f in info.found if f.code == "uwb.unit")
    assert finding.lines == {"uwb.unit_m": str(unit)}
    assert info.exit_code == 3
    result = run(bag, None, settings(), "online")
    assert "uwb.unit" in {f.code for f in result.findings}
    assert "uwb.range_bound" not in result.rejections
    settled = settings(unit_m=unit)
    assert "uwb.unit" not in {f.code for f in inspect_all(bag, None, settled).found}
    true = run(write(tmp_path / "metres"), None, settings(), "online")
    np.testing.assert_allclose(run(bag, None, settled, "online").trajectory.poses, true.trajectory.poses, atol=1e-3)


def test_the_first_settings_have_the_unit_of_ranges(tmp_path):
    text = first_settings(write(tmp_path, factor=1000.0)).text
    assert "unit_m: 0.001" in text
    assert first_settings(write(tmp_path / "metres")).text.count("unit_m") == 0


# --- Anchors ----------------------------------------------------------------------------------------------------------


def test_anchors_that_are_heard_and_those_of_the_settings_are_named(tmp_path):
    bag = write(tmp_path, frame="DW1{}", seconds=8.0)
    (finding,) = (f for f in inspect_all(bag, None, settings()).found if f.code == "uwb.other_ids")
    assert finding.severity is Severity.ERROR
    assert "heard (11, 12, 13, 14) is in uwb.anchors, which has 1, 2, 3, 4" in finding.text
    with pytest.raises(EstimatorError, match=r"heard \(11, 12, 13, 14\)"):
        run(bag, None, settings(), "online")
    some = config_of({"uwb": {"anchors": {1: ANCHORS[1], 12: ANCHORS[2], 13: ANCHORS[3]}}})
    texts = [f.text for f in inspect_all(bag, None, some).found]
    assert any("anchors 11, 14 are not used, as uwb.anchors has 1, 12, 13, of which 1 are not" in t for t in texts)


def test_messages_that_do_not_say_which_anchor_they_are_of_are_refused_with_the_reason(tmp_path):
    bag = write(tmp_path, frame="base_link", seconds=4.0)
    for found in (inspect_all(bag, None, settings()).found, run(bag, None, settings(), "online").findings):
        assert any("40 of 40 messages cannot be used: frame_id 'base_link' does not end in an" in f.text for f in found)


def test_the_topic_tells_the_anchor_where_the_frame_does_not(tmp_path):
    bag = write(tmp_path, "/uwb/anchor_{}/range", "uwb_tag", seconds=2.0)
    with open_recording(bag, settings().recording) as recording:
        heard = [event.anchor for event in recording.events() if isinstance(event, UwbEvent)]
    assert heard == [k % 4 + 1 for k in range(20)]
