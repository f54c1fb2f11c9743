"""Identification of the robot: data, models (torch), training, evaluation, export."""
