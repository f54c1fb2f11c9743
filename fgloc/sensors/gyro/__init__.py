"""Yaw rate of an IMU as a motion source."""
