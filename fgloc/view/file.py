"""A finished run as a file that rerun's viewer opens."""

from __future__ import annotations

import os
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from fgloc.config import Config
from fgloc.errors import OutputError
from fgloc.types import Decision, Estimate, RunResult
from fgloc.view.scene import Scene, new_stream

if TYPE_CHECKING:
    from rerun import RecordingStream


def write_rrd(result: RunResult, path: Path) -> None:
    """Write a run as an ``.rrd``; the file appears whole or not at all. A truth in another frame is left out.

    Raises:
        OutputError: rerun is not installed, or the file cannot be written.
    """
    unfinished = path.with_name(path.name + ".part")
    stream = new_stream()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.touch()
        stream.save(unfinished)
        draw(result, stream)
        stream.flush()
        stream.disconnect()
        os.replace(unfinished, path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another place with --rrd") from error
    finally:
        with suppress(OSError):
            unfinished.unlink()


def draw(result: RunResult, stream: RecordingStream) -> None:
    """Send a run to a rerun recording stream, from its beginning to its end."""
    settings = (result.config or Config()).truth
    scene = Scene(stream, settings.max_gap_s)
    if result.landmarks is not None:
        scene.add_map(result.landmarks)
    truth = result.truth if settings.align == "none" else None
    next_truth = 0
    decisions: dict[int, list[Decision]] = defaultdict(list)
    for decision in result.decisions:
        decisions[decision.stamp_ns].append(decision)
    covs = result.trajectory.covs
    assert covs is not None  # an estimated trajectory has them
    for k, stamp in enumerate(result.trajectory.stamps_ns.tolist()):
        while (
            truth is not None
            and next_truth < len(truth)
            and (next_truth == 0 or truth.stamps_ns[next_truth - 1] < stamp)
        ):
            scene.add_truth(int(truth.stamps_ns[next_truth]), truth.poses[next_truth])
            next_truth += 1
        decided = tuple(decisions.get(stamp, ()))
        scene.add(Estimate(stamp, result.trajectory.poses[k], covs[k], result.modes[k], decided))
    for note in result.notes:
        scene.note(note)
