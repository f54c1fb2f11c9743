"""Robustness: noise and faults of the motion sources, association and faults of landmarks."""
