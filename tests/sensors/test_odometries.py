"""Odometries beside the wheels: motion, derivatives, covariance, faults, and whole runs with them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from recording_bags import write_messages
from robot_world import START_NS, Chain, World, config, position_error, room

from fgloc import se2
from fgloc.config import GateConfig, OdometryTopic, config_of
from fgloc.errors import RecordingError
from fgloc.evaluation.judgements import judgements
from fgloc.evaluation.metrics import compute_metrics
from fgloc.frames import yaw_quaternion
from fgloc.recording.reader import TopicInfo, select_roles
from fgloc.runner import run
from fgloc.sensors.odometry import BesideEvent, BesideOdometry, CovarianceScale
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Severity, Step, by_class
from fgloc_datasets.bag import BagWriter

START = 1_600_000_000_000_000_000
NAME = "odometry.visual"
NONE = np.zeros((6, 6))


def event(t, pose, twist=(0.0, 0.0, 0.0), cov=NONE):
    stamp = START + round(t * 1e9)
    linear, angular = np.array([*twist[:2], 0.0]), np.array([0.0, 0.0, twist[2]])
    where = np.array([pose[0], pose[1], 0.0]), yaw_quaternion(float(pose[2]))
    return BesideEvent(stamp, stamp, "/vo", "vo", "", *where, NONE, linear, angular, cov)


def way(t, scale=1.0, mounting=(0.0, 0.0, 0.0)):
    """Pose of what is tracked at a time: speed and turn change."""
    x = 0.6 * t + 0.1 * math.sin(t)
    pose = (x, 0.3 * math.sin(0.9 * t), 0.5 * math.sin(0.7 * t))
    tracked = se2.compose(pose, mounting)
    return np.array([scale * tracked[0], scale * tracked[1], tracked[2]])


def step_of(events, start, end):
    return Step(1, 0, START + round(start * 1e9), START + round(end * 1e9), by_class(events))


def odometry(pose=(0.1, -0.05, 0.2)):
    return BesideOdometry(OdometryTopic(name="visual", topic="/vo", pose=pose), GateConfig(), lambda name: None)


def events_of(late=0.0, scale=1.0, mounting=(0.1, -0.05, 0.2)):
    return [event(t, way(t - late, scale, mounting)) for t in np.arange(0.0, 2.0, 0.01)]


def motion(events, pose=(0.1, -0.05, 0.2)):
    return odometry(pose).read(step_of(events, 1.0, 1.2)).motion.motion


def test_motion_is_that_of_the_base():
    expected = se2.between(way(1.0), way(1.2))
    assert motion(events_of()) == pytest.approx(expected, abs=1e-9)


def test_derivatives_are_those_of_differences():
    source = odometry()
    step = step_of(events_of(), 1.0, 1.2)
    m = source.read(step).motion
    found = source.derivatives(step, m)
    d = 1e-4
    changed = {"scale": motion(events_of(scale=1.0 - d))}
    for i, name in enumerate(("x_m", "y_m", "yaw_rad")):
        shifted = np.array([0.1, -0.05, 0.2])
        shifted[i] += d
        changed[name] = motion(events_of(), tuple(shifted))
    for name, other in changed.items():
        sign = -1.0 if name == "scale" else 1.0  # reported short: the true motion is longer
        difference = sign * se2.log(se2.between(m.motion, other)) / d
        assert found[f"{NAME}.{name}"] == pytest.approx(difference, abs=2e-3), name
    late = 0.01
    difference = se2.log(se2.between(motion(events_of(late=late)), m.motion)) / late
    assert found[f"{NAME}.time_offset_s"] == pytest.approx(difference, abs=0.02)


@pytest.mark.parametrize("factor", [1.0, 10.0, 100.0])
def test_factor_on_the_covariance_is_found_in_seconds(factor):
    rng, scale = np.random.default_rng(2), CovarianceScale()
    own, other = np.diag([1e-6, 1e-6, 1e-6]), np.diag([4e-7, 4e-7, 4e-7])
    for k in range(150):
        difference = rng.multivariate_normal(np.zeros(3), factor * own + other)
        if k == 70:
            difference = 100.0 * difference
        scale.add(0.1, difference, own, other)
    assert factor / 2.0 < scale.factor < 2.5 * factor


def test_errors_that_last_count_by_their_sums():
    scale, own = CovarianceScale(), 1e-6 * np.eye(3)
    for _ in range(300):
        scale.add(0.1, np.array([0.0, 0.0, 2e-3]), own, 0.0 * own + 1e-9 * np.eye(3))
    assert scale.factor > 5.0


@pytest.mark.parametrize(
    ("after", "wrong"),
    [((3.0, 2.0, 0.1), "jumped"), ((0.0, 0.0, 0.0), "restarted")],
)
def test_a_pose_that_jumps_is_named(after, wrong):
    events = [event(t, (5.0 + 0.5 * t, 1.0, 0.0), (0.5, 0.0, 0.0)) for t in np.arange(0.0, 1.1, 0.05)]
    events += [event(t, after, (0.5, 0.0, 0.0)) for t in np.arange(1.1, 2.0, 0.05)]
    source = odometry()
    assert source.read(step_of(events[:22], 0.8, 1.0)).wrong == ""
    assert source.read(step_of(events[20:26], 1.0, 1.2)).wrong == wrong
    assert source.read(step_of(events, 1.2, 1.4)).wrong == ""


def test_a_silent_source_measures_nothing():
    events = [event(t, way(t)) for t in np.arange(0.0, 1.0, 0.05)]
    source = odometry()
    assert source.read(step_of(events, 0.8, 0.95)) is not None
    assert source.read(step_of(events, 1.0, 1.5)) is None


def test_topics_are_selected_by_name_and_the_other_is_the_wheels():
    found = [TopicInfo("/vo", "nav_msgs/msg/Odometry", 9), TopicInfo("/wheels", "nav_msgs/msg/Odometry", 9)]
    config = config_of({"recording": {"odometries": [{"name": "visual", "topic": "/vo"}]}}).recording
    assert select_roles(found, config.topics).problems
    selected = select_roles(found, config.topics, config.beside)
    assert selected.roles["odometry"] == "/wheels"
    assert selected.roles[NAME] == "/vo"
    assert select_roles(found[1:], config.topics, config.beside).problems


# --- Runs -------------------------------------------------------------------------------------------------------------


def write(folder, seconds=30.0, visual=lambda t, pose: pose, told=1.0):
    """A robot in a circle, with two odometries of independent noise."""
    rng = np.random.default_rng(5)
    wheels, seen = np.zeros(3), np.array([3.0, 1.0, 0.5])
    sigma = np.array([0.002, 0.002, 0.001])
    with BagWriter(folder / "bag") as bag:
        for k in range(round(20 * seconds)):
            t, stamp = 0.05 * k, START + k * 50_000_000
            twist = np.array([0.4, 0.0, 0.3])
            wheels = se2.compose(wheels, se2.exp(0.05 * twist + sigma * rng.standard_normal(3)))
            seen = se2.compose(seen, se2.exp(0.05 * twist + sigma * rng.standard_normal(3)))
            bag.odometry("/odom", stamp, wheels.tolist(), twist.tolist())
            given = visual(t, seen)
            if given is not None:
                bag.odometry("/vo", stamp + 1, np.asarray(given).tolist(), twist.tolist())
    return folder / "bag"


def ran(bag):
    config = config_of({"recording": {"odometries": [{"name": "visual", "topic": "/vo", "pose": [0.0, 0.0, 0.0]}]}})
    when: dict[str, float] = {}
    steps: list[bool] = []

    def note(step, estimate):
        rows = [d for d in estimate.decisions if d.kind == NAME] if estimate is not None else []
        steps.append(bool(rows))
        for d in rows:
            if d.reason:
                when.setdefault(d.reason, (step.stamp_ns - START) * 1e-9)

    return run(bag, None, config, "online", on_step=note, check=False), when, steps


def test_two_sound_odometries_are_both_used(tmp_path):
    result, when, steps = ran(write(tmp_path))
    assert when == {}
    assert 0.7 < np.mean(steps) < 0.9  # all but the first 5 s
    assert result.installation[f"{NAME}.x_m"][1] < 0.021
    scale = compute_metrics(result, result.config).installation[f"{NAME}.scale"]
    assert (scale.given, scale.prior_sigma) == (1.0, pytest.approx(0.02))
    assert (scale.found, scale.sigma) == result.installation[f"{NAME}.scale"]
    assert not [f for f in result.findings if NAME in f.text]


def test_a_frozen_odometry_is_named_within_a_second_and_left_out(tmp_path):
    held = {}

    def freeze(t, pose):
        return held.setdefault("pose", pose) if 15.0 <= t < 25.0 else pose

    result, when, _ = ran(write(tmp_path, visual=freeze))
    assert 15.0 <= when["frozen"] < 16.0
    assert any(NAME in f.text for f in result.findings)
    assert any(j.kind == "motion_faulty" and j.subject == NAME for j in judgements(result))


def test_a_jump_is_named_in_its_step(tmp_path):
    offset = np.array([0.5, 0.2, 0.4])
    _, when, _ = ran(write(tmp_path, visual=lambda t, pose: se2.compose(offset, pose) if t >= 15.0 else pose))
    assert 15.0 <= when["jumped"] < 15.5


def test_an_odometry_that_restarts_is_named_so(tmp_path):
    first = {}

    def restart(t, pose):
        return se2.between(first.setdefault("pose", pose), pose) if t >= 15.0 else pose

    _, when, _ = ran(write(tmp_path, visual=restart))
    assert 15.0 <= when["restarted"] < 15.5


def test_a_silent_odometry_leaves_the_wheels(tmp_path):
    result, when, steps = ran(write(tmp_path, visual=lambda t, pose: None if 10.0 <= t < 20.0 else pose))
    assert when == {}
    assert 0.3 < np.mean(steps) < 0.65
    assert len(result.trajectory) > 100


def test_a_topic_that_is_not_there_is_an_error(tmp_path):
    bag = write(tmp_path, seconds=2.0)
    config = config_of({"recording": {"odometries": [{"name": "visual", "topic": "/other"}]}})
    with pytest.raises(RecordingError, match=r"recording\.odometries: /other\b"):
        run(bag, None, config, "online")


# --- Messages with a pose alone, or a twist alone ---------------------------------------------------------------------


def message_of(kind, t):
    """Content of a message of a robot on a circle, by its type."""
    x, y, yaw = math.sin(0.4 * t), 1.0 - math.cos(0.4 * t), 0.4 * t
    qx, qy, qz, qw = yaw_quaternion(yaw).tolist()
    pose = {"position": {"x": x, "y": y, "z": 0.0}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}
    twist = {"linear": {"x": 0.4, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.4}}
    name, content = ("pose", pose) if "Pose" in kind else ("twist", twist)
    if "Covariance" in kind:
        content = {name: content, "covariance": [0.0] * 36}
    stamp = START + round(t * 1e9)
    header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "odom"}
    return {"header": header, name: content}


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize(
    "kind", ["PoseStamped", "PoseWithCovarianceStamped", "TwistStamped", "TwistWithCovarianceStamped"]
)
def test_a_run_drives_by_poses_or_twists_alone(tmp_path, kind, beside):
    kind = f"geometry_msgs/msg/{kind}"
    stamps = np.arange(0.0, 6.0, 0.05)
    messages = [("/own", kind, START + round(t * 1e9), message_of(kind, t)) for t in stamps]
    recording = {"odometries": [{"name": "visual", "topic": "/own"}]} if beside else {"topics": {"odometry": "/own"}}
    if beside:
        wheels = "geometry_msgs/msg/TwistWithCovarianceStamped"
        messages += [("/wheels", wheels, START + round(t * 1e9), message_of(wheels, t)) for t in stamps]
        recording["topics"] = {"odometry": "/wheels"}
    result = run(write_messages(tmp_path / "bag", messages), None, config_of({"recording": recording}), mode="online")
    assert not [finding for finding in result.findings if finding.severity == Severity.ERROR]
    assert not result.rejections
    begin, end = result.trajectory.poses[[0, -1]]
    turned = 0.4 * (result.trajectory.stamps_ns[-1] - result.trajectory.stamps_ns[0]) * 1e-9
    moved = se2.between(begin, end)
    assert moved == pytest.approx([math.sin(turned), 1.0 - math.cos(turned), se2.wrap(turned)], abs=0.02)


# --- On a known map: sightings tell which is wrong --------------------------------------------------------------------


def with_visual(made, wheels=lambda t: 1.0):
    """The chain of a run with an odometry beside the wheels, whose speed is multiplied, and its estimates."""
    settings = config(recording={"odometries": [{"name": "visual", "topic": "/vo", "pose": [0.0, 0.0, 0.0]}]})
    source = BesideOdometry(settings.recording.odometries[0], settings.gate, lambda name: None)
    chain, events = Chain(settings, made.map, beside=(source,)), []
    for e in made.events():
        factor = wheels((e.stamp_ns - START_NS) * 1e-9) if isinstance(e, OdometryEvent) else 1.0
        events.append(e if factor == 1.0 else replace(e, linear=factor * e.linear))
    for stamp in range(START_NS + 1, START_NS + round(made.seconds * 1e9), 50_000_000):
        x, y, yaw = made.truth(stamp)
        where = np.array([x, y, 0.0]), yaw_quaternion(yaw), 1e-6 * np.eye(6)
        events.append(BesideEvent(stamp, stamp, "/vo", "vo", "", *where, np.zeros(3), np.zeros(3), NONE))
    return chain, chain.run(sorted(events, key=lambda e: e.received_ns))


@pytest.mark.parametrize("factor", [1.3, 2.0])
def test_wheels_that_slip_beside_a_sound_odometry_are_named_and_counted(factor):
    """A slip shows after some steps, which are judged again; until then the odometry is taken to be wrong."""
    made = World(room(), seconds=24.0)
    chain, estimates = with_visual(made, lambda t: factor if 10.0 <= t < 13.0 or 17.0 <= t < 20.0 else 1.0)
    last = {(d.stamp_ns, d.kind): d for e in estimates for d in e.decisions}
    slipped = [(t - START_NS) * 1e-9 for (t, kind), d in last.items() if kind == "wheels" and d.reason == "slip"]
    during = [t for t in slipped if 10.0 <= t < 14.5 or 17.0 <= t < 21.5]
    assert len(during) == len(slipped) > 30
    assert chain.localizer.motion.slips_per_s == pytest.approx(2.0 / (60.0 + 24.0), rel=0.01)
    (note,) = chain.localizer.motion.notes
    assert "the wheels" in note
    assert " 2 time(s): they slipped" in note
    assert max(position_error(e, made.truth(e.stamp_ns)) for e in estimates) < 0.06


def test_an_odometry_beside_wheels_that_fall_silent_tells_the_motion():
    made = World(room(), seconds=22.0, dumb=((10.0, 22.0),), blind=((11.0, 22.0),))
    _, estimates = with_visual(made)
    assert max(position_error(e, made.truth(e.stamp_ns)) for e in estimates) < 0.06
