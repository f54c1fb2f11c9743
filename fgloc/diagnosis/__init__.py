"""Faults of the set-up, from a whole run: clocks, scales, mountings and maps that do not fit together."""

from fgloc.diagnosis.diagnosis import Diagnosis

__all__ = ["Diagnosis"]
