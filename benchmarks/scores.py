"""Scores of one run: errors, consistency, refused sightings, detected slips, and found values against the truth.

**What a run found of the installation** is a mapping of names to values with their sigmas. The names, and what the
truth has under them, are those of `truth_values`; a run may have any part of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from benchmarks.common import Row, mean_row, ratio_row
from benchmarks.recordings import Recorded, slip_intervals
from benchmarks.replays import Replayed, kept
from fgloc.config import Config
from fgloc.estimation.log import OVERRULED
from fgloc.estimation.motion import KNOWN
from fgloc.evaluation.metrics import match_result, nees
from fgloc.runner import RunResult
from fgloc.types import Decision, FloatArray, IntArray, LandmarkMap, Mode

Found = Mapping[str, tuple[float, float]]
"""Value and sigma by name."""
SIGHTINGS = frozenset({"corners", "range_bearing", "marker_pose"})  # kinds of decisions
_FOUND_AFTER_S = 1.0  # a robot that was carried away may be lost so long after the first marker seen again
_ANGLES = frozenset({"roll", "pitch", "yaw"})
_NOT_FOUND_BY_MOTION = {"", KNOWN, OVERRULED}  # reasons that no detector gave
_NAMED = re.compile(r"[Mm]arker (\d+) does not stand where the map has it")
_LINGER_S = 0.5  # a slip that is flagged so long after its end was still found
_WINDOW_S = 2.0  # a flag may be of a slip, however short, so long before it: the detector's window
_STEP_S = 0.45  # flagged steps closer than this are of one flag


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of a trajectory, and the consistency of its covariance."""

    ate_mm: float
    yaw_deg: float
    nees_over_3: float


@dataclass(frozen=True, slots=True)
class Slips:
    """Detections of the slip detector in one run.

    Attributes:
        delays_s: from the true onset to the flag, of each slip that was found.
        found_m: distance that the wheels slipped, of each slip that was found.
        missed_m: likewise, of each that was not.
        false_alarms: flags without any slip in the detector's window.
        path_m: distance travelled.
    """

    delays_s: tuple[float, ...] = ()
    found_m: tuple[float, ...] = ()
    missed_m: tuple[float, ...] = ()
    false_alarms: int = 0
    path_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures of one run, as they are kept.

    Attributes:
        online, batch: of the estimates as they were made and of the smoothed ones; None if there are none.
        poses: number of estimates online.
        lost_share: of the poses, those of a robot that took itself for lost without cause.
        refused_share: of the sightings.
        update_ms: processor time of each update after the first pose.
        found: error and sigma of what was found of the installation, by name; None if the run found nothing of it.
        map_over_survey: error of the markers' places over that of the survey.
        textbook_mm: mean distance from the truth of each textbook pipeline, by name.
        named, moved: landmarks that the notes of the run name as moved, and those that were moved.
        wrong_names: landmarks and faults of wheels that are named although they are not there.
        missed_names: those that are there and not named.
        slips: those that were found.
        lifted_nees: NEES/3 while a robot was carried and until it saw a marker again; None without a kidnapping.
        acted: how often each mechanism acted, by name; of the run with all of them on.
        failed: why there are no figures.
        batch_failed: why the run could not be smoothed.
    """

    online: Errors | None = None
    batch: Errors | None = None
    poses: int = 0
    lost_share: float = math.nan
    refused_share: float = math.nan
    update_ms: tuple[float, ...] = ()
    found: dict[str, tuple[float, float]] | None = None
    map_over_survey: float | None = None
    textbook_mm: dict[str, float] = field(default_factory=dict)
    named: tuple[int, ...] = ()
    moved: tuple[int, ...] = ()
    wrong_names: int = 0
    missed_names: int = 0
    slips: Slips = Slips()
    lifted_nees: float | None = None
    acted: dict[str, int] = field(default_factory=dict)
    failed: str = ""
    batch_failed: str = ""


_SCORES = TypeAdapter(Scores)


def kept_scores(name: str, make: Callable[[], Scores], *sources: Path) -> Scores:
    """Scores of a cell, from the cache or made now; arguments as those of `benchmarks.replays.kept`."""
    return _SCORES.validate_python(kept(name, lambda: asdict(make()), *sources))


Figure = Callable[[Scores], float | None]


def of_errors(mode: str, name: str) -> Figure:
    """Figure: one of `Errors`, ``online`` or ``batch``."""
    return lambda scores: None if (found := getattr(scores, mode)) is None else getattr(found, name)


def figures(row_id: str, scores: Sequence[Scores], figure: Figure) -> tuple[list[float], Row | None]:
    """The figure of each run; and a row that says why there is none, if one is missing."""
    values = [None if s.failed else figure(s) for s in scores]
    known = [v for v in values if v is not None and math.isfinite(v)]
    if len(known) == len(scores):
        return known, None
    missing = [s for s, v in zip(scores, values, strict=True) if v is None or not math.isfinite(v)]
    why = next((said for s in missing if (said := s.failed or s.batch_failed)), "the run says nothing of it")
    return known, Row(row_id, None, n=len(scores), reason=f"in {len(missing)} of {len(scores)} runs: {why}")


def mean_of(row_id: str, scores: Sequence[Scores], figure: Figure, unit: str = "") -> Row:
    """Mean and standard deviation of a figure over the runs."""
    values, missing = figures(row_id, scores, figure)
    return missing or mean_row(row_id, values, unit)


def ratio_of(row_id: str, scores: Sequence[Scores], over: Sequence[Scores], figure: Figure) -> Row:
    """Mean of a figure over that of other runs; the spread is that of the ratios of single runs."""
    (values, missing), (others, also) = (figures(row_id, runs, figure) for runs in (scores, over))
    return missing or also or ratio_row(row_id, values, others)


# --- The trajectory ---------------------------------------------------------------------------------------------------


def errors(result: RunResult, config: Config, unknown_ns: tuple[int, int] | None = None) -> Errors:
    """Errors of a run.

    Args:
        result: with its truth.
        config: of the run.
        unknown_ns: from when until when the pose cannot be known: this time is left out of the NEES.

    Raises:
        ValueError: the run and the truth have no time in common.
    """
    matched = match_result(result, config)
    if matched is None or matched.covs is None:
        raise ValueError("the run and the truth have no time in common, or it has no covariance; nothing to compare")
    known = np.ones(len(matched.stamps_ns), dtype=bool)
    if unknown_ns is not None:
        known = (matched.stamps_ns < unknown_ns[0]) | (matched.stamps_ns >= unknown_ns[1])
    off = matched.errors
    return Errors(
        ate_mm=1e3 * float(matched.distances.mean()),
        yaw_deg=math.degrees(float(np.abs(off[:, 2]).mean())),
        nees_over_3=float(nees(off[known], matched.covs[known]).mean()) / 3.0,
    )


def lost_share(modes: Sequence[Mode], stamps_ns: IntArray, unknown_ns: tuple[int, int] | None = None) -> float:
    """Share of the poses with mode LOST, but for those that have cause to be (and a second after it)."""
    lost = np.array([mode is Mode.LOST for mode in modes], dtype=bool)
    if unknown_ns is not None:
        start, end = unknown_ns
        lost &= (stamps_ns < start) | (stamps_ns >= end + round(_FOUND_AFTER_S * 1e9))
    return float(lost.mean())


def refused_share(decisions: Sequence[Decision]) -> float:
    """Share of the sightings that were not used as given; NaN without sightings."""
    refused = [d.reason != "" for d in decisions if d.kind in SIGHTINGS]
    return float(np.mean(refused)) if refused else math.nan


def trajectory_scores(made: Replayed, config: Config, unknown_ns: tuple[int, int] | None) -> Scores:
    """Scores of the trajectories of a run, and of what it refused; arguments as those of `errors`."""
    online, batch = made.online, made.batch
    return Scores(
        online=errors(online, config, unknown_ns),
        batch=None if batch is None else errors(batch, config, unknown_ns),
        poses=len(online.trajectory),
        lost_share=lost_share(online.modes, online.trajectory.stamps_ns, unknown_ns),
        refused_share=refused_share(online.decisions),
    )


# --- Slips and moved landmarks ----------------------------------------------------------------------------------------


def slips(recorded: Recorded, online: RunResult) -> Slips:
    """Slips found and missed, and false alarms, by the flags and the simulator's slip."""
    rises = flags(recorded, online.decisions)
    true = slip_intervals(recorded)
    delays, found, missed = [], [], []
    for start, end in true:
        inside = (recorded.slip_s >= start) & (recorded.slip_s <= end)
        way = float(np.trapezoid(np.abs(recorded.slip[inside, 0]), recorded.slip_s[inside]))
        raised = [max(rise - start, 0.0) for rise, fall in rises if fall >= start and rise <= end + _LINGER_S]
        if raised:
            delays.append(min(raised))
            found.append(way)
        else:
            missed.append(way)
    slipping = recorded.slip_s[recorded.slipping]
    false = sum(not ((slipping > rise - _WINDOW_S) & (slipping <= fall)).any() for rise, fall in rises)
    return Slips(tuple(delays), tuple(found), tuple(missed), false, recorded.path_m)


def flags(recorded: Recorded, decisions: Sequence[Decision]) -> list[tuple[float, float]]:
    """Times [s from the start] at which the wheels were rejected, as other motion sources contradicted them.

    A flag counts from the step that raised it, not from the earlier ones that it revised.
    """
    raised, newest = [], 0
    for d in decisions:
        if d.kind != "wheels" or d.stamp_ns <= newest:
            continue  # an earlier step that is judged again
        newest = d.stamp_ns
        if d.reason not in _NOT_FOUND_BY_MOTION:
            raised.append(newest)
    out: list[tuple[float, float]] = []
    for stamp in raised:
        t = (stamp - recorded.start_ns) * 1e-9
        if out and t - out[-1][1] <= _STEP_S:
            out[-1] = (out[-1][0], t)
        else:
            out.append((t, t))
    return out


def named(result: RunResult) -> frozenset[int]:
    """Markers that the notes of a run name as moved."""
    return frozenset(int(i) for note in result.notes for i in _NAMED.findall(note))


# --- The installation -------------------------------------------------------------------------------------------------


def truth_values(installed: Mapping[str, Any]) -> dict[str, float]:
    """True values of an installation, by the names that a run gives it.

    - ``camera.x``, ``.y``, ``.z`` [m], ``.roll``, ``.pitch``, ``.yaw`` [rad]: of its body axes in the base frame;
      ``camera.focal_scale``: true over believed; ``camera.cx_px``, ``.cy_px``, ``.k1``, ``.k2``, ``.p1``, ``.p2``;
    - ``camera.time_offset_s``, ``wheels.time_offset_s``: how much later than the IMU's their stamps are;
    - ``wheels.left_scale``, ``.right_scale``, ``.radius_scale`` (of the mean), ``.track_scale``: true over believed;
      ``wheels.radius_ratio``: left over right, true over believed;
    - ``imu.roll``, ``.pitch``, ``.yaw`` [rad], ``gyro.scale``: reported over true;
    - ``map.7.x``, ``.y``, ``.z`` [m]: of marker 7.

    Args:
        installed: content of ``installed.yaml``.
    """
    camera, wheels, imu, believed = (installed[name] for name in ("camera", "wheels", "imu", "believed"))
    left = wheels["left_radius"] / believed["wheels"]["left_radius"]
    right = wheels["right_radius"] / believed["wheels"]["right_radius"]
    axes = ("x", "y", "z", "roll", "pitch", "yaw")
    out = dict(zip((f"camera.{axis}" for axis in axes), [*camera["position"], *camera["rpy"]], strict=True))
    out |= dict(zip(("camera.cx_px", "camera.cy_px"), camera["principal_px"], strict=True))
    out |= dict(zip((f"camera.{name}" for name in ("k1", "k2", "p1", "p2", "k3")), camera["distortion"], strict=False))
    out |= dict(zip((f"imu.{axis}" for axis in axes[3:]), imu["rpy"], strict=True))
    out |= {
        "camera.focal_scale": float(np.mean(camera["focal_px"]) / np.mean(believed["camera"]["focal_px"])),
        "camera.time_offset_s": camera["time_offset_s"] - imu["time_offset_s"],
        "wheels.time_offset_s": wheels["time_offset_s"] - imu["time_offset_s"],
        "wheels.left_scale": left,
        "wheels.right_scale": right,
        "wheels.radius_scale": 0.5 * (left + right),
        "wheels.radius_ratio": left / right,
        "wheels.track_scale": wheels["track"] / believed["wheels"]["track"],
        "gyro.scale": imu["gyro_scale"],
    }
    for landmark in installed["map"]["landmarks"]:
        names = (f"map.{landmark['id']}.{axis}" for axis in axes[:3])
        out |= dict(zip(names, landmark["position"], strict=True))
    return {name: float(value) for name, value in out.items()}


def found_by(result: RunResult) -> Found | None:
    """Installation that a run found, but for the learned motion's scale, which has no truth."""
    told = result.installation
    if not told:
        return None
    return {name: (float(v), float(s)) for name, (v, s) in told.items() if not name.startswith("learned.")}


def found_errors(found: Found, installed: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Error and sigma of each value that a run found.

    Args:
        found: what it found.
        installed: content of ``installed.yaml``.

    Raises:
        ValueError: a name that the truth does not know.
    """
    truth = truth_values(installed)
    unknown = sorted(set(found) - set(truth))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: not in installed.yaml, which has {', '.join(sorted(truth))}")
    out = {}
    for name, (value, sigma) in found.items():
        error = value - truth[name]
        if name.rsplit(".", 1)[-1] in _ANGLES:
            error = math.remainder(error, math.tau)
        out[name] = (error, sigma)
    return out


def inside(found: Mapping[str, tuple[float, float]], sigmas: float = 3.0) -> list[bool]:
    """Whether each value's error is within so many of its sigmas."""
    return [abs(error) <= sigmas * sigma for error, sigma in found.values()]


def map_over_survey(
    places: Mapping[int, FloatArray], believed: LandmarkMap, installed: Mapping[str, Any]
) -> float | None:
    """Root mean square error of the markers' places over that of the survey, in one frame: nothing is aligned.

    Args:
        places: ``(3,)`` that a run found, by id; markers that it does not mention count as where the survey has them.
        believed: the survey.
        installed: content of ``installed.yaml``.

    Returns:
        None if no place was found or the survey has no error.
    """
    true = {int(m["id"]): np.asarray(m["position"], dtype=float) for m in installed["map"]["landmarks"]}
    survey = {i: landmark.position for i, landmark in believed.landmarks.items() if i in true}
    if not set(places) & set(survey):
        return None
    before = np.array([survey[i] - true[i] for i in survey])
    after = np.array([places.get(i, survey[i]) - true[i] for i in survey])
    worst = float((before**2).sum())
    return None if worst == 0.0 else math.sqrt(float((after**2).sum()) / worst)


def places_in(found: Found) -> dict[int, FloatArray]:
    """Places ``(3,)`` of markers of which a run found all three coordinates."""
    ids = {int(name.split(".")[1]) for name in found if name.startswith("map.")}
    names = {i: [f"map.{i}.{axis}" for axis in "xyz"] for i in ids}
    return {i: np.array([found[n][0] for n in names[i]]) for i in sorted(ids) if all(n in found for n in names[i])}
