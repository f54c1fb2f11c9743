"""Faults of the set-up, from a whole run: clocks, scales, mountings and maps that do not fit together."""
