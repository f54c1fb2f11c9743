"""Faults whose tests needed the real thing: GTSAM's own exceptions, notes of whole runs, a disk that is full."""

import re
import resource
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml
from circle_bag import write_circle
from test_ablation_sweep import SUITE
from test_graph import corner_sighting, wall_map

from fgloc.ablation.jobs import log_attempt, only_sweep, read_record, record_path
from fgloc.config import Config, EstimatorConfig
from fgloc.errors import OutputError
from fgloc.graph.estimators import IncrementalEstimator
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.runner import run
from fgloc.types import MotionMeasurement
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000


def driven(kind="fixed_lag"):
    """An estimator after ten keyframes along a corridor, its map's factors, and its motion."""
    walls = LandmarkFactors(wall_map())
    estimator = IncrementalEstimator(EstimatorConfig(kind=kind), walls)
    estimator.start(0, PoseWithCovariance(np.array([6.0, 0.0, 0.0]), np.eye(3) * 1e-4))
    motion = MotionMeasurement("wheels", 0, 1, np.array([0.1, 0.0, 0.0]), np.eye(3) * 1e-4)
    for k in range(1, 10):
        estimator.update(k * 10**8, 0.1, [motion])
    return estimator, walls, motion


@pytest.mark.parametrize("kind", ["fixed_lag", "isam2"])
def test_fault_67_a_key_that_gtsam_has_already_does_not_end_the_run(kind):
    """GTSAM itself refuses the key of the next pose, for its graph holds one."""
    estimator, walls, motion = driven(kind)
    twin, _, _ = driven(kind)
    twin.update(10**9, 0.1, [motion])
    estimator._backend = twin._backend  # one keyframe ahead of the log
    seen = corner_sighting(np.zeros(3), wall_map().landmarks[0])
    belief = estimator.update(10**9, 0.1, [motion], [walls.sighting(10, seen, 3.0)])
    assert np.isfinite(belief.cov).all()
    assert np.hypot(belief.pose[0] - 7.0, belief.pose[1]) < 0.2
    after = estimator.update(11 * 10**8, 0.1, [motion])
    assert after.pose[0] == pytest.approx(belief.pose[0] + 0.1, abs=1e-6)


@pytest.mark.parametrize("kind", ["fixed_lag", "isam2"])
def test_fault_67_a_value_that_gtsam_lacks_does_not_end_the_run(kind):
    """The graph that the next motion is to be added to does not hold the pose that it starts from."""
    estimator, _, motion = driven(kind)
    estimator._backend = estimator._new_backend()
    belief = estimator.update(10**9, 0.1, [motion])
    assert belief.pose[0] == pytest.approx(7.0, abs=1e-6)
    assert belief.cov[0, 0] == pytest.approx(11e-4, rel=1e-6)


def test_fault_38_a_run_says_that_the_distortion_is_taken_as_zero(tmp_path):
    K = [[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]
    png = cv2.imencode(".png", np.full((480, 640), 128, np.uint8))[1].tobytes()
    with BagWriter(tmp_path / "bag") as bag:
        bag.static_transform(START_NS, "base_link", "camera", (0.1, 0.0, 0.3), (-0.5, 0.5, -0.5, 0.5))
        bag.camera_info("/camera/camera_info", START_NS, (640, 480), K, [], frame_id="camera")
        for k in range(60):
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (0.02 * k, 0.0, 0.0), (0.4, 0.0))
            if k % 10 == 0:
                bag.compressed_image("/camera/image/compressed", stamp, png, frame_id="camera")
    config = Config.model_validate(
        {"markers": {"dictionary": "DICT_4X4_50", "default_size_m": 0.1}, "estimator": {"initial_pose": [0, 0, 0]}}
    )
    notes = run(tmp_path / "bag", None, config, "online").notes
    assert [note for note in notes if re.search(r"\bdistortion\b", note)]


@pytest.mark.slow
def test_fault_71_disk_full_in_a_sweep_is_an_error_and_it_goes_on_later(tmp_path):
    """The kernel refuses what is written beyond 3 kB a file, for the workers too."""
    write_circle(tmp_path, seconds=6.0)
    (tmp_path / "suite.yaml").write_text(yaml.safe_dump(SUITE | {"failures": []}))
    suite, out = str(tmp_path / "suite.yaml"), str(tmp_path / "out")
    command = [sys.executable, "-m", "fgloc.cli", "ablate", suite, "--out", out]

    def little():
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))

    done = subprocess.run([*command, "--workers", "1"], capture_output=True, text=True, preexec_fn=little, check=False)
    assert done.returncode == 1, done.stderr
    assert "error: " in done.stderr
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    done = subprocess.run([*command, "--workers", "1"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.html").exists()


def test_a_truncated_record_counts_as_missing(tmp_path):
    path = record_path(tmp_path, "k")
    path.parent.mkdir(parents=True)
    for text in ("", '{"key": "k", "outcome": "do', "\0" * 100, "[]"):
        path.write_text(text)
        assert read_record(tmp_path, "k") is None
    log_attempt(tmp_path, "abc")
    assert re.fullmatch(r"abc \d+\.\d{6}\n", (tmp_path / "jobs" / "attempts.log").read_text())


def test_two_sweeps_do_not_share_a_folder(tmp_path):
    with only_sweep(tmp_path), pytest.raises(OutputError, match=re.escape(str(tmp_path))), only_sweep(tmp_path):
        pass
    with only_sweep(tmp_path):
        pass
