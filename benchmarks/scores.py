"""Scores of one run: errors, consistency, refused sightings, detected slips, and found values against the truth.

**What a run found of the installation** is a mapping of names to values with their sigmas. The names, and what the
truth has under them, are those of `truth_values`; a run may have any part of them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self

import numpy as np

from benchmarks.recordings import Recorded, slip_intervals
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
class Scores:
    """Figures of one run, as they are kept.

    Attributes:
        online, batch: of the estimates as they were made and of the smoothed ones; None if there are none.
        lost_share: of the poses, those of a robot that took itself for lost without cause.
        refused_share: of the sightings.
        update_ms: processor time of each update after the first pose.
        found: error and sigma of what was found of the installation, by name; None if the run found nothing of it.
        map_over_survey: error of the markers' places over that of the survey.
        textbook_mm: mean distance from the truth of each textbook pipeline, by name.
        failed: why there are no figures.
        batch_failed: why the run could not be smoothed.
    """

    online: Errors | None = None
    batch: Errors | None = None
    lost_share: float = math.nan
    refused_share: float = math.nan
    update_ms: tuple[float, ...] = ()
    found: dict[str, tuple[float, float]] | None = None
    map_over_survey: float | None = None
    textbook_mm: dict[str, float] = field(default_factory=dict)
    failed: str = ""
    batch_failed: str = ""

    def as_json(self) -> dict[str, Any]:
        """Scores as values for JSON, which `from_json` reads."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Scores from values of JSON."""
        told = dict(content)
        for name in ("online", "batch"):
            told[name] = None if told[name] is None else Errors(**told[name])
        if told["found"] is not None:
            told["found"] = {name: (error, sigma) for name, (error, sigma) in told["found"].items()}
        return cls(**(told | {"update_ms": tuple(told["update_ms"])}))


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


# --- Slips and moved landmarks ----------------------------------------------------------------------------------------


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

    delays_s: tuple[float, ...]
    found_m: tuple[float, ...]
    missed_m: tuple[float, ...]
    false_alarms: int
    path_m: float


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
