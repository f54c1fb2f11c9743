"""Values that `fgloc.Live` cannot use: one kind of error, which has the value; nothing is taken silently."""

import numpy as np
import pytest

from fgloc import Live
from fgloc.config import Config
from fgloc.errors import EstimatorError
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


def test_a_call_without_its_arguments_is_pythons_own_error():
    with Live(Config(), roles=ODOMETRY) as live, pytest.raises(TypeError):
        live.odometry()
