"""Whether the robot was lifted or pushed: signs of it in accelerometer, gyro and wheels, and what then is known.

Wheels that hang in the air or stand do not measure where the robot is carried. Three tests look for it; each has at
most one false alarm a day where its errors are normal (Bonferroni over steps and windows):

- *vertical velocity*: the magnitude of the specific force, less what is usual, summed over windows of up to a second.
  It does not depend on the tilt. A robot on the floor cannot rise; its standard deviation is that of the run itself,
  one of a driving robot, which shakes, and one of a standing one.
- *tilted at rest*: it rolls or pitches although its wheels drive it nowhere. No floor does that, uneven or not.
- *turned at rest*: the gyro turns although the wheels stand and no command moves them.

It was set down when wheels and gyro rest for a while, when a sighting fixes its pose, or some time after the last sign.
A wheel that spins while gyro and accelerometer show rest may as well slip; `MotionFaultMonitor` detects that.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from fgloc.sensors.wheels.motion import commanded_to_move, is_standing
from fgloc.stats import alarm_bound
from fgloc.types import Decision, FloatArray, MotionReadings, Step

_WINDOW_S = 1.0  # of vertical velocity: lifting takes about as long
_STEEP = 0.3  # m/s of rising for each m/s of driving: slopes of 17 degrees
_LEAST_RISE = 0.2  # m/s: a kerb, a ramp of 10 degrees and humps of 3 cm give a driving robot less
_OVERLAPPING = 1.5  # degrees of freedom that sums over overlapping windows have more than those over separate ones
_MEMORY_S = 60.0  # over which level and standard deviation of the specific force are averaged
_LEARN_S = 2.0  # before the first test
_LEAST_TURN = 0.05  # rad: less is a shaken floor
_ROCKING = 0.015  # rad: a robot on the floor rocks so much when it stops, or while it turns on the spot ...
_ON_SPOT_M = 0.02  # ... and goes no further in a second; half a wheel's width
_SHAKES_M_S, _SHAKES_RAD_S = 0.02, 0.05  # m/s, rad/s
_ONSET_S = 0.5  # from the start of a lift to its alarm
_SETTLED_S = 2.0  # after the last sign: a sighting then ends it


class LiftMonitor:
    """Watches for a robot that is carried.

    Attributes:
        carried: the robot may be in the air, or was set down a short time ago.
    """

    def __init__(self, longest_s: float, up: FloatArray | None = None) -> None:
        """Nothing has come in.

        Args:
            longest_s: how long after the last sign it has been set down, if nothing tells it earlier.
            up: ``(3,)`` the base's z axis in the IMU's frame, times the scale of its rates; None: there is no gyro.
        """
        self._longest_s = longest_s
        self._up = up
        self.carried = False
        self._rest_s = 0.0  # since when wheels and gyro rest
        self._begin()
        self._since_fix_s = 0.0  # time in the air since a sighting has fixed the pose
        self._quiet_s = 0.0  # since the last sign

    def observe(self, k: int, step: Step, readings: MotionReadings) -> list[Decision]:
        """Take in a step; rows of ``steps.csv`` while the robot is carried.

        Args:
            k: keyframe of the step.
            step: with the messages of IMU and commands.
            readings: what the motion sources measured.
        """
        self._quiet_s += step.dt
        self._rest_s = self._rest_s + step.dt if readings.at_rest else 0.0
        moving = readings.wheels is None or _shakes(readings.wheels.motion, step.dt)
        speed = 0.0 if readings.wheels is None else float(np.hypot(*readings.wheels.motion[:2])) / max(step.dt, 1e-3)
        least = _LEAST_RISE + _STEEP * speed
        rise = self._rise[moving].test(step, self.carried, least)
        if moving or self._rise[False].known:
            self._rise[not moving].skip(step)
        else:  # a robot that stands shakes no more than one that drives
            rise = self._rise[True].test(step, True, least)
        signs = [
            ("vertical_velocity", *rise),
            ("tilted_at_rest", *self._tilt.test(step, readings)),
            ("turned_at_rest", *self._turn.test(step, readings)),
        ]
        told = [
            Decision(k, step.stamp_ns, "lift", -1, math.sqrt(nis), nis, 1, 0.0, reason, bound)
            for reason, nis, bound in signs
            if nis > bound
        ]
        if told:
            self._quiet_s = 0.0
            if not self.carried:
                self.carried, self._since_fix_s = True, _ONSET_S
        elif self.carried and (self._quiet_s > self._longest_s or self._rest_s > _SETTLED_S):
            self.carried = False
        if self.carried and not told:
            told = [Decision(k, step.stamp_ns, "lift", -1, math.nan, math.nan, 0, 0.0, "carried")]
        return told

    def carried_s(self, step: Step) -> float:
        """How long before a step that it is carried over the robot was fixed last [s]."""
        before, self._since_fix_s = self._since_fix_s, self._since_fix_s + step.dt
        return before

    def fix(self) -> None:
        """Sightings have fixed the pose."""
        self._since_fix_s = 0.0
        if self._quiet_s > _SETTLED_S:
            self.carried = False

    def reset(self) -> None:
        """The clock jumped: nothing connects what comes with what was."""
        self.carried = False
        self._begin()

    def _begin(self) -> None:
        self._rise = {moving: _RiseTest() for moving in (False, True)}
        self._tilt, self._turn = _TiltTest(self._up), _TurnTest()
        self._rest_s = 0.0  # since when wheels and gyro rest


def _shakes(motion: FloatArray, seconds: float) -> bool:
    """Whether a robot on wheels that turn so fast is shaken by its floor; a jitter of encoders is no motion."""
    return bool(math.hypot(motion[0], motion[1]) > _SHAKES_M_S * seconds or abs(motion[2]) > _SHAKES_RAD_S * seconds)


class _RiseTest:
    """The vertical velocity that windows of the specific force give, against what is usual in this run."""

    def __init__(self) -> None:
        self._level = math.nan  # m/s²: of the magnitude at rest, with the sensor's bias
        self._variance = 0.0  # of a window of full length
        self._learned_s = 0.0
        self._newest_ns = 0
        self._samples: deque[tuple[float, float]] = deque()  # seconds it stands for, magnitude
        self._length_s = 0.0

    @property
    def known(self) -> bool:
        """Whether it is known what is usual."""
        return self._learned_s > _LEARN_S

    def skip(self, step: Step) -> None:
        """The robot is in the other state, driving or standing."""
        self._samples.clear()
        self._length_s, self._newest_ns = 0.0, step.stamp_ns

    def test(self, step: Step, carried: bool, least: float) -> tuple[float, float]:
        """Squared ratio of rise and standard deviation of the least likely window, and its bound."""
        new = [e for e in step.inertial if max(self._newest_ns, step.start_ns) < e.stamp_ns <= step.stamp_ns]
        forces = [float(np.linalg.norm(e.linear_acceleration)) for e in new]
        if not new or not all(map(math.isfinite, forces)) or max(forces) == 0.0:  # 0: there is no accelerometer
            self.skip(step)
            return 0.0, math.inf
        each, self._newest_ns = step.dt / len(new), new[-1].stamp_ns
        for force in forces:
            self._samples.append((each, force))
            self._length_s += each
        while self._length_s - self._samples[0][0] > _WINDOW_S:
            self._length_s -= self._samples.popleft()[0]
        return self._judge(step.dt, float(np.mean(forces)), carried, least)

    def _judge(self, dt: float, mean: float, carried: bool, least: float) -> tuple[float, float]:
        seconds, forces = np.array(self._samples).T
        if math.isnan(self._level):
            self._level = mean
        rises = np.cumsum(((forces - self._level) * seconds)[::-1])
        spans = np.cumsum(seconds[::-1])
        bound = alarm_bound(dt, len(spans), 1, _OVERLAPPING * self._learned_s / _WINDOW_S)
        nis = rises**2 / np.maximum(self._variance * spans / _WINDOW_S, least**2 / bound)
        if not carried and nis.max() <= bound:
            self._learned_s += dt
            share = dt / min(self._learned_s, _MEMORY_S)
            self._level += share * (mean - self._level)
            self._variance += share * (rises[-1] ** 2 * _WINDOW_S / spans[-1] - self._variance)
        return (float(nis.max()), bound) if self.known else (0.0, bound)


class _TiltTest:
    """How far a robot that stands, or turns on the spot, rolls or pitches within a second."""

    def __init__(self, up: FloatArray | None) -> None:
        self._up = up
        self._bias = np.zeros(3)
        self._newest: tuple[float, ...] = ()
        self._learned_s = 0.0
        self._steps: deque[tuple[float, float, FloatArray]] = deque()  # seconds, way [m], turn across the vertical

    def test(self, step: Step, readings: MotionReadings) -> tuple[float, float]:
        """Squared ratio of tilt and standard deviation of the widest stretch, and its bound."""
        bound = alarm_bound(step.dt, 1, 2)
        events = [e for e in step.inertial if step.start_ns < e.stamp_ns <= step.stamp_ns]
        new, before = [(*e.angular_velocity, *e.linear_acceleration) for e in events], self._newest
        self._newest = new[-1] if new else before
        frozen = all(sample == before for sample in new)  # or there is none
        if self._up is None or readings.wheels is None or frozen or not np.isfinite(new).all():
            self._steps.clear()
            return 0.0, bound
        scale = float(np.linalg.norm(self._up))
        u, rate = self._up / scale, scale * np.mean(new, axis=0)[:3]
        rate = rate - (rate @ u) * u
        way = float(np.hypot(*readings.wheels.motion[:2]))
        self._steps.append((step.dt, way, (rate - self._bias) * step.dt))
        while sum(s for s, _, _ in self._steps) - self._steps[0][0] > _WINDOW_S:
            self._steps.popleft()
        tilts = np.cumsum([turn for _, _, turn in self._steps][::-1], axis=0)
        nis = float((tilts**2).sum(axis=1).max()) / _ROCKING**2
        if sum(w for _, w, _ in self._steps) > _ON_SPOT_M:
            return 0.0, bound
        if nis <= bound:
            self._learned_s += step.dt
            self._bias += step.dt / min(self._learned_s + _LEARN_S, _MEMORY_S) * (rate - self._bias)
        return nis, bound


class _TurnTest:
    """The turn of a robot whose wheels stand and that is commanded to stand."""

    def __init__(self) -> None:
        self._turned = self._variance = 0.0

    def test(self, step: Step, readings: MotionReadings) -> tuple[float, float]:
        """Squared ratio of turn and standard deviation since the robot stands, and its bound."""
        bound = alarm_bound(step.dt, 1, 1)
        wheels, gyro = readings.wheels, readings.gyro
        told_to_stand = commanded_to_move(step) is False
        if wheels is None or gyro is None or not told_to_stand or not is_standing(wheels.motion, step.dt):
            self._turned = self._variance = 0.0
            return 0.0, bound
        self._turned += float(gyro.motion[2])
        self._variance += float(gyro.cov[2, 2] + wheels.cov[2, 2])
        if abs(self._turned) < _LEAST_TURN:
            return 0.0, bound
        return self._turned**2 / self._variance, bound
