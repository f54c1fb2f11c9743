"""Bounds on the error: they hold the risk, grow with what may be wrong, and say what they are due to."""

import math

import numpy as np
import pytest
from robot_world import Chain, World, config, room
from scipy.stats import norm

from fgloc import se2
from fgloc.config import IntegrityConfig
from fgloc.estimation.integrity import Fix, ProtectionLevels
from fgloc.estimation.landmark_modes import MountModes
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.observation import Lines

COV = np.diag([0.004, 0.003, 0.005]) ** 2
STILL = np.zeros(3)
REST, DRIVES = np.zeros(3), np.array([0.4, 0.0, 0.1])


class Modes:
    """Hypotheses of displaced landmarks, as `LandmarkModes.displaced` gives them: (id, share, bias, covariance)."""

    def __init__(self, *rows):
        self._rows, self.mounts = rows, MountModes(3)

    def displaced(self, prior):
        return iter(self._rows)


def bound(modes=None, since_fix_s=0.0, speed=DRIVES, checked=False, **config):
    levels = ProtectionLevels(IntegrityConfig(**config), modes or Modes())
    return levels.of(COV, speed, since_fix_s, checked)


def displaced(landmark_id, share, bias_m, sigma_m=0.0):
    return landmark_id, share, np.array([bias_m, 0.0, 0.0]), np.diag([sigma_m**2, 0.0, 0.0])


def test_noise_alone_exceeds_with_less_than_the_risk():
    found = bound(risk_per_hour=1e-3)
    per_sample = 1e-3 / 360.0
    beyond = [2.0 * norm.sf(b / s) for b, s in zip(found.bound, np.sqrt(np.diag(COV)), strict=True)]
    assert sum(beyond) < per_sample
    assert found.cause == "noise"
    assert (bound(risk_per_hour=1e-5).bound > found.bound).all()


def test_the_bound_on_the_position_holds_for_noise_in_any_direction():
    found, rng = bound(risk_per_hour=0.5), np.random.default_rng(0)
    off = rng.multivariate_normal(np.zeros(2), COV[:2, :2], 1_000_000)
    assert np.mean(np.hypot(*off.T) > found.position_m) < 0.5 / 360.0
    assert found.position_m < np.hypot(found.bound[0], found.bound[1])


@pytest.mark.parametrize("share", [1e-3, 0.05, 0.9])
def test_the_risk_holds_over_all_hypotheses_together(share):
    """By numbers: the mixture of all distributions has no more than the risk beyond the bound, along the robot."""
    modes = Modes(displaced(3, share, 0.05, 0.03), displaced(8, 1e-4, 0.0, 0.4))
    found = bound(modes, since_fix_s=3.0, risk_per_hour=1e-2)
    x, sigma = float(found.bound[0]), float(np.sqrt(COV[0, 0]))

    def beyond(mean, spread):
        return norm.sf((x - mean) / spread) + norm.cdf((-x - mean) / spread)

    total = beyond(0.0, sigma) + share * beyond(0.05, np.hypot(sigma, 0.03)) + 1e-4 * beyond(0.0, np.hypot(sigma, 0.4))
    assert total < 1e-2 / 360.0


def test_a_landmark_that_may_be_displaced_is_named_while_it_matters():
    assert bound(Modes(displaced(7, 1e-3, 0.0, 0.3))).cause == "landmark 7"
    assert bound(Modes(displaced(7, 1e-12, 0.0, 0.3))).cause == "noise"
    assert bound(Modes(displaced(7, 1e-3, 0.0, 1e-5))).cause == "noise"


@pytest.mark.parametrize("cov", [np.eye(2), [[1.0, 0.9], [0.9, 1.0]], [[1.0, -0.5], [-0.5, 0.4]]])
def test_the_bound_on_the_position_holds_for_a_fault_in_any_direction(cov):
    """And is not much more: by numbers, of a landmark that moves the pose by this covariance [dm²]."""
    spread = np.zeros((3, 3))
    spread[:2, :2] = 0.01 * np.asarray(cov)
    found, rng = bound(Modes((7, 0.05, np.zeros(3), spread)), risk_per_hour=0.5), np.random.default_rng(1)
    off = rng.multivariate_normal(np.zeros(2), spread[:2, :2] + COV[:2, :2], 1_000_000)
    beyond = 0.05 * np.mean(np.hypot(*off.T) > found.position_m)
    assert 0.1 / 360.0 / 3.0 < beyond < 2.0 * 0.5 / 360.0 / 3.0


def test_a_constant_that_sightings_contradict_may_be_as_they_have_it():
    levels = ProtectionLevels(IntegrityConfig(), Modes())
    shift, spread = np.array([0.0, 0.02, 0.04]), np.array([0.0, 0.001, 0.002]) ** 2
    found = levels.of(COV, DRIVES, 0.0, False, as_seen=[("camera.ry_rad", shift, np.diag(spread))])
    sigmas = np.sqrt(np.diag(COV) + spread)
    assert found.cause == "camera.ry_rad"
    assert (2.0 * norm.sf((found.bound - shift) / sigmas)[1:] < 1e-3 / 360.0).all()
    assert found.bound[0] == pytest.approx(bound().bound[0], rel=0.05)  # half the risk at most is left for it


def test_constants_that_sightings_contradict_add_up_and_come_on_top_of_a_slip():
    def of(*shifts, since_fix_s=0.0):
        seen = [(f"constant {k}", np.array([0.0, 0.0, shift]), np.zeros((3, 3))) for k, shift in enumerate(shifts)]
        return ProtectionLevels(IntegrityConfig(), Modes()).of(COV, DRIVES, since_fix_s, False, as_seen=seen)

    assert of(0.05, 0.05).bound[2] == pytest.approx(of(0.05).bound[2] + 0.05, abs=1e-3)
    assert of(0.05, since_fix_s=5.0).bound[2] == pytest.approx(of(since_fix_s=5.0).bound[2] + 0.05, rel=0.02)


def test_a_camera_that_was_knocked_moves_the_pose_that_it_alone_tells():
    """Its sightings agree with each other; the bound covers what a change of its mounting would do."""
    modes, H = Modes(), np.eye(3) / 0.001
    W = np.linalg.inv(np.linalg.cholesky(H @ H.T + np.eye(3)))  # it tells the first pose
    modes.mounts.take(0, H, W, np.zeros(3), H.T @ W.T, ["front/corners"] * 3)
    found = bound(modes)
    assert found.cause == "mounting of camera front"
    assert 0.03 < found.position_m < 0.2
    assert 0.05 < found.bound[2] < 0.3


def test_a_camera_may_have_been_knocked_while_the_robot_was_parked_in_the_dark():
    """For an hour, or a year: the longer, the more probable."""
    shares = []
    for parked_s in (3600, 365 * 86400, 300 * 365 * 86400):
        modes, H, W = (
            MountModes(3),
            np.eye(3) / 0.001,
            np.linalg.inv(np.linalg.cholesky(np.diag([1e6] * 3) + np.eye(3))),
        )
        for stamp_ns in (0, parked_s * 10**9):
            modes.take(stamp_ns, H, W, np.zeros(3), H.T @ W.T, ["corners"] * 3)
        shares.append([share for _, share, *_ in modes.displaced()][1])
    assert 0.0 < shares[0] < shares[1] <= shares[2] <= 1.0


class Straight:
    """A robot that drives straight on, half a metre a step, with a camera that tells its pose to 2 mm and 2 mrad.

    Attributes:
        modes: that follow it.
    """

    def __init__(self):
        self.modes, self._cov, self._pose, self._steps = MountModes(3), COV.copy(), np.zeros(3), 0
        self._true = np.zeros(3)

    def drive(self, knocked=(0.0, 0.0, 0.0), slipped=(0.0, 0.0, 0.0), slips=0.0):
        """One step; the camera tells the pose with its mounting off, and the prior of a slip is so high."""
        ahead, H = np.array([0.5, 0.0, 0.0]), np.eye(3) / 0.002
        self._steps += 1
        self._true = se2.compose(se2.compose(self._true, ahead), np.array(slipped))
        A = se2.adjoint(se2.inverse(ahead))
        cov, pose = A @ self._cov @ A.T + np.diag([0.01, 0.002, 0.002]) ** 2, se2.compose(self._pose, ahead)
        self.modes.move(A, np.zeros((3, 0)))
        innovation = H @ se2.log(se2.between(se2.compose(self._true, np.array(knocked)), pose))
        W = np.linalg.inv(np.linalg.cholesky(H @ cov @ H.T + np.eye(3)))
        gain = cov @ H.T @ W.T
        self.modes.take(self._steps * 500_000_000, H, W, W @ innovation, gain, ["corners"] * 3)
        self.modes.weigh(slips, np.array([0.25, 0.25, 0.15]) ** 2)
        self._pose = se2.compose(pose, se2.exp(-gain @ W @ innovation))
        self._cov = cov - gain @ gain.T

    def likeliest(self):
        """Probability of the most probable hypothesis, and the error of the pose under it."""
        _, share, mean, _ = max(self.modes.displaced(), key=lambda one: one[1])
        return share, mean


@pytest.mark.parametrize("slips", [0.0, 0.005])
def test_the_way_a_robot_drives_tells_that_its_camera_was_turned(slips):
    """The turned camera has it going aslant by 0.06 rad, which slips explain only if each step has one."""
    robot = Straight()
    for _ in range(20):
        robot.drive(knocked=(0.0, 0.0, 0.06), slips=slips)
    share, mean = robot.likeliest()
    assert share > 0.99
    assert abs(mean[2]) == pytest.approx(0.06, abs=0.01)


def test_what_a_slip_explains_is_no_evidence_that_a_camera_was_knocked():
    def after_slip(slips):
        robot = Straight()
        for k in range(9):
            robot.drive(slipped=(-0.05, 0.05, 0.05) if k == 3 else (0.0, 0.0, 0.0), slips=slips)
        return robot.likeliest()[0]

    assert after_slip(0.0) > 0.999
    assert after_slip(0.005) < 1e-3


def test_a_slip_that_the_last_fix_showed_may_go_on():
    def soon_after(off_m):
        levels = ProtectionLevels(IntegrityConfig(), Modes())
        levels.of(COV, DRIVES, 0.0, False, fix=fix_by(0.02, off_m))
        return levels.of(COV, DRIVES, 0.2, False).position_m

    assert soon_after(0.3) > 1.05 * soon_after(0.0)


def test_a_robot_that_may_have_been_carried_away_is_bounded_by_the_hall():
    found = ProtectionLevels(IntegrityConfig(), Modes()).of(
        COV, DRIVES, 0.0, False, carried=(0.01, np.diag(np.square([4.0, 4.0, 0.1])))
    )
    assert found.cause == "carried away"
    assert 0.01 * 2.0 * norm.sf(found.bound[0] / 4.0) == pytest.approx(1e-3 / 360.0 / 3.0, rel=0.05)


def test_without_a_yaw_nothing_is_along_or_across():
    """A robot whose yaw nobody knows: each axis is bounded as the distance is, and the yaw by half a turn."""
    cov = np.diag(np.square([1.0, 0.01, 1.5]))
    found = ProtectionLevels(IntegrityConfig(), Modes()).of(cov, DRIVES, 0.0, False)
    assert found.bound[2] == math.pi
    assert found.bound[:2].tolist() == [pytest.approx(found.position_m)] * 2
    known = ProtectionLevels(IntegrityConfig(), Modes()).of(np.diag(np.square([1.0, 0.01, 0.1])), DRIVES, 0.0, False)
    assert known.bound[1] < 0.1 < known.bound[0] <= known.position_m
    assert known.position_m == pytest.approx(found.position_m)


def test_in_the_dark_a_slip_may_go_unseen_and_less_of_it_between_two_sources():
    fixed, dark, checked = bound(), bound(since_fix_s=5.0), bound(since_fix_s=5.0, checked=True)
    assert dark.cause == "slip"
    assert fixed.position_m < checked.position_m < dark.position_m
    assert bound(since_fix_s=5.0, speed=REST).position_m == pytest.approx(fixed.position_m, rel=0.01)


def test_where_wheels_have_slipped_in_this_run_the_dark_is_bounded_more_widely():
    world, bounds = World(room(), seconds=6.0, rate=5, blind=((3.0, 6.0),)), []
    for slips in (0, 20):
        chain = Chain(config(), world.map)
        chain.localizer.motion._faults.flags["wheels.slip"] = slips
        bounds.append([e.protection.position_m for e in chain.run(world.events())[-8:]])
    assert (np.array(bounds[1]) > np.array(bounds[0])).all()


def test_in_a_long_darkness_several_slips_add_up():
    """In 400 and 1600 s, 4 and 16 slips are to be expected beside the one that may be there."""
    short, long = (bound(since_fix_s=seconds).bound[0] for seconds in (400.0, 1600.0))
    assert long / short == pytest.approx(math.sqrt(17.0 / 5.0), rel=0.05)


def test_soon_after_a_fix_a_slip_has_made_no_more_than_the_way_since_then():
    fixed, dark = bound(), bound(since_fix_s=0.1)
    assert dark.cause == "slip"
    assert dark.position_m - fixed.position_m <= 0.1 * DRIVES[0]


def test_a_robot_that_slipped_and_stands_now_is_still_off():
    levels = ProtectionLevels(IntegrityConfig(), Modes())
    levels.of(COV, DRIVES, 1.0, False)
    stands = levels.of(COV, REST, 5.0, False)
    assert stands.cause == "slip"
    assert stands.position_m == pytest.approx(bound(since_fix_s=5.0).position_m)


def fix_by(sigma, off_m=0.0):
    """One sighting of the whole pose, so far from the prediction [m], ahead."""
    residual = np.array([-off_m, 0.0, 0.0]) / sigma
    lines = Lines(residual, np.eye(3) / sigma, np.zeros((3, 0)), [3], np.array([False]))
    return Fix(PoseWithCovariance(STILL, COV), InstallationEstimate(np.zeros(0), np.zeros((0, 0))), lines, 0.5)


@pytest.mark.parametrize("off_m", [0.0, 0.01])
def test_a_fix_that_differs_from_the_prediction_may_be_of_a_robot_that_slipped(off_m):
    """By the two solutions, with and without the prediction, in one dimension."""
    prior, off, sigma = 0.1, np.array([0.2, 0.2, 0.3]) ** 2, 0.01
    share, mean, added = fix_by(sigma, off_m).if_slipped(prior, off)
    P = np.diag(COV)
    gains = [p / (p + sigma**2) for p in (P, P + off)]
    assert mean == pytest.approx((gains[1] - gains[0]) * [off_m, 0.0, 0.0])
    assert np.diag(added) == pytest.approx(1.3**2 * ((1.0 - gains[1]) * (P + off) - (1.0 - gains[0]) * P))
    at = np.array([off_m, 0.0, 0.0])
    ratio = np.prod(norm.pdf(at, scale=np.sqrt(P + off + sigma**2)) / norm.pdf(at, scale=np.sqrt(P + sigma**2)))
    assert share == pytest.approx(prior * ratio / (1.0 - prior + prior * ratio))


def test_at_a_fix_that_is_hardly_better_than_the_prediction_a_slip_is_a_cause():
    levels = ProtectionLevels(IntegrityConfig(), Modes())
    levels.of(COV, DRIVES, 0.5, False)
    found = levels.of(COV, DRIVES, 0.0, False, 0.05, fix_by(0.02, 0.03))
    assert found.cause == "slip"
    assert found.position_m > bound().position_m


def test_an_alert_is_given_above_the_limit_of_position_or_yaw():
    position, yaw = bound().position_m, float(bound().bound[2])
    assert not bound().alert
    assert bound(alert_m=0.9 * position).alert
    assert not bound(alert_m=1.1 * position).alert
    assert bound(alert_m=1.1 * position, alert_yaw_rad=0.9 * yaw).alert


def test_a_place_found_anew_is_believed_once_enough_sightings_agree_with_it():
    levels = ProtectionLevels(IntegrityConfig(alert_m=0.1), Modes())
    levels.jumped()
    bounds = [levels.of(COV, REST, 0.0, False, fix=fix_by(0.02)) for _ in range(12)]
    assert bounds[0].cause == "place"
    assert bounds[0].position_m > 10.0
    assert bounds[0].alert
    assert bounds[-1].cause == "noise"
    assert not bounds[-1].alert


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_wheels_that_report_any_speed_leave_a_bound(seed):
    """Four numbers of three unknowns: what is left of their noise beside such a slip is below rounding."""
    modes, H = Modes(), np.random.default_rng(seed).normal(0.0, 100.0, (4, 3))
    modes.mounts.take(0, H, np.eye(4), np.ones(4), H.T * 1e-7, ["corners"] * 4)
    lines = Lines(np.ones(4), H, np.zeros((4, 0)), [4], np.array([False]))
    none = InstallationEstimate(np.zeros(0), np.zeros((0, 0)))
    fix = Fix(PoseWithCovariance(STILL, COV), none, lines, 0.5)
    found = ProtectionLevels(IntegrityConfig(), modes).of(COV, np.array([1e12, 0.0, 1e9]), 0.0, False, fix=fix)
    assert np.isfinite(found.bound).all()


def test_new_states_of_the_installation_change_nothing_of_what_a_knocked_camera_may_do():
    """Two rows between the two that there are, on which nothing depends yet."""
    rng, changed, as_it_was = np.random.default_rng(3), MountModes(5), MountModes(5)
    A, here = se2.adjoint(np.array([-0.5, 0.0, 0.1])), [0, 1, 2, 3, 6]

    def wider(part, axis):
        made = np.zeros((part.shape[0], 7) if axis else (7, part.shape[1]))
        made[(slice(None), here) if axis else here] = part
        return made

    for k in range(4):
        H, D = rng.normal(0.0, 100.0, (4, 5)), rng.normal(0.0, 0.1, (3, 2))
        W, w, gain = np.eye(4) * 1e-2, rng.normal(0.0, 1.0, 4), rng.normal(0.0, 1e-3, (5, 4))
        as_it_was.move(A, D)
        as_it_was.take(k * 10**9, H, W, w, gain, ["corners"] * 4)
        if k == 2:
            changed.states_changed(slice(1, 3), [])
        if k >= 2:
            H, gain, D = wider(H, 1), wider(gain, 0), wider(np.hstack([np.eye(3), D]), 1)[:, 3:]
        changed.move(A, D)
        changed.take(k * 10**9, H, W, w, gain, ["corners"] * 4)
    for modes in (changed, as_it_was):
        modes.weigh()
    for found, expected in zip(changed.displaced(), as_it_was.displaced(), strict=True):
        for a, b in zip(found, expected, strict=True):
            assert a == pytest.approx(b)


def test_a_turn_that_a_gyro_nearly_tells_makes_no_knock_less_probable():
    def share(turn):
        modes, H = MountModes(3), np.eye(3)
        modes.suspect(turn, 1e-4)
        modes.take(0, H, np.eye(3), np.zeros(3), H.T * 1e-7, ["corners"] * 3)
        return max(found for _, found, *_ in modes.displaced())

    assert share(0.0) == pytest.approx(5e-5, rel=0.01)
    assert share(0.2) == pytest.approx(0.25, rel=0.01)


def test_a_change_of_a_mounting_is_taken_up_only_when_it_has_lasted_for_seconds():
    robot, found = Straight(), None
    for step in range(1, 16):
        robot.drive(knocked=(0.0, 0.0, 0.06 if step > 2 else 0.0))
        found = robot.modes.changed()
        if found is not None:
            break
    assert found is not None
    assert robot.likeliest()[0] > 0.999
    assert step * 500_000_000 - found.since_ns == 5_000_000_000


def test_images_that_are_far_off_at_once_are_no_change_of_a_mounting_until_others_agree():
    """A pose known to millimetres; the camera saw little at first, and then the robot turned by 0.3 rad."""
    modes, taken_up = MountModes(3), []
    for stamp_s, sigma, off in ((0.0, 1.0, 0.0), (1.0, 1.0, 0.0), *((7.0 + 0.1 * k, 0.002, 0.3) for k in range(6))):
        H = np.eye(3) / sigma
        W = np.linalg.inv(np.linalg.cholesky(H @ COV @ H.T + np.eye(3)))
        modes.take(round(stamp_s * 1e9), H, W, W @ H @ [0.0, 0.0, off], np.zeros((3, 3)), ["corners"] * 3)
        modes.weigh()
        taken_up.append(modes.changed() is not None)
    assert taken_up == [False] * 6 + [True] * 2
