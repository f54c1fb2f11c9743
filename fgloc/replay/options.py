"""How one recording is run: mode, progress, and what a caller may change on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, TypedDict

from fgloc.types import Estimate, Event, Step

RunMode = Literal["batch", "online"]
Progress = Callable[[float, float], None]
"""Called with seconds of the recording done, and its length."""
EventFilter = Callable[[Iterator[Event]], Iterator[Event]]
"""Changes, drops, adds or delays events; what comes after it does not know."""


class RunOptions(TypedDict, total=False):
    """What `run` takes besides, by keyword.

    Attributes:
        pace: replay at this multiple of real time; None: as fast as possible.
        on_step: called after each step (online displays, benchmarks).
        events: filter of the recorded events (ablations).
        sightings: likewise, of the events once the markers are found: after detection, without images on the recorded.
        detections: file that remembers what was found in the images, for other runs of the same ones.
        check: look for gross mistakes of the set-up first, and run with those undone that are sure; afterwards, where a
            clock seems to be wrong, run again with it corrected, to see whether it is. True if not given; not done on
            filtered events.
    """

    pace: float | None
    on_step: Callable[[Step, Estimate | None], None] | None
    events: EventFilter | None
    sightings: EventFilter | None
    detections: Path | None
    check: bool
