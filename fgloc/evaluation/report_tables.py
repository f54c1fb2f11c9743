"""What the report of a run says: tiles, sentences and the rows of its tables. A run without truth has no word of it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fgloc.calibration.installation import contradicted, found_text, given_text, setting_unit
from fgloc.evaluation.judgements import GRAVITY, Judgement
from fgloc.evaluation.matching import Matched
from fgloc.evaluation.metrics import Metrics
from fgloc.stats import rounded
from fgloc.types import Mode, RunResult

_MOST_ROWS = 60  # of the table of judgements
_JUDGED = (
    "A row stands for steps of steps.csv that say the same; the file's column judgement has its number. Times are "
    "seconds from the first pose. The statistic is the one that exceeds its threshold most."
)
_TIMELINE = (
    "Messages received; each motion source at the height of its weight, red where it was left out; the reasons; the "
    "sightings' fit to the prediction (1 is expected); every landmark, red where its sightings were rejected"
)
_INSTALLATION = (
    "What the run found, and how well; what it cannot determine keeps its value and sigma. A value contradicts the "
    "given one if it is off by more than three sigmas of either. installation.yaml and map.yaml hold all of it."
)
Row = tuple[str, ...]


def content_of(result: RunResult, metrics: Metrics, matched: Matched | None) -> dict[str, Any]:
    """All that the template needs besides the pictures."""
    compared = matched is not None
    lost = Mode.LOST in result.modes
    landmark_head, landmarks = _landmarks(result)
    judged, more = _judged(metrics.judgements)
    return {
        "tiles": _tiles(metrics),
        "truth_line": _truth_line(result, matched),
        "truth_missing": result.truth is not None and not compared,
        "modes_line": _modes(result.modes),
        "lost": lost,
        "judged": judged,
        "judged_line": _JUDGED + (f" {more} more are in metrics.json." if more else ""),
        "findings": metrics.findings,
        "captions": _captions(result, compared),
        "figures": _figures(metrics),
        "installation": _installation(result),
        "sensors": _sensors(result),
        "factors": [(kind, str(count)) for kind, count in metrics.factors.items()],
        "rejected": [(reason, str(count)) for reason, count in _most(metrics.rejections)],
        "landmark_head": landmark_head,
        "landmarks": landmarks,
    }


def _tiles(metrics: Metrics) -> list[Row]:
    shown = [
        ("mean distance from truth", _number(metrics.ate_mean_m, 1000.0, "{:.1f} mm")),
        ("mean yaw error", _number(metrics.yaw_mae_deg, 1.0, "{:.2f}°")),
        ("drift", _number(metrics.drift_percent, 1.0, "{:.2f} %")),
        ("NEES / 3 (honest: 1)", _number(metrics.nees_over_3, 1.0, "{:.2f}")),
        ("recording", _number(metrics.duration_s, 1.0, "{:.1f} s")),
        ("keyframes", str(metrics.keyframes)),
        ("times real time", _number(metrics.real_time_factor, 1.0, "{:.1f}×")),
    ]
    return [(label, text) for label, text in shown if text != "–"]


def _truth_line(result: RunResult, matched: Matched | None) -> str:
    if matched is not None:
        return f"The truth was matched at {len(matched.stamps_ns)} of {len(result.trajectory)} keyframes."
    if result.truth is not None:
        return "The truth has no poses at the run's time: there is nothing to compare with."
    return "The recording has no reference trajectory; the 3σ bands are the estimate's own."


def _modes(modes: Sequence[Mode]) -> str:
    counts = Counter(modes)
    shares = ", ".join(f"{mode} {100.0 * counts[mode] / len(modes):.1f} %" for mode in Mode if counts[mode])
    lost = " The robot was LOST for part of the run: do not use these stretches." if counts[Mode.LOST] else ""
    return f"Modes: {shares}.{lost}"


def _captions(result: RunResult, compared: bool) -> Mapping[str, str]:
    drawn = "The estimate with its times and 3σ ellipses"
    mapped = ", and the landmarks" if result.landmarks is not None else ""
    return {
        "trajectory": f"{drawn}{', the truth' if compared else ''}{mapped}. Below: the position's 3σ"
        + (" and its distance from the truth." if compared else "."),
        "error_title": "Error and its 3σ band" if compared else "3σ band",
        "error": "In the map frame. An honest band holds 99.7 % of the errors." if compared else "In the map frame.",
        "timeline": f"{_TIMELINE}{'; the true errors' if compared else ''}.",
        "installation": _INSTALLATION,
        "space": "The path in space; heights are drawn larger than they are.",
        "height": "Height, pitch and roll over the distance travelled, with their 3σ bands.",
    }


def _judged(found: Sequence[Judgement]) -> tuple[list[Row], int]:
    """What was judged to be wrong, when, by which evidence, what that cost or saved; how many more there are."""
    shown = {j.number for j in sorted(found, key=lambda j: (GRAVITY[j.kind], -j.rows))[:_MOST_ROWS]}
    rows: list[Row] = [(str(j.number), j.when, j.what, j.evidence, j.effect) for j in found if j.number in shown]
    return rows, len(found) - len(rows)


def _figures(metrics: Metrics) -> list[Row]:
    share = metrics.coverage or {}
    times = metrics.step_ms
    steps = "–" if times is None else f"{times.median:.2f} / {times.p95:.2f} / {times.p99:.2f} / {times.max:.2f} ms"
    within = " / ".join(_number(share.get(k), 100.0, "{:.1f} %") for k in ("1", "2", "3")) if share else "–"
    honest = "share of x, y and yaw errors inside their band; honest: 68.3 / 95.4 / 99.7 %"
    rows = [
        ("ATE, mean", _number(metrics.ate_mean_m, 1.0, "{:.4f} m"), "mean distance from the truth"),
        ("ATE, rmse", _number(metrics.ate_rmse_m, 1.0, "{:.4f} m"), "root mean square distance from the truth"),
        ("yaw MAE", _number(metrics.yaw_mae_deg, 1.0, "{:.3f}°"), "mean absolute yaw error"),
        ("end error", _number(metrics.end_error_m, 1.0, "{:.4f} m"), "distance from the truth at the end"),
        ("drift", _number(metrics.drift_percent, 1.0, "{:.3f} %"), "end error over distance travelled"),
        ("NEES / 3", _number(metrics.nees_over_3, 1.0, "{:.3f}"), "1 is honest, more is over-confident"),
        *_ground_figures(metrics),
        ("coverage 1σ / 2σ / 3σ", within, honest),
        ("first pose", _number(metrics.first_pose_s, 1.0, "{:.1f} s"), "after the recording's first step, as it went"),
        ("update", steps, "wall time of one step: median / p95 / p99 / worst"),
        (
            "real-time factor",
            _number(metrics.real_time_factor, 1.0, "{:.1f}"),
            "seconds of recording per second of work",
        ),
    ]
    return [row for row in rows if row[1] != "–"]


def _ground_figures(metrics: Metrics) -> list[Row]:
    found = metrics.ground
    if found is None:
        return []
    return [
        ("ATE in space, rmse", f"{found.ate_rmse_m:.4f} m", "root mean square distance, with the height"),
        ("height, rmse", f"{found.height_rmse_m:.4f} m", "root mean square error of the height"),
        ("roll / pitch, rmse", f"{found.roll_rmse_deg:.3f} / {found.pitch_rmse_deg:.3f}°", "root mean square errors"),
        ("NEES / 6", f"{found.nees_over_6:.3f}", "of x, y, z, roll, pitch and yaw; 1 is honest"),
    ]


def _sensors(result: RunResult) -> list[Row]:
    rows: list[Row] = []
    for name, topic in result.spans.items():
        steps = np.diff(np.sort(topic.times)) / topic.every
        rate = f"{1.0 / np.median(steps):.1f}" if len(steps) and np.median(steps) > 0 else "–"
        rows.append((name, str(topic.count), rate, f"{topic.longest_gap_s:.2f}" if topic.count > 1 else "–"))
    return rows


def _installation(result: RunResult) -> list[Row]:
    return [
        (
            s.name + (" (contradicts the given value)" if contradicted(s) else ""),
            setting_unit(s.name),
            f"{given_text(s)} ± {rounded(0.0, s.prior_sigma)[1]}",
            found_text(s),
            f"{s.off:+z.1f}",
        )
        for s in (() if result.found is None else result.found.settings)
    ]


def _landmarks(result: RunResult) -> tuple[Row, list[Row]]:
    """Head and rows; sigmas only of a map that has them."""
    landmarks = {} if result.landmarks is None else result.landmarks.landmarks
    used, refused = Counter[int](), Counter[int]()
    for decision in result.decisions:
        (refused if decision.weight == 0 else used)[decision.landmark_id] += 1
    known = any(lm.cov is not None for lm in landmarks.values())
    rows: list[Row] = []
    for i, lm in sorted(landmarks.items()):
        place = (str(i), f"{lm.position[0]:.3f}", f"{lm.position[1]:.3f}")
        sigma = "–" if lm.cov is None else f"{1e3 * math.sqrt(lm.cov[0, 0] + lm.cov[1, 1]):.1f}"
        rows.append((*place, *((sigma,) if known else ()), str(used[i]), str(refused[i])))
    return ("id", "x [m]", "y [m]", *(("σ [mm]",) if known else ()), "fused", "rejected"), rows


def _most(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def _number(value: float | None, factor: float, form: str) -> str:
    return "–" if value is None else form.format(value * factor)
