"""The map that a run found becomes the map of another run only where a user says so."""

import shutil

import pytest
from robot_world import World, beacons
from typer.testing import CliRunner
from world_bags import write_world

from fgloc import cli
from fgloc.cli.options import spare_inputs
from fgloc.errors import OutputError
from fgloc.recording.storage import find_beside
from fgloc.sensors.maps import load_map


def test_a_run_into_the_folder_of_its_recording_leaves_the_map_of_the_next_run_as_it_was(tmp_path):
    bag = write_world(tmp_path, World(beacons(), seconds=4.0))
    given = tmp_path / "map.yaml"
    for _ in range(2):  # the result is written over, the map is not
        shown = CliRunner().invoke(cli.app, ["online", str(bag), "--out", str(bag)])
        assert shown.exit_code == 0, shown.output
        assert str(given) in shown.output
    found = bag / "map.yaml"
    assert load_map(found).landmarks.keys() == load_map(given).landmarks.keys()
    assert find_beside(bag, "map.yaml") == given
    assert str(found) in shown.output  # said to be passed over
    other = tmp_path / "beside"
    shutil.copytree(bag, other / "bag", ignore=lambda _, names: {n for n in names if n == "trajectory.tum"})
    assert find_beside(other / "bag", "map.yaml") == other / "bag" / "map.yaml"  # a user took it out of the result
    shutil.copy(given, found)
    assert find_beside(bag, "map.yaml") == found  # a user put a map of his own there


def test_a_map_beside_the_recording_is_spared_though_another_is_read(tmp_path):
    (tmp_path / "bag").mkdir()
    for file in (tmp_path / "map.yaml", tmp_path / "other.yaml"):
        file.write_text("landmarks:\n  - {id: 1, position: [1, 2, 0]}\n")
    with pytest.raises(OutputError):
        spare_inputs(tmp_path, tmp_path / "bag", tmp_path / "other.yaml", None, force=False)
