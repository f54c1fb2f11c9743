"""Real recordings and the bundled sample, through the same program: ``python -m benchmarks.real``.

MRCLAM 6: robot k is localized with a motion model trained on the other four and constants fitted on the other four
(`fgloc_datasets.mrclam`); shared settings (correlation time of the sightings, priors of the self-calibration) are one
set for all five. Values are means over the robots, spreads their standard deviation.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import yaml

from benchmarks import stills
from benchmarks.common import DATA, SAMPLES, Row, main, not_run
from benchmarks.field_sheet import MODES
from benchmarks.recordings import MRCLAM, converted
from fgloc import se2
from fgloc.calibration.first_settings import first_settings
from fgloc.calibration.installation import with_settings
from fgloc.config import Config, config_of_file, load_config
from fgloc.evaluation.metrics import compute_metrics
from fgloc.recording.reader import open_recording
from fgloc.runner import RunResult, run
from fgloc.sensors.equipment import LandmarkSensor
from fgloc.sensors.maps import load_map
from fgloc.sensors.measurements import PointMeasurement
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc_datasets import mrclam

_SAMPLE = SAMPLES / "first_run"
_MRCLAM_UNITS = {
    "ate_mean_m": "m",
    "yaw_mae_deg": "deg",
    "nees_over_3": "",
    "first_pose_s": "s",
    "real_time_factor": "x",
}
_BAD_SPEED = 2.0  # m/s: twice the gate's bound on this robot; a keyframe that moves faster is an accepted spike


def measure(quick: bool) -> Iterator[Row]:
    """Yield every row; a quick run takes one robot of MRCLAM."""
    if MRCLAM.is_dir():
        yield from _mrclam((3,) if quick else mrclam.ROBOTS)
    else:
        ids = [f"mrclam.{mode}.{key}" for mode in MODES for key in _MRCLAM_UNITS]
        yield from not_run(ids, f"no {MRCLAM}; set FGLOC_REAL_DATA")
    turtlebot3 = DATA / "turtlebot3"
    if turtlebot3.is_dir():
        yield from _turtlebot3(turtlebot3)
    else:
        yield from not_run(["turtlebot3.residual_median_m"], f"no {turtlebot3}; set FGLOC_REAL_DATA")
    yield from stills.measure(quick)
    yield from _sample()


def _mrclam(robots: Iterable[int]) -> Iterator[Row]:
    found: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for robot in robots:
            bag, map_path, config = converted(robot, Path(scratch))
            for mode in MODES:
                metrics = compute_metrics(run(bag, map_path, config, mode), config)
                for key in _MRCLAM_UNITS:
                    found.setdefault(f"mrclam.{mode}.{key}", []).append(getattr(metrics, key))
    for name, values in found.items():
        yield Row(name, float(np.mean(values)), float(np.std(values)), len(values), _MRCLAM_UNITS[name.split(".")[-1]])


def _turtlebot3(folder: Path) -> Iterator[Row]:
    """Rows of a bag of others with its own map, with what `fgloc init` writes and what the run itself finds."""
    bag, map_path = folder / "rosbag2_2025_11_25-15_11_34", folder / "landmarks_2025_real.yaml"
    config = config_of_file(yaml.safe_load(first_settings(bag).text))
    result = run(bag, map_path, config, "batch")
    assert result.found is not None
    medians = _residual_medians(bag, with_settings(config, result.found.settings), map_path, result)
    yield Row(
        "turtlebot3.residual_median_m", max(medians.values()), float(np.std(list(medians.values()))), len(medians), "m"
    )
    poses, seconds = result.trajectory.poses, np.diff(result.trajectory.stamps_ns) * 1e-9
    speeds = np.hypot(*np.diff(poses[:, :2], axis=0).T) / seconds
    wrong = int((~np.isfinite(poses).all(axis=1)).sum() + (speeds > _BAD_SPEED).sum())
    yield Row("turtlebot3.accepted_spikes", wrong, n=len(poses))


def _residual_medians(bag: Path, config: Config, map_path: Path, result: RunResult) -> dict[int, float]:
    """Median distance [m] between where each landmark is and where the smoothed robot's sightings put it."""
    landmark_map = load_map(map_path)
    x, y, z, _, _, yaw = config.recording.sightings_pose or (0.0,) * 6
    T_base_sensor = np.eye(4)
    T_base_sensor[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T_base_sensor[:3, 3] = x, y, z
    sensor = LandmarkSensor(config, landmark_map, None, T_base_sensor)
    distances: dict[int, list[float]] = {}
    with open_recording(bag, config.recording) as recording:
        events = [e for e in recording.events() if isinstance(e, RangeBearingEvent)]
    stamps = result.trajectory.stamps_ns
    for event in events:
        if not stamps[0] <= event.stamp_ns <= stamps[-1]:
            continue
        (pose,) = se2.interpolate(stamps, result.trajectory.poses, np.array([event.stamp_ns]))
        for m in sensor.measure(event):
            if isinstance(m, PointMeasurement):
                local = (m.range_m * np.cos(m.bearing_rad), m.range_m * np.sin(m.bearing_rad), 0.0)
                away = se2.compose(pose, local)[:2] - landmark_map.landmarks[m.landmark_id].position[:2]
                distances.setdefault(m.landmark_id, []).append(float(np.hypot(*away)))
    return {landmark: float(np.median(values)) for landmark, values in distances.items()}


def _sample() -> Iterator[Row]:
    bag = _SAMPLE / "bag"
    config = load_config(_SAMPLE / "robot.yaml")
    for mode in MODES:
        metrics = compute_metrics(run(bag, _SAMPLE / "map.yaml", config, mode), config)
        yield Row(f"sample.{mode}.ate_mean_m", metrics.ate_mean_m, unit="m")
        yield Row(f"sample.{mode}.nees_over_3", metrics.nees_over_3)


if __name__ == "__main__":
    main(measure, __doc__ or "")
