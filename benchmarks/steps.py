"""Where the time of one online step goes, and what it costs over bare GTSAM: ``python -m benchmarks.steps``.

A robot sways before a wall with four markers in view, 20 images a second, odometry and commands at 50 and 20 Hz, lag
10 s, with a learned motion model; images are left out except where detection itself is timed (on the bundled sample).
``online.fuse_over_gtsam`` gives each step's own factors, ready made, to a plain ``IncrementalFixedLagSmoother`` in the
same process, which also returns pose and covariance; our side of the ratio includes making the motion factors.
Beside the wall time of updates stands the processor's (``cpu``): on a shared machine the tail of the former is that of
the scheduler. The motion model is of another robot, as happens; it is found out in the first seconds.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.common import Row, main
from fgloc import se2
from fgloc.config import Config, load_config
from fgloc.frames import yaw_quaternion
from fgloc.graph.factors import motion_factor, pose_key, prior_factor
from fgloc.graph.isam2_backends import isam2_params
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.intake.validation import EventValidator
from fgloc.localizer import Localizer
from fgloc.recording.reader import open_recording
from fgloc.sensors.equipment import MotionSensors, PoseSensors
from fgloc.sensors.landmarks import LandmarkSensor
from fgloc.sensors.learned import load_model
from fgloc.sensors.learned.source import LearnedMotion
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.timing import Stopwatch
from fgloc.types import Camera, ControlEvent, Event, FloatArray, Landmark, LandmarkMap

_ROOT = Path(__file__).resolve().parent.parent
_SAMPLE = _ROOT / "datasets" / "samples" / "first_run"
_MODEL = _ROOT / "fgloc" / "motion" / "models" / "mrclam" / "all.safetensors"
_WALL = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # a marker that faces -x
_T_BASE_CAM = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.2], [0.0, 0.0, 0.0, 1.0]])
_K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
_TICK_NS = 10_000_000  # 100 Hz
_START_NS = 1_700_000_000_000_000_000


def measure(quick: bool) -> Iterator[Row]:
    """Yield every row; a quick run lasts 2 minutes instead of 60."""
    minutes = 2 if quick else 60
    yield from _detection()
    yield from _phases_and_ratio(60 if quick else 300)
    yield from _long_run(minutes)


class _World:
    """Events of the swaying robot, made as they are asked for."""

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self.map = LandmarkMap({i: Landmark(i, np.array([4.0, -1.2 + 0.8 * i, 0.3]), _WALL, 0.2) for i in range(4)})
        self.camera = Camera(640, 480, "plumb_bob", _K, np.array([0.05, -0.02, 0.001, -0.002]), _T_BASE_CAM)

    @staticmethod
    def twist(t: float) -> tuple[float, float]:
        """Speed [m/s] and yaw rate [rad/s]: to and fro, so that the markers stay in view for hours."""
        return 0.3 * np.cos(0.7 * t), 0.1 * np.cos(0.9 * t)

    def events(self, seconds: float) -> Iterator[Event]:
        """Odometry at 50 Hz, commands at 20 Hz, corners at 20 Hz."""
        pose = np.zeros(3)
        for tick in range(round(seconds * 100)):
            stamp, t = _START_NS + tick * _TICK_NS, tick * 0.01
            v, omega = self.twist(t)
            if tick % 2 == 0:
                yield self._odometry(stamp, pose, v, omega)
            if tick % 5 == 0:
                yield ControlEvent(stamp, stamp, "/cmd_vel", v, omega)
                yield self._corners(stamp, pose)
            pose = se2.compose(pose, se2.exp((v * 0.01, 0.0, omega * 0.01)))

    def _odometry(self, stamp: int, pose: FloatArray, v: float, omega: float) -> OdometryEvent:
        v_noisy, omega_noisy = v + self._rng.normal(0, 0.01), omega + self._rng.normal(0, 0.01)
        return OdometryEvent(
            stamp,
            stamp,
            "/odom",
            "odom",
            "base_link",
            np.array([pose[0], pose[1], 0.0]),
            yaw_quaternion(pose[2]),
            np.zeros((6, 6)),
            np.array([v_noisy, 0.0, 0.0]),
            np.array([0.0, 0.0, omega_noisy]),
            np.zeros((6, 6)),
        )

    def _corners(self, stamp: int, pose: FloatArray) -> CornersEvent:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        T_map_base = np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        T_cam_map = np.linalg.inv(T_map_base @ _T_BASE_CAM)
        k1, k2, p1, p2 = self.camera.D
        seen = []
        for landmark in self.map.landmarks.values():
            points = landmark.corners() @ T_cam_map[:3, :3].T + T_cam_map[:3, 3]
            x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2 * r2
            u = 500.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 320.0
            w = 500.0 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 240.0
            corners = np.column_stack([u, w]) + self._rng.normal(0, 0.3, (4, 2))
            seen.append(MarkerCorners(landmark.landmark_id, corners))
        return CornersEvent(stamp, stamp, "/detections", "camera", tuple(seen))


class _Chain:
    """Gate, stepper and localizer on a world, as the runner has them."""

    def __init__(self, world: _World, keep_times: bool = False) -> None:
        config = Config.model_validate({"wheels": {"source": "twist"}})
        self.gate = EventValidator(config.gate, set(world.map.landmarks))
        self.stepper = KeyframeBuilder(config.keyframes, config.gate, config.estimator.lag_s)
        model = load_model(_MODEL)
        wheels, landmarks = WheelMotion(config.wheels), LandmarkSensor(config, world.map, world.camera, None)
        learned = LearnedMotion(model, config.motion)
        self.localizer = Localizer(
            config, world.map, MotionSensors(wheels, learned, model.joint), PoseSensors(landmarks)
        )
        self.localizer.stopwatch = Stopwatch(keep=keep_times)
        self.config = config

    def updates(self, events: Iterator[Event]) -> Iterator[tuple[float, float]]:
        """Run; yield the wall and the processor time [s] of each update."""
        clock = self.localizer.stopwatch
        for event in events:
            with clock("gate"):
                passed = self.gate.check(event)
            if passed is None:
                continue
            with clock("stepper"):
                steps = self.stepper.push(passed)
            for step in steps:
                start, cpu_start = time.perf_counter(), time.thread_time()
                self.localizer.update(step)
                yield time.perf_counter() - start, time.thread_time() - cpu_start


def _phases_and_ratio(seconds: float) -> Iterator[Row]:
    """Time by phase, and of the same factors given to bare GTSAM."""
    chain = _Chain(_World(), keep_times=True)
    estimator = chain.localizer.estimator
    bare = gtsam.IncrementalFixedLagSmoother(chain.config.estimator.lag_s, isam2_params(chain.config.estimator))
    bare_s: list[float] = []
    fed = -1
    for _ in chain.updates(_World().events(seconds)):
        bare_s += [_feed(bare, estimator.log.keyframes[k]) for k in range(fed + 1, estimator.k + 1)]
        fed = estimator.k
    steps = len(chain.localizer.stopwatch.samples["fuse"])
    for phase in ("gate", "stepper", "motion", "sightings", "weigh", "fuse"):
        sample = np.array(chain.localizer.stopwatch.samples[phase]) * 1e6
        per_step = float(sample.sum()) / steps
        yield Row(f"steps.{phase}_us", per_step, float(np.std(sample)), steps, "us/step")
    fuse = np.array(chain.localizer.stopwatch.samples["fuse"])[-len(bare_s) :]
    bare_us = np.array(bare_s[-len(fuse) :]) * 1e6
    yield Row("steps.bare_gtsam_us", float(bare_us.mean()), float(bare_us.std()), len(bare_us), "us/step")
    yield Row("online.fuse_over_gtsam", float(fuse.sum() * 1e6 / bare_us.sum()), n=len(bare_us))
    yield Row("online.fuse_over_gtsam_median", float(np.median(fuse) * 1e6 / np.median(bare_us)), n=len(bare_us))


def _feed(bare: gtsam.IncrementalFixedLagSmoother, frame) -> float:  # type: ignore[no-untyped-def]
    """Give a keyframe's factors to the bare smoother; seconds of its update, estimate and covariance."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(pose_key(frame.k), gtsam.Pose2(*frame.belief.pose))
    if frame.prior is not None:
        graph.add(prior_factor(frame.k, frame.prior.pose, frame.prior.cov))
    for motion in frame.motions:
        graph.add(motion_factor(frame.k, motion))
    for sighting in frame.sightings:
        for factor in sighting.factors:
            graph.add(factor)
    stamps = {pose_key(frame.k): frame.elapsed_s}
    start = time.perf_counter()
    bare.update(graph, values, stamps)
    bare.calculateEstimatePose2(pose_key(frame.k))
    bare.marginalCovariance(pose_key(frame.k))
    return time.perf_counter() - start


def _long_run(minutes: int) -> Iterator[Row]:
    """An hour of updates: the tail, the growth of time and of memory."""
    chain = _Chain(_World())
    times, n, memory_kb = np.ones((2000 * minutes, 2)), 0, {}  # memory of its own, taken from the start
    for wall_and_cpu in chain.updates(_World().events(60.0 * minutes)):
        times[n] = wall_and_cpu
        n += 1
        if n in (1200, 1200 * minutes - 20):
            memory_kb[n] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    wall, cpu = times[:n].T * 1e3
    for label, sample in (("update", wall), ("update_cpu", cpu)):
        yield Row(f"online.{label}_median_ms", float(np.median(sample)), n=len(sample), unit="ms")
        yield Row(f"online.{label}_p99_ms", float(np.percentile(sample, 99)), n=len(sample), unit="ms")
        yield Row(f"online.{label}_max_ms", float(sample.max()), n=len(sample), unit="ms")
        yield Row(f"online.{label}_growth", float(np.median(sample[-1200:]) / np.median(sample[:1200])), n=1200)
    marks = sorted(memory_kb.values())
    yield Row("online.memory_growth_mb", (marks[-1] - marks[0]) / 1024, unit="MB")


def _detection() -> Iterator[Row]:
    """Decoding and detection on the images of the bundled sample."""
    config = load_config(_SAMPLE / "robot.yaml")
    detector = MarkerDetector(load_map(_SAMPLE / "map.yaml").dictionary, config.markers)
    times = []
    with open_recording(_SAMPLE / "bag", config.recording) as recording:
        for event in recording.events():
            if isinstance(event, ImageEvent):
                start = time.perf_counter()
                detector.detect(event)
                times.append((time.perf_counter() - start) * 1e3)
    yield Row("steps.detection_ms", float(np.median(times)), float(np.std(times)), len(times), "ms/image")


if __name__ == "__main__":
    main(measure, __doc__ or "")
