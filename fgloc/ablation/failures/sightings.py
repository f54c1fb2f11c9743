"""Failures of what is seen: markers hidden, misread, doubled, moved, or measured badly."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fgloc.frames import rpy_matrix
from fgloc.sensors.failures import Change, EventFailure, Failure, Scene
from fgloc.types import Event, LandmarkMap, Sighting, SightingsEvent


class SightingFailure(EventFailure):
    """A failure that changes or hides single sightings; a message left empty stays, as a camera would send it."""

    stage: ClassVar[Literal["recorded", "sightings"]] = "sightings"

    def targets(self) -> tuple[type[Event], ...]:
        """Sightings of all kinds."""
        return (SightingsEvent,)

    def begin(self, scene: Scene) -> Change:
        """Apply `alter` to each sighting of a message."""
        alter = self.alter(scene)

        def change(event: Event) -> Event | None:
            assert isinstance(event, SightingsEvent)
            after = tuple(s for s in map(alter, event.sightings) if s is not None)
            same = len(after) == len(event.sightings) and all(
                a is b for a, b in zip(after, event.sightings, strict=True)
            )
            return event if same else replace(event, sightings=after)

        return change

    @abstractmethod
    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """What happens to one sighting (None: hidden), with the state of one run."""


class SightingNoise(SightingFailure):
    """White noise, of the standard deviations below, on each number that a sighting reports."""

    kind: Literal["sighting_noise"] = "sighting_noise"
    corner_px: float = Field(0.0, ge=0, description="px, on each coordinate of each corner")
    range_m: float = Field(0.0, ge=0, description="m")
    bearing_rad: float = Field(0.0, ge=0, description="rad")
    position_m: float = Field(0.0, ge=0, description="m, on each coordinate of a marker pose")

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Add the noise of the sighting's kind."""
        sigmas = {name: getattr(self, name) for name in ("corner_px", "range_m", "bearing_rad", "position_m")}
        return lambda s: s.noisy(sigmas, scene.rng)


class OccludedIds(SightingFailure):
    """Markers are hidden: those of ``ids``, and a random ``part`` of the map's others, the same throughout a run."""

    kind: Literal["occluded_ids"] = "occluded_ids"
    ids: tuple[int, ...] = ()
    part: float = Field(0.0, ge=0, le=1, description="share of the map's markers; the number is rounded")

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Hide the chosen ids."""
        others = [i for i in scene.landmark_ids if i not in self.ids]
        order = scene.rng.permutation(len(others))  # drawn whole: a larger part holds the smaller one
        hidden = {*self.ids, *(others[k] for k in order[: round(self.part * len(others))])}
        return lambda s: None if s.landmark_id in hidden else s


class WrongIds(SightingFailure):
    """A sighting is read as another marker of the map with probability ``probability``."""

    kind: Literal["wrong_ids"] = "wrong_ids"
    probability: float = Field(0.05, ge=0, le=1, description="of each sighting")

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Draw another id of the map."""

        def misread(s: Sighting) -> Sighting:
            others = [i for i in scene.landmark_ids if i != s.landmark_id]
            if not others or scene.rng.uniform() >= self.probability:
                return s
            return replace(s, landmark_id=others[int(scene.rng.integers(len(others)))])

        return misread


class DuplicatedId(SightingFailure):
    """Two markers carry one id: the map's marker ``other`` reports as ``marker_id``; random ones where not given."""

    kind: Literal["duplicated_id"] = "duplicated_id"
    marker_id: int | None = None
    other: int | None = None

    def alter(self, scene: Scene) -> Callable[[Sighting], Sighting | None]:
        """Rename one marker."""
        free = [i for i in scene.landmark_ids if i not in (self.marker_id, self.other)]
        drawn = [free[k] for k in scene.rng.permutation(len(free))]
        kept = self.marker_id if self.marker_id is not None else next(iter(drawn), None)
        renamed = self.other if self.other is not None else next((i for i in drawn if i != kept), None)
        if kept is None or renamed is None:
            return lambda s: s
        return lambda s: replace(s, landmark_id=kept) if s.landmark_id == renamed else s


class MovedMarker(Failure):
    """Markers are not where the map has them, throughout the run.

    Each of ``ids`` (or ``count`` random markers) stands ``distance_m`` away in a random horizontal direction and turned
    by ``yaw_rad`` about the vertical. That the map is moved instead of the marker is the same to the robot: all of
    them ``together`` are a map that is shifted as a whole (each turns about itself).
    """

    timed: ClassVar[bool] = False
    kind: Literal["moved_marker"] = "moved_marker"
    ids: tuple[int, ...] = ()
    count: int = Field(1, ge=1, description="markers to be moved if no ids are given")
    distance_m: float = Field(0.3, ge=0, description="m")
    yaw_rad: float = Field(0.0, description="rad, counter-clockwise from above")
    together: bool = Field(False, description="all in the same direction")

    def apply(self, events: Any, scene: Scene) -> Any:
        """All events as they were."""
        return events

    def corrupt_map(self, landmark_map: LandmarkMap, scene: Scene) -> LandmarkMap:
        """The map with some markers elsewhere."""
        order = [scene.landmark_ids[k] for k in scene.rng.permutation(len(scene.landmark_ids))]
        chosen = set(self.ids) or set(order[: self.count])
        turn = rpy_matrix(0.0, 0.0, -self.yaw_rad)
        moved = dict(landmark_map.landmarks)
        direction = scene.rng.uniform(-np.pi, np.pi)
        for n, i in enumerate(sorted(chosen & set(moved))):
            if n > 0 and not self.together:
                direction = scene.rng.uniform(-np.pi, np.pi)
            shift = self.distance_m * np.array([np.cos(direction), np.sin(direction), 0.0])
            landmark = moved[i]
            rotation = turn @ landmark.rotation if landmark.size_m > 0 else landmark.rotation
            moved[i] = replace(landmark, position=landmark.position - shift, rotation=rotation)
            self.touch(scene)
        return replace(landmark_map, landmarks=moved)
