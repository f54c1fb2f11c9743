"""Tests for faults: motion sources that differ, which is wrong, a lasting bias, a robot that is carried."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from fgloc import se2
from fgloc.config import Config, WeightsConfig
from fgloc.estimation.pose_fit import Fit, fit_pose
from fgloc.graph.estimators import Estimator
from fgloc.graph.joint import MOST_JOINT
from fgloc.graph.measurement_log import Keyframe
from fgloc.graph.noise import COVARIANCE_FACTOR, NoiseBudget
from fgloc.graph.observation import Lines
from fgloc.sensors.wheels.motion import commanded_to_move, is_standing
from fgloc.stats import GATE, alarm_bound, chi2_bound
from fgloc.types import Decision, FloatArray, MotionMeasurement, MotionReadings, Step

# --- Motion sources that differ: a generalized likelihood ratio test --------------------------------------------------

_MEDIAN = chi2_bound(0.5, se2.DOF)  # of the NIS of a step, if the covariances are as given


@dataclass(frozen=True, slots=True)
class GlrResult:
    """Result of the GLR test for the newest step.

    Attributes:
        flagged: whether the sources disagree now.
        since: on the step that raises the flag, how many of the newest steps (this one included) the disagreement
            spans; else 0.
        nis: largest NIS of any window that ends with this step, over what is usual.
        bound: above which it raises the flag.
        span: the number of that window's steps.
        scale: factor on the sources' covariances: the NIS over its expectation, or the usual level if that is larger.
    """

    flagged: bool
    since: int
    nis: float
    bound: float
    span: int = 1
    scale: float = 1.0


class GlrTest:
    """Compares two motion sources over all windows up to a length at once.

    A single step has little power (encoder quantization alone exceeds its bound), a long window detects late. The
    test takes, of all windows that end now, the one whose summed difference is least likely; its beginning is the most
    likely onset of the fault. A flag is taken back after the newest steps have agreed for a while.

    Source: Willsky and Jones 1976, generalized likelihood ratio for a jump of unknown time; docs/decisions/0003.
    """

    def __init__(self, config: WeightsConfig) -> None:
        self._config = config
        self.flagged = False
        self._usual = _MEDIAN  # median of the NIS of a step
        self._steps: deque[tuple[float, FloatArray, FloatArray, FloatArray]] = deque()  # dt, value, cov, derivative
        self._length_s = self._calm_s = 0.0

    def reset(self) -> None:
        """Forget all steps, as nothing connects them with those to come."""
        self.flagged = False
        self._steps.clear()
        self._length_s = self._calm_s = 0.0

    def judge(
        self,
        dt: float,
        difference: FloatArray,
        cov: FloatArray,
        by_installation: FloatArray | None = None,
        installation_cov: FloatArray | None = None,
    ) -> GlrResult:
        """Add one step and test all windows that end with it.

        Args:
            dt: its length [s].
            difference: ``(3,)`` in the body frame. Summed as it is: over a window the body hardly moves by more than a
                metre, and the position error of a yaw difference over so short a way is small beside the yaw's own.
            cov: ``(3, 3)`` of it if both sources are right.
            by_installation: ``(3, p)`` its derivative by what is wrong in the same way all the time.
            installation_cov: ``(p, p)`` of that.
        """
        D = np.zeros((3, 0)) if by_installation is None else by_installation
        self._installation_cov = np.zeros((0, 0)) if installation_cov is None else installation_cov
        self._steps.append((dt, difference, cov, D))
        self._length_s += dt
        while len(self._steps) > 1 and self._length_s - self._steps[0][0] >= self._config.window_s:
            self._length_s -= self._steps.popleft()[0]
        of_windows = self._nis_of_windows()
        if not self.flagged:
            moved = math.copysign(dt / self._config.window_s, of_windows[0] - self._usual)
            self._usual = min(max(self._usual * math.exp(moved), _MEDIAN / COVARIANCE_FACTOR), _MEDIAN)
        span = int(np.argmax(of_windows)) + 1
        nis = float(of_windows[span - 1]) / self._level
        bound = alarm_bound(dt, len(self._steps), se2.DOF)
        if not self.flagged:
            if nis <= bound:
                return GlrResult(False, 0, nis, bound, span, max(self._level, nis / se2.DOF))
            self.flagged, self._calm_s = True, 0.0
            return GlrResult(True, span, nis, bound, span)
        agrees = self._newest_nis() / self._level < chi2_bound(GATE, se2.DOF)
        self._calm_s = self._calm_s + dt if agrees else 0.0
        if self._calm_s >= self._config.release_s:
            self.reset()
        return GlrResult(self.flagged, 0, nis, bound, span)

    @property
    def _level(self) -> float:
        """How large differences are while nothing is wrong, as a share of their covariances."""
        return self._usual / _MEDIAN

    def _nis_of_windows(self) -> FloatArray:
        """NIS ``(n,)`` of each window that ends now, the shortest first."""
        differences = np.cumsum([d for _, d, _, _ in reversed(self._steps)], axis=0)
        covs = np.cumsum([S for _, _, S, _ in reversed(self._steps)], axis=0)
        D = np.cumsum([D for _, _, _, D in reversed(self._steps)], axis=0)
        covs = covs + D @ self._installation_cov @ D.transpose(0, 2, 1)
        return np.asarray(np.einsum("ni,ni->n", differences, np.linalg.solve(covs, differences[:, :, None])[:, :, 0]))

    def _newest_nis(self) -> float:
        """NIS of the newest steps, as many as the release takes."""
        seconds = np.cumsum([dt for dt, *_ in reversed(self._steps)])
        steps = int(np.searchsorted(seconds, self._config.release_s)) + 1
        return float(self._nis_of_windows()[:steps][-1])


@dataclass(frozen=True, slots=True)
class FaultVerdict:
    """Verdict of the GLR test: faulty sources, covariance scales, onset.

    Attributes:
        budget: which of them are rejected and why, or the scale on their covariances.
        earlier: what was found out of the newest steps, this one included ...
        span: ... and of how many of them ...
        doubted: ... or of how many since wheels and model were doubted first, but for those with another judgement.
        nis: of the difference of wheels and reference source over the least likely window; NaN without one.
        threshold: that ``nis`` is held against.
    """

    budget: NoiseBudget = field(default_factory=NoiseBudget)
    earlier: NoiseBudget = field(default_factory=NoiseBudget)
    span: int = 1
    doubted: int = 0
    nis: float = math.nan
    threshold: float = math.nan


# --- Which of two motion sources is wrong -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Contradicted:
    """Motion sources that sightings contradict, and for how many steps.

    Attributes:
        sources: of the motion, by name.
        steps: for how many of the newest steps this holds.
    """

    sources: frozenset[str] = frozenset()
    steps: int = 1


class FaultAttribution:
    """Compares wheels and learned motion with how far the robot went by sightings alone.

    Two sources that differ do not say which of them is wrong. A third one does: the poses that sightings give by
    themselves where the difference began and now. Wheels slip now and then, while a model that is of another robot, or
    of another floor, is wrong all the time.

    Source: Gertler 1998, "Fault detection and diagnosis in engineering systems", structured residuals.

    Attributes:
        memory_s: how far back the log goes [s].
    """

    def __init__(self, config: Config, estimator: Estimator) -> None:
        """Set up for the estimator, whose log has the readings and sightings of the newest keyframes."""
        self.memory_s = config.estimator.lag_s
        self._config = config
        self._estimator = estimator
        self._fits: dict[int, Fit | None] = {}

    def contradicted(self, steps: int | None) -> Contradicted | None:
        """Which of wheels, learned motion and odometries beside them sightings contradict over the newest keyframes.

        Args:
            steps: for how many the sources differ, the last of them is not in the log yet; None: over a whole window.

        Returns:
            None if sightings cannot tell; without a map none tells a pose by itself.
        """
        frames = self._stretch(steps) if self._estimator.factors.known else None
        if frames is None:
            return None
        self._fits = {k: fit for k, fit in self._fits.items() if k >= frames[0].k}
        first, last = self._fit(frames[0]), self._fit(frames[-1])
        if first is None or last is None:
            return None
        went = se2.between(first.pose, last.pose)
        cov = se2.compose_cov(first.cov, went, last.cov)
        bound = chi2_bound(self._config.estimator.gate_probability, se2.DOF)
        wrong = set()
        beside = {m.source: 1.0 for frame in frames[1:] for m in frame.readings.beside}
        for name, factor in {"wheels": 1.0, "learned": COVARIANCE_FACTOR, **beside}.items():
            motions = [_of(f.readings, name) for f in frames[1:]]
            known = [replace(m, cov=factor * m.cov) for m in motions if m is not None]
            if len(known) == len(motions) and self._nis(known, went, cov) > bound:
                wrong.add(name)
        return Contradicted(frozenset(wrong), self._estimator.k + 1 - frames[0].k)

    def _stretch(self, steps: int | None) -> list[Keyframe] | None:
        """Keyframes from the last one with sightings before the difference to the newest one with sightings."""
        log, newest = self._estimator.log.keyframes, self._estimator.k
        stretch: list[Keyframe] = []
        for k in range(newest, -1, -1):
            frame = log.get(k)
            if frame is None:
                return None
            seen = bool(frame.sightings or frame.rejected)
            began = steps is not None and k <= newest + 1 - steps
            if began and not stretch:  # nothing was seen since they differ
                return None
            if seen or stretch:
                stretch.append(frame)
            age_s = self._estimator.elapsed_s - frame.elapsed_s
            if len(stretch) > 1 and seen and (began or age_s >= self._config.weights.window_s):
                return stretch[::-1]
            if frame.prior is not None or age_s > self.memory_s:
                return None
        return None

    def _fit(self, frame: Keyframe) -> Fit | None:
        """The pose that a keyframe's sightings give by themselves, where they check each other."""
        if frame.k not in self._fits:
            sightings = [s.alone for s in (*frame.sightings, *frame.rejected)]
            fit = fit_pose(frame.belief.pose, sightings, self._estimator.factors)
            checked = fit is not None and fit.is_checked(self._config.estimator.gate_probability)
            self._fits[frame.k] = fit if checked else None
        return self._fits[frame.k]

    def _nis(self, motions: Sequence[MotionMeasurement], went: FloatArray, cov: FloatArray) -> float:
        """NIS of the difference between the motion of a source and ``went (3,)``, which has ``cov (3, 3)``."""
        total, cov_total = motions[0].motion, motions[0].cov
        by: dict[str, FloatArray] = {name: d for name, (d, _) in motions[0].depends_on.items()}
        for _, m in pairwise(motions):
            back = se2.adjoint(se2.inverse(m.motion))
            by = {name: back @ d for name, d in by.items()}
            for name, (d, _) in m.depends_on.items():
                by[name] = by.get(name, np.zeros(3)) + d
            total, cov_total = se2.compose(total, m.motion), se2.compose_cov(cov_total, m.motion, m.cov)
        factors = self._estimator.factors
        rows = [factors.installation.index[name] for name in by]
        D = np.array(list(by.values())).reshape(len(by), 3).T
        cov_total = cov_total + cov + D @ factors.estimated.cov[np.ix_(rows, rows)] @ D.T
        miss = se2.log(se2.between(total, went))
        return float(miss @ np.linalg.solve(cov_total, miss))


def _of(readings: MotionReadings, name: str) -> MotionMeasurement | None:
    """Motion of a source by its name; None: it has none."""
    return next((m for m in (readings.wheels, readings.learned, *readings.beside) if m and m.source == name), None)


# --- A bias that lasts ------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class _Window:
    stamps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=MOST_JOINT))
    innovations: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=MOST_JOINT))
    prediction: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=MOST_JOINT))


class InnovationBias:
    """The newest innovations of each source and target."""

    def __init__(self, probability: float, window_s: float) -> None:
        """Set the probability with which sound measurements pass, and the silence [s] after which all is forgotten.

        What is older than such a silence may be of another place. `MOST_JOINT` innovations show a bias from one sigma
        on; one of half a sigma, as a survey leaves it, passes however long it lasts.
        """
        self._probability, self._window_ns = probability, round(window_s * 1e9)
        self._windows: dict[Hashable, _Window] = {}

    def forget(self) -> None:
        """Forget all innovations, as the pose was set anew."""
        self._windows.clear()

    def is_biased(self, key: Hashable, stamp_ns: int, one: Lines, pose_cov: FloatArray) -> bool:
        """Add an innovation that passed the gate; whether the newest ones together do not.

        Their own noise is white. What is not known of the pose is taken to be the same in all of them.

        Args:
            key: `LandmarkMeasurement.bias_key`.
            stamp_ns: of the measurement; asked again of the same one, it counts once.
            one: the measurement alone, at the predicted pose.
            pose_cov: ``(3, 3)`` of the prediction.
        """
        held = self._windows.setdefault(key, _Window())
        while held.stamps_ns and not 0 < stamp_ns - held.stamps_ns[-1] < self._window_ns:
            if stamp_ns - held.stamps_ns[-1] >= self._window_ns:
                self._windows[key] = held = _Window()
                break
            for column in (held.stamps_ns, held.innovations, held.prediction):
                column.pop()
        held.stamps_ns.append(stamp_ns)
        held.innovations.append(one.residual)
        held.prediction.append(np.hstack([one.H[:, :3] @ np.linalg.cholesky(pose_cov), one.shared]))
        if len(held.stamps_ns) < 2 or len({part.shape for part in held.prediction}) > 1:
            return False
        total, common = np.sum(held.innovations, axis=0), np.sum(held.prediction, axis=0)
        cov = len(held.stamps_ns) * np.eye(len(total)) + common @ common.T
        return bool(total @ np.linalg.solve(cov, total) > chi2_bound(self._probability, len(total)))


# --- A robot that is lifted or pushed ---------------------------------------------------------------------------------

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
_APART_S = 5.0  # between two signs of one handling: nobody sets a robot down for less
_SETTLED_S = 2.0  # after the last sign: a sighting then ends it
_SPARSE_S = 0.25  # a sample of the IMU stands for no longer


class LiftMonitor:
    """Watches for a robot that is carried.

    Attributes:
        carried: the robot may be in the air, or was set down a short time ago.
    """

    def __init__(self, longest_s: float, up: FloatArray | None = None) -> None:
        """Begin without data.

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
        self._sure_s = math.inf  # since the last that the ground cannot make

    def observe(self, k: int, step: Step, readings: MotionReadings) -> list[Decision]:
        """Add a step; return rows of ``steps.csv`` while the robot is carried.

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
        # Rough ground and skidding throw a robot that drives as hands do
        drives = moving and readings.wheels is not None
        sure = [d for d in told if not (drives and d.reason == "vertical_velocity")]
        self._sure_s = 0.0 if sure else self._sure_s + step.dt
        if self._sure_s > _APART_S:
            told = []
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
        """Time [s] that the robot was carried since the last fix, before this step, which is added."""
        before, self._since_fix_s = self._since_fix_s, self._since_fix_s + step.dt
        return before

    def fix(self) -> None:
        """Note that sightings have fixed the pose."""
        self._since_fix_s = 0.0
        if self._quiet_s > _SETTLED_S:
            self.carried = False

    def reset(self) -> None:
        """Forget all steps, as the clock jumped."""
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
        """Whether the usual level of this run is known."""
        return self._learned_s > _LEARN_S

    def skip(self, step: Step) -> None:
        """Forget the samples of the window, as the robot is in the other state, driving or standing."""
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
        if each > _SPARSE_S:  # one sample does not tell what a silence held
            self.skip(step)
            return 0.0, math.inf
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
        sparse = step.dt > _SPARSE_S * len(new)
        if self._up is None or readings.wheels is None or frozen or sparse or not np.isfinite(new).all():
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
