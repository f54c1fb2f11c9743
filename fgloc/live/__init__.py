"""Localization on a running robot: `Live`."""

from fgloc.live.engine import LiveStatus, TopicStatus
from fgloc.live.extrapolation import LivePose
from fgloc.live.live import Live

__all__ = ["Live", "LivePose", "LiveStatus", "TopicStatus"]
