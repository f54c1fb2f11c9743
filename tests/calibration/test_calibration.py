"""Wheels calibrated on a recording: the true gains are found, and the path is as long as it was."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from refusal import refusal
from robot_world import points
from typer.testing import CliRunner

from fgloc import cli, se2
from fgloc.calibrate import calibrate
from fgloc.calibration.installation import found_text, given_text, setting_unit
from fgloc.config import Config, config_of, load_config, model_path, yaml_of
from fgloc.errors import EstimatorError
from fgloc.runner import run
from fgloc.sensors.maps import write_map
from fgloc.types import Setting
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
BEACONS = {0: (4.0, 0.5), 1: (0.5, 4.0), 2: (-4.0, -0.5), 3: (-0.5, -4.0)}
TRUE = {"scale_v": 1.06, "scale_omega": 0.93, "yaw_per_m": -0.05, "slowdown": 0.6, "delay_s": 0.2}
OF_WHEELS = ("scale_v", "scale_omega", "yaw_per_m")
NOISE = {"x_per_sqrt_m": 0.01, "y_per_sqrt_m": 0.003, "yaw_per_sqrt_m": 0.02, "yaw_per_sqrt_rad": 0.0}
LANDMARKS = {"range_sigma_m": 0.03, "bearing_sigma_rad": 0.01}
SECONDS = {"command": 60, "wheels": 40}


def settings(source: str) -> Config:
    sigmas = {"scale_sigma": 0.1, "turn_scale_sigma": 0.1, "yaw_per_m_sigma": 0.1}
    wheels = {"source": source, "noise": NOISE, "hold_s": 0.2, **sigmas}
    return Config.model_validate({"wheels": wheels, "landmarks": LANDMARKS})


def drive(folder: Path, seed: int, told_by: str) -> Path:
    """A robot that obeys with the true gains, told by commands or telling by odometry; one beacon seen every 2 s."""
    rng = np.random.default_rng(seed)
    levels = rng.uniform([0.1, -0.8], [0.4, 0.8], (SECONDS[told_by] // 3 + 1, 2))
    slow, late = (TRUE["slowdown"], round(TRUE["delay_s"] * 100)) if told_by == "command" else (0.0, 0)
    pose, told = np.zeros(3), [(0.0, 0.0)] * (1 + late // 5)
    with BagWriter(folder / "bag") as bag:
        for k in range(SECONDS[told_by] * 100):
            stamp = START_NS + k * 10_000_000
            if k % 5 == 0:
                v, omega = levels[k // 300]
                omega -= 0.3 * math.hypot(pose[0], pose[1]) * math.sin(pose[2] - math.atan2(-pose[1], -pose[0]))  # back
                if told_by == "command":
                    bag.command("/cmd_vel", stamp, v, omega)
                else:
                    bag.odometry("/odom", stamp, (0.0, 0.0, 0.0), (v, omega))
                told.append((v, omega))
            if k % 20 == 0:
                bag.planar_truth("/truth", stamp, pose)
            if k % 200 == 0 or k == 20:
                bag.range_bearing("/landmarks", stamp, [sight(rng, pose, int(i)) for i in rng.choice(4, 2, False)])
            v, omega = told[-1 - late // 5]
            v *= TRUE["scale_v"] * max(0.0, 1.0 - slow * abs(omega))
            turn = TRUE["scale_omega"] * omega + TRUE["yaw_per_m"] * v
            way = 0.01 * v + NOISE["x_per_sqrt_m"] * math.sqrt(0.01 * abs(v)) * rng.normal()
            pose = se2.compose(pose, se2.exp((way, 0.0, 0.01 * turn)))
    write_map(points(BEACONS), folder / "map.yaml")
    (folder / "robot.yaml").write_text(yaml_of(settings("twist" if told_by == "wheels" else told_by), folder))
    return folder / "bag"


def sight(rng: np.random.Generator, pose: np.ndarray, i: int) -> tuple[int, float, float]:
    x, y, _ = se2.between(pose, (*BEACONS[i], 0.0))
    return i, math.hypot(x, y) + rng.normal(0.0, 0.03), math.atan2(y, x) + rng.normal(0.0, 0.01)


def length(poses: np.ndarray) -> float:
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


@pytest.fixture(scope="module")
def commanded(tmp_path_factory) -> Path:
    return drive(tmp_path_factory.mktemp("commanded"), 1, "command")


@pytest.fixture(scope="module")
def wheeled(tmp_path_factory) -> list[Path]:
    return [drive(tmp_path_factory.mktemp("wheeled"), seed, "wheels") for seed in (2, 3)]


def test_the_gains_of_commands_are_found_and_the_path_gets_its_length(commanded, tmp_path):
    out = tmp_path / "calibrated.yaml"
    result = CliRunner().invoke(cli.app, ["calibrate", str(commanded), "--out", str(out)])
    assert result.exit_code == 0, result.output
    wheels = load_config(out).wheels
    for name, tolerance in (("scale_v", 0.02), ("scale_omega", 0.02), ("yaw_per_m", 0.03), ("slowdown", 0.1)):
        assert getattr(wheels, name) == pytest.approx(TRUE[name], abs=tolerance), name
    assert wheels.delay_s == pytest.approx(TRUE["delay_s"], abs=0.03)
    assert wheels.hold_s == 0.2  # what was given stays
    errors = []
    for config in (settings("command"), load_config(out)):
        smoothed = run(commanded, commanded.parent / "map.yaml", config, "batch")
        poses = smoothed.trajectory.poses
        truth = se2.interpolate(smoothed.truth.stamps_ns, smoothed.truth.poses, smoothed.trajectory.stamps_ns)
        errors.append(np.hypot(*(poses - truth)[:, :2].T).mean())
    assert abs(length(poses) / length(truth) - 1.0) < 0.02
    assert errors[1] < 0.02
    assert errors[0] > 3.0 * errors[1]  # gains are states of every run, but not delay and slowdown


def test_sigmas_are_honest_and_shrink_with_every_recording(wheeled):
    config, map_path = settings("twist"), wheeled[0].parent / "map.yaml"
    one, both = (
        {s.name.removeprefix("wheels."): s for s in calibrate(bags, map_path, config)[1]}
        for bags in (wheeled[:1], wheeled)
    )
    for found in (one, both):
        assert set(OF_WHEELS) <= found.keys()
        for name in OF_WHEELS:
            assert abs(found[name].found - TRUE[name]) < 3.5 * found[name].sigma, name
    for name in OF_WHEELS:
        assert both[name].sigma < 0.9 * one[name].sigma
        assert both[name].sigma < 0.03


def test_recordings_with_different_wheels_are_refused(commanded, wheeled):
    with pytest.raises(EstimatorError, match=r"wheels\.source"):
        calibrate([commanded, wheeled[0]], commanded.parent / "map.yaml", settings("auto"))


def test_wheels_that_never_spoke_are_not_calibrated(commanded):
    """Silence is in the graph as a robot that stands; it says nothing of gains."""
    with pytest.raises(EstimatorError, match=r"see wheels\.source"):
        calibrate([commanded], commanded.parent / "map.yaml", settings("twist"))


def test_a_run_without_sightings_tells_no_gains(commanded):
    deaf = {
        "recording": {"topics": {"sightings": "none", "truth": "none"}},
        "estimator": {"initial_pose": [0.0, 0.0, 0.0]},
    }
    config = Config.model_validate(settings("command").model_dump(exclude_unset=True) | deaf)
    with refusal(EstimatorError, commanded):
        calibrate([commanded], commanded.parent / "map.yaml", config)


@pytest.mark.slow
def test_gains_that_no_robot_has_are_not_written(wheeled):
    config = settings("twist")
    far = config.model_copy(update={"wheels": config.wheels.model_copy(update={"scale_v": 0.4})})
    with pytest.raises(EstimatorError, match=r"cannot be (calibrated on this run: scale_v|had|determined)"):
        calibrate(wheeled[:1], wheeled[0].parent / "map.yaml", far)


def test_a_written_configuration_is_read_back(tmp_path):
    values = {
        "wheels": {"scale_v": 0.9, "noise": {"x_per_sqrt_m": 0.01}},
        "camera": {"file": tmp_path / "cameras" / "front.yaml"},
        "motion": {"model": model_path("shipped:mrclam/all")},
    }
    config = config_of(values)
    (tmp_path / "robot.yaml").write_text(yaml_of(config, tmp_path))
    text = (tmp_path / "robot.yaml").read_text()
    assert "shipped:mrclam/all" in text
    assert "file: cameras/front.yaml" in text
    assert load_config(tmp_path / "robot.yaml") == config


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        (Setting("camera.roll", -0.0, -0.00001234, 0.00002, 0.01), ("rad", "0.000000", "-0.000012 ± 0.000020")),
        (Setting("camera.z", 0.3, 0.30412, 0.0031, 0.01), ("m", "0.3000", "0.3041 ± 0.0031")),
        (Setting("camera.cx_px", 320.0, 321.26, 1.4, 3.0), ("px", "320.0", "321.3 ± 1.4")),
        (Setting("camera.k1", 0.0, -0.02, 0.3, 0.3), ("-", "0.00", "-0.02 ± 0.30")),
        (Setting("stamp_offset_s.imu", 0.0, 0.0012, 0.00033, 0.01), ("s", "0.00000", "0.00120 ± 0.00033")),
        (Setting("landmarks.bearing_bias_rad", 0.0, -0.001, 0.02, 0.02), ("rad", "0.000", "-0.001 ± 0.020")),
        (Setting("wheels.scale_v", 1.0, 1.0123, 0.00046, 0.2), ("-", "1.00000", "1.01230 ± 0.00046")),
        (Setting("wheels.yaw_per_m", 0.0, -0.0001, 0.00002, 0.2), ("rad/m", "0.000000", "-0.000100 ± 0.000020")),
        (Setting("wheels.slowdown", 0.0, 0.4, 0.011, 1.0), ("s/rad", "0.000", "0.400 ± 0.011")),
        (Setting("wheels.delay_s", 0.0, 0.0, 0.05, 0.05), ("s", "0.000", "0.000 ± 0.050")),
    ],
    ids=lambda value: value.name if isinstance(value, Setting) else "",
)
def test_a_setting_is_shown_with_unit_and_the_digits_of_its_sigma(setting, told):
    assert (setting_unit(setting.name), given_text(setting), found_text(setting)) == told
