"""Calibration: first settings of a robot, the installation estimated by a run, surveys of markers."""
