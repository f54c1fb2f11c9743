"""Learned motion, inference only: numpy and safetensors, no torch."""

from fgloc.motion.card import ModelCard
from fgloc.motion.displacement import DisplacementModel
from fgloc.motion.forms import MotionModel, MotionPrediction
from fgloc.motion.joint import JointCalibration
from fgloc.motion.load import load_model, save_model
from fgloc.motion.source import LearnedMotion
from fgloc.motion.velocity import NaiveModel, VelocityModel

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
