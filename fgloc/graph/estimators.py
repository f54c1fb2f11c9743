"""The online estimators: what they share, the extended Kalman filter, and iSAM2 in a fixed lag or whole."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence

import gtsam
import numpy as np
from scipy.linalg.lapack import dpotri

from fgloc import se2
from fgloc.config import Config, EstimatorConfig
from fgloc.errors import ConfigError, EstimatorError
from fgloc.graph.factors import (
    INSTALLATION,
    LandmarkFactors,
    factor_graph,
    ground_key,
    installed_motion_factor,
    installed_prior_factor,
    landmark_key,
    linear_factor,
    motion_factor,
    pose_key,
    pose_vector,
    prior_factor,
    sighting_factors,
)
from fgloc.graph.ground import ground_factors, ground_prior, is_level_known, levelled, predict, starting, step_of
from fgloc.graph.installation import GROUND, VACANT_SIGMA, Installation, InstallationEstimate, installation_of
from fgloc.graph.joint import EXACT, conditioned, considered, correct, is_linear
from fgloc.graph.measurement_log import Keyframe, LoggedSighting, MeasurementLog, PoseWithCovariance, Remounting
from fgloc.sensors.equipment import MotionSensors, PoseSensors
from fgloc.sensors.learned.sensor import gains_of
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.types import (
    FloatArray,
    LandmarkMap,
    MotionMeasurement,
)

# --- What all estimators share ----------------------------------------------------------------------------------------


class Estimator(ABC):
    """Poses of the newest keyframes, one update a step.

    Attributes:
        factors: makes the factors of landmarks; it has what is known of the installation.
        log: every measurement of the window (or of the run, if ``keep_all``).
        belief: the newest pose.
        k: index of the newest keyframe, -1 before the first.
        elapsed_s: the estimator's own time: runs on through clock jumps.
        rebuilt: how often what the estimator held had to be built again from the log.
        contradicted: constants that left the gate of their prior, with value and sigma that they had then. They are
            held at what was given from then on, and their prior's uncertainty stays in the covariance of the pose.
    """

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        self._config = config
        self.factors = factors
        self.log = MeasurementLog(config.lag_s, keep_all or config.kind == "isam2")
        self.rebuilt = 0
        self.belief: PoseWithCovariance | None = None
        self.k = -1
        self._corrected = -1  # the keyframe that was corrected last: those before it lead elsewhere
        self.elapsed_s = 0.0
        self.contradicted: dict[str, tuple[float, float]] = {}
        self._last_seen: dict[int, None] = {}  # landmarks of a map that has more than can be states, in this order
        self._given: list[tuple[int, list[slice]]] = []  # keyframes from whose beliefs on rows are of a landmark

    @property
    def installation(self) -> Installation:
        """The parameters beside the pose."""
        return self.factors.installation

    @property
    def installed(self) -> InstallationEstimate:
        """Newest estimate of the installation, with its covariance."""
        return self.factors.estimated

    @property
    def newest(self) -> Keyframe:
        """The newest keyframe."""
        return self.log.keyframes[self.k]

    def smoothed(self, k: int) -> FloatArray | None:
        """Pose ``(3,)`` of a keyframe as it is estimated now; None: it has left the window."""
        return self.log.keyframes[k].belief.pose if k in self.log.keyframes else None

    def start(
        self, stamp_ns: int, prior: PoseWithCovariance, sightings: Sequence[LoggedSighting] = ()
    ) -> PoseWithCovariance:
        """Begin a segment: a first pose with a prior, unconnected to what was before."""
        if self.installation.stateless and (rows := self._occupied(sightings)):
            self.factors.states_changed()
            self.factors.estimated = self._anew(self.installed, rows)
            if self.k >= 0 and self._config.kind == "isam2":  # the graph goes on
                self._add_prior(rows)
        self.k += 1
        self.elapsed_s += 1e-3
        frame = Keyframe(self.k, stamp_ns, self.elapsed_s, prior, prior=prior, sightings=tuple(sightings))
        return self._take(frame)

    def predict(self, motions: Sequence[MotionMeasurement]) -> PoseWithCovariance:
        """Predicted pose after the motions of one step (information-weighted), before any sighting.

        Raises:
            EstimatorError: not started, or no motion.
        """
        if self.belief is None or not motions:
            raise EstimatorError("predict needs a started estimator and at least one motion measurement")
        if not self.installation.ground:
            return predict(self.belief, self.installed, self.factors.installation, motions)
        predicted = predict(self.belief, self.belief.installation or self.installed, self.installation, motions)
        assert predicted.installation is not None
        self.factors.estimated = predicted.installation  # sightings are held against the ground as predicted
        return predicted

    def forget_contradictions(self) -> None:
        """The pose was somewhere else: constants that it had contradicted are what they were before any measurement.

        What was learned of all others at the wrong place is as wrong.
        """
        if self.contradicted:
            self.contradicted.clear()
            self.factors.estimated = self.installation.prior()

    def level(self, motions: Sequence[MotionMeasurement]) -> None:
        """Update roll and pitch by gravity over a step, while no pose is known."""
        if self.installation.ground:
            self.factors.estimated = levelled(self.installed, motions, self.installation)

    def forget_ground(self) -> None:
        """A first pose comes: height, roll and pitch there may be others than those of the newest step."""
        if self.installation.ground:
            self.factors.estimated = starting(self.installed, self.installation)

    def update(
        self,
        stamp_ns: int,
        dt: float,
        motions: Sequence[MotionMeasurement],
        sightings: Sequence[LoggedSighting] = (),
        rejected: Sequence[LoggedSighting] = (),
        predicted: PoseWithCovariance | None = None,
    ) -> PoseWithCovariance:
        """Add one keyframe with its measurements; return the filtered pose.

        Args:
            stamp_ns: time of the keyframe.
            dt: time since the one before [s].
            motions: between-factors from the one before; at least one.
            sightings: landmark measurements, motion-compensated to this keyframe.
            rejected: sightings that are only logged, for the cost of the batch.
            predicted: result of `predict` for these motions, if the caller has it already.
        """
        predicted = predicted or self.predict(motions)
        self.k += 1
        self.elapsed_s += max(dt, 1e-6)
        frame = Keyframe(
            self.k, stamp_ns, self.elapsed_s, predicted, None, tuple(motions), tuple(sightings), tuple(rejected)
        )
        return self._take(frame)

    def revise(self, motions: Mapping[int, Sequence[MotionMeasurement]], anew: bool = False) -> None:
        """Replace the motion factors of keyframes that the estimator still holds; the newest belief follows.

        Older ones are changed in the log alone, for the batch smoother.

        Args:
            motions: those of each keyframe.
            anew: they are so different that the poses since then are predicted anew.
        """
        for k, changed in motions.items():
            self.log.keyframes[k].motions = tuple(changed)
        if motions and self.belief is not None:
            if anew:
                self._drive_again(min(motions))
            else:
                self._solve_again(sorted(motions))
            self._adopt(self.newest.belief)

    def _drive_again(self, first: int) -> None:
        """Solve anew from keyframe ``first`` on, as the motions since then are other ones."""
        self._solve_again([first])

    def correct(self, belief: PoseWithCovariance, landmark_id: int) -> None:
        """Go on from another newest pose, which owes nothing to a landmark; its sightings are only logged."""
        for frame in self.log.keyframes.values():
            of_it = tuple(s for s in frame.sightings if s.measurement.landmark_id == landmark_id)
            if of_it:
                frame.sightings = tuple(s for s in frame.sightings if s.measurement.landmark_id != landmark_id)
                frame.rejected = (*frame.rejected, *of_it)
        newest = self.newest
        newest.belief, self._corrected = belief, self.k
        self._begin_at(newest)
        self._adopt(newest.belief)

    @property
    def can_remount(self) -> bool:
        """Whether a mounting may change: not where one graph holds all poses, seen by a camera that stays as it is."""
        return self.factors.known and self._config.kind != "isam2"

    def loosened(
        self, belief: PoseWithCovariance, kind: str, now: InstallationEstimate | None = None
    ) -> PoseWithCovariance:
        """The belief if the mounting of a sensor is no longer what was found of it, but off by what a knock does.

        Args:
            belief: pose and installation.
            kind: of the sensor's sightings.
            now: of the installation, if the mounting in it is the one that is known now.
        """
        rows, added = self.installation.mounting(kind)
        known = belief.installation or self.installed
        cross: FloatArray = np.zeros((3, len(known.cov))) if belief.cross is None else belief.cross.copy()
        cross[:, rows] = 0.0
        anew = (np.diag(added), None) if now is None else (now.cov[np.ix_(rows, rows)], now.mean[rows])
        return PoseWithCovariance(belief.pose, belief.cov, cross, known.anew(rows, *anew))

    def remount(
        self, belief: PoseWithCovariance, kind: str, since_ns: int, now: InstallationEstimate | None = None
    ) -> None:
        """Go on from another newest pose, as the mounting of a sensor changed: the belief is loosened.

        Args:
            belief: pose and installation without what the change has done to them.
            kind: of the sensor's sightings.
            since_ns: stamp of the first of them since then.
            now: of the installation, if the mounting in it is the one that is known now.
        """
        rows, added = self.installation.mounting(kind)
        if all(change.kind != kind for change in self.log.remounted):  # later ones improve on the first
            self.log.remounted.append(Remounting(kind, since_ns, self.installed.mean[rows]))
        self.installation.widen_gate(rows, added)
        for name in [self.installation.names[i] for i in rows]:
            self.contradicted.pop(name, None)
        newest = self.newest
        newest.belief, self._corrected = self.loosened(belief, kind, now), self.k
        self._begin_at(newest)
        self._adopt(newest.belief)

    def mounted_anew(
        self, belief: PoseWithCovariance, kind: str, H: FloatArray, shift: FloatArray
    ) -> PoseWithCovariance:
        """The belief with another mounting of a sensor, by what the change does to its sightings.

        Args:
            belief: pose and installation.
            kind: of the sensor's sightings.
            H: ``(d, 3 + n)`` of some of them by pose and installation.
            shift: ``(d,)`` of those by the change.
        """
        rows, variances = self.installation.mounting(kind)
        known, A = belief.installation or self.installed, H[:, 3 + rows]
        mean = known.mean.copy()
        mean[rows] += np.linalg.solve(A.T @ A + np.diag(1.0 / variances), A.T @ shift)
        return PoseWithCovariance(belief.pose, belief.cov, belief.cross, InstallationEstimate(mean, known.cov))

    def give_states(self, sightings: Sequence[LoggedSighting]) -> tuple[slice, list[slice]]:
        """Make states of the landmarks that are none of sightings which are to be fused at the next keyframe.

        Where no rows are vacant, some are added; where there are as many as there may be, a third of the landmarks,
        those not seen for longest, becomes stateless: what was known of their places is forgotten. After either the
        newest belief begins a new window; so it is rare. Sightings of a landmark that is no state have the sigma of
        the map as noise.

        Returns:
            Rows that were added to the installation, and those that are now of other landmarks.
        """
        installation, newest, added = self.installation, self.newest, slice(0, 0)
        if not installation.stateless:
            return added, []
        here = dict.fromkeys(s.measurement.landmark_id for s in sightings)
        before = dict.fromkeys([*(installation.landmarks.keys() - self._last_seen.keys()), *self._last_seen])
        self._last_seen = dict.fromkeys([*(i for i in before if i not in here and i in installation.landmarks), *here])
        wanted = [i for i in here if i in installation.stateless]
        gone: list[int] = []
        if len(wanted) > installation.vacancies and self._config.kind != "isam2" and newest.prior is None:
            added = installation.grow()
            if added.start == added.stop:
                idle = [i for i in self._last_seen if i not in here]
                gone = idle[: max(len(wanted) - installation.vacancies, len(installation.landmarks) // 3)]
        rows = [installation.vacate(i) for i in gone]
        rows += self._occupied(sightings)
        if not rows:
            return added, []
        self.factors.states_changed()
        newest.belief = self._forgetful(_wider(newest.belief, self.installed, added), rows)
        if gone or added.stop > added.start:
            self._corrected = self.k
            self.factors.estimated = newest.belief.installation or self.installed
            self._begin_at(newest)
        else:
            self._add_prior(rows)
        self._adopt(newest.belief)
        return added, rows

    def _given_since(self, k: int, end: float = math.inf) -> list[slice]:
        """Rows that were given to landmarks from the belief of keyframe ``k`` on, before keyframe ``end``."""
        return [own for at, rows in self._given if k <= at < end for own in rows]

    def _occupied(self, sightings: Sequence[LoggedSighting]) -> list[slice]:
        """Rows of the landmarks that are made states, as long as some are vacant."""
        seen = dict.fromkeys(s.measurement.landmark_id for s in sightings)
        wanted = [i for i in seen if i in self.installation.stateless]
        return [self.installation.occupy(i) for i in wanted[: self.installation.vacancies]]

    def _forgetful(self, belief: PoseWithCovariance, rows: Sequence[slice]) -> PoseWithCovariance:
        """The belief with nothing but their prior known of these rows of the installation."""
        known = self._anew(belief.installation or self.installed, rows)
        cross = None if belief.cross is None else belief.cross.copy()
        if cross is not None:
            for own in rows:
                cross[:, own] = 0.0
        return PoseWithCovariance(belief.pose, belief.cov, cross, known)

    def _anew(self, known: InstallationEstimate, rows: Sequence[slice]) -> InstallationEstimate:
        prior = self.installation.prior()
        for own in rows:
            known = known.anew(np.arange(own.start, own.stop), prior.cov[own, own], prior.mean[own])
        return known

    def _add_prior(self, rows: Sequence[slice]) -> None:
        """Add the prior of landmarks in rows of the installation that were vacant."""
        self._given = [*((k, before) for k, before in self._given if k in self.log.keyframes), (self.k, list(rows))]

    @abstractmethod
    def _begin_at(self, newest: Keyframe) -> None:
        """Forget what led to the belief of this keyframe, which stands as it is."""

    def _take(self, frame: Keyframe) -> PoseWithCovariance:
        self._solve(frame)
        frame.ground = self.ground_of(frame.belief)
        self.log.append(frame)
        self._adopt(frame.belief)
        return frame.belief

    def ground_of(self, belief: PoseWithCovariance) -> FloatArray | None:
        """Height, roll and pitch ``(3,)``; None where the floor is flat."""
        if not self.installation.ground:
            return None
        return (belief.installation or self.installed).mean[self.installation.constants :]

    def asked(self) -> InstallationEstimate:
        """Installation in which held constants have the value at which they left the gate of their prior."""
        known = self.installed
        for name, (value, sigma) in self.contradicted.items():
            row = np.array([self.installation.index[name]])
            known = known.anew(row, np.array([[sigma**2]]), np.array([value]))
        return known

    def _held(self) -> list[int]:
        """Rows of pose and installation together that are held."""
        return [3 + self.installation.index[name] for name in self.contradicted]

    def if_as_seen(self) -> Iterator[tuple[str, FloatArray, FloatArray]]:
        """How the newest pose would differ if a held constant were what sightings made of it.

        Yields:
            Name of the constant, difference ``(3,)`` in the base's axes, and its covariance ``(3, 3)``.
        """
        known, cross = (None, None) if self.belief is None else (self.belief.installation, self.belief.cross)
        if known is None or cross is None:
            return
        prior, rows = self.installation.prior(), [self.installation.index[name] for name in self.contradicted]
        gains = np.linalg.solve(known.cov[np.ix_(rows, rows)], cross[:, rows].T) if rows else ()
        for (name, (value, sigma)), i, gain in zip(self.contradicted.items(), rows, gains, strict=True):
            yield name, gain * (value - prior.mean[i]), np.outer(gain, gain) * sigma**2

    def _hold_beyond_gate(self, belief: PoseWithCovariance) -> bool:
        """From now on hold what this belief has furthest beyond the gate of its prior; whether there was something.

        Not all at once: what one wrong constant makes impossible pulls others along.
        """
        known = belief.installation
        names = () if known is None else self.installation.beyond_gate(known)
        new = [name for name in names if name not in self.contradicted][:1]
        for name in new:
            i = self.installation.index[name]
            assert known is not None
            self.contradicted[name] = float(known.mean[i]), math.sqrt(max(0.0, float(known.cov[i, i])))
        return bool(new)

    def _considered(self, belief: PoseWithCovariance) -> PoseWithCovariance:
        """The belief with what is held as uncertain as its prior."""
        if not self.contradicted or belief.installation is None:
            return belief
        rows, prior = self._held(), self.installation.prior()
        held = [i - 3 for i in rows]
        P = considered(belief.joint_cov(belief.installation), rows, prior.cov[np.ix_(held, held)])
        belief.installation.mean[held] = prior.mean[held]
        return PoseWithCovariance.jointly(belief.pose, belief.installation.mean, P)

    def _adopt(self, belief: PoseWithCovariance) -> None:
        self.belief = belief
        if belief.installation is not None:
            self.factors.estimated = belief.installation

    def _solve_again(self, changed: Sequence[int]) -> None:
        """The motions of these keyframes (in order) have changed: filter anew from the first of them on."""
        for k in range(max(changed[0], self._corrected + 1), self.k + 1):
            before, frame = self.log.keyframes.get(k - 1), self.log.keyframes[k]
            if before is None or frame.prior is not None:
                continue
            known = before.belief.installation or self.installed
            frame.belief = predict(before.belief, known, self.factors.installation, frame.motions)
            self._solve(frame)
            frame.belief = self._forgetful(frame.belief, self._given_since(k, k + 1))

    @abstractmethod
    def _solve(self, frame: Keyframe) -> None:
        """Replace the belief of a keyframe, which is its prior or its prediction, by the filtered one."""


def _wider(belief: PoseWithCovariance, known: InstallationEstimate, added: slice) -> PoseWithCovariance:
    """The belief with these rows of the installation added, of which nothing is known."""
    known, at = belief.installation or known, [added.start] * (added.stop - added.start)
    cov = np.insert(np.insert(known.cov, at, 0.0, axis=0), at, 0.0, axis=1)
    cov[added, added] = VACANT_SIGMA**2 * np.eye(len(at))
    cross = None if belief.cross is None else np.insert(belief.cross, at, 0.0, axis=1)
    wider = InstallationEstimate(np.insert(known.mean, at, 0.0), cov)
    return PoseWithCovariance(belief.pose, belief.cov, cross, wider)


# --- The extended Kalman filter, to compare with ----------------------------------------------------------------------


class ExtendedKalmanFilter(Estimator):
    """Predicts by the fused motion and corrects by all accepted sightings at once.

    It is given the measurements of the fixed-lag smoother, after the same χ² gates. What a filter lacks remains: no
    sighting changes an older pose. Its log serves the batch smoother.

    Source: Thrun, Burgard, Fox, Probabilistic Robotics, table 7.2; on SE(2) with a right perturbation, iterated.
    """

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        """Begin without a pose.

        Raises:
            ConfigError: the map is unknown.
        """
        if not factors.known:
            raise ConfigError(
                "estimator.kind is ekf, which does not estimate landmarks: give a map with --map, or build one with "
                "`fgloc map`"
            )
        super().__init__(config, factors, keep_all)

    def _solve(self, frame: Keyframe) -> None:
        known = frame.belief.installation or self.installed
        if frame.sightings:
            measurements = [s.measurement for s in frame.sightings]
            before = self._exact(frame.belief, known)
            corrected = correct(before, before.installation or known, measurements, self.factors)
            while corrected is not None and self._hold_beyond_gate(corrected[0]):
                before = self._exact(frame.belief, known)
                corrected = correct(before, before.installation or known, measurements, self.factors)
            if corrected is not None:
                frame.belief = self._considered(corrected[0])
        if frame.belief.installation is None:
            frame.belief.installation = known

    def _exact(self, belief: PoseWithCovariance, known: InstallationEstimate) -> PoseWithCovariance:
        """The belief with what is held as it was given, and nothing uncertain about it."""
        if not self.contradicted:
            return belief
        rows, P, prior = self._held(), belief.joint_cov(known), self.installation.prior()
        gap = np.array([prior.mean[i - 3] - known.mean[i - 3] for i in rows])
        shift = np.linalg.solve(P[np.ix_(rows, rows)], P[rows]).T @ gap
        pose = se2.compose(belief.pose, se2.exp(shift[:3]))
        return PoseWithCovariance.jointly(pose, known.mean + shift[3:], conditioned(P, rows))

    def _begin_at(self, newest: Keyframe) -> None:
        """Do nothing: a filter holds no earlier keyframes."""


# --- The two smoothers of GTSAM behind one interface ------------------------------------------------------------------

_NEVER = 1e9


class Backend(ABC):
    """A smoother of GTSAM: both are read through iSAM2."""

    @property
    @abstractmethod
    def isam2(self) -> gtsam.ISAM2:
        """The solver that holds the estimate."""

    @abstractmethod
    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, elapsed_s: float) -> list[int]:
        """Add a keyframe; return the slots of its factors, in their order."""

    @abstractmethod
    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:
        """Replace the factors in these slots, if any, by others on variables that are there; the slots of the new."""

    def holds(self, k: int) -> bool:
        """Whether a keyframe is in the window."""
        return bool(self.isam2.valueExists(pose_key(k)))

    def pose(self, k: int) -> FloatArray:
        """Estimated pose ``(3,)`` of a keyframe."""
        return pose_vector(self.isam2.calculateEstimatePose2(pose_key(k)))

    def belief(self, k: int, n: int, ground: bool = False) -> PoseWithCovariance:
        """Pose of a keyframe with an installation of ``n`` parameters, and their joint covariance.

        ``ground``: the installation ends with height, roll and pitch of the keyframe.
        """
        pose = self.pose(k)
        if ground:
            return _joint_on_ground(self.isam2, pose, k, n)
        if not n:
            return PoseWithCovariance(pose, np.asarray(self.isam2.marginalCovariance(pose_key(k))))
        return _joint(self.isam2, pose, k)


class FixedLag(Backend):
    """``IncrementalFixedLagSmoother`` over poses, and the installation, which never leaves the window."""

    def __init__(self, config: EstimatorConfig, installed: int, careful: bool = False) -> None:
        self._smoother = gtsam.IncrementalFixedLagSmoother(config.lag_s, isam2_params(config, installed, careful))
        self._installed = False

    @property
    def isam2(self) -> gtsam.ISAM2:  # noqa: D102
        return self._smoother.getISAM2()

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, elapsed_s: float) -> list[int]:  # noqa: D102
        stamps = dict.fromkeys(values.keys(), elapsed_s)
        self._installed |= INSTALLATION in stamps
        if self._installed:
            stamps[INSTALLATION] = elapsed_s
        self._smoother.update(graph, values, stamps)  # type: ignore[arg-type]
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:  # noqa: D102
        self._smoother.update(graph, gtsam.Values(), {}, slots)
        return list(self._smoother.getISAM2Result().getNewFactorsIndices())


class WholeRun(Backend):
    """``ISAM2`` over the whole run: landmarks may be variables; the cost grows with the run."""

    def __init__(self, config: EstimatorConfig, careful: bool = False) -> None:
        self._isam2 = gtsam.ISAM2(isam2_params(config, careful=careful))

    @property
    def isam2(self) -> gtsam.ISAM2:  # noqa: D102
        return self._isam2

    def update(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, elapsed_s: float) -> list[int]:  # noqa: D102
        return list(self._isam2.update(graph, values).getNewFactorsIndices())

    def swap(self, graph: gtsam.NonlinearFactorGraph, slots: list[int]) -> list[int]:  # noqa: D102
        return list(self._isam2.update(graph, gtsam.Values(), slots).getNewFactorsIndices())


def _joint(isam2: gtsam.ISAM2, pose: FloatArray, k: int) -> PoseWithCovariance:
    """Pose and installation with their joint covariance, of its square-root information: (RᵀR)⁻¹."""
    theta = isam2.calculateEstimateVector(INSTALLATION)
    R, _ = isam2.jointBayesNet(pose_key(k), INSTALLATION).matrix()
    upper, failed = dpotri(R)
    if failed:
        raise RuntimeError("the joint information of pose and installation is singular")
    upper = np.triu(upper)
    return PoseWithCovariance.jointly(pose, np.asarray(theta), upper + np.triu(upper, 1).T)


def _joint_on_ground(isam2: gtsam.ISAM2, pose: FloatArray, k: int, n: int) -> PoseWithCovariance:
    """Joint belief as `_joint`; the installation ends with height, roll and pitch of the ground at the keyframe."""
    keys = [pose_key(k), *([INSTALLATION] if n > len(GROUND) else []), ground_key(k)]
    found = isam2.jointMarginalCovariance(keys)
    mean = np.concatenate([np.asarray(isam2.calculateEstimateVector(key)) for key in keys[1:]])
    return PoseWithCovariance.jointly(pose, mean, np.block([[np.asarray(found.at(a, b)) for b in keys] for a in keys]))


def isam2_params(config: EstimatorConfig, installed: int = 0, careful: bool = False) -> gtsam.ISAM2Params:
    """iSAM2 settings that every backend shares; see gtsam's defaults for the rest.

    Args:
        config: for the threshold.
        installed: parameters of the installation, in which all factors are linear: relinearizing gives the same.
        careful: by QR; Cholesky takes a third of its time, but fails where sigmas are metres apart from millimetres:
            at a first pose that is hardly known, and after minutes without a fix.
    """
    params = gtsam.ISAM2Params()
    params.setFactorization("QR" if careful else "CHOLESKY")
    if installed:
        thresholds = gtsam.ISAM2ThresholdMap()
        thresholds.insert(("x", np.full(3, config.relinearize_threshold)))
        thresholds.insert(("i", np.full(installed, _NEVER)))
        thresholds.insert(("g", np.full(len(GROUND), _NEVER)))
        params.setRelinearizeThreshold(thresholds)
    else:
        params.setRelinearizeThreshold(config.relinearize_threshold)
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    return params


# --- The incremental estimator ----------------------------------------------------------------------------------------

_GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)


class IncrementalEstimator(Estimator):
    """The factor graph of the window, or of the run, kept solved."""

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        super().__init__(config, factors, keep_all)
        self._backend: Backend | None = None
        self._landmarks: set[int] = set()  # variables in the graph
        self._careful_until_s = -math.inf  # of the estimator's own time: by QR; Cholesky failed
        self._fresh = True  # nothing was given to the backend yet
        self._slots: dict[int, list[int]] = {}  # of the motion factors, by keyframe
        self._known_at_start = self.installed

    def smoothed(self, k: int) -> FloatArray | None:  # noqa: D102
        return self._backend.pose(k) if self._backend is not None and self._backend.holds(k) else None

    def _solve(self, frame: Keyframe) -> None:
        if self._backend is None or (frame.prior is not None and self._config.kind == "fixed_lag"):
            self._careful_until_s = -math.inf
            self._backend = self._new_backend()
            self._slots.clear()
            self._known_at_start = self.installed
        initial, predicted = self._linearization(frame), frame.belief
        try:
            graph, values = self._graph_of(frame, initial, frame.prior)
            self._keep_slots(frame, self._backend.update(graph, values, frame.elapsed_s))
            frame.belief = self._newest(frame.k)
        except _GTSAM_ERRORS:
            frame.belief = predicted  # which the sightings have no part in
            self._solve_carefully(frame, initial)
            return
        if math.isfinite(self._careful_until_s) and frame.elapsed_s > self._careful_until_s:
            self._careful_until_s = -math.inf
            try:
                frame.belief = self._replayed([*self._window(frame), frame], frame.belief)
            except _GTSAM_ERRORS:
                self._solve_carefully(frame, frame.belief)

    def _solve_carefully(self, frame: Keyframe, initial: PoseWithCovariance) -> None:
        """Solve by QR while the window holds what Cholesky fails at; if that fails too, the sightings are at fault."""
        predicted = frame.belief
        self._careful_until_s = frame.elapsed_s + self._config.lag_s
        try:
            frame.belief = self._replayed([*self._window(frame), frame], initial)
        except _GTSAM_ERRORS:
            self._rebuild(frame, predicted)

    def _linearization(self, frame: Keyframe) -> PoseWithCovariance:
        """Point of linearization: the prediction or, for sightings that are nonlinear over it, the corrected pose."""
        known = frame.belief.installation or self.installed
        near = is_level_known(known, self.installation) and is_linear(frame.belief)
        if not frame.sightings or not self.factors.known or near:
            return frame.belief
        measurements = [s.measurement for s in frame.sightings]
        corrected = correct(frame.belief, known, measurements, self.factors)
        return frame.belief if corrected is None else corrected[0]

    def _newest(self, k: int) -> PoseWithCovariance:
        belief = self._found(k)
        while self._hold_beyond_gate(belief):
            assert self._backend is not None
            self._backend.swap(factor_graph([self._holding()]), [])
            belief = self._found(k)
        return self._considered(belief)

    def _found(self, k: int) -> PoseWithCovariance:
        """Belief of keyframe ``k`` by the backend, in which held constants are nearly exact."""
        assert self._backend is not None
        belief = self._backend.belief(k, len(self.factors.installation), self.installation.ground)
        if not (math.isfinite(belief.pose[2]) and math.isfinite(belief.cov[0, 0])):
            raise ValueError("estimate is not finite")
        return belief

    def _holding(self) -> gtsam.NonlinearFactor:
        """Factor that holds the constants that left the gate of their prior at the given values."""
        constants = self.installation.constants
        rows = [self.installation.index[name] for name in self.contradicted]
        H = np.eye(constants)[rows] / EXACT
        values = gtsam.Values()
        values.insert(INSTALLATION, self.installation.prior().mean[:constants])
        return linear_factor({INSTALLATION: H}, np.zeros(len(rows)), values)

    def _add_prior(self, rows: Sequence[slice]) -> None:
        super()._add_prior(rows)
        assert self._backend is not None
        made, prior, values = [], self.installation.prior(), gtsam.Values()
        values.insert(INSTALLATION, prior.mean[: self.installation.constants])
        for own in rows:
            more = np.linalg.inv(prior.cov[own, own]) - np.eye(own.stop - own.start) / VACANT_SIGMA**2
            H = np.zeros((len(more), self.installation.constants))
            H[:, own] = np.linalg.cholesky(more).T
            made.append(linear_factor({INSTALLATION: H}, np.zeros(len(more)), values))
        try:
            self._backend.swap(factor_graph(made), [])
        except _GTSAM_ERRORS:
            self._careful_until_s = self.newest.elapsed_s + self._config.lag_s
            self._build_again()

    def _solve_again(self, changed: Sequence[int]) -> None:
        """Swap the motion factors of these keyframes, as far as the window holds them."""
        backend = self._backend
        if backend is None:
            return
        frames = [self.log.keyframes[k] for k in changed if k in self._slots]
        newest = self.newest
        graph = factor_graph(factor for frame in frames for factor in self._motion_factors(frame))
        slots = [slot for frame in frames for slot in self._slots[frame.k]]
        try:
            new = backend.swap(graph, slots) if frames else []
            newest.belief = self._newest(newest.k)
        except _GTSAM_ERRORS:
            self._careful_until_s = newest.elapsed_s + self._config.lag_s
            self._build_again()
            return
        for frame in frames:
            held, new = new[: len(frame.motions)], new[len(frame.motions) :]
            self._slots[frame.k] = held

    def _begin_at(self, newest: Keyframe) -> None:
        if self._config.kind == "fixed_lag":
            newest.belief = self._replayed([newest], newest.belief)
        else:
            self._build_again()

    def _build_again(self) -> None:
        """Build a new window from the log as it is now."""
        newest = self.newest
        initial = newest.belief
        try:
            newest.belief = self._replayed(self._window(newest) or [newest], initial)
        except _GTSAM_ERRORS:  # what the window knew is in the belief
            self.rebuilt += 1
            newest.belief = self._replayed([newest], initial)

    def _drive_again(self, first: int) -> None:
        for k in range(first, self.k + 1):
            before, frame = self.log.keyframes.get(k - 1), self.log.keyframes[k]
            if before is not None and frame.prior is None and not frame.sightings:
                known = before.belief.installation or self.installed
                frame.belief = predict(before.belief, known, self.factors.installation, frame.motions)
        if self._backend is not None:
            self._build_again()

    def _keep_slots(self, frame: Keyframe, slots: Sequence[int], prior: PoseWithCovariance | None = None) -> None:
        """Remember where the motion factors of a keyframe are, while both of their poses are in the window."""
        if frame.prior is None and prior is None:
            self._slots[frame.k] = list(slots[: len(frame.motions)])
        while self._slots and self._backend is not None and not self._backend.holds(next(iter(self._slots)) - 1):
            del self._slots[next(iter(self._slots))]

    def _window(self, frame: Keyframe) -> list[Keyframe]:
        """Logged keyframes that are in the window together with this one: of its segment, unless all are kept."""
        if self._config.kind != "fixed_lag":
            return list(self.log.keyframes.values())
        if frame.prior is not None:
            return []
        frames = [f for f in self.log.since(frame.elapsed_s - self._config.lag_s) if f.k >= self._corrected]
        starts = [i for i, f in enumerate(frames) if f.prior is not None]
        return frames[starts[-1] :] if starts else frames

    def _motion_factors(self, frame: Keyframe) -> list[gtsam.NonlinearFactor]:
        """Motion factors of a keyframe, linear about the pose before it; with a kernel on the wheels, nonlinear."""
        before, motions = self.log.keyframes.get(frame.k - 1), frame.motions
        if self.installation.ground and motions:
            motions = step_of(motions, self._theta_before(frame), self.installation).motions
        installed = self._config.motion_kernel == "none" and before is not None
        return [
            installed_motion_factor(frame.k, m, before.belief.pose, self.factors.installation)
            if installed and before is not None
            else motion_factor(frame.k, m, self._config.motion_kernel)
            for m in motions
        ]

    def _theta_before(self, frame: Keyframe) -> FloatArray:
        """Installation ``(n,)`` as it is known now, with height, roll and pitch at the keyframe before this one."""
        before = self.log.keyframes.get(frame.k - 1)
        return (self.installed if before is None else self._on_ground(before, self.installed)).mean

    def _ground_factors(self, frame: Keyframe) -> list[gtsam.NonlinearFactor]:
        if not self.installation.ground or not frame.motions:
            return []
        motions, theta = frame.motions, self._theta_before(frame)
        return ground_factors(frame.k, motions, step_of(motions, theta, self.installation), theta, self.installation)

    def _graph_of(
        self, frame: Keyframe, initial: PoseWithCovariance, prior: PoseWithCovariance | None
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """Factors and first values of a keyframe; of the first one in a new backend, also of the installation."""
        values = gtsam.Values()
        values.insert(pose_key(frame.k), gtsam.Pose2(*initial.pose))
        known = initial.installation or self.installed
        constants = self.installation.constants
        if self.installation.ground:
            known = known if initial.installation is not None else self._on_ground(frame, known)
            values.insert(ground_key(frame.k), known.mean[constants:])
        if self._fresh and constants:
            values.insert(INSTALLATION, known.mean[:constants])
        if prior is None:
            made = [*self._motion_factors(frame), *self._ground_factors(frame)]
        elif len(known.mean) and self._fresh:
            made = [installed_prior_factor(frame.k, prior, self._on_ground(frame, self.installed), constants)]
        else:
            made = [prior_factor(frame.k, prior.pose, prior.cov)]
            if self.installation.ground:
                made.append(ground_prior(frame.k, known.mean[constants:], known.cov[constants:, constants:]))
        held = [self._holding()] if self._fresh and self.contradicted else []
        self._fresh = False
        if self.factors.known and frame.sightings:
            measurements = [s.measurement for s in frame.sightings]
            if known is self.factors.estimated:
                lines = self.factors.linearize(measurements, initial.pose)
            else:
                lines = self.factors.observe(measurements).together(initial.pose, known.mean)
            ahead = np.flatnonzero(~lines.behind).tolist()
            if ahead:
                sightings, lines = [frame.sightings[i] for i in ahead], lines.only(ahead)
                made += sighting_factors(frame.k, sightings, lines, initial.pose, known.mean, constants)
        for sighting in frame.sightings:
            self._introduce(sighting.measurement, initial.pose, values)
            made += [] if sighting.factor is None else [sighting.factor]
        return factor_graph([*held, *made]), values

    def _on_ground(self, frame: Keyframe, known: InstallationEstimate) -> InstallationEstimate:
        """The installation with height, roll and pitch of this keyframe, which may not be the newest."""
        if frame.ground is None:
            return known
        mean = np.concatenate([known.mean[: self.installation.constants], frame.ground])
        return InstallationEstimate(mean, known.cov)

    def _introduce(self, m: LandmarkMeasurement, pose: FloatArray, values: gtsam.Values) -> None:
        """Give a first value to a landmark that is a variable and not yet in the graph."""
        if self.factors.known or m.landmark_id in self._landmarks:
            return
        key = landmark_key(m.landmark_id)
        initial = m.landmark_from(pose)
        if initial is None:
            return
        values.insert(key, initial if len(initial) == 2 else gtsam.Pose2(*initial))
        self._landmarks.add(m.landmark_id)

    def _rebuild(self, frame: Keyframe, initial: PoseWithCovariance) -> None:
        """Build the window again from the log, without the sightings of the offending step."""
        self.rebuilt += 1
        frame.rejected = (*frame.rejected, *frame.sightings)
        frame.sightings = ()
        try:
            frame.belief = self._replayed([*self._window(frame), frame], initial)
        except _GTSAM_ERRORS:  # an older sighting is at fault; what the window knew is in the prediction
            frame.belief = self._replayed([frame], initial)

    def _replayed(self, frames: Sequence[Keyframe], initial: PoseWithCovariance) -> PoseWithCovariance:
        """Give these keyframes to a new backend; the belief of the last, whose pose starts at ``initial``."""
        self._backend = backend = self._new_backend()
        self._landmarks.clear()
        self._slots.clear()
        newest = frames[-1].k
        for i, held in enumerate(frames):
            prior = held.prior
            if i == 0 and prior is None:  # its belief holds its sightings already
                prior, held = held.belief, dataclasses.replace(held, sightings=())
            if i == 0 and prior is not None and self.factors.known:
                known = prior.installation or self._known_at_start
                vacant = self._given_since(held.k)
                prior = self._forgetful(dataclasses.replace(prior, installation=known), vacant)
            start = initial if held.k == newest else PoseWithCovariance(held.belief.pose, held.belief.cov)
            graph, values = self._graph_of(held, start, prior)
            self._keep_slots(held, backend.update(graph, values, held.elapsed_s), prior)
        return self._newest(newest)

    def _new_backend(self) -> Backend:
        self._fresh = True
        installed = self.installation.constants if self.factors.known else 0
        careful = math.isfinite(self._careful_until_s)
        if self._config.kind == "fixed_lag":
            return FixedLag(self._config, installed, careful)
        return WholeRun(self._config, careful)


# --- The estimator of a run, by its configuration ---------------------------------------------------------------------


def make_estimator(
    config: Config, landmark_map: LandmarkMap | None, motion: MotionSensors, poses: PoseSensors, keep_all: bool
) -> Estimator:
    """Fixed-lag smoother, whole graph or extended Kalman filter.

    Args:
        config: ``estimator.kind`` says which.
        landmark_map: the known map; None: landmarks are variables.
        motion: sensors that have parameters in the installation.
        poses: likewise.
        keep_all: keep the measurement log of the whole run, for the batch smoother.

    Raises:
        ConfigError: the kind needs a known map.
    """
    installation = installation_of(
        config,
        landmark_map,
        poses.landmarks.sees_corners,
        has_gyro=motion.gyro is not None,
        gains=() if motion.learned is None else gains_of(motion.learned.model.card),
        sensed=[parameter for sensor in poses.registered for parameter in getattr(sensor, "parameters", ())],
        cameras=poses.landmarks.camera_names or ("",),
    )
    kind = ExtendedKalmanFilter if config.estimator.kind == "ekf" else IncrementalEstimator
    return kind(config.estimator, LandmarkFactors(landmark_map, installation), keep_all)
