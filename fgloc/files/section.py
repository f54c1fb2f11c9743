"""A part of a settings file as a pydantic model."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

SHIPPED = "shipped:"
"""Begins the name of a file that comes with fgloc."""


class Section(BaseModel):
    """A part of the configuration: unknown keys are errors, numbers are finite, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
