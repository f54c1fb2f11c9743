"""Sensors of other packages, by those of examples/: found, configured, validated, fused, and made to fail."""

import importlib
import json
import math
import os
import pickle
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from source_roots import PYTHONPATH

from benchmarks.equal_cases import Drive, example_sensors
from fgloc import se2
from fgloc.config import Config, GateConfig, config_of, load_config
from fgloc.errors import ConfigError
from fgloc.evaluation.metrics import compute_metrics
from fgloc.extensions import outside_sensors
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.recording.info import inspect
from fgloc.runner import run
from fgloc.sensors.base import Context, with_values
from fgloc.sensors.gyro import Gyro
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import LandmarkMap
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.record import record
from fgloc_datasets.sim.scenario import Gnss, Scenario, Uwb
from fgloc_datasets.sim.sensors import geodetic

SECONDS = 14.0
ANCHORS = {1: (0.0, 0.0, 2.0), 2: (6.0, 0.0, 2.2), 3: (6.0, 5.0, 1.8)}
GATE = GateConfig()


@pytest.fixture(scope="module")
def folders():
    with example_sensors() as found:
        yield found


@pytest.fixture(scope="module")
def uwb(folders):
    return importlib.import_module("fgloc.sensors.uwb")


@pytest.fixture(scope="module")
def gnss(folders):
    return importlib.import_module("fgloc.sensors.gnss")


@pytest.fixture(scope="module")
def recording(folders, tmp_path_factory):
    """Both sensors, a tenth of the ranges and a twentieth of the positions wrong, no camera."""
    scenario = Scenario(
        name="radio",
        duration_s=SECONDS,
        camera=None,
        uwb=Uwb(nlos_share=0.1),
        gnss=Gnss(multipath_share=0.05, multipath_s=0.5),
    )
    folder = tmp_path_factory.mktemp("radio")
    record(scenario, 4, folder)
    return folder


def only(config, used):
    """The configuration with one of the two sensors."""
    off = {name: "none" for name in ("uwb", "gnss") if name != used}
    topics = config.recording.topics.model_copy(update=off)
    return config.model_copy(update={"recording": config.recording.model_copy(update={"topics": topics})})


def context(section, landmark_map=None, frame=lambda name: None):
    return Context(config_of({}), section, {}, landmark_map, frame)


def range_of(uwb, anchors_sigma_m=0.0, **fields):
    config = uwb.UwbConfig(anchors=ANCHORS, anchors_sigma_m=anchors_sigma_m, tag=(0.1, -0.05, 0.3))
    event = uwb.UwbEvent(1_000, 1_000, "/uwb", anchor=2, range_m=4.0)
    (m,) = uwb.Uwb.build(context(config)).measure(replace(event, **fields))
    return m


def position_of(gnss, config, **fields):
    event = gnss.GnssEvent(1_000, 1_000, "/fix", "antenna", 48.1372, 11.5762, 519.0, np.diag([0.04, 0.01]), True)
    (m,) = gnss.Gnss.build(context(config)).measure(replace(event, **fields))
    return m


# --- Found and configured ---------------------------------------------------------------------------------------------


def test_sections_and_roles_come_from_the_entry_points(uwb, tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(
        "recording: {topics: {uwb: /ranges}, stamp_offset_s: {uwb: 0.1}}\nuwb: {anchors: {7: [1, 2, 3]}, sigma_m: 0.2}"
    )
    config = load_config(path)
    assert config.uwb.anchors == {7: (1.0, 2.0, 3.0)}
    assert config.recording.topics.given("uwb") == "/ranges"
    assert config.recording.topics.given("gnss") is None
    again = pickle.loads(pickle.dumps(config))
    assert again == config
    assert isinstance(config, Config)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("uwb: {sigma: 0.1}", "uwb.sigma: .*'sigma_m'"),
        ("uwb: {sigma_m: -1}", "uwb.sigma_m"),
        ("recording: {topics: {uwbb: /x}}", "uwbb: .*'uwb'"),
        ("recording: {received_stamps: [lidar]}", "lidar"),
    ],
)
def test_wrong_settings_of_a_sensor_are_named(folders, tmp_path, text, named):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=named):
        load_config(path)


def test_without_the_package_its_section_is_an_unknown_key(folders, monkeypatch, tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text("uwb: {sigma_m: 0.1}")
    monkeypatch.setattr("fgloc.config.outside_sensors", lambda: ())
    with pytest.raises(ConfigError, match=r"robot\.yaml:1: uwb: "):
        load_config(path)


@pytest.mark.parametrize(
    ("module", "wrong"),
    [
        ("raise RuntimeError('no driver')", "RuntimeError: no driver.* broken"),
        ("class Sensor: name = 'lidar'", "Config, streams"),
        (
            "class Sensor: name, streams, optional = 'lidar', (), True; Config = failures = build = measure = None",
            "lacks needs, purpose",
        ),
    ],
)
def test_a_package_that_is_no_sensor_is_named(tmp_path, monkeypatch, module, wrong):
    name = f"broken_sensor_{len(module)}"
    (tmp_path / f"{name}.py").write_text(module)
    info = tmp_path / "broken-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1\n")
    (info / "entry_points.txt").write_text(f"[fgloc.sensors]\nlidar = {name}:Sensor\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    outside_sensors.cache_clear()
    try:
        with pytest.raises(ConfigError, match=wrong):
            config_of({})
    finally:
        monkeypatch.undo()
        outside_sensors.cache_clear()


# --- Measurements -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("which", ["uwb", "gnss"])
def test_jacobians_are_the_residuals_derivatives(uwb, gnss, which, moved):
    origin = (48.137154, 11.576124, 519.0)
    m = range_of(uwb) if which == "uwb" else position_of(gnss, gnss.GnssConfig(origin=origin, antenna=(0.2, -0.1)))
    if moved:
        m = m.compensated(np.array([-0.08, 0.01, 0.05]), 1e-4 * np.eye(3))
    pose = np.array([1.2, 2.3, 0.7])
    _, J = m.residual_at_keyframe(pose)
    for i, d in enumerate(1e-6 * np.eye(3)):
        ahead, _ = m.residual_at_keyframe(se2.compose(pose, se2.exp(d)))
        behind, _ = m.residual_at_keyframe(se2.compose(pose, se2.exp(-d)))
        np.testing.assert_allclose(J[:, i], (ahead - behind) / 2e-6, atol=1e-6)


@pytest.mark.parametrize("values", [(0.04, -0.1), (0.04, -0.1, 0.2, -0.3, 0.15)])
def test_derivatives_by_scale_and_offset_of_ranges_and_the_place_of_the_anchor(uwb, values):
    m = range_of(uwb, 0.1 if len(values) > 2 else 0.0).compensated(np.array([-0.08, 0.01, 0.05]), 1e-4 * np.eye(3))
    pose, values = np.array([1.2, 2.3, 0.7]), np.array(values)
    assert len(m.constants) == len(values)
    _, J, H = m.by_constants_at_keyframe(pose, values)
    for i, d in enumerate(1e-6 * np.eye(len(values))):
        ahead, behind = (m.by_constants_at_keyframe(pose, values + sign * d)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(H[:, i], (ahead - behind) / 2e-6, atol=1e-6)
    for i, d in enumerate(1e-6 * np.eye(3)):
        ahead, behind = (m.by_constants_at_keyframe(se2.compose(pose, se2.exp(s * d)), values)[0] for s in (1.0, -1.0))
        np.testing.assert_allclose(J[:, i], (ahead - behind) / 2e-6, atol=1e-6)


def test_range_is_that_from_the_tag_to_the_anchor(uwb):
    m = range_of(uwb)
    residual, _ = m.residual_at(np.array([1.0, 2.0, math.pi / 2]))
    tag = np.array([1.05, 2.1, 0.3])
    assert residual[0] == pytest.approx(np.linalg.norm(tag - ANCHORS[2]) - 4.0)
    for place in m.places():
        at_base = np.linalg.norm(np.array([*place, 0.3]) - ANCHORS[2])
        assert at_base == pytest.approx(4.0)


def test_only_ranges_that_are_too_long_may_lack_line_of_sight(uwb):
    here = np.array([3.0, 2.0, 0.0])
    long, short = range_of(uwb, range_m=9.0), range_of(uwb, range_m=1.0)
    (other,) = long.alternatives(here)
    assert other.source == "uwb_nlos"
    assert other.cov[0, 0] > 100 * long.cov[0, 0]
    assert not short.alternatives(here)


@pytest.mark.parametrize(
    "origin", [(48.1, 11.6, 500.0), (-33.9, 151.2, 20.0), (0.0, 179.9999, 0.0), (89.0, -70.0, 0.0)]
)
def test_positions_agree_with_the_inverse_transformation(gnss, origin):
    enu = np.array([[0.0, 0.0, 0.0], [150.0, -80.0, 3.0], [-4000.0, 2500.0, -40.0]])
    for point, (latitude, longitude, altitude) in zip(enu, geodetic(enu, origin), strict=True):
        found = gnss.east_north(latitude, longitude, altitude, origin)
        np.testing.assert_allclose(found, point[:2], atol=1e-6)


def test_an_arc_of_the_meridian_has_its_length(gnss):
    """A degree of latitude at 45 degrees has 111.132 km, one of longitude at the equator 111.319 km."""
    assert gnss.east_north(45.005, 7.0, 0.0, (44.995, 7.0, 0.0))[1] == pytest.approx(1111.32, abs=0.02)
    assert gnss.east_north(0.0, 7.01, 0.0, (0.0, 7.0, 0.0))[0] == pytest.approx(1113.19, abs=0.02)


def test_axes_of_map_and_covariance_turn_with_the_origin(gnss):
    config = gnss.GnssConfig(origin=(48.1372, 11.5762, 519.0), yaw_rad=math.pi / 2)  # x of the map is north
    m = position_of(gnss, config, latitude=48.1373)
    assert m.position[0] == pytest.approx(11.12, abs=0.02)
    assert m.position[1] == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(m.cov, np.diag([0.01, 0.04]), atol=1e-12)


def test_antenna_is_where_tf_has_it_else_at_the_base_which_is_said(gnss):
    T = np.eye(4)
    T[:2, 3] = 0.3, -0.2
    config = gnss.GnssConfig(origin=(48.1372, 11.5762, 519.0))
    known = gnss.Gnss.build(context(config, frame=lambda name: T))
    event = gnss.GnssEvent(1, 1, "/fix", "antenna", 48.1372, 11.5762, math.nan, np.zeros((2, 2)), True)
    (m,) = known.measure(event)
    np.testing.assert_allclose(m.antenna, [0.3, -0.2])
    np.testing.assert_allclose(m.cov, np.eye(2) * 1.5**2)  # the message gave none
    assert not known.notes
    unknown = gnss.Gnss.build(context(config))
    assert not next(iter(unknown.measure(event))).antenna.any()
    assert "antenna" in unknown.notes[0]
    assert not list(unknown.measure(replace(event, latitude=49.0)))
    assert "20 km" in unknown.notes[1]


def test_checks_say_what_is_wrong(uwb, gnss):
    near = uwb.UwbEvent(1, 1, "/uwb", 2, 3.0)
    assert uwb.check(near, GATE) is near
    assert uwb.check(replace(near, range_m=math.nan), GATE) == "non_finite"
    assert uwb.check(replace(near, range_m=500.0), GATE) == "range_bound"
    fix = gnss.GnssEvent(1, 1, "/fix", "", 48.0, 11.0, 500.0, np.eye(2), True)
    assert gnss.check(fix, GATE) is fix
    assert gnss.check(replace(fix, fixed=False), GATE) == "no_fix"
    assert gnss.check(replace(fix, latitude=math.inf), GATE) == "non_finite"
    assert gnss.check(replace(fix, latitude=91.0), GATE) == "position_bound"
    assert gnss.check(replace(fix, cov=-np.eye(2)), GATE) == "indefinite_cov"
    assert not gnss.check(replace(fix, cov=1e9 * np.eye(2)), GATE).cov.any()


def test_too_few_anchors_without_a_map_are_refused(uwb):
    config = uwb.UwbConfig(anchors={1: (0.0, 0.0, 2.0)})
    with pytest.raises(ConfigError, match="1 anchor"):
        uwb.Uwb.build(context(config))
    assert uwb.Uwb.build(context(config, LandmarkMap({}))) is not None
    assert uwb.Uwb.build(context(uwb.UwbConfig())) is None


def test_more_places_than_can_be_estimated_are_refused(uwb):
    many = {i: (float(i), 0.0, 2.0) for i in range(41)}
    with pytest.raises(ConfigError, match="41 anchors, expected at most 40"):
        uwb.Uwb.build(context(uwb.UwbConfig(anchors=many, anchors_sigma_m=0.1)))
    some = uwb.Uwb.build(context(uwb.UwbConfig(anchors=many, anchors_sigma_m={3: (0.1, 0.1, 0.0), 99: (1, 1, 1)})))
    assert [p.name for p in some.parameters if p.sigma == 0.1] == ["uwb.bias_m", "uwb.anchor_3.x_m", "uwb.anchor_3.y_m"]


# --- Steps ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keyframe", [False, True])
def test_events_get_a_keyframe_of_their_own_if_their_stream_says_so(uwb, keyframe):
    (stream,) = uwb.Uwb.streams
    builder = KeyframeBuilder(Config().keyframes, GATE, 10.0, [stream._replace(keyframe=keyframe)])
    zero3, zero6 = np.zeros(3), np.zeros((6, 6))
    start, ms = 10**18, 1_000_000
    events = [
        OdometryEvent(t, t, "/odom", "odom", "base", zero3, np.array([0.0, 0.0, 0.0, 1.0]), zero6, zero3, zero3, zero6)
        for t in range(start, start + 2_000 * ms, 20 * ms)
    ]
    ranges = [uwb.UwbEvent(start + t * ms, start + t * ms, "/uwb", 1, 3.0) for t in (510, 555, 1230)]
    steps = []
    for event in sorted([*events, *ranges], key=lambda e: e.stamp_ns):
        steps += builder.push(event)
    steps += builder.flush()
    sensed = [(step.stamp_ns, event) for step in steps for event in step.sensed]
    assert [event.stamp_ns for _, event in sensed] == [r.stamp_ns for r in ranges]  # once each
    for at, event in sensed:
        assert 0 <= at - event.stamp_ns < 200 * ms
    own = [at == event.stamp_ns for at, event in sensed]
    assert own[0] == own[2] == keyframe


# --- Whole runs -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sensor", "bound_m"), [pytest.param("uwb", 0.08, marks=pytest.mark.slow), ("gnss", 0.03)])
def test_the_pose_is_found_and_held_by_one_sensor_alone(recording, sensor, bound_m):
    """No map, no first pose, no camera."""
    config = only(load_config(recording / "robot.yaml"), sensor)
    result = run(recording / "bag", None, config, "batch", check=False)
    metrics = compute_metrics(result, config)
    assert metrics.ate_rmse_m < bound_m
    assert 0.2 < metrics.nees_over_3 < 3.0
    kinds = {kind.split(".")[0] for kind in result.counts}
    assert sensor in kinds
    if sensor == "uwb":
        assert {"uwb.1", "uwb.6"} <= result.counts.keys()
        assert "uwb_nlos" in kinds
    else:
        assert result.rejections["gnss.gate"] > 0


@pytest.mark.parametrize("kind", ["fixed_lag", pytest.param("ekf", marks=pytest.mark.slow)])
def test_online_every_estimator_takes_both(recording, kind):
    config = load_config(recording / "robot.yaml")
    config = config.model_copy(update={"estimator": config.estimator.model_copy(update={"kind": kind})})
    result = run(recording / "bag", None, config, "online", check=False)
    assert compute_metrics(result, config).ate_rmse_m < 0.03
    assert result.counts["gnss"] > 40


# --- Landmarks of the map ---------------------------------------------------------------------------------------------

NO_CLOCK = {"time_offset_sigma_s": 0.0}  # that of another package's sensor is taken as given


def write_cloud(bag, topic, stamp_ns, seen, received_ns):
    """Ranges and bearings as the points of a cloud, with an unknown one."""
    points = [{"x": r * math.cos(b), "y": r * math.sin(b)} for _, r, b in [*seen, (99, 1.0, 0.0)]]
    content = {"points": points, "channels": [{"name": "id", "values": [*(i for i, _, _ in seen), 99]}]}
    bag._write("/numbered", "sensor_msgs/msg/PointCloud", stamp_ns, received_ns, "base_link", content)


@pytest.fixture(scope="module")
def drives(folders, tmp_path_factory):
    """A drive among beacons, one of which was moved, twice: seen by the built-in sensor and by that of examples/."""
    made = tmp_path_factory.mktemp("drives")
    Drive("beacons", seconds=18.0, moved=(2,), seed=2).write(made / "ranges")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BagWriter, "range_bearing", write_cloud)
        Drive("beacons", seconds=18.0, moved=(2,), seed=2).write(made / "numbered")
    return made


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_landmarks_of_another_package_are_treated_as_those_of_the_built_in_sensor(drives, mode):
    """First pose, gate, shared information, the moved landmark and the fit are the same."""
    results = {}
    for name in ("ranges", "numbered"):
        config = load_config(drives / name / "robot.yaml")
        config = with_values(config, "landmarks", NO_CLOCK)
        if name == "numbered":
            config = with_values(config, "beacons", {"range_sigma_m": 0.05, "bearing_sigma_rad": 0.015})
        results[name] = run(drives / name / "bag", drives / name / "map.yaml", config, mode, check=False)
    ours, theirs = results["ranges"], results["numbered"]
    assert len(theirs.trajectory) == len(ours.trajectory) > 80
    assert np.abs(theirs.trajectory.poses - ours.trajectory.poses).max() < 1e-4  # points are of 32 bits
    assert theirs.counts["beacons"] == ours.counts["range_bearing"] > 50
    reasons = [[(d.step, d.landmark_id, d.reason) for d in r.decisions if d.landmark_id >= 0] for r in (ours, theirs)]
    assert reasons[0] == reasons[1]
    assert theirs.rejections["beacons.unknown_id"] > 50
    assert "beacons.quarantined" in theirs.rejections


# --- Motion -----------------------------------------------------------------------------------------------------------


def write_twist(bag, topic, stamp_ns, pose, twist, received_ns):
    """The twist of an odometry alone, in a message that no built-in sensor reads."""
    v, omega = twist
    content = {"twist": {"twist": {"linear": {"x": v}, "angular": {"z": omega}}}}
    kind = "geometry_msgs/msg/TwistWithCovarianceStamped"
    bag._write("/velocity", kind, stamp_ns, received_ns, "base_link", content)


def test_motion_in_a_message_of_another_package_is_that_of_the_wheels(folders, tmp_path):
    """The same twists, the same poses."""
    Drive("beacons", seconds=8.0, seed=1).write(tmp_path / "odometry")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BagWriter, "odometry", write_twist)
        Drive("beacons", seconds=8.0, seed=1).write(tmp_path / "velocity")
    results = []
    for name in ("odometry", "velocity"):
        folder = tmp_path / name
        results.append(
            run(folder / "bag", folder / "map.yaml", load_config(folder / "robot.yaml"), "online", check=False)
        )
    ours, theirs = results
    assert theirs.counts["wheels"] == ours.counts["wheels"] > 30
    np.testing.assert_allclose(theirs.trajectory.poses, ours.trajectory.poses, atol=1e-12)
    assert theirs.trajectory.stamps_ns.tolist() == ours.trajectory.stamps_ns.tolist()


def command_line(folders, *arguments):
    """fgloc in a process of its own, which finds the sensors by their entry points."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join([PYTHONPATH, *map(str, folders)])}
    command = [sys.executable, "-m", "fgloc.cli", *arguments]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


def test_info_names_their_topics(recording, folders):
    done = command_line(folders, "info", str(recording / "bag"))
    assert done.returncode == 0, done.stderr
    assert re.search(r"sensor_msgs/NavSatFix .* gnss\n", done.stdout)
    unbounded = [f.text for f in inspect(recording / "bag", Config()).found if f.code == "place.unbounded"]
    assert not [text for text in unbounded if text in done.stdout]


@pytest.mark.slow
def test_their_failures_and_the_general_ones_are_ablated(recording, folders, tmp_path):
    suite = {
        "title": "radio",
        "recordings": [{"name": "radio", "bag": str(recording / "bag")}],
        "failures": [
            {"name": "nlos", "chain": [{"kind": "uwb_non_line_of_sight", "when": {"share": 0.3}}]},
            {"name": "silent", "chain": [{"kind": "dropout", "sensor": "gnss"}]},
        ],
    }
    path = tmp_path / "suite.yaml"
    path.write_text(json.dumps(suite))
    out = tmp_path / "out"
    done = command_line(folders, "ablate", str(path), "--out", str(out), "--workers", "1")
    assert done.returncode in (0, 3), done.stderr
    report = json.loads((out / "ablation.json").read_text())
    runs = {run["failure"]: run for run in report["runs"]}
    assert runs["nlos"]["affected"]["uwb_non_line_of_sight"] > 50
    assert runs["silent"]["affected"]["dropout"] > 50
    assert {run["outcome"] for run in runs.values()} == {"done"}


def test_the_gyros_bias_is_learned_from_positions_far_apart_only(recording, monkeypatch):
    """Positions determine the yaw along the way: two of them correct the bias if they are far apart."""
    taught, fix = [], Gyro.fix

    def spied(gyro, yaw, variance, apart_s=0.0):
        before = gyro.bias, gyro._turned_s
        fix(gyro, yaw, variance, apart_s)
        taught.append((gyro.bias != before[0], before[1], apart_s))

    monkeypatch.setattr(Gyro, "fix", spied)
    config = only(load_config(recording / "robot.yaml"), "gnss")
    result = run(recording / "bag", None, config, "online", check=False)
    assert result.counts["gnss"] > 40
    learned = [(turned_s, apart_s) for changed, turned_s, apart_s in taught if changed]
    assert all(turned_s >= apart_s for turned_s, apart_s in learned)
    assert all(apart_s > 0.0 for _, _, apart_s in taught)
    assert len(learned) < 0.2 * len(taught)
