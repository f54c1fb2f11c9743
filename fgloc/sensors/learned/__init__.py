"""Learned motion, inference only: numpy and safetensors, no torch."""

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
