"""Settings of marker detection."""

from __future__ import annotations

from pydantic import Field

from fgloc.files.section import Section


class MarkersConfig(Section):
    """Marker detection in images."""

    dictionary: str | None = Field(None, description='OpenCV name, "DICT_4X4_50"; None: the map\'s')
    default_size_m: float | None = Field(None, ge=1e-3, le=5.0, description="side, for maps that give none")
    sigma_px: float = Field(0.5, ge=1e-3, le=100, description="noise of one corner coordinate")
    blur_s: float = Field(
        2e-4,
        ge=0,
        le=0.1,
        description="s: a blurred corner is off by as much as the image moves in this time (3 % of 6 ms)",
    )
    cauchy_k: float = Field(3.0, ge=0.01, le=1e6, description="Cauchy constant in units of sigma")
    max_sightings: int = Field(12, gt=0, le=1000, description="the largest markers of an image that are used")
