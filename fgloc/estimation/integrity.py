"""Protection levels: bounds that the error of a pose exceeds with no more than a stated risk, also if a sensor lies.

What may be wrong is a list of hypotheses, each with a prior: nothing but noise; one landmark displaced; wheels that
slipped since the last fix, or just before it; the robot carried away; the mounting of a sensor changed; a constant of
the installation that sightings contradict, as they have it. Under each the error of the pose has a normal distribution:
the modes of landmarks and mountings follow, beside the estimator, how a displacement that has not been found out moves
the pose and how likely it still is. The bound is the least one that keeps the probability of a larger error, over all
hypotheses together, within the risk.

Sources: Blanch, Walter, Enge et al. 2015, "Baseline advanced RAIM user algorithm and possible improvements" (one bound
for all hypotheses together); Pervan, Pullen, Christie 1998, "A multiple hypothesis approach to
satellite navigation integrity" (posterior probabilities of the hypotheses in place of a test).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtr, ndtri

from fgloc.config import IntegrityConfig
from fgloc.estimation.landmark_modes import LandmarkModes, posterior
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.joint import innovation
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.observation import Lines
from fgloc.sensors.measurements import sensor_name
from fgloc.types import FloatArray, Protection

_INDEPENDENT_S = 10.0  # errors further apart than this are taken to be independent: so many samples has an hour
_HALVINGS = 10  # by which the bound is found to a thousandth
# Sigma of the errors over that of the covariance, in the tail: models of noise are Gaussian, its tails are not
_OVERBOUND = 1.3
_DISPLACED = 1e-3  # prior that a given landmark of a map stands elsewhere, and nobody knows
_SLIP_PER_S = 0.01  # slips that the motion sources do not show, for each second, beside as many as they do show ...
_SLIP_LASTS_S = 1.0  # ... each at most so long, at the speed of the wheels
_FARTHEST = 1e4  # m², rad²: variance of a slip, whatever the wheels say of their speed
_CHECKED = 0.25  # of a slip passes the comparison of two independent motion sources
_WRONG_JUMP = 1e-2  # probability that a place to which the estimate jumps is wrong ...
_BY_ACCIDENT = 0.1  # ... and that a sighting agrees with it nevertheless
_ELSEWHERE = np.diag(np.square([10.0, 10.0, 1.8]))  # m², m², rad²
_UNBOUNDED = np.full(3, np.inf)
_LEAST_RAD_S = 0.3  # a slip turns a robot that drives straight on by so much


@dataclass(frozen=True, slots=True, eq=False)
class _Fault:
    """Fault hypothesis: something is wrong beside noise, and the error of the pose has another normal distribution.

    Attributes:
        name: of the cause.
        share: its probability.
        mean: ``(3,)`` of the error's size.
        added: ``(4,)`` variance, beside that of the noise: along, across, of the yaw, and in the direction where the
            place has most of it.
        most: ``(3,)`` that the fault alone can make.
    """

    name: str
    share: float
    mean: FloatArray
    added: FloatArray
    most: FloatArray = field(default_factory=lambda: _UNBOUNDED)

    def beside(self, other: _Fault) -> _Fault:
        """Both at once, as probable as this one alone."""
        mean, added = self.mean + other.mean, self.added + other.added
        return _Fault(self.name, self.share, mean, added, self.most + 10.0 * np.sqrt(other.added[:3]))


def _directions(cov: FloatArray) -> FloatArray:
    """Variances ``(..., 4)`` along, across, of the yaw, and in the direction where the place has most of it."""
    x, y = cov[..., 0, 0], cov[..., 1, 1]
    most = 0.5 * (x + y) + np.hypot(0.5 * (x - y), cov[..., 0, 1])
    return np.stack([x, y, cov[..., 2, 2], most], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Sightings of one step, as they corrected the predicted pose.

    Attributes:
        predicted: the pose before them.
        known: the installation then.
        lines: the sightings, linearized there.
        dt: length of the step [s].
    """

    predicted: PoseWithCovariance
    known: InstallationEstimate
    lines: Lines
    dt: float

    def if_slipped(self, prior: float, off: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Error of the corrected pose if the wheels slipped before it, and nobody has noticed: solution separation.

        Args:
            prior: probability of that.
            off: ``(3,)`` variance that it adds to the prediction.

        Returns:
            Probability after the sightings, mean ``(3,)`` and added covariance ``(3, 3)`` of the error.
        """
        P = self.predicted.joint_cov(self.known)
        found = innovation(P, self.lines)
        H = found.H[:, :3]
        cross, before = found.H @ P[:, :3], P[:3, :3]
        log_sound, sound, cov = _corrected(found.residual, found.cov, cross, before)
        log_slipped, moved, wide = _corrected(
            found.residual, found.cov + (H * off) @ H.T, cross + H * off, before + np.diag(off)
        )
        share = posterior(prior, 2.0 * (log_slipped - log_sound))
        return share, moved - sound, _OVERBOUND**2 * (wide - cov)


def _corrected(
    residual: FloatArray, cov: FloatArray, cross: FloatArray, before: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Log-likelihood of an innovation, the correction ``(3,)`` of the pose, and its covariance ``(3, 3)`` after it.

    Args:
        residual: ``(d,)``.
        cov: ``(d, d)`` of it.
        cross: ``(d, 3)`` covariance of it and the pose.
        before: ``(3, 3)`` covariance of the pose before.
    """
    root = np.linalg.cholesky(cov)
    white = np.linalg.solve(root, np.column_stack([residual, cross]))
    w, gain = white[:, 0], white[:, 1:]
    fits = -0.5 * float(w @ w) - float(np.log(np.diag(root)).sum())
    return fits, -gain.T @ w, before - gain.T @ gain


class ProtectionLevels:
    """Bounds on the error of each pose, by the hypotheses that the landmark modes follow."""

    def __init__(self, config: IntegrityConfig, modes: LandmarkModes) -> None:
        """Take the risk and the alert limits, and the hypotheses of displaced landmarks."""
        self._config, self._modes = config, modes
        samples = max(3600.0 / _INDEPENDENT_S, 1.0)
        risk = config.risk_per_hour / samples / 3.0  # of a sample and axis; a position has that of two
        self._fastest: FloatArray = np.zeros(2)  # speed and yaw rate since the last fix ...
        self._agreeing = math.inf  # sightings since the robot was found at another place
        self._blind_s = 0.0  # ... which was so long before the newest pose
        self._slipped = 0.0  # probability that the wheels slipped just before the last fix
        self._risks = risk * np.array([1.0, 1.0, 1.0, 2.0])
        self._negligible = 1e-3 * risk  # probability of a fault
        within, around = -float(ndtri(0.5 * risk)), math.sqrt(-2.0 * math.log(2.0 * risk))
        self._alone = np.array([within, within, within, around])  # sigmas, where there is nothing but noise

    def jumped(self) -> None:
        """The robot was found at another place: misread markers agree on one now and then."""
        self._agreeing = 0

    def of(
        self,
        cov: FloatArray,
        speed: FloatArray,
        since_fix_s: float,
        checked: bool,
        slips_per_s: float = 0.0,
        fix: Fix | None = None,
        as_seen: Iterable[tuple[str, FloatArray, FloatArray]] = (),
        carried: tuple[float, FloatArray] = (0.0, np.zeros((3, 3))),
    ) -> Protection:
        """Bound of the newest pose.

        Args:
            cov: ``(3, 3)`` of the pose in the base's axes, with all that is added to the graph's.
            speed: ``(3,)`` of the base in its axes [m/s, m/s, rad/s].
            since_fix_s: time since a sighting was used.
            checked: whether wheels are compared with an independent source of motion.
            slips_per_s: slips that were found in this run: where wheels slip, some slips pass unseen.
            fix: how sightings were used, if they were.
            as_seen: constants that are held against the sightings, with mean ``(3,)`` and covariance ``(3, 3)`` of the
                pose's difference if these are right.
            carried: probability that the robot was carried away, and covariance ``(3, 3)`` of the error then.
        """
        slip = self._slip(speed, since_fix_s, checked, slips_per_s, fix)
        self._modes.mounts.weigh()  # sightings that no slip can have come before
        landmarks, mounts = self._modes.displaced(_DISPLACED), self._modes.mounts.displaced()
        displaced = [(f"landmark {landmark_id}", share, bias, cov) for landmark_id, share, bias, cov in landmarks]
        displaced += [(f"mounting of {sensor_name(kind)}", share, bias, cov) for kind, share, bias, cov in mounts]
        likely = [one for one in displaced if one[1] > self._negligible]
        added = _directions(np.array([spread for _, _, _, spread in likely]).reshape(-1, 3, 3))
        faults = [
            _Fault(name, share, np.abs(bias), of_spread)
            for (name, share, bias, _), of_spread in zip(likely, added, strict=True)
        ]
        if slip is not None and slip.share > self._negligible:
            faults.append(slip)
        if carried[0] > self._negligible:
            faults.append(_Fault("carried away", carried[0], np.zeros(3), _directions(carried[1])))
        self._agreeing += 0 if fix is None else len(fix.lines)
        if (share := _WRONG_JUMP * _BY_ACCIDENT**self._agreeing) > self._negligible:
            faults.append(_Fault("place", share, np.zeros(3), _directions(_ELSEWHERE)))
        if held := list(as_seen):  # beside each of the others, too
            off = _Fault(
                " + ".join(name for name, *_ in held),
                1.0,
                np.sum([np.abs(mean) for _, mean, _ in held], axis=0),
                _OVERBOUND**2 * _directions(np.sum([spread for *_, spread in held], axis=0)),
            )
            faults = [off, *faults, *(f.beside(off) for f in faults)]
        sound = _OVERBOUND * np.sqrt(_directions(cov))
        bound, cause = self._least(sound, faults)
        if bound[2] > 0.5 * math.pi:  # nobody knows which way is along: what lies there may lie across
            bound = np.array([*np.maximum(bound[:2], bound[3]), min(float(bound[2]), math.pi), bound[3]])
        limits = (self._config.alert_m, float(bound[3])), (self._config.alert_yaw_rad, float(bound[2]))
        alert = any(limit is not None and level > limit for limit, level in limits)
        return Protection(bound[:3], float(bound[3]), cause, alert)

    def _slip(
        self, speed: FloatArray, since_fix_s: float, checked: bool, slips_per_s: float, fix: Fix | None
    ) -> _Fault | None:
        """Wheels slipped since the last fix, or before this one since the one before; None: there was no time for it.

        A robot that stands now may have slipped before: the fastest motion since then counts.
        """
        now = np.array([np.hypot(speed[0], speed[1]), abs(speed[2])])
        self._fastest = np.maximum(self._fastest, now)
        linear, turn = self._fastest.tolist()
        blind_s = since_fix_s if since_fix_s > 0.0 else 0.0 if fix is None else self._blind_s + fix.dt
        self._blind_s = since_fix_s
        if since_fix_s == 0.0:
            self._fastest = now
        if blind_s == 0.0:
            return None
        turn = max(turn, _LEAST_RAD_S) if linear > 0.0 else turn
        expected = (_SLIP_PER_S + slips_per_s) * blind_s
        off = np.square(np.array([linear, linear, turn]) * min(blind_s, _SLIP_LASTS_S)) * (1.0 + expected)
        off = np.minimum(off * (_CHECKED**2 if checked else 1.0), _FARTHEST)
        goes_on = self._slipped * math.exp(-blind_s / _SLIP_LASTS_S)  # a slip that has begun
        share, bias, spread = goes_on - (1.0 - goes_on) * math.expm1(-expected), np.zeros(3), np.diag(off)
        if since_fix_s == 0.0 and fix is not None:
            self._modes.mounts.weigh(share, off)
            share, bias, spread = fix.if_slipped(share, off)
            self._slipped = share
        return _Fault("slip", share, np.abs(bias), _directions(spread), blind_s * np.array([linear, linear, turn]))

    def _least(self, sound: FloatArray, faults: Sequence[_Fault]) -> tuple[FloatArray, str]:
        """Least bounds ``(4,)`` on x, y, yaw and distance that keep the risk, and what that on the distance is due to.

        Args:
            sound: ``(4,)`` sigmas of these if nothing is wrong but noise.
            faults: what else may be.
        """
        low = self._alone * sound
        if not faults:
            return low, "noise"
        share = np.array([1.0, *(fault.share for fault in faults)])
        mean, sigma, most = np.zeros((len(share), 4)), np.tile(sound, (len(share), 1)), np.zeros((len(share), 4))
        for i, fault in enumerate(faults, 1):
            mean[i] = *fault.mean, math.hypot(fault.mean[0], fault.mean[1])
            sigma[i] = np.sqrt(sound**2 + np.maximum(fault.added, 0.0))  # a difference of two covariances is rounded
            most[i] = *fault.most, fault.most[0]

        def beyond(bound: FloatArray) -> FloatArray:
            """Probability of a larger error by each hypothesis, times its own ``(n, 4)``."""
            return share[:, None] * np.minimum(_tails(bound - mean, sigma), _tails(bound - mean - most, sound))

        high = low.copy()
        while (over := beyond(high).sum(axis=0) > self._risks).any():
            low, high = np.where(over, high, low), np.where(over, 1.5 * high, high)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            over = beyond(middle).sum(axis=0) > self._risks
            low, high = np.where(over, middle, low), np.where(over, high, middle)
        causes = beyond(high)[:, 3]
        return high, ["noise", *(fault.name for fault in faults)][int(np.argmax(causes))]


def _tails(gap: FloatArray, sigma: FloatArray) -> FloatArray:
    """Probability ``(n, 4)`` of larger errors by these sigmas: three of one axis, the last of a place in the plane."""
    z = gap / sigma
    found = 2.0 * ndtr(-z)
    found[:, 3] = np.exp(-0.5 * np.maximum(z[:, 3], 0.0) ** 2)
    return np.asarray(np.minimum(found, 1.0))
