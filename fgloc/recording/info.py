"""``fgloc info``: what a recording holds, what would be used of it, and what looks wrong."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fgloc.config import BUILT_IN_ROLES, Config, Role
from fgloc.errors import RecordingError
from fgloc.frames import BASE_NAMES
from fgloc.recording.checks import CameraInfoChecks, collector
from fgloc.recording.reader import Recording
from fgloc.recording.topic_report import Times, TopicReport, early_clocks, int64, plural, report_topic
from fgloc.sensors.checks import Collector, RawChecks, SightingsChecks
from fgloc.types import Event, Finding, MotionEvent, Severity, note

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
    """All that `inspect` found."""

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
        """Of ``fgloc info``, as a run would end: 1 if none is possible, 3 if its poses would be wrong, else 0."""
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
    """As `inspect`, of an opened recording; `watch` is called with each event that is decoded, tf's excepted."""
    times, checks, child_frame = _read_through(recording, watch)
    start_ns = min((t.received[0] for t in times.values() if t.received), default=0)
    undecodable = dict(recording.undecodable)
    reports, findings = [], []
    for info in recording.topics:
        report, found = report_topic(info, times[info.name], start_ns, config)
        reports.append(report)
        findings += found
        if info.name in checks and times[info.name].stamps:
            seconds = np.asarray((int64(times[info.name].decoded) - start_ns) * 1e-9)
            with np.errstate(all="ignore"):  # absurd magnitudes overflow: that is what is looked for
                findings += checks[info.name].findings(info.name, seconds, config)
    findings += [f"{topic}: {n} messages cannot be decoded." for topic, n in undecodable.items()]
    findings += _roles(recording, config, checks, child_frame)
    findings += early_clocks(reports)
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
            *note("recording.unused", _unused(recording), Severity.NOTE),
        ),
        notes=recording.notes,
    )


def _read_through(
    recording: Recording, watch: Callable[[Event], object] | None
) -> tuple[dict[str, Times], dict[str, Collector], str]:
    """Times and checks of each topic, and the first name of a child frame."""
    times = {topic.name: Times() for topic in recording.topics}
    role_of = {topic: role for role, topic in recording.roles.items()}
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


def _roles(recording: Recording, config: Config, checks: Mapping[str, Collector], child_frame: str) -> list[str]:
    """What is missing for a run."""
    roles, found = recording.roles, []
    unsettled = bool(recording.problems)
    if not unsettled and not {"odometry", "joints", "command"} & roles.keys():
        found.append("No odometry, joint states or commands: nothing measures how the robot moves.")
    if not unsettled and not roles.keys() - _NO_PLACE:
        found.append("No images and no marker sightings: nothing bounds the drift.")
    images = next((c for c in checks.values() if isinstance(c, RawChecks)), None)
    info = next((c for c in checks.values() if isinstance(c, CameraInfoChecks)), None)
    sightings = next((c for c in checks.values() if isinstance(c, SightingsChecks)), None)
    needs_camera = images is not None or (sightings is not None and sightings.in_pixels)
    if needs_camera and info is None and config.camera.file is None:
        found.append("No sensor_msgs/CameraInfo for the camera; give a calibration (camera.file in the configuration).")
    if images is not None and info is not None and images.sizes and info.size not in images.sizes:
        sizes = ", ".join(f"{w}x{h}" for w, h in images.sizes)
        found.append(
            f"{roles['camera_info']}: the calibration is for {info.size[0]}x{info.size[1]}, the images are {sizes}."
        )
    if config.recording.sightings_pose is None:
        sensors = (info, images, sightings) if needs_camera else (sightings,)
        frames = [sensor.frame_id for sensor in sensors if sensor is not None]
        if frames:
            found += _mounting(
                recording, _base_names(config, child_frame), next(filter(None, frames), ""), needs_camera
            )
    return found


def _unused(recording: Recording) -> list[str]:
    """Sentences on topics that tell where the robot is, and that nothing here reads."""
    return [
        f"{t.name} ({t.message_type}) is not used: nothing here reads {_UNREAD[kind]}."
        for t in recording.topics
        if t.count and t.role is None and (kind := t.message_type.rpartition("/")[2]) in _UNREAD
    ]


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
    messages = sum(topic.count for topic in info.topics)
    head = (
        f"{info.path}\n{_KINDS[info.kind]}, {info.duration_s:.1f} s from {start}, {info.size_bytes / 1e6:.1f} MB, "
        f"{messages} messages on {plural(len(info.topics), 'topic')}"
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
