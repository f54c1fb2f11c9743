"""The tutorial of an own robot, run as it stands: every block of commands, in one empty folder."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from source_roots import PYTHONPATH

import fgloc

PAGE = Path(fgloc.__file__).parent.parent / "docs" / "tutorial-own-robot.md"


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_every_command_of_the_tutorial_is_one():
    known = {line.split()[1] for block in blocks("sh") for line in block.splitlines() if line.startswith("fgloc ")}
    assert known == {"sim", "init", "info", "map", "calibrate", "train", "smooth", "online"}


@pytest.mark.slow
@pytest.mark.render
def test_the_tutorial_leads_from_bags_to_a_model(tmp_path):
    (scenario,) = blocks("yaml")
    (tmp_path / "own.yaml").write_text(scenario)
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin" / "fgloc"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m fgloc "$@"\n')
    command.chmod(0o755)
    paths = {"PATH": f"{command.parent}:{os.environ['PATH']}", "PYTHONPATH": PYTHONPATH}
    said = ""
    for block in blocks("sh"):
        done = subprocess.run(
            [shutil.which("bash"), "-euc", block], cwd=tmp_path, env=os.environ | paths, capture_output=True, text=True
        )
        said += done.stdout + done.stderr
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"
    assert "warning: the size of the markers" in said
    assert len(yaml.safe_load((tmp_path / "bags" / "map.yaml").read_text())["landmarks"]) == 14
    found = yaml.safe_load((tmp_path / "bags" / "robot.yaml").read_text())["expert"]["wheels"]["yaw_per_m"]
    assert found == pytest.approx(-0.015 / 0.26, abs=0.02)  # the wheels differ by 1.5 %, their track is 0.26 m
    assert "the negative log-likelihood got worse" in said
    for name in ("result", "online"):
        metrics = json.loads((tmp_path / name / "metrics.json").read_text())
        assert metrics["ate_mean_m"] < 0.02
        assert metrics["factors"]["learned"] > 100
