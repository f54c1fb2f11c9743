"""The motion sources of a robot, each read as if it were alone, with the installation as it is known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.ground import planar_turn
from fgloc.graph.joint import FAR_M2
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.graph.noise import FusionRules, with_yaw
from fgloc.sensors import registry
from fgloc.sensors.base import MotionRole, Turn
from fgloc.sensors.equipment import MotionSensors
from fgloc.sensors.wheels.motion import commanded_to_move
from fgloc.stats import GATE, chi2_bound
from fgloc.types import FloatArray, MotionMeasurement, MotionReadings, Step

_MEMORIES = 2.0  # times what a yaw remembers of the gyro: two yaws so far apart measure the turn without it


class MotionSources:
    """Reads wheels, learned motion and gyro, and follows what is known of their drift."""

    def __init__(self, config: Config, sensors: MotionSensors, factors: LandmarkFactors | None = None) -> None:
        """Take the sensors.

        Args:
            config: of all of them.
            sensors: to be read.
            factors: hold what is known of the installation; None: motions are taken as they are reported.
        """
        self._config = config
        # Sigma of a speed that is not measured, as a share of the gate's bound: the bound is the quantile of GATE
        self._likely = 1.0 / math.sqrt(chi2_bound(GATE, 1))
        self.factors = LandmarkFactors(None) if factors is None else factors
        # m²/s of wheels that stand, with the way of encoders that jitter; of silent ones it is hundreds of times more
        self._known_rest = 10.0 * registry.odometer().errors(config).noise.xy_per_sqrt_s ** 2
        self._wheels, self._learned, self._joint = sensors.wheels, sensors.learned, sensors.joint
        self.gyro, self.attitude = sensors.gyro, sensors.attitude
        self._turn: Turn | None = None  # by the gyro, of the step that was read last
        self._yaw_indirect_s = 0.0  # how far back the yaw rests on the gyro, where fixes observe it along the way only
        self._silent_s = 0.0  # how long there was neither a motion source nor a fix

    @property
    def rules(self) -> FusionRules:
        """How the sources depend on each other."""
        return FusionRules(
            wheels_are_commands=self._wheels.from_commands,
            learned_has_gyro=self._learned_has_gyro,
            joint=self._joint,
            stopped_speed=self._likely * self._config.gate.max_speed,
            stopped_turn=self._likely * self._config.gate.max_yaw_rate,
        )

    @property
    def learned_is_independent(self) -> bool:
        """Whether the learned motion can be held against the wheels: it does not read them."""
        return self._learned is not None and not self._learned.model.card.reads(MotionRole.ODOMETER)

    @property
    def _learned_has_gyro(self) -> bool:
        return self._learned is not None and self._learned.model.card.reads(MotionRole.RATE)

    def read(self, step: Step, since_fix_s: float = 0.0) -> MotionReadings:
        """Read every source once.

        Args:
            step: its events.
            since_fix_s: time before the step without a fix.
        """
        if step.dt <= 0.0:
            return MotionReadings()
        reported = wheels = self._wheels.measure(step)
        if reported is not None:
            by = self._wheels.derivatives(step, reported, self.factors.installation.index)
            wheels = self._installed(reported, by)
        motion = np.zeros(3) if wheels is None else wheels.motion
        gyro = self._turn = None
        if self.gyro is not None:
            without_yaw_s = max(since_fix_s, self._yaw_indirect_s)
            turn = self.gyro.measure(step, None if wheels is None or commanded_to_move(step) else motion, without_yaw_s)
            if turn is not None:
                cov = np.diag([FAR_M2, FAR_M2, turn.variance])
                name, turned = registry.motion_names().rate, with_yaw(motion, turn.yaw)
                gyro = MotionMeasurement(name, step.start_ns, step.stamp_ns, turned, cov)
                gyro = self._installed(gyro, self.gyro.derivatives(turned))
                self._turn = turn
                if reported is not None and wheels is not None:
                    wheels = replace(wheels, depends_on=self._by_fused_turn(step, reported, turn, wheels.depends_on))
        learned = self._with_drift(self._measure_learned(step))
        inertial = None if self.attitude is None else self.attitude.measure(step, self._wheels.twist)
        readings = MotionReadings(wheels, learned, gyro, inertial, self._at_rest(step, reported))
        if readings.wheels is not None or readings.learned is not None:
            self._silent_s = 0.0
        return readings

    def _at_rest(self, step: Step, wheels: MotionMeasurement | None) -> bool:
        """Whether the wheels stand, as far as encoders tell, no command moves them, and the gyro agrees."""
        if self.gyro is None or not self.gyro.at_rest or wheels is None or self._wheels.from_commands:
            return False
        return bool(wheels.cov[0, 0] <= self._known_rest * step.dt + 1e-11)

    def _by_fused_turn(
        self, step: Step, reported: MotionMeasurement, turn: Turn, known: Mapping[str, tuple[FloatArray, float]]
    ) -> dict[str, tuple[FloatArray, float]]:
        """Derivatives of the wheels' motion where its turn is that of wheels and gyro together.

        The derivative by a scale is the motion itself. With the wheels' own noise in it, derivative and residual are
        correlated, and the estimate of the scale is biased, the more certain the longer the run (errors in variables).
        The gyro is the instrument, as far as it is the better of the two. Source: Fuller 1987, "Measurement Error
        Models", section 1.4.
        """
        assert self.gyro is not None
        both = reported.cov[2, 2] + turn.noise
        weight = float(reported.cov[2, 2] / both) if both > 0.0 else 0.0
        fused = reported.motion[2] + weight * (turn.yaw - reported.motion[2])
        m = replace(reported, motion=with_yaw(reported.motion, fused))
        rates = self.gyro.rates_at(step.inertial, (step.start_ns, step.stamp_ns))
        by = self._wheels.derivatives(step, m, self.factors.installation.index, (weight, rates))
        return {name: (by[name], assumed) for name, (_, assumed) in known.items()}

    def _with_drift(self, learned: MotionMeasurement | None) -> MotionMeasurement | None:
        """The learned motion with the drift of the gyro that it reads, where no fix observes the yaw by itself."""
        if learned is None or self._turn is None or not self._learned_has_gyro or self._yaw_indirect_s == 0.0:
            return learned
        drift = max(self._turn.variance - self._turn.noise, 0.0)
        return replace(learned, cov=learned.cov + np.diag([0.0, 0.0, drift]))

    def _installed(self, m: MotionMeasurement, *derivatives: Mapping[str, FloatArray]) -> MotionMeasurement:
        """The motion as reported with the installation as it is known now; its derivatives are those of the sensors."""
        index, mean = self.factors.installation.index, self.factors.estimated.mean
        by = {name: d for each in derivatives for name, d in each.items()}
        kept = {name: (d, float(mean[index[name]])) for name, d in by.items() if name in index}
        correction = np.sum([d * value for d, value in kept.values()], axis=0) if kept else np.zeros(3)
        return replace(m, motion=se2.compose(m.motion, se2.exp(correction)), depends_on=kept)

    def _measure_learned(self, step: Step) -> MotionMeasurement | None:
        if self._learned is None:
            return None
        m = self._learned.measure_scaled(step, 0.0 if self.gyro is None else self.gyro.bias)
        if m is None:
            return None
        by_turn = [self.gyro.derivatives(m.motion)] if self.gyro and self._turn and self._learned_has_gyro else []
        return self._installed(m, self._learned.derivatives(m.motion), *by_turn)

    def unknown(
        self, step: Step, readings: MotionReadings | None = None, carried_s: float | None = None
    ) -> MotionMeasurement:
        """No source measured the motion: sigma grows with the time since the last, however many steps it is cut into.

        A gyro, if there is one, still measures the turn.

        Args:
            step: over which.
            readings: of it.
            carried_s: since when the robot is carried, so that its wheels do not measure [s]; None: it is not.
        """
        before = self._silent_s if carried_s is None else carried_s
        after = before + step.dt
        if carried_s is None:
            self._silent_s = after
        gate = self._config.gate
        speed, turn = self._likely * gate.max_speed, self._likely * gate.max_yaw_rate
        cov = np.diag(np.square([speed, speed, turn])) * (after**2 - before**2)
        motion, gyro = np.zeros(3), None if readings is None else readings.gyro
        if gyro is not None:
            motion, cov[2, 2] = with_yaw(motion, float(gyro.motion[2])), gyro.cov[2, 2]
        inertial = None if readings is None else readings.inertial
        return MotionMeasurement("unknown", step.start_ns, step.stamp_ns, motion, cov, inertial=inertial)

    def commit(self, readings: MotionReadings, fix: PoseWithCovariance | None, observes_yaw: bool = True) -> None:
        """The robot went on by a step.

        Args:
            readings: of that step.
            fix: where sightings have it now; None if there were none.
            observes_yaw: whether one of them observes the yaw by itself. Positions and ranges do along the way: the yaw
                of a fix then rests on the gyro too, and only two fixes far apart correct its bias.
        """
        if fix is not None:
            self._silent_s = 0.0
        if self.gyro is None:
            return
        if readings.gyro is None:
            self.gyro.forget_fix()
            return
        turn = readings.gyro
        seconds = (turn.stamp_ns - turn.start_ns) * 1e-9
        turned = float(turn.motion[2])
        if self.factors.installation.ground:  # the gyro turns about the robot's axis, the yaw about the map's
            known, inertial = self.factors.estimated.mean, readings.inertial
            turned = planar_turn(turn.motion, inertial, known, self.factors.installation)
        self.gyro.turned(turned, seconds)
        if fix is None:
            return
        yaw, variance = float(fix.pose[2]), float(fix.cov[2, 2])
        if observes_yaw:
            self._yaw_indirect_s = 0.0
            self.gyro.fix(yaw, variance)
        else:
            memory_s = self._yaw_memory_s(variance)
            self._yaw_indirect_s = min(self._yaw_indirect_s + seconds, memory_s, self._config.estimator.lag_s)
            self.gyro.fix(yaw, variance, apart_s=_MEMORIES * memory_s)

    def _yaw_memory_s(self, variance: float) -> float:
        """How far back [s] a yaw of this variance [rad²] can rest on the gyro alone.

        Over a time t its noise and its bias make a variance of q t + b² t²: where the yaw is known better than that,
        fixes have replaced the turns before.
        """
        if self.gyro is None or self._turn is None:
            return 0.0
        noise, bias = 0.5 * self._turn.noise_density, self.gyro.bias_variance
        return variance / (noise + math.sqrt(noise**2 + bias * variance))

    def begin_segment(self) -> None:
        """The clock jumped: nothing is known of what happened in between."""
        self._silent_s = self._yaw_indirect_s = 0.0
        if self.gyro is not None:
            self.gyro.forget_fix()
