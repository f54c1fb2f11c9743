"""Sightings that enter the graph, and the causes of others: a moved or misread landmark, a wrong motion or pose.

`Association` is the chi-square gate with its better explanations; `SightingJudge` asks it, `LandmarkModes` for moved
landmarks and `Tracking` for another place on the map in turn.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.estimation.faults import InnovationBias
from fgloc.estimation.landmark_modes import LandmarkModes
from fgloc.estimation.log import (
    OVERRULED,
    mounting_decision,
    mounting_notes,
    moved_decision,
    moved_notes,
    place_decision,
)
from fgloc.estimation.motion import JudgedMotion
from fgloc.estimation.place import InitialPose
from fgloc.estimation.pose_fit import Fit, apart, fit_pose
from fgloc.estimation.tracking import CONTRADICTS, Tracking
from fgloc.estimation.unnamed import Naming, contradictions
from fgloc.graph.estimators import Estimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.joint import MOST_JOINT, correct, innovation, is_linear, nis_of_each
from fgloc.graph.measurement_log import LoggedSighting, PoseWithCovariance
from fgloc.graph.noise import repetition
from fgloc.graph.observation import Lines
from fgloc.sensors.measurements import LandmarkMeasurement, points_of
from fgloc.stats import chi2_bound
from fgloc.types import Decision, Step

# --- The gate, joint compatibility, misread ids -----------------------------------------------------------------------


Judged = list[tuple[float, int, str]]
"""NIS of each measurement, degrees of freedom, and why it is rejected ("" if it is not)."""


class Association:
    """Weighs the sightings of one step against the prediction.

    Attributes:
        rejections: rejected sightings by reason.
    """

    def __init__(self, config: Config, factors: LandmarkFactors) -> None:
        self._config = config
        self._factors = factors
        self._last_used_ns: dict[int, int] = {}
        self._seen: Counter[int] = Counter()
        self.rejections: Counter[str] = Counter()
        self._contradicting: set[int] = set()
        self._bias = InnovationBias(config.estimator.gate_probability, config.weights.window_s)
        self.modes = LandmarkModes(config, factors)
        self._naming = Naming(config, factors)

    def judge(
        self,
        k: int,
        stamp_ns: int,
        measurements: Sequence[LandmarkMeasurement],
        predicted: PoseWithCovariance,
    ) -> tuple[list[LoggedSighting], list[LoggedSighting], list[Decision]]:
        """Sort sightings into accepted and rejected, with the decision on each.

        The NIS is that of the prediction, with what is not known of the installation. Where it fails the χ² gate and
        the pose is not known well, it is taken again at the pose that best explains prediction and sighting together,
        because the linear one is far too large.
        """
        accepted, rejected, decisions = [], [], []
        hits = [m for m in points_of(measurements) if m.unnamed]
        named, nameless = self._naming.name(hits, predicted) if hits else ([], [])
        measurements = [*(m for m in measurements if not m.unnamed), *named] if hits else measurements
        judged = self._judge(measurements, predicted)
        fits = [m for m, (*_, reason) in zip(measurements, judged, strict=True) if not reason]
        here = self._corrected([m for m in fits if not self.modes.excludes(m.landmark_id)], predicted)
        measurements, judged = self._revise(measurements, judged, predicted, here)
        shared = [self._share_information(m) for m in measurements]
        for alone, (m, weight), (nis, dof, gate) in zip(measurements, shared, judged, strict=True):
            sighting = self._factors.sighting(k, m, m.cauchy_k, alone)
            reason = "quarantined" if self.modes.excludes(m.landmark_id) else gate
            if reason:
                rejected.append(sighting)
                self.rejections[f"{m.counted_as}.{reason}"] += 1
            else:
                accepted.append(sighting)
                self._last_used_ns[m.landmark_id] = m.stamp_ns
            used = 0.0 if reason else weight
            decisions.append(
                Decision(k, stamp_ns, m.row_kind, m.row_id, nis**0.5, nis, dof, used, reason, self._gate(dof))
            )
        if accepted:
            self._contradicting.clear()
            for misread, sighting, decision in self._reassociate(k, stamp_ns, rejected, decisions, here):
                rejected.remove(misread)
                accepted.append(sighting)
                decisions.append(decision)
        if not accepted:
            self._contradicting.update(
                s.measurement.landmark_id
                for s, d in zip(rejected, decisions, strict=True)
                if d.reason != "quarantined" and s.measurement.of_landmark
            )
            self._contradicting.update(range(-contradictions(nameless), 0))
        for m, nis, reason in ((one.hit, one.nis, one.reason) for one in nameless):
            rejected.append(LoggedSighting(m, m, m.cauchy_k))
            self.rejections[f"{m.counted_as}.{reason}"] += 1
            decisions.append(
                Decision(k, stamp_ns, m.row_kind, m.row_id, nis**0.5, nis, m.dof, 0.0, reason, self._gate(m.dof))
            )
        return accepted, rejected, decisions

    def _corrected(self, accepted: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance) -> PoseWithCovariance:
        """The pose that others than these are held against: the predicted one, or where they have it if it is vague.

        Metres beside the robot a marker that was misread looks like one that hangs there.
        """
        if not accepted or not self._factors.known or is_linear(predicted):
            return predicted
        known = predicted.installation or self._factors.estimated
        corrected = correct(predicted, known, accepted[:MOST_JOINT], self._factors)
        return predicted if corrected is None else corrected[0]

    def _revise(
        self,
        measurements: Sequence[LandmarkMeasurement],
        judged: Judged,
        predicted: PoseWithCovariance,
        here: PoseWithCovariance,
    ) -> tuple[Sequence[LandmarkMeasurement], Judged]:
        """The measurements to be used and the verdict on each; some may be biased, or mean something else.

        Args:
            measurements: of one step.
            judged: what the gate makes of them.
            predicted: the pose.
            here: the pose with those that are accepted.
        """
        taken, verdicts = list(measurements), list(judged)
        for i, (m, verdict) in enumerate(zip(measurements, judged, strict=True)):
            if not verdict[2] and self._config.weights.adaptive and self._is_biased(m, predicted):
                verdicts[i] = verdict[0], verdict[1], "biased"
            if verdicts[i][2]:
                taken[i], verdicts[i] = self._explained_otherwise(m, verdicts[i], here)
        return taken, verdicts

    def _is_biased(self, m: LandmarkMeasurement, predicted: PoseWithCovariance) -> bool:
        if m.bias_key is None:
            return False
        lines = self._factors.linearize([m], predicted.pose)
        return self._bias.is_biased(m.bias_key, m.stamp_ns, lines, predicted.cov)

    def _explained_otherwise(
        self, m: LandmarkMeasurement, verdict: tuple[float, int, str], predicted: PoseWithCovariance
    ) -> tuple[LandmarkMeasurement, tuple[float, int, str]]:
        """The first alternative of a rejected measurement that the gate accepts; else the measurement itself.

        Source: Olson, Agarwal 2013, "Inference on networks of mixtures for robust robot mapping": the most probable
        component of a mixture stands for all of it; here the gate decides which.
        """
        if verdict[2] in ("gate", "biased"):
            for other in m.alternatives(predicted.pose):
                (found,) = self._judge([other], predicted)
                if not found[2]:
                    return other, found
        return m, verdict

    def _reassociate(
        self,
        k: int,
        stamp_ns: int,
        rejected: Sequence[LoggedSighting],
        decisions: list[Decision],
        predicted: PoseWithCovariance,
    ) -> list[tuple[LoggedSighting, LoggedSighting, Decision]]:
        """Rejected markers whose code was misread: what was rejected, what it was, and the decision on that.

        Beside others that are accepted, a marker that cannot be where it was seen, in a place where exactly one other
        would be seen that was not, is that other.
        """
        if not rejected or not self._config.weights.adaptive or not self._factors.known:
            return []
        found = []
        seen = {d.landmark_id for d in decisions if not d.reason}
        rows = [i for i, d in enumerate(decisions) if d.reason]
        for i, misread in zip(rows, rejected, strict=True):
            m = misread.measurement
            if decisions[i].reason not in ("gate", "behind_camera"):
                continue
            fits = []
            for again in self._factors.lookalikes(m, predicted.pose):
                if again.landmark_id in seen or self.modes.excludes(again.landmark_id):
                    continue
                sighting = self._factors.sighting(k, again, misread.cauchy_k)
                nis, dof, reason = self._judge([again], predicted)[0]
                if not reason:
                    fits.append((sighting, nis, dof))
            if len(fits) != 1:
                continue
            sighting, nis, dof = fits[0]
            other = sighting.measurement.landmark_id
            seen.add(other)
            self._last_used_ns[other] = m.stamp_ns
            self.rejections[f"sightings.{decisions[i].reason}"] -= 1
            self.rejections["sightings.misread"] += 1
            decisions[i] = dataclasses.replace(decisions[i], reason="misread")
            found.append(
                (
                    misread,
                    sighting,
                    Decision(k, stamp_ns, m.row_kind, other, math.sqrt(nis), nis, dof, 1.0, "", self._gate(dof)),
                )
            )
        self.rejections += Counter()  # drops the zeros
        return found

    def nearby_consensus(
        self, rejected: Sequence[LoggedSighting], decisions: Sequence[Decision], predicted: PoseWithCovariance
    ) -> Fit | None:
        """The place nearby that rejected sightings agree on, if they are of two landmarks or more and are unambiguous.

        Then it is the prediction that was wrong (a wheel slipped, say), not each of them in the same way. Their
        rejection is taken back.
        """
        gated = [s for s, d in zip(rejected, decisions, strict=True) if d.reason == "gate"]
        if not self._config.weights.adaptive or len({s.measurement.landmark_id for s in gated}) < 2:
            return None
        fit = fit_pose(predicted.pose, [s.measurement for s in gated], self._factors)
        checked = fit is not None and fit.is_checked(self._config.estimator.gate_probability)
        if fit is None or not checked or apart(predicted.pose, fit.pose):
            return None
        self.take_back((s.measurement, d.reason) for s, d in zip(rejected, decisions, strict=True))
        return fit

    def take_back(self, rejected: Iterable[tuple[LandmarkMeasurement, str]]) -> None:
        """Count these sightings no longer as rejected for these reasons."""
        self.rejections.subtract(f"{m.counted_as}.{reason}" for m, reason in rejected)
        self.rejections += Counter()  # drops the zeros

    def _judge(self, measurements: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance) -> Judged:
        """Verdict of the gate on each measurement."""
        if not self._factors.known:
            return [(math.nan, 0, self._seen_too_seldom(m)) for m in measurements]
        if not measurements:
            return []
        known = predicted.installation or self._factors.estimated
        lines = self._factors.observe(measurements).together(predicted.pose, known.mean)
        found = nis_of_each(innovation(predicted.joint_cov(known), lines), lines)
        uncertain = not is_linear(predicted)
        judged = []
        for m, dof, behind, nis in zip(measurements, lines.dofs, lines.behind, found, strict=True):
            if behind:
                judged.append((math.nan, dof, "behind_camera"))
                continue
            bound = self._gate(dof)
            if nis > bound and uncertain and (corrected := correct(predicted, known, [m], self._factors)):
                nis = min(nis, corrected[1])
            judged.append((nis, dof, "gate" if nis > bound else ""))
        return self._agreed(measurements, predicted, judged) if uncertain and self._config.weights.adaptive else judged

    def _agreed(
        self,
        measurements: Sequence[LandmarkMeasurement],
        predicted: PoseWithCovariance,
        judged: Judged,
    ) -> Judged:
        """Verdicts with the largest set of compatible sightings accepted, where the prediction is uncertain.

        Between as many as that, those of the least NIS.

        Source: Neira, Tardos 2001, "Data association in stochastic mapping using the joint compatibility test".
        """
        rows = [
            i
            for i, (m, (_, _, reason)) in enumerate(zip(measurements, judged, strict=True))
            if not reason and not self.modes.excludes(m.landmark_id)
        ]
        candidates = rows if len(rows) <= MOST_JOINT else sorted(rows, key=lambda i: judged[i][0])[:MOST_JOINT]
        if len(rows) < 2 or (candidates is rows and self._compatible(rows, measurements, predicted)):
            return judged
        most = self._largest_agreeing(candidates, measurements, predicted)
        if candidates is not rows and most:
            others = [i for i in rows if i not in candidates]
            most = [*most, *self._agreeing_with(most, others, measurements, predicted)[1]]
        return [
            (nis, dof, reason or ("contradicts_others" if most and i in rows and i not in most else ""))
            for i, (nis, dof, reason) in enumerate(judged)
        ]

    def _largest_agreeing(
        self, rows: Sequence[int], measurements: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance
    ) -> list[int]:
        """The most sightings that agree; all of them, if they do."""
        if self._compatible(rows, measurements, predicted):
            return list(rows)
        found = [self._agreeing_with([i], [j for j in rows if j != i], measurements, predicted) for i in rows]
        sets = [(nis, [i, *agree]) for i, (nis, agree) in zip(rows, found, strict=True) if math.isfinite(nis)]
        most: list[int] = []
        for _, agree in sorted(sets, key=lambda item: (-len(item[1]), item[0])):
            while len(agree) > max(len(most), 1) and not self._compatible(agree, measurements, predicted):
                agree = agree[:-1]
            if len(agree) > len(most):
                most = agree
        return most

    def _compatible(
        self, rows: Sequence[int], measurements: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance
    ) -> bool:
        """Whether these sightings and the prediction may all be right."""
        known = predicted.installation or self._factors.estimated
        seen = [measurements[i] for i in rows]
        together = correct(predicted, known, seen, self._factors)
        dof = sum(m.dof for m in seen)
        return together is not None and together[1] <= self._gate(dof)

    def _agreeing_with(
        self,
        held: Sequence[int],
        others: Sequence[int],
        measurements: Sequence[LandmarkMeasurement],
        predicted: PoseWithCovariance,
    ) -> tuple[float, list[int]]:
        """How little the prediction agrees with what is held, and those others that agree with both, the best first."""
        known = predicted.installation or self._factors.estimated
        corrected = correct(predicted, known, [measurements[i] for i in held], self._factors)
        if corrected is None or corrected[0].installation is None:
            return math.inf, []
        belief, theirs = corrected[0], corrected[0].installation
        lines = self._factors.observe([measurements[i] for i in others]).together(belief.pose, theirs.mean)
        found = nis_of_each(innovation(belief.joint_cov(theirs), lines), lines)
        ratios = {
            i: math.inf if behind else nis / self._gate(dof)
            for i, dof, behind, nis in zip(others, lines.dofs, lines.behind, found, strict=True)
        }
        return corrected[1], sorted((i for i in others if ratios[i] <= 1.0), key=lambda i: ratios[i])

    def _gate(self, dof: int) -> float:
        """Bound of the NIS of a sighting with ``dof`` degrees of freedom; NaN for 0."""
        return chi2_bound(self._config.estimator.gate_probability, dof) if dof > 0 else math.nan

    def _seen_too_seldom(self, m: LandmarkMeasurement) -> str:
        self._seen[m.landmark_id] += 1
        return "seen_too_seldom" if self._seen[m.landmark_id] < self._config.landmarks.min_sightings else ""

    def _share_information(self, m: LandmarkMeasurement) -> tuple[LandmarkMeasurement, float]:
        """Inflate a sighting that follows the last of its landmark within the correlation time of the errors."""
        if not m.errors_repeat:
            return m, 1.0
        last = self._last_used_ns.get(m.landmark_id)
        scale = repetition(self._config.landmarks.repeat_s, last, m.stamp_ns)
        return (m, 1.0) if scale == 1.0 else (m.scaled(scale), 1.0 / scale)

    @property
    def contradicting(self) -> int:
        """How many landmarks were rejected since a sighting was accepted."""
        return len(self._contradicting)

    def forget_contradictions(self) -> None:
        """Set `contradicting` to 0, as the pose was set anew."""
        self._contradicting.clear()
        self._bias.forget()

    def begin_segment(self) -> None:
        """Forget when landmarks were seen last, as the clock jumped."""
        self._last_used_ns.clear()
        self.forget_contradictions()


# --- The verdict on a step's sightings --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class JudgedSightings:
    """The sightings of one step as they enter the graph.

    Attributes:
        accepted: to be fused.
        rejected: not to be fused.
        logged: those of them that the batch smoother and the landmark modes may know of.
        decisions: rows of ``steps.csv``, one per sighting; of a misread marker two, by either id.
        places: rows for places that sightings tell beside the predicted one.
        predicted: the pose that they were held against.
        lines: the accepted ones linearized there; None: there is none, or that pose is too uncertain for it to hold.
        elsewhere: where on the map the robot is instead; None: it is where it was predicted.
    """

    accepted: Sequence[LoggedSighting]
    rejected: Sequence[LoggedSighting]
    logged: Sequence[LoggedSighting]
    decisions: Sequence[Decision]
    predicted: PoseWithCovariance
    lines: Lines | None = None
    places: Sequence[Decision] = ()
    elsewhere: InitialPose | None = None

    @property
    def observes_yaw(self) -> bool:
        """Whether any accepted one determines the yaw by itself."""
        return any(s.measurement.observes_yaw for s in self.accepted)

    def dropped(self, reason: str) -> JudgedSightings:
        """Judged sightings with none accepted, where the graph could not use any of them."""
        decisions = [replace(d, weight=0.0, reason=d.reason or reason) for d in self.decisions]
        return replace(self, accepted=(), decisions=decisions, lines=None)


_KNOCK_LANDMARKS, _KNOCK_IMAGES = 2, 3  # at least in an image, and such images in a row, that show another mounting


class SightingJudge:
    """Holds the sightings of each step against the predicted pose.

    Attributes:
        association: the gate, with what it remembers.
    """

    def __init__(self, config: Config, estimator: Estimator, tracking: Tracking) -> None:
        """Set up for the estimator that predicts the pose, and the tracking that searches for it."""
        self._estimator = estimator
        self._tracking = tracking
        self.association = Association(config, estimator.factors)
        self._rejections: Counter[str] = Counter()
        self._adaptive, self._gate = config.weights.adaptive, config.estimator.gate_probability
        self._remounted: dict[str, int] = {}  # stamp of the first sightings since then, by their kind
        self._refused: dict[
            str, tuple[int, int, InstallationEstimate | None]
        ] = {}  # images, since, installation by them

    @property
    def modes(self) -> LandmarkModes:
        """Hypotheses of moved landmarks."""
        return self.association.modes

    @property
    def rejections(self) -> Counter[str]:
        """Number of sightings that were not used so far, by reason."""
        return self._rejections + self.association.rejections

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about moved landmarks and knocked sensors."""
        return (*moved_notes(self.modes.displacements), *mounting_notes(self._remounted))

    def judge(
        self, step: Step, sightings: Sequence[LandmarkMeasurement], motion: JudgedMotion
    ) -> tuple[JudgedMotion, JudgedSightings]:
        """Sort the sightings of a step; the motion is returned too, with more noise where they found it to be wrong."""
        motion, seen = self._judge_as_mounted(step, sightings, motion)
        refused = None if seen.elsewhere is not None else self._knocked(seen)
        if refused is None:
            return motion, seen
        kind, since_ns, nis, now = refused  # the sightings of this step are judged again
        row = mounting_decision(self._estimator.k + 1, step.stamp_ns, kind, nis)
        self._remount(kind, since_ns, self._estimator.newest.belief, now)
        self.modes.restart()
        seen = self.associate(step, sightings, self._estimator.predict(motion.factors))
        return motion, replace(seen, places=(row,))

    def _knocked(self, seen: JudgedSightings) -> tuple[str, int, float, InstallationEstimate | None] | None:
        """Sensor all of whose sightings are refused, though another mounting explains those of several images in a row.

        A camera that looks up or down now sees what no pose on the floor explains.

        Returns:
            Kind of its sightings, stamp of the first such ones, χ² of those in the newest image, and the installation
            by the images before it.
        """
        if not (self._adaptive and self._estimator.can_remount) or self._tracking.keeps_initial_pose:
            return None
        nis = {(d.kind, d.landmark_id): d.nis for d in seen.decisions if d.reason == "gate"}
        refused: dict[str, list[LandmarkMeasurement]] = {}
        for m in (s.measurement for s in seen.rejected):
            if m.in_pixels and (m.row_kind, m.landmark_id) in nis:
                refused.setdefault(m.row_kind, []).append(m)
        for kind in {s.measurement.row_kind for s in seen.accepted}:
            refused.pop(kind, None)
            self._refused.pop(kind, None)
        for kind, own in refused.items():
            if len({m.landmark_id for m in own}) < _KNOCK_LANDMARKS:
                continue
            if not seen.accepted:  # else the pose is confirmed, and no other one explains them
                fit = fit_pose(seen.predicted.pose, own, self._estimator.factors)
                if fit is not None and fit.is_checked(self._gate):
                    self._refused.pop(kind, None)
                    continue
            count, since_ns, now = self._refused.get(kind, (0, own[0].stamp_ns, None))
            loose = self._estimator.loosened(seen.predicted, kind, now)
            assert loose.installation is not None
            found = correct(loose, loose.installation, own, self._estimator.factors)
            if found is None or found[1] > chi2_bound(self._gate, sum(m.dof for m in own)):
                self._refused.pop(kind, None)
                continue
            self._refused[kind] = count + 1, since_ns, found[0].installation
            if count + 1 == _KNOCK_IMAGES:
                self.association.take_back((m, "gate") for m in own)
                return kind, since_ns, sum(nis[kind, m.landmark_id] for m in own), now
        return None

    def _remount(
        self, kind: str, since_ns: int, belief: PoseWithCovariance, now: InstallationEstimate | None = None
    ) -> None:
        self._estimator.remount(belief, kind, since_ns, now)
        self._refused.pop(kind, None)
        self._remounted.setdefault(kind, since_ns)

    def _judge_as_mounted(
        self, step: Step, sightings: Sequence[LandmarkMeasurement], motion: JudgedMotion
    ) -> tuple[JudgedMotion, JudgedSightings]:
        """Verdicts if all sensors are mounted as they were."""
        predicted = self._estimator.predict(motion.factors)
        seen = self.associate(step, sightings, predicted)
        if seen.accepted:
            return motion, seen
        # The search judges by itself whether a beacon was moved
        rejected = [s.measurement for s in seen.rejected]
        outliers = [m for m in rejected if m.is_point or not self.modes.excludes(m.landmark_id)]
        found = self._tracking.search(step, motion.factors, outliers, motion.readings, predicted)
        if found is not None and self._tracking.keeps_initial_pose:
            self._tracking.record_conflict(predicted, found.newest)
            row = place_decision(self._estimator.k + 1, step.stamp_ns, predicted, found.newest, CONTRADICTS)
            return motion, replace(seen, places=(row,))
        if found is not None or self._tracking.keeps_initial_pose:
            return motion, replace(seen, elsewhere=found)
        fit = self.association.nearby_consensus(seen.rejected, seen.decisions, predicted)
        if fit is None:
            return motion, seen
        nearby = PoseWithCovariance(fit.pose, fit.cov)
        row = place_decision(self._estimator.k + 1, step.stamp_ns, predicted, nearby, OVERRULED)
        self._rejections["motion.overruled"] += 1
        self.modes.restart()  # the evidence against landmarks came from a pose that was wrong
        miss = se2.log(se2.between(predicted.pose, fit.pose))
        if motion.readings.gyro is not None:
            self.modes.mounts.suspect(float(miss[2]), float(predicted.cov[2, 2] + fit.cov[2, 2]))
        motion = motion.overruled(np.diag(miss**2))
        seen = self.associate(step, sightings, self._estimator.predict(motion.factors))
        return motion, replace(seen, places=(row,))

    def associate(
        self, step: Step, sightings: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance
    ) -> JudgedSightings:
        """Accept or reject each sighting against one pose; against a given first pose that holds, reject all."""
        judged = self.association.judge(self._estimator.k + 1, step.stamp_ns, sightings, predicted)
        accepted, rejected, decisions = self._tracking.gate_initial_pose(*judged)
        if held := sum(d.reason == CONTRADICTS for d in decisions):
            self._rejections["sightings.contradict_initial_pose"] += held
        if self._tracking.keeps_initial_pose:
            self.modes.forget()  # they all seem moved from there
        logged = () if self._tracking.keeps_initial_pose else [s for s in rejected if not s.measurement.unnamed]
        return JudgedSightings(accepted, rejected, logged, decisions, predicted, self._lines(accepted, predicted))

    def _lines(self, accepted: Sequence[LoggedSighting], predicted: PoseWithCovariance) -> Lines | None:
        if accepted and self._estimator.factors.known and is_linear(predicted):
            return self._estimator.factors.linearize([s.measurement for s in accepted], predicted.pose)
        return None

    def give_states(self, motion: JudgedMotion, seen: JudgedSightings) -> JudgedSightings:
        """Make states of accepted landmarks that are none, see `Estimator.give_states`; the same held against them."""
        added, rows = self._estimator.give_states(seen.accepted)
        if not rows:
            return seen
        self.modes.states_changed(added, rows)
        predicted = self._estimator.predict(motion.factors)
        return replace(seen, predicted=predicted, lines=self._lines(seen.accepted, predicted))

    def exclude_displaced(self, k: int, step: Step, found: InitialPose) -> list[Decision]:
        """Leave out what the search found to be moved, and no longer what it found in place."""
        return [
            moved_decision(k, step.stamp_ns, landmark_id, one.evidence, self.modes.alarm)
            for landmark_id, one in (found.displaced or {}).items()
            if self.modes.exclude_if_moved(landmark_id, one.by, one.evidence)
        ]

    def begin_graph(self, seen: JudgedSightings, belief: PoseWithCovariance) -> None:
        """Begin the landmark hypotheses with the sightings that determined the first pose of the graph."""
        self.modes.restart()
        self.modes.observe((), seen.predicted, belief, seen.accepted)

    def exclude_moved(self, step: Step, motion: JudgedMotion, seen: JudgedSightings) -> tuple[list[Decision], bool]:
        """Leave out a landmark that was moved; take back what it did to the newest pose.

        Returns:
            The rows of ``steps.csv``, and whether the pose was set anew.
        """
        k = self._estimator.k
        belief = self._estimator.log.keyframes[k].belief
        moved = self.modes.observe(motion.factors, seen.predicted, belief, seen.accepted, seen.logged, seen.lines)
        if moved is None:
            return self._take_up_change(step, belief)
        without, nis = self.modes.exclude(moved, belief)
        if without is not belief:
            self._estimator.correct(without, moved)
        return [moved_decision(k, step.stamp_ns, moved, nis, self.modes.alarm)], without is not belief

    def _take_up_change(self, step: Step, belief: PoseWithCovariance) -> tuple[list[Decision], bool]:
        """Take back what a knocked sensor did to the newest pose; its mounting is to be found again.

        Returns:
            As `exclude_moved`.
        """
        change = self.modes.mounts.changed() if self._estimator.can_remount else None
        if change is None:
            return [], False
        without = self._estimator.mounted_anew(self.modes.take_up(change, belief), change.kind, change.H, change.shift)
        self._remount(change.kind, change.since_ns, without)
        return [mounting_decision(self._estimator.k, step.stamp_ns, change.kind, change.evidence)], True
