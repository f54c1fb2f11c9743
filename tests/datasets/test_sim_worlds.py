"""A few seconds of each world, physics only; suites that resume; pictures."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from refusal import refusal

from fgloc.errors import ConfigError, RecordingError
from fgloc.types import FloatArray
from fgloc_datasets.sim.camera import light_level
from fgloc_datasets.sim.control import Driver, make_function
from fgloc_datasets.sim.figures import draw
from fgloc_datasets.sim.physics import Log, base_twist, make_scene, simulate, slipping, wheel_twist
from fgloc_datasets.sim.record import BUNDLED, jobs, load_suite, record, record_suite
from fgloc_datasets.sim.scenario import (
    Control,
    ControlKind,
    Floor,
    Humps,
    LightStep,
    Markers,
    Patch,
    PlacedMarker,
    Ramp,
    Robot,
    Rough,
    Scenario,
    Tilt,
    World,
    channel_rng,
)
from fgloc_datasets.sim.scene import make_ground, make_map

SUITE = load_suite(BUNDLED)
KINDS: tuple[ControlKind, ...] = (
    "straight", "turns", "steps", "ramps", "sines", "random_walk", "stop_and_go", "figure_eight", "spiral", "spin",
)  # fmt: skip


@pytest.mark.parametrize("name", [e.scenario.name for e in SUITE.entries])
def test_each_world_drives(name: str) -> None:
    scenario = SUITE.find(name).model_copy(update={"duration_s": 3.0, "camera": None})
    log = simulate(make_scene(scenario, 4))
    travelled = np.linalg.norm(np.diff(log.positions[:, :2], axis=0), axis=1).sum()
    assert 0.01 < travelled < 3.0 * 1.3 * scenario.robot.max_v
    assert np.abs(log.positions[:, :2]).max(axis=0) == pytest.approx(0, abs=0.5 * max(scenario.world.size_m))
    assert np.degrees(2 * np.hypot(log.quaternions[:, 0], log.quaternions[:, 1]).max()) < 20


def test_every_scenario_has_all_splits_and_none_shares_a_seed_or_controls() -> None:
    for entry in SUITE.entries:
        by_split = {split: [r for r in entry.runs if r.split == split] for split in ("train", "validation", "test")}
        if not entry.runs:
            continue  # a bundled sample
        assert all(by_split.values())
        seeds = [r.seed for r in entry.runs]
        assert len(set(seeds)) == len(seeds)
        sets = {split: {r.control.functions for r in runs if r.control} for split, runs in by_split.items()}
        assert not sets["train"] & sets["test"]
        assert not sets["train"] & sets["validation"]
        assert not sets["validation"] & sets["test"]


def test_ramp_is_climbed() -> None:
    floor = Floor(ramp=Ramp(start_x=0.3, width_m=3.0))
    scenario = Scenario(
        name="ramp", duration_s=6.0, camera=None, world=World(size_m=(8.0, 6.0), floor=floor),
        control=Control(waypoints=((3.0, 0.0),), speed=0.4),
    )  # fmt: skip
    log = simulate(make_scene(scenario, 1))
    assert log.positions[:, 2].max() == pytest.approx(np.tan(np.radians(7.0)), abs=0.01)
    pitch = 2 * np.arcsin(log.quaternions[:, 1])
    assert np.degrees(pitch.min()) == pytest.approx(-7.0, abs=1.5)


def pitch_deg(log: Log) -> FloatArray:
    """Nose up is negative."""
    x, y, z, w = log.quaternions.T
    return np.degrees(np.arcsin(np.clip(2 * (w * y - x * z), -1, 1)))


@pytest.mark.parametrize("angle", [10.0, 15.0])
def test_truth_pitches_as_the_ramp_does(angle: float) -> None:
    ramp = Ramp(start_x=0.3, angle_deg=angle, rise_m=1.5, width_m=3.0)
    scenario = Scenario(
        name="ramp", duration_s=8.0, camera=None, world=World(size_m=(9.0, 6.0), floor=Floor(ramp=ramp)),
        control=Control(waypoints=((4.0, 0.0),), speed=0.3),
    )  # fmt: skip
    log = simulate(make_scene(scenario, 1))
    x = log.positions[:, 0]
    on_slope = (x > 0.7) & (x < 1.6)  # wheels and caster
    assert on_slope.sum() > 100
    assert x[-1] > 1.8
    np.testing.assert_allclose(np.median(pitch_deg(log)[on_slope]), -angle, atol=0.3)
    np.testing.assert_allclose(log.positions[on_slope, 2], (x[on_slope] - 0.3) * np.tan(np.radians(angle)), atol=0.01)


def test_a_tilted_floor_leans_and_its_walls_carry_the_markers() -> None:
    tilt = Tilt(slope_deg=5.0, direction_deg=90.0)
    scenario = Scenario(
        name="tilt", duration_s=3.0, camera=None, world=World(floor=Floor(tilt=tilt)),
        control=Control(rest_s=10.0), start=(0.0, 1.0, np.pi / 2),
    )  # fmt: skip
    scene = make_scene(scenario, 2)
    log = simulate(scene)
    np.testing.assert_allclose(pitch_deg(log)[-100:], -5.0, atol=0.3)
    np.testing.assert_allclose(log.positions[-1, 2], np.tan(np.radians(5.0)), atol=0.01)
    low, high = scenario.world.markers.heights_m
    for landmark in scene.landmarks.landmarks.values():
        above = landmark.position[2] - tilt.height(landmark.position[0], landmark.position[1])
        assert low - 1e-3 < above < high + 1e-3


def test_a_rough_floor_is_as_high_as_it_is_said_to_be() -> None:
    world = World(floor=Floor(rough=Rough(height_m=0.03)))
    ground, again, other = (make_ground(world, seed) for seed in (1, 1, 2))
    assert ground.height is not None
    np.testing.assert_allclose((ground.height.min(), ground.height.max()), (-0.03, 0.03))
    np.testing.assert_array_equal(ground.height, again.height)
    assert np.abs(ground.height - other.height).max() > 0.01
    scenario = Scenario(name="rough", duration_s=5.0, camera=None, world=world, control=Control(functions=("turns",)))
    log = simulate(make_scene(scenario, 1))
    beneath = [ground.height_at(x, y) for x, y in log.positions[::40, :2]]
    np.testing.assert_allclose(log.positions[::40, 2], beneath, atol=0.012)
    assert np.ptp(pitch_deg(log)) > 1.0


def test_markers_hang_where_they_are_placed() -> None:
    ceiling = PlacedMarker(id=14, position=(0.0, 0.0, 2.0), facing_deg=0.0, elevation_deg=-90.0)
    post = PlacedMarker(id=15, position=(1.0, 0.0, 0.3), facing_deg=180.0)
    landmarks = make_map(World(markers=Markers(placed=(ceiling, post))), 1).landmarks
    np.testing.assert_allclose(landmarks[14].rotation[:, 2], (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(landmarks[15].rotation.T, [(0, -1, 0), (0, 0, 1), (-1, 0, 0)], atol=1e-12)
    with pytest.raises(ValidationError, match="placed marker 3"):
        Markers(placed=(ceiling.model_copy(update={"id": 3}),))


def test_humps_shake_the_robot() -> None:
    scenario = Scenario(
        name="humps", duration_s=4.0, camera=None, world=World(size_m=(4.0, 4.0), floor=Floor(humps=Humps(count=30))),
        control=Control(functions=("straight",)),
    )  # fmt: skip
    log = simulate(make_scene(scenario, 1))
    assert np.ptp(log.positions[:, 2]) > 0.003
    assert np.isfinite(log.velocities).all()


def test_skid_steer_turns_less_than_its_wheels_say() -> None:
    robot = SUITE.find("skid_steer").robot
    control = Control(functions=("spin",), segment_s=20.0)
    scenario = Scenario(name="skid", duration_s=3.0, camera=None, robot=robot, control=control)
    log = simulate(make_scene(scenario, 2))
    steady = log.stamps_s > 2.0
    ratio = base_twist(log)[steady, 2].mean() / wheel_twist(log, robot)[steady, 2].mean()
    assert 0.35 < ratio < 0.75


def test_payload_moves_the_center_of_mass() -> None:
    robot = SUITE.find("payload_shift").robot
    assert robot.payload is not None
    robot = robot.model_copy(update={"payload": robot.payload.model_copy(update={"shift_at_s": 0.5})})
    rest = Control(rest_s=10.0)
    scene = make_scene(Scenario(name="load", duration_s=2.0, camera=None, robot=robot, control=rest), 1)
    log = simulate(scene)
    roll = 2 * np.arcsin(log.quaternions[:, 0])
    assert abs(roll[-1] - roll[90]) > 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_control_functions_stay_within_limits_and_repeat(kind: ControlKind) -> None:
    robot = Robot()
    times = np.arange(0.0, 15.0, 0.05)
    first, again = (make_function(kind, robot, 15.0, channel_rng(7, "control")) for _ in range(2))
    values = np.array([first(t) for t in times])
    assert (values == np.array([again(t) for t in times])).all()
    assert np.abs(values[:, 0]).max() <= robot.max_v * (1 + 1e-9)
    assert np.abs(values).max() > 0.1
    if kind not in ("straight", "turns"):
        assert np.ptp(values, axis=0).max() > 0.1


def test_driver_turns_back_before_walls() -> None:
    scenario = Scenario(name="guard", duration_s=30.0, camera=None, control=Control(functions=("straight", "turns")))
    log = simulate(make_scene(scenario, 1))
    reach = 0.5 * np.asarray(scenario.world.size_m)
    assert (np.abs(log.positions[:, :2]).max(axis=0) < reach - 0.25).all()


def test_waypoints_are_reached_in_turn() -> None:
    scenario = Scenario(name="way", duration_s=1.0, control=Control(waypoints=((1.0, 0.0), (0.0, 1.0)), rest_s=0.0))
    driver = Driver(scenario, 1)
    assert driver.command(0.0, (0.0, 0.0, 0.0))[1] == 0.0
    assert driver.command(1.0, (1.0, 0.0, 0.0)).omega > 1.0  # there: now to the left and back


def test_patches_lie_where_they_are_drawn() -> None:
    patches = (
        Patch(center=(1.0, 0.5), size=(1.0, 0.4), yaw_deg=90.0, shape="rectangle", mu=0.1),
        Patch(center=(-1.0, 0.0), size=(0.8, 0.8), mu=0.2),
        Patch(center=(0.0, -1.0), points=((-0.3, -0.3), (0.3, -0.3), (0.0, 0.4)), shape="polygon", mu=0.3),
    )
    ground = make_ground(World(floor=Floor(patches=patches)), 1)
    assert ground.mu_at(1.0, 0.95) == 0.1
    assert ground.mu_at(1.45, 0.5) == 0.8
    assert ground.mu_at(-1.0, 0.35) == 0.2
    assert ground.mu_at(-1.35, 0.35) == 0.8
    assert ground.mu_at(0.0, -1.0) == 0.3
    assert ground.mu_at(0.25, -0.75) == 0.8
    assert ground.mu_at(100.0, 100.0) == 0.8


def test_light_holds_until_the_next_step() -> None:
    steps = (LightStep(at_s=1.0, level=0.1), LightStep(at_s=2.0, level=0.5))
    assert [light_level(steps, t) for t in (0.0, 1.0, 1.9, 2.5)] == [1.0, 0.1, 0.1, 0.5]


def test_slip_is_flagged_on_patches_only() -> None:
    scenario = SUITE.find("patches").model_copy(update={"duration_s": 20.0, "camera": None})
    scene = make_scene(scenario, 11)
    log = simulate(scene)
    slips = slipping(log, scenario.robot)
    assert 0.01 < slips.mean() < 0.5
    where = np.array([scene.ground.mu_at(x, y) for x, y in log.positions[slips, :2]])
    assert (where < 0.8).mean() > 0.6  # the base may stand beside the patch that a wheel is on


def test_more_markers_than_ids_are_refused() -> None:
    with pytest.raises(ValueError, match="60 markers, but DICT_4X4_50 has 50"):
        Markers(count=60)


def test_suite_resumes_and_skips_what_is_done(tmp_path: Path) -> None:
    short = tmp_path / "short.yaml"
    short.write_text(
        "entries:\n  - scenario: {name: a, duration_s: 0.5}\n"
        "    runs: [{split: train, seed: 1}, {split: test, seed: 2}]\n",
        encoding="utf-8",
    )
    todo = jobs(load_suite(short))
    record(todo[0].scenario, todo[0].seed, tmp_path / "out" / todo[0].folder, camera=False)
    killed = tmp_path / "out" / "a" / ".test_2.partial-of-a-killed-recorder"
    killed.mkdir(parents=True)
    assert record_suite(todo, tmp_path / "out", camera=False, workers=1) == 1
    assert not killed.exists()
    assert (tmp_path / "out" / "a" / "test_2" / "bag" / "metadata.yaml").is_file()
    assert record_suite(todo, tmp_path / "out", camera=False, workers=1) == 0


def test_suite_names_the_wrong_key(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("name: a\nrobot: {radius: 3}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"robot\.radius"):
        load_suite(wrong)
    with refusal(ConfigError, tmp_path / "missing.yaml", cause=FileNotFoundError):
        load_suite(tmp_path / "missing.yaml")
    with pytest.raises(ConfigError, match=r"'nothing'.*\bcalibrated\b"):
        SUITE.find("nothing")


def test_figures_are_drawn(tmp_path: Path) -> None:
    scenario = SUITE.find("patches").model_copy(update={"duration_s": 2.0})
    record(scenario, 1, tmp_path / "run", camera=False)
    paths = draw(tmp_path / "run", tmp_path / "pictures")
    assert [p.name for p in paths] == ["trajectory.png", "control.png", "slip.png"]
    for path in paths:
        picture = cv2.imread(str(path))
        assert picture.shape[0] > 300
        assert picture.std() > 5
    with pytest.raises(RecordingError, match=r"no scenario\.yaml"):
        draw(tmp_path, tmp_path)
