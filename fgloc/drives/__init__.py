"""Drives: how wheels move a robot."""
