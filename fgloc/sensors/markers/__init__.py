"""Markers in images: found by their corners, each corner a direction from the camera."""
