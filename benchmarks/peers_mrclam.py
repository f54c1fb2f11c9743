"""MRCLAM 6 for `benchmarks.peers`: five real robots among beacons, each with the constants of the other four.

All begin at the true pose, take the same steps and the constants of ``robot.yaml`` (gains and delay of the commands,
scale of the camera's ranges, offset of its bearings).

- ``fgloc``: online, with the motion model of the other four robots.
- ``beacons``: iSAM2 as a good engineer writes it in an afternoon: commands integrated at constant noise, ranges and
  bearings with a Cauchy kernel, landmarks held by tight priors. Its constants are the best of 13 sets on robots
  1 and 2 (least geometric mean of the ATE), which are among the five.
- ``wheels``: the commands alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from benchmarks.recordings import converted
from fgloc import se2
from fgloc.ablation.jobs import start_at_truth
from fgloc.config import Config
from fgloc.runner import run
from fgloc.sensors.maps import load_map
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.motion import WheelMotion
from fgloc.types import Estimate, FloatArray, LandmarkMap, Step, Trajectory

_START = np.array([0.1, 0.1, 0.1])  # m, m, rad
_HELD_M = 1e-3  # of a landmark
_LANDMARKS = 1_000_000_000  # keys of landmarks are above those of poses


@dataclass(frozen=True, slots=True)
class Constants:
    """Sigmas: of motion over a second, growing with the root of time, and of a sighting."""

    motion_m: float = 0.02
    motion_rad: float = 0.05
    range_m: float = 0.1
    bearing_rad: float = 0.03
    cauchy: float = 1.0  # in sigmas


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """A robot's run: what fgloc made of it, and the steps that the others take."""

    config: Config
    landmarks: LandmarkMap
    steps: list[Step]
    estimates: list[Estimate]
    truth: Trajectory


def replay(robot: int) -> Replay:
    """Fgloc online on one robot's recording, begun at the true pose."""
    steps: list[Step] = []
    estimates: list[Estimate] = []

    def note(step: Step, estimate: Estimate | None) -> None:
        steps.append(step)
        estimates.extend([] if estimate is None else [estimate])

    with tempfile.TemporaryDirectory() as scratch:
        bag, map_yaml, config = converted(robot, Path(scratch))
        config = start_at_truth(bag, config)
        truth = run(bag, map_yaml, config, "online", on_step=note).truth
        landmarks = load_map(map_yaml)
    assert truth is not None
    return Replay(config, landmarks, steps, estimates, truth)


class Beacons:
    """The plain pipeline, fed with steps."""

    def __init__(self, replayed: Replay, constants: Constants | None = None) -> None:
        """Take what the installer believes."""
        self._constants = c = constants or Constants()
        self._config, self._landmarks = replayed.config, replayed.landmarks.landmarks
        self._commands = WheelMotion(replayed.config.wheels)
        kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(c.cauchy)
        sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.array([c.bearing_rad, c.range_m]))
        self._sighting_noise = gtsam.noiseModel.Robust.Create(kernel, sigmas)
        self._isam = gtsam.ISAM2(gtsam.ISAM2Params())
        self._held: set[int] = set()
        self._k = 0
        self._pose: FloatArray | None = None

    def run(self, steps: Iterable[Step], truth: Trajectory) -> list[Estimate]:
        """All poses, from the first one that is known in truth on."""
        out = []
        for step in steps:
            if self._pose is not None:
                out.append(self._update(step))
            elif truth.stamps_ns[0] <= step.stamp_ns <= truth.stamps_ns[-1]:
                self._pose = truth.interpolate(step.stamp_ns)
                prior = gtsam.noiseModel.Diagonal.Sigmas(_START)
                out.append(self._solve(step, [gtsam.PriorFactorPose2(0, gtsam.Pose2(*self._pose), prior)], self._pose))
        return out

    def _update(self, step: Step) -> Estimate:
        measured, c, root_s = self._commands.measure(step), self._constants, step.dt**0.5
        motion = np.zeros(3) if measured is None else measured.motion
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([c.motion_m, c.motion_m, c.motion_rad]) * root_s)
        self._k += 1
        assert self._pose is not None
        between = gtsam.BetweenFactorPose2(self._k - 1, self._k, gtsam.Pose2(*motion), noise)
        return self._solve(step, [between], se2.compose(self._pose, motion))

    def _solve(self, step: Step, factors: list[gtsam.NonlinearFactor], initial: FloatArray) -> Estimate:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(self._k, gtsam.Pose2(*initial))
        for event in step.sightings:
            for seen in event.sightings if isinstance(event, RangeBearingEvent) else ():
                if seen.landmark_id in self._landmarks:
                    factors.append(self._sighting(seen))
                    self._hold(seen.landmark_id, factors, values)
        for factor in factors:
            graph.add(factor)
        self._isam.update(graph, values)
        pose = self._isam.calculateEstimatePose2(self._k)
        self._pose = np.array([pose.x(), pose.y(), pose.theta()])
        cov = np.asarray(self._isam.marginalCovariance(self._k))
        return Estimate(step.stamp_ns, self._pose, se2.rotate_cov(cov, pose.theta()))

    def _sighting(self, seen: RangeBearing) -> gtsam.NonlinearFactor:
        section, mounting = self._config.landmarks, self._config.recording.sightings_pose
        assert mounting is not None
        depth, bearing = section.range_scale * seen.range_m, seen.bearing_rad - section.bearing_bias_rad
        x, y = depth + mounting[0], depth * np.tan(bearing)  # depth is along the axis
        key, direction = _LANDMARKS + seen.landmark_id, gtsam.Rot2(float(np.arctan2(y, x)))
        return gtsam.BearingRangeFactor2D(self._k, key, direction, float(np.hypot(x, y)), self._sighting_noise)

    def _hold(self, landmark_id: int, factors: list[gtsam.NonlinearFactor], values: gtsam.Values) -> None:
        if landmark_id not in self._held:
            self._held.add(landmark_id)
            place, key = self._landmarks[landmark_id].position[:2], _LANDMARKS + landmark_id
            factors.append(gtsam.PriorFactorPoint2(key, place, gtsam.noiseModel.Isotropic.Sigma(2, _HELD_M)))
            values.insert(key, place)
