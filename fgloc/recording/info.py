"""``fgloc info``: what a recording holds, what would be used of it, and what looks wrong."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fgloc.config import BUILT_IN_ROLES, CAMERA_ROLES, Config, Role, base_role, base_roles, camera_role
from fgloc.errors import RecordingError
from fgloc.extensions import outside_sensors
from fgloc.frames import BASE_NAMES
from fgloc.recording.reader import CONVERTERS, HEADERLESS, TF_TYPES, Recording, TopicInfo, converters_of
from fgloc.recording.transforms import TF_TOPIC, pair_topic
from fgloc.sensors import registry
from fgloc.sensors.checks import (
    Collector,
    RawChecks,
    SightingsChecks,
    Table,
    TimingOnly,
    count,
    finite_rows,
    unit_length,
)
from fgloc.types import CameraInfoEvent, Event, Finding, FloatArray, MotionEvent, Severity, TruthEvent, note

# --- Timing of one topic: rate, gaps, stamps and clocks ---------------------------------------------------------------

_OFF_S = 1.0  # header stamps further from the receive times than this are wrong
_EARLY_S = 0.005
_DRIFT_S = 0.05


@dataclass(frozen=True, slots=True)
class TopicReport:
    """Timing of one topic. Times are from the recording's start; None: not known."""

    name: str
    message_type: str
    count: int
    used_as: str  # role, "tf", or empty
    rate_hz: float | None = None  # mean
    longest_gap_s: float | None = None
    longest_gap_at_s: float | None = None
    delay_s: float | None = None  # median of receive time minus stamp; None without stamps
    zero_stamps: int = 0
    repeated_stamps: int = 0
    jumps_back: int = 0
    jumps_ahead: int = 0


@dataclass
class Times:
    """Receive times and stamps [ns] of one topic's messages."""

    received: array[int] = field(default_factory=lambda: array("q"))
    decoded: array[int] = field(default_factory=lambda: array("q"))  # receive times of those that have a stamp
    stamps: array[int] = field(default_factory=lambda: array("q"))


def report_topic(topic: TopicInfo, times: Times, start_ns: int, config: Config) -> tuple[TopicReport, list[str]]:
    """Timing of a topic, and what looks wrong with it."""
    used_as = topic.role or ("tf" if topic.message_type in TF_TYPES else "")
    received = int64(times.received)
    report = TopicReport(topic.name, topic.message_type, max(topic.count, len(received)), used_as)
    if len(received) < 2:
        return report, []
    report, found = _received(report, topic, received, start_ns, config)
    if topic.role is None or topic.message_type in HEADERLESS or len(times.stamps) < 2:
        return report, found
    report, clocks = _stamped(report, topic.role, times, start_ns, config)
    return report, clocks + found


def _received(
    report: TopicReport, topic: TopicInfo, received: NDArray[np.int64], start_ns: int, config: Config
) -> tuple[TopicReport, list[str]]:
    """Rate and longest gap by the receive times ``(n,)`` [ns]; and the gaps that are too long."""
    intervals = np.diff(received) * 1e-9
    longest = int(np.argmax(intervals))
    at = float(received[longest] - start_ns) * 1e-9
    gap = float(intervals[longest])
    found = []
    if topic.role is not None and base_role(topic.role) not in ("camera_info", "truth", "sightings"):
        long = intervals > max(config.gate.gap_s, 3.0 * float(np.median(intervals)))
        if long.any():
            found.append(
                f"{topic.name}: {plural(int(long.sum()), 'gap')} of more than {config.gate.gap_s:g} s, "
                f"the longest of {gap:.1f} s from {at:.1f} s on."
            )
    span = float(received[-1] - received[0]) * 1e-9
    rate = (len(received) - 1) / span if span > 0 else None
    return TopicReport(report.name, report.message_type, report.count, report.used_as, rate, gap, at), found


def _stamped(
    report: TopicReport, role: Role, times: Times, start_ns: int, config: Config
) -> tuple[TopicReport, list[str]]:
    """Header stamps, as they are recorded, against receive times; and what is wrong with them."""
    configured_ns = round(config.recording.stamp_offset_s.get(role, 0.0) * 1e9)
    stamps, received = int64(times.stamps) - configured_ns, int64(times.decoded)
    zero = stamps == 0
    steps = np.diff(stamps[~zero]) * 1e-9
    delays = (received - stamps)[~zero] * 1e-9
    drifted = np.diff(stamps[~zero]) - np.diff(received[~zero])
    back = steps < 0
    ahead = drifted * 1e-9 > config.gate.gap_s
    report = replace(
        report,
        delay_s=float(np.median(delays)) if len(delays) else None,
        zero_stamps=int(zero.sum()),
        repeated_stamps=int((steps == 0).sum()),
        jumps_back=int(back.sum()),
        jumps_ahead=int(ahead.sum()),
    )
    clocks = _clocks(report, role, delays, bool(back.any() or ahead.any()))
    if back.any():
        at_back = float(received[~zero][int(np.argmin(steps)) + 1] - start_ns) * 1e-9
        clocks.append(
            f"{report.name}: stamps go back {plural(report.jumps_back, 'time')}, by up to {-steps.min():.3g} s "
            f"at {at_back:.1f} s."
        )
    if ahead.any():
        at_ahead = float(received[~zero][int(np.argmax(drifted)) + 1] - start_ns) * 1e-9
        clocks.append(
            f"{report.name}: stamps jump ahead of the receive times {plural(report.jumps_ahead, 'time')}, by up to "
            f"{drifted.max() * 1e-9:.3g} s at {at_ahead:.1f} s."
        )
    return report, clocks


def _clocks(report: TopicReport, role: Role, delays: FloatArray, jumps: bool) -> list[str]:
    """Faults of a topic's header stamps as a whole, one sentence each."""
    topic, found = report.name, []
    remedy = f"recording.received_stamps: [{role}] takes the receive times instead"
    if report.zero_stamps:
        found.append(f"{topic}: {report.zero_stamps} of {report.count} stamps are 0 and will be rejected; {remedy}.")
    if report.repeated_stamps:
        found.append(f"{topic}: {plural(report.repeated_stamps, 'stamp')} repeated; the repetition will be dropped.")
    if report.delay_s is None:
        return found
    if abs(report.delay_s) > _OFF_S:
        where = "behind" if report.delay_s > 0 else "ahead of"
        found.append(f"{topic}: header stamps are {abs(report.delay_s):.4g} s {where} the receive times; {remedy}.")
    tenth = len(delays) // 10
    if tenth >= 10 and not jumps:
        drift = float(np.median(delays[-tenth:]) - np.median(delays[:tenth]))
        if abs(drift) > _DRIFT_S:
            found.append(f"{topic}: the delay of its messages changes by {drift:+.3f} s: one of the clocks drifts.")
    return found


def early_clocks(reports: list[TopicReport]) -> list[str]:
    """A message cannot be received before it was stamped: if it seems so, two clocks were at work."""
    early = {r.name: r.delay_s for r in reports if r.delay_s is not None and -_OFF_S <= r.delay_s < -_EARLY_S}
    if not early:
        return []
    return [
        f"{', '.join(early)}: header stamps are {-min(early.values()) * 1e3:.0f} ms ahead of the receive times: the "
        "robot's clock and the recorder's differ, which matters beside topics without stamps (Twist, Pose2D)."
    ]


def plural(n: int, noun: str) -> str:
    """A number with its noun."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def int64(values: array[int]) -> NDArray[np.int64]:
    """Convert to an int64 array."""
    return np.array(values, dtype=np.int64)


# --- Contents: calibration and truth; sensors bring checks of their own -----------------------------------------------


class TruthChecks:
    """Truth that is not always there."""

    def __init__(self) -> None:
        self._rows = Table(7)

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, TruthEvent)
        self._rows.add(*event.position, *event.orientation)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        rows = self._rows.array()
        found = []
        finite = finite_rows(rows)
        if not finite.all():
            found.append(f"{topic}: {count(~finite)} hold NaN or infinity.")
        found += unit_length(topic, rows[finite, 3:7])
        if len(seconds) > 1:
            gaps = np.diff(seconds)
            covered = float(gaps[gaps <= config.truth.max_gap_s].sum() / max(seconds[-1] - seconds[0], 1e-9))
            if covered < 0.95:
                found.append(
                    f"{topic}: truth arrives in bursts: gaps of more than {config.truth.max_gap_s:g} s make up "
                    f"{1 - covered:.0%} of the time, where nothing can be compared."
                )
        return found


class CameraInfoChecks:
    """A calibration that is none, or that changes."""

    def __init__(self) -> None:
        self.sizes = ((0, 0), (0, 0))  # of the calibration, and of the images by it
        self.frame_id = ""
        self.zero = 0
        self._no_distortion = 0
        self.count = 0
        self._calibrations: set[bytes] = set()

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, CameraInfoEvent)
        self.count += 1
        self.sizes = (event.width, event.height), event.image_size
        self.frame_id = self.frame_id or event.frame_id
        self.zero += not event.K.any()
        self._no_distortion += len(event.D) == 0
        if len(self._calibrations) < 10:
            self._calibrations.add(event.K.tobytes() + event.D.tobytes())

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        found = []
        if self._no_distortion and not self.zero:
            found.append(f"{topic}: no distortion coefficients; they are taken as zero.")
        if len(self._calibrations) > 1:
            found.append(f"{topic}: the calibration changes during the recording; the first one is used.")
        return found


_CHECKS: dict[Role, type[Collector]] = {"camera_info": CameraInfoChecks, "truth": TruthChecks}


def collector(role: Role) -> Collector:
    """A new collector for the topic of a role."""
    if base_role(role) in _CHECKS:
        return _CHECKS[base_role(role)]()
    return next((stream.findings() for stream in registry.streams_of(base_role(role))), TimingOnly())


# --- The whole recording ----------------------------------------------------------------------------------------------

_KINDS = {"ros1": "ROS 1 bag", "sqlite3": "rosbag2 (sqlite3)", "mcap": "rosbag2 (MCAP)"}

_UNREAD = {
    "Range": "ranges without a bearing",
    "LaserScan": "laser scans",
    "MultiEchoLaserScan": "laser scans",
    "PointCloud2": "point clouds",
    "NavSatFix": "satellite fixes",
}  # what tells where a robot is, by type of message
_NO_PLACE = frozenset(BUILT_IN_ROLES) - {"image", "sightings"}  # roles that do not tell where in the map a robot is


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Result of `inspect`."""

    path: Path
    kind: str
    start_ns: int
    duration_s: float
    size_bytes: int
    topics: tuple[TopicReport, ...]
    roles: Mapping[Role, str]
    marker_ids: Mapping[int, int]  # id -> sightings
    problems: tuple[str, ...]  # what must be settled before a run
    found: tuple[Finding, ...]  # what looks wrong, the gravest first
    notes: tuple[str, ...]

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences of what looks wrong, the gravest first."""
        return tuple(finding.text for finding in self.found)

    @property
    def exit_code(self) -> int:
        """Exit code of ``fgloc info``: 1 if no run is possible, 3 if its poses would be wrong, else 0."""
        return 1 if self.problems else 3 if any(f.severity is Severity.ERROR for f in self.found) else 0


def inspect(path: Path, config: Config) -> RecordingInfo:
    """Read a recording through and report on it.

    Raises:
        RecordingError: nothing can be read.
    """
    with Recording(path, config.recording) as recording:
        return inspect_recording(recording, config)


def inspect_recording(
    recording: Recording, config: Config, watch: Callable[[Event], object] | None = None
) -> RecordingInfo:
    """Inspect an opened recording; `watch` is called with each event that is decoded, tf's excepted."""
    times, checks, child_frame = _read_through(recording, watch)
    start_ns = min((t.received[0] for t in times.values() if t.received), default=0)
    unreadable = recording.unreadable
    reports: list[TopicReport] = []
    findings: list[str] = []
    for info in recording.topics:
        report, found = report_topic(info, times[info.name], start_ns, config)
        reports.append(report)
        findings += found
        if info.name in checks and times[info.name].stamps:
            seconds = np.asarray((int64(times[info.name].decoded) - start_ns) * 1e-9)
            with np.errstate(all="ignore"):  # absurd magnitudes overflow: that is what is looked for
                findings += checks[info.name].findings(info.name, seconds, config)
    findings += unreadable
    ids = next((c.ids for c in checks.values() if isinstance(c, SightingsChecks)), Counter())
    return RecordingInfo(
        path=recording.path,
        kind=recording.kind,
        start_ns=start_ns,
        duration_s=recording.duration_s,
        size_bytes=recording.size_bytes,
        topics=tuple(reports),
        roles=recording.roles,
        marker_ids=dict(sorted(ids.items())),
        problems=recording.problems,
        found=(
            *note("recording", findings, Severity.WARNING),
            *_roles(recording, config, checks, child_frame),
            *note("recording", early_clocks(reports), Severity.WARNING),
            *note("sensor.unheard", unheard(recording, config), Severity.WARNING),
            *note("recording.unused", _unused(recording, config), Severity.NOTE),
        ),
        notes=recording.notes,
    )


def _read_through(
    recording: Recording, watch: Callable[[Event], object] | None
) -> tuple[dict[str, Times], dict[str, Collector], str]:
    """Times and checks of each topic, and the first name of a child frame."""
    times = {topic.name: Times() for topic in recording.topics}
    role_of = recording.role_of
    checks: dict[str, Collector] = {topic: collector(role) for topic, role in role_of.items()}
    child_frame = ""
    recording.undecodable = {}
    for message in recording.messages():
        topic, _, received_ns, _ = message
        if topic not in times:  # damage may hide it at first
            times[topic] = Times()
        times[topic].received.append(received_ns)
        if topic in role_of:
            for event in recording.decode(message, role_of[topic]):
                times[topic].decoded.append(received_ns)
                times[topic].stamps.append(event.stamp_ns)
                checks[topic].add(event)
                if watch is not None:
                    watch(event)
                if isinstance(event, MotionEvent):
                    child_frame = child_frame or event.base_frame_id
    return times, checks, child_frame


LACKING = ("motion.unmeasured", "place.unbounded", "camera.uncalibrated", "camera.resolution", "frame.unmounted")
"""Codes of what a run needs and the recording lacks."""


def _roles(
    recording: Recording, config: Config, checks: Mapping[str, Collector], child_frame: str
) -> Iterator[Finding]:
    """Roles that a run needs and the recording lacks."""
    roles = recording.roles
    motion, place, *_ = LACKING
    unsettled = bool(recording.problems)
    if not unsettled and not {"odometry", "joints", "command"} & roles.keys():
        told = "sightings alone tell" if {"image", "sightings"} & base_roles(roles) else "nothing measures"
        text = f"No odometry, joint states or commands: {told} how the robot moves."
        yield Finding(motion, text + _perhaps_odometry(recording), Severity.WARNING)
    elif not unsettled and not {"odometry", "joints"} & roles.keys() and (pairs := _of_odometry(recording)):
        text = f"Commands alone tell how the robot moves. If {' or '.join(pairs)} is an odometry of the robot, "
        yield Finding("recording.unused", text + f"set recording.topics.odometry: {pairs[0]}.", Severity.NOTE)
    if not unsettled and not placing_roles(roles, config):
        text = "No images and no marker sightings: nothing bounds the drift." + _perhaps_sightings(recording)
        yield Finding(place, text, Severity.WARNING)
    for name in config.camera_names:
        own = {role: topic for role in CAMERA_ROLES if (topic := roles.get(camera_role(name, role)))}
        yield from _camera(recording, config.of_camera(name), own, checks, child_frame)


def _camera(
    recording: Recording, config: Config, own: Mapping[Role, str], checks: Mapping[str, Collector], child_frame: str
) -> Iterator[Finding]:
    """Calibration, resolution and place that one of the cameras needs and the recording lacks, by its own topics."""
    _, _, uncalibrated, size, unmounted = LACKING
    images, info, sightings = (checks.get(own.get(role, "")) for role in ("image", "camera_info", "sightings"))
    needs_camera = isinstance(images, RawChecks) or (isinstance(sightings, SightingsChecks) and sightings.in_pixels)
    calibrations = info if isinstance(info, CameraInfoChecks) else None
    if needs_camera and config.camera.file is None and (calibrations is None or calibrations.zero):
        lacking = "No sensor_msgs/CameraInfo for the camera"
        if calibrations is not None:
            times = f"{calibrations.zero} of {calibrations.count} messages"
            lacking = f"{own['camera_info']}: K is all zero in {times}: the camera is not calibrated"
        text = f"{lacking}; give a calibration (camera.file in the configuration)."
        yield Finding(uncalibrated, text, Severity.WARNING)
    by_info = () if calibrations is None else calibrations.sizes
    if by_info and isinstance(images, RawChecks) and images.sizes and not images.sizes.keys() & {*by_info}:
        sizes, (width, height) = ", ".join(f"{w}x{h}" for w, h in images.sizes), by_info[0]
        text = f"{own['camera_info']}: the calibration is for {width}x{height}, the images are {sizes}."
        yield Finding(size, text, Severity.WARNING)
    sensors = (calibrations, images, sightings) if needs_camera else (sightings,)
    frames = [one.frame_id for one in sensors if isinstance(one, CameraInfoChecks | RawChecks | SightingsChecks)]
    if config.recording.sightings_pose is None and frames:
        bases, frame = _base_names(config, child_frame), next(filter(None, frames), "")
        yield from note(unmounted, _mounting(recording, bases, frame, needs_camera), Severity.WARNING)


def _perhaps_odometry(recording: Recording) -> str:
    """Sentence on topics that are read as odometry only where the configuration names them; empty: there are none."""
    fitting = [
        topic.name
        for topic in recording.topics
        if topic.role is None and topic.count and topic.message_type in converters_of("odometry")
    ]
    fitting += _of_odometry(recording)
    if not fitting:
        return ""
    return f" If {' or '.join(fitting)} is an odometry of the robot, set recording.topics.odometry: {fitting[0]}."


def _of_odometry(recording: Recording) -> list[str]:
    """Poses in tf that may be those of an odometry, in place of topics."""
    return [pair_topic(*pair) for pair in recording.frames.moving if "odom" in pair[0].lower()]


_OF_MARKERS = re.compile(r"(?<![a-z])(aruco|april_?tag|tag|fiducial|marker)s?(?![a-z])", re.IGNORECASE)


def _perhaps_sightings(recording: Recording) -> str:
    """Sentence on what seems to tell of markers in a form that is not read; empty: nothing does."""
    found = [
        f"{topic.name} ({topic.message_type.replace('/msg/', '/')})"
        for topic in recording.topics
        if topic.role is None and topic.count and topic.message_type in _DRAWN and _OF_MARKERS.search(topic.name)
    ]
    frames = [name for name in recording.frames.frames if _OF_MARKERS.search(name)]
    found += [f"the frames {', '.join(frames[:3])}{', ...' if len(frames) > 3 else ''} in tf"] if frames else []
    if not found:
        return ""
    return f" Not read: {' and '.join(found)}; record the detector's own messages (the types are in docs/formats.md)."


_DRAWN = frozenset({"visualization_msgs/msg/MarkerArray", "visualization_msgs/msg/Marker", *CONVERTERS["truth"]})


def unread_map(recording: Recording, config: Config) -> str | None:
    """Sentence on a map that is given while nothing of the recording is read that sees landmarks; None: something is.

    Args:
        recording: whose roles and topics are known.
        config: of the run.
    """
    if placing_roles(recording.roles, config):
        return None
    unread = " ".join([*_unused(recording, config), _perhaps_sightings(recording).strip()]).strip()
    return (
        "A map is given, but the recording has no images and no sightings that are read: the run is dead reckoning, "
        f"and where on the map it takes place is not known.{' ' + unread if unread else ''} Run it without the map, or "
        "give estimator.initial_pose."
    )


def unused_positions(recording: Recording, config: Config) -> list[str]:
    """Sentences on topics of positions or ranges that lack a setting, of a run that nothing else places."""
    if placing_roles(recording.roles, config):
        return []
    lacking, counts = _lacking(config), {t.name: t.count for t in recording.topics}
    return [
        f"{topic} is not used, and nothing else tells where the robot is: give {lacking[role]} in robot.yaml."
        for role, topic in recording.roles.items()
        if role in lacking and counts.get(topic)
    ]


def unheard(recording: Recording, config: Config) -> list[str]:
    """Sentences on sensors that the settings ask for, and that no topic of the recording has messages of."""
    topics, found = config.recording.topics, []
    for sensor in outside_sensors():
        roles = [stream.role for stream in sensor.streams if stream.role in topics.asked]
        if not roles or recording.problems or any(r in recording.roles or topics.given(r) == "none" for r in roles):
            continue
        kinds = " or ".join(kind.replace("/msg/", "/") for stream in sensor.streams for kind in stream.converters)
        found.append(
            f"{sensor.name}.{sensor.needs} is given, but no topic holds messages of {sensor.name} (expected {kinds}): "
            f"record them, or remove {sensor.name}.{sensor.needs}; recording.topics.{roles[0]}: none says that there "
            "are none."
        )
    return found


def _unused(recording: Recording, config: Config) -> list[str]:
    """Sentences on topics that hold the robot's position, and that nothing reads, or nothing as it is configured."""
    lacking, found = _lacking(config), []
    placed = bool(placing_roles(recording.roles, config))
    optional = {  # what could see landmarks too: told where nothing else does
        kind: sensor
        for sensor in outside_sensors()
        if not placed and sensor.name in lacking and getattr(sensor, "optional", False)
        for stream in sensor.streams
        for kind in stream.converters
    }
    read = {kind for sensor in outside_sensors() for stream in sensor.streams for kind in stream.converters}
    for t in recording.topics:
        kind = t.message_type.rpartition("/")[2]
        if t.count and t.role in lacking:
            same = [other.name for other in recording.topics if other.role == t.role and other.count]
            if t.name == same[0]:
                what = f"{', '.join(same)} ({t.message_type}) {'is' if len(same) == 1 else 'are'}"
                found.append(f"{what} not used: give {lacking[t.role]} in robot.yaml.")
        elif t.count and t.role is None and (one := optional.get(t.message_type)) is not None:
            why = f"{one.purpose}, give {lacking[one.name]}"
            found.append(f"{t.name} ({t.message_type}) is not used: {why} in robot.yaml.")
        elif t.count and t.role is None and kind in _UNREAD and t.message_type not in read:
            found.append(f"{t.name} ({t.message_type}) is not used: nothing here reads {_UNREAD[kind]}.")
    return found


def _lacking(config: Config) -> dict[str, str]:
    """Sensors that are not built because a setting of theirs is missing, with that setting."""
    needed = {sensor.name: key for sensor in outside_sensors() if (key := getattr(sensor, "needs", ""))}
    return {
        name: f"{name}.{key}" for name, key in needed.items() if not getattr(getattr(config, name, None), key, None)
    }


def placing_roles(roles: Mapping[Role, str], config: Config) -> Collection[str]:
    """Roles that tell where a robot is, of sensors that the configuration has."""
    return base_roles(roles) - _NO_PLACE - _lacking(config).keys()


def _mounting(recording: Recording, bases: tuple[str, ...], frame: str, camera: bool) -> list[str]:
    """Whether tf has the place of the sensor."""
    if frame.lstrip("/") in bases and not camera:
        return []
    base = next((name for name in bases if name in recording.frames), bases[0])
    try:
        recording.frames.lookup(base, frame)
    except RecordingError as error:
        text = str(error)
        return [f"{text[0].upper()}{text[1:]}." if camera else f"{text[0].upper()}{text[1:]}; else the base is taken."]
    return []


def _base_names(config: Config, child_frame_id: str) -> tuple[str, ...]:
    """Frames that may be the robot's base, the most probable first."""
    if config.recording.base_frame is not None:
        return (config.recording.base_frame,)
    return tuple(dict.fromkeys(name for name in (*BASE_NAMES, child_frame_id) if name))


def format_info(info: RecordingInfo) -> str:
    """The report as text."""
    start = datetime.fromtimestamp(info.start_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    counts = [topic.count for topic in info.topics if not topic.name.startswith(TF_TOPIC)]
    head = (
        f"{info.path}\n{_KINDS[info.kind]}, {info.duration_s:.1f} s from {start}, {info.size_bytes / 1e6:.1f} MB, "
        f"{sum(counts)} messages on {plural(len(counts), 'topic')}"
    )
    rows = [("topic", "type", "count", "rate", "longest gap", "delay", "used as")]
    rows += [
        (
            t.name,
            t.message_type.replace("/msg/", "/"),
            str(t.count),
            "" if t.rate_hz is None else f"{t.rate_hz:.3g} Hz",
            "" if t.longest_gap_s is None else f"{t.longest_gap_s:.2f} s at {t.longest_gap_at_s:.1f} s",
            "" if t.delay_s is None else _duration(t.delay_s),
            t.used_as,
        )
        for t in info.topics
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(7)]
    right = {2, 3, 5}
    table = "\n".join(
        "  ".join(
            cell.rjust(w) if k in right else cell.ljust(w) for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
    parts = [head, table]
    if info.marker_ids:
        seen = ", ".join(f"{marker} ({n})" for marker, n in info.marker_ids.items())
        parts.append(f"Marker ids seen (times): {seen}")
    for title, lines in (
        ("To be settled before a run:", info.problems),
        ("What looks wrong:", info.findings or (() if info.problems else ("nothing",))),
        ("Notes:", info.notes),
    ):
        if lines:
            parts.append("\n".join([title, *(f"  - {line}" for line in lines)]))
    return "\n\n".join(parts) + "\n"


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:z.0f} ms" if abs(seconds) < 1.0 else f"{seconds:.4g} s"
