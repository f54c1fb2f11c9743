"""Ranges as drivers publish them: a topic for each anchor, other units, other numbers; each is read, or is named."""

import math

import numpy as np
import pytest

from fgloc import run
from fgloc.config import config_of
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.errors import RecordingError
from fgloc.recording.reader import TopicInfo, open_recording, select_roles
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
ANCHORS = {1: (-4.0, -4.0, 2.0), 2: (8.0, -4.0, 2.0), 3: (8.0, 8.0, 2.0), 4: (-4.0, 8.0, 2.0)}
RANGE = "sensor_msgs/msg/Range"


def write(folder, topic="/uwb/range", frame="anchor_{}", factor=1.0, beside=(), seconds=20.0):
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
