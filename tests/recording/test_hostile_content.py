"""Recordings whose content is odd but whose bytes are sound: ids, names, metadata."""

import os
from collections import Counter

import numpy as np
import pytest
from circle_bag import write_circle
from command_line import fgloc
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from recording_bags import START_NS, storage_file, write_drive
from refusal import refusal

from fgloc.cli.terminal import say
from fgloc.config import Config, GateConfig, RecordingConfig
from fgloc.errors import MapError, RecordingError
from fgloc.evaluation.style import plain_label
from fgloc.files.documents import HostileError
from fgloc.intake.validation import EventValidator
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.images import CornersEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc_datasets.bag import BagWriter
from tests.fuzz.hostile_yaml import SYNTAX


@pytest.mark.parametrize("number", [-5, 2**31, 10**21, 2**63])
def test_ids_beyond_the_graphs_keys_are_rejected_and_counted(number):
    gate = EventValidator(GateConfig(), None)
    corners = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]])
    stamp = 1_700_000_000_000_000_000
    assert gate.check(RangeBearingEvent(stamp, stamp, "/s", "", (RangeBearing(number, 1.0, 0.0),))) is None
    assert gate.check(CornersEvent(stamp + 1, stamp + 1, "/s", "", (MarkerCorners(number, corners),))) is None
    kept = gate.check(
        RangeBearingEvent(stamp + 2, stamp + 2, "/s", "", (RangeBearing(number, 1.0, 0.0), RangeBearing(7, 1.0, 0.0)))
    )
    assert [s.landmark_id for s in kept.sightings] == [7]
    assert gate.rejections == Counter({"sightings.id_bound": 3})


def test_map_with_an_id_beyond_the_graphs_keys_is_refused(tmp_path):
    (tmp_path / "map.yaml").write_text("landmarks:\n  - {id: 0, position: [1, 2]}\n  - {id: 1e21, position: [1, 2]}\n")
    with pytest.raises(MapError, match=r"map.yaml:3: .* 1e\+21 .* 2147483647$"):
        load_map(tmp_path / "map.yaml")


def test_run_without_a_map_survives_such_ids(tmp_path):
    bag = write_circle(tmp_path, seconds=4.0)
    with BagWriter(tmp_path / "odd") as odd, open_recording(bag, RecordingConfig()) as recording:
        for event in recording.events():
            if event.topic == "/odom":
                odd.odometry("/odom", event.stamp_ns, (0.0, 0.0, 0.0), (0.4, 0.4))
            elif event.topic == "/landmarks":
                odd.range_bearing("/landmarks", event.stamp_ns, [(-5, 2.0, 0.1), (3, 2.0, 0.5)])
    result = run(tmp_path / "odd", None, Config(), "batch")
    assert result.rejections["sightings.id_bound"] > 5


NAMES = [
    "/a$b$c",
    "/$x_{$",
    "/\\frac{",
    "/bell\x07\x1b[2J\x1b]0;title\x07",
    "/" + "long" * 500,
    "/<script>alert(1)</script>",
]


def test_names_are_no_formulas(recwarn):
    figure = Figure()
    axes = figure.add_subplot()
    axes.set_yticks(range(len(NAMES)), [plain_label(name) for name in NAMES])
    FigureCanvasAgg(figure).draw()
    shown = [label.get_text() for label in axes.get_yticklabels()]
    assert shown[0] == r"/a\$b\$c"
    assert max(map(len, shown)) <= 62
    assert not any(c for text in shown for c in text if not c.isprintable())


def test_odd_topic_names_reach_neither_terminal_nor_page(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(60):
            bag.odometry("/odom", START_NS + k * 50_000_000, (0.02 * k, 0.0, 0.0), (0.4, 0.0))
            for name in NAMES:
                bag.command(name, START_NS + k * 50_000_000, 0.4, 0.0)
    (tmp_path / "bag" / "robot.yaml").write_text(
        'recording: {topics: {command: "/<script>alert(1)</script>"}}\nestimator: {initial_pose: [0, 0, 0]}\n'
    )
    code, stdout, _ = fgloc("info", tmp_path / "bag")
    assert code == 0
    assert "\x1b" not in stdout
    assert "/bell\\x07\\x1b[2J" in stdout
    fgloc("smooth", tmp_path / "bag", "--out", tmp_path / "out")
    assert "<script>alert(1)" not in (tmp_path / "out" / "report.html").read_text()
    for name in NAMES[:4]:
        quoted = name.replace("\\", "\\\\").replace("\x07", "\\a").replace("\x1b", "\\e")
        (tmp_path / "c.yaml").write_text(
            f'recording: {{topics: {{command: "{quoted}"}}}}\nestimator: {{initial_pose: [0, 0, 0]}}\n'
        )
        code, stdout, stderr = fgloc(
            "smooth", tmp_path / "bag", "--config", tmp_path / "c.yaml", "--out", tmp_path / "o"
        )
        assert code in (0, 3), stderr
        assert "\x1b" not in stdout + stderr


def test_say_shows_control_characters(capsys):
    say("a\x1b[31mb\r\n\x9bc\udc80ü")
    assert capsys.readouterr().out == "a\\x1b[31mb\\r\n\\x9bc\\udc80ü\n"


def test_metadata_with_a_harmless_alias_is_read(tmp_path):
    folder = write_drive(tmp_path / "run", n=20)
    path = folder / "metadata.yaml"
    text = path.read_text()
    name = storage_file(folder).name
    (line,) = [line for line in text.splitlines() if line.strip() == f"- {name}"]
    path.write_text(text.replace(line, line.replace("- ", "- &file ") + "\n" + line.replace(name, "*file"), 1))
    with open_recording(folder, RecordingConfig()) as recording:
        assert sum(1 for _ in recording.events()) > 20
        assert not [note for note in recording.notes if "metadata" in note]


@pytest.mark.parametrize("name", ["alias bomb", "merge bomb", "deep lists", "alias of itself"])
def test_fault_65_metadata_with_a_bomb_is_refused(tmp_path, name):
    folder = write_drive(tmp_path / "run", n=5)
    (folder / "metadata.yaml").write_text(SYNTAX[name])
    with refusal(RecordingError, folder / "metadata.yaml", cause=HostileError):
        open_recording(folder, RecordingConfig())


def test_pipe_as_recording_is_refused(tmp_path):

    for name in ("pipe", "pipe.mcap", "pipe.bag"):
        os.mkfifo(tmp_path / name)
        with refusal(RecordingError, tmp_path / name):
            open_recording(tmp_path / name, RecordingConfig())
