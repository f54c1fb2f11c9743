"""Timing of one topic: rate, gaps, stamps and clocks."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fgloc.config import Config, Role
from fgloc.recording.decode import HEADERLESS, TF_TYPES
from fgloc.recording.roles import TopicInfo
from fgloc.types import FloatArray

_OFF_S = 1.0  # header stamps further from the receive times than this are wrong
_EARLY_S = 0.005
_DRIFT_S = 0.05


@dataclass(frozen=True, slots=True)
class TopicReport:
    """Timing of one topic. Times are from the recording's start; None where there is nothing to tell."""

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
    if topic.role is not None and topic.role not in ("camera_info", "truth", "sightings"):
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
    """Header stamps against receive times; and what is wrong with them."""
    stamps, received = int64(times.stamps), int64(times.decoded)
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
    """What is wrong with the header stamps as a whole."""
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
    """As an array."""
    return np.array(values, dtype=np.int64)
