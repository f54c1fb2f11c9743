"""No command writes over a map or a configuration that it reads, unless it is told to."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fgloc import cli
from fgloc.cli.options import spare_inputs
from fgloc.errors import OutputError

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "first_run"


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(SAMPLE, tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.parametrize(
    "command",
    [
        ["online", "{run}/bag", "--out", "{run}"],
        ["smooth", "{run}/bag", "--out", "{run}"],
        ["smooth", "{run}/bag", "--map", "{run}/../run/map.yaml", "--out", "{run}"],
        ["map", "{run}/bag", "--anchor", "{run}/map.yaml", "--out", "{run}/map.yaml"],
        ["calibrate", "{run}/bag", "--config", "{run}/robot.yaml", "--out", "{run}/robot.yaml"],
        ["calibrate", "{run}/bag", "--out", "{run}/robot.yaml"],
    ],
)
def test_an_input_is_not_written_over(folder, command):
    before = {name: (folder / name).read_bytes() for name in ("map.yaml", "robot.yaml")}
    shown = CliRunner().invoke(cli.app, [part.format(run=folder) for part in command])
    assert isinstance(shown.exception, OutputError) or shown.exit_code == 1
    assert {name: (folder / name).read_bytes() for name in before} == before


def test_force_may(folder):
    with pytest.raises(OutputError):
        spare_inputs(folder, folder / "bag", None, None, force=False)
    spare_inputs(folder, folder / "bag", None, None, force=True)
    spare_inputs(folder / "result", folder / "bag", None, None, force=False)
