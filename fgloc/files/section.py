"""A part of a settings file as a pydantic model."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, model_validator

SHIPPED = "shipped:"
"""Begins the name of a file that comes with fgloc."""


class Section(BaseModel):
    """A part of the configuration: unknown keys are errors, numbers are finite, values are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _of_comments(cls, content: Any) -> Any:
        """A section whose keys are all comments is an empty one; YAML reads it as None."""
        return {} if content is None else content
