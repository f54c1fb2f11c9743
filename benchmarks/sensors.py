"""Sensors of other packages: UWB ranges and GNSS positions of the simulator, online, with the camera dark throughout.

``python -m benchmarks.sensors [--quick] [--json FILE]``. The robots are as installed. Runs with and without the sensor
begin at the true pose; without, they are dead reckoning by wheels, gyro and learned motion.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.common import Row, main
from benchmarks.example_sensors import example_sensors
from fgloc.ablation.jobs import start_at_truth
from fgloc.config import Config, load_config
from fgloc.evaluation.metrics import Metrics, compute_metrics
from fgloc.runner import run
from fgloc_datasets.sim.record import record
from fgloc_datasets.sim.scenario import Gnss, Scenario, Uwb

SEEDS = (71, 72, 73, 74, 75)
NAMES = ("uwb", "gnss")
_DURATION_S = 120.0
_NLOS, _MULTIPATH = 0.10, 0.05  # shares


def scenario(duration_s: float, wrong: bool) -> Scenario:
    """A run in the dark with both sensors, whose readings are partly wrong or all sound."""
    uwb = Uwb(nlos_share=_NLOS if wrong else 0.0)
    gnss = Gnss(multipath_share=_MULTIPATH if wrong else 0.0)
    return Scenario(name="radio", duration_s=duration_s, camera=None, uwb=uwb, gnss=gnss, installation="as_installed")


def only(config: Config, used: Sequence[str]) -> Config:
    """The configuration with these of the sensors."""
    off = {name: "none" for name in NAMES if name not in used}
    topics = config.recording.topics.model_copy(update=off)
    return config.model_copy(update={"recording": config.recording.model_copy(update={"topics": topics})})


def scores(folder: Path, used: Sequence[str]) -> Metrics:
    """Metrics of one run."""
    config = only(load_config(folder / "robot.yaml"), used)
    config = start_at_truth(folder / "bag", config)
    return compute_metrics(run(folder / "bag", None, config, "online", check=False), config)


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    seeds, duration_s = (SEEDS[:1], 20.0) if quick else (SEEDS, _DURATION_S)
    ratios: dict[str, list[float]] = {name: [] for name in NAMES}
    ates: dict[str, list[float]] = {name: [] for name in ("none", *NAMES)}
    nees: dict[str, list[float]] = {name: [] for name in NAMES}
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="fgloc-sensors-") as name:
            sound, wrong = Path(name) / "sound", Path(name) / "wrong"
            record(scenario(duration_s, False), seed, sound)
            record(scenario(duration_s, True), seed, wrong)
            without = _number(scores(sound, ()).ate_rmse_m)
            ates["none"].append(without)
            for sensor in NAMES:
                ates[sensor].append(_number(scores(sound, (sensor,)).ate_rmse_m))
                ratios[sensor].append(ates[sensor][-1] / without)
                nees[sensor].append(_number(scores(wrong, (sensor,)).nees_over_3))
    for sensor in NAMES:
        yield _row(f"{sensor}.ate_over_none", ratios[sensor])
        yield _row(f"{sensor}.nees_over_3", nees[sensor])
    for sensor, values in ates.items():
        yield replace(_row(f"{sensor}.ate_rmse_m", values), unit="m")


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _row(name: str, values: Sequence[float]) -> Row:
    return Row(name, float(np.mean(values)), float(np.std(values)), len(values))


if __name__ == "__main__":
    with example_sensors():
        main(measure, __doc__.splitlines()[0])
