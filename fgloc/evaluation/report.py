"""Everything a run leaves behind: the files of one folder, and a report that needs nothing but itself."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from fgloc.calibration.installation import with_settings
from fgloc.config import Config, yaml_of
from fgloc.evaluation.ground_plots import plot_height, plot_space
from fgloc.evaluation.html import embedded, page, plotly, script_data
from fgloc.evaluation.interactive import interactive
from fgloc.evaluation.judgements import numbered
from fgloc.evaluation.matching import Matched
from fgloc.evaluation.metrics import Metrics, compute_metrics, match_result
from fgloc.evaluation.plots import plot_error
from fgloc.evaluation.report_tables import content_of
from fgloc.evaluation.style import FORMATS, Format, image_of, png
from fgloc.evaluation.timeline import plot_timeline
from fgloc.evaluation.trajectory_plot import plot_trajectory
from fgloc.files.atomic import atomic_folder
from fgloc.files.outputs import write_bytes, write_covariance_csv, write_json, write_steps_csv, write_text, write_tum
from fgloc.recording.reader import open_recording
from fgloc.recording.truth import true_slips
from fgloc.sensors.maps import write_map
from fgloc.types import InstallationFound, IntArray, RunResult

_FIGURES = ("trajectory", "error", "timeline", "space", "height")  # the last two: on uneven ground
FILES = (
    "trajectory.tum",
    "covariance.csv",
    "steps.csv",
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
    result: RunResult,
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
    images = {f"{name}.png": png(figure) for name, figure in drawn.items()}
    files = {f"{name}.{form}": image_of(figure, form) for form in figures for name, figure in drawn.items()}
    with atomic_folder(out, own=FILES) as stage:
        write_tum(stage / "trajectory.tum", result.trajectory)
        write_covariance_csv(stage / "covariance.csv", result.trajectory)
        write_steps_csv(stage / "steps.csv", result.decisions, numbered(result))
        write_json(stage / "metrics.json", metrics.model_dump())
        write_json(stage / "config.json", provenance)
        for name, data in ({name: images[name] for name in _ALWAYS} | files).items():
            write_bytes(stage / name, data)
        if result.found is not None and result.found.names:
            write_text(stage / "installation.yaml", installation_yaml(result.found, config, out, command))
            if result.found.landmarks is not None:
                write_map(result.found.landmarks, stage / "map.yaml")
        write_text(stage / "report.html", render(result, metrics, matched, images, provenance))
    return metrics


def _provenance(result: RunResult, config: Config, command: str, input_hash: str | None) -> dict[str, Any]:
    """What ``config.json`` holds: how the result came about."""
    source = None if result.source is None else str(result.source)
    return {
        "command": command,
        "input": {"path": source, "sha256": input_hash},
        "versions": {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}},
        "config": config.model_dump(mode="json"),
    }


def _drawn(result: RunResult, matched: Matched | None, config: Config) -> dict[str, Figure]:
    """The figures of a run by name."""
    drawn = {
        "trajectory": plot_trajectory(result, matched),
        "error": plot_error(result, matched),
        "timeline": plot_timeline(result, matched, _slips(result, config)),
    }
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
