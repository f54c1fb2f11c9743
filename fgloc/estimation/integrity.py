"""Protection levels: bounds that the error of a pose exceeds with no more than a stated risk, also if a sensor lies.

What may be wrong is a list of hypotheses, each with a prior: nothing but noise; one landmark displaced; a motion source
wrong since the last fix. Under each the error of the pose has a normal distribution: the landmark modes follow, beside
the estimator, how a displacement that has not been found out moves the pose and how likely it still is. The bound is
the least one that keeps the probability of a larger error, over all hypotheses together, within the risk.

Sources: Blanch, Walter, Enge et al. 2015, "Baseline advanced RAIM user algorithm and possible improvements" (a bound
for each hypothesis from its share of the risk); Pervan, Pullen, Christie 1998, "A multiple hypothesis approach to
satellite navigation integrity" (posterior probabilities of the hypotheses in place of a test).
"""

from __future__ import annotations

import math

import numpy as np

from fgloc.config import IntegrityConfig
from fgloc.estimation.landmark_modes import LandmarkModes
from fgloc.types import FloatArray, Protection

_INDEPENDENT_S = 10.0  # errors further apart than this are taken to be independent: so many samples has an hour
_NOISE_SHARE = 0.5  # of the risk, for noise alone; the faults share the rest alike
# Sigma of the errors over that of the covariance, in the tail: models of noise are Gaussian, its tails are not
_OVERBOUND = 1.3
_DISPLACED = 1e-3  # prior that a given landmark of a map stands elsewhere, and nobody knows
_SLIP_PER_S = 0.01  # slips that the motion sources do not show, for each second, beside as many as they do show ...
_SLIP_LASTS_S = 1.0  # ... each at most so long, at the speed of the wheels
_CHECKED = 0.25  # of a slip passes the comparison of two independent motion sources
_UNBOUNDED = np.full(3, np.inf)
_LEAST_RAD_S = 0.3  # a slip turns a robot that drives straight on by so much


class ProtectionLevels:
    """Bounds on the error of each pose, by the hypotheses that the landmark modes follow."""

    def __init__(self, config: IntegrityConfig, modes: LandmarkModes) -> None:
        """Take the risk and the alert limits, and the hypotheses of displaced landmarks."""
        self._config, self._modes = config, modes
        samples = max(3600.0 / _INDEPENDENT_S, 1.0)
        self._risk = config.risk_per_hour / samples / 3.0  # of a sample and axis
        self._fastest: FloatArray = np.zeros(2)  # speed and yaw rate since the last fix
        self._sigmas = -float(_quantile(np.array(0.5 * _NOISE_SHARE * self._risk)))
        self._radii = float(_radius(np.array(2.0 * _NOISE_SHARE * self._risk)))

    def of(
        self, cov: FloatArray, speed: FloatArray, since_fix_s: float, checked: bool, slips_per_s: float = 0.0
    ) -> Protection:
        """Bound of the newest pose.

        Args:
            cov: ``(3, 3)`` of the pose in the base's axes, with all that is added to the graph's.
            speed: ``(3,)`` of the base in its axes [m/s, m/s, rad/s].
            since_fix_s: time since a sighting was used.
            checked: whether wheels are compared with an independent source of motion.
            slips_per_s: slips that were found in this run: where wheels slip, some slips pass unseen.
        """
        variance = _OVERBOUND**2 * np.diag(cov)
        widest = _OVERBOUND**2 * float(np.linalg.eigvalsh(cov[:2, :2])[-1])  # variance in the worst direction
        names: list[str] = []
        priors, biases, added, most = [], [], [], []  # most: that the fault alone can make
        for landmark_id, share, bias, spread in self._modes.displaced(_DISPLACED):
            names.append(f"landmark {landmark_id}")
            priors.append(share)
            biases.append(np.abs(bias))
            added.append(spread)
            most.append(_UNBOUNDED)
        now = np.array([np.hypot(speed[0], speed[1]), abs(speed[2])])
        self._fastest = np.maximum(self._fastest, now) if since_fix_s > 0.0 else now
        if since_fix_s > 0.0:
            lasts_s = min(since_fix_s, _SLIP_LASTS_S)
            linear, turn = self._fastest.tolist()
            turn = max(turn, _LEAST_RAD_S) if linear > 0.0 else turn
            off = np.square([linear * lasts_s, linear * lasts_s, turn * lasts_s]) * (_CHECKED**2 if checked else 1.0)
            expected = (_SLIP_PER_S + slips_per_s) * since_fix_s
            names.append("slip")
            priors.append(-math.expm1(-expected))
            biases.append(np.zeros(3))
            added.append(off * (1.0 + expected))
            most.append(since_fix_s * np.array([linear, linear, turn]))
        bound, cause = self._sigmas * np.sqrt(variance), "noise"
        position = self._radii * math.sqrt(widest)
        if names:
            # An axis has a third of the risk, a position two; no direction is spread by more than the trace
            tail = (1.0 - _NOISE_SHARE) * self._risk / len(names) / np.maximum(priors, 1e-300)
            matters = tail < 1.0
            sigmas, radii = -_quantile(np.minimum(0.5 * tail, 0.5)), _radius(np.minimum(2.0 * tail, 1.0))
            off_by, spreads, far = np.array(biases) * matters[:, None], np.array(added), np.array(most)
            noise, all_of_it = sigmas[:, None] * np.sqrt(variance), sigmas[:, None] * np.sqrt(variance + spreads)
            each = off_by + np.minimum(all_of_it, noise + far)
            spread = np.minimum(
                radii * np.sqrt(widest + spreads[:, :2].sum(axis=1)), radii * np.sqrt(widest) + far[:, 0]
            )
            places = np.hypot(off_by[:, 0], off_by[:, 1]) + spread
            worst = int(np.argmax(places))
            if places[worst] > position:
                position, cause = float(places[worst]), names[worst]
            bound = np.maximum(bound, each.max(axis=0))
        return Protection(bound, position, cause, self._is_alert(position, float(bound[2])))

    def _is_alert(self, position_m: float, yaw_rad: float) -> bool:
        limit, yaw = self._config.alert_m, self._config.alert_yaw_rad
        return (limit is not None and position_m > limit) or (yaw is not None and yaw_rad > yaw)


def _quantile(probability: FloatArray) -> FloatArray:
    """Standard normal quantile."""
    from scipy.special import ndtri  # as in `fgloc.stats`

    return np.asarray(ndtri(probability))


def _radius(probability: FloatArray) -> FloatArray:
    """Distance that a standard normal vector in the plane exceeds with this probability."""
    return np.sqrt(-2.0 * np.log(probability))
