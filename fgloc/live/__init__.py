"""Localization on a running robot: `Live`."""

from fgloc.live.live import Live
from fgloc.live.status import LivePose, LiveStatus, TopicStatus

__all__ = ["Live", "LivePose", "LiveStatus", "TopicStatus"]
