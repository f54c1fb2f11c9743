"""The page of `benchmarks.field`: docs/field.md."""

# ruff: noqa: E501 (lines of the page)
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.field import MODES, Mode, Outcome, nees_of
from benchmarks.field_recordings import Recording
from benchmarks.field_sheet import SHEET, found
from fgloc.files.atomic import atomic_file

_HEAD = """# Recordings by others

`python -m benchmarks.field --page docs/field.md`, of {day}: each recording as a stranger would run it. `fgloc init BAG`, then `info`, `smooth` and
`online` with the `robot.yaml` that `init` wrote and the set's own map; no constant was fitted for a set and no sign put right. Sets that are text are only
rewritten as bags (`benchmarks/field_recordings.py`). Beside fgloc, on the same messages: odometry alone, with its owner's nominal geometry, and a textbook's
iSAM2 with fixed constants, which reads sightings as the headers have them (`benchmarks/field_peers.py`; its smoothed poses are shown).

ATE is the rmse of positions [m] against a truth without frozen poses and glitches. Where the truth's frame is not the map's a rigid motion is fitted for
each estimator alike, and likewise the place of the tracked body on the robot where it is not stated. Odometry is always aligned. NEES/3 is the run's own
(1 is expected). The exit code is that of `smooth` / `online`: 0, 3 (not to be trusted), 1 (no result, with a sentence), 124 (stopped after ten minutes).

Choices were made with the recordings marked *dev* (and with robots 1 and 2 of MRCLAM 6); the others are only reported. Not here: the Husky's windows of 2 s
(no recording lasts) and TagSLAM's sets (no wheels).

| recording | what is peculiar | odometry | textbook | batch | online | NEES/3 | exit | named first |
|---|---|---|---|---|---|---|---|---|
"""


def write_page(path: Path, chosen: Sequence[Recording], outcomes: Mapping[str, Outcome]) -> None:
    """Write the table of all recordings, and of the answer sheet, as Markdown."""
    lines = [_HEAD.format(day=datetime.now(UTC).date().isoformat()).rstrip("\n")]
    lines += [_line(recording, outcomes[recording.name]) for recording in chosen]
    lines += ["", "## What a recording tells by itself", ""]
    lines += [
        "What is peculiar, as it was measured by hand, and whether `init`, `info` or a run's findings say it, with its figure.",
        "",
    ]
    lines += ["| recording | to be told | told |", "|---|---|---|"]
    for trap in SHEET:
        if trap.recording in outcomes:
            lines.append(
                f"| {trap.recording} | {trap.what} | {'yes' if found(trap, outcomes[trap.recording]) else 'no'} |"
            )
    with atomic_file(path) as file:
        file.write("\n".join(lines) + "\n")


def _line(recording: Recording, o: Outcome) -> str:
    nees = " / ".join(_figure(nees_of(o, mode), 2) for mode in MODES)
    codes = " / ".join(str(o.codes.get(mode, "–")) for mode in MODES)
    ates = [_figure(o.ate.get(key), 3) for key in ("odometry", "textbook.batch", "batch", "online")]
    name = f"{recording.name} *dev*" if recording.development else recording.name
    return f"| {name} | {recording.peculiar} | {' | '.join(ates)} | {nees} | {codes} | {_first(o, 'batch')} |"


def _figure(value: float | None, digits: int) -> str:
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.{digits}f}" if value < 1e4 else f"{value:.1e}"


def _first(o: Outcome, mode: Mode) -> str:
    findings = o.findings(mode)
    if not findings:
        return "–"
    text = str(findings[0]["text"]).replace("|", "\\|").replace("\n", " ")
    return text if len(text) < 160 else f"{text[:157]}…"
