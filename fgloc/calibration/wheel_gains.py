"""Calibration of the wheels from a whole run: the gains under which their motion fits the sightings best.

A wrong gain is the same error all along. Taken for noise it is shared out between sightings, and the smoothed path
comes out too long, or too short, wherever they are sparse.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly
from fgloc.errors import EstimatorError
from fgloc.graph.batch import BatchSmoother
from fgloc.sensors.wheels import WheelMotion
from fgloc.types import FloatArray, MotionMeasurement, WheelCalibration

# By gain: finite differences, and sigma before anything was seen
_GAINS = {"scale_v": (0.01, 0.2), "scale_omega": (0.01, 0.2), "yaw_per_m": (0.01, 0.2)}
_COMMAND_GAINS = _GAINS | {"slowdown": (0.05, 1.0), "delay_s": (0.02, 0.2)}  # none of them negative
_NEWTON_STEPS = 2
_FAR = 3.0  # sigmas that a gain may move at most


def calibrate_wheels(parts: Assembly, solver: BatchSmoother) -> WheelCalibration:
    """Newton's method on the cost that is left when the poses have been solved for, by finite differences.

    As `fgloc.smoothing.refine` does it for sightings: at the optimum over the poses the derivative of the whole cost by
    the gains is the partial one, and its differences between nearby gains give the Hessian. The solver is left with the
    motions of the new gains.

    Raises:
        EstimatorError: no motion of wheels, or of commands in their place, is in the graph by itself, or no gains near
            the configuration's fit the sightings.
    """
    fit = _Fit(parts, solver)
    hessian = fit.hessian()
    for _ in range(_NEWTON_STEPS):
        fit.move(fit.value - np.linalg.solve(hessian, fit.gradient()))
    fit.release()
    found = WheelCalibration(fit.names, fit.value, np.asarray(np.linalg.inv(hessian)))
    if (np.linalg.eigvalsh(hessian) <= 0.0).any() or (abs(fit.value - fit.start) > _FAR * fit.sigmas).any():
        raise EstimatorError(
            f"the wheels cannot be calibrated on this run: {found} is no robot's. Sightings are refused where wheels "
            "are believed too much: say how far they may be off (wheels.scale_sigma, turn_scale_sigma, yaw_per_m_sigma)"
        )
    return found


class _Fit:
    """The graph with the wheels' gains as its parameters, and for the time being none of the wheels' states.

    Attributes:
        names: of the gains, as `WheelsConfig` has them.
        value: ``(n,)`` of the gains in the graph now.
        start: ``(n,)`` as configured.
        sigmas: ``(n,)`` of what they may be, around that.
    """

    def __init__(self, parts: Assembly, solver: BatchSmoother) -> None:
        self._solver, self._sources, self._config = solver, parts.localizer.sources, parts.config.wheels
        gains = _COMMAND_GAINS if parts.wheels.stands_in else _GAINS
        self.names = tuple(gains)
        self._nudges, self.sigmas = np.array(list(gains.values())).T
        self._prior = np.diag(self.sigmas**-2)
        self._least = np.array([-np.inf if name == "yaw_per_m" else 0.0 for name in gains])
        self.start = self.value = np.array([getattr(self._config, name) for name in gains])
        told = {i: _wheels_of(f.motions) for i, f in enumerate(solver.frames) if f.prior is None}
        factors = {i: wheels for i, wheels in told.items() if wheels is not None}
        if parts.learned is not None or not factors or not parts.wheels.source:
            raise EstimatorError(
                "wheels can be calibrated where they, or commands in their place, are in the graph by themselves: "
                "leave out --model, and see wheels.source"
            )
        self._ends = np.array(list(factors))
        self._information = np.linalg.inv([wheels.cov for wheels in factors.values()])
        self.move(self.value)

    def move(self, value: FloatArray) -> None:
        """Solve with these gains, and linearize there."""
        self._solve(np.maximum(value, self._least))
        self._slopes = self._differentiated()

    def release(self) -> None:
        """Let the wheels' states say again how far the gains may be off, which are now those that were found."""
        self._solve(self.value, released=True)

    def gradient(self) -> FloatArray:
        """Of the cost that is left, by the gains ``(n,)``."""
        poses = self._solver.poses()
        errors = _between(self._motions, _between(poses[self._ends - 1], poses[self._ends]))
        partial = -np.einsum("gni,nij,nj->g", self._slopes, self._information, errors)
        return np.asarray(partial + self._prior @ (self.value - self.start))

    def hessian(self) -> FloatArray:
        """Second derivatives ``(n, n)`` of the cost that is left."""
        at, here, rows = self.value, self.gradient(), []
        for nudge in np.diag(self._nudges):
            self._solve(at + nudge)
            rows.append((self.gradient() - here) / nudge.sum())
        self._solve(at)
        return np.asarray(0.5 * (np.array(rows) + np.array(rows).T))

    def _solve(self, value: FloatArray, released: bool = False) -> None:
        self.value, self._motions = value, self._measured(value)
        again = {}
        for i, motion in zip(self._ends.tolist(), self._motions, strict=True):
            frame = self._solver.frames[i]
            if frame.readings.wheels is not None:
                before = frame.readings.wheels
                depends = {name: (by, 0.0) for name, (by, _) in before.depends_on.items()} if released else {}
                readings = replace(frame.readings, wheels=replace(before, motion=motion, depends_on=depends))
                again[frame.k] = tuple(self._sources.combine_again(frame, readings))
        self._solver.replace_motions(again)

    def _differentiated(self) -> FloatArray:
        """Derivatives ``(gains, n, 3)`` of the motions by the gains, as perturbations from the right."""
        nudged = [self._measured(self.value + nudge) for nudge in np.diag(self._nudges)]
        return np.array([_between(self._motions, m) / n for m, n in zip(nudged, self._nudges, strict=True)])

    def _measured(self, value: FloatArray) -> FloatArray:
        """What wheels with these gains say ``(n, 3)`` of the steps to the keyframes."""
        gains = dict(zip(self.names, value.tolist(), strict=True))
        wheels = WheelMotion(self._config.model_copy(update=gains))
        said = [None if frame.step is None else wheels.measure(frame.step) for frame in self._solver.frames]
        return np.array([np.zeros(3) if (m := said[i]) is None else m.motion for i in self._ends.tolist()])


def _wheels_of(motions: Iterable[MotionMeasurement]) -> MotionMeasurement | None:
    return next((m for m in motions if m.source == "wheels"), None)


def _between(a: FloatArray, b: FloatArray) -> FloatArray:
    """``T_a⁻¹ ∘ T_b`` of ``(n, 3)`` poses; where these hardly differ, the perturbation that takes one to the other."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.column_stack([c * dx + s * dy, c * dy - s * dx, se2.wrap_array(b[:, 2] - a[:, 2])])
