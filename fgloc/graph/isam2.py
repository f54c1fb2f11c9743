"""The incremental estimator: iSAM2 in a fixed-lag window (flat cost, however long the run) or whole (short runs).

A GTSAM update that throws leaves the smoother unusable; the window is then rebuilt from the measurement log
without the sightings of the step, and `rebuilt` counts it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import gtsam
import numpy as np

from fgloc import se2
from fgloc.config import EstimatorConfig
from fgloc.graph.estimator import Estimator
from fgloc.graph.factors import (
    INSTALLATION,
    LandmarkFactors,
    installed_motion_factor,
    installed_prior_factor,
    landmark_key,
    motion_factor,
    pose_key,
    prior_factor,
    sighting_factors,
)
from fgloc.graph.ground import ground_key
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.isam2_backends import Backend, FixedLag, WholeRun
from fgloc.graph.joint import EXACT, correct, is_linear
from fgloc.graph.linear_factors import linear_factor
from fgloc.graph.measurement_log import Keyframe, PoseWithCovariance
from fgloc.graph.uneven import ground_factors, ground_prior, is_level_known, step_of
from fgloc.types import (
    FloatArray,
    FrameMeasurement,
    LandmarkMeasurement,
    PointMeasurement,
)

_GTSAM_ERRORS = (RuntimeError, IndexError, ValueError)


class IncrementalEstimator(Estimator):
    """The factor graph of the window, or of the run, kept solved."""

    def __init__(self, config: EstimatorConfig, factors: LandmarkFactors, keep_all: bool = False) -> None:
        super().__init__(config, factors, keep_all)
        self._backend: Backend | None = None
        self._landmarks: dict[int, FloatArray] = {}  # initial values of the variables in the graph
        self._careful_until_s = -math.inf  # of the estimator's own time: by QR; Cholesky failed
        self._fresh = True  # nothing was given to the backend yet
        self._slots: dict[int, list[int]] = {}  # of the motion factors, by keyframe

    def _solve(self, frame: Keyframe) -> None:
        if self._backend is None or (frame.prior is not None and self._config.kind == "fixed_lag"):
            self._careful_until_s = -math.inf
            self._backend = self._new_backend()
            self._slots.clear()
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
        """By QR, as long as the window holds what Cholesky fails at; if that fails too, the sightings are at fault."""
        predicted = frame.belief
        self._careful_until_s = frame.elapsed_s + self._config.lag_s
        try:
            frame.belief = self._replayed([*self._window(frame), frame], initial)
        except _GTSAM_ERRORS:
            self._rebuild(frame, predicted)

    def _linearization(self, frame: Keyframe) -> PoseWithCovariance:
        """Where to linearize: at the prediction or, where sightings are far from linear over it, where they put it."""
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
            self._backend.hold(self._holding())
            belief = self._found(k)
        return self._considered(belief)

    def _found(self, k: int) -> PoseWithCovariance:
        """As the backend has it: what is held is as good as exact."""
        assert self._backend is not None
        belief = self._backend.belief(k, len(self.factors.installation), self.installation.ground)
        if not (math.isfinite(belief.pose[2]) and math.isfinite(belief.cov[0, 0])):
            raise ValueError("estimate is not finite")
        return belief

    def _holding(self) -> gtsam.NonlinearFactorGraph:
        """What keeps the constants that left the gate of their prior at what was given."""
        graph, constants = gtsam.NonlinearFactorGraph(), self.installation.constants
        rows = [self.installation.index[name] for name in self.contradicted]
        H = np.eye(constants)[rows] / EXACT
        values = gtsam.Values()
        values.insert(INSTALLATION, self.installation.prior().mean[:constants])
        graph.add(linear_factor({INSTALLATION: H}, np.zeros(len(rows)), values))
        return graph

    def _solve_again(self, changed: Sequence[int]) -> None:
        """Swap the motion factors of these keyframes, as far as the window holds them."""
        backend = self._backend
        if backend is None:
            return
        frames = [self.log.keyframes[k] for k in changed if k in self._slots]
        newest = self.log.keyframes[self._k]
        graph, slots = gtsam.NonlinearFactorGraph(), []
        for frame in frames:
            slots += self._slots[frame.k]
            for factor in self._motion_factors(frame):
                graph.add(factor)
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
        """Take the log up as it is now, in a new window."""
        newest = self.log.keyframes[self._k]
        initial = newest.belief
        try:
            newest.belief = self._replayed(self._window(newest) or [newest], initial)
        except _GTSAM_ERRORS:  # what the window knew is in the belief
            self.rebuilt += 1
            newest.belief = self._replayed([newest], initial)

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
        """Of a keyframe, linear about the pose before it; a kernel on the wheels needs factors that are not."""
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
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
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
            made = installed_prior_factor(frame.k, prior, self.installed, constants)
        else:
            made = [prior_factor(frame.k, prior.pose, prior.cov)]
            if self.installation.ground:
                made.append(ground_prior(frame.k, known.mean[constants:], known.cov[constants:, constants:]))
        if self._fresh and self.contradicted:
            graph.push_back(self._holding())
        self._fresh = False
        if self.factors.known and frame.sightings:
            measurements = [s.measurement for s in frame.sightings]
            if known is self.factors.estimated:
                lines = self.factors.linearize(measurements, initial.pose)
            else:
                lines = self.factors.observe(measurements).linearize(initial.pose, known.mean)
            kept = [(s, one) for s, one in zip(frame.sightings, lines, strict=True) if not one.behind]
            if kept:
                sightings, ahead = zip(*kept, strict=True)
                made += sighting_factors(frame.k, sightings, ahead, initial.pose, known.mean, constants)
        for sighting in frame.sightings:
            self._introduce(sighting.measurement, initial.pose, values)
            made += sighting.factors
        for factor in made:
            graph.add(factor)
        return graph, values

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
        if isinstance(m, PointMeasurement):
            initial = se2.compose(
                pose, [m.range_m * np.cos(m.bearing_rad), m.range_m * np.sin(m.bearing_rad), m.bearing_rad]
            )
            values.insert(key, initial[:2])
        elif isinstance(m, FrameMeasurement):
            initial = se2.compose(pose, m.pose)
            values.insert(key, gtsam.Pose2(*initial))
        else:
            return
        self._landmarks[m.landmark_id] = initial

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
