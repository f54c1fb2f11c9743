"""An inertial unit: yaw rate as a motion source, roll and pitch on uneven ground."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from fgloc import se2
from fgloc.config import Config, GyroConfig
from fgloc.frames import rotation_of, rpy_matrix
from fgloc.sensors.base import (
    BASE,
    BuiltIn,
    Channel,
    EventInput,
    FoundRow,
    InstallationState,
    MotionInstallation,
    Mounting,
    Parameter,
    Signal,
    Stream,
    Turn,
    When,
    matrix,
    of_stamps,
    xyz,
)
from fgloc.sensors.checks import Changes, FieldChecks, Table, count, finite_rows, spikes
from fgloc.sensors.failures import Carriage, EventFailure, Scene
from fgloc.sensors.wheels.motion import Standing
from fgloc.stats import GATE, chi2_bound
from fgloc.types import Event, FloatArray, Grave, InertialEvent, InertialReading, Setting, Step


@dataclass(frozen=True, slots=True, eq=False)
class ImuEvent(InertialEvent):
    """``sensor_msgs/Imu``."""

    angular_velocity_cov: FloatArray  # (3, 3)


def from_imu(m: Any, when: When) -> Event:
    """Event of a ``sensor_msgs/Imu``."""
    return ImuEvent(
        *when,
        m.header.frame_id,
        xyz(m.angular_velocity),
        xyz(m.linear_acceleration),
        matrix(m.angular_velocity_covariance, 3),
    )


_MAX_ACCELERATION = 1e3  # m/s²
_FROZEN_NS, _FROZEN_TIMES = 1_000_000_000, 10  # for so long, and so often: noise does not repeat six values


def imu_validator(checks: FieldChecks) -> Callable[[ImuEvent], Event | str]:
    """Validator of IMU messages."""
    bounds = checks.config
    repeated: dict[str, tuple[tuple[float, ...], int, int]] = {}  # by topic: values, since when, how often

    def is_frozen(event: ImuEvent, values: tuple[float, ...]) -> bool:
        before, since_ns, times = repeated.get(event.topic, ((), 0, 0))
        same = values == before and event.stamp_ns > since_ns
        repeated[event.topic] = (before, since_ns, times + 1) if same else (values, event.stamp_ns, 1)
        lasts = same and event.stamp_ns - since_ns > _FROZEN_NS and times >= _FROZEN_TIMES
        return lasts and all(values)  # a simulated one without noise has zeros, and may repeat itself

    def validate(event: ImuEvent) -> Event | str:
        changes: Changes = {}
        cov = event.angular_velocity_cov
        if cov[0, 0] == -1.0:  # REP 145
            checks.note(f"{event.topic}: says that it has no gyroscope (its covariance starts with -1)")
            return "unavailable"
        wx, wy, wz = event.angular_velocity.tolist()
        ax, ay, az = event.linear_acceleration.tolist()
        if is_frozen(event, (wx, wy, wz, ax, ay, az)):
            checks.note(
                Grave(
                    f"{event.topic}: rates and accelerations repeat to the digit for more than "
                    f"{_FROZEN_NS * 1e-9:g} s: the IMU is frozen, and such messages are rejected (see its driver)"
                )
            )
            return "frozen"
        if not math.isfinite(wx + wy + wz):
            return "non_finite"
        if max(abs(wx), abs(wy), abs(wz)) > bounds.max_yaw_rate:
            return "yaw_rate_bound"
        if reason := checks.covariance(
            event.topic, "angular velocity", cov, (0, 1, 2), "angular_velocity_cov", changes
        ):
            return reason
        if not abs(ax) + abs(ay) + abs(az) <= _MAX_ACCELERATION:  # also NaN
            checks.rejections["imu.acceleration"] += 1
            changes["linear_acceleration"] = np.full(3, np.nan)
        return replace(event, **changes) if changes else event

    return validate


class ImuChecks:
    """Checks of a topic of IMU messages: yaw rates within the gate's bound, and gravity near 9.81 m/s²."""

    def __init__(self) -> None:
        self._rows = Table(6)

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, ImuEvent)
        self._rows.add(*event.angular_velocity, *event.linear_acceleration)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows)
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity and will be rejected.")
        found += spikes(topic, "yaw rate", "rad/s", np.abs(rows[:, 2]), config.gate.max_yaw_rate, seconds)
        if not rows[:, :3].any():
            found.append(f"{topic}: the gyro is always zero.")
        gravity = float(np.median(np.linalg.norm(rows[finite, 3:], axis=1))) if finite.any() else 0.0
        if 0.0 < gravity < 8.8 or gravity > 10.8:
            hint = " (unit g?)" if 0.9 < gravity < 1.1 else ""
            found.append(f"{topic}: the acceleration's median is {gravity:.2f} m/s², expected about 9.81{hint}.")
        return found


class GyroInput(EventInput):
    """Method that makes the events of an IMU."""

    def imu(
        self,
        stamp_ns: int,
        angular_velocity: ArrayLike,
        linear_acceleration: ArrayLike = (0.0, 0.0, 0.0),
        frame_id: str = BASE,
    ) -> None:
        """Gyro rates ``(3,)`` [rad/s] and accelerations ``(3,)`` [m/s²] in the IMU's axes."""
        rates, accelerations = (np.asarray(a, dtype=float) for a in (angular_velocity, linear_acceleration))
        self._deliver(ImuEvent(*self._when("imu", stamp_ns), frame_id, rates, accelerations, np.zeros((3, 3))))


BIASES = ("gyro.bias_x", "gyro.bias_y")  # rad/s, in the axes of the base
TILTS = ("gyro.roll_rad", "gyro.pitch_rad")  # of the IMU, beside its mounting as it is given
LEVELS = ("gyro.level_x_rad", "gyro.level_y_rad")  # tilt about x and y that the accelerometer's bias makes


def _parameters(config: Config, sources: Collection[str]) -> tuple[Parameter, ...]:
    """Parameters of the gyro with their priors; on uneven ground also biases, tilts and levels."""
    scale = Parameter("gyro.scale", config.gyro.scale_sigma if "gyro" in sources else 0.0, effects=("turn",))
    if config.estimator.ground == "flat" or "gyro" not in sources:
        return (scale,)
    biases = (Parameter(name, config.gyro.bias_sigma) for name in BIASES)
    tilts = (Parameter(name, config.gyro.tilt_sigma_rad) for name in TILTS)
    return (scale, *biases, *tilts, *(Parameter(name, config.gyro.level_sigma_rad) for name in LEVELS))


def _settings(state: InstallationState, config: Config) -> Iterator[Setting]:
    """Settings of the gyro, as a run has estimated them."""
    scale = config.gyro.scale
    yield from state.setting("gyro.scale", scale, scale * (1.0 + state.value("gyro.scale")), {"gyro.scale": scale})


_FOUND = (FoundRow("gyro.scale", "gyro.scale", 1.0, -1.0),)
INSTALLATION = MotionInstallation(_parameters, lambda config: _FOUND, _settings, {"gyro.scale": "gyro.scale_sigma"})


_MAX_GAP_S = 0.1  # over a longer silence the turn is not known
_AT_REST_S = 0.3  # that the wheels have stood before the robot is taken to stand
_MOST_SIGMAS = 10.0  # of the bias at the start: what is larger is no bias
_UNSURE = 0.4  # sigma of a bias that changed, over the change: a wrong fix shows twice, then by twice as much
_APART_S = 2.0  # between two yaws that the bias is learned from, at least


class Gyro:
    """Integrates the yaw rate over steps and keeps an estimate of its bias (a scalar Kalman filter).

    The bias is learned while the wheels stand, and between fixes of the yaw.

    Attributes:
        up: ``(3,)`` the base's z axis in the IMU's frame, times the scale of its rates.
        bias: [rad/s].
        bias_variance: [rad²/s²].
        rejections: steps without a turn, by reason: ``gyro.silence``.
    """

    def __init__(self, config: GyroConfig, up: ArrayLike = (0.0, 0.0, 1.0)) -> None:
        """Set up.

        Args:
            config: noise of the gyro.
            up: ``(3,)`` the base's z axis in the IMU's frame.
        """
        self.bias = 0.0
        self.bias_variance = config.bias_sigma**2
        self.rejections: Counter[str] = Counter()
        self._config = config
        self.up = np.asarray(up, dtype=float)
        self._standing_s = 0.0
        self._wheels = Standing()
        self._anchor: tuple[float, float] | None = None  # yaw and variance of the last fix ...
        self._turned = self._turned_s = 0.0  # ... and what was turned since
        self._received = False
        self.forget_fix()

    @property
    def at_rest(self) -> bool:
        """Whether the wheels have stood, and the gyro has measured nothing but its bias, for more than 0.3 s."""
        return self._standing_s > _AT_REST_S

    def fork(self) -> Gyro:
        """A copy that may integrate beyond the newest step without changing this one."""
        forked = copy.copy(self)
        forked.rejections = Counter()
        forked._wheels = self._wheels.fork()
        return forked

    def resume(self, bias: float, bias_variance: float) -> None:
        """Go on from what an earlier run learned of the bias [rad/s], [rad²/s²]."""
        self.bias, self.bias_variance = bias, min(bias_variance, self._config.bias_sigma**2)

    def measure(self, step: Step, wheels: ArrayLike | None, since_fix_s: float = 0.0) -> Turn | None:
        """Turn of the robot over a step.

        Args:
            step: with the IMU's messages.
            wheels: ``(3,)`` what the wheels measured of the step: where they stand, the bias shows.
            since_fix_s: how long before the step no fix has determined the yaw. A wrong bias turns all steps
                alike, so that its variance grows with the square of that time, however it is cut into steps.

        Returns:
            None without data of the gyro; after its first data, that is counted.
        """
        dt = step.dt
        raw = None if dt <= 0.0 else self._integral(step.inertial, step.start_ns, step.stamp_ns)
        if raw is None:
            self._standing_s = 0.0
            if self._received:
                self.rejections["gyro.silence"] += 1
            return None
        self._received = True
        self.bias_variance += self._config.bias_walk**2 * dt
        self._watch_rest(raw / dt, dt, wheels)
        yaw = raw - self.bias * dt
        drift = self.bias_variance * ((since_fix_s + dt) ** 2 - since_fix_s**2)
        noise = self._config.yaw_per_sqrt_s**2 * dt
        return Turn(yaw, noise + drift, noise, self._config.yaw_per_sqrt_s**2)

    def rates_at(self, events: tuple[InertialEvent, ...], stamps_ns: tuple[int, ...]) -> FloatArray:
        """Yaw rates ``(n,)`` [rad/s] at these times, interpolated between the neighboring messages, bias removed."""
        times = np.array([(event.stamp_ns - stamps_ns[0]) * 1e-9 for event in events])
        rates = np.array([event.angular_velocity for event in events]) @ self.up
        at = np.array([(stamp - stamps_ns[0]) * 1e-9 for stamp in stamps_ns])
        return np.asarray(np.interp(at, times, rates) - self.bias)

    def derivatives(self, motion: FloatArray) -> dict[str, FloatArray]:
        """Derivatives ``(3,)`` of a motion whose turn is this gyro's (right perturbation), by parameter of the gyro."""
        rho_x, rho_y, phi = se2.log(motion)
        return {"gyro.scale": phi * np.array([-0.5 * rho_y, 0.5 * rho_x, 1.0])}

    def turned(self, yaw: float, seconds: float) -> None:
        """Add the turn [rad] of a step, as `measure` gave it, to the turn since the last fix."""
        self._turned += yaw
        self._turned_s += seconds

    def fix(self, yaw: float, variance: float, apart_s: float = 0.0) -> None:
        """Add a fix of the yaw at the end of the last step; the turn between two fixes corrects the bias.

        Args:
            yaw: [rad].
            variance: [rad²].
            apart_s: how far apart the two have to be at least, so that their errors do not depend on this gyro.
        """
        if self._anchor is not None:
            if self._turned_s < max(_APART_S, apart_s):
                return
            before, spread = self._anchor
            error = math.remainder(self._turned - (yaw - before), math.tau)
            noise = self._config.yaw_per_sqrt_s**2 * self._turned_s
            off, spread = error / self._turned_s, (spread + variance + noise) / self._turned_s**2
            beyond = off**2 > chi2_bound(GATE, 1) * (self.bias_variance + spread)
            unsure = 0.0
            if beyond and abs(self.bias + off) < _MOST_SIGMAS * self._config.bias_sigma:
                self.bias_variance += off**2  # it changed, as after a shock, or a fix is wrong: the next ones tell
                unsure = (_UNSURE * off) ** 2
            self._learn(self.bias + off, spread)
            self.bias_variance = max(self.bias_variance, unsure)
        self._anchor, self._turned, self._turned_s = (yaw, variance), 0.0, 0.0

    def forget_fix(self) -> None:
        """Forget the last fix, since which the robot may have been turned without data."""
        self._anchor, self._turned, self._turned_s = None, 0.0, 0.0

    def _watch_rest(self, rate: float, dt: float, wheels: ArrayLike | None) -> None:
        stands = self._wheels.observe(None if wheels is None else np.asarray(wheels, dtype=float), dt)
        variance = self._config.yaw_per_sqrt_s**2 / dt
        still = (rate - self.bias) ** 2 < chi2_bound(GATE, 1) * (self.bias_variance + variance)  # or turned by hand
        self._standing_s = self._standing_s + dt if stands and still else 0.0
        if self._standing_s > _AT_REST_S:
            self._learn(rate, variance)

    def _learn(self, bias: float, variance: float) -> None:
        gain = self.bias_variance / (self.bias_variance + variance)
        change = gain * (bias - self.bias)
        self.bias += change
        self.bias_variance *= 1.0 - gain
        self._turned -= change * self._turned_s  # what was turned since the last fix, with the bias of now

    def _integral(self, events: tuple[InertialEvent, ...], start_ns: int, end_ns: int) -> float | None:
        """Turn [rad] of the rates as they are, joined by straight lines and held at the ends."""
        if not events:
            return None
        times = np.array([(event.stamp_ns - start_ns) * 1e-9 for event in events])
        rates = np.array([event.angular_velocity for event in events]) @ self.up
        nodes = _nodes(times, (end_ns - start_ns) * 1e-9)
        return None if nodes is None else float(np.trapezoid(np.interp(nodes, times, rates), nodes))


def _nodes(times: FloatArray, end: float) -> FloatArray | None:
    """Times ``(m,)`` [s] from 0 to an end, with those of the samples between; None where these were silent for long."""
    if max(times[0], end - times[-1]) > _MAX_GAP_S or (len(times) > 1 and np.diff(times).max() > _MAX_GAP_S):
        return None
    return np.concatenate([[0.0], times[(times > 0.0) & (times < end)], [end]])


_SPEED_SIGMA = 0.015  # m/s: by what wheels and a mean over 40 ms are off from the robot's speed at one time

Twist = Callable[[Step, int], FloatArray]
"""Of the base ``(3,)`` at a time near the step's end."""


class Attitude:
    """Integrates the rates about x and y, and takes the robot's own acceleration out of the specific force.

    Source: Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd edition, 3.4 (specific force in body
    axes: ``f = dv/dt + ω × v - g``).
    """

    def __init__(self, config: GyroConfig, T_base_imu: FloatArray) -> None:
        """Take the noise, and the mounting ``(4, 4)`` of the IMU."""
        self._config = config
        self._R, self._t = T_base_imu[:3, :3], T_base_imu[:3, 3]

    def rates_at(self, events: Sequence[InertialEvent], at_ns: int) -> FloatArray:
        """Angular velocity ``(3,)`` [rad/s] of the base at a time, bias included."""
        times, rates, _ = self._samples(events, at_ns)
        return np.array([np.interp(0.0, times, rates[:, i]) for i in range(3)])

    def measure(self, step: Step, twist: Twist) -> InertialReading | None:
        """The step's reading; None if the IMU was silent.

        Args:
            step: with the IMU's messages.
            twist: tells the speed at its start and end.
        """
        dt = step.dt
        if dt <= 0.0 or not step.inertial:
            return None
        times, rates, forces = self._samples(step.inertial, step.start_ns)
        nodes = _nodes(times, dt)
        if nodes is None:
            return None
        at = np.column_stack([np.interp(nodes, times, rates[:, i]) for i in range(3)])
        turn = np.asarray(np.trapezoid(at, nodes, axis=0))
        sampled = (times > 0.0) & (times <= dt)
        force, variance = None, self._config.acceleration_sigma**2 + 2.0 * (_SPEED_SIGMA / dt) ** 2
        if sampled.any() and np.isfinite(forces[sampled]).all() and forces[sampled].any():
            force = self._without_acceleration(step, turn, forces[sampled].mean(axis=0), twist)
        return InertialReading(turn[:2], self._config.yaw_per_sqrt_s**2 * dt, force, variance, dt)

    def _without_acceleration(self, step: Step, turn: FloatArray, force: FloatArray, twist: Twist) -> FloatArray:
        """The mean force over a step less the robot's own acceleration, in the base's axes at the end."""
        dt = step.dt
        start, end = twist(step, step.start_ns), twist(step, step.stamp_ns)
        omega = turn / dt
        speed = np.array([*(0.5 * (start[:2] + end[:2])), 0.0]) + np.cross(omega, self._t)
        own = np.array([*((end[:2] - start[:2]) / dt), 0.0]) + np.cross(omega, speed)
        return np.asarray(rotation_of(-0.5 * turn) @ (force - own))

    def _samples(self, events: Sequence[InertialEvent], origin_ns: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        times = np.array([(event.stamp_ns - origin_ns) * 1e-9 for event in events])
        rates = np.array([event.angular_velocity for event in events]) @ self._R.T
        forces = np.array([event.linear_acceleration for event in events]) @ self._R.T
        return times, rates, forces


_GRAVITY = 9.81  # m/s²


def _rate(events: Sequence[InertialEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Signal of the yaw rate [rad/s] with its bias removed; None without events."""
    if not events:
        return None
    rates = np.concatenate([e.angular_velocity for e in events]).reshape(-1, 3)
    rates = rates @ np.asarray(mounting.imu_up) - np.asarray(mounting.gyro_bias)
    return of_stamps([e.stamp_ns for e in events], rates[None], origin_ns)


def _gravity(events: Sequence[InertialEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Specific force along the robot's x and y over that of gravity: on a slope what pulls the robot, sign reversed.

    The IMU's x axis is taken to lie in the plane of the robot's x and z.
    """
    forces = np.array([e.linear_acceleration for e in events]).reshape(-1, 3)
    known = np.isfinite(forces).all(axis=1) & (np.abs(forces).sum(axis=1) > 0.0)
    if not known.any():
        return None
    up = np.asarray(mounting.imu_up) / np.linalg.norm(mounting.imu_up)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    pulls = forces[known] @ np.array([ahead, np.cross(up, ahead)]).T / _GRAVITY
    return of_stamps([e.stamp_ns for e, there in zip(events, known, strict=True) if there], pulls.T, origin_ns)


CHANNELS = (
    Channel("gyro", 1, 0, InertialEvent, _rate),
    Channel("gravity", 2, 3, InertialEvent, _gravity),
)


class ImuBias(EventFailure):
    """The gyroscope's yaw rate is off by ``yaw_rate`` and the accelerometer by ``acceleration``."""

    changes: ClassVar[tuple[type[Event], ...]] = (ImuEvent,)
    sizes: ClassVar[tuple[str, ...]] = ("yaw_rate", "acceleration")
    kind: Literal["imu_bias"] = "imu_bias"
    yaw_rate: float = Field(0.05, description="rad/s, about z")
    acceleration: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="m/s², in the sensor's axes")

    def change(self, event: ImuEvent, scene: Scene) -> Event:
        """Add the biases to a message."""
        return replace(
            event,
            angular_velocity=event.angular_velocity + np.array([0.0, 0.0, self.yaw_rate]),
            linear_acceleration=event.linear_acceleration + np.array(self.acceleration),
        )


_BOUNCE_HZ, _BOUNCE_M_S2 = 1.9, 1.0  # vertical acceleration of what a walking person carries: amplitude
_SWAY_HZ, _SWAY_RAD = 0.7, 0.03  # of the hands, in roll and pitch
_TILT_RAD = 0.12  # largest tilt at which it is held


def carried(carriage: Carriage) -> Callable[[Event], Event]:
    """Return the function that shakes the IMU while the robot is carried; the IMU is taken to be level."""
    hands = {(a, b): _Hands(a, b, carriage) for a, b in carriage.intervals}

    def tell(event: Event) -> Event:
        assert isinstance(event, ImuEvent)
        interval = carriage.interval(event)
        return event if interval is None else hands[interval].shake(event, carriage.seconds(event))

    return tell


class _Hands:
    """Motion that hands add to the IMU in one interval: lift, tilt, sway and bounce."""

    def __init__(self, start_s: float, end_s: float, carriage: Carriage) -> None:
        rng = carriage.scene.rng
        self.start_s, self.end_s = start_s, end_s
        self._rise_s, self._height = min(carriage.rise_s, 0.5 * (end_s - start_s)), carriage.height_m
        self._tilt = rng.uniform(-_TILT_RAD, _TILT_RAD, 2)
        self._phase = rng.uniform(0.0, 2.0 * math.pi, 3)

    def shake(self, event: ImuEvent, t: float) -> ImuEvent:
        """Message with the motion of the hands added."""
        s = min(t - self.start_s, self.end_s - t) / self._rise_s  # 0 on the floor, 1 up
        up, rate, rises = _minimum_jerk(s)
        sign = 1.0 if t - self.start_s < self.end_s - t else -1.0
        swing = 2.0 * math.pi * _SWAY_HZ
        angles = self._phase[:2] + swing * t
        tilt = up * (self._tilt + _SWAY_RAD * np.sin(angles))
        turning = up * _SWAY_RAD * swing * np.cos(angles)
        turning = turning + sign * rate / self._rise_s * (self._tilt + _SWAY_RAD * np.sin(angles))
        vertical = self._height * rises / self._rise_s**2
        vertical += up * _BOUNCE_M_S2 * math.sin(2.0 * math.pi * _BOUNCE_HZ * t + self._phase[2])
        R = rpy_matrix(tilt[0], tilt[1], 0.0)
        force = R.T @ (event.linear_acceleration + np.array([0.0, 0.0, vertical]))
        rates = R.T @ event.angular_velocity + np.array([turning[0], turning[1], 0.0])
        return replace(event, angular_velocity=rates, linear_acceleration=force)


def _minimum_jerk(s: float) -> tuple[float, float, float]:
    """Height and its first and second derivative on the way from 0 to 1 in unit time.

    Source: Flash, Hogan 1985, "The coordination of arm movements".
    """
    if s >= 1.0:
        return 1.0, 0.0, 0.0
    return (
        10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5,
        30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4,
        60.0 * s - 180.0 * s**2 + 120.0 * s**3,
    )


GYRO = BuiltIn(
    name="gyro",
    installation=INSTALLATION,
    streams=(
        Stream(
            "imu",
            ImuEvent,
            {"sensor_msgs/msg/Imu": from_imu},
            ("imu", "imu/data"),
            validator=imu_validator,
            findings=ImuChecks,
        ),
    ),
    failing_as="imu",
    failures=(ImuBias,),
    carried=carried,
)
