"""Values that `fgloc.Live` cannot use: one kind of error, which has the value; nothing is taken silently."""

import re
from pathlib import Path

import numpy as np
import pytest

from fgloc import Live
from fgloc.config import Config
from fgloc.errors import ConfigError, EstimatorError
from fgloc.live.live import TYPED_SIGMAS, begun_at
from fgloc.types import ControlEvent

T = 1_700_000_000_000_000_000
ODOMETRY, TWIST = ("odometry",), (0.2, 0.0, 0.0)


@pytest.mark.parametrize("stamp", [1.7e9 + 0.05, float("nan"), float("inf"), None, "now", (1,)])
@pytest.mark.parametrize("method", ["odometry", "imu", "command", "pose_at", "push"])
def test_a_stamp_that_is_no_whole_number_of_nanoseconds(stamp, method):
    calls = {
        "odometry": lambda live: live.odometry(stamp, (0.0, 0.0, 0.0), TWIST),
        "imu": lambda live: live.imu(stamp, (0.0, 0.0, 0.1)),
        "command": lambda live: live.command(stamp, 0.1, 0.0),
        "pose_at": lambda live: live.pose_at(stamp),
        "push": lambda live: live.push(ControlEvent(stamp, T, "command", 0.1, 0.0)),
    }
    if (stamp, method) == (None, "pose_at"):
        return  # the newest
    with Live(Config(), roles=ODOMETRY) as live, pytest.raises(EstimatorError) as caught:
        calls[method](live)
    assert repr(stamp) in str(caught.value)


@pytest.mark.parametrize("whole", [T, np.int64(T), np.uint64(T), float(T)])
def test_whole_stamps_of_any_kind(whole):
    with Live(Config(), roles=ODOMETRY) as live:
        live.odometry(whole, (0.0, 0.0, 0.0), TWIST)
        assert live.status().topics["odometry"].count == 1


@pytest.mark.parametrize(
    ("method", "arguments", "value"),
    [
        ("odometry", (T, (1.0, 2.0)), (1.0, 2.0)),
        ("odometry", (T, (1.0, 2.0, 3.0, 4.0)), (1.0, 2.0, 3.0, 4.0)),
        ("odometry", (T, None, ("fast", 0.0, 0.0)), ("fast", 0.0, 0.0)),
        ("odometry", (T, 1.0), 1.0),
        ("odometry_beside", ("visual", T, (1.0, 2.0)), (1.0, 2.0)),
        ("imu", (T, (0.0, 0.1)), (0.0, 0.1)),
        ("joints", (T, ("left", "right"), ("x", 2.0)), ("x", 2.0)),
        ("command", (T, None, 0.0), None),
        ("command", (T, (0.1, 0.2), 0.0), (0.1, 0.2)),
        ("ranges", (T, [(1, 2.0)]), [(1, 2.0)]),
        ("ranges", (T, [(1, 2.0, None)]), [(1, 2.0, None)]),
        ("ranges", (T, [(1.5, 2.0, 0.1)]), 1.5),
        ("corners", (T, {7: [(1.0, 2.0), (3.0, 4.0)]}), [(1.0, 2.0), (3.0, 4.0)]),
        ("image", (T, [1, 2]), [1, 2]),
        ("camera_info", (640, 480, (1.0, 2.0)), (1.0, 2.0)),
        ("transform", ("base_link", "cam", (1.0, 2.0), (0.0, 0.0, 0.0, 1.0)), (1.0, 2.0)),
        ("transform", ("base_link", "cam", (1.0, 2.0, 3.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 1.0)),
        ("reset_pose", ((1.0, 2.0),), (1.0, 2.0)),
        ("reset_pose", ((1.0, 2.0, "north"),), (1.0, 2.0, "north")),
        ("reset_pose", ((1.0, 2.0, 3.0), (0.1, 0.1)), (0.1, 0.1)),
        ("push", ("odometry",), "odometry"),
    ],
)
def test_an_argument_of_another_shape_is_named_with_its_value(method, arguments, value):
    with Live(Config(), roles=ODOMETRY) as live, pytest.raises(EstimatorError) as caught:
        getattr(live, method)(*arguments)
    assert method in str(caught.value)
    assert repr(value) in str(caught.value)


@pytest.mark.parametrize(
    ("method", "arguments", "expected"),
    [
        ("odometry", (T, (1.0, 2.0)), "pose is (1.0, 2.0); expected 3 numbers"),
        ("odometry", (T, (0.0, 0.0, 0.0), (0.2,)), "twist is (0.2,); expected 3 numbers"),
        ("command", (T, 0.1, (0.2,)), "omega is (0.2,); expected 1 number:"),
        ("imu", (T, (0.1,)), "angular_velocity is (0.1,); expected 3 numbers"),
        ("imu", (T, (0.0, 0.0, 0.1), (9.8,)), "linear_acceleration is (9.8,); expected 3 numbers"),
        ("ranges", (T, [(1, 2.0)]), "expected n x 3 numbers"),
        ("corners", (T, {7: [(1.0, 2.0)]}), "expected 4 x 2 numbers"),
        ("camera_info", (640, 480, (1.0, 2.0)), "expected 3 x 3 numbers"),
        ("camera_info", (640, 480, np.eye(3), "no"), "expected n numbers"),
        ("transform", ("base_link", "cam", (1.0,), (0.0, 0.0, 0.0, 1.0)), "translation is (1.0,); expected 3 numbers"),
        ("transform", ("base_link", "cam", (0.0, 0.0, 1.0), (1.0,)), "rotation is (1.0,); expected 4 numbers"),
    ],
)
def test_the_first_argument_that_has_not_its_shape_is_named_with_the_shape(method, arguments, expected):
    with Live(Config(), roles=ODOMETRY) as live, pytest.raises(EstimatorError, match=re.escape(expected)):
        getattr(live, method)(*arguments)


def test_a_call_without_its_arguments_is_pythons_own_error():
    with Live(Config(), roles=ODOMETRY) as live, pytest.raises(TypeError):
        live.odometry()


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        ({"config": {}}, "{}"),
        ({"config": Path("robot.yaml")}, "robot.yaml"),
        ({"landmark_map": "map.yaml"}, "'map.yaml'"),
        ({"state": "run.state"}, "'run.state'"),
        ({"roles": "joints"}, "'joints'"),
    ],
)
def test_an_argument_of_another_type_is_named_with_its_value(arguments, value):
    with pytest.raises(ConfigError, match=next(iter(arguments))) as caught:
        Live(**({"config": Config()} | arguments))
    assert value in str(caught.value)


@pytest.mark.parametrize(
    "pose", [(1.0, 2.0, 90.0), (float("nan"), 0.0, 0.0), (0.0, 0.0, float("inf")), (1e12, 0.0, 0.0)]
)
def test_a_first_pose_that_no_file_may_have_is_refused(pose):
    with pytest.raises(ConfigError, match=re.escape(f"--initial-pose {pose[0]:g}, {pose[1]:g}, {pose[2]:g}")):
        begun_at(Config(), pose, "--initial-pose")


def test_a_typed_first_pose_is_as_uncertain_as_a_click_unless_the_configuration_says():
    exact = Config.model_validate({"estimator": {"initial_sigmas": (0.01, 0.01, 0.02)}})
    for config, sigmas in ((Config(), TYPED_SIGMAS), (exact, (0.01, 0.01, 0.02))):
        estimator = begun_at(config, (1.0, 2.0, 0.5), "--initial-pose").estimator
        assert (estimator.initial_pose, estimator.initial_sigmas) == ((1.0, 2.0, 0.5), sigmas)
