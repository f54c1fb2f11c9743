"""The robot that drives itself: paths, the follower, failing sensors, and the closed loop."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks import follow as benchmark
from benchmarks.follow import Driven
from fgloc import run, se2
from fgloc.config import Config, load_config
from fgloc.errors import ConfigError
from fgloc.recording.reader import open_recording
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import LandmarkMap
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.control import Driver
from fgloc_datasets.sim.drives import Command
from fgloc_datasets.sim.following.cases import CASES, draw_drives, drive_of, table
from fgloc_datasets.sim.following.loop import (
    PROCESSING_S,
    Arrivals,
    Drive,
    FailingSensors,
    Followed,
    Written,
    follow,
    read_failures,
)
from fgloc_datasets.sim.following.pursuit import (
    BUNDLED,
    Curve,
    Pursuit,
    PursuitSettings,
    State,
    WaypointPath,
    load_path,
)
from fgloc_datasets.sim.physics import Simulation, make_scene, simulate
from fgloc_datasets.sim.scenario import Camera, Gnss, Scenario, Uwb, World
from fgloc_datasets.sim.sensors import EPOCH_NS, stamp_ns, streams

HOOK = WaypointPath(name="hook", speed_m_s=0.4, waypoints=((-0.6, 0), (-0.3, 0), (0, 0), (0.3, 0.1), (0.4, 0.4)))
ROOM = Scenario(
    name="room", world=World(size_m=(5.0, 4.0)), camera=Camera(rate_hz=5), installation={"marker_position_m": 0.005}
)  # fmt: skip
DARK = "{kind: dropout, sensor: camera, when: {intervals: [[2.5, 20]]}}"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("followed") / "run"


@pytest.fixture(scope="module")
def followed(folder: Path) -> Followed:
    """By fgloc, with the corners of markers."""
    return follow(Drive(ROOM, HOOK, "fgloc", seed=3, sees="corners"), folder)


# --- Paths ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(p.stem for p in BUNDLED.glob("*.yaml")))
def test_bundled_paths_pass_their_waypoints_and_keep_off_the_walls(name: str) -> None:
    path = load_path(name)
    curve = Curve(path)
    assert path.name == name
    world = World(size_m=(8.0, 6.0)) if name == "ramp" else World()  # that of the scenario ramp_and_humps
    keep_off = world.keep_off_m - 0.2
    assert (np.abs(curve.points).max(axis=0) < 0.5 * np.array(world.size_m) - keep_off).all()
    np.testing.assert_allclose(curve.points[curve.at_waypoints], path.waypoints, atol=1e-12)


@pytest.mark.parametrize(("name", "spacing"), [("grid30", 0.3), ("grid20", 0.2)])
def test_grids_are_spaced_as_they_are_named(name: str, spacing: float) -> None:
    gaps = np.hypot(*np.diff(np.array(load_path(name).waypoints), axis=0).T)
    np.testing.assert_allclose(gaps, spacing)


def test_a_row_of_waypoints_is_a_straight_line_and_distances_are_from_it() -> None:
    curve = Curve(WaypointPath(name="row", waypoints=((0, 0), (0.3, 0), (0.6, 0), (0.9, 0))))
    np.testing.assert_allclose(curve.points[:, 1], 0.0, atol=1e-15)
    np.testing.assert_allclose(curve.distances(np.array([(0.45, 0.02), (1.0, 0.0), (0.1, -0.3)])), (0.02, 0.1, 0.3))


def test_waypoints_at_any_distance_make_a_curve() -> None:
    x = (-2.0, -1.6, -1.2, -0.8, -0.4, 0.0, 0.4, 0.805)
    curve = Curve(WaypointPath(name="row", waypoints=tuple((at, 0.3 * at) for at in x)))
    assert (np.diff(curve.along_m) > 1e-3).all()
    np.testing.assert_allclose(curve.points[curve.at_waypoints, 0], x, atol=1e-12)
    np.testing.assert_allclose(curve.distances(curve.points), 0.0, atol=1e-9)


def test_wrong_paths_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'grid'.* eight, grid20, grid30"):
        load_path("grid")
    file = tmp_path / "twice.yaml"
    file.write_text("{name: twice, waypoints: [[0, 0], [0, 0], [1, 0]]}", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"\b0 and 1\b.*\(0\.0, 0\.0\)"):
        load_path(str(file))


# --- The follower -----------------------------------------------------------------------------------------------------


def driven(pursuit: Pursuit, start: tuple[float, float, float], seconds: float = 60.0) -> np.ndarray:
    """Poses of a robot that does at once what it is told."""
    poses = [np.array(start)]
    for k in range(round(seconds / 0.05)):
        v, omega = pursuit.command(0.05 * k, poses[-1])
        poses.append(se2.compose(poses[-1], se2.exp((0.05 * v, 0.0, 0.05 * omega))))
        if pursuit.state is State.ARRIVED:
            break
    return np.array(poses)


@pytest.mark.parametrize("name", ["grid20", "eight"])
def test_paths_are_followed_to_their_end_also_where_they_cross_themselves(name: str) -> None:
    path = load_path(name)
    curve = Curve(path)
    pursuit = Pursuit(curve, path.speed_m_s)
    poses = driven(pursuit, path.start)
    assert pursuit.state is State.ARRIVED
    assert curve.distances(poses[:, :2]).mean() < 0.006
    nearest = [np.hypot(*(poses[:, :2] - w).T).min() for w in path.waypoints]
    assert max(nearest) < 0.03


def test_a_robot_that_looks_away_turns_on_the_spot_first() -> None:
    pursuit = Pursuit(Curve(HOOK), 0.4)
    assert pursuit.command(0.0, np.array([-0.6, 0.0, math.pi - 0.1]))[0] == 0.0
    assert pursuit.command(0.1, np.array([-0.6, 0.0, math.pi - 0.1]))[1] < -1.0


def test_a_robot_that_does_not_know_its_place_well_turns_round_once() -> None:
    pose, pursuit = np.array([-0.6, 0.0, 0.0]), Pursuit(Curve(HOOK), 0.4)
    turned, states = 0.0, []
    for k in range(400):
        v, omega = pursuit.command(0.05 * k, pose, 0.02)
        states.append(pursuit.state)
        if pursuit.state is State.LOOKING:
            assert v == 0.0
            turned += 0.05 * omega
        pose = se2.compose(pose, se2.exp((0.05 * v, 0.0, 0.05 * omega)))
    assert turned == pytest.approx(math.tau, abs=0.05)
    assert states.index(State.FOLLOWING) == states.count(State.LOOKING) < 400  # once, and before all else
    sure = Pursuit(Curve(HOOK), 0.4)
    sure.command(0.0, np.array([-0.6, 0.0, 0.0]), 0.005)
    assert sure.state is State.FOLLOWING


def test_a_robot_whose_tyres_stick_is_told_to_turn_more() -> None:
    off = np.array([-0.6, 0.02, 0.0])
    stuck, follows = (Pursuit(Curve(HOOK), 0.4, PursuitSettings(rate_gain=g)) for g in (0.5, 0.0))
    stuck.command(0.0, off)
    follows.command(0.0, off)
    wanted = follows.command(0.05, off)[1]
    assert wanted < 0.0
    assert stuck.command(0.05, off)[1] == pytest.approx(1.5 * wanted)


def test_an_uncertain_pose_slows_the_robot_and_a_lost_one_stops_it_until_it_is_found() -> None:
    settings = PursuitSettings(slow_sigma_m=0.1, stop_sigma_m=0.3, search_after_s=2.0, look_sigma_m=1.0)
    pose, pursuit = np.array([-0.3, 0.0, 0.0]), Pursuit(Curve(HOOK), 0.4, settings)
    sure, slow, lost = (pursuit.command(0.1, pose, sigma) for sigma in (0.05, 0.2, 0.31))
    assert 0.0 < slow[0] == pytest.approx(0.5 * sure[0])
    assert lost == (0.0, 0.0)
    assert pursuit.state is State.STOPPED
    assert pursuit.command(1.0, None) == (0.0, 0.0)
    v, omega = pursuit.command(2.2, None)
    assert (v, pursuit.state) == (0.0, State.SEARCHING)
    assert omega == settings.search_omega
    assert pursuit.command(2.3, pose, 0.05)[0] > 0.0
    assert pursuit.state is State.FOLLOWING


# --- Failing sensors --------------------------------------------------------------------------------------------------


def imu(received_s: float) -> ImuEvent:
    at = stamp_ns(received_s)
    return ImuEvent(at, at, "/imu", "", np.zeros(3), np.zeros(3), np.zeros((3, 3)))


def failing(*texts: str) -> FailingSensors:
    return FailingSensors(read_failures(texts), Config(), LandmarkMap({}), 60.0, 1)


def test_failures_drop_events_and_hold_them_back_no_longer_than_they_say() -> None:
    sensors = failing(
        "{kind: dropout, sensor: imu, when: {intervals: [[1, 2]]}}", "{kind: latency, sensor: imu, delay_s: 0.1}"
    )
    out = []
    for k in range(1, 60):
        now = 0.05 * k
        events = list(sensors.after([imu(now - 0.01)], stamp_ns(now)))
        assert all(e.received_ns <= stamp_ns(now) for e in events)
        out += [(now, (e.stamp_ns - EPOCH_NS) * 1e-9) for e in events]
    waited = np.array(out)
    np.testing.assert_allclose(waited[:, 0] - waited[:, 1], 0.11, atol=1e-6)
    assert not ((waited[:, 1] >= 1.0) & (waited[:, 1] < 2.0)).any()
    assert len(out) == 59 - 20 - 2


@pytest.mark.parametrize("kind", ["kidnap", "wrong_ids", "truncated"])
def test_failures_that_only_a_recording_can_have_are_refused(kind: str) -> None:
    with pytest.raises(ConfigError, match=f"failure '{kind}'"):
        failing(f"{{kind: {kind}, when: {{intervals: [[1, 2]]}}}}" if kind == "kidnap" else f"{{kind: {kind}}}")
    with pytest.raises(ConfigError, match="--failure"):
        read_failures(["{kind: nonsense}"])


# --- The loop ---------------------------------------------------------------------------------------------------------


class Watched:
    """Drives as the scenario says, and has the messages written as they come."""

    def __init__(self, driver: Driver, written: Written) -> None:
        self._driver, self._written = driver, written

    def command(self, t: float, pose: tuple[float, float, float]) -> Command | None:
        self._written.until(stamp_ns(t))
        return self._driver.command(t, pose)


def test_messages_that_are_written_while_the_robot_drives_say_the_same(tmp_path: Path) -> None:
    scenario = ROOM.model_copy(update={"duration_s": 4.0, "uwb": Uwb(), "gnss": Gnss()})
    scene = make_scene(scenario, 5)
    with BagWriter(tmp_path / "at_the_end") as bag:
        Written(streams(scene, simulate(scene), bag, "corners")).until(stamp_ns(9.0))
    scene = make_scene(scenario, 5)
    simulation = Simulation(scene)
    with BagWriter(tmp_path / "as_they_come") as bag:
        written = Written(streams(scene, simulation.log, bag, "corners"))
        simulation.run(Watched(Driver(scenario, 5), written))
        written.until(stamp_ns(9.0))
    events = []
    for name in ("at_the_end", "as_they_come"):
        with open_recording(tmp_path / name, Config().recording) as recording:
            events.append(list(recording.events()))
    assert len(events[0]) == len(events[1]) > 900
    for first, second in zip(*events, strict=True):
        assert (first.stamp_ns, first.received_ns, first.topic) == (second.stamp_ns, second.received_ns, second.topic)
        if isinstance(first, ImuEvent):
            np.testing.assert_allclose(first.angular_velocity, second.angular_velocity, atol=1e-12)
            np.testing.assert_allclose(first.linear_acceleration, second.linear_acceleration, atol=1e-9)
        if isinstance(first, OdometryEvent):
            np.testing.assert_array_equal(first.position, second.position)
        if isinstance(first, CornersEvent):
            assert [s.landmark_id for s in first.sightings] == [s.landmark_id for s in second.sightings]


def test_what_the_camera_sees_arrives_after_it_was_processed(folder: Path, followed: Followed) -> None:
    arrivals = Arrivals(Config())
    with BagWriter(folder.parent / "one", tap=arrivals.take) as bag:
        bag.corners("/camera/corners", 1_000, {3: np.zeros((4, 2))}, received_ns=2_000)
    assert list(arrivals.until(round(1e9 * PROCESSING_S) + 1_999)) == []
    (event,) = arrivals.until(round(1e9 * PROCESSING_S) + 2_000)
    assert isinstance(event, CornersEvent)
    np.testing.assert_allclose(event.sightings[0].corners_px, 0.0)


def test_the_robot_follows_by_its_estimated_pose(folder: Path, followed: Followed) -> None:
    score = followed.score
    assert score.arrived
    assert score.reached == 1.0
    assert score.track_mm < 20.0
    assert score.pose_mm is not None
    assert 0.1 < score.pose_mm < 30.0
    told = yaml.safe_load((folder / "following.yaml").read_text(encoding="utf-8"))
    assert told["score"]["track_mm"] == score.track_mm
    assert len((folder / "following.csv").read_text(encoding="utf-8").splitlines()) == len(followed.times_s) + 1


def test_the_recording_of_a_drive_is_one_like_any_other(folder: Path, followed: Followed) -> None:
    result = run(folder / "bag", folder / "map.yaml", load_config(folder / "robot.yaml"), "online")
    poses = np.array([result.trajectory.interpolate(stamp_ns(t)) for t in followed.times_s[60:-10]])
    errors = np.hypot(*(poses[:, :2] - followed.true_poses[60:-10, :2]).T)
    assert errors.mean() < 0.02


def test_the_same_drive_again_is_the_same(followed: Followed) -> None:
    again = follow(Drive(ROOM, HOOK, "fgloc", seed=3, sees="corners"))
    np.testing.assert_array_equal(again.poses, followed.poses)
    np.testing.assert_array_equal(again.true_path, followed.true_path)


def test_sensors_that_fail_change_the_drive_but_not_the_recording_of_what_they_measured(tmp_path: Path) -> None:
    dark = follow(Drive(ROOM, HOOK, "fgloc", 3, read_failures([DARK]), "corners"), tmp_path / "dark")
    assert dark.sigmas_m[-1] > 0.005
    with open_recording(tmp_path / "dark" / "bag", Config().recording) as recording:
        seen = [e for e in recording.events() if isinstance(e, CornersEvent) and e.received_ns > stamp_ns(2.5)]
    assert any(e.sightings for e in seen)


@pytest.mark.parametrize("pose", ["truth", "wheels", "learned"])
def test_other_poses_guide_the_robot_too(pose: str, tmp_path: Path) -> None:
    drive = Drive(ROOM, HOOK, pose, seed=3, sees="nothing")  # type: ignore[arg-type]
    done = follow(drive)
    assert done.score.arrived
    assert done.score.track_mm < (8.0 if pose == "truth" else 40.0)
    assert (done.score.pose_mm == 0.0) == (pose == "truth")
    draw_drives({"hook": (drive, done)}, tmp_path / "hook.png", close=False)
    assert (tmp_path / "hook.png").stat().st_size > 5_000
    assert f"{done.score.track_mm:.1f} mm" in table({"hook": (drive, done)})


def test_fgloc_cannot_guide_a_robot_without_camera() -> None:
    with pytest.raises(ConfigError, match=r"'room'.* fgloc"):
        follow(Drive(ROOM.model_copy(update={"camera": None}), HOOK, "fgloc"))


# --- The benchmark ----------------------------------------------------------------------------------------------------


def test_rows_of_the_benchmark_are_means_and_ratios_of_means() -> None:
    rows = {w.id: w for w in benchmark.wanted()}
    of_uneven_ground = {"slope", "rough", "level"}  # rows of their own, by --ground
    assert {case for w in rows.values() for case, _ in w.needs} == set(CASES) - of_uneven_ground
    fgloc, truth = [Driven(6.0), Driven(10.0)], [Driven(4.0), Driven(4.0)]
    row = rows["ice.track_over_truth"].row("x", [fgloc, truth])
    assert (row.value, row.spread, row.n) == (2.0, 0.5, 2)
    assert rows["flat30.track_mm"].row("x", [fgloc]).value == 8.0


def test_a_moved_marker_is_one_that_the_robot_sees_at_its_start() -> None:
    drive = drive_of("moved", "fgloc", 141)
    (failure,) = drive.failures
    (moved,) = failure.ids  # type: ignore[attr-defined]
    scene = make_scene(replace(drive).placed(), 141)
    x, y, yaw = drive.path.start
    at = scene.landmarks.landmarks[moved].position
    assert abs(math.atan2(at[1] - y, at[0] - x) - yaw) < 0.4
