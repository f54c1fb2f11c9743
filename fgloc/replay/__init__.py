"""Recorded events through the loop, and the smoothing of what came out."""
