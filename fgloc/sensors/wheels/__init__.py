"""Wheels: odometry messages, wheel angles, or commands in their place, as a motion source."""
