"""Robots of MRCLAM 6 for `benchmarks.mechanisms`: their landmarks are beacons, which the simulator has not."""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path

from benchmarks.adaptive_mrclam import CASES, DATA, chain, load
from benchmarks.adaptive_recordings import Recorded

SOURCE = DATA / "mrclam6"
ROBOT_CASES = CASES
robot_chain = chain
_scratch: list[tempfile.TemporaryDirectory[str]] = []


@lru_cache(maxsize=2)
def robot(number: int) -> Recorded:
    """The first minutes of one robot, in a folder that lasts as long as the process."""
    if not _scratch:
        _scratch.append(tempfile.TemporaryDirectory())
    return load(SOURCE, number, Path(_scratch[0].name))
