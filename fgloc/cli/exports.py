"""Results for other tools: ``export``, and the options ``--mcap`` and ``--rrd`` of runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgloc.cli.terminal import say
from fgloc.errors import ConfigError

if TYPE_CHECKING:
    from fgloc.types import RunResult

_BASE = "base_link"


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", file_okay=False, help="results of smooth or online")],
    mcap: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="a bag of standard ROS 2 messages")
    ] = None,
    kitti: Annotated[
        Path | None, typer.Option(metavar="FILE", dir_okay=False, help="poses as KITTI has them, without stamps")
    ] = None,
) -> None:
    """Write a finished run for other tools. TUM, CSV and JSON are in its folder already."""
    if mcap is None and kitti is None:
        raise ConfigError("nothing to write: give --mcap FILE or --kitti FILE, or both")
    from fgloc.evaluation.results import read_results
    from fgloc.files.outputs import write_kitti
    from fgloc.recording.mcap_export import write_mcap

    results = read_results(folder)
    if mcap is not None:
        write_mcap(results, mcap, _base_frame(results.provenance.get("config")))
        say(f"MCAP: {mcap}")
    if kitti is not None:
        write_kitti(kitti, results.trajectory)
        say(f"KITTI: {kitti}")


def write_for_viewers(result: RunResult, rrd: Path | None, mcap: Path | None) -> None:
    """Write what ``--rrd`` and ``--mcap`` ask for. A truth in another frame than the map's is left out."""
    if rrd is not None:
        from fgloc.view.scene import write_rrd

        write_rrd(result, rrd)
    if mcap is not None:
        from fgloc.recording.mcap_export import write_mcap

        elsewhere = result.config is not None and result.config.truth.align != "none"
        base = None if result.config is None else result.config.recording.base_frame
        write_mcap(replace(result, truth=None) if elsewhere else result, mcap, base or _BASE)


def _base_frame(config: Any) -> str:
    """Of a configuration as ``config.json`` has it."""
    recording = config.get("recording") if isinstance(config, dict) else None
    base = recording.get("base_frame") if isinstance(recording, dict) else None
    return base if isinstance(base, str) else _BASE
