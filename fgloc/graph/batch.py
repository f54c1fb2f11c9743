"""The batch smoother: Levenberg–Marquardt over the whole log, started from the incremental result."""

from __future__ import annotations

import math
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeAlias, TypeVar

import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.errors import CovarianceError, EstimatorError
from fgloc.graph.batch_factors import BatchMotions, BatchSightings, GroundMotions
from fgloc.graph.factors import (
    INSTALLATION,
    LandmarkFactors,
    factor_graph,
    ground_key,
    landmark_key,
    pose_key,
    pose_vector,
    prior_factor,
)
from fgloc.graph.installation import GROUND, InstallationEstimate
from fgloc.graph.joint import MOST_STEPS, fuse
from fgloc.graph.measurement_log import Keyframe, LoggedSighting, MeasurementLog
from fgloc.graph.noise import whitening_of
from fgloc.sensors.measurements import seen_since_knocked
from fgloc.stats import ROUNDING, chi2_bound
from fgloc.types import FloatArray, IntArray, Landmark, MotionMeasurement

# --- Initial values, order of elimination, covariances ----------------------------------------------------------------

_DEEP_STACK_BYTES = 1 << 30  # of address space; only what is used is taken

_KEYFRAMES_KEPT = 200  # whose separators GTSAM may keep: the way to the root, found again, is a twentieth of their cost

Solved: TypeAlias = gtsam.GaussianBayesTree | gtsam.Marginals | gtsam.ISAM2
"""What covariances are read from; the first where the order of elimination was given."""

_T = TypeVar("_T")


def with_deep_stack(work: Callable[[], _T]) -> _T:
    """Run in a thread of its own: in its own order GTSAM overflows 8 MB of stack with a chain of 1e5 poses."""
    before = threading.stack_size(_DEEP_STACK_BYTES)
    try:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(work).result()
    finally:
        threading.stack_size(before)


def dead_reckoned(frames: Sequence[Keyframe]) -> list[FloatArray]:
    """Poses ``(3,)`` by the motions alone, from the pose that each segment begins at."""
    poses: list[FloatArray] = []
    for frame in frames:
        if frame.prior is not None or not frame.motions or not poses:
            poses.append(frame.belief.pose if frame.prior is None else frame.prior.pose)
        else:
            poses.append(se2.compose(poses[-1], fuse(frame.motions)[0]))
    return poses


def values_at(
    frames: list[Keyframe],
    poses: Sequence[FloatArray],
    accepted: Mapping[int, tuple[LoggedSighting, ...]],
    factors: LandmarkFactors,
) -> gtsam.Values:
    """Values with these poses of the keyframes, and the landmarks where they are seen from there."""
    values = gtsam.Values()
    for frame, pose in zip(frames, poses, strict=True):
        values.insert(pose_key(frame.k), gtsam.Pose2(*pose))
        if frame.ground is not None:
            values.insert(ground_key(frame.k), frame.ground)
    if factors.installation.constants:
        values.insert(INSTALLATION, factors.estimated.mean[: factors.installation.constants])
    if factors.known:
        return values
    seen: dict[int, list[FloatArray]] = {}
    for frame, pose in zip(frames, poses, strict=True):
        for sighting in accepted[frame.k]:
            m = sighting.measurement
            place = m.landmark_from(pose)
            if place is not None:
                seen.setdefault(m.landmark_id, []).append(place)
    for landmark_id, places in seen.items():
        middle = places[int(np.argsort([p[0] for p in places])[len(places) // 2])]  # one of them: yaw has no median
        value = middle if len(middle) == 2 else gtsam.Pose2(*middle)
        values.insert(landmark_key(landmark_id), value)
    return values


def elimination_order(frames: Sequence[Keyframe], constants: int) -> gtsam.Ordering:
    """Keys in the order in which they are eliminated: poses by nested dissection of the chain, the installation last.

    The middle keyframe comes after both halves, and so in each half: a tree as deep as the logarithm of the length.
    GTSAM's default, COLAMD, leaves the chain in its own order. To find that, and then the roots of a tree as deep as
    the chain is long, for each factor of the installation anew, takes a time that grows with the square of the length.

    Source: George 1973, "Nested dissection of a regular finite element mesh".
    """
    ordering = gtsam.Ordering()
    parts = [(0, len(frames), False)]
    while parts:
        first, end, halves_done = parts.pop()
        middle = (first + end) // 2
        if halves_done:
            ordering.push_back(pose_key(frames[middle].k))
            if frames[middle].ground is not None:
                ordering.push_back(ground_key(frames[middle].k))
        elif first < end:
            parts += [(first, end, True), (middle + 1, end, False), (first, middle, False)]
    if constants:
        ordering.push_back(INSTALLATION)
    return ordering


def solved(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering | None) -> Solved:
    """The graph solved about these values, for its covariances; with long stretches that little determines, by QR.

    Raises:
        EstimatorError: the graph leaves a pose undetermined.
    """
    try:
        if ordering is not None:
            return graph.linearize(values).eliminateMultifrontal(ordering)
        return with_deep_stack(lambda: gtsam.Marginals(graph, values))
    except RuntimeError:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.relinearizeSkip = 1
        solver = gtsam.ISAM2(params)
    try:
        with_deep_stack(lambda: solver.update(graph, values))
    except RuntimeError as error:
        why = str(error).strip().partition("\n\n")[0].replace("\n", " ")  # what follows is advice on GTSAM's use
        raise EstimatorError(f"the covariances of the batch cannot be had: {why}") from error
    return solver


def pose_covs(solution: Solved, frames: Sequence[Keyframe]) -> FloatArray:
    """Covariances ``(n, 3, 3)`` of the poses, right perturbation."""
    covs = np.empty((len(frames), 3, 3))
    for row, frame in enumerate(frames):
        covs[row] = solution.marginalCovariance(pose_key(frame.k))
        forget_separators(solution, row)
    return covs


def forget_separators(solution: Solved, row: int) -> None:
    """After every so many keyframes: what GTSAM has kept of the way from the root to those before.

    That is 14 kB a keyframe with 40 parameters of the installation, 1 MB with 360. In a tree made by nested dissection
    the way of the next keyframe is short; in the others, of GTSAM's order, it may be as long as the chain.
    """
    if row % _KEYFRAMES_KEPT == _KEYFRAMES_KEPT - 1 and isinstance(solution, gtsam.GaussianBayesTree):
        solution.deleteCachedShortcuts()


def without_orphans(values: gtsam.Values, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """Values without the keys that the graph does not contain."""
    kept, mentioned = gtsam.Values(values), set(graph.keyVector())
    for key in values.keys():  # noqa: SIM118 (gtsam.Values is not iterable)
        if key not in mentioned:
            kept.erase(key)
    return kept


def estimated_landmarks(
    accepted: Mapping[int, tuple[LoggedSighting, ...]],
    values: gtsam.Values,
    marginals: Solved,
) -> dict[int, Landmark]:
    """Landmarks that were variables, with their covariance."""
    landmarks = {}
    for m in (s.measurement for sightings in accepted.values() for s in sightings):
        key = landmark_key(m.landmark_id)
        if m.landmark_id in landmarks:
            continue
        cov = np.asarray(marginals.marginalCovariance(key))
        if m.variable_dof == 3:
            pose = values.atPose2(key)
            place, yaw = np.array([pose.x(), pose.y(), 0.0]), pose.theta()
            c, s = np.cos(yaw), np.sin(yaw)
            rotation = np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])  # a standing marker, normal at this yaw
            cov = se2.rotate_cov(cov, yaw)[:2, :2]
        else:
            place, rotation = np.array([*values.atPoint2(key), 0.0]), np.eye(3)
        landmarks[m.landmark_id] = Landmark(m.landmark_id, place, rotation, 0.0, cov)
    return dict(sorted(landmarks.items()))


def ground_of(values: gtsam.Values, frames: Sequence[Keyframe]) -> FloatArray:
    """Height, roll and pitch ``(n, 3)`` of keyframes."""
    return np.array([values.atVector(ground_key(frame.k)) for frame in frames]).reshape(-1, len(GROUND))


def ground_covs(marginals: Solved, frames: Sequence[Keyframe]) -> FloatArray:
    """Covariances ``(n, 6, 6)`` of x, y, yaw (right perturbation), height, roll and pitch."""
    found = []
    for row, frame in enumerate(frames):
        keys = [pose_key(frame.k), ground_key(frame.k)]
        joint = marginals.jointMarginalCovariance(keys)
        found.append(np.block([[np.asarray(joint.at(a, b)) for b in keys] for a in keys]))
        forget_separators(marginals, row)
    return np.array(found)


_MOST_STATES = 100  # landmarks of a map that are states over the whole run


def of_whole_run(log: MeasurementLog, factors: LandmarkFactors) -> LandmarkFactors:
    """The factors with those landmarks as states that were seen most; of a map that has few, as they are.

    A camera that was knocked is another one since then, also in the log.
    """
    if factors.installation.stateless:
        seen = Counter(s.measurement.landmark_id for frame in log.keyframes.values() for s in frame.sightings)
        known = {*factors.installation.landmarks, *factors.installation.stateless}
        factors = factors.with_states([i for i, _ in seen.most_common() if i in known][:_MOST_STATES])
    names: dict[str, str] = {}
    for number, change in enumerate(log.remounted, 1):
        name = f"{names.get(change.kind, change.kind).rpartition('/')[0]}#{number}"
        factors = factors.with_mounting(names.get(change.kind, change.kind), name, change.before)
        names[change.kind] = f"{name}/corners"
        for frame in log.keyframes.values():
            if frame.stamp_ns >= change.stamp_ns:
                frame.sightings = tuple(_renamed(s, change.kind, name) for s in frame.sightings)
                frame.rejected = tuple(_renamed(s, change.kind, name) for s in frame.rejected)
    return factors


def _renamed(sighting: LoggedSighting, kind: str, name: str) -> LoggedSighting:
    measurement, alone = (seen_since_knocked(m, kind, name) for m in (sighting.measurement, sighting.alone))
    return replace(sighting, measurement=measurement, alone=alone)


# --- The smoother -----------------------------------------------------------------------------------------------------

_SAME = 1e-3  # share by which the error may rise where a step is linearized anew: noise of sightings is made there too
_SETTLED = 1.2  # factor by which a weight of the wheels may still change
_HALVINGS = 7  # tries of a step that fits worse, each of half the length: a sixty-fourth of it leads nowhere
_LARGEST_LOG = math.log(sys.float_info.max) - 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The result: keyframes in order."""

    stamps_ns: IntArray  # (n,)
    poses: FloatArray  # (n, 3)
    covs: FloatArray  # (n, 3, 3) right perturbation (body frame)
    ground: FloatArray | None  # (n, 3) height, roll and pitch; None: the floor is flat
    ground_covs: FloatArray | None  # (n, 6, 6) of x, y, yaw, height, roll and pitch
    landmarks: Mapping[int, Landmark]  # those that were variables
    error: float  # its GTSAM error


class BatchSmoother:
    """Solves the whole log.

    It holds the sightings that were accepted online. Of an unknown map, sightings that the first solution finds less
    likely than ``1 - gate_probability`` are left out.

    Attributes:
        frames: the keyframes.
        accepted: the sightings in the graph, by keyframe.
    """

    def __init__(
        self,
        log: MeasurementLog,
        factors: LandmarkFactors,
        config: BatchConfig,
        gate_probability: float,
    ) -> None:
        """Solve the log; its filtered beliefs are the initial values.

        Raises:
            EstimatorError: the log is empty.
        """
        self.frames = list(log.keyframes.values())
        if not self.frames:
            raise EstimatorError("nothing to smooth: no keyframe was made; see the notes and the rejections of the run")
        self._factors = factors
        self._config = config
        self._probability = gate_probability
        self.accepted = {frame.k: frame.sightings for frame in self.frames}
        self._on_ground = GroundMotions(self.frames, factors.installation) if factors.installation.ground else None
        self._motions = None if self._on_ground is not None else BatchMotions(self.frames, factors.installation)
        self._sightings = None
        if factors.known:
            self._sightings = BatchSightings(self.frames, list(self.accepted.values()), factors)
        # With landmarks as variables GTSAM's own order has the smaller cliques
        self._order = elimination_order(self.frames, factors.installation.constants) if factors.known else None
        self._values = values_at(self.frames, [frame.belief.pose for frame in self.frames], self.accepted, factors)
        self._solved: Solved | None = None  # covariances of the last solution
        if not factors.known:
            self._begin_at_best()
        self._optimize()
        if not factors.known:
            self._leave_out_unlikely()
        self._weigh_wheels()

    def _weigh_wheels(self) -> None:
        """Weigh each motion of the wheels by how far it is from the solution and solve again, until that is settled."""
        for _ in range(MOST_STEPS):
            if self._motions is None or self._motions.weigh(self.poses(), self._theta()) < _SETTLED:
                return
            self._optimize()

    def _begin_at_best(self) -> None:
        """Start an unknown map's solution by dead reckoning where that fits better than the online poses."""
        online = self._values
        by_beliefs = self._relinearize()
        self._values = values_at(self.frames, dead_reckoned(self.frames), self.accepted, self._factors)
        if not self._relinearize() < by_beliefs:
            self._values = online

    def _leave_out_unlikely(self) -> None:
        """Remove sightings of an unknown map whose NIS exceeds the gate at the solution, and solve again."""
        self.accepted = {
            k: tuple(s for s in held if _nis(s, self._values) <= chi2_bound(self._probability, _dof(s)))
            for k, held in self.accepted.items()
        }
        self._optimize()

    def reconsider(self) -> bool:
        """Gate all sightings of a known map by this solution instead of the online one's, and solve again.

        With another installation others fit: those that were refused online may be what determines it.

        Returns:
            Whether there are more than before.
        """
        if self._sightings is None:
            return False
        before = sum(map(len, self.accepted.values()))
        every = [_seen(frame) for frame in self.frames]
        squares, rows = BatchSightings(self.frames, every, self._factors).squares(self._whole_poses(), self._theta())
        fits = squares <= np.array([chi2_bound(self._probability, d) for d in rows.tolist()])
        kept = iter(fits.tolist())
        self.accepted = {f.k: tuple(s for s in seen if next(kept)) for f, seen in zip(self.frames, every, strict=True)}
        self._sightings = BatchSightings(self.frames, list(self.accepted.values()), self._factors)
        self._optimize()
        self._weigh_wheels()
        return sum(map(len, self.accepted.values())) > before

    def stamps_ns(self) -> IntArray:
        """Times of the keyframes ``(n,)``."""
        return np.array([frame.stamp_ns for frame in self.frames], dtype=np.int64)

    def poses(self) -> FloatArray:
        """Smoothed poses ``(n, 3)``."""
        if self._factors.known:  # then no other pose is among the values
            return np.asarray(gtsam.utilities.extractPose2(self._values))
        return np.array([pose_vector(self._values.atPose2(pose_key(frame.k))) for frame in self.frames])

    def installed(self) -> InstallationEstimate:
        """The installation that the last solution has found; on uneven ground with that under the last keyframe."""
        n = self._factors.installation.constants
        found = InstallationEstimate(np.zeros(0), np.zeros((0, 0)))
        if n:
            marginals = self._marginals()
            found = InstallationEstimate(self._theta(), np.asarray(marginals.marginalCovariance(INSTALLATION)))
        if self._on_ground is None:
            return found
        cov = self._factors.installation.prior().cov
        cov[:n], cov[:, :n] = 0.0, 0.0
        cov[:n, :n] = found.cov
        return InstallationEstimate(np.concatenate([found.mean, self._ground()[-1]]), cov)

    def _ground(self) -> FloatArray:
        """Height, roll and pitch ``(n, 3)`` of the keyframes; ``(n, 0)``: the floor is flat."""
        return np.zeros((len(self.frames), 0)) if self._on_ground is None else ground_of(self._values, self.frames)

    def _whole_poses(self) -> FloatArray:
        """Poses ``(n, 3)``, on uneven ground with height, roll and pitch ``(n, 6)``."""
        return self.poses() if self._on_ground is None else np.column_stack([self.poses(), self._ground()])

    def cost(self) -> float:
        """How badly the solution fits, half a sum of squares, for the comparison of ways to read one recording.

        Corners count by their own noise alone, ranges with the logarithm of the noise that they got on the way to their
        keyframe; a sighting that is left out counts as the least that would be rejected.
        """
        total = float(factor_graph(self.factors_of_motion()).error(self._values)) + self._cost_of_installation()
        if self._sightings is None:
            for frame in self.frames:
                kept = self.accepted[frame.k]
                total += sum(s.factor.error(self._values) for s in kept if s.factor is not None)
                left_out = [s for s in frame.sightings if s not in kept]
                total += sum(0.5 * chi2_bound(self._probability, _dof(s)) for s in left_out)
            return total
        refused = [tuple(s for s in _seen(frame) if s not in self.accepted[frame.k]) for frame in self.frames]
        rejected = BatchSightings(self.frames, refused, self._factors)
        for squares, rows in (s.squares(self._whole_poses(), self._theta()) for s in (self._sightings, rejected)):
            bounds = np.array([chi2_bound(self._probability, d) for d in rows.tolist()])
            total += 0.5 * float(np.minimum(squares, bounds).sum())
        seen = [s for frame in self.frames for s in _seen(frame)]
        covs = [s.alone.cov for s in seen if s.alone.cov is not None]
        for size in {len(cov) for cov in covs}:
            total += 0.5 * float(np.linalg.slogdet(np.array([cov for cov in covs if len(cov) == size]))[1].sum())
        return total

    def evidence(self, motions: Sequence[tuple[MotionMeasurement, ...]]) -> float:
        """Logarithm of the likelihood of the whole log, but for a constant, with other motions of its keyframes.

        ``-½ min |A x - b|² - log |R| - ½ Σ log |Q|``, with the white graph ``A x = b`` linear about the solution, its
        square root R (``RᵀR = AᵀA``) and the covariances Q of the motions: Laplace's approximation. The most
        likely covariances of the motions have the largest evidence. On a flat floor only.

        Source: MacKay 1992, "Bayesian interpolation".

        Args:
            motions: those that end at each keyframe.

        Raises:
            EstimatorError: the graph leaves a pose undetermined.
        """
        frames = [replace(frame, motions=some) for frame, some in zip(self.frames, motions, strict=True)]
        before, self._motions = self._motions, BatchMotions(frames, self._factors.installation)
        try:
            linear = self._linearized().linearize(self._values)
            root, solution = with_deep_stack(lambda: _eliminated(linear, self._order))
        except RuntimeError as error:
            raise EstimatorError("the graph leaves a pose undetermined") from error
        finally:
            self._motions = before
        covs = np.array([m.cov for some in motions for m in some]).reshape(-1, 3, 3)
        of_motions = 0.5 * float(np.linalg.slogdet(covs)[1].sum())
        return -float(linear.error(solution)) - float(root.logDeterminant()) - of_motions

    def rows(self) -> int:
        """Number of residual rows of all sightings that `cost` counts."""
        seen = [s for frame in self.frames for s in _seen(frame)]
        return sum(s.measurement.dof for s in seen)

    def _cost_of_installation(self) -> float:
        """Cost of the installation's prior; 0 where `_priors` contains that prior already."""
        n = self._factors.installation.constants
        if self._sightings is None or not n:
            return 0.0
        prior = self._factors.installation.prior()
        return 0.5 * float(np.sum((whitening_of(prior.cov[:n, :n]) @ (self._theta() - prior.mean[:n])) ** 2))

    def result(self) -> Smoothed:
        """The last solution with its covariances.

        Raises:
            EstimatorError: the graph leaves a pose undetermined.
        """
        marginals = self._marginals()
        return with_deep_stack(lambda: self._result(marginals))

    def _marginals(self) -> Solved:
        """Solver for the covariances of the last solution, made once."""
        if self._solved is None:
            self._solved = solved(self._graph, self._values, self._order)
        return self._solved

    def _result(self, marginals: Solved) -> Smoothed:
        ground, spatial = None, None
        if self._on_ground is not None:
            ground, spatial = self._ground(), ground_covs(marginals, self.frames)
        covs = pose_covs(marginals, self.frames) if spatial is None else spatial[:, :3, :3]
        return Smoothed(
            stamps_ns=self.stamps_ns(),
            poses=self.poses(),
            covs=covs,
            ground=ground,
            ground_covs=spatial,
            landmarks={} if self._factors.known else estimated_landmarks(self.accepted, self._values, marginals),
            error=self._error,
        )

    def _theta(self) -> FloatArray:
        n = self._factors.installation.constants
        return np.asarray(self._values.atVector(INSTALLATION)) if n else np.zeros(0)

    def _optimize(self) -> None:
        """Linearize anew and solve, until the error stays what it is; a step that fits worse is damped or refused.

        What a step is worth shows where it is linearized next. Without one that fits better the initial values stand.
        """
        self._solved = None
        self._error = math.inf
        self._relinearize()
        before, cost = self._values, float(self._graph.error(self._values))  # where the next step begins
        for _ in range(MOST_STEPS):
            previous, self._error = self._error, self._solve(before)
            if abs(previous - self._error) <= ROUNDING * self._error:
                break
            before, cost, refused = self._damped(before, cost)
            if refused:
                break
        if not np.isfinite(self._error):  # the last step was shortened
            self._error = cost
        if not np.isfinite(self._error):
            raise EstimatorError("the batch optimum is not finite; look at steps.csv for what broke it")

    def _relinearize(self) -> float:
        """Linearize at the values; their error there."""
        self._graph = gtsam.NonlinearFactorGraph()  # of a long run the factors take a gigabyte
        self._graph = self._linearized()
        if not self._factors.known:
            self._values = without_orphans(self._values, self._graph)
        return float(self._graph.error(self._values))

    def _damped(self, before: gtsam.Values, cost: float) -> tuple[gtsam.Values, float, bool]:
        """Shorten the last step until it fits no worse than what it began at; else go back there.

        Returns:
            The values now, their error, and whether the step was refused.
        """
        step = before.localCoordinates(self._values)
        for i in range(_HALVINGS if np.isfinite(step.vector()).all() else 0):
            if i:
                step = step.scale(0.5)
                self._values, self._error = before.retract(step), math.inf
            try:
                at = self._relinearize()
            except (EstimatorError, CovarianceError, RuntimeError):  # too far off for anything to be seen from there
                continue
            if at <= (1.0 if i else 1.0 + _SAME) * cost:
                return self._values, at, False
        self._values, self._error = before, cost
        self._relinearize()
        return before, cost, True

    def _linearized(self) -> gtsam.NonlinearFactorGraph:
        seen: Iterable[gtsam.NonlinearFactor]
        if self._sightings is None:
            seen = [s.factor for held in self.accepted.values() for s in held if s.factor is not None]
        else:
            seen = self._sightings.factors(self._whole_poses(), self._theta(), self._values)
        return factor_graph(chain(self.factors_of_motion(), seen))

    def factors_of_motion(self) -> Iterator[gtsam.NonlinearFactor]:
        """Priors of poses, and motions linear about the solution."""
        yield from self._priors()
        if self._motions is not None:
            yield from self._motions.factors(self.poses())
        if self._on_ground is not None:
            yield from self._on_ground.factors(self.poses(), self._ground(), self._theta())

    def _priors(self) -> Iterator[gtsam.NonlinearFactor]:
        """Priors of the poses and, without sightings of a known map, of the installation."""
        n = self._factors.installation.constants
        if n and self._sightings is None:
            prior = self._factors.installation.prior()
            noise = gtsam.noiseModel.Gaussian.Covariance(prior.cov[:n, :n])
            yield gtsam.PriorFactorVector(INSTALLATION, prior.mean[:n], noise)
        for frame in self.frames:
            if frame.prior is not None:
                yield prior_factor(frame.k, frame.prior.pose, frame.prior.cov)

    def _solve(self, start: gtsam.Values) -> float:
        """Levenberg-Marquardt on the graph as it is linearized; its error."""
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(self._config.max_iterations)
        params.setLinearSolverType("SEQUENTIAL_CHOLESKY")  # the multifrontal one overflows the stack in GTSAM's order
        params.setRelativeErrorTol(ROUNDING)
        if self._order is not None:
            params.setOrdering(self._order)
        optimizer = gtsam.LevenbergMarquardtOptimizer(self._graph, start, params)
        self._values = optimizer.optimize()
        return float(optimizer.error())


def _eliminated(
    linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering | None
) -> tuple[gtsam.GaussianBayesNet | gtsam.GaussianBayesTree, gtsam.VectorValues]:
    """Square root of a linear graph, and its solution."""
    root = linear.eliminateSequential() if order is None else linear.eliminateMultifrontal(order)
    return root, root.optimize()


def _seen(frame: Keyframe) -> tuple[LoggedSighting, ...]:
    return (*frame.sightings, *frame.rejected)


def _nis(sighting: LoggedSighting, values: gtsam.Values) -> float:
    """Squared whitened residual without the kernel, from ``e = k²/2 · log(1 + r²/k²)`` of a robust factor."""
    if sighting.factor is None:
        return 0.0
    error = 2.0 * sighting.factor.error(values)
    if sighting.cauchy_k is None:
        return error
    k2 = sighting.cauchy_k**2
    return k2 * math.expm1(min(error / k2, _LARGEST_LOG))


def _dof(sighting: LoggedSighting) -> int:
    return 0 if sighting.factor is None else sighting.factor.dim()
