"""Settings of the learned motion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from fgloc.files.section import SHIPPED, Section

MODELS = Path(__file__).parent / "models"


def model_path(given: Any) -> Any:
    """The file of a motion model; ``shipped:NAME`` is one that comes with the package.

    Raises:
        ValueError: no model of this name is shipped; those that are get listed.
    """
    if not str(given).startswith(SHIPPED):
        return given
    path = MODELS / (str(given).removeprefix(SHIPPED) + ".safetensors")
    if path.is_file():
        return path
    names = ", ".join(
        sorted(f"{SHIPPED}{p.relative_to(MODELS).with_suffix('')}" for p in MODELS.rglob("*.safetensors"))
    )
    raise ValueError(f"{given} is not shipped; there are {names}")


def shipped_name(path: Path) -> str | None:
    """``shipped:NAME`` of a file that comes with the package; None for others."""
    return f"{SHIPPED}{path.relative_to(MODELS).with_suffix('')}" if path.is_relative_to(MODELS) else None


class MotionConfig(Section):
    """The learned motion model."""

    model: Annotated[Path | None, BeforeValidator(model_path)] = Field(
        None,
        description="a .safetensors file that fgloc train wrote, or a shipped one: shipped:sim/diff_drive",
    )
    use: bool = True
    scale: float = Field(1.0, ge=0.01, le=100, description="this robot's distance over the model's")
    scale_sigma: float = Field(
        0.01, ge=0, le=0.5, description="how far this robot may be faster or slower than the model's; estimated"
    )
    correlation: Literal["joint", "independent"] = Field(
        "joint", description="joint: decorrelated from the wheels; independent: counted twice (for comparison)"
    )
