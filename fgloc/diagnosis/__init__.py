"""What the whole run says about the set-up: clocks, scales, mountings and maps that do not fit together."""

from fgloc.diagnosis.diagnosis import Diagnosis

__all__ = ["Diagnosis"]
