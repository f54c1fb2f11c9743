"""A camera that is knocked in the run: its mounting is found again, and the covariance stays right meanwhile."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from robot_world import CAMERA, SIGMA_PX, START_NS, T_BASE_CAM, TURN, World, project, room
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.config import config_of
from fgloc.evaluation.judgements import judgements
from fgloc.evaluation.metrics import match_result
from fgloc.runner import RunResult, run
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

SETTINGS = {"wheels": {"source": "twist"}, "markers": {"sigma_px": SIGMA_PX}}
KNOCK_S, SECONDS = 20.0, 60.0
LEVEL, TILTED = (0.0, 0.0, 0.06), (0.03, -0.07, 0.01)  # rad: roll, pitch, yaw of the camera since then


def recorded(folder: Path, turned: tuple[float, float, float]) -> Path:
    """Bag of a circle with a gyro; from `KNOCK_S` on the camera looks elsewhere."""
    rng, world = np.random.default_rng(8), World(room(), seconds=SECONDS, rate=5)
    yaw = turned[2]
    with BagWriter(folder / "bag") as bag:
        bag.camera_info("/camera_info", START_NS, (640, 480), CAMERA.K, [0.0] * 4, frame_id="cam")
        quaternion = tuple(Rotation.from_matrix(T_BASE_CAM[:3, :3]).as_quat())
        bag.static_transform(START_NS, "base_link", "cam", T_BASE_CAM[:3, 3], quaternion)
        for event in world.events():
            stamp, pose = event.stamp_ns, world.truth(event.stamp_ns)
            if isinstance(event, OdometryEvent):
                bag.odometry("/odom", stamp, pose, (event.linear[0], event.angular[2]))
                bag.imu("/imu", stamp, (0.0, 0.0, TURN + 0.004 * rng.normal()), (0.0, 0.0, 9.81), frame_id="base_link")
                bag.truth("/truth", stamp, (*pose[:2], 0.0), (0, 0, math.sin(pose[2] / 2), math.cos(pose[2] / 2)))
            if isinstance(event, CornersEvent):
                after = (stamp - START_NS) * 1e-9 >= KNOCK_S
                at, tilt = (se2.compose(pose, (0.0, 0.0, yaw)), turned[:2]) if after else (pose, (0.0, 0.0))
                views = {i: project(at, m, tilt) for i, m in room().landmarks.items()}
                seen = {i: c + rng.normal(0.0, SIGMA_PX, (4, 2)) for i, c in views.items() if c is not None}
                bag.corners("/tags", stamp, seen, frame_id="cam", received_ns=stamp + 40_000_000)
    write_map(room(), folder / "map.yaml")
    return folder / "bag"


@pytest.fixture(scope="module", params=[LEVEL, TILTED], ids=["level", "tilted"])
def knocked(request, tmp_path_factory) -> Path:
    return recorded(tmp_path_factory.mktemp("knocked"), request.param)


def settled(result: RunResult) -> tuple[float, float]:
    """Largest error of the last 20 s [mm], and mean NEES/3."""
    matched = match_result(result, result.config)
    late = matched.stamps_ns > START_NS + (SECONDS - 20.0) * 1e9
    off = np.array([se2.between(t, e) for t, e in zip(matched.truth[late], matched.estimate[late], strict=True)])
    covs = [se2.rotate_cov(c, -float(e[2])) for c, e in zip(matched.covs[late], matched.estimate[late], strict=True)]
    nees = [float(d @ np.linalg.solve(cov, d)) / 3.0 for d, cov in zip(off, covs, strict=True)]
    return 1e3 * float(np.hypot(off[:, 0], off[:, 1]).max()), float(np.mean(nees))


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_fault_72_a_knocked_camera_is_named_and_its_mounting_found_again(knocked, mode):
    result = run(knocked, knocked.parent / "map.yaml", config_of(SETTINGS), mode, check=False)
    found = [j for j in judgements(result) if j.kind == "mounting_changed"]
    assert [j.subject for j in found] == ["camera"]
    assert KNOCK_S <= found[0].from_s < KNOCK_S + 15.0
    assert any(f.severity is Severity.WARNING and "knocked" in f.text for f in result.findings)
    worst_mm, nees = settled(result)
    assert worst_mm < 60.0
    assert nees < 5.0


def test_a_camera_that_stays_where_it_is_was_not_knocked(tmp_path):
    bag = recorded(tmp_path, (0.0, 0.0, 0.0))
    result = run(bag, tmp_path / "map.yaml", config_of(SETTINGS), "online", check=False)
    assert not [d for d in result.decisions if d.reason == "mounting_changed"]
    assert settled(result)[1] < 3.0


def test_one_graph_of_all_poses_has_one_mounting(knocked):
    settings = config_of(SETTINGS | {"estimator": {"kind": "isam2"}})
    result = run(knocked, knocked.parent / "map.yaml", settings, "online", check=False)
    assert not [d for d in result.decisions if d.reason == "mounting_changed"]
