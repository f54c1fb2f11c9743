"""Which images and marker corners can be used."""

from __future__ import annotations

import math
from collections.abc import Callable

from fgloc.sensors.field_checks import FieldChecks
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.types import Event, FloatArray

_MAX_PIXEL = 1e5


def images(checks: FieldChecks) -> Callable[[ImageEvent], Event | str]:
    """Validator of images."""

    def validate(event: ImageEvent) -> Event | str:
        size = len(event.data)
        if size == 0 or (not event.compressed and (event.width <= 0 or event.height <= 0)):
            return "empty"
        return "truncated" if not event.compressed and size < event.height * event.step else event

    return validate


def corners(checks: FieldChecks) -> Callable[[CornersEvent], Event | str]:
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
