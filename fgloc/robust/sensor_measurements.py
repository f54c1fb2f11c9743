"""Measurements of registered sensors beyond the gate: the bias test, and other explanations of a reading."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.robust.innovation_bias import InnovationBias
from fgloc.sensors import registry
from fgloc.types import LandmarkMeasurement, PoseMeasurement

Judged = list[tuple[float, int, str]]
"""Of each measurement: NIS, degrees of freedom, and why it is rejected ("" if it is not)."""
Judge = Callable[[Sequence[LandmarkMeasurement], PoseWithCovariance], Judged]


class SensorMeasurements:
    """Revises what the gate makes of measurements of registered sensors; those of landmarks are left as they are."""

    def __init__(self, config: Config, factors: LandmarkFactors) -> None:
        self._adaptive = config.weights.adaptive
        self._factors = factors
        self._bias = InnovationBias(config.estimator.gate_probability, config.weights.window_s)

    def forget(self) -> None:
        """The pose was set anew."""
        self._bias.forget()

    def revise(
        self, measurements: Sequence[LandmarkMeasurement], judged: Judged, predicted: PoseWithCovariance, judge: Judge
    ) -> tuple[Sequence[LandmarkMeasurement], Judged]:
        """The measurements to be used, and the verdict on each.

        Args:
            measurements: of one step.
            judged: what the gate makes of them.
            predicted: the pose.
            judge: the gate, for other explanations.
        """
        if not any(isinstance(m, PoseMeasurement) for m in measurements):
            return measurements, judged
        taken, verdicts = list(measurements), list(judged)
        for i, (m, verdict) in enumerate(zip(measurements, judged, strict=True)):
            if not isinstance(m, PoseMeasurement):
                continue
            if not verdict[2] and self._adaptive and self._is_biased(m, predicted):
                verdicts[i] = verdict[0], verdict[1], "biased"
            if verdicts[i][2]:
                taken[i], verdicts[i] = _explained_otherwise(m, verdicts[i], predicted, judge)
        return taken, verdicts

    def _is_biased(self, m: PoseMeasurement, predicted: PoseWithCovariance) -> bool:
        (one,) = self._factors.observe([m]).linearize(predicted.pose, self._factors.estimated.mean)
        return self._bias.is_biased((m.source, m.target), m.stamp_ns, one, predicted.cov)


def _explained_otherwise(
    m: PoseMeasurement, verdict: tuple[float, int, str], predicted: PoseWithCovariance, judge: Judge
) -> tuple[PoseMeasurement, tuple[float, int, str]]:
    """The first alternative of a rejected measurement that the gate accepts; else the measurement itself.

    Source: Olson, Agarwal 2013, "Inference on networks of mixtures for robust robot mapping": the most probable
    component of a mixture stands for all of it; here the gate decides which.
    """
    if verdict[2] in ("gate", "biased"):
        for other in m.alternatives(predicted.pose):
            (found,) = judge([other], predicted)
            if not found[2]:
                return other, found
    return m, verdict


def kind_of(m: LandmarkMeasurement) -> str:
    """Of a measurement's row in ``steps.csv``: of a registered sensor with the number of what it measured."""
    if not isinstance(m, PoseMeasurement):
        return registry.kind_of(type(m))
    return m.source if m.target < 0 else f"{m.source}.{m.target}"


def row_id(m: LandmarkMeasurement) -> int:
    """Of a landmark in a measurement's row in ``steps.csv``; -1: none."""
    return -1 if isinstance(m, PoseMeasurement) else m.landmark_id


def source_of(m: LandmarkMeasurement) -> str:
    """Of a measurement's rejections."""
    return m.source if isinstance(m, PoseMeasurement) else "sightings"
