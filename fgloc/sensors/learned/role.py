"""The learned motion as the motion model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fgloc.sensors.learned.config import MotionConfig, shipped_name
from fgloc.sensors.learned.installation import INSTALLATION
from fgloc.sensors.roles import ModelRole, with_values
from fgloc.types import FloatArray

if TYPE_CHECKING:
    from fgloc.config import Config
    from fgloc.sensors.equipment import ErrorCorrelation, MotionPredictor


def _build(config: Config, up: Callable[[], FloatArray] | None) -> MotionPredictor | None:
    if not config.motion.use or config.motion.model is None:
        return None
    from fgloc.sensors.learned.load import load_model
    from fgloc.sensors.learned.source import LearnedMotion

    model = load_model(config.motion.model)
    return LearnedMotion(model, config.motion, (0.0, 0.0, 1.0) if up is None else up())


def _correlation(config: Config, predictor: MotionPredictor) -> ErrorCorrelation | None:
    joint: ErrorCorrelation | None = predictor.model.joint
    return joint if config.motion.correlation == "joint" else None


def _given(config: Config, model: Path) -> Config:
    motion = MotionConfig(model=model, use=True, correlation=config.motion.correlation)
    return config.model_copy(update={"motion": motion})


def _left_out(seconds: float) -> str:
    return (
        f"The motion model was left out for {seconds:.1f} s: sightings contradict it. It may be of another robot or "
        "floor: train one of this robot (fgloc train), or set motion.use: false."
    )


ROLE = ModelRole(
    installation=INSTALLATION,
    build=_build,
    correlation=_correlation,
    given=_given,
    without=lambda config: with_values(config, "motion", {"use": False}),
    left_out=_left_out,
    shipped_name=shipped_name,
)
