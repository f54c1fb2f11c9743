"""Failures of sensors, as filters of events that know nothing of the estimator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from fgloc.ablation.failures.base import Failure, Scene
from fgloc.ablation.failures.camera import Darkness, FrameRate, MirroredImage
from fgloc.ablation.failures.kidnap import Kidnap
from fgloc.ablation.failures.lift import Lift
from fgloc.ablation.failures.messages import (
    EncoderFrozen,
    EncoderRollover,
    ImuBias,
    OdometryReset,
    WheelNan,
    WrongCovariance,
)
from fgloc.ablation.failures.sightings import DuplicatedId, MovedMarker, OccludedIds, SightingNoise, WrongIds
from fgloc.ablation.failures.timing import ClockOffset, Dropout, DuplicatedMessages, Latency, Truncated
from fgloc.ablation.failures.wheels import EncoderDead, EncoderQuantized, WheelScaleDrift, WheelSlip
from fgloc.types import Event

BuiltInFailure = (
    Dropout
    | Darkness
    | FrameRate
    | MirroredImage
    | SightingNoise
    | OccludedIds
    | WrongIds
    | DuplicatedId
    | MovedMarker
    | Latency
    | ClockOffset
    | DuplicatedMessages
    | Truncated
    | Kidnap
    | Lift
    | WheelSlip
    | EncoderDead
    | EncoderFrozen
    | EncoderQuantized
    | EncoderRollover
    | WheelScaleDrift
    | OdometryReset
    | WheelNan
    | WrongCovariance
    | ImuBias
)
AnyFailure = Annotated[BuiltInFailure, Field(discriminator="kind")]
"""Any failure of a built-in sensor, by its ``kind``; a suite knows those of other packages' sensors too."""


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


__all__ = ["AnyFailure", "BuiltInFailure", "Failure", "Scene", "corrupt", "generators"]
