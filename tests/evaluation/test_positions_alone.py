"""A truth of positions without a yaw, as a total station's: what it judges, and what it does not."""

import math

import numpy as np
import pytest
from command_line import fgloc
from refusal import refusal

from fgloc import run, se2
from fgloc.ablation.jobs import start_at_truth
from fgloc.calibrate import calibrate
from fgloc.config import Config
from fgloc.errors import EstimatorError, RecordingError
from fgloc.evaluation.metrics import compared, compute_metrics, in_own_gauge, match, match_result, nees
from fgloc.evaluation.report import write_results
from fgloc.recording.truth import TruthTrack
from fgloc.types import Trajectory, TruthEvent
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
LEVER = (0.3, -0.2)
T_MAP_TRUTH = (2.0, -1.0, 0.8)  # frame of the total station


def circle(k):
    angle = 0.02 * k
    return math.sin(angle), 1.0 - math.cos(angle), angle


def write(folder, topic="/total_station/truth", lever=LEVER, way=circle, turn=0.4):
    """A robot on a circle with odometry and commands; a prism beside its base is tracked at 10 Hz."""
    point_type, header_type = "geometry_msgs/msg/PointStamped", "std_msgs/msg/Header"
    with BagWriter(folder / "bag") as bag:
        for k in range(400):
            stamp, pose = START_NS + k * 50_000_000, way(k)
            bag.odometry("/odom", stamp, pose, (0.4, turn), stamp, (np.eye(6) * 1e-3, np.eye(6) * 1e-3))
            bag.command("/cmd_vel", stamp, 0.4, turn, stamp)
            if k % 2 == 0:
                x, y = se2.compose(se2.inverse(T_MAP_TRUTH), se2.compose(pose, (*lever, 0.0)))[:2].tolist()
                time = bag.make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
                header = bag.make(header_type, stamp=time, frame_id="station")
                point = bag.make("geometry_msgs/msg/Point", x=x, y=y, z=0.4)
                bag.write(topic, point_type, bag.make(point_type, header=header, point=point), stamp)
    return folder / "bag"


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write(tmp_path_factory.mktemp("positions"))


def settings(align="se2", offset=LEVER):
    return Config.model_validate({"truth": {"align": align, "offset_m": list(offset)}})


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_positions_are_compared_with_the_lever_arm_and_the_yaw_is_not(bag, tmp_path, mode):
    result = run(bag, None, settings(), mode)
    metrics = compute_metrics(result, settings())
    assert metrics.ate_rmse_m < 0.01
    assert metrics.yaw_mae_deg is None
    assert metrics.nees_over_3 < 1.0
    assert set(metrics.coverage) == {"1", "2", "3"}
    assert not [f for f in metrics.findings if f.code in ("truth.mounting", "covariance.optimistic")]
    matched = match_result(result, settings())
    assert not matched.has_yaw
    np.testing.assert_allclose(matched.errors[:, 2], 0.0)
    assert metrics.odometry.ate_rmse_m == pytest.approx(metrics.ate_rmse_m, abs=0.01)
    write_results(result, settings(), tmp_path / "out", "fgloc")
    assert (tmp_path / "out" / "report.html").stat().st_size > 10_000


def test_the_covariance_is_that_of_the_point_that_is_tracked():
    """Errors as a covariance says: NEES is one, whatever the lever arm."""
    rng = np.random.default_rng(3)
    n, sigmas = 4000, np.array([0.01, 0.01, 0.03])
    yaw = np.linspace(0.0, 30.0, n)
    true = np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw), yaw])
    stamps = START_NS + 10_000_000 * np.arange(n)
    poses = true + rng.normal(0.0, sigmas, (n, 3))
    estimate = Trajectory(stamps, poses, np.tile(np.diag(sigmas**2), (n, 1, 1)))
    points = se2.compose_array(true, np.tile((1.5, 0.0, 0.0), (n, 1)))
    points[:, 2] = 0.0
    matched = match(estimate, Trajectory(stamps, points, has_yaw=False), offset_m=(1.5, 0.0))
    for errors, covs in (compared(matched), in_own_gauge(matched)):
        assert np.mean(nees(errors, covs)) / 2.0 == pytest.approx(1.0, abs=0.1)


def test_on_a_straight_way_points_have_no_yaw_either(tmp_path):
    bag = write(tmp_path, lever=(0.0, 0.0), way=lambda k: (0.0, 0.02 * k, 0.5 * math.pi), turn=0.0)
    config = settings("none", (0.0, 0.0))
    metrics = compute_metrics(run(bag, None, config, "online"), config)
    assert metrics.yaw_mae_deg is None
    assert "truth.mounting" not in {f.code for f in metrics.findings}


def test_a_lever_arm_that_is_not_given_is_an_error_of_positions(bag):
    config = settings(offset=(0.0, 0.0))
    assert compute_metrics(run(bag, None, config, "online"), config).ate_rmse_m > 0.05


def test_without_alignment_the_error_is_in_the_maps_frame(bag):
    config = settings("none")
    initial = (*se2.inverse(T_MAP_TRUTH)[:2].tolist(), -T_MAP_TRUTH[2])
    config = config.model_copy(update={"estimator": config.estimator.model_copy(update={"initial_pose": initial})})
    metrics = compute_metrics(run(bag, None, config, "online"), config)
    assert metrics.ate_rmse_m < 0.01
    assert metrics.yaw_mae_deg is None


def test_poses_whose_yaw_never_changes_are_positions_however_often_they_are_asked_for():
    config = settings().truth
    track = TruthTrack(config, 1.0)
    places = np.array([se2.compose(circle(k), (*LEVER, 0.0))[:2] for k in range(100)])
    for k, (x, y) in enumerate(places.tolist()):
        track.add(TruthEvent(k, k, "/truth", "map", np.array([x, y, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])))
    for _ in range(2):
        truth = track.trajectory()
        assert not truth.has_yaw
        np.testing.assert_allclose(truth.poses[:, :2], places, atol=1e-12)


def test_points_are_no_truth_unless_their_topic_says_so(tmp_path):
    code, out, _ = fgloc("info", write(tmp_path, topic="/leica/position"))
    assert code == 0
    assert "recording.topics.truth: /leica/position" in out


def test_what_needs_a_yaw_refuses_a_truth_without_one(bag):
    with refusal(RecordingError, bag, "estimator.initial_pose"):
        start_at_truth(bag, settings())
    with refusal(EstimatorError, bag, "yaw"):
        calibrate([bag], None, settings())
