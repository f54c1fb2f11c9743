"""Data of the report's interactive plots, for their script; long runs are thinned out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fgloc.evaluation.metrics import Matched
from fgloc.evaluation.plots import relocated, stands
from fgloc.evaluation.style import (
    BLUE,
    MODE_LOOKS,
    ErrorScale,
    TimeAxis,
    after_gaps,
    mode_runs,
    position_sigma,
    seconds,
)
from fgloc.results import RunData
from fgloc.types import Decision, FloatArray, IntArray, Landmark

_MOST = 4000  # points of a curve
_DEGREES = math.degrees(1.0)


def interactive(result: RunData, matched: Matched | None) -> dict[str, Any]:
    """Poses, truth, landmarks, errors, sightings and modes; times where `TimeAxis` draws them."""
    axis = TimeAxis.of(result)
    trajectory = result.trajectory
    kept = _thinned(len(trajectory))
    times = seconds(result, trajectory.stamps_ns)
    modes = [result.modes[k] for k in kept]
    breaks = np.searchsorted(
        kept, np.union1d(relocated(result), after_gaps(trajectory.stamps_ns))
    )  # no line leads there
    sigma = None
    if trajectory.covs is not None:
        covs = trajectory.covs[kept]
        yaw = np.sqrt(covs[:, 2, 2])
        sigma = {"position_mm": _rounded(1e3 * position_sigma(covs), 2), "yaw_deg": _rounded(_DEGREES * yaw, 4)}
    return {
        "poses": {
            "t": _rounded(axis.place(times[kept]), 3),
            "told": [f"{t:.2f}" for t in times[kept]],
            "breaks": np.unique(breaks[(breaks > 0) & (breaks < len(kept))]).tolist(),
            "x": _rounded(trajectory.poses[kept, 0], 4),
            "y": _rounded(trajectory.poses[kept, 1], 4),
            "yaw_deg": _rounded(_DEGREES * trajectory.poses[kept, 2], 3),
            "mode": [str(mode) for mode in modes],
            "color": [MODE_LOOKS[mode][0] if mode in MODE_LOOKS else BLUE for mode in modes],
        },
        "sigma": sigma,
        "truth": None if matched is None else _truth(matched),
        "errors": None if matched is None else _errors(result, matched, axis),
        "sightings": {
            "accepted": _sightings(result, [d for d in result.decisions if _judged(d) and d.weight > 0.0], axis),
            "rejected": _sightings(result, [d for d in result.decisions if _judged(d) and d.weight == 0.0], axis),
        },
        "modes": _modes(result, axis, times),
        "ticks": None if not axis.cuts else _ticks(axis),
        "logarithmic": ErrorScale.of_distance(result, matched).is_logarithmic,
        **_landmarks(result),
    }


def _thinned(count: int) -> IntArray:
    return np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(np.int64))


def _rounded(values: FloatArray, digits: int) -> list[float | None]:
    return [round(v, digits) if math.isfinite(v) else None for v in values.tolist()]


def _truth(matched: Matched) -> Mapping[str, Any]:
    x, y = _thinned_columns(matched, matched.truth[:, :2])
    return {"x": _rounded(x, 4), "y": _rounded(y, 4)}


def _errors(result: RunData, matched: Matched, axis: TimeAxis) -> Mapping[str, Any]:
    times = axis.place(seconds(result, matched.stamps_ns))
    yaws = _DEGREES * np.abs(matched.errors[:, 2]) if matched.has_yaw else np.full(len(times), math.nan)
    t, position, yaw = _thinned_columns(matched, np.column_stack([times, 1e3 * matched.distances, yaws]))
    return {"t": _rounded(t, 3), "position_mm": _rounded(position, 2), "yaw_deg": _rounded(yaw, 4)}


def _thinned_columns(matched: Matched, rows: FloatArray) -> FloatArray:
    """Columns of rows ``(n, m)``, some of the rows, with NaN where the truth was silent: no line leads across."""
    kept = _thinned(len(rows))
    gaps = np.searchsorted(kept, after_gaps(matched.stamps_ns))
    return np.insert(rows[kept], np.unique(gaps[gaps < len(kept)]), np.nan, axis=0).T


def _judged(d: Decision) -> bool:
    return d.landmark_id >= 0 and d.dof > 0 and d.nis > 0.0 and math.isfinite(d.nis)


def _sightings(result: RunData, decisions: Sequence[Decision], axis: TimeAxis) -> Mapping[str, Any]:
    chosen = [decisions[k] for k in _thinned(len(decisions))] if decisions else []
    return {
        "t": _rounded(axis.place(seconds(result, [d.stamp_ns for d in chosen])), 3) if chosen else [],
        "nis": [float(f"{d.nis / d.dof:.3g}") for d in chosen],
        "told": [f"{d.kind} {d.landmark_id}{': ' + d.reason if d.reason else ''}, step {d.step}" for d in chosen],
    }


def _modes(result: RunData, axis: TimeAxis, times: FloatArray) -> list[Mapping[str, Any]]:
    found: list[Mapping[str, Any]] = []
    for mode, (color, _, _) in MODE_LOOKS.items():
        for first, last in mode_runs(result, mode):
            start, end = axis.place(times[[max(first - 1, 0), last]]).round(3).tolist()
            found.append({"start": start, "end": end, "color": color})
    return found


def _ticks(axis: TimeAxis) -> Mapping[str, Any]:
    ticks = axis.ticks()
    return {"at": _rounded(axis.place(np.array(ticks)), 3), "told": [f"{t:g}" for t in ticks]}


def _landmarks(result: RunData) -> Mapping[str, Any]:
    """Places by id, and the edges of markers as seen from above."""
    known = [] if result.landmarks is None else list(result.landmarks.landmarks.values())
    edges = [lm.corners()[:2, :2] for lm in known if stands(lm)]
    told = []
    for lm in known:
        sigma = "" if lm.cov is None else f"<br>σ {1e3 * math.sqrt(lm.cov[0, 0] + lm.cov[1, 1]):.1f} mm"
        told.append(f"landmark {lm.landmark_id}<br>x {lm.position[0]:.3f} m, y {lm.position[1]:.3f} m{sigma}")
    return {
        "landmarks": {
            "x": [round(float(lm.position[0]), 4) for lm in known],
            "y": [round(float(lm.position[1]), 4) for lm in known],
            "id": [str(lm.landmark_id) for lm in known],
            "shown": [0 if stands(lm) else 1 for lm in known],
            "label_at": [_label_side(lm) for lm in known],
            "told": told,
        },
        "edges": [{"x": _rounded(e[:, 0], 4), "y": _rounded(e[:, 1], 4)} for e in edges],
    }


def _label_side(landmark: Landmark) -> str:
    """Side of a marker's label in Plotly's words: behind its face, where the robot does not drive."""
    if not stands(landmark):
        return "top right"
    face = landmark.rotation[:2, 2]
    if abs(face[0]) > abs(face[1]):
        return "middle left" if face[0] > 0.0 else "middle right"
    return "bottom center" if face[1] > 0.0 else "top center"
