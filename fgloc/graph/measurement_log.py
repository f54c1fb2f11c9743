"""The measurement log: what entered each keyframe. Graphs are built from it, never copied from one another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.noise import NoiseBudget
from fgloc.sensors.measurements import LandmarkMeasurement
from fgloc.types import FloatArray, Mode, MotionMeasurement, MotionReadings, Step


@dataclass(slots=True, eq=False)
class PoseWithCovariance:
    """A pose ``(3,)`` with the covariance ``(3, 3)`` of its right perturbation (the body frame).

    With the installation at that time, and the covariance ``(3, n)`` of the two; None: nothing connects them.
    """

    pose: FloatArray
    cov: FloatArray
    cross: FloatArray | None = None
    installation: InstallationEstimate | None = None

    @classmethod
    def jointly(cls, pose: FloatArray, mean: FloatArray, P: FloatArray) -> PoseWithCovariance:
        """A pose with an installation of this mean ``(n,)``, and the covariance ``(3 + n, 3 + n)`` of both."""
        return cls(pose, P[:3, :3], P[:3, 3:], InstallationEstimate(mean, P[3:, 3:]))

    def joint_cov(self, known: InstallationEstimate) -> FloatArray:
        """Covariance ``(3 + n, 3 + n)`` of the pose and an installation: its own, or what is known of it beside."""
        n = len(known.mean)
        P = np.zeros((3 + n, 3 + n))
        P[:3, :3], P[3:, 3:] = self.cov, known.cov
        if self.cross is not None:
            P[:3, 3:], P[3:, :3] = self.cross, self.cross.T
        return P


@dataclass(frozen=True, slots=True, eq=False)
class LoggedSighting:
    """A landmark measurement as the graph takes it: motion-compensated to its keyframe, with kernel and factor.

    A factor is immutable and may be held by any number of graphs. On a known map there is none: the sightings of a
    keyframe become one factor together (`fgloc.graph.factors.sighting_factors`).
    """

    measurement: LandmarkMeasurement
    alone: LandmarkMeasurement  # before sightings near in time shared their information
    cauchy_k: float | None
    factor: gtsam.NonlinearFactor | None = None  # of a landmark that is a variable


@dataclass(slots=True, eq=False)
class Keyframe:
    """One pose of the graph and every measurement that ends at it."""

    k: int
    stamp_ns: int
    elapsed_s: float  # the estimator's own time: runs on through clock jumps
    belief: PoseWithCovariance  # filtered; factors are linear about it, and a rebuilt window or the batch start there
    prior: PoseWithCovariance | None = None  # first keyframe of a segment
    motions: tuple[MotionMeasurement, ...] = ()
    sightings: tuple[LoggedSighting, ...] = ()
    rejected: tuple[LoggedSighting, ...] = ()  # rejected online; for the cost of the batch
    step: Step | None = None  # its events, to be measured again
    mode: Mode = Mode.OK
    readings: MotionReadings = field(default_factory=MotionReadings)  # what the motions were made of ...
    budget: NoiseBudget = field(default_factory=NoiseBudget)  # ... and with which noise
    added_cov: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))  # to that of the pose when it is reported
    carried_cov: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))  # likewise, unless a later fix agrees
    ground_clock_cov: FloatArray | None = None  # (6, 6) as `added_cov`, of x, y, z, roll, pitch, yaw
    ground: FloatArray | None = None  # (3,) height, roll and pitch, as of the belief; on uneven ground


@dataclass(frozen=True, slots=True, eq=False)
class Remounting:
    """Change of a sensor's mounting in the run.

    Attributes:
        kind: of its sightings.
        stamp_ns: of the first sightings since then.
        before: mean ``(k,)`` of the constants of the mounting until then (`Installation.mounting`).
    """

    kind: str
    stamp_ns: int
    before: FloatArray


@dataclass(slots=True)
class MeasurementLog:
    """Keyframes in order. ``window_s`` bounds it, unless ``keep_all`` (batch).

    Older keyframes that are kept lose their installation estimate: it is large, and needed in the window only.
    """

    window_s: float
    keep_all: bool = False
    _whole: int = 0  # the first keyframe that still has all
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    remounted: list[Remounting] = field(default_factory=list)

    def append(self, keyframe: Keyframe) -> None:
        """Add the newest keyframe; forget those that the window has left behind."""
        self.keyframes[keyframe.k] = keyframe
        horizon = keyframe.elapsed_s - self.window_s
        if self.keep_all:
            while self._whole < keyframe.k and self.keyframes[self._whole].elapsed_s < horizon:
                old = self.keyframes[self._whole]
                old.belief = PoseWithCovariance(old.belief.pose, old.belief.cov)
                self._whole += 1
            return
        while self.keyframes:
            oldest = next(iter(self.keyframes))
            if self.keyframes[oldest].elapsed_s >= horizon:
                break
            del self.keyframes[oldest]

    def added_covs(self) -> list[FloatArray]:
        """Covariances ``(3, 3)`` to add to the smoothed poses; that a robot was carried is not once a fix agrees."""
        added, agreed = [], False
        for frame in reversed(self.keyframes.values()):
            agreed = agreed or bool(frame.sightings)
            added.append(frame.added_cov if agreed else frame.added_cov + frame.carried_cov)
            agreed = agreed and frame.prior is None
        return added[::-1]

    def since(self, elapsed_s: float) -> Iterator[Keyframe]:
        """Keyframes not older than the given time of the estimator's own clock."""
        return (frame for frame in self.keyframes.values() if frame.elapsed_s >= elapsed_s)

    def __len__(self) -> int:
        return len(self.keyframes)
