"""Data association: the covariance of each sighting, and whether it is accepted."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence

from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.joint import MOST_JOINT, correct, innovation, is_linear, joint_cov, nis_of_each
from fgloc.graph.measurement_log import LandmarkFactor, PoseWithCovariance
from fgloc.graph.noise import repetition
from fgloc.relocalization.pose_consensus import apart
from fgloc.relocalization.pose_fit import Fit, fit_pose
from fgloc.robust.landmark_modes import LandmarkModes
from fgloc.robust.sensor_measurements import SensorMeasurements, kind_of, row_id, source_of
from fgloc.stats import chi2_bound
from fgloc.types import (
    Decision,
    LandmarkMeasurement,
    PixelMeasurement,
    PoseMeasurement,
)


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
        self._sensors = SensorMeasurements(config, factors)
        self.modes = LandmarkModes(config, factors)

    def judge(
        self,
        k: int,
        stamp_ns: int,
        measurements: Sequence[LandmarkMeasurement],
        predicted: PoseWithCovariance,
    ) -> tuple[list[LandmarkFactor], list[LandmarkFactor], list[Decision]]:
        """Sort sightings into accepted and rejected, with the decision on each.

        The NIS is that of the prediction, with what is not known of the installation. Where it fails the χ² gate and
        the pose is not known well, it is taken again at the pose that best explains prediction and sighting together,
        because the linear one is far too large.
        """
        accepted, rejected, decisions = [], [], []
        judged = self._judge(measurements, predicted)
        measurements, judged = self._sensors.revise(measurements, judged, predicted, self._judge)
        shared = [self._share_information(m) for m in measurements]
        for alone, (m, weight), (nis, dof, gate) in zip(measurements, shared, judged, strict=True):
            sighting = self._factors.sighting(k, m, m.cauchy_k, alone)
            reason = "quarantined" if self.modes.excludes(m.landmark_id) else gate
            if reason:
                rejected.append(sighting)
                self.rejections[f"{source_of(m)}.{reason}"] += 1
            else:
                accepted.append(sighting)
                self._last_used_ns[m.landmark_id] = m.stamp_ns
            used = 0.0 if reason else weight
            decisions.append(
                Decision(k, stamp_ns, kind_of(m), row_id(m), nis**0.5, nis, dof, used, reason, self._gate(dof))
            )
        if accepted:
            self._contradicting.clear()
            for misread, sighting, decision in self._reassociate(k, stamp_ns, rejected, decisions, predicted):
                rejected.remove(misread)
                accepted.append(sighting)
                decisions.append(decision)
        if not accepted:
            self._contradicting.update(
                s.measurement.landmark_id
                for s, d in zip(rejected, decisions, strict=True)
                if d.reason != "quarantined" and not isinstance(s.measurement, PoseMeasurement)
            )
        return accepted, rejected, decisions

    def _reassociate(
        self,
        k: int,
        stamp_ns: int,
        rejected: Sequence[LandmarkFactor],
        decisions: list[Decision],
        predicted: PoseWithCovariance,
    ) -> list[tuple[LandmarkFactor, LandmarkFactor, Decision]]:
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
            if decisions[i].reason not in ("gate", "behind_camera") or not isinstance(m, PixelMeasurement):
                continue
            fits = []
            for other in self._factors.lookalikes(m, predicted.pose):
                if other in seen or self.modes.excludes(other):
                    continue
                again = dataclasses.replace(m, landmark_id=other)
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
                    Decision(k, stamp_ns, kind_of(m), other, math.sqrt(nis), nis, dof, 1.0, "", self._gate(dof)),
                )
            )
        self.rejections += Counter()  # drops the zeros
        return found

    def nearby_consensus(
        self, rejected: Sequence[LandmarkFactor], decisions: Sequence[Decision], predicted: PoseWithCovariance
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
        self.rejections.subtract(
            f"{source_of(s.measurement)}.{d.reason}" for s, d in zip(rejected, decisions, strict=True)
        )
        self.rejections += Counter()  # drops the zeros
        return fit

    def _judge(
        self, measurements: Sequence[LandmarkMeasurement], predicted: PoseWithCovariance
    ) -> list[tuple[float, int, str]]:
        """Of each: NIS, its degrees of freedom, and why it is rejected ("" if it is accepted)."""
        if not self._factors.known:
            return [(math.nan, 0, self._seen_too_seldom(m)) for m in measurements]
        if not measurements:
            return []
        lines = self._factors.linearize(measurements, predicted.pose)
        known = predicted.installation or self._factors.estimated
        found = nis_of_each(innovation(joint_cov(predicted, known), lines), lines)
        uncertain = not is_linear(predicted)
        judged = []
        for m, one, nis in zip(measurements, lines, found, strict=True):
            dof = len(one.residual)
            if one.behind:
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
        judged: list[tuple[float, int, str]],
    ) -> list[tuple[float, int, str]]:
        """Where the prediction excludes little: of sightings that exclude each other, the most that agree.

        Between as many as that, those of the least NIS.

        Source: Neira, Tardos 2001, "Data association in stochastic mapping using the joint compatibility test".
        """
        rows = [i for i, (_, _, reason) in enumerate(judged) if not reason]
        candidates = rows if len(rows) <= MOST_JOINT else sorted(rows, key=lambda i: judged[i][0])[:MOST_JOINT]
        if len(rows) < 2 or (candidates is rows and self._compatible(rows, measurements, predicted)):
            return judged
        most = self._largest_agreeing(candidates, measurements, predicted)
        if candidates is not rows and most:
            others = [i for i in rows if i not in candidates]
            most = [*most, *self._agreeing_with(most, others, measurements, predicted)[1]]
        return [
            (nis, dof, reason or ("" if i in most or not most else "contradicts_others"))
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
        lines = self._factors.observe([measurements[i] for i in others]).linearize(belief.pose, theirs.mean)
        found = nis_of_each(innovation(joint_cov(belief, theirs), lines), lines)
        ratios = {
            i: math.inf if one.behind else nis / self._gate(len(one.residual))
            for i, one, nis in zip(others, lines, found, strict=True)
        }
        return corrected[1], sorted((i for i in others if ratios[i] <= 1.0), key=lambda i: ratios[i])

    def _gate(self, dof: int) -> float:
        """Bound of the NIS of a sighting; NaN where there is nothing to hold it against."""
        return chi2_bound(self._config.estimator.gate_probability, dof) if dof > 0 else math.nan

    def _seen_too_seldom(self, m: LandmarkMeasurement) -> str:
        self._seen[m.landmark_id] += 1
        return "seen_too_seldom" if self._seen[m.landmark_id] < self._config.landmarks.min_sightings else ""

    def _share_information(self, m: LandmarkMeasurement) -> tuple[LandmarkMeasurement, float]:
        """Inflate a sighting that follows the last of its landmark within the correlation time of the errors."""
        if isinstance(m, PixelMeasurement | PoseMeasurement):
            return m, 1.0
        last = self._last_used_ns.get(m.landmark_id)
        scale = repetition(self._config.landmarks.repeat_s, last, m.stamp_ns)
        return (m, 1.0) if scale == 1.0 else (dataclasses.replace(m, cov=m.cov * scale), 1.0 / scale)

    @property
    def contradicting(self) -> int:
        """How many landmarks were rejected since a sighting was accepted."""
        return len(self._contradicting)

    def forget_contradictions(self) -> None:
        """The pose was set anew: `contradicting` starts from 0."""
        self._contradicting.clear()
        self._sensors.forget()

    def begin_segment(self) -> None:
        """The clock jumped: nothing is known of when landmarks were seen last."""
        self._last_used_ns.clear()
        self.forget_contradictions()
