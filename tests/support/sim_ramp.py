"""A simulated robot that drives over a ramp, recorded with the corners of markers."""

from __future__ import annotations

import heapq
from operator import itemgetter
from pathlib import Path

from fgloc import run
from fgloc.config import Config, load_config
from fgloc.runner import RunResult
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.physics import make_scene, simulate
from fgloc_datasets.sim.record import write_beside
from fgloc_datasets.sim.scenario import Scenario
from fgloc_datasets.sim.sensors import streams

RAMP = Scenario.model_validate(
    {
        "name": "ramp",
        "duration_s": 16.0,
        "start": (-1.9, 0.0, 0.0),
        "world": {
            "size_m": (6.0, 5.0),
            "floor": {"ramp": {"start_x": -1.2, "angle_deg": 12.0, "rise_m": 0.8, "top_m": 0.6}},
            "markers": {"count": 20},
        },
        "camera": {"rate_hz": 5},
        "control": {"waypoints": [(0.9, 0.0), (0.2, 0.3), (-1.9, 0.0)], "speed": 0.45},
        "installation": "as_installed",
    }
)


def record_ramp(out: Path) -> Path:
    """Drive and record it."""
    scene = make_scene(RAMP, 5)
    log = simulate(scene)
    with BagWriter(out / "bag", compress=True) as bag:
        for _, write in heapq.merge(*streams(scene, log, bag, "corners"), key=itemgetter(0)):
            write()
    write_beside(out, scene, RAMP, camera=False)
    return out


def estimated(folder: Path, mode: str, imu: bool = True, **estimator: object) -> tuple[RunResult, Config]:
    """A run of it, and its configuration, with settings of the estimator changed."""
    config = load_config(folder / "robot.yaml")
    update: dict[str, object] = {"estimator": config.estimator.model_copy(update=estimator)}
    if not imu:
        topics = config.recording.topics.model_copy(update={"imu": "none"})
        update["recording"] = config.recording.model_copy(update={"topics": topics})
    config = config.model_copy(update=update)
    return run(folder / "bag", folder / "map.yaml", config, mode, check=False), config  # type: ignore[arg-type]
