"""Which marker poses can be used."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from fgloc.sensors.field_checks import Changes, FieldChecks
from fgloc.sensors.marker_pose.events import MarkerPose, MarkerPosesEvent
from fgloc.types import Event


def marker_poses(checks: FieldChecks) -> Callable[[MarkerPosesEvent], Event | str]:
    """Validator of marker poses."""
    bounds = checks.config

    def judge(topic: str, sighting: MarkerPose) -> MarkerPose | str:
        distance = math.hypot(*sighting.position.tolist())
        if not math.isfinite(distance):
            return "non_finite"
        if not bounds.min_range < distance <= bounds.max_range:
            return "range_bound"
        changes: Changes = {}
        reason = checks.quaternion(sighting.orientation, "orientation", changes)
        reason = reason or checks.covariance(topic, "marker pose", sighting.cov, range(6), "cov", changes)
        if reason:
            return reason
        return replace(sighting, **changes) if changes else sighting

    return lambda event: checks.sift(event, judge)
