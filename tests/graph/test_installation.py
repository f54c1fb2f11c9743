"""The installation as a state: names and priors, the joint Gaussian, and errors of it that are found in a drive."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from exact import EXACT, exact
from robot_world import (
    NOISE,
    SPEED,
    START_NS,
    TURN,
    Chain,
    World,
    beacons,
    config,
    nees,
    position_error,
    room,
    truth_at,
)

from fgloc import se2
from fgloc.config import BatchConfig, Config, EstimatorConfig, GyroConfig
from fgloc.estimation.motion import MotionSources
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.estimators import ExtendedKalmanFilter, IncrementalEstimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.ground import predict
from fgloc.graph.installation import MARKER, BoardPrior, Installation, InstallationEstimate, installation_of
from fgloc.graph.joint import conditioned, correct, fuse_installed
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.measurements import PointMeasurement
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import ControlEvent, Landmark, LandmarkMap, MotionMeasurement, Step, by_class

# --- names and priors -------------------------------------------------------------------------------------------------


def test_parameters_of_sigma_zero_are_no_states():
    made = Installation({"wheels.radius": 0.01, "wheels.track": 0.0, "gyro.scale": 0.0})
    assert made.names == ("wheels.radius",)
    assert len(Installation({})) == 0
    assert Installation({}).time_offset(Installation({}).prior()) == 0.0


def test_in_a_block_that_holds_others_a_parameter_of_sigma_zero_is_held():
    sigmas = {"map.3.x_m": 0.0, "map.3.y_m": 0.01, "map.4.x_m": 0.0, "map.4.y_m": 0.0, "wheels.track": 0.02}
    made = Installation(sigmas)
    assert made.names == ("map.3.x_m", "map.3.y_m", "wheels.track")
    assert made.landmarks == {3: (0, 2)}
    assert np.sqrt(np.diag(made.prior().cov)) == pytest.approx([1e-5, 0.01, 0.02])


def test_a_covariance_of_the_map_is_the_prior_of_its_landmark():
    cov = np.array([[0.04, 0.01], [0.01, 0.09]])
    held = {1: Landmark(1, np.zeros(3), np.eye(3), 0.0, cov), 2: Landmark(2, np.ones(3), np.eye(3), 0.0)}
    for settings in (config(), exact()):
        made = installation_of(settings, LandmarkMap(held), False)
        first, count = made.landmarks[1]
        assert count == 2
        assert made.prior().cov[first : first + 2, first : first + 2] == pytest.approx(cov)
    assert made.names == ("map.1.x_m", "map.1.y_m")


def test_markers_of_a_board_that_are_states_are_displaced_together():
    """The second marker of the board is no state, as if the map had not given its size."""
    rng = np.random.default_rng(4)
    derivative, root = rng.normal(size=(18, 6)), 0.01 * rng.normal(size=(6, 6))
    board = BoardPrior((7, 8, 9), derivative, root @ root.T, np.full(6, 1e-6))
    sigmas = {f"map.{i}.{name}": 0.05 for i in (9, 7) for name in MARKER}
    prior = Installation(sigmas, boards=(board,)).prior().cov
    rows = np.r_[12:18, 0:6]  # of the board's, in the order of the states
    np.testing.assert_allclose(prior, board.joint(rows), atol=1e-15)


@pytest.mark.parametrize("sigma", [1e-7, 1.5e-5, 1e-3, 1.0])
def test_states_that_are_taken_as_exact_keep_a_covariance_and_tell_the_others(sigma):
    rng = np.random.default_rng(2)
    root = rng.normal(size=(4, 4)) * np.array([1.0, 1.0, sigma, 1.0])[:, None]
    P = root @ root.T
    found = conditioned(P, [2])
    assert np.linalg.eigvalsh(found)[0] > -1e-15
    assert 0.0 <= found[2, 2] <= 1.01e-10
    if sigma > 1e-4:  # else it is more certain than what is called exact
        rest = [0, 1, 3]
        expected = P[np.ix_(rest, rest)] - np.outer(P[rest, 2], P[rest, 2]) / P[2, 2]
        np.testing.assert_allclose(found[np.ix_(rest, rest)], expected, atol=1e-3)


def test_what_is_a_state_depends_on_the_sensors():
    corners, points = (installation_of(config(), room(), c).names for c in (True, False))
    assert {"camera.focal", "map.3.rz_rad"} <= set(corners)
    assert not any(name.startswith("sightings") for name in corners)
    assert {"sightings.range_scale", "map.3.y_m"} <= set(points)
    assert "map.3.z_m" not in points
    assert "wheels.time_offset_s" not in corners
    assert "wheels.time_offset_s" in installation_of(config(), room(), True, has_gyro=True).names
    assert not any(
        "." in n and n.split(".")[0] in ("map", "camera") for n in installation_of(config(), None, True).names
    )


# --- prediction and correction against a dense Gaussian ---------------------------------------------------------------

NAMES = (
    "wheels.radius",
    "sightings.range_scale",
    "sightings.bearing_offset_rad",
    "sightings.time_offset_s",
    "gyro.scale",
)
SIGMAS = (0.02, 0.03, 0.02, 0.01, 0.05)
POINTS = LandmarkMap(
    {i: Landmark(i, np.array([3.0 * np.cos(i), 3.0 * np.sin(i), 0.0]), np.eye(3), 0.0) for i in range(5)}
)


def seen_from(pose, i: int, rng, twist=(0.4, 0.0, 0.3)) -> PointMeasurement:
    x, y, _ = se2.between(pose, (*POINTS.landmarks[i].position[:2], 0.0))
    R = np.diag([0.01, 0.02]) ** 2
    bearing, distance = rng.multivariate_normal((math.atan2(y, x), math.hypot(x, y)), R)
    return PointMeasurement(0, i, float(distance), float(bearing), R, np.array(twist))


def correlated(rng, n: int) -> tuple[PoseWithCovariance, InstallationEstimate]:
    A = rng.normal(size=(3 + n, 3 + n)) * 0.003
    P = A @ A.T + 1e-6 * np.eye(3 + n)
    known = InstallationEstimate(rng.normal(0.0, 0.005, n), P[3:, 3:])
    return PoseWithCovariance(np.array([0.3, -0.2, 0.4]), P[:3, :3], P[:3, 3:], known), known


def test_prediction_is_that_of_the_dense_joint_gaussian():
    rng, installation = np.random.default_rng(0), Installation(dict(zip(NAMES, SIGMAS, strict=True)))
    belief, known = correlated(rng, len(installation))
    d, g = np.array([0.1, 0.01, 0.05]), np.array([0.0, 0.02, 0.07])
    cov = np.diag([0.01, 0.02, 0.03]) ** 2
    m = MotionMeasurement(
        "wheels", 0, 1, np.array([0.1, 0.01, 0.05]), cov, {"wheels.radius": (d, 0.002), "gyro.scale": (g, 0.0)}
    )
    after = predict(belief, known, installation, [m])

    def end(x):
        """Pose and installation after the motion, by pose, installation and noise as they really are."""
        theta = known.mean + x[3:8]
        start = se2.compose(belief.pose, se2.exp(x[:3]))
        move = se2.compose(m.motion, se2.exp(d * (theta[0] - 0.002) + g * theta[4]))
        return se2.compose(start, se2.compose(move, se2.exp(x[8:])))

    middle, h = end(np.zeros(11)), 1e-6
    assert after.pose == pytest.approx(middle, abs=1e-5)
    F = np.array([se2.log(se2.between(end(-h * e), end(h * e))) / (2 * h) for e in np.eye(11)]).T
    G = np.vstack([F, np.hstack([np.zeros((5, 3)), np.eye(5), np.zeros((5, 3))])])
    P = np.zeros((11, 11))
    P[:8, :8], P[8:, 8:] = belief.joint_cov(known), cov
    assert after.joint_cov(known) == pytest.approx(G @ P @ G.T, rel=1e-3, abs=1e-7)


def test_fused_motions_depend_on_both_installations():
    a = MotionMeasurement(
        "wheels", 0, 1, np.array([0.1, 0.0, 0.0]), np.eye(3) * 1e-4, {"wheels.radius": (np.ones(3), 0.1)}
    )
    b = MotionMeasurement("gyro", 0, 1, np.array([0.1, 0.0, 0.0]), np.eye(3) * 3e-4, {"gyro.scale": (np.ones(3), 0.0)})
    _, _, depends = fuse_installed([a, b])
    assert depends["wheels.radius"][0] == pytest.approx(0.75 * np.ones(3))
    assert depends["gyro.scale"][0] == pytest.approx(0.25 * np.ones(3))
    assert depends["wheels.radius"][1] == 0.1


def test_correction_is_that_of_the_dense_joint_gaussian():
    rng, installation = np.random.default_rng(1), Installation(dict(zip(NAMES, SIGMAS, strict=True)))
    factors = LandmarkFactors(POINTS, installation)
    belief, known = correlated(rng, len(installation))
    truth = se2.compose(belief.pose, se2.exp(np.array([0.004, -0.003, 0.002])))
    seen = [seen_from(truth, i, rng) for i in (0, 1, 3)]
    corrected, cost = correct(belief, known, seen, factors)
    # Gauss-Newton on the whole cost, in information form
    P, x = belief.joint_cov(known), np.zeros(8)
    for _ in range(20):
        pose, theta = se2.compose(belief.pose, se2.exp(x[:3])), known.mean + x[3:]
        H, r = [], []
        for one in factors.observe(seen).linearize(pose, theta):
            dense = np.zeros((2, 5))
            dense[:, one.columns] = one.H
            H.append(np.hstack([one.J, dense]))
            r.append(one.residual)
        H, r = np.vstack(H), np.concatenate(r)
        information = np.linalg.inv(P) + H.T @ H
        x = x - np.linalg.solve(information, np.linalg.solve(P, x) + H.T @ r)
    assert corrected.pose == pytest.approx(se2.compose(belief.pose, se2.exp(x[:3])), abs=2e-5)
    assert corrected.installation.mean == pytest.approx(known.mean + x[3:], abs=2e-5)
    assert corrected.joint_cov(corrected.installation) == pytest.approx(np.linalg.inv(information), rel=0.01, abs=1e-7)
    assert cost == pytest.approx(float(r @ r + x @ np.linalg.solve(P, x)), rel=0.01)


def test_a_correction_that_does_not_settle_says_so():
    factors = LandmarkFactors(POINTS, Installation({}))
    m = replace(seen_from(np.zeros(3), 0, np.random.default_rng(0)), range_m=math.nan)
    belief = PoseWithCovariance(np.zeros(3), np.eye(3))
    assert correct(belief, InstallationEstimate(np.zeros(0), np.zeros((0, 0))), [m], factors) is None


# --- online against batch ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "lag_s"), [("fixed_lag", 100.0), ("fixed_lag", 1.0), ("isam2", 10.0), ("ekf", 10.0)], ids=str
)
def test_online_with_an_installation_equals_the_batch(kind, lag_s):
    """On a short run that is nearly linear: poses, the installation, and both covariances; however short the window."""
    rng, sigmas = np.random.default_rng(2), dict(zip(NAMES[:4], SIGMAS[:4], strict=True))
    factors = LandmarkFactors(POINTS, Installation(sigmas))
    truth_theta = rng.normal(0.0, SIGMAS[:4])
    made = ExtendedKalmanFilter if kind == "ekf" else IncrementalEstimator
    estimator = made(EstimatorConfig(kind=kind, lag_s=lag_s), factors, keep_all=True)
    estimator.start(0, PoseWithCovariance(np.zeros(3), np.eye(3) * 1e-6))
    truth, step, Q = np.zeros(3), np.array([0.04, 0.0, 0.02]), np.diag([0.002, 0.001, 0.002]) ** 2
    by_radius = se2.log(step)
    for k in range(1, 60):
        truth = se2.compose(truth, se2.compose(step, se2.exp(by_radius * truth_theta[0])))
        measured = se2.compose(step, se2.exp(rng.multivariate_normal(np.zeros(3), Q)))
        motion = MotionMeasurement("wheels", k - 1, k, measured, Q, {"wheels.radius": (by_radius, 0.0)})
        seen = []
        for i in rng.choice(5, 2, replace=False):
            ahead = se2.compose(truth, se2.exp(np.array([0.4, 0.0, 0.2]) * -truth_theta[3]))
            m = seen_from(ahead, int(i), rng, (0.4, 0.0, 0.2))
            m = replace(m, range_m=m.range_m * math.exp(-truth_theta[1]), bearing_rad=m.bearing_rad + truth_theta[2])
            seen.append(factors.sighting(k, replace(m, stamp_ns=k), None))
        belief = estimator.update(k * 10**8, 0.1, [motion], seen)
    solver = BatchSmoother(estimator.log, factors, BatchConfig(), 1 - 1e-9)
    result, installed = solver.result(), solver.installed()
    sigma = np.sqrt(np.diag(result.covs[-1]))
    assert (np.abs(se2.log(se2.between(result.poses[-1], belief.pose))) < 0.1 * sigma).all()
    assert np.sqrt(np.diag(belief.cov)) == pytest.approx(sigma, rel=0.03)
    spread = np.sqrt(np.diag(installed.cov))
    assert (np.abs(installed.mean - belief.installation.mean) < 0.1 * spread).all()
    assert np.sqrt(np.diag(belief.installation.cov)) == pytest.approx(spread, rel=0.03)
    assert (np.abs(installed.mean - truth_theta) < 3.5 * spread).all()
    assert (spread[:3] < 0.8 * np.array(SIGMAS[:3])).all()  # something was found


# --- derivatives of the motions ---------------------------------------------------------------------------------------

STILL = np.zeros(3), np.zeros((3, 3))  # acceleration and covariance of an IMU that gives neither


def turning(i: int, dt: float = 0.1, later_s: float = 0.0) -> Step:
    """Commands of a robot that speeds up into a curve, as a clock shows them that is late by ``later_s``."""
    start, end = START_NS + round(i * dt * 1e9), START_NS + round((i + 1) * dt * 1e9)
    commands = []
    for j in range(-30, 40):
        t = i * dt + 0.01 * j
        stamp = START_NS + round((t + later_s) * 1e9)
        commands.append(ControlEvent(stamp, stamp, "/cmd_vel", 0.3 + 0.2 * t, 0.4 + 0.8 * t))
    kept = tuple(c for c in commands if c.stamp_ns <= end)
    imu = tuple(
        ImuEvent(t, t, "/imu", "imu", np.array([0.0, 0.0, 0.4 + 0.8e-9 * (t - START_NS)]), *STILL)
        for t in range(start, end + 1, 10_000_000)
    )
    return Step(i, 0, start, end, by_class((*kept, *imu)))


def readings_with(theta: dict[str, float], later_s: float = 0.0, **gains):
    settings = Config.model_validate({"wheels": {"source": "command", "track": 0.3, **gains}})
    installation = Installation(dict.fromkeys(theta, 0.01))
    factors = LandmarkFactors(None, installation)
    factors.estimated = replace(factors.estimated, mean=np.array(list(theta.values())))
    sensors = MotionSensors(WheelMotion(settings.wheels), gyro=Gyro(GyroConfig()))
    some = MotionSources(settings, sensors, factors)
    some.read(turning(0, later_s=later_s))
    return some.read(turning(1, later_s=later_s))


@pytest.mark.parametrize(
    ("name", "gains"),
    [
        ("wheels.radius", lambda h: {"scale_v": 1 + h, "scale_omega": 1 + h}),
        ("wheels.track", lambda h: {"scale_omega": 1 - h}),
        ("wheels.yaw_per_m", lambda h: {"yaw_per_m": h}),
    ],
)
def test_derivatives_of_the_wheels_are_those_of_their_model(name, gains):
    h = 1e-4
    derivative, assumed = readings_with({name: 0.0}).wheels.depends_on[name]
    there, back = (readings_with({}, **gains(sign * h)).wheels.motion for sign in (1.0, -1.0))
    numeric = se2.log(se2.between(back, there)) / (2 * h)
    assert derivative == pytest.approx(numeric, rel=0.01, abs=2e-3 * np.abs(numeric).max())
    assert assumed == 0.0
    moved = readings_with({name: 10 * h})  # what is known is put in, and said to be
    assert moved.wheels.depends_on[name][1] == pytest.approx(10 * h)
    expected = readings_with({}, **gains(10 * h)).wheels.motion
    assert moved.wheels.motion == pytest.approx(expected, abs=1e-5)


def test_noise_of_the_wheels_turn_is_not_in_their_derivatives_where_a_gyro_measures_it():
    """Else derivative and residual are correlated: the scale would drift away in a long run."""
    by, noisy = ({"wheels.track": 0.0}, {"scale_omega": 1.05})
    gyro = GyroConfig().yaw_per_sqrt_s ** 2 * 0.1
    true, off = readings_with(by).wheels, readings_with(by, **noisy).wheels
    share = gyro / (gyro + off.cov[2, 2])
    assert share < 0.5
    change = off.depends_on["wheels.track"][0][2] - true.depends_on["wheels.track"][0][2]
    assert abs(change) < 1.05 * share * abs(off.motion[2] - true.motion[2])
    assert abs(off.motion[2] - true.motion[2]) > 0.04 * abs(true.motion[2])


def test_the_derivative_by_the_clock_of_the_wheels_is_that_of_other_stamps():
    """The motion over a step as told by stamps that are late by h is the true one of a time h before."""
    h = 0.02
    derivative, _ = readings_with({"wheels.time_offset_s": 0.0}).wheels.depends_on["wheels.time_offset_s"]
    true, late = (readings_with({}, later_s).wheels.motion for later_s in (0.0, h))
    # knowing that they are late by h corrects the late motion to the true one
    corrected = se2.compose(late, se2.exp(derivative * h))
    assert np.abs(se2.between(true, corrected)).max() < 0.35 * np.abs(se2.between(true, late)).max()


def test_the_derivative_by_the_scale_of_the_gyro_is_its_turn():
    reading = readings_with({"gyro.scale": 0.0}).gyro
    derivative, _ = reading.depends_on["gyro.scale"]
    assert derivative[2] == pytest.approx(reading.motion[2], rel=1e-6)
    h = 1e-4
    scaled = se2.compose(reading.motion, se2.exp(derivative * h))
    assert scaled[2] == pytest.approx(reading.motion[2] * (1 + h), rel=1e-6)


# --- errors that are found in a drive ---------------------------------------------------------------------------------


SWING, BEAT = 0.12, 2.0  # rad, rad/s: how far the robot is ahead on its circle, now and then
PER_SQRT_M = 0.006
QUIET = {"wheels": {"noise": dict.fromkeys(NOISE, 0.0) | {"x_per_sqrt_m": PER_SQRT_M, "yaw_per_sqrt_m": PER_SQRT_M}}}


class Wobbling(World):
    """A world whose robot goes now faster, now slower, and has an IMU; without that no clock shows.

    Attributes:
        radius: true over reported speed of the wheels.
        late_ms: how much later than their exposure sightings are stamped.
    """

    radius: float = 1.0
    late_ms: int = 0

    def truth(self, stamp_ns: int) -> np.ndarray:
        t = (stamp_ns - self.start_ns) * 1e-9
        return truth_at(t, SWING * math.sin(BEAT * t))

    def events(self):
        made = []
        for event in super().events():
            if isinstance(event, CornersEvent):
                at = event.stamp_ns + self.late_ms * 1_000_000
                event = replace(event, stamp_ns=at, received_ns=max(event.received_ns, at))
            made.append(event)
        for tick in range(round(self.seconds * 50)):
            stamp = self.start_ns + tick * 20_000_000
            rate = np.array([0.0, 0.0, self._rate(stamp) + self._rng.normal(0.0, 0.002 * math.sqrt(50.0))])
            made.append(ImuEvent(stamp, stamp, "/imu", "imu", rate, np.zeros(3), np.zeros((3, 3))))
        return sorted(made, key=lambda e: e.received_ns)

    def _odometry(self, stamp: int) -> OdometryEvent:
        rate = self._rate(stamp)
        spread = PER_SQRT_M * math.sqrt(abs(rate) / TURN * SPEED / 0.05)
        v, omega = np.array([rate / TURN * SPEED, rate]) / self.radius + self._rng.normal(0.0, spread, 2)
        twist = np.array([v, 0.0, 0.0]), np.array([0.0, 0.0, omega])
        place = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((6, 6))
        return OdometryEvent(stamp, stamp, "/odom", "odom", "base_link", *place, *twist, np.zeros((6, 6)))

    def _rate(self, stamp: int) -> float:
        return TURN + SWING * BEAT * math.cos(BEAT * (stamp - self.start_ns) * 1e-9)


def found_in(world: World, settings: Config, name: str, gyro: bool = True):
    """What is found of a parameter and its sigma, online and by the batch; the chain and its estimates."""
    chain = Chain(settings, world.map, keep_all=True, gyro=Gyro(settings.gyro) if gyro else None)
    estimates = chain.run(world.events())
    factors = chain.localizer.factors
    online = factors.estimated
    i = factors.installation.index[name]
    log = chain.localizer.estimator.log
    batch = BatchSmoother(log, factors, settings.batch, settings.estimator.gate_probability).installed()
    pairs = [(float(b.mean[i]), math.sqrt(b.cov[i, i])) for b in (online, batch)]
    return pairs, factors.installation.sigmas[i], chain, estimates


def moved_map(landmark_map: LandmarkMap, i: int, dx: float, dy: float) -> LandmarkMap:
    landmark = landmark_map.landmarks[i]
    there = replace(landmark, position=landmark.position + np.array([dx, dy, 0.0]))
    return LandmarkMap({**landmark_map.landmarks, i: there}, landmark_map.dictionary)


def check_found(pairs, truth: float, prior: float, share: float = 0.5) -> None:
    for (value, sigma), which in zip(pairs, ("online", "batch"), strict=True):
        assert abs(value - truth) < 3.0 * sigma, (which, value, sigma)
        assert sigma < share * prior, (which, sigma)
        assert abs(value) > 2.0 * sigma, (which, value, sigma)  # it is told from none


@pytest.mark.parametrize("late_ms", [12, -15])
@pytest.mark.parametrize("gyro", [True, False])
def test_a_late_clock_of_the_camera_is_found(late_ms, gyro):
    world = Wobbling(room(), seconds=20.0)
    world.late_ms = late_ms
    pairs, prior, _, estimates = found_in(world, config(**QUIET), "camera.time_offset_s", gyro)
    check_found(pairs, late_ms * 1e-3, prior, 0.5)
    last = estimates[-1]
    assert position_error(last, world.truth(last.stamp_ns)) < 0.02
    assert nees(last, world.truth(last.stamp_ns)) < 20.0


@pytest.mark.parametrize("radius", [1.02, 0.98])
def test_wheels_of_another_radius_are_found(radius):
    world = Wobbling(room(), seconds=20.0)
    world.radius = radius
    pairs, prior, _, _ = found_in(world, config(**QUIET), "wheels.radius")
    check_found(pairs, math.log(radius), prior, 0.5)


def test_a_marker_that_hangs_elsewhere_by_centimetres_is_found():
    world_map = room()
    world = World(world_map, seconds=40.0, shown=moved_map(world_map, 7, 0.012, -0.01))
    settings = exact(map={"position_sigma_m": 0.01})
    for name, truth in (("map.7.x_m", 0.012), ("map.7.y_m", -0.01)):
        pairs, prior, chain, _ = found_in(world, settings, name, gyro=False)
        check_found(pairs, truth, prior)
    assert not chain.localizer.sightings.modes.displacements


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_scale_and_offset_of_ranges_and_bearings_are_found_with_an_honest_sigma(sign):
    scale, bias = 1.0 + 0.03 * sign, -0.02 * sign
    settings = exact(landmarks={"range_scale_sigma": 0.05, "bearing_bias_sigma_rad": 0.05})
    sizes = []
    for seed in range(4):
        world = World(beacons(), seed=seed, range_scale=scale, bearing_bias=bias)
        pairs, prior, chain, estimates = found_in(world, settings, "sightings.range_scale", gyro=False)
        check_found(pairs, -math.log(scale), prior, 0.2)
        known, index = chain.localizer.factors.estimated, chain.localizer.factors.installation.index
        rows = [index["sightings.range_scale"], index["sightings.bearing_offset_rad"]]
        error = known.mean[rows] - [-math.log(scale), bias]
        sizes.append(error @ np.linalg.solve(known.cov[np.ix_(rows, rows)], error))
        poses = np.mean([nees(e, world.truth(e.stamp_ns)) for e in estimates[50:]]) / 3
        assert 0.2 < poses < 3.0
    assert np.mean(sizes) < 5.0  # 2 on average


def displaced(event, ahead: float, left: float):
    """Ranges and bearings as a sensor sees them that sits elsewhere on the robot."""
    if not isinstance(event, RangeBearingEvent):
        return event
    seen = []
    for s in event.sightings:
        x, y = s.range_m * math.cos(s.bearing_rad) - ahead, s.range_m * math.sin(s.bearing_rad) - left
        seen.append(replace(s, range_m=math.hypot(x, y), bearing_rad=math.atan2(y, x)))
    return replace(event, sightings=tuple(seen))


def test_the_place_of_a_sensor_of_ranges_and_bearings_is_found_with_an_honest_sigma():
    there = np.array([0.08, -0.05])
    settings = exact(landmarks={"position_sigma_m": 0.1})
    for seed in range(3):
        world = World(beacons(), seed=seed)
        chain = Chain(settings, world.map)
        chain.run([displaced(event, *there) for event in world.events()])
        known, index = chain.localizer.factors.estimated, chain.localizer.factors.installation.index
        rows = [index["sightings.x_m"], index["sightings.y_m"]]
        error = known.mean[rows] - there
        assert abs(error[0]) < 0.03  # to the left it is hardly told from the bearing on a circle
        assert error @ np.linalg.solve(known.cov[np.ix_(rows, rows)], error) < 14.0  # 1 in 1000 is larger


def test_poses_are_over_confident_where_a_wrong_range_is_taken_as_exact():
    world = World(beacons(), range_scale=1.03, bearing_bias=0.02)
    known = Chain(exact(landmarks={"range_scale_sigma": 0.05, "bearing_bias_sigma_rad": 0.05}), world.map)
    naive = Chain(exact(), world.map)
    a, b = (
        np.mean([nees(e, world.truth(e.stamp_ns)) for e in chain.run(world.events())[50:]]) for chain in (known, naive)
    )
    assert b > 2.0 * a


@pytest.mark.parametrize("kind", ["fixed_lag", "ekf"])
@pytest.mark.parametrize("landmarks", [room, beacons], ids=["corners", "beacons"])
def test_an_exact_installation_runs_without_states(kind, landmarks):
    world = World(landmarks(), seconds=6.0)
    chain = Chain(exact(estimator={"kind": kind}), world.map, keep_all=True)
    estimates = chain.run(world.events())
    localizer = chain.localizer
    assert len(localizer.factors.installation) == 0
    last = estimates[-1]
    assert nees(last, world.truth(last.stamp_ns)) < 20.0
    solver = BatchSmoother(localizer.estimator.log, localizer.factors, BatchConfig(), 0.9999)
    assert len(solver.installed().mean) == 0
    assert np.isfinite(solver.result().covs).all()
    assert set(EXACT) <= set(Config.model_fields)
