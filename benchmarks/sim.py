"""The simulator: physics against theory, camera against projection, speed, bags against what was written."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

from benchmarks.common import Row, main, not_run
from fgloc.config import MarkersConfig
from fgloc.frames import quaternion_matrix
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.types import FloatArray
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.sim.camera import RenderError, frames, pose_at
from fgloc_datasets.sim.physics import (
    Log,
    Scene,
    base_twist,
    center_of_mass,
    make_scene,
    simulate,
    slipping,
    wheel_twist,
)
from fgloc_datasets.sim.record import BUNDLED, jobs, load_suite, record, record_suite
from fgloc_datasets.sim.scenario import Camera, Control, Floor, Robot, Scenario, World
from fgloc_datasets.sim.scene import camera_rotation, intrinsics
from fgloc_datasets.sim.sensors import streams

_HALL = World(size_m=(30.0, 30.0))
_NEAR_M = 3.0
_CAMERA_IDS = ("camera.corner_bias_px", "camera.corner_rms_px", "speed.camera_rtf")


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    seeds = range(1 if quick else 6)
    yield _agreement("physics.straight_error", "straight", seeds)
    yield _agreement("physics.spin_error", "spin", seeds)
    yield _coulomb(quick)
    yield _slip_contrast(quick)
    os.environ["LP_NUM_THREADS"] = "1"  # Mesa's: one core
    try:
        yield from _corners(range(1 if quick else 5))
        yield _speed("speed.camera_rtf", 5.0 if quick else 30.0, 1 if quick else 3, camera=True)
    except RenderError as error:
        yield from not_run(_CAMERA_IDS, str(error))
    yield _speed("speed.physics_rtf", 10.0 if quick else 60.0, 1 if quick else 3, camera=False)
    yield _suite(quick)
    yield _round_trip(2.0 if quick else 10.0)


def _agreement(row_id: str, function: Any, seeds: range) -> Row:
    """Relative difference of the true and the wheels' path or angle at constant speed; the seeds draw the speed."""
    errors = []
    for seed in seeds:
        control = Control(functions=(function,), segment_s=30.0)
        scenario = Scenario(name="grippy", duration_s=8.0, camera=None, world=_HALL, control=control)
        log = simulate(make_scene(scenario, seed))
        steady = log.stamps_s > 3.0
        axis = 0 if function == "straight" else 2
        true = base_twist(log)[steady, axis].mean()
        errors.append(abs(true / wheel_twist(log, scenario.robot)[steady, axis // 2].mean() - 1.0))
    return Row(row_id, max(errors), float(np.std(errors)), len(errors))


def _coulomb(quick: bool) -> Row:
    """Acceleration with spinning wheels against Coulomb's law; the worst friction coefficient."""
    errors = []
    for mu in (0.05,) if quick else (0.02, 0.05, 0.1):
        robot = Robot(center_of_mass=(-0.02, 0.0, 0.045), max_acceleration=50.0)
        control = Control(functions=("straight",), segment_s=30.0)
        scenario = Scenario(
            name="ice", duration_s=4.0, camera=None, robot=robot, control=control,
            world=_HALL.model_copy(update={"floor": Floor(mu=mu)}),
        )  # fmt: skip
        scene = make_scene(scenario, 0)
        log = simulate(scene)
        v, wheel = base_twist(log)[:, 0], wheel_twist(log, robot)[:, 0]
        spinning = (wheel - v > 0.1) & (log.stamps_s > 1.3)
        first, last = np.flatnonzero(spinning)[[0, -1]]
        measured = (v[last] - v[first]) / (log.stamps_s[last] - log.stamps_s[first])
        errors.append(abs(measured / _coulomb_acceleration(scene, mu) - 1.0))
    return Row("physics.coulomb_error", max(errors), float(np.std(errors)), len(errors))


def _coulomb_acceleration(scene: Scene, mu: float) -> float:
    """Forward acceleration [m/s²] when both wheels spin and the caster slides behind them.

    With x and h the place of the center of mass behind the axle and above the floor, L the caster's distance, moments
    about the caster give the wheels' load N = m (g (L - x) - a h) / L, the caster's m g - N; m a is the difference of
    their frictions.
    """
    robot = scene.scenario.robot
    center = center_of_mass(scene)
    g, L, x, h = 9.81, robot.caster_behind_m, -center[0], center[2]
    caster = robot.contact.caster_friction
    return float(((mu + caster) * g * (L - x) / L - caster * g) / (1.0 + (mu + caster) * h / L))


def _slip_contrast(quick: bool) -> Row:
    """Ratio of the wheels' error where they slip in the simulator to that where they do not."""
    ratios = []
    for job in jobs(load_suite(BUNDLED), 20.0 if quick else None):
        if job.scenario.name == "patches" and (not quick or job.split == "test"):
            scene = make_scene(job.scenario, job.seed)
            log, robot = simulate(scene), scene.scenario.robot
            slips = slipping(log, robot)
            error = np.abs(base_twist(log)[:, 0] - wheel_twist(log, robot)[:, 0])
            ratios.append(error[slips].mean() / error[~slips].mean())
    return Row("physics.slip_contrast", float(np.mean(ratios)), float(np.std(ratios)), len(ratios))


def _corners(seeds: range) -> Iterator[Row]:
    """Detected corners minus projected truth, markers within 3 m of the camera, without motion blur."""
    biases, spreads, count = [], [], 0
    for seed in seeds:
        camera = Camera(motion_blur=False, rate_hz=5.0)
        scenario = Scenario(name="corners", duration_s=20.0, camera=camera)
        errors = corner_errors(scenario, seed)
        count += len(errors)
        biases.append(errors.mean(axis=0))
        spreads.append((errors**2).mean(axis=0))
    bias = np.abs(np.mean(biases, axis=0)).max()
    rms = np.sqrt(np.mean(spreads, axis=0)).max()
    yield Row("camera.corner_bias_px", float(bias), float(np.std(biases, axis=0).max()), count, "px")
    yield Row("camera.corner_rms_px", float(rms), float(np.sqrt(spreads).std(axis=0).max()), count, "px")


def corner_errors(scenario: Scenario, seed: int) -> FloatArray:
    """Corner errors ``(n, 2)`` [px] of all markers found within 3 m."""
    scene = make_scene(scenario, seed)
    log = simulate(scene)
    detector = MarkerDetector(scene.landmarks.dictionary, MarkersConfig())
    errors = []
    for frame in frames(scene, log):
        for marker_id, corners in detector.find(frame.image):
            expected, distance = _project(scene, log, frame.stamp_s, marker_id)
            if distance < _NEAR_M:
                errors.append(corners - expected)
    return np.concatenate(errors)


def _project(scene: Scene, log: Log, stamp_s: float, marker_id: int) -> tuple[FloatArray, float]:
    """Corners ``(4, 2)`` [px] of a marker by truth, and its distance [m]."""
    camera = scene.scenario.camera
    assert camera is not None
    position, quaternion = pose_at(log, stamp_s)
    R_map_base = quaternion_matrix(quaternion)
    corners = scene.landmarks.landmarks[marker_id].corners()
    in_cam = (corners - position - R_map_base @ camera.position) @ (R_map_base @ camera_rotation(camera))
    zero = np.zeros(3)
    pixels = cv2.projectPoints(in_cam, zero, zero, intrinsics(camera), np.array(camera.distortion))[0]
    return pixels.reshape(4, 2), float(np.linalg.norm(in_cam.mean(axis=0)))


def _speed(row_id: str, seconds: float, n: int, camera: bool) -> Row:
    """Simulated seconds per CPU second (of all threads) of a whole recording, written to disk."""
    scenario = Scenario(name="speed", duration_s=seconds)
    factors = []
    for seed in range(n):
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            record(scenario, seed, Path(folder) / "run", camera)
            factors.append(seconds / (time.process_time() - start))
    return Row(row_id, float(np.mean(factors)), float(np.std(factors)), n, "x")


def _suite(quick: bool) -> Row:
    """Wall time of the whole suite in two processes, without camera."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        count = record_suite(jobs(load_suite(BUNDLED), 1.0 if quick else None), Path(folder), camera=False, workers=2)
        return Row("speed.suite_minutes", (time.perf_counter() - start) / 60.0, None, count, "min")


class _Remembering(BagWriter):
    """Bag writer that also keeps the messages in memory."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, compress=True)
        self.written: list[tuple[str, int, Any]] = []

    def write(self, topic: str, message_type: str, message: Any, received_ns: int) -> None:
        self.written.append((topic, received_ns, message))
        super().write(topic, message_type, message, received_ns)


def _round_trip(seconds: float) -> Row:
    """Messages that are read back other than they were written, in content, time or order; with images if possible."""
    scene = make_scene(Scenario(name="round", duration_s=seconds), 1)
    log = simulate(scene)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with _Remembering(bag) as writer:
            messages: list[tuple[int, Callable[[], None]]] = []
            for stream in streams(scene, log, writer, camera=_can_render(scene)):
                messages += stream
            for _, write in sorted(messages, key=lambda m: m[0]):
                write()
        with AnyReader([bag]) as reader:
            read_back = [(c.topic, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
        written = writer.written
    wrong = abs(len(written) - len(read_back))
    for (topic, received, message), (topic_back, received_back, back) in zip(written, read_back, strict=False):
        wrong += not (topic == topic_back and received == received_back and _same(message, back))
    return Row("roundtrip.mismatches", float(wrong), None, len(written))


def _can_render(scene: Scene) -> bool:
    from fgloc_datasets.sim.camera import Renderer

    try:
        Renderer(scene).close()
    except RenderError:
        return False
    return True


def _same(a: Any, b: Any) -> bool:
    """Whether two messages are equal, bit for bit."""
    if is_dataclass(a):
        return all(_same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return bool(np.array_equal(a, b))
    if isinstance(a, list):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, float):
        return a == b or (math.isnan(a) and math.isnan(b))
    return bool(a == b)


if __name__ == "__main__":
    main(measure, __doc__ or "")
