"""What a live run gives: poses between keyframes, and how it fares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fgloc.types import Finding, FloatArray, Ground, Mode


@dataclass(frozen=True, slots=True, eq=False)
class LivePose:
    """``T_map_base`` at any time: of the last keyframe at or before it, propagated by the motion sources."""

    stamp_ns: int
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3) in the map frame
    mode: Mode
    keyframe_ns: int  # stamp of the keyframe that it was propagated from
    ground: Ground | None = None  # height, roll and pitch; None: the floor is flat


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """How one topic comes in."""

    role: str
    count: int
    rate_hz: float  # by receive times, lately
    delay_s: float  # receive time less stamp, lately; of sensors whose clock is another one, the offset is in it


@dataclass(frozen=True, slots=True, eq=False)
class LiveStatus:
    """A live run at one time."""

    running: bool = False  # its parts are built; before that it waits for what `waiting_for` names
    mode: Mode | None = None  # of the last keyframe; None: no pose yet
    stamp_ns: int | None = None  # of the last keyframe
    keyframes: int = 0
    step_ms: float = 0.0  # mean wall time of an update, lately
    step_ms_max: float = 0.0  # longest one so far
    reordering_s: float = 0.0  # how far the last keyframe was behind the newest stamp when it was made
    queued_events: int = 0
    queued_images: int = 0
    topics: Mapping[str, TopicStatus] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)  # by role: for overload, not for their contents
    rejections: Mapping[str, int] = field(default_factory=dict)  # by "sensor.reason", as in reports
    waiting_for: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # what is wrong, one sentence each
    findings: tuple[Finding, ...] = ()  # of sensors, settings and estimate; their sentences are notes too


class TopicMeter:
    """Rate and delay of one topic: exponential means over the last messages.

    Attributes:
        last_ns: when the last one was received.
    """

    def __init__(self, role: str) -> None:
        """Nothing has come yet."""
        self._role = role
        self._count = 0
        self.last_ns = 0
        self._interval_s = 0.0
        self._delay_s = 0.0

    def add(self, stamp_ns: int, received_ns: int) -> None:
        """Take in one message."""
        delay = (received_ns - stamp_ns) * 1e-9
        if self._count:
            interval = max(received_ns - self.last_ns, 0) * 1e-9
            share = 1.0 / min(self._count, _MEAN_OF)
            self._interval_s += share * (interval - self._interval_s)
            self._delay_s += share * (delay - self._delay_s)
        else:
            self._delay_s = delay
        self._count += 1
        self.last_ns = received_ns

    @property
    def is_regular(self) -> bool:
        """Whether it comes often enough to be missed."""
        return self._role != "tf" and self._count > 2 and self._interval_s < _REGULAR_S

    def status(self) -> TopicStatus:
        """As it is now."""
        rate = 1.0 / self._interval_s if self._interval_s > 0.0 else 0.0
        return TopicStatus(self._role, self._count, rate, self._delay_s)


_MEAN_OF = 20  # messages
_REGULAR_S = 1.0
