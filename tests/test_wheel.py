"""The wheel is the product: built, installed away from the repository, and used in an empty folder.

Its dependencies are those of the environment that runs the tests, by a path file; fgloc itself is that of the wheel.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
import yaml

import fgloc

ROOT = Path(fgloc.__file__).resolve().parent.parent
MOST_BYTES = 10_000_000
FAST = {  # a model that learns nothing much, in seconds
    "network": {"hidden": [8], "variance_units": 8},
    "optimization": {"iterations": 20, "validate_every": 10, "variance_iterations": 20, "validation_s": [5.0]},
    "calibration": {"horizons_s": [5.0]},
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this source, built as `make dist` does."""
    out = tmp_path_factory.mktemp("dist")
    source = out / "source"  # a copy: setuptools leaves its build/ beside what it builds
    for name in ("fgloc", "training", "datasets"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, source],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def run(wheel, tmp_path_factory):
    """Runs a command of the installed wheel in an empty folder; its output."""
    place = tmp_path_factory.mktemp("installed")
    venv.create(place / "venv", with_pip=True, symlinks=True)
    python = place / "venv" / "bin" / "python"
    packages = sysconfig.get_path("purelib", "venv", {"base": str(place / "venv")})
    (Path(packages) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # else pip finds the source
    subprocess.run([python, "-m", "pip", "install", "-q", "--no-deps", "--no-index", wheel], check=True, env=alone)
    empty = place / "empty"
    empty.mkdir()

    def command(*arguments, program="fgloc", code=0):
        done = subprocess.run(
            [place / "venv" / "bin" / program, *map(str, arguments)],
            cwd=empty, env={"PATH": "/usr/bin:/bin", "HOME": str(empty), "OMP_NUM_THREADS": "1"},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == code, f"{arguments}: {done.stdout}\n{done.stderr}"
        return done.stdout

    command.folder = empty
    command.bin = place / "venv" / "bin"
    return command


def bundled(run):
    code = "import fgloc_datasets; print(fgloc_datasets.SAMPLE)"
    sample = Path(run("-c", code, program="python").strip())
    assert not sample.is_relative_to(ROOT)
    return sample


@pytest.mark.slow
def test_the_wheel_is_small_and_holds_no_top_level_package_but_its_three(wheel):
    assert wheel.stat().st_size < MOST_BYTES
    names = zipfile.ZipFile(wheel).namelist()
    about = f"fgloc-{wheel.name.split('-')[1]}.dist-info"
    assert {name.partition("/")[0] for name in names} == {"fgloc", "fgloc_datasets", "fgloc_training", about}
    assert [n for n in names if n.endswith(".mcap")] == ["fgloc_datasets/samples/installed_run/bag/bag.mcap"]


@pytest.mark.slow
def test_the_description_renders_on_pypi(wheel):
    done = subprocess.run([sys.executable, "-m", "twine", "check", "--strict", wheel], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
def test_runs_of_the_bundled_recording(run):
    assert run("--version") == run("-m", "fgloc", "--version", program="python")
    assert "demo-out/batch/report.html" in run("demo")
    sample = bundled(run)
    assert "DICT_4X4_50" in run("init", sample, "--out", "robot.yaml") + (run.folder / "robot.yaml").read_text()
    assert "joint_states" in run("info", sample, "--config", "robot.yaml")
    run("smooth", sample, "--out", "batch", "--mcap", "batch.mcap")
    run("online", sample, "--out", "online")
    run("evaluate", "online/trajectory.tum", "batch/trajectory.tum")
    run("export", "batch", "--kitti", "batch.txt")
    run("map", sample, "--size", "0.2", "--dictionary", "DICT_4X4_50", "--out", "map.yaml")
    assert len(yaml.safe_load((run.folder / "map.yaml").read_text())["landmarks"]) >= 4


@pytest.mark.slow
def test_simulate_and_train(run):
    for seed in (1, 2, 3):
        run("sim", "record", "calibrated", "--seed", seed, "--longest", "40", "--no-camera", "--out", f"sim/run{seed}")
    run("train", "--init", *(f"sim/run{seed}/bag" for seed in (1, 2, 3)), "--out", "train.yaml")
    config = yaml.safe_load((run.folder / "train.yaml").read_text())
    (run.folder / "train.yaml").write_text(yaml.safe_dump(config | FAST))
    run("train", "train.yaml", "--out", "models")
    out = run("evaluate-model", "models/model.safetensors", "sim/run3/bag", "--json", "figures.json")
    assert "model" in out
    assert (run.folder / "figures.json").is_file()


@pytest.mark.slow
def test_a_sweep(run):
    sample = bundled(run)
    suite = yaml.safe_load((ROOT / "ablations" / "quick.yaml").read_text())
    suite["recordings"] = [{"name": "sample", "bag": str(sample)}]
    suite["variants"], suite["failures"] = suite["variants"][:1], suite["failures"][1:2]
    (run.folder / "suite.yaml").write_text(yaml.safe_dump(suite))
    assert "report.html" in run("ablate", "suite.yaml", "--out", "swept", "--workers", "1")


@pytest.mark.slow
def test_live_and_play(run):
    sample = bundled(run)
    domain = "87"
    live = subprocess.Popen(
        [run.bin / "fgloc", "live", "--map", sample.parent / "map.yaml", "--config", sample.parent / "robot.yaml",
         "--domain", domain],
        cwd=run.folder, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        played = run("play", sample, "--domain", domain, "--rate", "4")
        assert re.search(r"\d+ messages published", played)
    finally:
        live.send_signal(2)
        out, _ = live.communicate(timeout=60)
    assert int(re.search(r"keyframes\s+(\d+)", out)[1]) > 50, out
