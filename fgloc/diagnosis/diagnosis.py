"""The diagnosis of a run: observes its steps, and reports at the end what of the set-up does not fit together."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fgloc import se2
from fgloc.config import Config, Role
from fgloc.diagnosis.collect import SightingCollector, WindowCutter
from fgloc.diagnosis.floor import FloorWatch
from fgloc.diagnosis.frame_checks import first_pose_sentence
from fgloc.diagnosis.hypotheses import explanation
from fgloc.diagnosis.pool import Pool, Pooled
from fgloc.diagnosis.turning import GyroComparison, Turning
from fgloc.diagnosis.window import PRIOR_SIGMAS, PRIOR_SIGMAS_NO_MAP, Fault, Fit, Window, fit_window
from fgloc.sensors import registry
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.types import Camera, FloatArray, LandmarkMap, MotionMeasurement, Step

_SURE = 6.0  # sigmas: windows are few, and their errors are not quite independent
_MIN_WINDOWS = 4
_MIN_LATE_S = 0.03  # less is within what drivers mean by a stamp
_MIN_DRIFT_S = 0.03  # over the run
_MIN_SCALE = 0.03
_MIN_TURN = 0.03  # rad
_MIN_ARM_M = 0.05
_SAME_SCALE = 0.02
_PLAUSIBLE = 1.5  # times how large faults may be: what is larger stands in for something that is not modeled
_MODEL_S, _MODEL_SHARE, _MODEL_DEG, _MODEL_M = 0.003, 0.002, 0.2, 0.005  # what this model of a robot leaves out
_INCONSISTENT_SHARE, _INCONSISTENT_KEPT = 0.5, 6
_ALL_INCONSISTENT = 0.8  # without an explanation fewer may be the wheels' slipping


class Diagnosis:
    """Takes in the steps of a run, in bounded memory, whatever the estimator makes of them.

    It finds constant and drifting offsets between the clocks of sightings, wheels and gyro; wrong scales (focal length,
    marker size, map); a sensor that is not where its transform puts it; and a map that no motion fits. Only what is
    many sigmas from right, and matters, is reported.
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | None,
        camera: Camera | None,
        T_base_sensor: FloatArray | None,
        seen_by: Role,
        imu_up: FloatArray | None,
        floor: FloorWatch | None = None,
    ) -> None:
        """Set up for the sensors of a run.

        Args:
            config: as the run uses it.
            landmark_map: the known map; None if landmarks are estimated.
            camera: of corners; None if there is none.
            T_base_sensor: ``(4, 4)`` of a sensor that reports ranges or marker poses, as `LandmarkSensor` takes it.
            seen_by: role whose stamps the sightings have: "image" or "sightings".
            imu_up: ``(3,)`` the base's z axis in the IMU's frame; None: there is no gyro.
            floor: watches whether it is flat; None: it may be as it is.
        """
        self._floor = floor
        place = camera.T_base_cam if camera is not None else T_base_sensor
        self._config = config
        self._camera = camera is not None
        self._place: FloatArray = np.eye(4) if place is None else np.asarray(place, dtype=float)
        self._known: dict[int, FloatArray] | None = None
        if landmark_map is not None:
            self._known = {i: lm.position[:2] for i, lm in landmark_map.landmarks.items()}
        self._collector = SightingCollector(
            config, landmark_map, LandmarkSensor(config, landmark_map, camera, T_base_sensor), self._place
        )
        self._cutter = WindowCutter()
        self._faults = Pool(PRIOR_SIGMAS if landmark_map is not None else PRIOR_SIGMAS_NO_MAP)
        self._seen_by = seen_by
        self._gyro = GyroComparison(imu_up)
        self._inconsistent: list[Window] = []
        self._inconsistent_count = 0
        self._tried = 0
        self._started: FloatArray | None = None  # where the sightings put the run's first pose

    def observe(self, step: Step, wheels: MotionMeasurement | None, by_hand: bool = False) -> None:
        """Take in a step.

        Args:
            step: as the localizer got it.
            wheels: their motion over the step; None without a measurement.
            by_hand: a person has the robot in hand: its wheels do not measure where it goes.
        """
        if self._floor is not None:
            self._floor.observe(step, by_hand)
        if by_hand:
            wheels = None
        self._cutter.begin(step)
        for event in step.sightings:
            at_s = self._cutter.seconds(event.stamp_ns)
            if self._cutter.wants(at_s):
                for sighting in self._collector.sightings(event, at_s):
                    self._cutter.add_sighting(sighting)
        for imu in step.inertial:
            self._gyro.record(imu, self._cutter.seconds(imu.stamp_ns))
        travelled = self._cutter.travelled
        window = self._cutter.move(step, None if wheels is None else wheels.motion)
        if window is not None:
            slipped = self._gyro.compare(window)
            if not slipped:
                self._judge(window, travelled, step.segment)

    def _judge(self, window: Window, travelled: FloatArray, segment: int) -> None:
        fit = fit_window(window, self._place, self._known)
        if fit is None:
            return
        self._tried += 1
        if fit.inconsistent:
            self._inconsistent_count += 1
            if len(self._inconsistent) < _INCONSISTENT_KEPT:
                self._inconsistent.append(window)
            return
        self._faults.add(fit.evidence)
        if self._started is None and segment == 0 and self._known is not None:
            self._started = _start(fit, travelled)

    # --- the report ---

    def clock_offsets(self, source: str) -> dict[str, float]:
        """Values of ``recording.stamp_offset_s`` by role, as the windows suggest them; to be tried."""
        if source not in ("ticks", "odometry"):
            return {}
        known = {str(role): offset for role, offset in self._config.recording.stamp_offset_s.items()}
        off = self._offsets(self._faults.constant(), source)
        return {role: known.get(role, 0.0) - late for role, _, late, _, _ in off}

    @property
    def mistakes(self) -> tuple[str, ...]:
        """What is surely wrong with the configuration, and makes the poses wrong: a sentence each."""
        sentence = None if self._floor is None else self._floor.sentence
        return () if sentence is None else (sentence,)

    def notes(self, source: str, offsets: bool = True) -> tuple[str, ...]:
        """What does not fit together, a sentence each with its remedy.

        Args:
            source: where wheel motion came from: "ticks", "odometry", "command" or "".
            offsets: report constant offsets of clocks too; they have not been tried.
        """
        if self._known is not None and self._inconsistent_count > _INCONSISTENT_SHARE * max(self._tried, 3):
            found = explanation(self._inconsistent, self._place, self._known, self._camera)
            share = f"in {self._inconsistent_count} of {self._tried} stretches of the run"
            if found is not None:
                return (f"Map, sightings and wheel motion contradict each other {share}; they agree if {found}.",)
            if self._inconsistent_count > _ALL_INCONSISTENT * self._tried:
                return (
                    f"Map, sightings and wheel motion contradict each other {share}, and no single mistake of the "
                    "set-up explains it: check the map's positions, the sensor's transform, the wheels' geometry, "
                    "and whether they slip.",
                )
        faults = self._faults.constant()
        notes = [*self._clocks(faults, source, offsets), *self._first_pose()]
        plausible = bool((np.abs(faults.values) < _PLAUSIBLE * PRIOR_SIGMAS).all())
        if self._known is not None and plausible:
            notes += [*self._scales(faults), *self._mounting(faults)]
        return tuple(notes)

    def _clocks(self, faults: Pooled, source: str, offsets: bool) -> Iterator[str]:
        if source not in ("ticks", "odometry"):  # a robot follows its commands late: that is no clock's fault
            return
        drifts = [*self._drifts()]
        yield from drifts
        if offsets and not drifts:
            for role, name, late, sigma, others in self._offsets(faults, source):
                yield self._offset(role, name, late, sigma, others)

    def _drifts(self) -> Iterator[str]:
        yield from self._drift(self._faults, Fault.LATE, "sightings")
        yield from self._drift(self._gyro.pool, Turning.LATE, registry.motion_names().rate)

    def _offsets(self, faults: Pooled, source: str) -> Iterator[tuple[Role, str, float, float, str]]:
        """Role, name, lateness and its sigma [s], and the clocks that it is late against; none if a clock drifts."""
        if any(self._drifts()):  # then there is no constant offset to be set
            return
        gyro, names = self._gyro.pool.constant(), registry.motion_names()
        late, late_sigma = faults.values[Fault.LATE], faults.sigmas[Fault.LATE]
        gyro_late, gyro_sigma = gyro.values[Turning.LATE], gyro.sigmas[Turning.LATE]
        sightings_off = _sure(faults, Fault.LATE, _MIN_LATE_S)
        gyro_off = _sure(gyro, Turning.LATE, _MIN_LATE_S)
        wheels: Role = "joints" if source == "ticks" else "odometry"
        same = abs(late - gyro_late) < max(_MIN_LATE_S, 3.0 * math.hypot(late_sigma, gyro_sigma))
        if sightings_off and gyro_off and same:
            yield wheels, names.odometer, -float(gyro_late), float(gyro_sigma), "sightings and gyro"
        else:
            if sightings_off:
                yield self._seen_by, "sightings", float(late), float(late_sigma), names.odometer
            if gyro_off:
                yield "imu", names.rate, float(gyro_late), float(gyro_sigma), names.odometer

    def _offset(self, role: Role, name: str, late_s: float, sigma_s: float, others: str) -> str:
        known = self._config.recording.stamp_offset_s.get(role, 0.0)
        sigma_s = math.hypot(sigma_s, _MODEL_S)
        return (
            f"The stamps of the {name} are {abs(late_s):.3f} ± {sigma_s:.3f} s {'late' if late_s > 0 else 'early'} "
            f"against the {others}: set recording.stamp_offset_s: {{{role}: {known - late_s:.3f}}}."
        )

    def _drift(self, pool: Pool, i: int, name: str) -> Iterator[str]:
        drifting = pool.drifting(i)
        slope, sigma = float(drifting.values[-1]), float(drifting.sigmas[-1])
        over_run = slope * pool.span_s
        if drifting.windows > _MIN_WINDOWS and abs(slope) > _SURE * sigma and abs(over_run) > _MIN_DRIFT_S:
            yield (
                f"The clock of the {name} drifts against the wheels' by {1e3 * slope:+.2f} ± {1e3 * sigma:.2f} ms/s "
                f"({over_run:+.3f} s over the run): synchronize the clocks, or list its role in "
                "recording.received_stamps."
            )

    def _scales(self, faults: Pooled) -> Iterator[str]:
        if self._camera and _sure(faults, Fault.DEPTH, _MIN_SCALE):
            depth, sigma = faults.values[Fault.DEPTH], math.hypot(faults.sigmas[Fault.DEPTH], _MODEL_SHARE)
            yield (
                f"The camera's focal length has to be {math.exp(depth):.3f} ± {sigma:.3f} times what is given, by map "
                "and odometry: calibrate it."
            )
        scale, wheels = faults.values[Fault.SCALE], faults.values[Fault.WHEEL_SCALE]
        if not _sure(faults, Fault.SCALE, _MIN_SCALE):
            return
        sigma = math.hypot(faults.sigmas[Fault.SCALE], _MODEL_SHARE)
        if _sure(faults, Fault.WHEEL_SCALE, _MIN_SCALE) and abs(scale - wheels) < _SAME_SCALE:
            yield (
                f"Distances on the map are {math.exp(scale):.3f} ± {sigma:.3f} times those that wheels and sightings "
                "agree on: the map's scale is wrong."
            )
            return
        remedy = f"the markers' size has to be {math.exp(scale):.3f} times what is given"
        if not self._camera:
            remedy = f"set landmarks.range_scale: {self._config.landmarks.range_scale * math.exp(scale):.3f}"
        yield (
            f"Sightings are {math.exp(-scale):.3f} ± {sigma:.3f} times as far as map and odometry have it: {remedy}."
        )

    def _mounting(self, faults: Pooled) -> Iterator[str]:
        if _sure(faults, Fault.TURN, _MIN_TURN):
            turn, sigma = np.degrees([faults.values[Fault.TURN], faults.sigmas[Fault.TURN]])
            sigma = math.hypot(sigma, _MODEL_DEG)
            side = "right" if turn > 0 else "left"  # what lies to the left of where it looks has a positive bearing
            yield (
                f"The sensor of the sightings looks {abs(turn):.1f} ± {sigma:.1f}° further {side} than its transform "
                "says: correct it, or recording.sightings_pose."
            )
        for fault, (plus, minus) in ((Fault.FORWARD, ("forward", "back")), (Fault.LEFT, ("left", "right"))):
            if _sure(faults, fault, _MIN_ARM_M):
                arm, sigma = faults.values[fault], math.hypot(faults.sigmas[fault], _MODEL_M)
                yield (
                    f"The sensor of the sightings sits {abs(arm):.2f} ± {sigma:.2f} m further "
                    f"{plus if arm > 0 else minus} than its transform says: correct it, or recording.sightings_pose."
                )

    def _first_pose(self) -> Iterator[str]:
        """A first pose that was given and is not where the sightings put it: one of the two frames is shifted."""
        sentence = None if self._started is None else first_pose_sentence(self._config, self._started)
        if sentence is not None:
            yield sentence


def _sure(pooled: Pooled, i: int, least: float) -> bool:
    """Whether a parameter is certainly not zero, and large enough to matter."""
    value = abs(float(pooled.values[i]))
    return pooled.windows >= _MIN_WINDOWS and value > max(least, _SURE * float(pooled.sigmas[i]))


def _start(fit: Fit, travelled: FloatArray) -> FloatArray:
    """The run's first pose, if the window's first pose was reached by this motion ``(3,)``."""
    return se2.compose(fit.place, se2.inverse(travelled))
