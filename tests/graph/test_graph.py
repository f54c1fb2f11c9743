"""The graph: residuals at truth, agreement of batch and incremental, consistency, and what GTSAM must never see."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from fgloc import se2
from fgloc.config import BatchConfig, Config, EstimatorConfig
from fgloc.errors import CovarianceError, EstimatorError
from fgloc.estimation.sightings import Association
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.estimators import ExtendedKalmanFilter, IncrementalEstimator
from fgloc.graph.factors import LandmarkFactors, landmark_key, motion_factor, pose_key
from fgloc.graph.installation import Installation
from fgloc.graph.joint import fuse
from fgloc.graph.measurement_log import Keyframe, MeasurementLog, PoseWithCovariance
from fgloc.graph.noise import gaussian
from fgloc.sensors.measurements import FrameMeasurement, PixelMeasurement, PointMeasurement
from fgloc.types import Camera, Landmark, LandmarkMap, MotionMeasurement

WALL = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a marker on a wall, facing -x
T_BASE_CAM = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0]])


def wall_map() -> LandmarkMap:
    return LandmarkMap(
        {
            0: Landmark(0, np.array([4.0, 0.5, 0.4]), WALL, 0.2),
            7: Landmark(7, np.array([4.0, -0.8, 0.3]), WALL, 0.2),
            9: Landmark(9, np.array([3.0, 1.5, 0.0]), np.eye(3), 0.0),
        }
    )


def camera(D: list[float]) -> Camera:
    K = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    return Camera(640, 480, "plumb_bob", K, np.array(D), T_BASE_CAM)


def project(pose: np.ndarray, landmark: Landmark, cam: Camera) -> np.ndarray:
    """Independent of the package's factor: matrices and the Brown model written out."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    T_map_base = np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    T_cam_map = np.linalg.inv(T_map_base @ cam.T_base_cam)
    points = landmark.corners() @ T_cam_map[:3, :3].T + T_cam_map[:3, 3]
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    k1, k2, p1, p2 = cam.D[:4]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([cam.K[0, 0] * xd + cam.K[0, 2], cam.K[1, 1] * yd + cam.K[1, 2]])


def corner_sighting(pose: np.ndarray, landmark: Landmark, noise: np.ndarray | float = 0.0) -> PixelMeasurement:
    cam = camera([0.05, -0.02, 0.001, -0.002])
    return PixelMeasurement(0, landmark.landmark_id, project(pose, landmark, cam) + noise, 0.5, cam)


def point_sighting(pose: np.ndarray, landmark: Landmark, cov: np.ndarray) -> PointMeasurement:
    x, y, _ = se2.between(pose, np.array([*landmark.position[:2], 0.0]))
    return PointMeasurement(0, landmark.landmark_id, float(np.hypot(x, y)), float(np.arctan2(y, x)), cov)


POSES = [np.array([0.0, 0.0, 0.0]), np.array([1.0, -0.4, 0.25]), np.array([-0.5, 0.7, -0.2])]


@pytest.mark.parametrize("pose", POSES)
def test_every_landmark_factor_has_zero_residual_at_truth(pose):
    landmarks = wall_map()
    factors = LandmarkFactors(landmarks)
    wall = landmarks.landmarks[0]
    sightings = [
        corner_sighting(pose, wall),
        point_sighting(pose, landmarks.landmarks[9], np.diag([1e-4, 1e-2])),
        FrameMeasurement(0, 0, se2.between(pose, wall.planar), np.diag([1e-2, 2e-2, 3e-2])),
    ]
    for one in factors.observe(sightings).linearize(pose, np.zeros(0)):
        assert one.residual == pytest.approx(0.0, abs=1e-6)
        assert not one.behind


@pytest.mark.parametrize("pose", POSES)
def test_unknown_landmark_factors_have_zero_residual_at_truth(pose):
    landmarks = wall_map()
    factors = LandmarkFactors(None)
    values = gtsam.Values()
    values.insert(pose_key(0), gtsam.Pose2(*pose))
    values.insert(landmark_key(9), landmarks.landmarks[9].position[:2])
    values.insert(landmark_key(0), gtsam.Pose2(*landmarks.landmarks[0].planar))
    point = point_sighting(pose, landmarks.landmarks[9], np.diag([1e-4, 1e-2]))
    marker = FrameMeasurement(0, 0, se2.between(pose, landmarks.landmarks[0].planar), np.eye(3))
    for m in (point, marker):
        factor = factors.sighting(0, m, None).factor
        assert factor.error(values) == pytest.approx(0.0, abs=1e-12)


def test_motion_factor_has_zero_residual_at_truth():
    a, b = POSES[0], POSES[1]
    values = gtsam.Values()
    values.insert(pose_key(0), gtsam.Pose2(*a))
    values.insert(pose_key(1), gtsam.Pose2(*b))
    motion = MotionMeasurement("wheels", 0, 1, se2.between(a, b), np.eye(3) * 1e-4)
    assert motion_factor(1, motion).error(values) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("kernel", "expected"),
    [
        ("none", 0.5 * 10.0**2),
        ("huber", 1.345 * (10.0 - 0.5 * 1.345)),
        ("cauchy", 0.5 * 2.385**2 * math.log1p((10.0 / 2.385) ** 2)),
        ("dcs", (3.0 * 10.0**2 - 1.0) / (2.0 * (10.0**2 + 1.0))),  # the integral of r times its weight
    ],
)
def test_motion_kernel_is_on_the_wheels_alone(kernel, expected):
    values = gtsam.Values()
    values.insert(pose_key(0), gtsam.Pose2(*POSES[0]))
    values.insert(pose_key(1), gtsam.Pose2(1.0, 0.0, 0.0))
    cov = np.eye(3) * 0.1**2  # the motion is one metre too long: ten sigmas
    wheels, learned = (MotionMeasurement(source, 0, 1, np.zeros(3), cov) for source in ("wheels", "learned"))
    assert motion_factor(1, learned, kernel).error(values) == pytest.approx(50.0)
    assert motion_factor(1, wheels, kernel).error(values) == pytest.approx(expected, rel=1e-6)


def test_marker_pose_prior_carries_the_lever_arm():
    """Cov of the robot implied by a marker pose: a yaw error of the marker swings the robot around it (Monte Carlo)."""
    rng = np.random.default_rng(3)
    landmarks = wall_map()
    truth, cov = POSES[1], np.diag([0.01, 0.02, 0.03]) ** 2
    seen = se2.between(truth, landmarks.landmarks[0].planar)
    lines = LandmarkFactors(landmarks).linearize([FrameMeasurement(0, 0, seen, cov)], truth)
    implied = np.linalg.inv(lines.H.T @ lines.H)
    draws = []
    for noise in rng.multivariate_normal(np.zeros(3), cov, 20000):
        noisy = se2.compose(seen, se2.exp(noise))
        draws.append(se2.log(se2.between(truth, se2.compose(landmarks.landmarks[0].planar, se2.inverse(noisy)))))
    sampled = np.cov(np.array(draws).T)
    assert np.abs(sampled - implied).max() < 0.04 * np.abs(implied).max()


def test_cartesian_covariance_matches_samples():
    rng = np.random.default_rng(1)
    m = PointMeasurement(0, 9, 3.0, 0.7, np.diag([0.02, 0.1]) ** 2)
    point, cov = m.cartesian()
    bearing, r = 0.7 + rng.normal(0, 0.02, 50000), 3.0 + rng.normal(0, 0.1, 50000)
    samples = np.column_stack([r * np.cos(bearing), r * np.sin(bearing)])
    assert np.allclose(samples.mean(axis=0), point, atol=2e-3)
    assert np.abs(np.cov(samples.T) - cov).max() < 0.03 * np.abs(cov).max()


def test_carried_sightings_agree_with_those_made_at_the_keyframe():
    landmarks = wall_map()
    keyframe, motion = POSES[1], np.array([0.1, 0.02, 0.1])
    then = se2.compose(keyframe, motion)
    factors = LandmarkFactors(landmarks)
    sightings = [
        corner_sighting(then, landmarks.landmarks[0]),
        point_sighting(then, landmarks.landmarks[9], np.diag([1e-4, 1e-2])),
        FrameMeasurement(0, 0, se2.between(then, landmarks.landmarks[0].planar), np.eye(3) * 1e-2),
    ]
    carried = [m.compensated(motion, np.eye(3) * 1e-6) for m in sightings]
    for one in factors.observe(carried).linearize(keyframe, np.zeros(0)):
        assert one.residual == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    "cov",
    [
        np.diag([1.0, 1.0, np.nan]),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([1.0, -1.0, 1.0]),
        np.array([[1.0, 0.5, 0], [0.0, 1.0, 0], [0, 0, 1.0]]),
        np.array([[1.0, 2.0, 0], [2.0, 1.0, 0], [0, 0, 1.0]]),
    ],
)
def test_a_matrix_that_is_no_covariance_never_reaches_gtsam(cov):
    with pytest.raises(CovarianceError):
        gaussian(cov)


def test_unknown_id_is_named():
    with pytest.raises(EstimatorError, match=r"\b42\b"):
        LandmarkFactors(wall_map()).sighting(0, PointMeasurement(0, 42, 1.0, 0.0, np.eye(2)), None)


def test_fused_motion_equals_the_product_of_gaussians():
    a = MotionMeasurement("wheels", 0, 1, np.array([0.1, 0.0, 0.02]), np.diag([1e-4, 2e-4, 1e-4]))
    b = MotionMeasurement("learned", 0, 1, np.array([0.12, 0.0, 0.02]), np.diag([1e-4, 2e-4, 3e-4]))
    motion, cov = fuse([a, b])
    assert motion[0] == pytest.approx(0.11, abs=1e-6)
    assert np.allclose(np.diag(cov), [5e-5, 1e-4, 7.5e-5])


# --- estimators on a simulated drive ----------------------------------------------------------------------------------


def drive(seed: int, n: int = 150, blind: tuple[int, int] = (0, 0)):
    """Noisy motions and sightings along a known path; yields per step (truth, motions, measurements)."""
    rng = np.random.default_rng(seed)
    landmarks = LandmarkMap({i: Landmark(i, np.array([*rng.uniform(-4, 4, 2), 0.0]), np.eye(3), 0.0) for i in range(8)})
    Q, R = np.diag([0.01, 0.005, 0.01]) ** 2, np.diag([0.02, 0.08]) ** 2
    truth = np.zeros(3)
    rows = []
    for k in range(n):
        step = np.array([0.08, 0.0, 0.05 * np.sin(k / 15)])
        measured = se2.compose(step, se2.exp(rng.multivariate_normal(np.zeros(3), Q)))
        if k:
            truth = se2.compose(truth, step)
        sightings = []
        if k % 3 == 0 and not blind[0] <= k < blind[1]:
            for i in rng.choice(8, 2, replace=False):
                m = point_sighting(truth, landmarks.landmarks[int(i)], R)
                noise = rng.multivariate_normal(np.zeros(2), R)
                if m.range_m + noise[1] > 0.3:
                    sightings.append(PointMeasurement(k, int(i), m.range_m + noise[1], m.bearing_rad + noise[0], R))
        rows.append((truth, [MotionMeasurement("wheels", k - 1, k, measured, Q)], sightings))
    return landmarks, rows


def replay(seed: int, kind: str = "fixed_lag", lag_s: float = 10.0, **kwargs):
    landmarks, rows = drive(seed, **kwargs)
    factors = LandmarkFactors(landmarks)
    estimator = IncrementalEstimator(EstimatorConfig(kind=kind, lag_s=lag_s), factors, keep_all=True)
    beliefs = [estimator.start(0, PoseWithCovariance(np.zeros(3), np.diag([1e-4, 1e-4, 1e-4])))]
    for k, (_, motions, sightings) in enumerate(rows[1:], start=1):
        held = [factors.sighting(k, m, None) for m in sightings]
        beliefs.append(estimator.update(k * 10**8, 0.1, motions, held))
    return estimator, factors, beliefs, [truth for truth, _, _ in rows]


def nees(belief: PoseWithCovariance, truth: np.ndarray) -> float:
    error = se2.log(se2.between(belief.pose, truth))
    return float(error @ np.linalg.solve(belief.cov, error))


def test_batch_agrees_with_full_incremental():
    estimator, factors, beliefs, _ = replay(0, "isam2")
    result = BatchSmoother(estimator.log, factors, BatchConfig(), 0.999999).result()
    last = se2.log(se2.between(result.poses[-1], beliefs[-1].pose))
    assert np.abs(last).max() < 2e-3
    assert np.abs(result.covs[-1] - beliefs[-1].cov).max() < 0.03 * np.abs(beliefs[-1].cov).max()


def test_fixed_lag_agrees_with_full_isam2_within_the_noise():
    _, _, fixed, _ = replay(1, "fixed_lag", lag_s=3.0)
    _, _, full, _ = replay(1, "isam2")
    errors = np.array([se2.log(se2.between(a.pose, b.pose)) for a, b in zip(fixed, full, strict=True)])
    sigma = np.sqrt(np.diag(full[-1].cov))
    assert (np.abs(errors).max(axis=0) < sigma).all()


def test_nees_is_consistent_over_seeds():
    values = {"online": [], "batch": []}
    for seed in range(12):
        estimator, factors, beliefs, truths = replay(seed)
        result = BatchSmoother(estimator.log, factors, BatchConfig(), 0.999999).result()
        values["online"].append(nees(beliefs[-1], truths[-1]))
        values["batch"].append(nees(PoseWithCovariance(result.poses[75], result.covs[75]), truths[75]))
    low, high = chi2.ppf([0.001, 0.999], 3 * 12)
    for name, sample in values.items():
        assert low < sum(sample) < high, name


def test_fault_22_long_dead_reckoning_grows_and_recovers():
    _, _, beliefs, truths = replay(5, n=700, blind=(20, 680))
    sizes = [np.trace(b.cov) for b in beliefs]
    assert sizes[675] > 50 * sizes[20]
    assert sizes[-1] < 0.02 * sizes[675]
    assert np.hypot(*(beliefs[-1].pose - truths[-1])[:2]) < 0.2


def break_down(estimator: IncrementalEstimator) -> None:
    """GTSAM throws in the middle of the next update, whatever solves it, and leaves ruins; then it works again."""
    new, failing = estimator._new_backend, 1

    def update(*_):
        raise RuntimeError("Indeterminate linear system detected")

    def once_more():
        nonlocal failing
        backend = new()
        if failing:
            backend.update = update
        failing = 0
        return backend

    estimator._backend.update = update
    estimator._new_backend = once_more


def test_fault_67_an_exception_in_gtsam_rebuilds_the_window_without_the_offender():
    walls = LandmarkFactors(wall_map())
    seen = corner_sighting(np.zeros(3), wall_map().landmarks[0])
    estimator = IncrementalEstimator(EstimatorConfig(), walls)
    estimator.start(0, PoseWithCovariance(np.array([6.0, 0.0, 0.0]), np.eye(3) * 1e-4))
    motion = MotionMeasurement("wheels", 0, 1, np.array([0.1, 0.0, 0.0]), np.eye(3) * 1e-4)
    for k in range(1, 10):
        estimator.update(k * 10**8, 0.1, [motion])
    break_down(estimator)
    belief = estimator.update(10**9, 0.1, [motion], [walls.sighting(10, seen, 3.0)])
    assert estimator.rebuilt == 1
    assert [s.measurement for s in estimator.log.keyframes[10].rejected] == [seen]
    assert belief.pose[0] == pytest.approx(7.0, abs=1e-6)
    assert belief.cov[0, 0] == pytest.approx(11e-4, rel=1e-6)
    after = estimator.update(11 * 10**8, 0.1, [motion])
    assert after.pose[0] == pytest.approx(7.1, abs=1e-6)


@pytest.mark.parametrize("kind", ["fixed_lag", "isam2"])
@pytest.mark.parametrize("installed", [0.0, 0.01], ids=["exact", "installed"])
def test_a_first_pose_that_is_hardly_known_is_no_reason_to_drop_sightings(kind, installed):
    """Cholesky fails at metres beside millimetres, as where a run is taken up from before its first fix."""
    landmarks = wall_map()
    walls = LandmarkFactors(landmarks, Installation({"wheels.radius": installed}))
    estimator = IncrementalEstimator(EstimatorConfig(kind=kind, lag_s=1.0), walls)
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.diag([100.0, 100.0, 10.0])))
    by = {"wheels.radius": (np.array([0.05, 0.0, 0.0]), 0.0)} if installed else {}
    motion = MotionMeasurement("wheels", 0, 1, np.array([0.05, 0.0, 0.0]), np.diag([7e-5, 1e-6, 1e-4]), by)
    for k in range(1, 40):
        truth = np.array([0.05 * k, 0.0, 0.0])
        seen = [point_sighting(truth, landmarks.landmarks[i], np.diag([1e-4, 1e-2])) for i in (0, 7, 9)]
        held = [walls.sighting(k, m, None) for m in seen if k > 2]
        belief = estimator.update(k * 10**8, 0.1, [motion], held)
        assert not estimator.log.keyframes[k].rejected
    assert estimator.rebuilt == 0
    assert belief.pose == pytest.approx(truth, abs=1e-3)
    assert np.sqrt(np.diag(belief.cov)).max() < 0.03


@pytest.mark.parametrize("kind", [IncrementalEstimator, ExtendedKalmanFilter], ids=["fixed_lag", "ekf"])
def test_a_marker_behind_the_camera_says_nothing(kind):
    """What cannot be projected is left out; there is nothing to rebuild for it."""
    walls = LandmarkFactors(wall_map())
    seen = corner_sighting(np.zeros(3), wall_map().landmarks[0])
    estimator = kind(EstimatorConfig(), walls)
    estimator.start(0, PoseWithCovariance(np.array([6.0, 0.0, 0.0]), np.eye(3) * 1e-4))
    motion = MotionMeasurement("wheels", 0, 1, np.array([0.1, 0.0, 0.0]), np.eye(3) * 1e-4)
    belief = estimator.update(10**8, 0.1, [motion], [walls.sighting(1, seen, 3.0)])
    assert estimator.rebuilt == 0
    assert belief.pose == pytest.approx((6.1, 0.0, 0.0), abs=1e-9)
    assert belief.cov[0, 0] == pytest.approx(2e-4, rel=1e-6)


@pytest.mark.parametrize("depth", [0.0499, 0.0501, 0.06, 0.2])
def test_a_marker_right_in_front_of_the_camera_is_no_reason_to_fail(depth):
    """Its residual and derivatives are large beyond all digits."""
    walls = LandmarkFactors(wall_map())
    seen = replace(corner_sighting(np.zeros(3), wall_map().landmarks[0]), jitter_s=0.01, twist=np.array([0.5, 0, 0.5]))
    pose = np.array([4.0 - 0.1 - depth, 0.2, 0.0])
    estimator = IncrementalEstimator(EstimatorConfig(), walls)
    estimator.start(0, PoseWithCovariance(pose, np.eye(3) * 1e-2))
    predicted = estimator.predict([MotionMeasurement("wheels", 0, 1, np.zeros(3), np.eye(3) * 1e-6)])
    accepted, rejected, _ = Association(Config(), walls).judge(1, 10**8, [seen], predicted)
    assert not accepted
    assert len(rejected) == 1
    stay = MotionMeasurement("wheels", 0, 1, np.zeros(3), np.eye(3) * 1e-6)
    belief = estimator.update(10**8, 0.1, [stay], [walls.sighting(1, seen, 3.0)])
    assert np.isfinite(belief.pose).all()
    assert np.isfinite(belief.cov).all()


def test_a_landmark_under_the_robot_tells_its_place_no_better_than_its_range():
    m = PointMeasurement(0, 9, 0.0, 0.3, np.diag([0.01, 0.05]) ** 2)
    _, cov = m.cartesian()
    assert np.sqrt(np.linalg.eigvalsh(cov)) == pytest.approx((0.01 * 0.05, 0.05))


def after_a_slip(*seen) -> tuple[np.ndarray, list[str]]:
    """Where the chain puts a robot at the origin that it estimated to be 6 cm and 0.03 rad off, and its decisions."""
    walls = LandmarkFactors(wall_map())
    estimator = IncrementalEstimator(EstimatorConfig(), walls)
    estimator.start(0, PoseWithCovariance(np.array([-0.1, 0.0, 0.0]), np.eye(3) * 1e-8))
    slipped = MotionMeasurement("wheels", 0, 10**8, np.array([0.16, 0.0, 0.03]), np.diag([0.06, 0.06, 0.03]) ** 2)
    accepted, _, decisions = Association(Config(), walls).judge(1, 10**8, seen, estimator.predict([slipped]))
    return estimator.update(10**8, 0.1, [slipped], accepted).pose, [d.reason for d in decisions]


def test_sightings_that_agree_are_not_taken_for_outliers_because_the_prediction_is_off():
    """Two markers tell in the first step that it is the prediction."""
    a, b = (corner_sighting(np.zeros(3), wall_map().landmarks[i]) for i in (0, 7))
    pose, reasons = after_a_slip(a, b)
    assert reasons == ["", ""]
    assert np.linalg.norm(pose[:2]) < 0.03


@pytest.mark.parametrize("off", [0.1, 0.2, 0.4])
def test_sightings_that_exclude_each_other_are_not_averaged(off):
    """Each of them may be right after dead reckoning, both cannot: their mean would be half a metre off."""
    a, b = (corner_sighting(np.zeros(3), wall_map().landmarks[i]) for i in (0, 7))
    liar = corner_sighting(np.array([0.0, off, 0.0]), wall_map().landmarks[7])
    pose, reasons = after_a_slip(a, liar)
    assert sorted(reasons) == ["", "contradicts_others"]  # the one that the prediction finds likelier
    assert np.linalg.norm(pose[:2]) < 0.05
    beacon = point_sighting(np.zeros(3), wall_map().landmarks[9], np.diag([0.01, 0.02]) ** 2)
    liar = corner_sighting(np.array([0.0, -off, 0.0]), wall_map().landmarks[0])
    pose, reasons = after_a_slip(liar, b, beacon)  # two against one
    assert reasons == ["contradicts_others", "", ""]
    assert np.linalg.norm(pose[:2]) < 0.05


def test_a_rebuilt_window_counts_the_sightings_of_its_oldest_keyframe_once():
    """What is left after a rebuild is as sure as if nothing had happened."""
    landmarks = wall_map()
    walls = LandmarkFactors(landmarks)
    motion = MotionMeasurement("wheels", 0, 1, np.array([0.02, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-5]))
    offender = walls.sighting(31, corner_sighting(np.zeros(3), landmarks.landmarks[0]), 3.0)

    def filtered(offend: bool) -> PoseWithCovariance:
        estimator = IncrementalEstimator(EstimatorConfig(lag_s=1.0), walls)
        estimator.start(0, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-2))
        for k in range(1, 31):
            seen = point_sighting(np.array([0.02 * k, 0.0, 0.0]), landmarks.landmarks[9], np.diag([1e-4, 1e-2]))
            estimator.update(k * 10**8, 0.1, [motion], [walls.sighting(k, seen, None)])
        if offend:
            break_down(estimator)
        belief = estimator.update(31 * 10**8, 0.1, [motion], [offender] if offend else [])
        assert estimator.rebuilt == offend
        return belief

    usual, rebuilt = filtered(False), filtered(True)
    assert np.allclose(rebuilt.pose, usual.pose, atol=1e-6)
    assert np.allclose(rebuilt.cov, usual.cov, rtol=1e-3)


@pytest.mark.parametrize("kind", [IncrementalEstimator, ExtendedKalmanFilter], ids=["fixed_lag", "ekf"])
def test_what_a_moved_landmark_did_stays_undone_when_the_window_is_built_again(kind):
    """The beliefs before the correction are still in the log, and still wrong."""
    estimator = kind(EstimatorConfig(), LandmarkFactors(wall_map()))
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-4))
    step = [MotionMeasurement("wheels", 0, 10**8, np.array([0.1, 0.0, 0.0]), np.eye(3) * 1e-4)]
    for k in range(1, 4):
        estimator.update(k * 10**8, 0.1, step)
    estimator.correct(PoseWithCovariance(np.array([0.3, 0.5, 0.0]), np.eye(3) * 1e-4), 7)
    for k in range(4, 7):
        estimator.update(k * 10**8, 0.1, step)
    estimator.revise({2: step, 3: step})
    assert estimator.belief.pose == pytest.approx((0.6, 0.5, 0.0), abs=1e-6)
    assert estimator.update(7 * 10**8, 0.1, step).pose == pytest.approx((0.7, 0.5, 0.0), abs=1e-6)


@pytest.mark.slow
def test_fault_68_a_batch_of_many_poses_does_not_overflow_the_stack():
    n, motion = 120_000, np.array([0.02, 0.0, 0.01])
    factors = LandmarkFactors(wall_map())
    log, pose, cov = MeasurementLog(10.0, keep_all=True), np.zeros(3), np.diag([1e-6, 1e-6, 1e-6])
    for k in range(n):
        prior = PoseWithCovariance(pose, np.eye(3) * 1e-4) if k == 0 else None
        motions = (MotionMeasurement("wheels", k - 1, k, motion, cov),) if k else ()
        log.append(Keyframe(k, k * 10**8, 0.1 * k, PoseWithCovariance(pose, np.eye(3)), prior, motions))
        pose = se2.compose(pose, motion)
    result = BatchSmoother(log, factors, BatchConfig(), 0.9999).result()
    assert len(result.covs) == n
    assert (np.diff(result.covs[:, 2, 2]) > 0).all()
