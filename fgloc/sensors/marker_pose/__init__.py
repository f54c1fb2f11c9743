"""Poses of markers, as another node has estimated them from single views."""
