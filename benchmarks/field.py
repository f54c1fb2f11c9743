"""Recordings that others made, as a user would run them: ``python -m benchmarks.field [--quick] [--only NAME,...]``.

Each of `benchmarks.field_recordings.RECORDINGS` goes through ``fgloc init`` into a fresh folder, then ``info``,
``smooth`` and ``online`` with the ``robot.yaml`` that ``init`` wrote and the set's own map, as command lines. Beside
them odometry alone and a textbook's iSAM2 run on the same messages (`benchmarks.field_peers`). What a recording is to
tell by itself is in `benchmarks.field_sheet`.

ATE is the rmse of positions at the stamps of the odometry (10 Hz at most) against a truth without frozen poses and
glitches. Where the truth's frame is not the map's, one rigid motion is fitted for each estimator alike, and likewise
the place of the tracked body on the robot where it is not stated, and the clock of a truth without stamps. An odometry
has a frame of its own always.

- ``field.NAME.{batch,online}.{ate_m,ate_over_odometry,ate_over_textbook,nees_over_3,exit}``
- ``field.NAME.MODE.ate_over_textbook_begun_alike``, ``field.worse_begun_alike``: as ``field.worse``, against a textbook
  that starts from the run's own first pose. The other one starts from the truth's, which no user has.
- ``field.worse``: runs whose ATE is over 1.05 times and 2 mm more than that of odometry or of the textbook, without
  exit 3 and the right cause first. A run that gives poses for less than half of the time has no ATE, and is worse if it
  ends with 0. ``field.crashes``: commands that ended neither with 0 or 3 nor with a sentence.
- ``field.geomean_over_odometry``: of runs with truth and landmarks. ``field.nees``: share of runs with NEES/3 in 0.4 to
  2.5, or exit 3 with the right cause. ``field.traps_found``, ``field.false``: see `benchmarks.field_sheet`.
- ``field.beyond_gate``: constants that were used more than 4 prior sigmas from what was given.

``--windows N``: N windows of each recording that has a truth and landmarks, of a fifth to seven tenths of it, drawn by
``--seed``, in place of the recordings; with ``--unmapped`` without the sets' maps.

- ``field.window.lost``: runs that end with 0 although their ATE is over twice that of odometry and of the textbook
  begun alike, and 5 cm more, and NEES/3 over 6: whose covariance is wrong, too.
- ``field.window.geomean_over_odometry``: as above, of the windows whose truth's frame is fitted, as the odometry's is.
- ``field.window.nees``: as above, of all windows that end with 0.

``--changes NAMES`` (``all``, or some of `benchmarks.field_changes.CHANGES`): each change in one such window, of a recording
that the seed draws (with ``--only`` of these): ``field.change.*``, as the rows of windows.
"""

# ruff: noqa: E501 (lines of the page)
from __future__ import annotations

import argparse
import json
import math
import random
import re
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from benchmarks.common import DATA, Row, main, not_run
from benchmarks.field_changes import CHANGES, MAPS, changed
from benchmarks.field_peers import Heard, hear, textbook
from benchmarks.field_recordings import RECORDINGS, Recording, window
from benchmarks.field_sheet import MODES, SHEET, SOUND, Mode, Outcome, false_findings, found, right_cause
from benchmarks.replays import kept
from fgloc import se2
from fgloc.files.atomic import atomic_file
from fgloc.files.outputs import read_tum
from fgloc.sensors.maps import load_map
from fgloc.types import FloatArray, IntArray, Trajectory

QUICK = ("duarte", "turtlebot_aruco", "uwb_indoor")
_WORKERS = 2
_LIMIT_S = 600.0  # of a command
_WORSE, _WORSE_M = 1.05, 0.002
_GATE = 4.0  # prior sigmas
_NEES = (0.4, 2.5)
_LAGS_S = np.arange(-0.3, 0.3001, 0.02)  # of a truth without stamps
_BRIDGED_S = 1.0  # between poses of an estimate
_LEAST = 10  # compared positions
_SHARE = 0.5  # of the stamps with a truth: an estimate of less is none of the recording
_ESCAPES = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")


# --- Errors -----------------------------------------------------------------------------------------------------------


def distances(poses: FloatArray, truth: FloatArray, align: bool, lever: bool) -> FloatArray:
    """Distances ``(n,)`` [m] of ``poses (n, 3)`` from positions ``truth (n, 2)``, by the best motion and lever arm.

    Least squares over the angle and place of the truth's frame (``align``) and the place of the tracked body on the
    robot (``lever``), in closed form: with complex numbers z + exp(i yaw) a = c w + t, where c has length one.
    """
    z, w = (p[:, 0] + 1j * p[:, 1] for p in (poses, truth))
    columns = [np.exp(1j * poses[:, 2])] if lever else []
    if align:
        columns.append(np.ones(len(z), dtype=complex))
    if columns:
        basis = np.linalg.qr(np.column_stack(columns))[0]
        z, w = (p - basis @ (basis.conj().T @ p) for p in (z, w))
    if align:
        turn = np.vdot(w, z)
        w = w * (turn / abs(turn) if abs(turn) > 0.0 else 1.0)
    return np.asarray(np.abs(z - w))


def ate(estimate: Trajectory, truth: Trajectory, at_ns: IntArray, align: bool, lever: bool, clock: bool) -> float:
    """Rmse of positions at these stamps [m]; NaN if there are poses for less than half of those with a truth."""
    gap = max(0.25, 3.0 * float(np.median(np.diff(truth.stamps_ns))) * 1e-9)
    asked = int(_covered(truth.stamps_ns, at_ns, gap).sum())
    at_ns = at_ns[_covered(estimate.stamps_ns, at_ns, _BRIDGED_S)]
    if len(at_ns) == 0:
        return math.nan
    poses = se2.interpolate(estimate.stamps_ns, estimate.poses, at_ns)
    best = math.inf
    for lag in _LAGS_S if clock else np.zeros(1):
        shifted = at_ns + round(float(lag) * 1e9)
        known = _covered(truth.stamps_ns, shifted, gap)
        if known.sum() < max(_LEAST, _SHARE * asked):
            continue
        true = np.column_stack([np.interp(shifted[known], truth.stamps_ns, truth.poses[:, k]) for k in (0, 1)])
        best = min(best, float(np.sqrt(np.mean(distances(poses[known], true, align, lever) ** 2))))
    return best if math.isfinite(best) else math.nan


def _covered(stamps: IntArray, at_ns: IntArray, gap_s: float) -> Any:
    """Mask of the times that lie between two stamps at most ``gap_s`` apart."""
    if len(stamps) < 2:
        return np.zeros(len(at_ns), dtype=bool)
    k = np.clip(np.searchsorted(stamps, at_ns), 1, len(stamps) - 1)
    inside = (at_ns >= stamps[0]) & (at_ns <= stamps[-1])
    return inside & (stamps[k] - stamps[k - 1] <= gap_s * 1e9)


# --- Runs -------------------------------------------------------------------------------------------------------------


def outcome(recording: Recording) -> Outcome:
    """Run a recording through the commands and score it; the commands' results are kept by the sources' hash."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        try:
            bag = recording.bag(folder)
            ran = ran_through(recording, bag, folder)
        except Exception as error:  # a recording that breaks is a row
            return Outcome(error=f"{type(error).__name__}: {error}")
        out = Outcome(
            {name: r["said"] for name, r in ran.items()},
            {name: r["code"] for name, r in ran.items()},
            {name: r["metrics"] for name, r in ran.items() if r.get("metrics")},
        )
        try:
            heard, landmarks = hear(bag, recording.truth), landmarks_of(recording, folder)
            if heard.truth is not None:
                out.ate = ates(recording, heard, estimates_of(recording, heard, landmarks, ran), bool(landmarks))
        except Exception as error:
            out.error = f"{type(error).__name__}: {error}"
    return out


def ran_through(recording: Recording, bag: Path, folder: Path, begun: FloatArray | None = None) -> Mapping[str, Any]:
    """Exit code, output, time, poses and metrics of each command line, kept by the hash of the sources.

    Args:
        recording: what the bag holds.
        bag: where it is.
        folder: of the results.
        begun: first pose ``(3,)`` to give besides; None: what ``init`` writes alone.
    """
    name = recording.name if begun is None else f"{recording.name}_begun"
    return kept(f"field_{name}", lambda: _commands(recording, bag, folder, begun))


def _commands(recording: Recording, bag: Path, folder: Path, begun: FloatArray | None) -> dict[str, Any]:
    results_in = folder if begun is None else folder / "begun"
    config, found_map = results_in / "init" / "robot.yaml", recording.map_path(folder)
    config.parent.mkdir(parents=True)
    given = [str(bag), "--config", str(config), *([] if found_map is None else ["--map", str(found_map)])]
    results = {"init": _command(["init", str(bag), "--out", str(config)])}
    if begun is not None:
        settings = yaml.safe_load(config.read_text(encoding="utf-8"))
        settings["estimator"] = (settings.get("estimator") or {}) | {"initial_pose": begun.tolist()}
        config.write_text(yaml.safe_dump(settings), encoding="utf-8")
    if not config.is_file():
        given = [part for part in given if part not in ("--config", str(config))]
    results["info"] = _command(["info", *given])
    for mode, name in (("batch", "smooth"), ("online", "online")):
        out = results_in / mode
        results[mode] = _command([name, *given, "--out", str(out)])
        if (out / "metrics.json").is_file():
            results[mode]["metrics"] = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
        if (out / "trajectory.tum").is_file():
            tum = read_tum(out / "trajectory.tum")
            results[mode] |= {"stamps": tum.stamps_ns.tolist(), "poses": tum.poses.tolist()}
    return results


def _command(arguments: Sequence[str]) -> dict[str, Any]:
    began = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, "-m", "fgloc.cli", *arguments],
            capture_output=True,
            text=True,
            timeout=_LIMIT_S,
            check=False,
        )
        said, code = done.stdout + done.stderr, done.returncode
    except subprocess.TimeoutExpired:
        said, code = f"error: longer than {_LIMIT_S:.0f} s", 124
    return {"code": code, "said": _ESCAPES.sub("", said), "seconds": round(time.monotonic() - began, 1)}


def estimates_of(
    recording: Recording, heard: Heard, landmarks: Mapping[int, FloatArray], ran: Mapping[str, Any]
) -> dict[str, Trajectory]:
    """Trajectories of odometry, of the textbook, and of the commands that were run."""
    estimates: dict[str, Trajectory] = {}
    if heard.odometry is not None:
        estimates["odometry"] = heard.odometry
    if (plain := textbook(heard, landmarks)) is not None:
        estimates["textbook.online"], estimates["textbook.batch"] = plain
    for mode in MODES:
        if "poses" in ran[mode] and len(ran[mode]["poses"]) > 1:
            estimates[mode] = own = Trajectory(np.array(ran[mode]["stamps"]), np.array(ran[mode]["poses"]))
            begun = (int(own.stamps_ns[0]), own.poses[0])
            if landmarks and (plain := textbook(heard, landmarks, begun)) is not None:
                estimates[f"alike.{mode}"] = plain[mode == "batch"]
    return estimates


def ates(recording: Recording, heard: Heard, estimates: Mapping[str, Trajectory], mapped: bool) -> dict[str, float]:
    """ATE [m] of each estimate that covers half of the truth; ``mapped``: they are in the frame of a map."""
    truth = heard.truth
    assert truth is not None
    base = heard.odometry or estimates.get("batch") or estimates.get("online")
    if len(truth.stamps_ns) < 2 or base is None:
        return {}
    at_ns = base.stamps_ns[np.r_[True, np.diff(base.stamps_ns // 100_000_000) > 0]]
    stampless = recording.truth.endswith("ground_pose")
    out = {}
    for name, estimate in estimates.items():
        align = recording.frame == "se2" or name == "odometry" or not mapped
        value = ate(estimate, truth, at_ns, align, recording.lever, stampless)
        if math.isfinite(value):
            out[name] = value
    return out


def landmarks_of(recording: Recording, folder: Path) -> dict[int, FloatArray]:
    """Places ``(2,)`` of the map's landmarks where the truth is in its frame, by id; else none."""
    path = recording.map_path(folder) if recording.frame == "map" else None
    return {} if path is None else {i: k.position[:2] for i, k in load_map(path).landmarks.items()}


# --- Rows -------------------------------------------------------------------------------------------------------------


def measure(quick: bool, only: Sequence[str] = (), page: Path | None = None) -> Iterator[Row]:
    """Rows of the benchmark; a quick run has three recordings."""
    chosen = [r for r in RECORDINGS if r.name in (only or (QUICK if quick else [x.name for x in RECORDINGS]))]
    if not DATA.is_dir():
        yield from not_run(["field.worse", "field.traps_found"], f"no {DATA}; set FGLOC_REAL_DATA")
        return
    with ThreadPoolExecutor(_WORKERS) as pool:
        outcomes = {}
        for recording, o in zip(chosen, pool.map(outcome, chosen), strict=True):
            outcomes[recording.name] = o
            _say(recording, o)
    for recording in chosen:
        yield from _of_recording(recording, outcomes[recording.name])
    yield from _of_all(chosen, outcomes)
    if page is not None:
        write_page(page, chosen, outcomes)


def windows(count: int, seed: int, only: Sequence[str] = (), mapped: bool = True) -> Iterator[Row]:
    """Rows of windows of the recordings; ``mapped``: with the sets' maps."""
    if not DATA.is_dir():
        yield from not_run(["field.window.lost"], f"no {DATA}; set FGLOC_REAL_DATA")
        return
    rng, chosen = random.Random(seed), []
    for recording in (r for r in RECORDINGS if r.truth and r.landmarks):
        for _ in range(count):
            share = rng.uniform(0.2, 0.7)
            first = rng.uniform(0.0, 1.0 - share)
            if not only or recording.name in only:
                chosen.append(window(recording, first, first + share, mapped))
    yield from _of_parts("window", chosen)


def changes(names: Sequence[str], seed: int, only: Sequence[str] = ()) -> Iterator[Row]:
    """Rows of windows of recordings with one thing changed in each."""
    if not DATA.is_dir():
        yield from not_run(["field.change.lost"], f"no {DATA}; set FGLOC_REAL_DATA")
        return
    chosen = []
    for name in names or (*CHANGES, *MAPS):
        rng = random.Random(f"{name} {seed}")
        able = [r for r in RECORDINGS if r.truth and r.landmarks and (r.frame == "map" or name not in MAPS)]
        recording = rng.choice([r for r in able if not only or r.name in only])
        first = rng.uniform(0.0, 0.3)
        chosen.append(changed(window(recording, first, first + 0.7), name, seed))
    yield from _of_parts("change", chosen)


def _of_parts(kind: str, chosen: Sequence[Recording]) -> Iterator[Row]:
    with ThreadPoolExecutor(_WORKERS) as pool:
        outcomes = dict(zip(chosen, pool.map(outcome, chosen), strict=True))
    for r, o in outcomes.items():
        _say(r, o)
    runs = [(r, o, mode) for r, o in outcomes.items() for mode in MODES]
    for r, o, mode in runs:
        if mode in o.ate:
            yield Row(f"field.{kind}.{r.name}.{mode}.ate_m", o.ate[mode], unit="m")
    lost = [f"{r.name}.{mode}" for r, o, mode in runs if _lost(o, mode)]
    yield Row(f"field.{kind}.lost", float(len(lost)), n=len(runs), unit=" ".join(lost))
    fitted = [(o, mode) for r, o, mode in runs if r.frame == "se2" and {mode, "odometry"} <= o.ate.keys()]
    logs = np.log([o.ate[mode] / o.ate["odometry"] for o, mode in fitted])
    if len(logs):
        yield Row(f"field.{kind}.geomean_over_odometry", float(np.exp(logs.mean())), float(logs.std()), len(logs))
    judged = [nees for _, o, mode in runs if o.codes.get(mode) == 0 and (nees := nees_of(o, mode)) is not None]
    if judged:
        good = [_NEES[0] <= nees <= _NEES[1] for nees in judged]
        yield Row(f"field.{kind}.nees", float(np.mean(good)), n=len(judged))


def _lost(o: Outcome, mode: Mode) -> bool:
    """Whether a run is far off, by its own covariance too, and does not say so."""
    best = min((o.ate[name] for name in ("odometry", f"alike.{mode}") if name in o.ate), default=math.inf)
    far = o.ate.get(mode, 0.0) > 2.0 * best + 0.05
    return far and o.codes.get(mode) == 0 and (nees_of(o, mode) or 0.0) > 6.0


def _of_recording(recording: Recording, o: Outcome) -> Iterator[Row]:
    for name in ("odometry", "textbook.batch", "textbook.online"):
        if name in o.ate:
            yield Row(f"field.{recording.name}.{name}.ate_m", o.ate[name], unit="m")
    for mode in MODES:
        row = f"field.{recording.name}.{mode}"
        yield Row(f"{row}.exit", float(o.codes.get(mode, -1)))
        if mode in o.ate:
            yield Row(f"{row}.ate_m", o.ate[mode], unit="m")
            rivals = {"odometry": "odometry", "textbook": f"textbook.{mode}", "textbook_begun_alike": f"alike.{mode}"}
            for name, key in rivals.items():
                if key in o.ate:
                    yield Row(f"{row}.ate_over_{name}", o.ate[mode] / o.ate[key])
        elif recording.truth:
            first = next(iter(o.findings(mode)), {"text": o.error or "no poses"})
            yield from not_run([f"{row}.ate_m"], str(first["text"])[:120])
        if (nees := nees_of(o, mode)) is not None:
            yield Row(f"{row}.nees_over_3", nees)


def _of_all(chosen: Sequence[Recording], outcomes: Mapping[str, Outcome]) -> Iterator[Row]:
    runs = [(r, outcomes[r.name], mode) for r in chosen for mode in MODES]
    compared = [run for run in runs if math.isfinite(run[1].best(run[2])) and run[1].codes.get(run[2]) != 1]
    bad = [run for run in compared if worse(*run)]
    yield Row("field.worse", float(len(bad)), n=len(compared), unit=" ".join(f"{r.name}.{m}" for r, _, m in bad))
    bad = [run for run in compared if worse(*run, textbook="alike")]
    unit = " ".join(f"{r.name}.{m}" for r, _, m in bad)
    yield Row("field.worse_begun_alike", float(len(bad)), n=len(compared), unit=unit)
    crashed = [f"{name}.{c}" for name, o in outcomes.items() for c, code in o.codes.items() if crash(o, c, code)]
    yield Row(
        "field.crashes", float(len(crashed)), n=sum(len(o.codes) for o in outcomes.values()), unit=" ".join(crashed)
    )
    ratios = [o.ate[m] / o.ate["odometry"] for r, o, m in compared if r.landmarks and {m, "odometry"} <= o.ate.keys()]
    if ratios:
        logs = np.log(ratios)
        yield Row("field.geomean_over_odometry", float(np.exp(logs.mean())), float(logs.std()), len(ratios))
    judged = [(r, o, m, nees) for r, o, m in runs if (nees := nees_of(o, m)) is not None]
    good = [_NEES[0] <= nees <= _NEES[1] or excused(r, o, m) for r, o, m, nees in judged]
    if good:
        yield Row("field.nees", float(np.mean(good)), n=len(good))
    traps = [(trap, found(trap, outcomes[trap.recording])) for trap in SHEET if trap.recording in outcomes]
    if traps:
        missed = ", ".join(f"{t.recording}: {t.what}" for t, hit in traps if not hit)
        yield Row(
            "field.traps_found", float(np.mean([hit for _, hit in traps])), n=len(traps), unit=f"missed: {missed}"
        )
    wrong = [text for name, o in outcomes.items() for text in false_findings(name, o)]
    yield Row("field.false", float(len(wrong)), n=sum(s.recording in outcomes for s in SOUND), unit=" | ".join(wrong))
    beyond = [name for r, o, m in runs for name in beyond_gate(r, o, m)]
    yield Row("field.beyond_gate", float(len(beyond)), n=len(runs), unit=" ".join(beyond))


def nees_of(o: Outcome, mode: Mode) -> float | None:
    """NEES/3 by the run's own metrics; None without a truth."""
    value = o.metrics.get(mode, {}).get("nees_over_3")
    return None if value is None else float(value)


def worse(recording: Recording, o: Outcome, mode: Mode, textbook: str = "textbook") -> bool:
    """Whether a run is worse than odometry or a textbook without exit 3 and the right cause first."""
    value, best = o.ate.get(mode, math.inf), o.best(mode, textbook)
    if mode not in o.ate:
        return o.codes.get(mode) != 3
    return value > max(_WORSE * best, best + _WORSE_M) and not excused(recording, o, mode)


def excused(recording: Recording, o: Outcome, mode: Mode) -> bool:
    """Whether a run ended with exit 3 and one of the recording's peculiarities as its first finding."""
    return o.codes.get(mode) == 3 and right_cause(recording.name, o.findings(mode))


def crash(o: Outcome, command: str, code: int) -> bool:
    """Whether a command ended without a sentence of its own."""
    said = o.said[command]
    return code not in (0, 3) and ("Traceback" in said or not re.search("error|To be settled", said))


def beyond_gate(recording: Recording, o: Outcome, mode: Mode) -> list[str]:
    """Names of constants that were used beyond the gate of their prior."""
    out = []
    for name, c in (o.metrics.get(mode, {}).get("installation") or {}).items():
        sigma = c.get("prior_sigma") or 0.0
        if sigma > 0.0 and abs(c["found"] - c["given"]) > _GATE * sigma:
            out.append(f"{recording.name}.{mode}:{name}")
    return out


def _say(recording: Recording, o: Outcome) -> None:
    errors = " ".join(f"{k} {v:.3f}" for k, v in o.ate.items())
    nees = " ".join(f"{n:.2f}" for m in MODES if (n := nees_of(o, m)) is not None)
    codes = " ".join(f"{k} {v}" for k, v in o.codes.items())
    print(f"{recording.name:20} {codes}; {errors}; NEES/3 {nees} {o.error}", file=sys.stderr, flush=True)
    for mode in MODES:
        for f in o.findings(mode)[:2]:
            print(f"    {mode} {f['severity']} {f['code']}: {f['text'][:160]}", file=sys.stderr, flush=True)


# --- Page ---------------------------------------------------------------------------------------------------------------

_HEAD = """# Recordings by others

`python -m benchmarks.field --page docs/field.md` of {day}: `fgloc init BAG`, then `info`, `smooth` and `online` with the `robot.yaml` that it wrote and the
set's map. No setting was fitted for a set; choices were made with recordings marked *dev*. ATE is the rmse of positions [m]; an unknown frame of the truth or place of the tracked body is fitted for each estimator.

| column | estimator |
|---|---|
| odometry | alone, aligned to the truth |
| textbook | iSAM2 with fixed constants, smoothed; on a map from the truth's first pose (tuned: [public bench](public.md)) |
| alike | the same from fgloc's first pose |
| batch, online | fgloc; NEES/3 of both |

Losses of batch against the best other first:

| recording | odometry | textbook | alike | batch | online | NEES/3 |
|---|---|---|---|---|---|---|
"""


def write_page(path: Path, chosen: Sequence[Recording], outcomes: Mapping[str, Outcome]) -> None:
    """Write as Markdown: errors, losses first; which peculiarities no finding names; why runs failed."""
    lines = [_HEAD.format(day=datetime.now(UTC).date().isoformat()).rstrip("\n")]
    judged = [r for r in chosen if outcomes[r.name].ate]
    lines += [_line(r, outcomes[r.name]) for r in sorted(judged, key=lambda r: _order(outcomes[r.name]))]
    rest = ", ".join(r.name for r in chosen if r not in judged)
    lines += [
        "",
        f"Without truth or poses: {rest or 'none'}.",
        "",
        "## What a recording tells by itself",
        "",
    ]
    traps = [trap for trap in SHEET if trap.recording in outcomes]
    missed = [f"{t.what} ({t.recording})" for t in traps if not found(t, outcomes[t.recording])]
    lines += [
        f"Of {len(traps)} peculiarities, measured by hand (`benchmarks/field_sheet.py`), `init`, `info` or a run names "
        f"{len(traps) - len(missed)} with their figure. Not: {', '.join(missed) or 'none'}.",
        "",
        "Exit codes other than 0 (`smooth` / `online`):",
        "",
    ]
    lines += ["| recording | exit | named first |", "|---|---|---|"]
    failed = [r for r in chosen if any(outcomes[r.name].codes.get(mode) for mode in MODES)]
    lines += [
        f"| {r.name} | {_codes(outcomes[r.name])} | {_first(outcomes[r.name], _failed(outcomes[r.name]))} |"
        for r in failed
    ]
    with atomic_file(path) as file:
        file.write("\n".join(lines) + "\n")


def _order(o: Outcome) -> float:
    """Error of the best other over that of the batch; infinite without one."""
    return o.best("batch") / o.ate["batch"] if "batch" in o.ate else math.inf


def _line(recording: Recording, o: Outcome) -> str:
    nees = " / ".join(_figure(nees_of(o, mode), 2) for mode in MODES)
    ates = [_figure(o.ate.get(key), 3) for key in ("odometry", "textbook.batch", "alike.batch", "batch", "online")]
    name = f"{recording.name} *dev*" if recording.development else recording.name
    return f"| {name} | {' | '.join(ates)} | {nees} |"


def _failed(o: Outcome) -> Mode:
    """The mode whose exit code was not 0, the batch first."""
    return next((mode for mode in MODES if o.codes.get(mode)), "batch")


def _codes(o: Outcome) -> str:
    return " / ".join(str(o.codes.get(mode, "–")) for mode in MODES)


def _figure(value: float | None, digits: int) -> str:
    if value is None or math.isnan(value):
        return "–"
    return f"{value:.{digits}f}" if value < 1e4 else f"{value:.1e}"


def _first(o: Outcome, mode: Mode) -> str:
    findings = o.findings(mode)
    if not findings:
        return "–"
    text = str(findings[0]["text"]).replace("|", "\\|").replace("\n", " ").replace(f"{DATA}/", "")
    return textwrap.shorten(text, 110, placeholder=" …")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--only", default="", help="comma-separated names; default: all")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="also write the table as a page")
    parser.add_argument("--windows", type=int, default=0, metavar="N", help="of each recording; default: the whole")
    parser.add_argument("--seed", type=int, default=0, help="of the windows")
    parser.add_argument("--unmapped", action="store_true", help="windows without the sets' maps")
    parser.add_argument("--changes", default="", metavar="NAMES", help="comma-separated; all")
    known, rest = parser.parse_known_args()
    named = tuple(filter(None, known.only.split(",")))

    def rows(quick: bool) -> Iterator[Row]:
        """Rows of windows, of changes, or of the recordings."""
        if known.changes:
            asked = () if known.changes == "all" else tuple(known.changes.split(","))
            return changes(asked, known.seed, named)
        if known.windows:
            return windows(known.windows, known.seed, named, not known.unmapped)
        return measure(quick, named, known.page)

    main(rows, __doc__ or "", rest)
