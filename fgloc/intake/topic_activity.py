"""Which topics have messages, and when: in bounded memory, for recordings and live streams alike."""

from __future__ import annotations

from array import array
from collections.abc import Mapping

import numpy as np

from fgloc.config import Role
from fgloc.types import TopicTimes

_MOST = 100_000  # times kept of a topic; of more, every second is dropped


class TopicActivity:
    """Records when messages came. An expected topic without any hints at a mismatch that no error reports.

    Example:
        >>> activity = TopicActivity({"imu": "/imu", "odometry": "/odom"})
        >>> activity.record("/odom", 1_000_000_000)
        >>> [sentence.split(":")[0] for sentence in activity.missing()]
        ['/imu (imu)']
    """

    def __init__(self, expected: Mapping[Role, str]) -> None:
        """``expected``: topic of each role that is to be used."""
        self._expected = dict(expected)
        self._topics: dict[str, _Times] = {}
        self._without = set(expected.values())

    def record(self, topic: str, stamp_ns: int) -> None:
        """Record a message that could be used."""
        times = self._topics.get(topic)
        if times is None:
            times = self._topics[topic] = _Times()
            self._without.discard(topic)
        times.add(stamp_ns)

    def present(self, topic: str) -> None:
        """Record that a topic has messages, without their times."""
        self._without.discard(topic)

    def missing(self) -> tuple[str, ...]:
        """A sentence for each expected topic without a usable message so far.

        A live adapter asks this once the streams should have begun (a few seconds after subscribing), and again at the
        end.
        """
        return tuple(
            f"{topic} ({role}): no usable message has arrived. It is not published, all of its messages were rejected, "
            "or (live, and when recording) the quality of service does not match: subscribe with reliability "
            "best effort and durability volatile."
            for role, topic in self._expected.items()
            if topic in self._without
        )

    def spans(self, origin_ns: int) -> dict[str, TopicTimes]:
        """When each topic had messages, in seconds from a time."""
        return {topic: times.since(origin_ns) for topic, times in sorted(self._topics.items())}


class _Times:
    """Stamps of one topic: all, until they are too many."""

    def __init__(self) -> None:
        self._kept = array("q")
        self._every = 1
        self._count = 0
        self._newest = 0
        self._longest = 0

    def add(self, stamp_ns: int) -> None:
        if self._count and stamp_ns > self._newest:
            self._longest = max(self._longest, stamp_ns - self._newest)
        self._newest = max(self._newest, stamp_ns)
        if self._count % self._every == 0:
            self._kept.append(stamp_ns)
        self._count += 1
        if len(self._kept) > _MOST:
            self._kept = self._kept[::2]
            self._every *= 2

    def since(self, origin_ns: int) -> TopicTimes:
        seconds = np.asarray((np.array(self._kept, dtype=np.int64) - origin_ns) * 1e-9, dtype=np.float64)
        return TopicTimes(seconds, self._count, self._every, self._longest * 1e-9)
