"""Learned motion, inference only: numpy and safetensors, no torch.

Names are imported when they are first used: the settings of this package are read before all others.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fgloc.sensors.learned.card import ModelCard
    from fgloc.sensors.learned.displacement import DisplacementModel
    from fgloc.sensors.learned.forms import MotionModel, MotionPrediction
    from fgloc.sensors.learned.joint import JointCalibration
    from fgloc.sensors.learned.load import load_model, save_model
    from fgloc.sensors.learned.source import LearnedMotion
    from fgloc.sensors.learned.velocity import NaiveModel, VelocityModel

__all__ = [
    "DisplacementModel",
    "JointCalibration",
    "LearnedMotion",
    "ModelCard",
    "MotionModel",
    "MotionPrediction",
    "NaiveModel",
    "VelocityModel",
    "load_model",
    "save_model",
]

_MODULES = {
    "DisplacementModel": "displacement",
    "JointCalibration": "joint",
    "LearnedMotion": "source",
    "ModelCard": "card",
    "MotionModel": "forms",
    "MotionPrediction": "forms",
    "NaiveModel": "velocity",
    "VelocityModel": "velocity",
    "load_model": "load",
    "save_model": "load",
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
