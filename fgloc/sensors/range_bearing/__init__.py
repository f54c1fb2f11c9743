"""Ranges with bearings of landmarks."""
