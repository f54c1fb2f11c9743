"""What a run found of the installation is written, read back, and makes the next run no worse."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fgloc import cli
from fgloc.calibrate import pooled
from fgloc.calibration.installation import (
    contradicted,
    contradiction_findings,
    contradictions,
    found_values,
    settings_found,
    with_settings,
)
from fgloc.config import Config, config_of, load_config, yaml_of
from fgloc.frames import OPTICAL_TO_BODY, homogeneous, rpy_matrix
from fgloc.graph.contradictions import Contradiction, Rival
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.sensors.cameras import corrected
from fgloc.sensors.maps import load_map
from fgloc.types import Camera, Finding, InstallationFound, Landmark, LandmarkMap, Setting, Severity

SAMPLE = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples" / "installed_run"


def found(names: dict[str, tuple[float, float, float]], **parts) -> InstallationFound:
    """By name: mean, sigma, sigma of the prior."""
    mean, sigma, prior = (np.array(column) for column in zip(*names.values(), strict=True))
    given = {"cameras": (), "seen_by": "sightings", "wheels": "odometry"} | parts
    return InstallationFound(tuple(names), mean, np.diag(sigma**2), np.diag(prior**2), **given)


def localised(*arguments: str) -> dict[str, object]:
    result = CliRunner().invoke(cli.app, list(arguments))
    assert result.exit_code == 0, result.output
    return json.loads((Path(arguments[3]) / "metrics.json").read_text())


@pytest.mark.slow
def test_what_a_run_found_makes_the_next_one_better(tmp_path):
    bag, first, smoothed, again = (str(p) for p in (SAMPLE / "bag", *(tmp_path / n for n in "abc")))
    before = localised("online", bag, "--out", first)
    localised("smooth", bag, "--out", smoothed)
    given = ["--config", f"{smoothed}/installation.yaml", "--map", f"{smoothed}/map.yaml"]
    after = localised("online", bag, "--out", again, *given)
    assert after["ate_mean_m"] <= before["ate_mean_m"]
    for name, value in after["installation"].items():
        assert abs(value["found"] - value["given"]) < 3.0 * np.hypot(value["sigma"], value["prior_sigma"]), name
    refined = load_map(Path(smoothed) / "map.yaml")
    assert all(lm.cov is not None and lm.cov.shape == (6, 6) for lm in refined.landmarks.values())
    assert "Installation" in (Path(smoothed) / "report.html").read_text()


def test_settings_are_those_that_undo_the_deviation(tmp_path):
    config = Config.model_validate({"wheels": {"scale_v": 1.1, "scale_omega": 0.9, "yaw_per_m": 0.1}})
    state = found(
        {
            "wheels.radius": (0.02, 0.001, 0.01),
            "wheels.track": (0.01, 0.001, 0.01),
            "wheels.yaw_per_m": (0.03, 0.002, 0.015),
            "sightings.time_offset_s": (0.02, 0.001, 0.012),
            "sightings.range_scale": (-0.01, 0.001, 0.005),
        }
    )
    settings = settings_found(state, config)
    after = with_settings(config, settings)
    assert after.wheels.scale_v == pytest.approx(1.1 * 1.02)
    assert after.wheels.scale_omega == pytest.approx(0.9 * 1.02 * 0.99)
    assert after.wheels.yaw_per_m == pytest.approx(0.1 * 0.99 + 0.03 / 1.02)
    assert after.wheels.scale_sigma == pytest.approx(0.001)
    assert after.recording.stamp_offset_s == {"sightings": -0.02}
    assert after.landmarks.range_scale == pytest.approx(np.exp(-0.01))
    assert after.landmarks.range_scale_sigma == pytest.approx(0.001)
    assert after.gyro == config.gyro  # not in the state


def test_the_range_scale_of_a_run_that_diverged_stays_a_number_of_a_setting():
    (setting,) = settings_found(found({"sightings.range_scale": (5000.0, 1.0, 0.01)}), Config())
    assert setting.found < 1e10


def test_the_places_of_the_maps_landmarks_are_among_the_values_found():
    landmark_map = LandmarkMap({7: Landmark(7, np.array([1.0, 2.0, 0.0]), np.eye(3), 0.0)})
    installation = Installation({"map.7.x_m": 0.05, "map.7.y_m": 0.05})
    belief = InstallationEstimate(np.array([0.02, -0.03]), np.diag([0.01, 0.02]) ** 2)
    values = found_values(installation, belief, Config(), (), landmark_map)
    assert values == {"map.7.x": pytest.approx((1.02, 0.01)), "map.7.y": pytest.approx((1.97, 0.02))}


@pytest.mark.parametrize("pitch", [0.5 * np.pi, -0.5 * np.pi, 0.0])
def test_a_camera_that_looks_up_or_down_is_off_by_the_angle_that_it_is_turned_by(pitch):
    """Roll and yaw are one angle there: written as such, a turn by 3 mrad was one of 400 mrad."""
    K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
    T = homogeneous(rpy_matrix(0.0, pitch, 0.0) @ OPTICAL_TO_BODY)
    names = [f"camera.{name}" for name in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")]
    turned = {name: (0.003 * name.endswith("rad"), 0.001, 0.01) for name in names}
    settings = settings_found(found(turned, cameras=(Camera(640, 480, "plumb_bob", K, np.zeros(0), T),)), Config())
    off = {s.name: s.found - s.given for s in settings if s.name in ("camera.roll", "camera.pitch", "camera.yaw")}
    assert len(off) == 3
    assert max(abs(value) for value in off.values()) == pytest.approx(0.003, rel=0.05)


def test_a_camera_is_corrected():
    camera = Camera(
        640, 480, "plumb_bob", np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), np.zeros(0), np.eye(4)
    )
    config = Config.model_validate({"camera": {"focal_scale": 1.01, "cx_px": 321.0, "k1": -0.1}})
    made = corrected(camera, config.camera)
    assert made.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [505.0, 505.0, 321.0, 240.0]
    assert made.D.tolist() == [-0.1, 0.0, 0.0, 0.0]
    assert corrected(camera, Config().camera).D.tolist() == []


def test_only_what_is_surely_beyond_the_prior_is_said():
    ordinary = Setting("gyro.scale", 1.0, 1.009, 0.0005, 0.005)  # 1.8 sigmas of what a gyro may be off
    odd = Setting("gyro.scale", 1.0, 1.03, 0.0005, 0.005)
    unseen = Setting("gyro.scale", 1.0, 1.0001, 0.00499, 0.005)
    pulled = Setting("stamp_offset_s.sightings", 0.0, 0.0266, 0.0099, 0.012)  # halfway between prior and measurements
    assert [contradicted(s) for s in (ordinary, odd, unseen)] == [False, True, False]
    assert pulled.off == pytest.approx(3.9, abs=0.1)
    assert pulled.unpulled == pytest.approx(0.083, abs=0.001)
    state = found({"gyro.scale": (0.03, 0.0005, 0.005)})
    (finding,) = contradictions(InstallationFound(**_fields(state), settings=(odd,)), Config())
    assert finding.lines == {"expert.gyro.scale": "1.03"}


def on_map(moves: dict[int, float], sigma: float = 0.01) -> list[Finding]:
    """Findings on a map whose landmarks a run moves by so much along x, which it knows to a tenth of the prior."""
    names = {f"map.{i}.x_m": (by, 0.1 * sigma, sigma) for i, by in moves.items()}
    names |= {f"map.{i}.y_m": (0.0, 0.1 * sigma, sigma) for i in moves}
    landmarks = LandmarkMap({i: Landmark(i, np.zeros(3), np.eye(3), 0.0) for i in moves})
    return contradictions(found(names, landmarks=landmarks), Config())


def test_landmarks_that_surely_stand_elsewhere_are_named():
    assert on_map({3: 0.03}) == []  # three sigmas
    (told,) = on_map({3: 0.04, 4: 0.03})
    assert told.code == "map.moved"
    assert re.findall(r"(\d+) \((\d+) mm\)", told.text) == [("3", "40")]


@pytest.mark.parametrize(("n", "others"), [(5, []), (7, ["2"])])
def test_of_many_landmarks_that_stand_elsewhere_those_that_do_most_are_named_and_the_others_counted(n, others):
    (told,) = on_map({i: 0.1 + 0.01 * i for i in range(n)})
    assert [int(i) for i, _ in re.findall(r"(\d+) \((\d+) mm\)", told.text)] == [*range(n)][:-6:-1]
    assert re.findall(r"(\d+) more", told.text) == others


def test_pooling_counts_the_prior_once():
    """Three runs that each know as much as the prior: together four times as much."""
    one = found({"wheels.radius": (0.01, 0.01 / np.sqrt(2), 0.01)})  # measured 0.02 ± 0.01
    (setting,) = [s for s in pooled([one, one, one], {"a"}, Config()) if s.name == "wheels.scale_v"]
    assert setting.sigma == pytest.approx(0.005)
    assert setting.found == pytest.approx(1.0 + 0.75 * 0.02)


def clocks(odometer: str = "odometry", **off: tuple[float, float, float]) -> list[Finding]:
    """Findings on clocks that are off: mean, sigma and sigma of the prior."""
    state = found({f"{name}.time_offset_s": values for name, values in off.items()}, wheels=odometer)
    state = InstallationFound(**_fields(state), settings=settings_found(state, Config()))
    return contradictions(state, Config())


def test_a_late_clock_is_named_with_its_line():
    (told,) = clocks(sightings=(0.08, 0.002, 0.012))
    assert told.code == "clock.sightings"
    assert told.value == pytest.approx(0.082, abs=0.001)
    assert told.lines == {"recording.stamp_offset_s": "{sightings: -0.082}"}
    assert clocks(sightings=(0.02, 0.002, 0.004)) == []
    assert clocks("command", sightings=(0.08, 0.002, 0.012)) == []


def test_all_clocks_against_the_gyros_accuse_the_gyros():
    (told,) = clocks("joints", sightings=(0.08, 0.002, 0.012), wheels=(0.08, 0.002, 0.01))
    assert told.code == "clock.imu"
    assert told.value == pytest.approx(-0.08, abs=0.005)


def test_a_configuration_written_is_read(tmp_path):
    config = with_settings(
        config_of({}), [Setting("gyro.scale", 1.0, 1.01, 0.001, 0.005), *map(_distortion, ("k1", "k2"))]
    )
    path = tmp_path / "installation.yaml"
    path.write_text(yaml_of(config, tmp_path))
    assert load_config(path) == config


def _distortion(name: str) -> Setting:
    return Setting(f"camera.{name}", 0.0, 0.01, 0.001, 0.005)


def _fields(state: InstallationFound) -> dict[str, object]:
    names = ("names", "mean", "cov", "prior_cov", "cameras", "seen_by", "wheels")
    return {name: getattr(state, name) for name in names}


def test_a_contradiction_that_one_constant_explains_has_its_line_and_its_value():
    state = found({"gyro.scale": (0.0, 0.005, 0.005)})
    rival = Rival(("gyro.scale",), np.array([0.2]), np.array([0.001]), True, 1.0, np.zeros((1, 3)))
    (finding,) = contradiction_findings(state, Contradiction(("gyro.scale",), state, (rival,)), Config())
    assert finding.value == pytest.approx(1.2, abs=0.05)
    assert finding.sigma < 0.01
    assert float(finding.lines["expert.gyro.scale"]) == pytest.approx(finding.value, abs=1e-3)


def test_one_rival_that_is_no_installation_is_told_otherwise_than_two_that_explain_a_contradiction_alike():
    state = found({"gyro.scale": (0.0, 0.005, 0.005)})
    rival = Rival(("gyro.scale",), np.array([2.0]), np.array([0.001]), False, 1.0, np.zeros((1, 3)))
    other = Rival(("gyro.bias",), np.array([2.0]), np.array([0.001]), False, 1.0, np.zeros((1, 3)))
    one, two = (
        contradiction_findings(state, Contradiction(("gyro.scale",), state, rivals), Config())[0]
        for rivals in ((rival,), (other, rival))
    )
    assert not one.lines
    assert not two.lines
    assert two.value is None
    assert not two.text.endswith(one.text[-40:])


def test_a_contradiction_of_constants_without_a_setting_names_the_constants():
    state = found({"gyro.bias": (0.2, 0.001, 0.02)})
    rival = Rival(("gyro.bias",), np.array([0.2]), np.array([0.001]), True, 1.0, np.zeros((1, 3)))
    (finding,) = contradiction_findings(state, Contradiction(("gyro.bias",), state, (rival,)), Config())
    assert "gyro.bias" in finding.text
    assert not finding.lines
    assert finding.severity is Severity.ERROR
