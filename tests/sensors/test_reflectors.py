"""Reflectors without identity: hits of a scan, their names, the first pose by constellations, what a user is told."""

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
import yaml
from robot_world import points
from typer.testing import CliRunner

from fgloc import Live, se2
from fgloc.calibration.first_settings import first_settings
from fgloc.cli import app
from fgloc.config import Config, GateConfig, config_of, config_of_file
from fgloc.errors import ConfigError, EstimatorError
from fgloc.evaluation.metrics import compute_metrics
from fgloc.frames import yaw_quaternion
from fgloc.recording.info import inspect
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.base import Context
from fgloc.sensors.equipment import LandmarkSensor
from fgloc.sensors.maps import write_map
from fgloc.sensors.reflectors import Reflectors, ReflectorsConfig, ScanEvent, check
from fgloc.types import Landmark, LandmarkMap
from fgloc_datasets.bag import BagWriter

START_NS, TICK_NS = 1_700_000_000_000_000_000, 50_000_000
ROOM = ((-6, -5), (6.5, -4), (5, 5.5), (-5.5, 6), (0.5, 7), (1.5, -6.5), (-7, 1), (7.5, 1.5), (-2, -4), (3, 3.5))
MOUNTED = (0.4, 0.1, 0.3)  # of the scanner in the base
BEAMS, DARK, BRIGHT = 1440, 100.0, 900.0
SETTINGS = {"reflectors": {"min_intensity": 500.0, "pose": list(MOUNTED)}}


@dataclass(frozen=True)
class Drive:
    """A robot that goes an eight among reflectors, in scans of which some bright spots are of something else.

    Attributes:
        places: of the reflectors.
        unmapped: further ones, which the map lacks.
        seconds: length.
        start: first pose.
        carried_s: when the robot is somewhere else all at once; its wheels do not notice.
        turn_s: that the scanner takes for a turn.
        placed: whether tf has the place of the scanner.
        intensities: whether the scans have any.
        stretch: of its ranges.
        turned_rad: of its directions, to the left.
    """

    places: tuple[tuple[float, float], ...] = ROOM
    unmapped: tuple[tuple[float, float], ...] = ()
    seconds: float = 20.0
    start: tuple[float, float, float] = (1.0, -2.0, 2.0)
    carried_s: float = math.inf
    turn_s: float = 0.0
    placed: bool = False
    intensities: bool = True
    stretch: float = 1.0
    turned_rad: float = 0.0

    def write(self, folder):
        """Bag of odometry, scans and truth, the map beside it."""
        rng = np.random.default_rng(5)
        pose, odometry = np.array(self.start), np.zeros(3)
        with BagWriter(folder / "bag") as bag:
            if self.placed:
                turned = yaw_quaternion(MOUNTED[2]).tolist()
                bag.static_transform(START_NS, "base_link", "laser", (*MOUNTED[:2], 0.0), turned)
            for k in range(round(self.seconds * 1e9 / TICK_NS)):
                stamp, at_s = START_NS + k * TICK_NS, k * TICK_NS * 1e-9
                v, omega = 0.6, 0.45 * math.copysign(1.0, math.sin(math.tau * at_s / 28.0))
                bag.planar_truth("/truth", stamp, pose)
                bag.odometry("/odom", stamp, odometry.tolist(), (v, omega))
                if k % 4 == 1:
                    self._scan(bag, stamp, pose, (v, 0.0, omega), rng)
                odometry = se2.compose(odometry, np.array([0.05 * v, 0.0, 0.05 * omega]) * rng.normal(1.0, 0.03, 3))
                pose = se2.compose(pose, se2.exp(np.array([0.05 * v, 0.0, 0.05 * omega])))
                if at_s <= self.carried_s < at_s + 1e-9 * TICK_NS:
                    pose = np.array([-3.0, 2.5, -1.0])
        write_map(points(self.places), folder / "map.yaml")
        return folder / "bag"

    def _scan(self, bag, stamp, pose, twist, rng):
        ranges, intensities = rng.uniform(8.0, 9.0, BEAMS), rng.uniform(0.5 * DARK, DARK, BEAMS)
        step = math.tau / BEAMS
        for place in (*self.places, *self.unmapped):
            x, y, _ = se2.between(se2.compose(pose, MOUNTED), (*place, 0.0))
            beam_s = (math.atan2(y, x) + math.pi) / math.tau * self.turn_s
            then = se2.compose(pose, se2.exp(np.multiply(twist, beam_s)))
            x, y, _ = se2.between(se2.compose(then, MOUNTED), (*place, 0.0))
            distance = math.hypot(x, y)
            middle = np.round((math.atan2(y, x) + self.turned_rad + rng.normal(0.0, 0.004) + math.pi) / step)
            seen = np.add(middle, (-1, 0, 1)) % BEAMS
            wide = seen[[0, 1, 2] if distance < 6.0 else [1]].astype(int)
            ranges[wide] = self.stretch * distance + rng.normal(0.0, 0.02)
            intensities[wide] = BRIGHT
        bearings = (-math.pi, math.pi - step)
        shown = intensities if self.intensities else ()
        bag.laser_scan("/scan", stamp, ranges, shown, bearings, beam_s=self.turn_s / BEAMS)


def localized(drive, folder, mode="online", **settings):
    """Result and metrics of one run, held against the truth without any alignment."""
    config = config_of({**SETTINGS, **settings})
    result = run(drive.write(folder), folder / "map.yaml", config, mode)
    return result, compute_metrics(result, config)


def built(landmark_map, frame=lambda name: None, **settings):
    section = ReflectorsConfig(**{"min_intensity": 500.0, **settings})
    return Reflectors.build(Context(config_of({}), section, {}, landmark_map, frame))


def scan(ranges, bright, step_s=0.0):
    """A turn of a scanner of 360 beams from -pi on."""
    measured, intensities = np.full(360, np.nan), np.zeros(360)
    for beam, distance in ranges.items():
        measured[beam] = distance
    intensities[list(bright)] = BRIGHT
    return ScanEvent(1_000, 1_000, "/scan", "laser", -math.pi, math.radians(1.0), step_s, measured, intensities)


# --- Hits of one scan -------------------------------------------------------------------------------------------------


def test_bright_beams_next_to_each_other_are_one_hit():
    hits = list(
        built(points([(1, 1)])).measure(scan({268: 3.0, 270: 3.02, 272: 3.04, 90: 5.0, 91: 4.0}, (268, 270, 272, 90)))
    )
    assert [(round(m.range_m, 3), round(m.bearing_rad, 3)) for m in hits] == [(5.0, -1.571), (3.02, 1.571)]
    assert all(m.unnamed and m.row_id == -1 for m in hits)


def test_a_spot_across_the_first_beam_is_one_hit_and_a_wide_one_is_none():
    sensor = built(points([(1, 1)]))
    (m,) = sensor.measure(scan({0: 2.0, 359: 2.0}, (0, 359)))
    assert abs(m.bearing_rad) == pytest.approx(math.pi, abs=0.02)
    wall = dict.fromkeys(range(100, 120), 2.0)
    assert not list(sensor.measure(scan(wall, wall)))
    [note] = [note for note in sensor.notes if "reflectors.size_m" in note]
    assert note.startswith("1 ")


def test_hits_are_moved_to_the_base_and_have_the_time_of_their_beam():
    event = scan({180: 2.0, 270: 2.0}, (180, 270), step_s=1e-4)
    at_pose = list(built(points([(1, 1)]), pose=(1.0, 0.5, math.pi / 2), radius_m=0.1).measure(event))
    np.testing.assert_allclose([m.point for m in at_pose], [[1.0, 2.6], [-1.1, 0.5]], atol=1e-9)
    assert [m.stamp_ns for m in at_pose] == [1_000 + 18_000_000, 1_000 + 27_000_000]
    assert {m.scan_ns for m in at_pose} == {1_000}
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    assert [round(m.point[1], 6) for m in built(points([(1, 1)]), lambda name: upside_down).measure(event)] == [
        0.0,
        -2.0,
    ]
    unplaced = built(points([(1, 1)]))
    assert len(list(unplaced.measure(event))) == 2
    assert "'laser'" in unplaced.notes[0]
    assert "reflectors.pose" in unplaced.notes[0]


def test_a_scan_that_is_bright_all_over_is_not_used():
    sensor = built(points([(1, 1)]))
    every = dict.fromkeys(range(0, 360, 4), 20.0)
    assert not list(sensor.measure(scan(every, every)))
    assert "raise reflectors.min_intensity" in sensor.notes[-1]


def test_checks_say_what_is_wrong_with_a_scan():
    good = scan({1: 2.0}, (1,))
    assert check(good, GateConfig()) is good
    assert check(replace(good, intensities=np.zeros(0)), GateConfig()) == "no_intensities"
    assert check(replace(good, intensities=np.zeros(3)), GateConfig()) == "malformed"
    assert check(replace(good, step_rad=math.nan), GateConfig()) == "non_finite"
    assert check(replace(good, step_s=1.0), GateConfig()) == "beam_time"
    assert check(replace(good, first_rad=-180.0), GateConfig()) == "bearing_bound"


def test_without_a_map_nothing_can_name_a_hit():
    sensor = LandmarkSensor(config_of({}), None, None, None)
    assert not sensor.known(built(points([(1, 1)])).measure(scan({180: 2.0}, (180,))))
    assert sensor.rejections == {"reflectors.unknown_id": 1}


def test_a_map_without_points_is_refused():
    marker = Landmark(1, np.zeros(3), np.diag([-1.0, 1.0, -1.0]), 0.2)
    with pytest.raises(ConfigError, match="no points"):
        built(LandmarkMap({1: marker}))
    assert built(None) is None
    assert built(points([(1, 1)]), min_intensity=None) is None


# --- Whole runs -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mode", "kind"), [("batch", "fixed_lag"), ("online", "fixed_lag"), ("online", "ekf")])
def test_the_first_pose_is_found_and_held(tmp_path, mode, kind):
    result, metrics = localized(Drive(turn_s=0.1), tmp_path, mode, estimator={"kind": kind})
    assert result.first_pose_s < 3.0
    assert metrics.ate_rmse_m < 0.03
    assert 0.2 < metrics.nees_over_3 < 3.0
    assert result.counts["reflectors"] > 500
    assert not result.rejections


def test_motion_within_a_turn_of_the_scanner_is_taken_out(tmp_path):
    """0.6 m/s for 0.2 s are 0.12 m from the first beam to the last."""
    result, metrics = localized(Drive(turn_s=0.2), tmp_path)
    assert metrics.ate_rmse_m < 0.03
    assert abs(result.installation["sightings.time_offset_s"][0]) < 0.03


def test_what_a_run_finds_of_the_scanner_calibrates_the_next_one(tmp_path):
    """A scanner at the base that reports 3 % too much, turned by 2°."""
    drive = Drive(stretch=1.03, turned_rad=0.035)
    result, _ = localized(drive, tmp_path / "first", "batch")
    scale, bearing = (result.installation[f"sightings.{name}"] for name in ("range_scale", "bearing_offset_rad"))
    assert scale[0] == pytest.approx(1 / 1.03, abs=0.012)
    landmarks = {"range_scale": scale[0], "bearing_bias_rad": bearing[0]}
    again, metrics = localized(drive, tmp_path / "again", "batch", landmarks=landmarks)
    assert abs(again.installation["sightings.range_scale"][0] - 1.0) < 0.5 * abs(scale[0] - 1.0)
    assert abs(again.installation["sightings.bearing_offset_rad"][0]) < 0.5 * abs(bearing[0])
    assert metrics.ate_rmse_m < 0.03


def test_bright_things_that_the_map_lacks_are_rejected(tmp_path):
    drive = Drive(unmapped=((-1.0, 3.0), (4.0, 0.5), (-4.0, -1.0)))
    result, metrics = localized(drive, tmp_path, "batch")
    assert metrics.ate_rmse_m < 0.03
    assert result.rejections["reflectors.unmatched"] > 150
    assert {d.landmark_id for d in result.decisions if d.reason == "unmatched"} == {-1}


def test_in_a_dense_map_no_hit_gets_a_wrong_name(tmp_path):
    """Eighty beacons a metre and a half apart, of which the scanner sees some, beside five things that are none."""
    rng = np.random.default_rng(8)
    places = rng.uniform(-8.0, 8.0, (80, 2))
    seen, strange = tuple(map(tuple, places[:12])), tuple(map(tuple, rng.uniform(-6.0, 6.0, (5, 2))))
    bag = Drive(seen, strange, seconds=16.0).write(tmp_path)
    write_map(points(places), tmp_path / "dense.yaml")
    result = run(bag, tmp_path / "dense.yaml", config_of(SETTINGS), "batch")
    assert compute_metrics(result, config_of(SETTINGS)).ate_rmse_m < 0.03
    used = [d.landmark_id for d in result.decisions if d.kind == "reflectors" and not d.reason]
    assert len(used) > 400
    assert sum(i >= 12 for i in used) < 0.01 * len(used)


def test_a_hit_that_two_beacons_explain_is_rejected(tmp_path):
    """The map has a second beacon 7 cm beside one of them, which the scanner does not see apart."""
    drive = Drive()
    bag = drive.write(tmp_path)
    x, y = ROOM[0]
    twins = points([*ROOM, (x + 0.05, y - 0.05)])
    write_map(twins, tmp_path / "twins.yaml")
    result = run(bag, tmp_path / "twins.yaml", config_of(SETTINGS), "online")
    assert compute_metrics(result, config_of(SETTINGS)).ate_rmse_m < 0.03
    assert result.rejections["reflectors.ambiguous"] > 50
    used = {d.landmark_id for d in result.decisions if d.kind == "reflectors" and not d.reason}
    assert used == set(range(1, len(ROOM)))


def test_a_symmetric_constellation_starts_nowhere(tmp_path):
    """A rectangle of reflectors looks the same from the other side."""
    rectangle = ((-6.0, -4.0), (6.0, -4.0), (6.0, 4.0), (-6.0, 4.0))
    with pytest.raises(EstimatorError, match=r"estimator\.initial_pose"):
        localized(Drive(rectangle, seconds=8.0), tmp_path)
    result, metrics = localized(
        Drive(rectangle, seconds=8.0), tmp_path / "told", estimator={"initial_pose": [1.0, -2.0, 2.0]}
    )
    assert metrics.ate_rmse_m < 0.05
    assert result.counts["reflectors"] > 100


def test_another_place_of_the_same_kind_starts_nowhere(tmp_path):
    """None of the reflectors is in the map."""
    elsewhere = tuple((0.8 * y + 1.0, x - 2.0) for x, y in ROOM)
    bag = Drive(seconds=8.0).write(tmp_path)
    write_map(points(elsewhere), tmp_path / "other.yaml")
    with pytest.raises(EstimatorError, match=r"estimator\.initial_pose"):
        run(bag, tmp_path / "other.yaml", config_of(SETTINGS), "online")


def test_a_wrong_first_pose_is_said(tmp_path):
    result, _ = localized(Drive(seconds=10.0), tmp_path, estimator={"initial_pose": [3.0, 1.0, 0.0]})
    assert [d for d in result.decisions if d.reason == "contradicts initial_pose"]
    assert [f for f in result.findings if "estimator.initial_pose" in f.text]
    assert not result.counts.get("reflectors")


def test_a_robot_that_was_carried_away_is_found_again(tmp_path):
    result, _ = localized(Drive(carried_s=8.0), tmp_path)
    truth = result.truth
    end = se2.interpolate(truth.stamps_ns, truth.poses, result.trajectory.stamps_ns[-1:])[0]
    assert np.hypot(*(result.trajectory.poses[-1] - end)[:2]) < 0.05
    assert [f for f in result.findings if "jumped by" in f.text]


# --- What a user is told ----------------------------------------------------------------------------------------------


def info(bag, config=None):
    given = [] if config is None else ["--config", str(config)]
    done = CliRunner().invoke(app, ["info", str(bag), *given])
    return done.stdout


def test_info_says_what_is_missing(tmp_path):
    bag = Drive(seconds=2.0).write(tmp_path)
    config = tmp_path / "robot.yaml"
    [unused] = [f.text for f in inspect(bag, Config()).found if f.code == "recording.unused"]
    assert "reflectors.min_intensity" in unused
    assert unused in info(bag)
    assert not {f.code for f in inspect(bag, config_of(SETTINGS)).found} & {"recording.unused", "place.unbounded"}
    config.write_text("reflectors: {min_intensity: 5000}")
    assert re.search(r"/scan: .*\b900\b", info(bag, config))
    dark = Drive(seconds=2.0, intensities=False).write(tmp_path / "dark")
    assert re.search(r"/scan: 10 of 10\b", info(dark, config))


@pytest.mark.parametrize(
    ("has_map", "placed", "used"), [(True, True, True), (True, False, False), (False, True, False)]
)
def test_init_writes_the_section_where_map_and_mounting_are_known(tmp_path, has_map, placed, used):
    bag = Drive(seconds=3.0, placed=placed).write(tmp_path)
    if not has_map:
        (tmp_path / "map.yaml").unlink()
    made = first_settings(bag)
    section = config_of_file(yaml.safe_load(made.text)).reflectors
    assert (section.min_intensity is not None) == used
    if used:
        assert DARK < section.min_intensity < BRIGHT
    else:
        assert "# min_intensity: " in made.text
    assert bool([text for text in made.missing if "reflectors.pose" in text]) == (has_map and not placed)


def test_init_without_intensities_writes_nothing(tmp_path):
    made = first_settings(Drive(seconds=2.0, intensities=False).write(tmp_path))
    assert "reflectors" not in made.text


def test_without_a_map_the_run_is_dead_reckoning(tmp_path):
    bag = Drive(seconds=4.0).write(tmp_path)
    result = run(bag, None, config_of(SETTINGS), "online")
    assert len(result.trajectory) > 10
    assert not result.counts.get("reflectors")


def test_scans_are_read_only_if_reflectors_are_asked_for(tmp_path):
    """Most robots have a laser scanner, and few have reflectors."""
    bag = Drive(seconds=1.0).write(tmp_path)
    for settings, roles in (({}, {"odometry", "truth"}), (SETTINGS, {"odometry", "truth", "reflectors"})):
        with open_recording(bag, config_of(settings).recording) as recording:
            assert set(recording.roles) == roles
    off = {**SETTINGS, "recording": {"topics": {"reflectors": "none"}}}
    with open_recording(bag, config_of(off).recording) as recording:
        assert "reflectors" not in recording.roles


def test_a_live_run_gives_the_poses_of_a_replay(tmp_path):
    bag, config = Drive(seconds=6.0).write(tmp_path), config_of(SETTINGS)
    expected = run(bag, tmp_path / "map.yaml", config, "online", check=False)
    made = []
    with open_recording(bag, config.recording) as recording:
        events, roles = list(recording.events()), recording.roles
    with Live(config, tmp_path / "map.yaml", roles=roles) as live:
        live.subscribe(made.append)
        for event in events:
            live.push(event)
        assert live.wait(60.0)
    found = {e.stamp_ns: e.pose for e in made}
    poses = dict(zip(expected.trajectory.stamps_ns.tolist(), expected.trajectory.poses, strict=True))
    assert len(found.keys() & poses.keys()) > 15
    assert all((found[stamp] == poses[stamp]).all() for stamp in found.keys() & poses.keys())
