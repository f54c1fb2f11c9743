"""Everything a run leaves behind: the files of one folder, and a report that needs nothing but itself."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgloc.calibration.contradictions import contradicted
from fgloc.calibration.settings import with_settings
from fgloc.config import Config, yaml_of
from fgloc.evaluation.html import page, picture, table
from fgloc.evaluation.judgements import GRAVITY, Judgement
from fgloc.evaluation.matching import Matched
from fgloc.evaluation.metrics import Metrics, compute_metrics, match_result
from fgloc.evaluation.plots import plot_error, plot_trajectory, png
from fgloc.evaluation.timeline import plot_timeline
from fgloc.files.atomic import atomic_folder
from fgloc.recording.outputs import (
    write_bytes,
    write_covariance_csv,
    write_json,
    write_steps_csv,
    write_text,
    write_tum,
)
from fgloc.recording.reader import open_recording
from fgloc.recording.truth import true_slips
from fgloc.sensors.maps import write_map
from fgloc.types import InstallationFound, IntArray, Mode, RunResult

_TIMELINE = (
    "Messages received; each motion source at the height of its weight, red where it was left out; the reasons; the "
    "sightings' fit to the prediction (1 is expected); every landmark, red where its sightings were rejected; the true "
    "errors."
)
_JUDGED = (
    "Steps of steps.csv that say the same are one row; seconds from the first pose. The statistic is the one that "
    "exceeds its threshold most."
)
_MOST_ROWS = 60  # of the table of judgements
_INSTALLATION = (
    "What the run found, and how well; what it cannot determine keeps its value and sigma. A value contradicts the "
    "given one if it is off by more than three sigmas of either. installation.yaml and map.yaml hold all of it."
)
FILES = (
    "trajectory.tum",
    "covariance.csv",
    "steps.csv",
    "metrics.json",
    "config.json",
    "trajectory.png",
    "timeline.png",
    "installation.yaml",
    "map.yaml",
    "report.html",
)
"""Files of a run; those that a run does not have are taken away from an earlier result in the same folder."""
_PACKAGES = ("fgloc", "gtsam", "numpy", "opencv-contrib-python-headless")


def write_results(result: RunResult, config: Config, out: Path, command: str, input_hash: str | None = None) -> Metrics:
    """Write all files of a run into a folder; an error leaves what was there as it was.

    Args:
        result: the run.
        config: as it was used.
        out: the folder, made if missing.
        command: what the user typed, for the report and ``config.json``.
        input_hash: of the recording.

    Returns:
        What ``metrics.json`` holds.

    Raises:
        OutputError: the folder cannot be written.
        TrajectoryError: a pose is not finite.
        CovarianceError: a covariance is not positive definite.
    """
    metrics, matched = compute_metrics(result, config), match_result(result, config)
    source = None if result.source is None else str(result.source)
    provenance = {
        "command": command,
        "input": {"path": source, "sha256": input_hash},
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}},
        "config": config.model_dump(mode="json"),
    }
    pictures = {
        "trajectory": png(plot_trajectory(result, matched)),
        "error": png(plot_error(result, matched)),
        "timeline": png(plot_timeline(result, matched, _slips(result, config))),
    }
    with atomic_folder(out, own=FILES) as stage:
        write_tum(stage / "trajectory.tum", result.trajectory)
        write_covariance_csv(stage / "covariance.csv", result.trajectory)
        write_steps_csv(stage / "steps.csv", result.decisions)
        write_json(stage / "metrics.json", metrics.model_dump())
        write_json(stage / "config.json", provenance)
        write_bytes(stage / "trajectory.png", pictures["trajectory"])
        write_bytes(stage / "timeline.png", pictures["timeline"])
        if result.found is not None and result.found.names:
            write_text(stage / "installation.yaml", installation_yaml(result.found, config, out, command))
            if result.found.landmarks is not None:
                write_map(result.found.landmarks, stage / "map.yaml")
        write_text(stage / "report.html", render(result, metrics, matched, pictures, provenance))
    return metrics


def installation_yaml(found: InstallationFound, config: Config, folder: Path, command: str) -> str:
    """The configuration of the run with what it has found, for ``--config``; goes with the run's ``map.yaml``."""
    rows = [f"#   {s.name}: {s.given:.6g} -> {s.found:.6g} +- {s.sigma:.2g}" for s in found.settings]
    head = [
        f"# {command}",
        "# Given -> found +- sigma; whatever a run cannot determine keeps its value and sigma.",
        *rows,
    ]
    return "\n".join(head) + "\n" + yaml_of(with_settings(config, found.settings), folder)


def _slips(result: RunResult, config: Config) -> IntArray | None:
    """When a wheel truly slipped, if the recording is still there and has it."""
    if result.source is None or not result.source.exists():
        return None
    with open_recording(result.source, config.recording) as recording:
        return true_slips(recording)


def render(
    result: RunResult,
    metrics: Metrics,
    matched: Matched | None,
    pictures: Mapping[str, bytes],
    provenance: Mapping[str, Any],
) -> str:
    """The report as one HTML page that needs no other file and no network."""
    name = escape("recording" if result.source is None else "/".join(result.source.parts[-2:]))
    body = [
        f"<h1>{name}</h1>",
        f'<p class="sub"><code>{escape(str(provenance["command"]))}</code></p>',
        _tiles(metrics),
        _truth_line(result, matched),
        _modes(result.modes),
        _judged(metrics.judgements),
        _list("Notes", result.notes),
        "<h2>Trajectory</h2>",
        picture(pictures["trajectory"], "Trajectory", "The estimate with 3σ ellipses over the truth and the map."),
        "<h2>Error and its 3σ band</h2>",
        picture(pictures["error"], "Error", "In the map frame. An honest band holds 99.7 % of the errors."),
        "<h2>Timeline</h2>",
        picture(pictures["timeline"], "Timeline", _TIMELINE),
        "<h2>Figures</h2>",
        _figures(metrics),
        _installation(result),
        '<div class="columns">',
        _section("Sensors", _sensors(result)),
        _section("Factors", table(("kind", "count"), metrics.factors.items(), numbers=1)),
        _section("Rejected", table(("reason", "count"), _most(metrics.rejections), numbers=1)),
        _section("Landmarks", _landmarks(result)),
        "</div>",
        "<h2>Provenance</h2>",
        f"<pre>{escape(yaml.safe_dump(dict(provenance), sort_keys=False, allow_unicode=True))}</pre>",
    ]
    return page(name, body)


def _tiles(metrics: Metrics) -> str:
    shown = [
        ("mean distance from truth", _number(metrics.ate_mean_m, 1000.0, "{:.1f} mm")),
        ("mean yaw error", _number(metrics.yaw_mae_deg, 1.0, "{:.2f}°")),
        ("drift", _number(metrics.drift_percent, 1.0, "{:.2f} %")),
        ("NEES / 3 (honest: 1)", _number(metrics.nees_over_3, 1.0, "{:.2f}")),
        ("recording", _number(metrics.duration_s, 1.0, "{:.1f} s")),
        ("keyframes", str(metrics.keyframes)),
        ("times real time", _number(metrics.real_time_factor, 1.0, "{:.1f}×")),
    ]
    tiles = (f'<div class="tile"><b>{text}</b><span>{label}</span></div>' for label, text in shown if text != "–")
    return f'<div class="tiles">{"".join(tiles)}</div>'


def _truth_line(result: RunResult, matched: Matched | None) -> str:
    if matched is not None:
        return f"<p>The truth was matched at {len(matched.stamps_ns)} of {len(result.trajectory)} keyframes.</p>"
    if result.truth is not None:
        return '<p class="warn">The truth has no poses at the run\'s time: there is nothing to compare with.</p>'
    return "<p>The recording holds no truth: errors are unknown, the 3σ bands are the estimate's own.</p>"


def _modes(modes: Sequence[Mode]) -> str:
    counts = Counter(modes)
    shares = ", ".join(f"{mode} {100.0 * counts[mode] / len(modes):.1f} %" for mode in Mode if counts[mode])
    lost = " The robot was LOST for part of the run: do not use these stretches." if counts[Mode.LOST] else ""
    return f"<p{' class=warn' if lost else ''}>Modes: {shares}.{lost}</p>"


def _judged(found: Sequence[Judgement]) -> str:
    """One table of what was judged to be wrong, when, by which evidence, and what that cost or saved."""
    if not found:
        return "<h2>What was judged wrong</h2><p>Nothing.</p>"
    shown = set(map(id, sorted(found, key=lambda j: (GRAVITY[j.kind], -j.rows))[:_MOST_ROWS]))
    rows = [(j.when, j.what, j.evidence, j.effect) for j in found if id(j) in shown]
    rest = f" {len(found) - len(rows)} more are in metrics.json." if len(found) > len(rows) else ""
    content = table(("when", "what", "evidence", "effect"), rows, numbers=0)
    return f'<h2>What was judged wrong</h2><p>{_JUDGED}{rest}</p><div class="wide judged">{content}</div>'


def _figures(metrics: Metrics) -> str:
    share = metrics.coverage or {}
    times = metrics.step_ms
    steps = "–" if times is None else f"{times.median:.2f} / {times.p95:.2f} / {times.p99:.2f} / {times.max:.2f} ms"
    rows = [
        ("ATE, mean", _number(metrics.ate_mean_m, 1.0, "{:.4f} m"), "mean distance from the truth"),
        ("ATE, rmse", _number(metrics.ate_rmse_m, 1.0, "{:.4f} m"), "root mean square distance from the truth"),
        ("yaw MAE", _number(metrics.yaw_mae_deg, 1.0, "{:.3f}°"), "mean absolute yaw error"),
        ("end error", _number(metrics.end_error_m, 1.0, "{:.4f} m"), "distance from the truth at the end"),
        ("drift", _number(metrics.drift_percent, 1.0, "{:.3f} %"), "end error over distance travelled"),
        ("NEES / 3", _number(metrics.nees_over_3, 1.0, "{:.3f}"), "1 is honest, more is over-confident"),
        (
            "coverage 1σ / 2σ / 3σ",
            " / ".join(_number(share.get(k), 100.0, "{:.1f} %") for k in ("1", "2", "3")),
            "share of x, y and yaw errors inside their band; honest: 68.3 / 95.4 / 99.7 %",
        ),
        ("first pose", _number(metrics.first_pose_s, 1.0, "{:.1f} s"), "after the recording's first step, as it went"),
        ("update", steps, "wall time of one step: median / p95 / p99 / worst"),
        (
            "real-time factor",
            _number(metrics.real_time_factor, 1.0, "{:.1f}"),
            "seconds of recording per second of work",
        ),
    ]
    cells = (
        f'<tr><td>{label}</td><td class="n">{text}</td><td class="why">{why}</td></tr>' for label, text, why in rows
    )
    return f"<table>{''.join(cells)}</table>"


def _sensors(result: RunResult) -> str:
    rows = []
    for name, topic in result.spans.items():
        steps = np.diff(np.sort(topic.times)) / topic.every
        rate = f"{1.0 / np.median(steps):.1f}" if len(steps) and np.median(steps) > 0 else "–"
        rows.append((name, topic.count, rate, f"{topic.longest_gap_s:.2f}" if topic.count > 1 else "–"))
    return table(("topic", "messages", "rate [Hz]", "longest gap [s]"), rows, numbers=3)


def _installation(result: RunResult) -> str:
    if result.found is None or not result.found.settings:
        return ""
    rows = [
        (
            s.name + (" (contradicts the given value)" if contradicted(s) else ""),
            f"{s.given:.6g} ± {s.prior_sigma:.2g}",
            f"{s.found:.6g} ± {s.sigma:.2g}",
            f"{s.off:+.1f}",
        )
        for s in result.found.settings
    ]
    head = ("setting", "given", "found", "apart, in σ of both")
    return f"<h2>Installation</h2><p>{escape(_INSTALLATION)}</p>{table(head, rows, numbers=3)}"


def _landmarks(result: RunResult) -> str:
    if result.landmarks is None:
        return ""
    used, refused = Counter[int](), Counter[int]()
    for decision in result.decisions:
        (refused if decision.weight == 0 else used)[decision.landmark_id] += 1
    rows = [
        (i, f"{lm.position[0]:.3f}", f"{lm.position[1]:.3f}", used[i], refused[i])
        for i, lm in sorted(result.landmarks.landmarks.items())
    ]
    return table(("id", "x [m]", "y [m]", "fused", "rejected"), rows, numbers=4)


def _most(counts: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], item[0]))


def _section(title: str, content: str) -> str:
    return f"<section><h2>{title}</h2>{content or '<p>None.</p>'}</section>"


def _list(title: str, items: Sequence[str]) -> str:
    if not items:
        return ""
    return f"<h2>{title}</h2><ul>{''.join(f'<li>{escape(item)}</li>' for item in items)}</ul>"


def _number(value: float | None, factor: float, form: str) -> str:
    return "–" if value is None else form.format(value * factor)
