"""Markers in images as a sensor: their topics, settings and failures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from fgloc.config import GateConfig
from fgloc.errors import CameraError, ConfigError, RecordingError
from fgloc.sensors.base import (
    SENSOR,
    Asked,
    BuiltIn,
    EventInput,
    FirstLook,
    FirstSection,
    FirstSettings,
    Question,
    Stream,
    When,
    byte_array,
)
from fgloc.sensors.cameras import marker_pose_candidates, marker_pose_cov, pinhole, undistort_points
from fgloc.sensors.checks import FieldChecks, RawChecks, SightingsChecks
from fgloc.sensors.failures import Change, EventFailure, Scene
from fgloc.sensors.landmarks import planar_yaw
from fgloc.sensors.markers.detector import dictionary_names, fitting_dictionary
from fgloc.sensors.markers.images import CornersEvent, GrayImage, ImageEvent, MarkerCorners, decoded
from fgloc.sensors.measurements import LandmarkSighting, PixelMeasurement
from fgloc.types import Camera, Event, FloatArray, Grave, Landmark, RawEvent, SightingsEvent

if TYPE_CHECKING:
    from fgloc.sensors.landmarks import SightingContext


_APRILTAG_ORDER = [3, 2, 1, 0]  # corners begin at the bottom left of the upright print and go on to the right
_OPENCV_SHIFT_PX = -0.5  # the AprilTag library has whole pixels at the edges of pixels


def from_image(m: Any, when: When) -> Event:
    """Event of a ``sensor_msgs/Image``."""
    data = byte_array(m.data)
    return ImageEvent(
        *when, m.header.frame_id, m.encoding, False, m.width, m.height, m.step, bool(m.is_bigendian), data
    )


def from_compressed_image(m: Any, when: When) -> Event:
    """Event of a ``sensor_msgs/CompressedImage``."""
    return ImageEvent(*when, m.header.frame_id, m.format, True, 0, 0, 0, False, byte_array(m.data))


def from_apriltags(m: Any, when: When) -> Event:
    """Event of a ``apriltag_msgs/AprilTagDetectionArray``."""
    return CornersEvent(*when, m.header.frame_id, _tags(m.detections, _OPENCV_SHIFT_PX))


def from_tagslam(m: Any, when: When) -> Event:
    """Event of a ``apriltag_msgs/ApriltagArrayStamped``, as TagSLAM's detector nodes publish it."""
    return CornersEvent(*when, m.header.frame_id, _tags(m.apriltags, 0.0))


def _tags(tags: Any, shift_px: float) -> tuple[MarkerCorners, ...]:
    """Corners of tags in OpenCV's order, moved by this much to its pixels."""
    corners = (np.array([(c.x, c.y) for c in tag.corners], dtype=float)[_APRILTAG_ORDER] + shift_px for tag in tags)
    return tuple(MarkerCorners(int(tag.id), own) for tag, own in zip(tags, corners, strict=True))


def from_fiducials(m: Any, when: When) -> Event:
    """Event of a ``fiducial_msgs/FiducialArray``, whose vertices are in OpenCV's order and pixels."""
    return CornersEvent(
        *when,
        m.header.frame_id,
        tuple(
            MarkerCorners(
                int(f.fiducial_id), np.array([(f.x0, f.y0), (f.x1, f.y1), (f.x2, f.y2), (f.x3, f.y3)], dtype=float)
            )
            for f in m.fiducials
        ),
    )


_MAX_PIXEL = 1e5


def check_image(event: ImageEvent, gate: GateConfig) -> Event | str:
    """The image, or why it cannot be used."""
    size = len(event.data)
    if size == 0 or (not event.compressed and (event.width <= 0 or event.height <= 0)):
        return "empty"
    return "truncated" if not event.compressed and size < event.height * event.step else event


def image_validator(checks: FieldChecks) -> Callable[[ImageEvent], Event | str]:
    """Validator of images: rejects those of another size than the topic's first, which the calibration is for."""
    sizes: dict[str, tuple[int, int]] = {}

    def judge(event: ImageEvent) -> Event | str:
        verdict = check_image(event, checks.config)
        size = None if isinstance(verdict, str) else event.stated_size()
        if size is None or (first := sizes.setdefault(event.topic, size)) == size:
            return verdict
        checks.note(
            Grave(
                f"{event.topic}: images of {size[0]}x{size[1]} pixels are not used: the first had "
                f"{first[0]}x{first[1]}, which the calibration is for; begin a new run after a change of resolution"
            )
        )
        return "resized"

    return judge


def corners_validator(checks: FieldChecks) -> Callable[[CornersEvent], Event | str]:
    """Validator of corners."""

    def judge(topic: str, sighting: MarkerCorners) -> MarkerCorners | str:
        return judge_corners(sighting.corners_px, checks.config.min_marker_side_px) or sighting

    return lambda event: checks.sift(event, judge)


def judge_corners(corners_px: FloatArray, min_side_px: float) -> str:
    """Reason why four corners ``(4, 2)`` are no marker, or "": finite, convex and not too small."""
    if corners_px.shape != (4, 2):
        return "corners_degenerate"
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = corners_px.tolist()
    spread = abs(ax) + abs(ay) + abs(bx) + abs(by) + abs(cx) + abs(cy) + abs(dx) + abs(dy)
    if not spread <= 8.0 * _MAX_PIXEL:  # also NaN
        return "non_finite"
    abx, aby, bcx, bcy, cdx, cdy, dax, day = bx - ax, by - ay, cx - bx, cy - by, dx - cx, dy - cy, ax - dx, ay - dy
    side = (math.hypot(abx, aby) + math.hypot(bcx, bcy) + math.hypot(cdx, cdy) + math.hypot(dax, day)) / 4.0
    turns = (abx * bcy - aby * bcx, bcx * cdy - bcy * cdx, cdx * day - cdy * dax, dax * aby - day * abx)
    flat = 1e-3 * side * side
    if not (min(turns) > flat or max(turns) < -flat):  # crossed, dented, or on a line
        return "corners_degenerate"
    return "corners_small" if side < min_side_px else ""


class MarkersInput(EventInput):
    """Methods that make the events of a camera: images, or corners of markers."""

    def image(self, stamp_ns: int, image: NDArray[np.uint8] | bytes, frame_id: str = SENSOR) -> None:
        """An image: grey ``(h, w)``, colour ``(h, w, 3)`` in OpenCV's order (blue first), or encoded (JPEG, PNG).

        Raises:
            RecordingError: an array of another shape or type.
        """
        when = self._when("image", stamp_ns)
        if isinstance(image, bytes | bytearray | memoryview):
            data = np.frombuffer(image, dtype=np.uint8)
            kind = "png" if bytes(image[:4]) == b"\x89PNG" else "jpeg"
            return self._deliver(ImageEvent(*when, frame_id, kind, True, 0, 0, 0, False, data))
        shape = image.shape
        if image.dtype != np.uint8 or len(shape) not in (2, 3) or shape[2:] not in ((), (3,)):
            raise RecordingError(
                f"image of shape {shape} and type {image.dtype}; expected uint8, (h, w) grey or (h, w, 3) blue first, "
                "or the bytes of a JPEG or PNG"
            )
        encoding = "mono8" if len(shape) == 2 else "bgr8"
        step = shape[1] * (1 if len(shape) == 2 else 3)
        data = np.ascontiguousarray(image).reshape(-1).copy()  # the caller's buffer may be used again
        self._deliver(ImageEvent(*when, frame_id, encoding, False, shape[1], shape[0], step, False, data))

    def corners(self, stamp_ns: int, markers: Mapping[int, ArrayLike], frame_id: str = SENSOR) -> None:
        """Markers that were found in an image: corners ``(4, 2)`` [px] by id, clockwise from its top left."""
        found = tuple(MarkerCorners(int(i), np.asarray(c, dtype=float).reshape(4, 2)) for i, c in markers.items())
        self._deliver(CornersEvent(*self._when("sightings", stamp_ns), frame_id, found))


def _first_section(look: FirstLook) -> FirstSection:
    """Dictionary and size, as far as the images show them."""
    if "image" not in look.kinds:
        return FirstSection()
    lines, missing = ["markers:"], []
    asked: list[Asked] = []
    dictionary = fitting_dictionary(look.recording)
    if dictionary is not None:
        lines.append(f"  dictionary: {dictionary}  # what is seen in the images fits it")
    else:
        lines.append("  # dictionary: DICT_4X4_50")
        missing.append("the dictionary of the markers: no marker was found in the images (markers.dictionary)")
        which = Question(
            "Dictionary of the markers, such as DICT_4X4_50", ("markers.dictionary",), among=dictionary_names()
        )
        asked.append(Asked(missing[-1], (which,), replaced=(lines[-1],)))
    if look.has_map:
        lines.append("  # default_size_m:  # the map beside the bag has the sizes")
    else:
        lines.append("  # default_size_m: 0.16  # side of the black square; every distance follows from it")
        missing.append(
            "the size of the markers: measure the side of the black square and give it (markers.default_size_m)"
        )
        side = Question("Side of the markers' black square [m]", ("markers.default_size_m",), 5.0)
        asked.append(Asked(missing[-1], (side,), replaced=(lines[-1],)))
    lines.append("  sigma_px: 0.1  # of a corner: 0.1 for a sharp camera, 0.3 for one that shakes")
    if "camera_info" not in look.kinds:
        lines += [
            "",
            "# The recording has no CameraInfo:",
            "# camera: {file: camera.yaml}  # as camera_calibration writes it",
        ]
    return FirstSection(tuple(lines), tuple(missing), asked=tuple(asked))


FIRST_SETTINGS = FirstSettings((), _first_section)


class Darkness(EventFailure):
    """Images get darker by the factor ``gain`` and noisy by ``noise`` gray levels (standard deviation, of 255)."""

    changes: ClassVar[tuple[type[Event], ...]] = (ImageEvent,)
    pixels: ClassVar[bool] = True
    kind: Literal["darkness"] = "darkness"
    gain: float = Field(0.1, ge=0, le=1, description="brightness that is left, as a share")
    noise: float = Field(2.0, ge=0, description="read noise [gray levels of 255]")

    def change(self, event: ImageEvent, scene: Scene) -> Event:
        """Darken an image, add noise and round."""
        image = decoded(event)
        if image is None:
            return event
        noise = scene.rng.standard_normal(image.shape, dtype=np.float32) * np.float32(self.noise)
        return _with_pixels(event, np.clip(np.rint(image * np.float32(self.gain) + noise), 0, 255).astype(np.uint8))


class MirroredImage(EventFailure):
    """Images are flipped left to right, as by a wrong setting of the driver."""

    changes: ClassVar[tuple[type[Event], ...]] = (ImageEvent,)
    pixels: ClassVar[bool] = True
    kind: Literal["mirrored_image"] = "mirrored_image"

    def change(self, event: ImageEvent, scene: Scene) -> Event:
        """Flip an image."""
        image = decoded(event)
        return event if image is None else _with_pixels(event, image[:, ::-1])


class FrameRate(EventFailure):
    """The camera gives at most ``max_hz`` messages a second; the others are dropped."""

    changes: ClassVar[tuple[type[Event], ...]] = (RawEvent, SightingsEvent)  # all that a camera reports
    kind: Literal["frame_rate"] = "frame_rate"
    max_hz: float = Field(1.0, gt=0, description="Hz")

    def begin(self, scene: Scene) -> Change:
        """Return the function that drops what follows the last message too soon (5 % of jitter is let through)."""
        last_ns: dict[str, int] = {}
        period_ns = 0.95e9 / self.max_hz

        def change(event: Event) -> Event | None:
            if event.received_ns - last_ns.get(event.topic, -(10**19)) < period_ns:
                return None
            last_ns[event.topic] = event.received_ns
            return event

        return change


def _with_pixels(event: ImageEvent, gray: GrayImage) -> Event:
    height, width = gray.shape
    pixels = np.ascontiguousarray(gray).reshape(-1)
    return replace(event, encoding="mono8", compressed=False, width=width, height=height, step=width, data=pixels)


_CLEAR_RATIO = 2.0  # a marker's pose is unambiguous if the mirrored one explains its corners this much worse
_MIRRORED_SIGMA = 1.0  # rad, of the yaw of one that is not


class CornerMeasurer:
    """Corners of markers; see `fgloc.sensors.equipment.LandmarkSensor` for what it rejects."""

    def __init__(self, context: SightingContext) -> None:
        self._context = context
        self._pinhole = None if context.camera is None else pinhole(context.camera)

    def __call__(self, event: CornersEvent) -> Iterator[LandmarkSighting]:
        """Measurements of one message."""
        if self._context.camera is None or self._pinhole is None:
            raise CameraError(
                f"{event.topic}: marker corners, but no calibration; record sensor_msgs/CameraInfo or set camera.file"
            )
        usable = self._context.usable(event.sightings)
        usable.sort(key=lambda s: -_area(s.corners_px))
        most = self._context.config.markers.max_sightings
        if len(usable) > most:
            self._context.reject("beyond_max", len(usable) - most)
        for seen in usable[:most]:
            landmark = self._context.landmark(seen.landmark_id)
            if landmark is None or landmark.size_m == 0.0:
                measured = self._single_view(event, seen, self._context.camera, landmark)
            else:
                measured = self._corner(event, seen, self._context.camera, self._pinhole)
            if measured is not None:
                yield measured

    def _corner(
        self, event: CornersEvent, seen: MarkerCorners, camera: Camera, ideal: Camera
    ) -> PixelMeasurement | None:
        corners = undistort_points(camera, seen.corners_px)
        if not np.isfinite(corners).all():
            self._context.reject("undistortable")
            return None
        section = self._context.config.markers
        return PixelMeasurement(
            event.stamp_ns,
            seen.landmark_id,
            corners,
            section.sigma_px,
            ideal,
            blur_s=section.blur_s,
            sway_rad=section.sway_rad,
            cauchy_k=section.cauchy_k,
        )

    def _single_view(
        self, event: CornersEvent, seen: MarkerCorners, camera: Camera, landmark: Landmark | None
    ) -> LandmarkSighting | None:
        """Planar pose, or range and bearing, from one view of a marker that the map does not have as a square."""
        size = self._context.config.markers.default_size_m
        if size is None and landmark is None:
            raise ConfigError(
                f"{event.topic}: marker corners without a map need their size: set markers.default_size_m"
            )
        if size is None:
            self._context.reject("no_size")
            return None
        sigma_px = self._context.config.markers.sigma_px
        candidates = marker_pose_candidates(camera, seen.corners_px, size)
        if not candidates:
            self._context.reject("no_pose")
            return None
        T, rms = candidates[0]
        cov = marker_pose_cov(camera, T, size, sigma_px)
        R = camera.T_base_cam[:3, :3]
        in_base = camera.T_base_cam @ T
        cov_xy = (R @ cov[:3, :3] @ R.T)[:2, :2]
        clear = len(candidates) == 1 or candidates[1][1] > _CLEAR_RATIO * max(rms, sigma_px)
        floor = self._context.config.landmarks.yaw_sigma_rad
        if floor is None or landmark is not None:
            return self._context.polar(event.stamp_ns, seen.landmark_id, in_base[:2, 3], cov_xy)
        # Of a marker that may be mirrored the yaw is worth little; without it, it would be another kind of variable.
        yaw_var = max(floor if clear else _MIRRORED_SIGMA, math.sqrt((R @ cov[3:, 3:] @ R.T)[2, 2])) ** 2
        yaw = planar_yaw(in_base[:3, :3], None)
        return self._context.planar(event.stamp_ns, seen.landmark_id, in_base[:2, 3], cov_xy, yaw, yaw_var)


def _area(corners: FloatArray) -> float:
    """Area [px²] of a quadrilateral ``(4, 2)``."""
    (ax, ay), (bx, by) = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(ax * by - ay * bx))


MARKERS = BuiltIn(
    name="corners",
    first_settings=FIRST_SETTINGS,
    streams=(
        Stream(
            "image",
            ImageEvent,
            {"sensor_msgs/msg/Image": from_image, "sensor_msgs/msg/CompressedImage": from_compressed_image},
            ("image_raw", "image_raw/compressed", "image", "image/compressed"),
            validator=image_validator,
            findings=RawChecks,
        ),
        Stream(
            "sightings",
            CornersEvent,
            {
                "apriltag_msgs/msg/AprilTagDetectionArray": from_apriltags,
                "apriltag_msgs/msg/ApriltagArrayStamped": from_tagslam,
                "fiducial_msgs/msg/FiducialArray": from_fiducials,
            },
            ("fiducial_vertices",),
            keyframe=True,
            validator=corners_validator,
            findings=SightingsChecks,
        ),
    ),
    failing_as="camera",
    measures=CornerMeasurer,
    measured=(PixelMeasurement,),
    failures=(Darkness, FrameRate, MirroredImage),
)
