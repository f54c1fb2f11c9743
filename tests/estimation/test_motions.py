"""What of the motion sources enters the graph: all they say together, no more, however time is cut."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from exact import exact
from motion_models import make_card, make_tensors
from robot_world import SPEED, START_NS, TURN, Chain, World, beacons, nees, position_error, room
from robot_world import config as world_config
from scipy.stats import chi2

from fgloc import se2
from fgloc.config import Config, GyroConfig, MotionConfig, WheelsConfig
from fgloc.estimation.log import motion_decisions
from fgloc.estimation.motion import MotionFaultMonitor, MotionSources, TurnComparison, source_difference
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.ground import predict
from fgloc.graph.installation import Installation
from fgloc.graph.joint import fuse
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import NoiseBudget
from fgloc.sensors.base import Turn
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.gyro import Gyro, ImuEvent
from fgloc.sensors.learned.network import JointCalibration
from fgloc.sensors.learned.sensor import LearnedMotion, load_model, save_model
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.stats import GATE, chi2_bound
from fgloc.types import ControlEvent, Mode, MotionMeasurement, MotionReadings, Step, by_class

W, N = np.diag([0.012, 0.004, 0.02]) ** 2, np.diag([0.008, 0.003, 0.03]) ** 2
L_W, L_N = np.linalg.cholesky(W), np.linalg.cholesky(N)
C = L_N @ np.diag([0.44, 0.3, 0.6]) @ L_W.T  # E[e_n e_w']


def says(source: str, motion, cov) -> MotionMeasurement:
    return MotionMeasurement(source, 0, 10**8, np.asarray(motion, dtype=float), np.asarray(cov))


WHEELS = says("wheels", [0.050, 0.001, 0.020], W)
LEARNED = says("learned", [0.058, 0.000, 0.012], N)
GYRO = says("gyro", [0.050, 0.001, 0.016], np.diag([100.0, 100.0, 1e-5]))


def learned_motion(tmp_path, kind="displacement", **card) -> LearnedMotion:
    made = make_card(kind, **card)
    save_model(tmp_path / "m.safetensors", make_tensors(made, np.random.default_rng(0)), made)
    return LearnedMotion(load_model(tmp_path / "m.safetensors"), MotionConfig())


def sources(learned=None, joint=None, **sections) -> MotionSources:
    settings = Config.model_validate(sections)
    return MotionSources(settings, MotionSensors(WheelMotion(settings.wheels), learned, joint))


def combined(some: MotionSources, readings: MotionReadings, *budget, **named) -> list[MotionMeasurement]:
    return NoiseBudget(*budget, **named).combine(readings, some.rules)


def names(motions) -> list[str]:
    return [m.source for m in motions]


def test_the_pair_says_what_the_joint_gaussian_says(tmp_path):
    """Of all unbiased combinations of two measurements with correlated errors the best one, to the last digit."""
    both = sources(learned_motion(tmp_path), JointCalibration(W, N, C))
    motion, cov = fuse(combined(both, MotionReadings(WHEELS, LEARNED)))
    # the conditional of the joint, written out: x from [z_w; z_n] = [I; I] x + [e_w; e_n]
    P = np.linalg.inv(np.block([[W, C.T], [C, N]]))
    H = np.vstack([np.eye(3), np.eye(3)])
    expected_cov = np.linalg.inv(H.T @ P @ H)
    d = se2.log(se2.between(WHEELS.motion, LEARNED.motion))
    expected = se2.compose(WHEELS.motion, se2.exp(expected_cov @ H.T @ P @ np.concatenate([np.zeros(3), d])))
    assert motion == pytest.approx(expected, abs=1e-12)
    assert cov == pytest.approx(expected_cov, rel=1e-9)
    independent, too_small = fuse(combined(sources(learned_motion(tmp_path)), MotionReadings(WHEELS, LEARNED)))
    assert np.linalg.det(too_small) < 0.7 * np.linalg.det(expected_cov)
    assert np.abs(independent - expected).max() > 1e-4


def test_the_pair_is_honest_over_samples(tmp_path):
    rng, values = np.random.default_rng(2), {"joint": [], "independent": []}
    truth = np.array([0.05, 0.0, 0.015])
    model = learned_motion(tmp_path)
    made = {"joint": sources(model, JointCalibration(W, N, C)), "independent": sources(model)}
    for e in rng.multivariate_normal(np.zeros(6), np.block([[W, C.T], [C, N]]), 400):
        readings = MotionReadings(
            replace(WHEELS, motion=se2.compose(truth, se2.exp(e[:3]))),
            replace(LEARNED, motion=se2.compose(truth, se2.exp(e[3:]))),
        )
        for name, which in made.items():
            motion, cov = fuse(combined(which, readings))
            error = se2.log(se2.between(motion, truth))
            values[name].append(error @ np.linalg.solve(cov, error))
    low, high = chi2.ppf([0.001, 0.999], 3 * 400)
    assert low < sum(values["joint"]) < high
    assert sum(values["independent"]) > high


def test_what_enters_when_a_source_is_not_believed(tmp_path):
    all_say = MotionReadings(WHEELS, LEARNED, GYRO)
    some = sources(learned_motion(tmp_path), JointCalibration(W, N, C))
    assert names(combined(some, all_say)) == ["wheels", "learned", "gyro"]
    dead = combined(some, all_say, {"wheels": "frozen"})
    assert names(dead) == ["learned", "gyro"]
    assert dead[0].motion == pytest.approx(LEARNED.motion)  # plain: there is nothing left that it is correlated with
    assert dead[0].cov == pytest.approx(4.0 * LEARNED.cov)  # what makes wheels wrong is not all in a model
    without = combined(some, all_say, {"learned": "distrusted"})
    assert names(without) == ["wheels", "gyro"]
    assert without[0] is WHEELS
    assert names(combined(some, all_say, {"gyro": "distrusted"})) == ["wheels", "learned"]


def test_the_reference_source_may_change_from_step_to_step(tmp_path):
    """As at the start of a live run, when the first command comes after the first wheel messages."""
    installation = Installation({"wheels.radius": 0.01, "gyro.scale": 0.005, "motion.scale": 0.02})
    settings = Config()
    sensors = MotionSensors(WheelMotion(settings.wheels), learned_motion(tmp_path), None, Gyro(GyroConfig()))
    some = MotionSources(settings, sensors, LandmarkFactors(None, installation))
    ahead = np.array([0.05, 0.0, 0.02])
    wheels = replace(WHEELS, depends_on={"wheels.radius": (ahead, 0.0)})
    learned = replace(LEARNED, depends_on={"motion.scale": (ahead, 0.0)})
    gyro = replace(GYRO, depends_on={"gyro.scale": (np.array([0.0, 0.0, 0.02]), 0.0)})
    faults = MotionFaultMonitor(settings.weights, some, None)
    step = Step(0, 0, START_NS, START_NS + 10**8, {})
    faults.begin(step)
    for readings in (MotionReadings(wheels, None, gyro), MotionReadings(wheels, learned, gyro)) * 3:
        assert faults.judge(step, readings).nis < chi2_bound(GATE, 3)


def test_sources_that_disagree_are_known_less_well_together(tmp_path):
    pair = MotionReadings(WHEELS, LEARNED)
    some = sources(learned_motion(tmp_path), JointCalibration(W, N, C))
    motion, cov = fuse(combined(some, pair, scale=3.0))
    as_usual, usual = fuse(combined(some, pair))
    assert cov == pytest.approx(3.0 * usual)
    assert motion == pytest.approx(as_usual)  # between the two as before
    wheels, learned = combined(sources(learned_motion(tmp_path)), pair, scale=100.0)
    assert wheels.cov == pytest.approx(100.0 * WHEELS.cov)
    assert learned.cov == pytest.approx(4.0 * LEARNED.cov)  # it is the wheels that slip


def test_wheels_that_alone_know_the_way_are_kept_with_room_for_a_slip():
    kept = combined(sources(), MotionReadings(WHEELS, None, GYRO), {"wheels": "slip"})
    assert names(kept) == ["wheels", "gyro"]
    assert (np.diag(kept[0].cov) > 10.0 * np.diag(W)).all()
    assert kept[1].motion == pytest.approx([*WHEELS.motion[:2], GYRO.motion[2]])
    _, cov = fuse(kept)
    assert cov[2, 2] < 1.1e-5  # the gyro knows the turn still
    assert combined(sources(), MotionReadings(None, None, GYRO)) == []  # and no more than that


def test_a_gyro_that_the_model_reads_does_not_enter_again(tmp_path):
    reading = sources(learned_motion(tmp_path, inputs=("commands", "gyro")))
    assert names(combined(reading, MotionReadings(WHEELS, LEARNED, GYRO))) == ["wheels", "learned"]
    assert names(combined(reading, MotionReadings(WHEELS, None, GYRO))) == ["wheels", "gyro"]
    assert names(combined(reading, MotionReadings(WHEELS, LEARNED, GYRO), {"learned": "distrusted"})) == [
        "wheels",
        "gyro",
    ]


@pytest.mark.parametrize("reads", ["commands", "gyro"])
def test_a_model_depends_on_the_scale_of_the_gyro_only_if_it_reads_it(tmp_path, reads):
    learned = learned_motion(tmp_path, inputs=("commands", "gyro")[: 1 + (reads == "gyro")])
    settings, installation = Config(), Installation({"gyro.scale": 0.005, "learned.scale": 0.02})
    sensors = MotionSensors(WheelMotion(settings.wheels), learned, None, Gyro(GyroConfig()))
    some = MotionSources(settings, sensors, LandmarkFactors(None, installation))
    found = [some.read(step(k, 0.1)).learned for k in range(30)][-1]
    assert found is not None
    assert set(found.depends_on) == ({"learned.scale", "gyro.scale"} if reads == "gyro" else {"learned.scale"})


def step(i: int, dt: float, omega=0.0) -> Step:
    start, end = START_NS + round(i * dt * 1e9), START_NS + round((i + 1) * dt * 1e9)
    n = round(dt / 0.05)
    stamps = [START_NS + round((i * dt + 0.05 * j) * 1e9) for j in range(-1, n + 2)]
    commands = tuple(ControlEvent(t, t, "/cmd_vel", SPEED, TURN) for t in stamps[:-1])
    rates = np.array([0.0, 0.0, TURN + omega])
    imu = tuple(ImuEvent(t, t, "/imu", "imu", rates, np.zeros(3), np.zeros((3, 3))) for t in stamps)
    return Step(i, 0, start, end, by_class((*commands, *imu)))


def test_commands_that_stand_in_for_wheels_are_left_out_beside_a_model_that_reads_them(tmp_path):
    learned = learned_motion(tmp_path)
    alone, beside = sources(wheels={"source": "command"}), sources(learned, wheels={"source": "command"})
    for which in (alone, beside):
        which.read(step(0, 0.1))
    assert names(combined(alone, alone.read(step(1, 0.1)))) == ["wheels"]
    readings = beside.read(step(1, 0.1))
    assert readings.wheels is not None
    assert names(combined(beside, readings)) == ["learned"]
    assert source_difference(readings, beside) is None  # both are made of the commands


def end_pose(dt: float, sigmas, off=(0.0, 0.0, 0.0)) -> PoseWithCovariance:
    """Belief after 10 s, from the origin; ``off`` is what is known of radius, track and yaw_per_m."""
    names_ = ("wheels.radius", "wheels.track", "wheels.yaw_per_m")
    factors = LandmarkFactors(None, Installation(dict(zip(names_, sigmas, strict=True))))
    if len(factors.installation):
        factors.estimated = replace(factors.estimated, mean=np.array(off))
    settings = Config.model_validate({"wheels": {"source": "command", "noise": {}}})
    some = MotionSources(settings, MotionSensors(WheelMotion(settings.wheels)), factors)
    belief = PoseWithCovariance(np.zeros(3), np.zeros((3, 3)))
    for i in range(round(10.0 / dt)):
        readings = some.read(step(i, dt))
        if readings.wheels is not None:
            belief = predict(belief, factors.estimated, factors.installation, [readings.wheels])
    return belief


def test_systematic_errors_of_the_wheels_grow_with_the_way_however_it_is_cut():
    """The joint prediction spreads them along the path as driving it with other wheels would."""
    sigmas = np.array([0.02, 0.05, 0.01])
    moved = [end_pose(0.05, sigmas, off).pose for off in 1e-3 * np.vstack([np.eye(3), -np.eye(3)])]
    J = np.array([se2.log(se2.between(b, a)) / 2e-3 for a, b in zip(moved[:3], moved[3:], strict=True)]).T
    expected = J @ np.diag(sigmas**2) @ J.T
    for dt in (0.05, 0.2):
        grown = end_pose(dt, sigmas).cov - end_pose(dt, np.zeros(3)).cov
        assert np.abs(grown - expected).max() < 0.03 * np.abs(expected).max()
        assert end_pose(dt, sigmas).cross == pytest.approx(J @ np.diag(sigmas**2), abs=0.02 * 0.05**2 * 10.0)


def test_factors_made_again_keep_what_sightings_said_against_them():
    overruled_cov = np.diag([0.01, 0.0, 0.04])
    (made,) = combined(sources(), MotionReadings(WHEELS), scale=4.0, overruled_cov=overruled_cov)
    assert made.cov == pytest.approx(4.0 * W + overruled_cov)
    (as_read,) = combined(sources(), MotionReadings(WHEELS))
    assert as_read.cov == pytest.approx(W)


@pytest.mark.parametrize(
    ("rejected", "scale", "weights"),
    [({}, 1.0, (1.0, 1.0)), ({}, 9.0, (1 / 9, 1 / 4)), ({}, 0.25, (4.0, 2.0)), ({"wheels": "slip"}, 9.0, (0.0, 1 / 4))],
)
def test_weights_of_a_step_say_what_happened_to_its_covariances(tmp_path, rejected, scale, weights):
    readings = MotionReadings(WHEELS, LEARNED)
    budget = NoiseBudget(rejected, scale)
    made = budget.combine(readings, sources(learned_motion(tmp_path)).rules)
    rows = {d.kind: d for d in motion_decisions(3, made, readings, budget)}
    assert (rows["wheels"].weight, rows["learned"].weight) == pytest.approx(weights)
    for m in made:
        given = {"wheels": W, "learned": N}[m.source]
        assert m.cov == pytest.approx(given / rows[m.source].weight)


# --- the same covariance at 20 Hz and at 5 Hz -------------------------------------------------------------------------


class WithGyro(World):
    """The world with an IMU."""

    def events(self):
        made = super().events()
        for tick in range(round(self.seconds * 50)):
            stamp = self.start_ns + tick * 20_000_000
            rate = np.array([0.0, 0.0, TURN + self._rng.normal(0.0, 0.002 * math.sqrt(50.0))])
            made.append(ImuEvent(stamp, stamp, "/imu", "imu", rate, np.zeros(3), np.zeros((3, 3))))
        return sorted(made, key=lambda e: e.received_ns)


def blind_covs(tmp_path, max_interval_s: float, kind: str | None, gyro: bool, **wheels):
    """Covariance in the map frame every 2 s of 8 s without sightings."""
    adaptive = (
        not gyro and kind is None
    )  # what weighs disagreeing sources depends on their noise, which differs by chance
    kernels = {"cauchy_k": 1000.0}  # what these weigh differs by chance before the stretch, and with it the gyro's bias
    settings = exact(keyframes={"max_interval_s": max_interval_s}, weights={"adaptive": adaptive}, landmarks=kernels)
    settings = settings.model_copy(update={"wheels": settings.wheels.model_copy(update=wheels)})
    world_map = beacons()
    learned = None if kind is None else learned_motion(tmp_path, kind)
    joint = None if learned is None else JointCalibration(np.eye(3), np.eye(3), np.diag([0.4, 0.5, 0.7]))
    chain = Chain(settings, world_map, learned=learned, joint=joint, gyro=Gyro(GyroConfig()) if gyro else None)
    world = WithGyro(world_map, seconds=12.01, blind=((4.01, 13.0),))
    estimates = chain.run(world.events())
    for source, used in (("learned", learned is not None), ("gyro", gyro)):
        assert (chain.localizer.counts[source] > 40) == used
    at = [START_NS + round((4.0 + 2.0 * i) * 1e9) for i in range(5)]
    covs = {e.stamp_ns: e.cov for e in estimates}
    return np.array([covs[stamp] for stamp in at]), len(estimates)


@pytest.mark.parametrize(
    ("kind", "gyro", "wheels"),
    [
        (None, False, {}),
        (None, False, {"scale_sigma": 0.03, "turn_scale_sigma": 0.05}),
        (None, True, {}),
        ("naive", False, {}),
        ("velocity", True, {}),
        ("displacement", True, {}),
    ],
    ids=["wheels", "wheels, systematic", "gyro", "naive", "velocity", "displacement"],
)
def test_the_covariance_of_a_blind_stretch_does_not_depend_on_the_cadence(tmp_path, kind, gyro, wheels):
    fast, many = blind_covs(tmp_path, 0.05, kind, gyro, **wheels)
    slow, few = blind_covs(tmp_path, 0.2, kind, gyro, **wheels)
    assert many > few + 100
    grown = [np.array([c - covs[0] for c in covs[1:]]) for covs in (fast, slow)]
    for a, b in zip(*grown, strict=True):
        assert np.diag(a)[2] == pytest.approx(np.diag(b)[2], rel=0.05)
        assert np.trace(a[:2, :2]) == pytest.approx(np.trace(b[:2, :2]), rel=0.05)


# --- motion that nothing measures -------------------------------------------------------------------------------------


def gone(fixes: int, steps: int, seconds: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """Sigmas and way of a robot that nothing measures, in so many steps after fixes at 0.5 m/s, ten a second."""
    none = WheelMotion(WheelsConfig(source="none"))
    sources = MotionSources(Config(), MotionSensors(none, unmeasured=True))
    start = 10**18
    for k in range(fixes):
        belief = PoseWithCovariance(np.array([0.05 * k, 0.0, 0.0]), np.eye(3) * 1e-6)
        start = 10**18 + k * 10**8
        sources.commit(MotionReadings(), belief, start)
    limits = np.linspace(start, start + seconds * 1e9, steps + 1).astype(np.int64).tolist()
    made = [sources.unknown(Step(0, 0, a, b)) for a, b in pairwise(limits)]
    return np.sqrt(sum(np.diag(m.cov) for m in made)), sum(m.motion for m in made)


@pytest.mark.parametrize("fixes", [0, 1, 20])
def test_what_nothing_measures_is_as_unsure_in_one_step_as_in_many(fixes):
    for one, many in zip(gone(fixes, 1), gone(fixes, 60), strict=True):
        np.testing.assert_allclose(one, many, rtol=1e-6, atol=1e-9)


def test_a_robot_that_nothing_measures_goes_on_as_the_fixes_had_it():
    sigmas, way = gone(20, 6, 0.5)
    assert way == pytest.approx([0.22, 0.0, 0.0], abs=0.02)  # 0.25 m, as it may slow down
    assert sigmas[0] < 0.6 * gone(0, 6, 0.5)[0][0]
    _, far = gone(20, 60, 60.0)
    assert far == pytest.approx([1.0, 0.0, 0.0], abs=0.1)  # 0.5 m/s for the time constant


# --- turns of gyro and wheels, where nothing fixes the yaw ------------------------------------------------------------


@pytest.mark.parametrize(("per_m_sigma", "learned"), [(0.1, True), (0.0, False)])
def test_wheels_of_unequal_size_are_no_slip_to_the_comparison_with_a_gyro(per_m_sigma, learned):
    """They differ by 0.1 rad/s, of which some is the bias: more than gyros have, but not too much for such wheels."""
    settings = Config.model_validate({"wheels": {"yaw_per_m_sigma": per_m_sigma}, "gyro": {"bias_sigma": 0.02}})
    turns, wheels = TurnComparison(settings), says("wheels", [0.1, 0.0, 0.0], np.eye(3) * 1e-8)
    turned = Turn(0.1 * 0.2, 1e-6, 1e-6)
    for _ in range(50):
        turns.compare(0.2, turned, 0.0, wheels)
    corrected = turns.corrected(turned, 0.2, 0.0, 0.0, 0.02**2)
    share = 0.02**2 / (0.02**2 + (per_m_sigma * 0.5) ** 2)
    assert corrected.yaw == pytest.approx(turned.yaw - (share * turned.yaw if learned else 0.0), rel=0.02)


@pytest.mark.parametrize("kind", ["fixed_lag", "isam2", "ekf"])
@pytest.mark.parametrize("silent_s", [1.0, 3.0])
def test_a_silence_of_the_wheels_is_made_up_for_when_they_speak_again(kind, silent_s):
    """Nothing is seen then, nor for two seconds more; before, the steps of the silence had no motion."""
    again = 6.0 + silent_s
    world = World(room(), seed=1, seconds=again + 1.5, dumb=((6.0, again),), blind=((6.0, again + 2.0),))
    settings = world_config(estimator={"kind": kind})
    last = Chain(settings, room()).run(world.events())[-1]
    assert last.stamp_ns > START_NS + (again + 1.0) * 1e9
    assert last.mode is not Mode.LOST
    assert position_error(last, world.truth(last.stamp_ns)) < 0.05
    assert np.sqrt(np.diag(last.cov)).max() < 0.1
    assert nees(last, world.truth(last.stamp_ns)) < 12.0
