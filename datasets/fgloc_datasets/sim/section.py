"""What all parts of a scenario share: strict sections, vectors, and a generator for each use of the seed."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class Section(BaseModel):
    """A part of a scenario: unknown keys are errors, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def channel_rng(seed: int, channel: str) -> np.random.Generator:
    """A generator of its own for each use, so that adding one draw does not change the others."""
    return np.random.default_rng([seed, *channel.encode()])
