"""The gate's part for sightings: each entry is judged, bad ones are taken out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace
from typing import TypeVar

from fgloc.config import GateConfig
from fgloc.intake.field_checks import Changes, FieldChecks, judge_corners
from fgloc.types import (
    MAX_LANDMARK_ID,
    CornersEvent,
    MarkerCorners,
    MarkerPose,
    MarkerPosesEvent,
    RangeBearing,
    RangeBearingEvent,
)

EMPTIED = "emptied"  # reason of an event all parts of which were rejected, and counted, one by one
_SHOWN_IDS = 12
_KEPT_IDS = 1000

S = TypeVar("S", MarkerCorners, MarkerPose, RangeBearing)


class SightingsValidator:
    """Validates sightings; see `fgloc.gate.Gate`."""

    def __init__(
        self,
        config: GateConfig,
        known_ids: Collection[int] | None,
        parts: FieldChecks,
        rejections: Counter[str],
        note: Callable[[str], None],
    ) -> None:
        """Share the gate's counter and notes; ``known_ids`` None: every id passes."""
        self._config = config
        self._known = None if known_ids is None else frozenset(known_ids)
        self._parts = parts
        self._rejections = rejections
        self._note = note
        self._unknown: set[int] = set()
        self._bearings: dict[str, list[int]] = {}  # by topic: beyond 2 pi, all

    @property
    def notes(self) -> tuple[str, ...]:
        """Which ids were ignored."""
        if not self._unknown:
            return ()
        ids = ", ".join(str(i) for i in sorted(self._unknown)[:_SHOWN_IDS])
        more = ", ..." if len(self._unknown) > _SHOWN_IDS else ""
        return (f"sightings of ids that are not in the map are ignored: {ids}{more}",)

    def corners(self, event: CornersEvent) -> CornersEvent | str:
        """The event, a copy without the bad entries, or the reason for rejection."""
        kept = self._sift(event.topic, event.sightings, self._corners)
        if kept is event.sightings:
            return event
        return replace(event, sightings=kept) if kept else EMPTIED

    def marker_poses(self, event: MarkerPosesEvent) -> MarkerPosesEvent | str:
        """The event, a copy without the bad entries, or the reason for rejection."""
        kept = self._sift(event.topic, event.sightings, self._marker_pose)
        if kept is event.sightings:
            return event
        return replace(event, sightings=kept) if kept else EMPTIED

    def range_bearings(self, event: RangeBearingEvent) -> RangeBearingEvent | str:
        """The event, a copy without the bad entries, or the reason for rejection."""
        kept = self._sift(event.topic, event.sightings, self._range_bearing)
        if kept is event.sightings:
            return event
        return replace(event, sightings=kept) if kept else EMPTIED

    def _sift(self, topic: str, sightings: tuple[S, ...], judge: Callable[[str, S], S | str]) -> tuple[S, ...]:
        """Entries that pass, repaired; the same tuple if nothing changed."""
        kept: list[S] = []
        changed = False
        for sighting in sightings:
            number = sighting.landmark_id if isinstance(sighting, RangeBearing) else sighting.marker_id
            verdict = judge(topic, sighting) if 0 <= number <= MAX_LANDMARK_ID else "id_bound"
            if isinstance(verdict, str):
                self._rejections[f"sightings.{verdict}"] += 1
                changed = True
            else:
                kept.append(verdict)
                changed = changed or verdict is not sighting
        return tuple(kept) if changed else sightings

    def _unknown_id(self, landmark_id: int) -> bool:
        if self._known is None or landmark_id in self._known:
            return False
        if len(self._unknown) < _KEPT_IDS:
            self._unknown.add(landmark_id)
        return True

    def _corners(self, topic: str, sighting: MarkerCorners) -> MarkerCorners | str:
        if self._unknown_id(sighting.marker_id):
            return "unknown_id"
        return judge_corners(sighting.corners_px, self._config.min_marker_side_px) or sighting

    def _marker_pose(self, topic: str, sighting: MarkerPose) -> MarkerPose | str:
        if self._unknown_id(sighting.marker_id):
            return "unknown_id"
        distance = math.hypot(*sighting.position.tolist())
        if not math.isfinite(distance):
            return "non_finite"
        if not self._config.min_range <= distance <= self._config.max_range:
            return "range_bound"
        changes: Changes = {}
        reason = self._parts.quaternion(sighting.orientation, "orientation", changes)
        reason = reason or self._parts.covariance(topic, "marker pose", sighting.cov, range(6), "cov", changes)
        if reason:
            return reason
        return replace(sighting, **changes) if changes else sighting

    def _range_bearing(self, topic: str, sighting: RangeBearing) -> RangeBearing | str:
        if self._unknown_id(sighting.landmark_id):
            return "unknown_id"
        distance, bearing = sighting.range_m, sighting.bearing_rad
        if not math.isfinite(distance + bearing):
            return "non_finite"
        if not self._config.min_range <= distance <= self._config.max_range:
            return "range_bound"
        bearings = self._bearings.setdefault(topic, [0, 0])
        bearings[1] += 1
        if abs(bearing) > 2.0 * math.pi:
            bearings[0] += 1
            return "bearing_bound"
        if bearings[0] >= 3 and bearings[0] > 0.2 * bearings[1]:
            self._note(
                f"{topic}: many bearings lie beyond 2 pi: probably degrees where radians were expected; none is used "
                "while that is so: convert the recording"
            )
            return "bearing_unit"
        if abs(bearing) > math.pi:
            return replace(sighting, bearing_rad=math.remainder(bearing, 2.0 * math.pi))
        return sighting
