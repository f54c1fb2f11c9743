"""Robots of MRCLAM 6 for `benchmarks.mechanisms`: their landmarks are beacons, which the simulator has not.

The robots recorded commands and no wheels. The odometry that `benchmarks.adaptive_mrclam` makes of the commands is not
used here: taken as wheels of its own beside a model that reads the same commands, it counts them twice.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from benchmarks.adaptive_mrclam import DATA, chain, load
from benchmarks.adaptive_recordings import Recorded
from benchmarks.adaptive_runs import changed

SOURCE = DATA / "mrclam6"
ROBOT_CASES = ("none", "dropout", "ids30", "moved")  # without wheels nothing slips
robot_chain = chain
_scratch: list[tempfile.TemporaryDirectory[str]] = []


@lru_cache(maxsize=2)
def robot(number: int) -> Recorded:
    """The first minutes of one robot, in a folder that lasts as long as the process."""
    if not _scratch:
        _scratch.append(tempfile.TemporaryDirectory())
    recorded = load(SOURCE, number, Path(_scratch[0].name))
    return replace(recorded, config=changed(recorded.config, {"wheels": {"source": "command"}}))
