"""Data that cross module borders: events, steps, maps, measurements, findings, results.

Data flow one way: ``Event → validation → Step → Measurement → association → factor → Estimate``. Everything here is
frozen. Times are ``stamp_ns`` (when the sensor measured) and ``received_ns`` (when the recorder got it), both integers;
everything else is SI. Arrays are float64 or int64, and are not to be written to.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.errors import FglocError, TrajectoryError

MAX_LANDMARK_ID = 2**31 - 1  # int32 of the messages; the graph's keys have room for 56 bits


FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

WHOLE_NS = "expected a whole number of nanoseconds: of seconds, give round(seconds * 1e9)"


def whole_ns(stamp: Any, error: type[FglocError]) -> int:
    """Time [ns] as an integer.

    Raises:
        FglocError: of the given class: it is not a whole number, as a time in seconds.
    """
    try:
        whole = int(stamp)
        if whole == stamp and abs(whole) < 2**63:
            return whole
    except (TypeError, ValueError, OverflowError):
        pass
    raise error(f"stamp {stamp!r}; {WHOLE_NS}")


# --- Events: one message (or one transform of one) as recorded, before validation -------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """One message of a recording or a live stream."""

    stamp_ns: int
    received_ns: int
    topic: str


@dataclass(frozen=True, slots=True, eq=False)
class MotionEvent(Event):
    """Event of a motion source: it holds over time and is integrated over steps, at its own stamps."""

    @property
    def publisher(self) -> tuple[str, ...]:
        """Identity among the publishers that share the topic, each with a clock of its own."""
        return ()

    @property
    def base_frame_id(self) -> str:
        """The robot's base frame, if the message names it."""
        return ""

    @property
    def odometer(self) -> OdometerPose | None:
        """The pose that the source has integrated itself; None: it gives none."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class OdometerPose:
    """Pose of the base in a frame of the source's own, and the twist there."""

    frame_id: str
    pose: FloatArray  # (3,); NaN where it is not known
    twist: FloatArray  # (3,) in the body frame: m/s, m/s, rad/s; NaN where it is not known


@dataclass(frozen=True, slots=True, eq=False)
class ControlEvent(MotionEvent):
    """Control input: the commanded velocity. It holds until the next."""

    v: float  # m/s, forward
    omega: float  # rad/s, counter-clockwise
    vy: float = 0.0  # m/s, to the left: of drives that go sideways
    steering: float | None = None  # rad, of the steered wheels in place of the yaw rate; None: it is given


@dataclass(frozen=True, slots=True, eq=False)
class InertialEvent(MotionEvent):
    """Rates and specific forces in the axes of an inertial unit."""

    frame_id: str
    angular_velocity: FloatArray  # (3,) rad/s
    linear_acceleration: FloatArray  # (3,) m/s²


@dataclass(frozen=True, slots=True, eq=False)
class RawEvent(Event):
    """Data in which a detector still has to find the landmarks."""

    frame_id: str

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, if the message names them."""
        return None

    @property
    def empty(self) -> bool:
        """Whether there is no data."""
        return False

    def decoded_size(self) -> tuple[int, int] | None:
        """Width and height of the decoded data; None if it cannot be decoded."""
        return self.size


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """One landmark in one message; subclasses say how it was seen."""

    landmark_id: int

    def place(self) -> FloatArray | None:
        """Position ``(3,)`` in the sensor's axes, if the message gives it."""
        return None

    def distance(self) -> float | None:
        """Distance from the sensor [m], if the message gives it."""
        return None

    def noisy(self, sigmas: Mapping[str, float], rng: np.random.Generator) -> Sighting:
        """With white noise on its numbers, as ``fgloc ablate`` adds it.

        Args:
            sigmas: by kind of number: ``corner_px``, ``range_m``, ``bearing_rad``, ``position_m``; 0: none.
            rng: of the noise.
        """
        return self


@dataclass(frozen=True, slots=True, eq=False)
class SightingsEvent(Event):
    """Landmarks that were seen at one time. Made anew as a keyframe, or moved to one."""

    in_pixels: ClassVar[bool] = False  # whether it takes a calibrated camera to make measurements of them

    frame_id: str
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SensorEvent(Event):
    """One message of a registered sensor (`fgloc.sensors.base`); a subclass says what is in it."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfoEvent(Event):
    """``sensor_msgs/CameraInfo``."""

    frame_id: str
    width: int
    height: int
    distortion_model: str
    K: FloatArray  # (3, 3)
    D: FloatArray  # (n,)
    P: FloatArray | None = None  # (3, 4) of the rectified image
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)  # x, y, width, height of the part that images show; 0: all of it
    binning: tuple[int, int] = (1, 1)  # pixels of the calibration to one of the images, across and down

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the images, where they are a part of what was calibrated, or binned."""
        _, _, width, height = self.roi
        return (width or self.width) // self.binning[0], (height or self.height) // self.binning[1]


@dataclass(frozen=True, slots=True, eq=False)
class TransformEvent(Event):
    """One transform of ``/tf`` or ``/tf_static``: ``T_parent_child``."""

    parent: str
    child: str
    translation: FloatArray  # (3,)
    rotation: FloatArray  # (4,) quaternion x, y, z, w
    static: bool


@dataclass(frozen=True, slots=True, eq=False)
class TruthEvent(Event):
    """Pose from an external positioning system. Never reaches the estimator."""

    frame_id: str
    position: FloatArray  # (3,)
    orientation: FloatArray  # (4,) quaternion x, y, z, w
    has_yaw: bool = True  # False: the orientation says nothing


# --- Steps: all events between two keyframes --------------------------------------------------------------------------

M = TypeVar("M", bound=MotionEvent)


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)  # sensors remember what they made of it
class Step:
    """Events received between two keyframes, validated and in order of stamp.

    Each tuple of ``motion`` holds what is needed to integrate over ``[start_ns, stamp_ns]``: the events inside, the
    last one at or before the start, and the first one at or after the end where known. Control inputs reach back
    ``history_s`` further. ``sightings`` were made at ``stamp_ns`` (the keyframe) or, arriving late, at their own stamps
    in the lag.
    """

    index: int
    segment: int  # counts up where the clock jumped; a new segment shares no motion with the one before
    start_ns: int
    stamp_ns: int
    motion: Mapping[type[MotionEvent], tuple[MotionEvent, ...]] = field(default_factory=dict)  # by class of event
    sightings: tuple[SightingsEvent, ...] = ()
    sensed: tuple[SensorEvent, ...] = ()  # of registered sensors, at their own stamps like late sightings

    @property
    def dt(self) -> float:
        """Length of the step [s]."""
        return (self.stamp_ns - self.start_ns) * 1e-9

    def of(self, kind: type[M]) -> tuple[M, ...]:
        """The motion events of a class, or of the one class derived from it that the robot has."""
        for made, events in self.motion.items():
            if issubclass(made, kind):
                return events  # type: ignore[return-value]
        return ()

    @property
    def controls(self) -> tuple[ControlEvent, ...]:
        """Control inputs."""
        return self.of(ControlEvent)

    @property
    def inertial(self) -> tuple[InertialEvent, ...]:
        """Events of the inertial unit."""
        return self.of(InertialEvent)


def by_class(events: Iterable[MotionEvent]) -> dict[type[MotionEvent], tuple[MotionEvent, ...]]:
    """Motion events as a step holds them, in the order in which they are given."""
    made: dict[type[MotionEvent], list[MotionEvent]] = {}
    for event in events:
        made.setdefault(type(event), []).append(event)
    return {kind: tuple(same) for kind, same in made.items()}


# --- Cameras, landmarks and their maps --------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Intrinsics and mounting.

    ``model`` is ``"plumb_bob"`` (D: k1 k2 p1 p2 [k3]), ``"rational_polynomial"`` (D: k1 k2 p1 p2 k3 k4 k5 k6) or
    ``"equidistant"`` (fisheye, D: k1 k2 k3 k4). A width and height of 0 say that the calibration names no image size.
    """

    width: int
    height: int
    model: str
    K: FloatArray  # (3, 3)
    D: FloatArray  # (n,)
    T_base_cam: FloatArray  # (4, 4), cam is the optical frame: z forward, x right, y down
    frame_id: str = ""
    notes: tuple[str, ...] = ()  # what was assumed when the calibration was read
    name: str = ""  # of one among several
    topics: tuple[str, ...] = ()  # of its images, or of the corners found in them; empty: whatever there is


def camera_of(cameras: Iterable[Camera], topic: str) -> Camera | None:
    """Camera whose images or corners a topic has; None: none of them."""
    return next((camera for camera in cameras if not camera.topics or topic in camera.topics), None)


@dataclass(frozen=True, slots=True, eq=False)
class Board:
    """A rigid board of markers: they are displaced together, as the board is."""

    cov: FloatArray | None  # (6, 6) of its position in the map frame and its rotation about its own axes; None: unknown
    sigma_m: float  # of each marker's place on the board, along each axis


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A marker or beacon of the map.

    ``size_m`` is the side of the black square, 0 if the landmark is a point; ``rotation`` is of the marker frame: x to
    the marker's right as seen, y to its top, z out of its face towards the viewer.
    """

    landmark_id: int
    position: FloatArray  # (3,) m in the map frame
    rotation: FloatArray  # (3, 3) R_map_marker; identity for a point
    size_m: float
    cov: FloatArray | None = None
    """Of x, y ``(2, 2)``, of x, y, z ``(3, 3)`` in the map frame, or ``(6, 6)`` of these and the rotation [rad] about
    the marker's own axes; None: not known."""
    board: tuple[Board, FloatArray] | None = None
    """The board that it is on, and the derivative ``(6, 6)`` of its pose by the board's, each as ``cov`` has them."""

    @property
    def is_point(self) -> bool:
        """Whether it is a point, without an orientation."""
        return self.size_m == 0.0 and np.array_equal(self.rotation, np.eye(3))

    def corners(self) -> FloatArray:
        """Corners ``(4, 3)`` in the map frame, in the order of MarkerCorners."""
        h = 0.5 * self.size_m
        local = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
        return np.asarray(self.position + local @ self.rotation.T)

    @property
    def planar(self) -> FloatArray:
        """Planar pose ``(3,)`` x, y, yaw: yaw of the face normal if the marker stands, of its x axis if it lies."""
        axis = self.rotation[:, 2] if abs(self.rotation[2, 2]) < 0.7 else self.rotation[:, 0]
        return np.array([self.position[0], self.position[1], np.arctan2(axis[1], axis[0])])


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """Landmarks by id; ``dictionary`` is OpenCV's name (``"DICT_4X4_50"``) or empty."""

    landmarks: Mapping[int, Landmark]
    dictionary: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()  # what was assumed or left out when the file was read

    def __contains__(self, landmark_id: int) -> bool:
        return landmark_id in self.landmarks

    def __len__(self) -> int:
        return len(self.landmarks)


# --- Measurements of motion, computed by sensors from events; factors are made of them --------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class InertialReading:
    """Measurement of an inertial unit over one step on uneven ground, in the axes of the base."""

    turn: FloatArray  # (2,) rad: about x and y over the step, with the bias in it
    turn_variance: float  # rad², of each
    force: FloatArray | None  # (3,) m/s²: specific force at the step's end, without the robot's own acceleration
    force_variance: float  # (m/s²)², of each
    seconds: float  # length of the step


@dataclass(frozen=True, slots=True, eq=False)
class MotionMeasurement:
    """``T_start_end`` of the base from ``source`` (wheels, learned or gyro), with right-perturbation covariance."""

    source: str
    start_ns: int
    stamp_ns: int
    motion: FloatArray  # (3,)
    cov: FloatArray  # (3, 3) of what differs from step to step; what is always the same is in `depends_on`
    # by parameter of the installation: derivative (3,) of the motion (right perturbation), and the value it has in it
    depends_on: Mapping[str, tuple[FloatArray, float]] = field(default_factory=dict)
    inertial: InertialReading | None = None  # of the same step; on uneven ground
    end_variance: FloatArray | None = None  # (3,) of the pose at the end alone: no later step goes on from it


@dataclass(frozen=True, slots=True, eq=False)
class MotionReadings:
    """Motion over one step by each source, as if it were alone; None where it has no data."""

    wheels: MotionMeasurement | None = None
    learned: MotionMeasurement | None = None
    gyro: MotionMeasurement | None = None  # only its yaw means anything
    inertial: InertialReading | None = None  # on uneven ground
    at_rest: bool = False  # wheels report no motion, and the gyro none but its bias
    beside: tuple[MotionMeasurement, ...] = ()  # odometries beside the wheels


# --- Findings: errors, warnings and notes on a recording, its set-up or a run -----------------------------------------


class Severity(IntEnum):
    """Effect of a finding on the result; a higher value is graver."""

    NOTE = 0  # the user should know
    WARNING = 1  # something is off, and the run copes with it
    ERROR = 2  # the poses are not to be trusted as the set-up is; exit code 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong, or worth knowing, with its evidence and its remedy.

    Attributes:
        code: stable name, ``subject.kind``: "sightings.axes", "imu.axes", "truth.frame".
        text: one sentence with the evidence and the remedy.
        severity: effect on the result.
        lines: settings that undo it, ``section.key`` of robot.yaml to the value as YAML.
        value: figure that was found (a lag [s], a scale, an angle [rad]); None: there is none.
        sigma: standard deviation of `value`; None: not known.
    """

    code: str
    text: str
    severity: Severity = Severity.NOTE
    lines: Mapping[str, str] = field(default_factory=dict)
    value: float | None = None
    sigma: float | None = None


def note(code: str, texts: Iterable[str], severity: Severity = Severity.NOTE) -> list[Finding]:
    """Findings without settings, one for each sentence."""
    return [Finding(code, text, severity) for text in texts]


class Grave(str):
    """A note of which a warning is made: data are damaged, in another unit, or not of this map."""


class LostData(Grave):
    """A note that part of a recording cannot be read; ``share`` of it as far as that is known."""

    share: float

    def __new__(cls, text: str, share: float) -> LostData:
        """Note with the share that is lost, from 0 to 1."""
        made = super().__new__(cls, text)
        made.share = share
        return made

    def __getnewargs__(self) -> tuple[str, float]:  # type: ignore[override]
        """Arguments of a copy."""
        return str(self), self.share


REMARKS = ("run", "recording", "batch")
"""Codes of sentences on what a run does with its recording and settings; nothing was compared."""


def ordered(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by severity, the gravest first; among those alike remarks come last; else in the given order.

    Repetitions are dropped: of equal sentences, and of two findings that set the same key the later one loses that line
    (and is dropped if it is no graver than a note and has no other line).
    """
    kept: list[Finding] = []
    texts: set[str] = set()
    keys: set[str] = set()
    for finding in sorted(findings, key=lambda f: (-f.severity, f.code in REMARKS)):
        if finding.text in texts:
            continue
        if finding.lines and finding.severity < Severity.ERROR and keys >= finding.lines.keys():
            continue
        texts.add(finding.text)
        keys |= finding.lines.keys()
        kept.append(finding)
    return tuple(kept)


# --- Results: decisions, estimates, trajectories, runs ----------------------------------------------------------------


class Mode(StrEnum):
    """State of the tracker when the estimate was made."""

    OK = "OK"
    UNCONFIRMED = "UNCONFIRMED"  # by sightings that nothing checks yet: before the first pose is certain
    DEAD_RECKONING = "DEAD_RECKONING"
    LOST = "LOST"


MOUNTING_CHANGED = "mounting_changed"
"""Reason of the decision that a sensor was knocked; its kind is that of the sensor's sightings."""


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Decision on one measurement, or on the pose: a row of ``steps.csv``."""

    step: int
    stamp_ns: int
    kind: str  # a sensor by its name, "place", "mode" or "clock"
    landmark_id: int  # -1 for motion
    residual: float  # norm of the whitened residual against the prediction
    nis: float
    dof: int
    weight: float  # 1 as given, less if inflated, 0 if rejected
    reason: str  # "" if used as given
    threshold: float = math.nan  # that the NIS is held against; NaN: none
    shift_m: float = (
        math.nan
    )  # of a motion: how much further forward than its reference; of a place: from the estimated pose


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Height, roll and pitch that complete a planar pose where the ground is uneven.

    The base's rotation is ``Rz(yaw) Ry(pitch) Rx(roll)``.
    """

    z: float  # m
    roll: float  # rad
    pitch: float  # rad, positive where the nose is down
    cov: FloatArray  # (6, 6) of x, y, z, roll, pitch, yaw in the map frame, as in ROS

    def with_planar(self, cov: FloatArray) -> Ground:
        """Ground with another covariance ``(3, 3)`` of x, y and yaw, which are then not correlated with the others."""
        whole = self.cov.copy()
        whole[PLANAR, :] = whole[:, PLANAR] = 0.0
        whole[np.ix_(PLANAR, PLANAR)] = cov
        return replace(self, cov=whole)


PLANAR = (0, 1, 5)
"""Rows of x, y and yaw in a covariance of x, y, z, roll, pitch, yaw."""


@dataclass(frozen=True, slots=True, eq=False)
class Protection:
    """Bound on a pose's error that is exceeded with no more than the configured risk, see docs/integrity.md.

    Attributes:
        bound: ``(3,)`` along and across the robot [m], and of the yaw [rad].
        position_m: on the distance from the true place [m]; less than along and across together.
        cause: what the bound is due to: "noise", "landmark 7" (displaced), "slip", "place" (a jump to it).
        alert: whether it is above the alert limit.
    """

    bound: FloatArray
    position_m: float
    cause: str
    alert: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """``T_map_base`` at one keyframe. ``cov`` is in the map frame."""

    stamp_ns: int
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    mode: Mode = Mode.OK
    decisions: tuple[Decision, ...] = ()
    ground: Ground | None = None  # None: the floor is flat
    protection: Protection | None = None  # None: not computed (a smoothed pose, or before the first one)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time. ``covs`` is in the map frame; None where unknown (a truth)."""

    stamps_ns: IntArray  # (n,) strictly increasing
    poses: FloatArray  # (n, 3)
    covs: FloatArray | None = None  # (n, 3, 3)
    ground: FloatArray | None = None  # (n, 3) height, roll and pitch; None: the floor is flat, or not known
    ground_covs: FloatArray | None = None  # (n, 6, 6) of x, y, z, roll, pitch, yaw in the map frame
    has_yaw: bool = True  # False: a truth of positions of the point that is tracked; the yaw says nothing

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def ground_at(self, i: int) -> Ground | None:
        """Height, roll and pitch of pose ``i``; None: the floor is flat."""
        if self.ground is None or self.ground_covs is None:
            return None
        z, roll, pitch = self.ground[i].tolist()
        return Ground(z, roll, pitch, self.ground_covs[i])

    def interpolate(self, stamp_ns: int | IntArray) -> FloatArray:
        """Poses between the known ones: linear in x and y, and in yaw the shorter way round.

        Args:
            stamp_ns: one time, or ``(m,)`` times, between the first and the last of ``stamps_ns``.

        Returns:
            ``(3,)`` for one time, else ``(m, 3)``.

        Raises:
            TrajectoryError: the trajectory is empty, or a time lies outside it or is no whole number.
        """
        poses = se2.interpolate(self.stamps_ns, self.poses, self._inside(stamp_ns))
        return poses[0] if np.ndim(stamp_ns) == 0 else poses

    def interpolate_covs(self, stamp_ns: int | IntArray) -> FloatArray:
        """Covariances of the poses that `interpolate` gives, in the map frame.

        Between two poses with covariances P and Q, at the share s of the h seconds between them:

            (1 - s) P + s Q + (s (1 - s) h² / 2)² diag(A, A, W)

        The first two terms are no less than the covariance of the interpolated errors, however the two are correlated.
        The third is for the way between, which need not be straight nor of one speed, nor bend to a known side: A and W
        are the sums of the squared accelerations of position [m²/s⁴] and yaw [rad²/s⁴] at the two poses, by the mean
        velocities before and after each. A pose at either end of the trajectory has none; two poses alone are taken for
        a start from rest. A jolt that begins and ends between two poses is not seen: `fgloc.Live.pose_at` knows the
        motion there.

        Args:
            stamp_ns: as for `interpolate`.

        Returns:
            ``(3, 3)`` for one time, else ``(m, 3, 3)``; at a known pose its own covariance.

        Raises:
            TrajectoryError: as for `interpolate`, or there are no covariances.
        """
        asked = self._inside(stamp_ns)
        if self.covs is None:
            raise TrajectoryError(
                "the trajectory has no covariances, as that of a truth; `interpolate` gives its poses"
            )
        if len(self) == 1:
            covs = np.repeat(self.covs, len(asked), axis=0)
        else:
            k = np.clip(np.searchsorted(self.stamps_ns, asked, "right") - 1, 0, len(self) - 2)
            h = (self.stamps_ns[k + 1] - self.stamps_ns[k]) * 1e-9
            s = ((asked - self.stamps_ns[k]) * 1e-9 / h)[:, None, None]
            squared = self._squared_accelerations()
            covs = (1.0 - s) * self.covs[k] + s * self.covs[k + 1]
            bend = 0.5 * s[:, 0] * (1.0 - s[:, 0]) * h[:, None] ** 2
            covs[:, range(3), range(3)] += bend**2 * (squared[k] + squared[k + 1])
        return np.asarray(covs[0] if np.ndim(stamp_ns) == 0 else covs)

    def _squared_accelerations(self) -> FloatArray:
        """Squared acceleration ``(n, 3)`` of the position, twice, and of the yaw at each pose."""
        steps = np.diff(self.stamps_ns)[:, None] * 1e-9
        moved = np.diff(self.poses, axis=0)
        moved[:, 2] = se2.wrap_array(moved[:, 2])
        found = np.zeros((len(self), 3))
        if len(self) == 2:
            found[0] = (2.0 * moved / steps**2)[0]
        else:
            found[1:-1] = 2.0 * np.diff(moved / steps, axis=0) / (steps[1:] + steps[:-1])
        squared: FloatArray = found**2
        squared[:, :2] = squared[:, :2].sum(axis=1, keepdims=True)
        return squared

    def _inside(self, stamp_ns: int | IntArray) -> IntArray:
        """Times ``(m,)`` that were asked for.

        Raises:
            TrajectoryError: the trajectory is empty, or a time lies outside it or is no whole number.
        """
        if not len(self):
            raise TrajectoryError("the trajectory is empty: nothing to interpolate")
        given = np.atleast_1d(np.asarray(stamp_ns))
        if given.dtype.kind != "i":
            given = np.array([whole_ns(stamp, TrajectoryError) for stamp in given.tolist()], dtype=np.int64)
        asked: IntArray = given.astype(np.int64)
        first, last = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        outside = asked[(asked < first) | (asked > last)]
        if outside.size:
            raise TrajectoryError(
                f"stamp {outside[0]} ns lies outside the trajectory; expected {first} to {last} ns. fgloc.Live "
                "extrapolates beyond the last pose"
            )
        return asked


@dataclass(frozen=True, slots=True, eq=False)
class TopicTimes:
    """When a topic had messages.

    ``times`` are in seconds from the first estimate; of very many only one in ``every`` is kept.
    """

    times: FloatArray  # (n,)
    count: int
    every: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class Setting:
    """A value of the installation, as it was given and as a run found it; in the units of ``robot.yaml``."""

    name: str
    given: float
    found: float
    sigma: float  # of what was found
    prior_sigma: float  # of what was given

    @property
    def off(self) -> float:
        """Difference of the given value and that of the measurements alone, in sigmas of both.

        What was found lies between the two, by their sigmas; its expected square distance from the given value is the
        difference of the variances.
        """
        spread = self.prior_sigma**2 - self.sigma**2
        return (self.found - self.given) / math.sqrt(max(spread, 1e-6 * self.prior_sigma**2, 1e-30))

    @property
    def unpulled(self) -> float:
        """The change that the measurements alone ask for, without the pull of the prior."""
        share = 1.0 - (self.sigma / self.prior_sigma) ** 2 if self.prior_sigma > 0.0 else 1.0
        return (self.found - self.given) / max(share, 0.05)


@dataclass(frozen=True, slots=True, eq=False)
class InstallationFound:
    """The whole installation state of a run ``(n,)``, with the prior that it began from."""

    names: tuple[str, ...]
    mean: FloatArray  # (n,)
    cov: FloatArray  # (n, n)
    prior_cov: FloatArray  # (n, n)
    cameras: tuple[Camera, ...]  # of corners, as the run used them
    seen_by: str  # role whose stamps the sightings have; "" if they are of registered sensors alone
    wheels: str  # role whose stamps the wheels have: "joints", "odometry", "command"; "" if they had no messages
    settings: tuple[Setting, ...] = ()  # all but the map's
    landmarks: LandmarkMap | None = None  # of a known map, where they were found
