"""What a run must not keep to itself: ignored ids, a missing map, sightings dropped for their stamps, a lost robot."""

import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from circle_bag import write_circle
from command_line import fgloc

import fgloc as fgloc_package
from fgloc.config import Config, load_config
from fgloc.recording.reader import open_recording
from fgloc.runner import Outcome, run
from fgloc.sensors.markers.images import CornersEvent, ImageEvent, MarkerCorners
from fgloc.types import Finding, Mode, Severity


@pytest.mark.parametrize("command", ["smooth", "online"])
def test_sightings_dropped_for_their_stamps_are_said_first_and_exit_with_3(tmp_path, command):
    bag = write_circle(tmp_path, seconds=6.0, truth=False, late_s=20.0)
    (tmp_path / "map.yaml").unlink()
    code, stdout, stderr = fgloc(command, bag, "--out", tmp_path / "out")
    assert code == 3, stderr
    first = stdout.splitlines()[2]  # after the map and the configuration that are read
    assert first.startswith("error: ")
    assert "/landmarks" in first
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["findings"][0]["code"] == "sightings.unused"
    assert "recording.received_stamps: [sightings]" in first
    assert "dead reckoning" in (tmp_path / "out" / "report.html").read_text()


def test_a_map_that_is_missing_is_said(tmp_path):
    bag = write_circle(tmp_path, seconds=4.0)
    (tmp_path / "map.yaml").unlink()
    code, stdout, _ = fgloc("smooth", bag, "--out", tmp_path / "out")
    assert code == 0
    assert re.search(r"^note: .*`fgloc map`", stdout, re.MULTILINE)


def test_lost_poses_have_sigmas_of_the_maps_size(tmp_path):
    for mode in ("online", "batch"):
        result = run(
            write_circle(tmp_path / mode, seconds=5.0, sees=False), tmp_path / mode / "map.yaml", Config(), mode
        )
        assert set(result.modes) == {Mode.LOST}
        sigmas = np.sqrt(np.diagonal(result.trajectory.covs, axis1=1, axis2=2))
        assert sigmas[:, :2].min() > 1.5  # the beacons are 3 m from the middle
        assert sigmas[:, 2].min() > 1.5


def test_fault_50_ids_outside_the_map_are_named_in_runs_with_images(tmp_path):
    """The detector's sightings have a gate of their own."""
    corners = np.array([[0.0, 0.0], [20.0, 0.0], [20.0, 20.0], [0.0, 20.0]])
    sample = "datasets/samples/installed_run"

    def also_49(events):
        for event in events:
            if isinstance(event, CornersEvent):
                stranger = (MarkerCorners(49, corners + 5.0),)
                event = replace(event, sightings=(*event.sightings, *stranger))
            yield event

    folder = Path(fgloc_package.__file__).parent.parent / sample

    def first_seconds(events):
        images = 0
        for event in events:
            images += isinstance(event, ImageEvent)
            if images > 40:
                return
            yield event

    config = load_config(folder / "robot.yaml")
    result = run(folder / "bag", folder / "map.yaml", config, "online", events=first_seconds, sightings=also_49)
    assert result.rejections["sightings.unknown_id"] > 20
    assert [note for note in result.notes if re.search(r"\bids\b.*\b49\b", note)]
    with open_recording(folder / "bag", config.recording) as recording:
        assert "image" in recording.roles


def test_the_message_of_a_failed_run_is_in_sentences():
    found = Outcome(
        {},
        Counter(),
        (
            Finding("setup", "No marker.", Severity.ERROR),
            Finding("map.contradiction", "Another map?", Severity.WARNING),
        ),
    )
    assert found.failed("never found.") == "No marker. Never found. Another map?"
    assert replace(found, findings=()).failed("never found.") == "never found."
