"""Where the time of one online step goes, and what it costs over bare GTSAM: ``python -m benchmarks.steps``.

A robot sways before a wall with four markers in view, 20 images a second, odometry and commands at 50 and 20 Hz, lag
10 s, with a learned motion model; images are left out except where detection itself is timed (on the bundled sample).
``online.fuse_over_gtsam`` gives each step's own factors, ready made, to a plain ``IncrementalFixedLagSmoother`` in the
same process, which also returns pose and covariance; our side of the ratio includes making the factors.
``online.update_over_gtsam`` has the whole update on our side: from a step's events to its estimate, in processor time.
``map60.over_map4``, ``map5000.over_map60``: processor time of an update, median, with so many markers in the map and
the same four in view; the maps take turns.
Beside the wall time of updates stands the processor's (``cpu``): on a shared machine the tail of the former is that of
the scheduler. The motion model is of another robot, as happens; it is found out in the first seconds.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np

from benchmarks.common import MODELS, SAMPLES, Row, main
from fgloc import se2
from fgloc.config import config_of, load_config
from fgloc.estimation.localizer import Localizer
from fgloc.frames import yaw_quaternion
from fgloc.graph.estimators import FixedLag, isam2_params
from fgloc.graph.factors import pose_key
from fgloc.instrumentation import Stopwatch
from fgloc.intake.keyframing import KeyframeBuilder
from fgloc.intake.validation import EventValidator
from fgloc.recording.reader import open_recording
from fgloc.sensors.equipment import LandmarkSensor, MotionSensors, PoseSensors
from fgloc.sensors.learned.sensor import LearnedMotion, load_model
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.sensors.markers.images import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Camera, ControlEvent, Event, FloatArray, Landmark, LandmarkMap

_SAMPLE = SAMPLES / "first_run"
_MODEL = MODELS / "all.safetensors"
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
    yield from _maps(20 if quick else 100)
    yield from _long_run(minutes)


class World:
    """Events of the swaying robot, made as they are asked for."""

    def __init__(self, seed: int = 0, markers: int = 4) -> None:
        self._rng = np.random.default_rng(seed)
        places = [(4.0, -1.2 + 0.8 * i) for i in range(4)] + [(-50.0 - i // 50, 1.0 * (i % 50)) for i in range(markers)]
        held = [Landmark(i, np.array([*place, 0.3]), _WALL, 0.2) for i, place in enumerate(places[:markers])]
        self.map = LandmarkMap({one.landmark_id: one for one in held})
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
        for landmark in [self.map.landmarks[i] for i in range(4)]:
            points = landmark.corners() @ T_cam_map[:3, :3].T + T_cam_map[:3, 3]
            x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2 * r2
            u = 500.0 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 320.0
            w = 500.0 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 240.0
            corners = np.column_stack([u, w]) + self._rng.normal(0, 0.3, (4, 2))
            seen.append(MarkerCorners(landmark.landmark_id, corners))
        return CornersEvent(stamp, stamp, "/detections", "camera", tuple(seen))


class Chain:
    """Gate, stepper and localizer on a world, as the runner has them."""

    def __init__(self, world: World, keep_times: bool = False, keep_all: bool = False, with_model: bool = True) -> None:
        config = config_of({"wheels": {"source": "twist"}})
        self.gate = EventValidator(config.gate, set(world.map.landmarks))
        self.stepper = KeyframeBuilder(config.keyframes, config.gate, config.estimator.lag_s)
        wheels, landmarks = WheelMotion(config.wheels), LandmarkSensor(config, world.map, world.camera, None)
        motion = MotionSensors(wheels)
        if with_model:
            model = load_model(_MODEL)
            motion = MotionSensors(wheels, LearnedMotion(model, config.motion), model.joint)
        self.localizer = Localizer(config, world.map, motion, PoseSensors(landmarks), keep_all)
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
    with _mirrored() as mirrors:
        chain = Chain(World(), keep_times=True)
        clock, estimator = chain.localizer.stopwatch, chain.localizer.estimator
        times: list[tuple[float, float, float, float]] = []  # update (processor), fuse (wall), bare (wall, processor)
        steps = 0
        for _, cpu_s in chain.updates(World().events(seconds)):
            bare = mirrors[-1].follow(estimator.k) if mirrors else None
            fused = clock.samples.get("fuse", ())
            if bare is not None and len(fused) > steps:
                times.append((cpu_s, fused[-1], *bare))
            steps = len(fused)
    for phase in ("gate", "stepper", "motion", "sightings", "weigh", "fuse"):
        sample = np.array(clock.samples[phase]) * 1e6
        yield Row(f"steps.{phase}_us", float(sample.sum()) / steps, float(np.std(sample)), steps, "us/step")
    update, fuse, bare_wall, bare_cpu = np.array(times).T
    n = len(update)
    yield Row("steps.bare_gtsam_us", float(bare_wall.mean()) * 1e6, float(bare_wall.std()) * 1e6, n, "us/step")
    yield Row("online.fuse_over_gtsam", float(fuse.sum() / bare_wall.sum()), n=n)
    yield Row("online.fuse_over_gtsam_median", float(np.median(fuse) / np.median(bare_wall)), n=n)
    yield Row("online.update_over_gtsam", float(np.median(update) / np.median(bare_cpu)), n=n)


def _maps(seconds: float) -> Iterator[Row]:
    """Updates with larger maps, of which as much is in view."""
    worlds = [World(markers=n) for n in (4, 60, 5000)]
    runs = [Chain(world).updates(world.events(seconds)) for world in worlds]
    small, middle, large = np.array([[cpu for _, cpu in each] for each in zip(*runs, strict=True)]).T
    for name, a, b in (("map60.over_map4", middle, small), ("map5000.over_map60", large, middle)):
        yield Row(name, float(np.median(a) / np.median(b)), n=len(a))


class _Mirror:
    """A bare smoother that is given what ours is given, at another time."""

    def __init__(self, *arguments: Any) -> None:
        config = arguments[0]
        self._smoother = gtsam.IncrementalFixedLagSmoother(config.lag_s, isam2_params(*arguments))
        self.pending: list[tuple[gtsam.NonlinearFactorGraph, gtsam.Values, dict[int, float], list[int]]] = []

    def follow(self, k: int) -> tuple[float, float] | None:
        """Take what is pending; wall and processor seconds of a step that was one update, with pose and covariance."""
        pending, self.pending = self.pending, []
        start, cpu_start = time.perf_counter(), time.thread_time()
        for update in pending:
            self._smoother.update(*update)
        if not pending:
            return None
        self._smoother.calculateEstimatePose2(pose_key(k))
        self._smoother.marginalCovariance(pose_key(k))
        return (time.perf_counter() - start, time.thread_time() - cpu_start) if len(pending) == 1 else None


@contextmanager
def _mirrored() -> Iterator[list[_Mirror]]:
    """A mirror of each smoother that is made meanwhile."""
    mirrors: list[_Mirror] = []

    class Watched(gtsam.IncrementalFixedLagSmoother):  # type: ignore[misc]
        def update(self, *update: Any) -> Any:
            graph, values, stamps, *slots = update
            mirrors[-1].pending.append((graph, values, dict(stamps), slots[0] if slots else []))
            return super().update(*update)

    class Backend(FixedLag):
        def __init__(self, *arguments: Any) -> None:
            mirrors.append(_Mirror(*arguments))
            super().__init__(*arguments)
            self._smoother = Watched(arguments[0].lag_s, isam2_params(*arguments))

    with patch("fgloc.graph.estimators.FixedLag", Backend):
        yield mirrors


def _long_run(minutes: int) -> Iterator[Row]:
    """An hour of updates: the tail, the growth of time and of memory."""
    chain = Chain(World())
    times, n, memory_kb = np.ones((2000 * minutes, 2)), 0, {}  # memory of its own, taken from the start
    for wall_and_cpu in chain.updates(World().events(60.0 * minutes)):
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
    yield Row("online.update_p99_over_median", float(np.percentile(cpu, 99) / np.median(cpu)), n=n)
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
