"""What a built-in sensor is to the rest of fgloc beside its topics: odometer, rate sensor, motion model, raw landmarks.

There is one sensor for each role. Other modules ask the registry for the role, never for a sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from fgloc.sensors.base import MotionInstallation, MotionRole, RawMistake
from fgloc.sensors.noise_density import NoiseDensity
from fgloc.types import Event, FloatArray, LandmarkMap

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.detection import SensorDetector
    from fgloc.sensors.equipment import AttitudeSensor, ErrorCorrelation, MotionPredictor, Odometer, RateSensor


@dataclass(frozen=True, slots=True)
class OdometerErrors:
    """Error model of the odometer, as it is configured.

    Attributes:
        noise: white, by distance, rotation and time.
        scale_sigma: of the distance, as a share.
        turn_scale_sigma: of the rotation, as a share.
        yaw_per_m_sigma: rad/m.
        time_offset_sigma_s: of the clock.
    """

    noise: NoiseDensity
    scale_sigma: float
    turn_scale_sigma: float
    yaw_per_m_sigma: float
    time_offset_sigma_s: float


@dataclass(frozen=True, slots=True)
class RateErrors:
    """Error model of the rate sensor, as it is configured.

    Attributes:
        yaw_per_sqrt_s: white noise of the integrated rate [rad/√s].
        scale_sigma: as a share.
        bias_sigma: rad/s, before anything is known of the bias.
    """

    yaw_per_sqrt_s: float
    scale_sigma: float
    bias_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class SetupMistake:
    """What an excerpt of a recording shows to be wrong with the odometer's settings.

    Attributes:
        kind: ``radius``, ``track``, ``odometry_frame``, ``exchanged``, ``reversed`` or ``both_reversed``.
        factor: of radius and track: true over given.
        turned: of the others: what brings its twist ``(3,)`` into the base's axes, ``(3, 3)``.
        source: of its motion, as `Odometer.source` has it.
    """

    kind: str
    factor: float
    turned: FloatArray
    source: str


@dataclass(frozen=True, slots=True)
class OdometerRole:
    """Measures every step; what others are compared to.

    Attributes:
        installation: what it is off by.
        build: the odometer of one run; `ConfigError` where its settings do not fit together.
        errors: its error model.
        freed: settings with wide priors on its gains, to be calibrated; those for it alone, and, in this order where
            several are to be tried, those for control inputs in its place.
        distance_gain: the setting that sightings determine wherever the robot moves.
        correct: the sentence and the values that undo a mistake.
        by_angles: keys of ``wheels`` with their values, with which the wheels' angles among these events are used;
            None: the events do not determine them.
    """

    kind: ClassVar[MotionRole] = MotionRole.ODOMETER
    installation: MotionInstallation
    build: Callable[[Config], Odometer]
    errors: Callable[[Config], OdometerErrors]
    freed: Callable[[Config], tuple[Config, ...]]
    distance_gain: str
    correct: Callable[[SetupMistake, Config], RawMistake]
    by_angles: Callable[[Sequence[Event]], dict[str, Any] | None]


class AttitudeNames(NamedTuple):
    """Parameters of the installation that roll and pitch depend on, on uneven ground; each about x and y."""

    biases: tuple[str, str]  # of the rates [rad/s], in the axes of the base
    tilts: tuple[str, str]  # of the mounting, beside the given one [rad]
    levels: tuple[str, str]  # tilt that the accelerometer's bias makes [rad]


@dataclass(frozen=True, slots=True)
class RateRole:
    """Measures the turn alone.

    Attributes:
        installation: what it is off by.
        build: the sensor of one run, from all settings and the base's z axis ``(3,)`` in its frame.
        errors: its error model.
        is_used: whether it is to be used.
        scale: true over reported rate.
        attitude: what measures roll and pitch, from all settings and its mounting ``T_base_imu (4, 4)``.
        attitude_names: of the parameters that those depend on.
    """

    kind: ClassVar[MotionRole] = MotionRole.RATE
    installation: MotionInstallation
    build: Callable[[Config, FloatArray], RateSensor]
    errors: Callable[[Config], RateErrors]
    is_used: Callable[[Config], bool]
    scale: Callable[[Config], float]
    attitude: Callable[[Config, FloatArray], AttitudeSensor]
    attitude_names: AttitudeNames


@dataclass(frozen=True, slots=True)
class ModelRole:
    """Predicts the motion from control inputs.

    Attributes:
        installation: what it is off by.
        build: the model of one run, from all settings and what gives the base's z axis ``(3,)`` in the frame of the
            rate sensor (None: that is mounted level). None: no model is used. `ModelError` where it cannot be used.
        correlation: how the errors of odometer and model go together; None: they are taken as independent.
        given: settings with another model; `pydantic.ValidationError` where there is none of this name.
        without: settings by which none is used.
        left_out: what to tell the user where sightings contradicted the model for so long [s].
        shipped_name: ``shipped:NAME`` of a file that comes with the package; None for others.
    """

    kind: ClassVar[MotionRole] = MotionRole.MODEL
    installation: MotionInstallation
    build: Callable[[Config, Callable[[], FloatArray] | None], MotionPredictor | None]
    correlation: Callable[[Config, MotionPredictor], ErrorCorrelation | None]
    given: Callable[[Config, Path], Config]
    without: Callable[[Config], Config]
    left_out: Callable[[float], str]
    shipped_name: Callable[[Path], str | None]


@dataclass(frozen=True, slots=True)
class RawLandmarksRole:
    """Finds landmarks in raw data.

    Attributes:
        size: of landmarks for which the map gives none [m]; None: not known.
        dictionary: of the landmarks that are detected; None: the map's.
        given: settings with another dictionary and size; None: as they are.
        ids: how many ids a dictionary has; `ConfigError` where there is none of this name.
        sigma_px: noise of a corner, on each axis.
        detector: of one run; `ConfigError` where settings and map do not say what is to be detected.
        fitting_dictionary: the dictionary that fits the raw data of a recording; None if none does.
    """

    size: Callable[[Config], float | None]
    dictionary: Callable[[Config], str | None]
    given: Callable[[Config, str | None, float | None], Config]
    ids: Callable[[str], int]
    sigma_px: Callable[[Config], float]
    detector: Callable[[Config, LandmarkMap | None], SensorDetector]
    fitting_dictionary: Callable[[Any], str | None]


MotionSource = OdometerRole | RateRole | ModelRole


def with_values(config: Config, section: str, values: Mapping[str, Any]) -> Config:
    """Settings with other values in one section."""
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})
