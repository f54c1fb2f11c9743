"""How far two independent motion sources are apart over a step, and how far they may be if both are right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.graph.factors import LandmarkFactors
from fgloc.robust.motion_sources import MotionSources
from fgloc.types import FloatArray, MotionMeasurement, MotionReadings


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Of two motion sources over a step, in the body frame.

    Attributes:
        value: ``(3,)``.
        cov: ``(3, 3)`` if both are right, of what differs from step to step.
        by_installation: ``(3, p)`` derivative by the parameters of the sources, whose error is always the same ...
        installation_cov: ... and their covariance ``(p, p)``.
    """

    value: FloatArray
    cov: FloatArray
    by_installation: FloatArray
    installation_cov: FloatArray


def source_difference(readings: MotionReadings, sources: MotionSources) -> Difference | None:
    """How far the wheels and their reference source are apart over the step.

    Returns:
        None where there is no reference source: a model that reads the wheels is none, nor is one of the commands
        that replace wheels.
    """
    wheels, learned, gyro, rules = readings.wheels, readings.learned, readings.gyro, sources.rules
    if wheels is None or rules.wheels_are_commands:
        return None
    if learned is not None and sources.learned_is_independent:
        d = se2.log(se2.between(wheels.motion, learned.motion))
        cov = wheels.cov + learned.cov
        if rules.joint is not None:
            cov = rules.joint.difference_cov(wheels.cov, learned.cov)
        return Difference(d, cov, *_systematic(wheels, learned, sources.factors))
    if gyro is None:
        return None
    d = np.array([0.0, 0.0, se2.wrap(float(gyro.motion[2] - wheels.motion[2]))])
    cov = np.diag([1.0, 1.0, wheels.cov[2, 2] + gyro.cov[2, 2]])
    return Difference(d, cov, *_systematic(wheels, gyro, sources.factors))


def _systematic(a: MotionMeasurement, b: MotionMeasurement, factors: LandmarkFactors) -> tuple[FloatArray, FloatArray]:
    """Derivative ``(3, p)`` of ``b`` less ``a`` by all parameters that are not of sightings, and their covariance.

    By all: steps are summed although the reference source may be another one in each.
    """
    installation = factors.installation
    rows = installation.motion_rows
    D = np.zeros((3, len(rows)))
    for i, row in enumerate(rows):
        name = installation.names[row]
        for m, sign in ((a, -1.0), (b, 1.0)):
            if name in m.depends_on:
                D[:, i] += sign * m.depends_on[name][0]
    return D, factors.estimated.cov[np.ix_(rows, rows)]
