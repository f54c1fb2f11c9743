"""Uneven ground where something is missing: an IMU, a sensor for a while, the time between two runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from live_feed import PATIENCE_S
from sim_ramp import estimated, record_ramp

from fgloc.ablation.jobs import execute, make_jobs, read_record
from fgloc.ablation.suite import expand, load_suite
from fgloc.config import Config, load_config
from fgloc.evaluation.metrics import ground_metrics, match_result
from fgloc.live import Live, LivePose
from fgloc.recording.reader import open_recording
from fgloc.sensors.maps import load_map
from fgloc.types import Event, TransformEvent, TruthEvent

ROLES = ("odometry", "command", "joints", "imu", "sightings")
SUITE = {
    "title": "ramp",
    "mode": "online",
    "recordings": [{"name": "ramp", "bag": "bag", "config": "robot.yaml"}],
    "variants": [{"name": "uneven", "config": {"estimator": {"ground": "uneven"}}}],
    "failures": [
        {"name": "dark", "chain": [{"kind": "dropout", "sensor": "camera", "when": {"intervals": [[4, 6]]}}]},
        {"name": "no imu", "chain": [{"kind": "dropout", "sensor": "imu", "when": {"intervals": [[4, 8]]}}]},
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with the corners of markers."""
    return record_ramp(tmp_path_factory.mktemp("ramp"))


def test_without_an_imu_markers_tell_the_slope(folder: Path) -> None:
    result, config = estimated(folder, "online", imu=False)
    matched = match_result(result, config)
    assert matched is not None
    assert matched.true_ground is not None
    found = ground_metrics(matched)
    assert found is not None
    assert np.ptp(matched.true_ground[:, 0]) > 0.1  # it was on top
    assert found.ate_rmse_m < 0.05
    assert found.pitch_rmse_deg < 2.0
    assert 0.1 < found.nees_over_6 < 3.0


@pytest.mark.slow
def test_failures_are_swept_on_a_ramp(folder: Path, tmp_path: Path) -> None:
    path = folder / "suite.yaml"
    path.write_text(yaml.safe_dump(SUITE))
    records = {}
    for job in make_jobs(expand(load_suite(path), folder)):
        execute(job, tmp_path)
        record = read_record(tmp_path, job.key)
        assert record is not None
        assert record.outcome == "done"
        records[job.cell.failure] = record
    ate = {name: record.figures["ate_mean_m"] for name, record in records.items()}
    assert ate["none"] < 0.02
    assert records["dark"].affected["dropout"] > 5
    assert records["no imu"].affected["dropout"] > 300
    assert max(ate.values()) < 0.05


def test_resumed_on_another_slope_it_is_found_in_space(folder: Path, tmp_path: Path) -> None:
    """The state was saved on the level floor; the robot is on the ramp when it begins again."""
    config, state = uneven(folder), tmp_path / "state.json"
    with open_recording(folder / "bag", config.recording) as recording:
        events = [e for e in recording.events() if not isinstance(e, TruthEvent)]
    began = min(e.received_ns for e in events)
    before = [e for e in events if e.received_ns < began + 2.0e9]
    first = driven(folder, config, state, before)
    assert abs(first.ground.pitch) < np.radians(1.5)  # type: ignore[union-attr]
    transforms = [e for e in events if isinstance(e, TransformEvent)]
    on_ramp = [e for e in events if began + 3.2e9 <= e.received_ns < began + 4.2e9]
    second = driven(folder, config, state, [*transforms, *on_ramp])
    assert second.ground is not None
    true = truth_at(folder, config, second.stamp_ns)
    assert abs(true[3]) > np.radians(6.0)  # it is on the ramp
    error = np.array([*second.pose[:2], second.ground.z, second.ground.pitch]) - true
    assert np.linalg.norm(error[:3]) < 0.05
    assert abs(error[3]) < np.radians(2.0)


def uneven(folder: Path) -> Config:
    config = load_config(folder / "robot.yaml")
    return config.model_copy(update={"estimator": config.estimator.model_copy(update={"ground": "uneven"})})


def driven(folder: Path, config: Config, state: Path, events: list[Event]) -> LivePose:
    """The last pose of a live run that goes on from a state and saves its own."""
    with Live(config, load_map(folder / "map.yaml", None), state=state, roles=ROLES) as live:
        for event in events:
            live.push(event)
        assert live.wait(PATIENCE_S)
        pose = live.pose_at()
    assert pose is not None
    return pose


def truth_at(folder: Path, config: Config, stamp_ns: int) -> np.ndarray:
    """x, y, z, pitch of the truth nearest to a time."""
    result, _ = estimated(folder, "online")
    truth = result.truth
    assert truth is not None
    assert truth.ground is not None
    k = int(np.argmin(np.abs(truth.stamps_ns - stamp_ns)))
    return np.array([*truth.poses[k, :2], truth.ground[k, 0], truth.ground[k, 2]])
