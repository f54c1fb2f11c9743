"""Failures of sensors, as filters of events that know nothing of the estimator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from fgloc.ablation.failures.kidnap import Kidnap
from fgloc.ablation.failures.lift import Lift
from fgloc.ablation.failures.sightings import DuplicatedId, MovedMarker, OccludedIds, SightingNoise, WrongIds
from fgloc.ablation.failures.timing import ClockOffset, Dropout, DuplicatedMessages, Latency, Truncated
from fgloc.sensors import registry
from fgloc.sensors.failures import Failure, Scene
from fgloc.types import Event

_OF_ANY_SENSOR = (
    Dropout,
    SightingNoise,
    OccludedIds,
    WrongIds,
    DuplicatedId,
    MovedMarker,
    Latency,
    ClockOffset,
    DuplicatedMessages,
    Truncated,
    Kidnap,
    Lift,
)
if TYPE_CHECKING:
    AnyFailure = Failure
else:
    AnyFailure = Annotated[reduce(or_, (*_OF_ANY_SENSOR, *registry.failures())), Field(discriminator="kind")]
    """Any failure by its ``kind``: those of any sensor, and those that the installed sensors bring."""


def corrupt(
    failures: Sequence[Failure],
    stage: Literal["recorded", "sightings"],
    events: Iterator[Event],
    scenes: Sequence[Scene],
) -> Iterator[Event]:
    """Events after all failures of a stage, one after the other.

    Args:
        failures: in the order in which they act.
        stage: of the events.
        events: in order of receive time.
        scenes: one per failure.
    """
    for failure, scene in zip(failures, scenes, strict=True):
        if failure.stage == stage:
            events = failure.apply(events, scene)
    return events


def generators(count: int, seed: int) -> list[np.random.Generator]:
    """One generator per failure of a chain: what one draws does not depend on the others."""
    return [np.random.default_rng([seed, index]) for index in range(count)]


__all__ = ["AnyFailure", "Failure", "Scene", "corrupt", "generators"]
