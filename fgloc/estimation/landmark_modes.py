"""Landmark modes: in place, moved by δ, or misread. Finds the landmarks that do not stand where the map has them.

If landmark i is displaced by δ, the estimator, which takes it to be in place, errs by ``M δ``; M follows from the
estimator's own gains. The innovations of all sightings then have a mean linear in δ, and a filter of δ alone, one per
landmark, tells how much likelier they are than if everything were in place. A sighting that neither of the two explains
is misread: it costs as much as the gate's quantile, whatever it is, once in the time over which errors of one landmark
are alike. A landmark that was left out is used again when its sightings contradict the displacement.

Sources: Friedland 1969, "Treatment of bias in recursive filtering" (M); Willsky and Jones 1976, "A generalized
likelihood ratio approach to the detection and estimation of jumps in linear systems" (with a prior on the jump).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.joint import MOST_STEPS, innovation, transition
from fgloc.graph.measurement_log import LoggedSighting, PoseWithCovariance
from fgloc.graph.noise import repetition, sighting_whitening
from fgloc.graph.observation import Lines, Observations
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.stats import chi2_bound, evidence_bound
from fgloc.types import FloatArray, MotionMeasurement

# --- How a displacement explains a sighting ---------------------------------------------------------------------------

MOVED = 0.5  # m, rad: prior sigma of a displacement, on each axis, and of a marker's rotation with it

Explained = tuple[FloatArray, FloatArray, FloatArray]
"""Of each hypothesis: minus twice the log-likelihood ``(L,)``, mean ``(L, 2)`` and covariance ``(L, 2, 2)`` of δ."""


def explain(w: FloatArray, G: FloatArray, mean: FloatArray, cov: FloatArray) -> Explained:
    """A white innovation ``(d,)`` whose mean is ``G δ`` under each hypothesis, and δ after it."""
    gap = w - (G @ mean[:, :, None])[:, :, 0]
    Gt = G.transpose(0, 2, 1)
    pull = Gt @ gap[:, :, None]
    weight = cov @ (Gt @ G)  # I + it: how much less the prior weighs
    weight[:, 0, 0] += 1.0
    weight[:, 1, 1] += 1.0
    adjugate = np.empty_like(weight)
    adjugate[:, 0, 0], adjugate[:, 1, 1] = weight[:, 1, 1], weight[:, 0, 0]
    adjugate[:, 0, 1], adjugate[:, 1, 0] = -weight[:, 0, 1], -weight[:, 1, 0]
    determinant = weight[:, 0, 0] * weight[:, 1, 1] - weight[:, 0, 1] * weight[:, 1, 0]
    after = (adjugate @ cov) / determinant[:, None, None]
    after = 0.5 * (after + after.transpose(0, 2, 1))
    step = after @ pull
    cost = (gap * gap).sum(1) - (pull * step).sum((1, 2)) + np.log(determinant)
    return cost, mean + step[:, :, 0], after


def by_displacement(J: FloatArray, pose: FloatArray) -> FloatArray:
    """Derivative ``(d, 2)`` of a sighting's residual by its landmark's displacement in the map.

    Args:
        J: ``(d, 3)`` by the right perturbation of the pose.
        pose: ``(3,)``.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.asarray(-J[:, :2] @ np.array([[c, s], [-s, c]]))


def rotation_cov(H: FloatArray, rows: tuple[int, int]) -> FloatArray:
    """Covariance ``(d, d)`` of a marker's residual if whoever moved it also turned it, and hung it higher or lower.

    Args:
        H: ``(d, 3 + n)`` by pose and installation.
        rows: first and number of the rows of its landmark in the installation.
    """
    by_marker = H[:, 3 + rows[0] + 2 : 3 + rows[0] + rows[1]] * MOVED
    return np.asarray(by_marker @ by_marker.T)


# --- A sensor that was knocked ----------------------------------------------------------------------------------------

_KNOCKED = np.array([0.03, 0.03, 0.05])  # m, m, rad: sigma of a mounting's change, in the base's axes
_WRONG_FROM_THE_START = 1e-4  # probability that a mounting is another one than it was measured to be ...
_KNOCKS_PER_S = 0.01 / 3600.0  # ... and of a change afterwards
_LEVEL = 0.5  # share of a camera's changes that do not tilt it: markers in its images contradict a tilt
_MOST_ONSETS = 8  # of one sensor
_TURNED = 0.5  # probability that it was the sensor if sightings contradict a gyro
_MOST_OF_ONE = 8.0  # of the evidence: a keyframe may have what nobody models, as images of a stall all at once
_LASTS_NS = 5_000_000_000  # at least, before it is taken up: a robot that is pushed for a while looks alike at first
_CERTAIN = 0.99  # probability from which on the estimator takes a change up


class _Onsets:
    """Hypotheses "the mounting of a sensor changed by δ before this keyframe", the first one: before all of them.

    Attributes:
        M: ``(k, 3 + n, 3)`` derivative of the error of pose and installation by δ.
        moved: ``(k, 3)`` δ.
        information: ``(k, 3, 3)`` on δ.
        evidence: ``(k,)`` twice the log-likelihood ratio to "in place".
        steady: ``(k,)`` likewise, of which sightings of one keyframe make no more than `_MOST_OF_ONE`.
        prior: ``(k,)`` probability.
        since_ns: stamp of each one's first sightings.
        last_ns: stamp of the sensor's last sightings.
    """

    def __init__(self, states: int, unseen: float, first: float, turned: float) -> None:
        self._unseen = unseen  # share of the changes that the sensor's own sightings do not contradict
        self._first = first  # prior of the first hypothesis, and sigma of its turn
        self._sigmas = np.array([*_KNOCKED[:2], turned])
        self.M, self.moved = np.zeros((0, states, 3)), np.zeros((0, 3))
        self.information, self.evidence, self.prior = np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0)
        self.steady = np.zeros(0)
        self.since_ns: list[int] = []
        self.last_ns: int | None = None

    def begin(self, stamp_ns: int) -> None:
        """Add a hypothesis that begins now; the least probable of the others goes if there are too many."""
        prior = self._unseen * self._first
        if self.last_ns is not None:
            prior = -self._unseen * math.expm1(-max(stamp_ns - self.last_ns, 0) * 1e-9 * _KNOCKS_PER_S)
        self.last_ns = stamp_ns
        if prior == 0.0:
            return
        if len(self.prior) == _MOST_ONSETS:
            self._drop(1 + int(np.argmin(self.evidence[1:] + 2.0 * np.log(self.prior[1:]))))
        self.M = np.concatenate([self.M, np.zeros((1, *self.M.shape[1:]))])
        self.moved = np.concatenate([self.moved, np.zeros((1, 3))])
        self.information = np.concatenate([self.information, np.diag(self._sigmas**-2.0)[None]])
        self._sigmas = _KNOCKED
        self.evidence, self.prior = np.append(self.evidence, 0.0), np.append(self.prior, prior)
        self.steady = np.append(self.steady, 0.0)
        self.since_ns.append(stamp_ns)

    def weigh(self, w: FloatArray, G: FloatArray, prior: float, wider: FloatArray) -> None:
        """Add the evidence of white innovations, of which a slip of the wheels is another explanation.

        Of the two, slip or none, δ is corrected by the one that is more probable with the onset.

        Args:
            w: ``(d,)``.
            G: ``(k, d, 3)`` derivative of their mean by δ.
            prior: probability that the wheels slipped.
            wider: ``(d, d)`` Cholesky factor of their covariance then.
        """
        gap = w - (G @ self.moved[:, :, None])[:, :, 0]
        cost, step, information = self._costs(gap, G)
        sound = float(w @ w)
        if prior > 0.0:
            root, grown = np.linalg.inv(wider), 2.0 * float(np.log(np.diag(wider)).sum())
            slip_cost, slip_step, slip_information = self._costs(gap @ root.T, root @ G)
            slipped = slip_cost + grown - 2.0 * math.log(prior) < cost - 2.0 * math.log1p(-prior)
            step = np.where(slipped[:, None], slip_step, step)
            information = np.where(slipped[:, None, None], slip_information, information)
            cost = _either(cost, slip_cost + grown, prior)
            sound = float(_either(sound, float(np.square(root @ w).sum()) + grown, prior))
        self.moved, self.information = self.moved + step, information
        self.evidence = self.evidence + sound - cost
        self.steady = self.steady + np.minimum(sound - cost, _MOST_OF_ONE)

    def _costs(self, gap: FloatArray, G: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Minus twice the log-likelihoods ``(k,)``, the corrections ``(k, 3)`` of δ, and the information after them."""
        Gt = G.transpose(0, 2, 1)
        pull, information = (Gt @ gap[:, :, None])[:, :, 0], self.information + Gt @ G
        step = np.linalg.solve(information, pull[:, :, None])[:, :, 0]
        grown = np.linalg.slogdet(information)[1] - np.linalg.slogdet(self.information)[1]
        cost: FloatArray = (gap * gap).sum(1) - (pull * step).sum(1) + grown
        return cost, np.asarray(step, dtype=np.float64), information

    def _drop(self, k: int) -> None:
        kept = np.arange(len(self.prior)) != k
        self.M, self.moved, self.information = self.M[kept], self.moved[kept], self.information[kept]
        self.evidence, self.prior, self.steady = self.evidence[kept], self.prior[kept], self.steady[kept]
        del self.since_ns[k]


def _either(cost: FloatArray | float, other: FloatArray | float, prior: float) -> FloatArray:
    """Minus twice the log-likelihood of a mixture, by those of its parts; ``prior`` is the share of the other one."""
    sound, slipped = -0.5 * np.asarray(cost) + math.log1p(-prior), -0.5 * np.asarray(other) + math.log(prior)
    return np.asarray(-2.0 * np.logaddexp(sound, slipped))


def _with_states(M: FloatArray, added: slice, rows: Sequence[slice]) -> FloatArray:
    """Derivatives ``(k, 3 + n, d)`` of pose and installation with rows added to the latter, and 0 of changed ones."""
    wider = np.insert(M, [3 + added.start] * (added.stop - added.start), 0.0, axis=1)
    for own in rows:
        wider[:, 3 + own.start : 3 + own.stop] = 0.0
    return wider


class MountModes:
    """The hypotheses that the mounting of a landmark sensor is another one than the estimator takes it to be.

    A sensor that was turned or pushed on the robot sees what it would see from another pose: δ enters its sightings as
    the pose does. All of them agree; only the way that the robot drives contradicts them. The change came before the
    run, in a gap of the sightings or between any two of them: those onsets are followed that explain most. Wheels that
    slip drive another way, too: what a slip explains is no evidence.
    """

    def __init__(self, states: int) -> None:
        """Take the number of states beside δ, pose included."""
        self._states = states
        self._of: dict[str, _Onsets] = {}
        self._seen: dict[str, FloatArray] = {}  # derivatives of each sensor's newest sightings by pose and installation
        self._set_anew = False  # whether the pose was, in this run
        self.reset()

    def reset(self) -> None:
        """Forget all evidence, as the pose was set anew."""
        self._set_anew = self._set_anew or bool(self._of)
        self._first, self._turned = _WRONG_FROM_THE_START, float(_KNOCKED[2])
        self._of.clear()
        self._taken: tuple[FloatArray, FloatArray, dict[str, FloatArray]] | None = None  # not weighed yet

    def suspect(self, turn: float, variance: float) -> None:
        """Take a change of a mounting for more probable, as sightings agree on a pose that contradicts a gyro.

        A slip of the wheels does not turn a gyro: either it is wrong, or what sees the landmarks was turned.

        Args:
            turn: by which the yaw by the sightings differs from the gyro's [rad].
            variance: of that difference.
        """
        wide = variance + _KNOCKED[2] ** 2
        evidence = turn**2 / variance - turn**2 / wide - math.log(wide / variance)
        self._first = max(_TURNED * posterior(_WRONG_FROM_THE_START, evidence), _WRONG_FROM_THE_START)
        self._turned = max(abs(turn), float(_KNOCKED[2]))

    def states_changed(self, added: slice, rows: Sequence[slice]) -> None:
        """Follow `Estimator.give_states`: no change of a mounting has had a part in new states."""
        self._states += added.stop - added.start
        for one in self._of.values():
            one.M = _with_states(one.M, added, rows)

    def move(self, A: FloatArray, D: FloatArray) -> None:
        """Follow a motion by its derivatives; see `transition`."""
        for one in self._of.values():
            one.M[:, :3] = A @ one.M[:, :3] + D @ one.M[:, 3:]

    def take(
        self, stamp_ns: int, H: FloatArray, W: FloatArray, w: FloatArray, gain: FloatArray, rows: Sequence[str]
    ) -> None:
        """Follow the estimator through the sightings of a keyframe; `weigh` adds their evidence.

        Args:
            stamp_ns: of them.
            H: ``(d, 3 + n)`` by pose and installation.
            W: ``(d, d)`` whitening of their innovation.
            w: ``(d,)`` that innovation, white.
            gain: ``(3 + n, d)`` of the estimator on it.
            rows: sensor of each row; "" of what is of none.
        """
        self.weigh()
        for name in dict.fromkeys(rows):
            if name:
                unseen = _LEVEL if name.endswith("corners") else 1.0
                self._of.setdefault(name, _Onsets(self._states, unseen, self._first, self._turned)).begin(stamp_ns)
        of, by = np.array(rows), dict[str, FloatArray]()
        for name, one in self._of.items():
            G = -(H @ one.M)
            own = of == name
            G[:, own] -= H[own, :3]
            if own.any():
                self._seen[name] = H[own]
            G = W @ G
            by[name] = G
            one.M += gain @ G
        self._taken = w, W @ H[:, :3], by

    def weigh(self, prior: float = 0.0, off: FloatArray | None = None) -> None:
        """Add the evidence of the sightings taken last, if that has not been done.

        Args:
            prior: probability that the wheels slipped before them.
            off: ``(3,)`` variance of the pose that this adds, in the base's axes; None: they did not.
        """
        if self._taken is None:
            return
        w, by_pose, by = self._taken
        self._taken = None
        wider: FloatArray = np.eye(len(w))
        if off is None or prior <= 0.0:
            prior = 0.0
        else:
            prior = min(prior, _SURE)
            wider = np.asarray(np.linalg.cholesky(wider + (by_pose * off) @ by_pose.T), dtype=np.float64)
        for name, G in by.items():
            self._of[name].weigh(w, G, prior, wider)

    def displaced(self) -> Iterator[tuple[str, float, FloatArray, FloatArray]]:
        """Each sensor and onset, the probability of it, and what it does to the pose; as `LandmarkModes.displaced`."""
        for name, one in self._of.items():
            M, spread = one.M[:, :3], np.linalg.inv(one.information)
            for k, prior in enumerate(one.prior.tolist()):
                share = posterior(prior, float(one.evidence[k]))
                yield name, share, M[k] @ one.moved[k], M[k] @ spread[k] @ M[k].T

    def changed(self) -> Changed | None:
        """Sensor whose mounting certainly changed.

        One that is another from the start of the run may have been measured wrongly, and so may the map or the wheels:
        it is a hypothesis of the bounds alone. The others began when the pose was set anew, or later.
        """
        for name, one in self._of.items():
            for k, prior in enumerate(one.prior.tolist()):
                if one.last_ns is None or one.last_ns - one.since_ns[k] < _LASTS_NS:
                    continue
                if (k > 0 or self._set_anew) and posterior(prior, float(one.steady[k])) > _CERTAIN:
                    off, spread = one.M[k] @ one.moved[k], one.M[k] @ np.linalg.solve(one.information[k], one.M[k].T)
                    seen, moved = self._seen[name], one.moved[k]
                    return Changed(
                        name, one.since_ns[k], float(one.evidence[k]), off, spread, seen, seen[:, :3] @ moved
                    )
        return None


@dataclass(frozen=True, slots=True, eq=False)
class Changed:
    """Mounting that changed.

    Attributes:
        kind: of the sensor's sightings.
        since_ns: stamp of the first of them since then.
        evidence: twice the log-likelihood ratio to "in place".
        off: ``(3 + n,)`` error that this made in pose and installation.
        spread: ``(3 + n, 3 + n)`` covariance of that.
        H: ``(d, 3 + n)`` of the sensor's newest sightings by pose and installation.
        shift: ``(d,)`` of these by the change.
    """

    kind: str
    since_ns: int
    evidence: float
    off: FloatArray
    spread: FloatArray
    H: FloatArray
    shift: FloatArray


_SURE, _HARDLY = 1.0 - 1e-12, 1e-300  # probabilities whose odds are finite


def posterior(prior: float, evidence: float) -> float:
    """Probability of a hypothesis by its prior, and twice the log-likelihood ratio to its contrary."""
    odds = math.log(max(prior, _HARDLY)) - math.log1p(-min(prior, _SURE)) + 0.5 * min(max(evidence, -1e3), 1e3)
    return 1.0 / (1.0 + math.exp(-odds))


# --- The hypotheses ---------------------------------------------------------------------------------------------------

_LEAST_M = 0.15  # of a displacement that is named: less may be a survey
_MISREAD_SHARE, _NEAR_M = 0.15, 1.0  # of the sightings of what stands there: rarer ones may be of that, misread
_PROVEN = 2  # other landmarks that have to be in place
_STILL_RIGHT_S = 1.0  # after a sighting was fused, the prediction can be held against other sightings
MOST_HYPOTHESES = 100  # those of the landmarks seen last


class LandmarkModes:
    """The hypotheses "moved" beside an estimator that takes all landmarks to be in place.

    Attributes:
        displacements: of the landmarks that were found to be moved ``(2,)`` [m] in the map.
        alarm: evidence, twice the log-likelihood ratio to "in place", that names a landmark.
        mounts: hypotheses of the sensors that see them.
    """

    def __init__(self, config: Config, factors: LandmarkFactors) -> None:
        self._factors, self._gate = factors, config.estimator.gate_probability
        self._least, self._repeat_s = config.weights.quarantine_after, config.landmarks.repeat_s
        n = min(len(factors.landmarks), MOST_HYPOTHESES) if config.weights.adaptive else 0
        self.alarm = evidence_bound(self._gate, max(n, 1))
        self._rows: dict[int, int] = {}  # of landmarks, the one seen last last
        self._ids, self._places = np.zeros(n, dtype=np.int64), np.full((n, 2), np.inf)
        self._M = np.zeros((n, 3 + len(factors.installation), 2))
        self._moved, self._cov = np.zeros((n, 2)), np.zeros((n, 2, 2))  # δ
        self._evidence = np.zeros((n, n))  # for each hypothesis, by the landmark whose sightings support it
        self._seen, self._explained = np.zeros((n, n)), np.zeros(n)  # sightings of each; those of itself that fit δ
        self._information = np.zeros((n, 2, 2))  # on δ, of independent sightings of itself
        self._last_ns: dict[int, int] = {}
        self.displacements: dict[int, FloatArray] = {}
        self.mounts = MountModes(3 + len(factors.installation))
        self._returned: dict[int, float] = {}  # evidence that a landmark which is left out is in place
        self.restart()

    def restart(self) -> None:
        """Forget all evidence but the landmarks left out, as the pose was set anew."""
        self._reset(np.ones(len(self._ids), dtype=np.bool_))
        self.mounts.reset()
        self._returned.clear()
        self._in_place: set[int] = set()
        self._fused_ns = 0

    def forget(self) -> None:
        """Discard all hypotheses: the pose they were computed from was wrong."""
        self.displacements.clear()
        self.restart()

    def states_changed(self, added: slice, rows: Sequence[slice]) -> None:
        """Follow `Estimator.give_states`: no displacement has had a part in new states."""
        self._M = _with_states(self._M, added, rows)
        self.mounts.states_changed(added, rows)

    def excludes(self, landmark_id: int) -> bool:
        """Whether sightings of this landmark are not to be used."""
        return landmark_id in self.displacements

    def displaced(self, prior: float) -> Iterator[tuple[int, float, FloatArray, FloatArray]]:
        """Each landmark in use that may be displaced without having been found out.

        Args:
            prior: probability that a given landmark is displaced.

        Yields:
            Its id, the probability that it is displaced, mean ``(3,)`` and covariance ``(3, 3)`` of the error that this
            makes in the pose, in the base's axes.
        """
        evidence = self._evidence.sum(1)
        M = self._M[:, :3]
        spread = M @ self._cov @ M.transpose(0, 2, 1)
        bias = np.einsum("lij,lj->li", M, self._moved)
        for landmark_id, row in self._rows.items():
            if not self.excludes(landmark_id):
                yield landmark_id, posterior(prior, float(evidence[row])), bias[row], spread[row]

    def sensitivity(self, landmark_id: int) -> FloatArray:
        """Derivative ``(3 + n, 2)`` of the error of pose and installation by a landmark's displacement."""
        return np.asarray(self._M[self._rows[landmark_id]])

    def observe(
        self,
        motions: Sequence[MotionMeasurement],
        predicted: PoseWithCovariance,
        belief: PoseWithCovariance,
        fused: Sequence[LoggedSighting],
        rejected: Sequence[LoggedSighting] = (),
        lines: Lines | None = None,
    ) -> int | None:
        """Follow the estimator through one keyframe.

        Args:
            motions: that led to it; none at the first one.
            predicted: before its sightings.
            belief: after them.
            fused: sightings that it took.
            rejected: sightings that it did not take.
            lines: those that it took, linearized at the prediction; None: it is too uncertain for that.

        Returns:
            A landmark that is now known to be moved.
        """
        if not len(self._ids):
            return None
        seen = [s for s in fused if s.alone.of_landmark]
        against = [s for s in rejected if s.alone.of_landmark]
        for s in (*seen, *against):
            self._follow(s.alone.landmark_id)
        if motions:
            A, D = transition(motions, self._factors.installation)
            self._M[:, :3] = A @ self._M[:, :3] + D @ self._M[:, 3:]
            self.mounts.move(A, D)
        if fused:
            self._take(predicted, belief, [s.measurement for s in fused], lines)
            self._in_place.update(s.alone.landmark_id for s in seen)
            self._fused_ns = fused[0].measurement.stamp_ns
        P = belief.joint_cov(self._known(belief)) if against else np.zeros((0, 0))
        for m in (s.alone for s in against):
            if self.excludes(m.landmark_id):
                self._weigh_return(P, belief, m)
            elif m.stamp_ns - self._fused_ns < _STILL_RIGHT_S * 1e9:
                self._contradicted(P, belief, m)
        self._last_ns.update({s.alone.landmark_id: s.alone.stamp_ns for s in (*seen, *against)})
        self._reset(self._evidence.sum(1) < -self.alarm)  # it was in place; it may be moved from now on
        return self._certain() if seen or against else None

    def exclude(self, landmark_id: int, belief: PoseWithCovariance) -> tuple[PoseWithCovariance, float]:
        """Leave a moved landmark out from now on.

        Returns:
            Pose and installation without what its sightings did to them (the belief itself if none were fused), and the
            evidence.
        """
        row = self._rows[landmark_id]
        evidence, M = float(self._evidence[row].sum()), self._M[row]
        self.displacements[landmark_id] = self._moved[row].copy()
        off, spread = M @ self._moved[row], M @ self._cov[row] @ M.T
        self._reset(np.ones(len(self._ids), dtype=np.bool_))
        return self._without(belief, off, spread), evidence

    def take_up(self, change: Changed, belief: PoseWithCovariance) -> PoseWithCovariance:
        """The belief without what a changed mounting did to it; all hypotheses begin anew."""
        self.restart()
        return self._without(belief, change.off, change.spread)

    def _without(self, belief: PoseWithCovariance, off: FloatArray, spread: FloatArray) -> PoseWithCovariance:
        """Pose and installation without an error ``(3 + n,)`` of this covariance; without one the belief itself."""
        if not off.any():
            return belief
        known = self._known(belief)
        pose, P = se2.compose(belief.pose, se2.exp(off[:3])), belief.joint_cov(known) + spread
        return PoseWithCovariance.jointly(pose, known.mean + off[3:], P)

    def exclude_if_moved(self, landmark_id: int, moved: FloatArray, evidence: float) -> bool:
        """Leave out a landmark that a search found to be moved, if that is far and clear enough; whether it is."""
        self.displacements.pop(landmark_id, None)
        if evidence < self.alarm or not self._is_usual(moved):
            return False
        self.displacements[landmark_id] = moved
        return True

    def _follow(self, landmark_id: int) -> None:
        """Add a hypothesis of this landmark; if there are too many, it replaces the one not seen for longest."""
        row = self._rows.pop(landmark_id, None)
        if row is None:
            row = len(self._rows) if len(self._rows) < len(self._ids) else self._rows.pop(next(iter(self._rows)))
            self._ids[row], self._places[row] = landmark_id, self._factors.landmarks[landmark_id].position[:2]
            self._reset(np.arange(len(self._ids)) == row)
            self._evidence[:, row] = self._seen[:, row] = 0.0
        self._rows[landmark_id] = row

    def _known(self, belief: PoseWithCovariance) -> InstallationEstimate:
        return belief.installation or self._factors.estimated

    def _reset(self, rows: NDArray[np.bool_]) -> None:
        self._M[rows], self._moved[rows], self._cov[rows] = 0.0, 0.0, MOVED**2 * np.eye(2)
        self._evidence[rows], self._seen[rows], self._explained[rows] = 0.0, 0.0, 0.0
        self._information[rows] = 0.0

    def _take(
        self,
        predicted: PoseWithCovariance,
        belief: PoseWithCovariance,
        seen: Sequence[LandmarkMeasurement],
        lines: Lines | None,
    ) -> None:
        """Add the evidence of fused sightings and update M; without lines they are linear about the belief."""
        known, theta = self._known(predicted), self._known(belief).mean
        pose, there = predicted.pose, np.zeros(3 + len(theta))
        if lines is None:
            pose, lines = belief.pose, self._factors.observe(seen).together(belief.pose, theta)
            there = np.concatenate([se2.log(se2.between(predicted.pose, belief.pose)), theta - known.mean])
        if lines.behind.any():
            return
        P = predicted.joint_cov(known)
        found = innovation(P, lines)
        G, parts, own = -(found.H @ self._M), lines.parts, by_displacement(found.H, pose)
        for m, part in zip(seen, parts, strict=True):
            if m.of_landmark:
                G[self._rows[m.landmark_id], part] -= own[part]
        W = sighting_whitening(found.cov)  # lower triangular: each sighting given those before it
        w, G = W @ (found.residual - found.H @ there), W @ G
        for m, part in zip(seen, parts, strict=True):
            if m.of_landmark:
                self._weigh(m, w[part], G[:, part])
        gain = P @ found.H.T @ W.T
        self._M += gain @ G
        sensors = [m.row_kind if m.of_landmark else "" for m, part in zip(seen, parts, strict=True) for _ in w[part]]
        self.mounts.take(seen[0].stamp_ns, found.H, W, w, gain, sensors)

    def _contradicted(self, P: FloatArray, belief: PoseWithCovariance, m: LandmarkMeasurement) -> None:
        """A sighting that was rejected; how its own landmark's displacement explains it may be far from linear."""
        own, observed, scale = self._rows[m.landmark_id], self._factors.observe([m]), self._shared(m)
        one = observed.together(belief.pose, self._known(belief).mean)
        if one.behind.any():
            return
        found = innovation(P, one)
        W = sighting_whitening(found.cov) / scale
        misread = chi2_bound(self._gate, len(one.residual)) / scale**2
        explained = self._explain_own(own, P, belief, observed, scale)
        if explained[0][0] > misread and self._evidence[own].sum() <= 0.0:
            self._reset(np.arange(len(self._ids)) == own)  # it was in place; it may be moved from now on
            explained = self._explain_own(own, P, belief, observed, scale)
        self._weigh(m, W @ found.residual, -W @ found.H @ self._M, explained, misread)

    def _weigh_return(self, P: FloatArray, belief: PoseWithCovariance, m: LandmarkMeasurement) -> None:
        """Hold a sighting of a left-out landmark against its displacement; use the landmark again if that is wrong."""
        observed, scale, by = self._factors.observe([m]), self._shared(m), self.displacements[m.landmark_id]
        theta, costs = self._known(belief).mean, []
        for moved in (np.zeros(2), by):
            x, y = belief.pose[:2] - moved  # moving the landmark one way is moving the robot the other
            one = observed.together(np.array([x, y, belief.pose[2]]), theta)
            if one.behind.any():
                return
            misread = chi2_bound(self._gate, len(one.residual))
            found = innovation(P, one)
            w = sighting_whitening(found.cov) @ found.residual
            costs.append(min(float(w @ w), misread) / scale**2)
        evidence = max(self._returned.get(m.landmark_id, 0.0) + costs[1] - costs[0], 0.0)
        self._returned[m.landmark_id] = evidence
        if evidence > self.alarm:
            del self.displacements[m.landmark_id], self._returned[m.landmark_id]

    def _explain_own(
        self, row: int, P: FloatArray, belief: PoseWithCovariance, observed: Observations, scale: float
    ) -> Explained:
        """One rejected sighting under the hypothesis that its landmark was moved: iterated Kalman update."""
        theta, moved = self._known(belief).mean, self._moved[row]
        rows = self._factors.installation.landmarks.get(int(self._ids[row]), (0, 0))
        explained = np.array([np.inf]), self._moved[row, None], self._cov[row, None]
        for _ in range(MOST_STEPS):
            x, y = belief.pose[:2] - moved  # moving the landmark one way is moving the robot the other
            one = observed.together(np.array([x, y, belief.pose[2]]), theta)
            if one.behind.any():
                break
            found, B = innovation(P, one), by_displacement(one.H, belief.pose)
            W = sighting_whitening(found.cov + rotation_cov(one.H, rows)) / scale
            G = -W @ (B + found.H @ self._M[row])
            w = W @ (found.residual - B @ moved)
            explained = explain(w, G[None], self._moved[row, None], self._cov[row, None])
            moved = explained[1][0]
        return explained

    def _weigh(
        self,
        m: LandmarkMeasurement,
        w: FloatArray,
        G: FloatArray,
        own: Explained | None = None,
        misread: float | None = None,
    ) -> None:
        """Add the evidence of one sighting.

        Args:
            m: the sighting.
            w: ``(d,)`` its white innovation if all are in place.
            G: ``(L, d, 2)`` derivative of that one's mean by each landmark's displacement.
            own: how its own landmark's displacement explains it, if that is not linear.
            misread: cost of its being misread; None: that of one whose errors are its own.
        """
        row = self._rows[m.landmark_id]
        misread = chi2_bound(self._gate, len(w)) if misread is None else misread
        cost, moved, cov = explain(w, G, self._moved, self._cov)
        if own is not None:
            cost[row], moved[row], cov[row] = own[0][0], own[1][0], own[2][0]
        explains = cost < misread
        if explains[row]:
            self._add_information(row, np.linalg.inv(cov[row]) - np.linalg.inv(self._cov[row]), m.in_pixels)
        self._moved[explains], self._cov[explains] = moved[explains], cov[explains]
        self._evidence[:, row] += min(float(w @ w), misread) - np.minimum(cost, misread)
        self._seen[:, row] += 1.0
        self._explained[row] += explains[row]

    def _add_information(self, row: int, information: FloatArray, same_errors: bool) -> None:
        """Add the information ``(2, 2)`` of a sighting about its landmark's displacement.

        Errors of a marker's corners are the same in one image after another while the view hardly changes: a few tenths
        of a pixel that put a small one at 6 m off by 0.17 m. So its sharpest sighting counts for all of them.
        """
        if not same_errors:
            self._information[row] += information
        elif np.linalg.det(information) > np.linalg.det(self._information[row]):
            self._information[row] = information

    def _shared(self, m: LandmarkMeasurement) -> float:
        """Scale on the sigma of a rejected sighting, as errors of one landmark are correlated for some time."""
        if not m.errors_repeat:
            return 1.0
        return math.sqrt(repetition(self._repeat_s, self._last_ns.get(m.landmark_id), m.stamp_ns))

    def _certain(self) -> int | None:
        """A landmark that was moved, if no other one explains the sightings."""
        evidence = self._evidence.sum(1)
        for row in np.argsort(-evidence):
            if evidence[row] < self.alarm:
                break
            margins = ((self._evidence[row] - self._evidence) * (self._evidence[row] > 0.0)).sum(1)
            margins[row] = np.inf  # the others' are of what this one explains
            if margins.min() > 0.0 and self._plausible(int(row)):
                return int(self._ids[row])
        return None

    def _is_usual(self, moved: FloatArray) -> bool:
        """Whether a landmark may have been moved so far: less may be the survey's error, and a misreading more."""
        return _LEAST_M < math.hypot(*moved) < MOVED * math.sqrt(chi2_bound(self._gate, 2))

    def _plausible(self, row: int) -> bool:
        """Whether it is far enough off beside others that are in place, and not these misread."""
        moved = self._moved[row]
        if not self._is_usual(moved) or moved @ self._information[row] @ moved < chi2_bound(self._gate, 2):
            return False
        near = np.hypot(*(self._places - self._places[row] - moved).T) < _NEAR_M
        near[row] = False
        least = max(self._least, 0.5 * self._seen[row, row], _MISREAD_SHARE * self._seen[row, near].sum())
        return bool(self._explained[row] >= least) and len(self._in_place - {self._ids[row]}) >= _PROVEN
