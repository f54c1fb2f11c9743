"""Files of a run in one folder, and its report: one page that needs no other file and no network."""

from __future__ import annotations

import base64
import json
import math
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from fgloc.calibration.installation import contradicted, found_text, given_text, setting_unit, with_settings
from fgloc.config import Config, yaml_of
from fgloc.evaluation.interactive import interactive
from fgloc.evaluation.judgements import GRAVITY, Judgement, numbered
from fgloc.evaluation.metrics import Matched, Metrics, compute_metrics, match_result
from fgloc.evaluation.plots import plot_error, plot_height, plot_protection, plot_space, plot_timeline, plot_trajectory
from fgloc.evaluation.style import FORMATS, Format, image_of
from fgloc.files.atomic import atomic_folder
from fgloc.files.outputs import (
    RESULT_FORMAT,
    RESULT_MARK,
    write_bytes,
    write_covariance_csv,
    write_json,
    write_protection_csv,
    write_steps_csv,
    write_text,
    write_tum,
)
from fgloc.recording.reader import open_recording
from fgloc.recording.truth import true_slips
from fgloc.results import RunData
from fgloc.sensors.maps import write_map
from fgloc.stats import rounded
from fgloc.types import InstallationFound, IntArray, Mode

# --- Pages by Jinja, which escapes whatever a recording is called -----------------------------------------------------


def page(template: str, **content: Any) -> str:
    """Render a whole page.

    Args:
        template: name of a file in ``templates/``.
        content: what it needs; texts are escaped, images are PNG files and provenance is a mapping.
    """
    content["provenance"] = yaml.safe_dump(dict(content["provenance"]), sort_keys=False, allow_unicode=True)
    return _environment().get_template(template).render(content)


def embedded(data: bytes) -> str:
    """A file as base64, to stand in a page."""
    return base64.b64encode(data).decode("ascii")


def script_data(content: Mapping[str, Any]) -> Markup:
    """JSON for a ``<script>`` element: no text in it can end the element."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e"))


@cache
def plotly() -> Markup:
    """The script of Plotly's basic bundle."""
    return Markup((files("fgloc.evaluation") / "assets" / "plotly-basic.min.js").read_text(encoding="utf-8"))


@cache
def _environment() -> Environment:
    loader = PackageLoader("fgloc.evaluation")
    return Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )


# --- Tiles, sentences and tables of the report; a run without truth has no word of it ---------------------------------

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
_PROTECTION = (
    "Each pose: the bound that was promised for it over its distance from the truth. Points below the line are wrong "
    "by more than their bound; without an alert these are dangerous."
)
_NEES = "NEES / 3 (honest: 1)"
_AWAY = "mean distance from truth"
_OF_FINDING = {"covariance.optimistic": _NEES, "truth.size": _AWAY, "truth.frame": _AWAY}  # tile by code
Row = tuple[str, ...]


def content_of(result: RunData, metrics: Metrics, matched: Matched | None) -> dict[str, Any]:
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
    """Label, text and severity of each tile; the severity is that of the finding on the same figure, or empty."""
    shown = [
        ("mean distance from truth", _number(metrics.ate_mean_m, 1000.0, "{:.1f} mm")),
        ("mean yaw error", _number(metrics.yaw_mae_deg, 1.0, "{:.2f}°")),
        ("drift", _number(metrics.drift_percent, 1.0, "{:.2f} %")),
        (_NEES, _number(metrics.nees_over_3, 1.0, "{:.2f}")),
        ("recording", _number(metrics.duration_s, 1.0, "{:.1f} s")),
        ("keyframes", str(metrics.keyframes)),
        ("times real time", _number(metrics.real_time_factor, 1.0, "{:.1f}×")),
    ]
    severities = {_OF_FINDING[f.code]: f.severity for f in metrics.findings if f.code in _OF_FINDING}
    return [(label, text, severities.get(label, "")) for label, text in shown if text != "–"]


def _truth_line(result: RunData, matched: Matched | None) -> str:
    if matched is not None:
        return f"The truth was matched at {len(matched.stamps_ns)} of {len(result.trajectory)} keyframes."
    if result.truth is not None:
        return "The truth has no poses at the run's time: there is nothing to compare with."
    return "The recording has no reference trajectory; the 3σ bands are the estimate's own."


def _modes(modes: Sequence[Mode]) -> str:
    counts = Counter(modes)
    shares = ", ".join(f"{mode} {100.0 * counts[mode] / len(modes):.1f} %" for mode in Mode if counts[mode])
    lost = " The robot was LOST for part of the run: do not use these stretches." if counts[Mode.LOST] else ""
    if counts[Mode.LOST] == len(modes):
        lost = " The robot was LOST for the whole run: do not use it."
    return f"Modes: {shares}.{lost}"


def _captions(result: RunData, compared: bool) -> Mapping[str, str]:
    drawn = "The estimate with its times and 3σ ellipses"
    mapped = ", and the landmarks" if result.landmarks is not None else ""
    return {
        "trajectory": f"{drawn}{', the truth' if compared else ''}{mapped}. Below: the position's 3σ"
        + (" and its distance from the truth." if compared else "."),
        "error_title": "Error and its 3σ band" if compared else "3σ band",
        "error": "In the map frame. An honest band holds 99.7 % of the errors." if compared else "In the map frame.",
        "timeline": f"{_TIMELINE}{'; the true errors' if compared else ''}.",
        "installation": _INSTALLATION,
        "protection": _PROTECTION,
        "space": "The path in space; heights are drawn larger than they are.",
        "height": "Height, pitch and roll over the distance travelled, with their 3σ bands.",
    }


def _judged(found: Sequence[Judgement]) -> tuple[list[Row], int]:
    """Table of the gravest judgements (number, time, fault, evidence, effect), and how many more there are."""
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
        *_protection_figures(metrics),
        ("first pose", _number(metrics.first_pose_s, 1.0, "{:.1f} s"), "after the recording's first step, as it went"),
        ("update", steps, "wall time of one step: median / p95 / p99 / worst"),
        (
            "real-time factor",
            _number(metrics.real_time_factor, 1.0, "{:.1f}"),
            "seconds of recording per second of work",
        ),
    ]
    return [row for row in rows if row[1] != "–"]


def _protection_figures(metrics: Metrics) -> list[Row]:
    found = metrics.protection
    if found is None:
        return []
    level = "none" if found.median_m is None else f"{found.median_m:.3f} / {found.p95_m:.3f} m"
    rows: list[Row] = [("protection level", level, "bound on the position's error: median / 95 %")]
    if found.exceeded is not None:
        rows.append(("beyond the bound", f"{100.0 * found.exceeded:.2f} %", "poses wrong by more than was promised"))
    return rows


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


def _sensors(result: RunData) -> list[Row]:
    rows: list[Row] = []
    for name, topic in result.spans.items():
        steps = np.diff(np.sort(topic.times)) / topic.every
        rate = f"{1.0 / np.median(steps):.1f}" if len(steps) and np.median(steps) > 0 else "–"
        rows.append((name, str(topic.count), rate, f"{topic.longest_gap_s:.2f}" if topic.count > 1 else "–"))
    return rows


def _installation(result: RunData) -> list[Row]:
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


def _landmarks(result: RunData) -> tuple[Row, list[Row]]:
    """Head and rows of the table of landmarks; with sigmas if the map has them."""
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


# --- The folder -------------------------------------------------------------------------------------------------------

_FIGURES = ("trajectory", "error", "timeline", "protection", "space", "height")  # the last two: on uneven ground
FILES = (
    "trajectory.tum",
    "truth.tum",
    "covariance.csv",
    "steps.csv",
    "protection.csv",
    "metrics.json",
    "config.json",
    *(f"{name}.{form}" for name in _FIGURES for form in FORMATS),
    "installation.yaml",
    "map.yaml",
    "report.html",
)
"""Files of a run; those that a run does not have are taken away from an earlier result in the same folder."""
_ALWAYS = ("trajectory.png", "timeline.png")
_PACKAGES = ("fgloc", "gtsam", "numpy", "opencv-contrib-python-headless")


def write_results(
    result: RunData,
    config: Config,
    out: Path,
    command: str,
    input_hash: str | None = None,
    figures: Sequence[Format] = (),
) -> Metrics:
    """Write all files of a run into a folder; an error leaves what was there as it was.

    Args:
        result: the run.
        config: as it was used.
        out: the folder, made if missing.
        command: what the user typed, for the report and ``config.json``.
        input_hash: of the recording.
        figures: formats in which all figures are written too.

    Returns:
        What ``metrics.json`` holds.

    Raises:
        OutputError: the folder cannot be written.
        TrajectoryError: a pose is not finite.
        CovarianceError: a covariance is not positive definite.
    """
    metrics, matched = compute_metrics(result, config), match_result(result, config)
    provenance = _provenance(result, config, command, input_hash)
    drawn = _drawn(result, matched, config)
    images = {f"{name}.png": image_of(figure) for name, figure in drawn.items()}
    files = {f"{name}.{form}": image_of(figure, form) for form in figures for name, figure in drawn.items()}
    with atomic_folder(out, own=FILES) as stage:
        write_tum(stage / "trajectory.tum", result.trajectory)
        if result.truth is not None and len(result.truth):
            write_tum(stage / "truth.tum", result.truth)
        write_covariance_csv(stage / "covariance.csv", result.trajectory)
        write_steps_csv(stage / "steps.csv", result.decisions, numbered(result))
        if result.protections:
            write_protection_csv(stage / "protection.csv", result.trajectory.stamps_ns, result.protections)
        write_json(stage / "metrics.json", metrics.model_dump())
        write_json(stage / "config.json", provenance)
        for name, data in ({name: images[name] for name in _ALWAYS} | files).items():
            write_bytes(stage / name, data)
        if result.found is not None and result.found.names:
            write_text(stage / "installation.yaml", installation_yaml(result.found, config, out, command))
            if result.found.landmarks is not None:
                write_map(result.found.landmarks, stage / "map.yaml", (RESULT_MARK,))
        write_text(stage / "report.html", render(result, metrics, matched, images, provenance))
    return metrics


def _provenance(result: RunData, config: Config, command: str, input_hash: str | None) -> dict[str, Any]:
    """Content of ``config.json``: command, input, versions and configuration of a run."""
    source = None if result.source is None else str(result.source)
    return {
        "format": RESULT_FORMAT,
        "command": command,
        "input": {"path": source, "sha256": input_hash},
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}},
        "config": config.model_dump(mode="json"),
    }


def _drawn(result: RunData, matched: Matched | None, config: Config) -> dict[str, Figure]:
    """Plots of a run, by name."""
    drawn = {
        "trajectory": plot_trajectory(result, matched),
        "error": plot_error(result, matched),
        "timeline": plot_timeline(result, matched, _slips(result, config)),
    }
    if result.protections and matched is not None:
        drawn["protection"] = plot_protection(result, matched, config.integrity.alert_m)
    if result.trajectory.ground is not None:
        drawn |= {"space": plot_space(result, matched), "height": plot_height(result, matched)}
    return drawn


def installation_yaml(found: InstallationFound, config: Config, folder: Path, command: str) -> str:
    """The configuration of the run with what it has found, for ``--config``; goes with the run's ``map.yaml``."""
    rows = [f"#   {s.name}: {s.given:.6g} -> {s.found:.6g} +- {s.sigma:.2g}" for s in found.settings]
    head = [
        f"# {command}",
        "# Given -> found +- sigma; whatever a run cannot determine keeps its value and sigma.",
        *rows,
    ]
    return "\n".join(head) + "\n" + yaml_of(with_settings(config, found.settings), folder)


def _slips(result: RunData, config: Config) -> IntArray | None:
    """When a wheel truly slipped, if the recording is still there and has it."""
    if result.source is None or not result.source.exists():
        return None
    with open_recording(result.source, config.recording) as recording:
        return true_slips(recording)


def render(
    result: RunData,
    metrics: Metrics,
    matched: Matched | None,
    images: Mapping[str, bytes],
    provenance: Mapping[str, Any],
) -> str:
    """The report as one HTML page that needs no other file and no network."""
    return page(
        "report.html",
        title="recording" if result.source is None else "/".join(result.source.parts[-2:]),
        command=provenance["command"],
        images={name.removesuffix(".png"): embedded(data) for name, data in images.items()},
        interactive=script_data(interactive(result, matched)),
        plotly=plotly(),
        provenance=provenance,
        **content_of(result, metrics, matched),
    )
