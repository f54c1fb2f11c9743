"""Results: decisions, estimates, trajectories, and all of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fgloc import se2
from fgloc.errors import TrajectoryError
from fgloc.types.arrays import FloatArray, IntArray
from fgloc.types.findings import Finding, Severity
from fgloc.types.maps import Camera, LandmarkMap

if TYPE_CHECKING:
    from fgloc.config import Config


class Mode(StrEnum):
    """How the estimate came about."""

    OK = "OK"
    UNCONFIRMED = "UNCONFIRMED"  # by sightings that nothing checks yet: before the first pose is certain
    DEAD_RECKONING = "DEAD_RECKONING"
    LOST = "LOST"


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What became of one measurement, or of the pose: a row of ``steps.csv``."""

    step: int
    stamp_ns: int
    kind: str  # a sensor by its name, "place", "mode" or "clock"
    landmark_id: int  # -1 for motion
    residual: float  # norm of the whitened residual against the prediction
    nis: float
    dof: int
    weight: float  # 1 as given, less if inflated, 0 if rejected
    reason: str  # "" if used as given
    threshold: float = math.nan  # that the NIS is held against; NaN: none
    shift_m: float = (
        math.nan
    )  # of a motion: how much further forward than its reference; of a place: from the estimated pose


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What makes a planar pose one in space, where the ground is uneven.

    The base's rotation is ``Rz(yaw) Ry(pitch) Rx(roll)``.
    """

    z: float  # m
    roll: float  # rad
    pitch: float  # rad, positive where the nose is down
    cov: FloatArray  # (6, 6) of x, y, z, roll, pitch, yaw in the map frame, as in ROS

    def with_planar(self, cov: FloatArray) -> Ground:
        """With another covariance ``(3, 3)`` of x, y and yaw, which are then not correlated with the others."""
        whole = self.cov.copy()
        whole[PLANAR, :] = whole[:, PLANAR] = 0.0
        whole[np.ix_(PLANAR, PLANAR)] = cov
        return replace(self, cov=whole)


PLANAR = (0, 1, 5)
"""Rows of x, y and yaw in a covariance of x, y, z, roll, pitch, yaw."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """``T_map_base`` at one keyframe. ``cov`` is in the map frame."""

    stamp_ns: int
    pose: FloatArray  # (3,)
    cov: FloatArray  # (3, 3)
    mode: Mode = Mode.OK
    decisions: tuple[Decision, ...] = ()
    ground: Ground | None = None  # None: the floor is flat


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses over time. ``covs`` is in the map frame; None where unknown (a truth)."""

    stamps_ns: IntArray  # (n,) strictly increasing
    poses: FloatArray  # (n, 3)
    covs: FloatArray | None = None  # (n, 3, 3)
    ground: FloatArray | None = None  # (n, 3) height, roll and pitch; None: the floor is flat, or not known
    ground_covs: FloatArray | None = None  # (n, 6, 6) of x, y, z, roll, pitch, yaw in the map frame

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def ground_at(self, i: int) -> Ground | None:
        """What pose ``i`` has beside the planar one; None: the floor is flat."""
        if self.ground is None or self.ground_covs is None:
            return None
        z, roll, pitch = self.ground[i].tolist()
        return Ground(z, roll, pitch, self.ground_covs[i])

    def interpolate(self, stamp_ns: int | IntArray) -> FloatArray:
        """Poses between the known ones: linear in x and y, and in yaw the shorter way round.

        Args:
            stamp_ns: one time, or ``(m,)`` times, between the first and the last of ``stamps_ns``.

        Returns:
            ``(3,)`` for one time, else ``(m, 3)``.

        Raises:
            TrajectoryError: the trajectory is empty, or a time lies outside it.
        """
        if not len(self):
            raise TrajectoryError("the trajectory is empty: nothing to interpolate")
        asked = np.atleast_1d(np.asarray(stamp_ns, dtype=np.int64))
        first, last = int(self.stamps_ns[0]), int(self.stamps_ns[-1])
        outside = asked[(asked < first) | (asked > last)]
        if outside.size:
            raise TrajectoryError(
                f"stamp {outside[0]} ns lies outside the trajectory; expected {first} to {last} ns. fgloc.Live "
                "extrapolates beyond the last pose"
            )
        poses = se2.interpolate(self.stamps_ns, self.poses, asked)
        return poses[0] if np.ndim(stamp_ns) == 0 else poses


@dataclass(frozen=True, slots=True, eq=False)
class TopicTimes:
    """When a topic had messages.

    ``times`` are in seconds from the first estimate; of very many only one in ``every`` is kept.
    """

    times: FloatArray  # (n,)
    count: int
    every: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class Setting:
    """A value of the installation, as it was given and as a run found it; in the units of ``robot.yaml``."""

    name: str
    given: float
    found: float
    sigma: float  # of what was found
    prior_sigma: float  # of what was given

    @property
    def off(self) -> float:
        """How far what was given and what the measurements alone give are apart, in sigmas of both.

        What was found lies between the two, by their sigmas; its expected square distance from the given value is the
        difference of the variances.
        """
        spread = self.prior_sigma**2 - self.sigma**2
        return (self.found - self.given) / math.sqrt(max(spread, 1e-6 * self.prior_sigma**2, 1e-30))

    @property
    def unpulled(self) -> float:
        """The change that the measurements alone ask for, without the pull of the prior."""
        share = 1.0 - (self.sigma / self.prior_sigma) ** 2 if self.prior_sigma > 0.0 else 1.0
        return (self.found - self.given) / max(share, 0.05)


@dataclass(frozen=True, slots=True, eq=False)
class InstallationFound:
    """The whole installation state of a run ``(n,)``, with the prior that it began from."""

    names: tuple[str, ...]
    mean: FloatArray  # (n,)
    cov: FloatArray  # (n, n)
    prior_cov: FloatArray  # (n, n)
    camera: Camera | None  # of corners, as the run used it
    seen_by: str  # role whose stamps the sightings have
    wheels: str  # role whose stamps the wheels have: "joints", "odometry", "command"; "" if they had no messages
    settings: tuple[Setting, ...] = ()  # all but the map's
    landmarks: LandmarkMap | None = None  # of a known map, where they were found


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """A whole run, ready to be evaluated and written."""

    trajectory: Trajectory
    modes: tuple[Mode, ...]  # one per pose
    decisions: tuple[Decision, ...]
    counts: Mapping[str, int]  # factors held, by kind
    rejections: Mapping[str, int]  # items rejected, by reason
    findings: tuple[Finding, ...]  # what is wrong and worth knowing, the gravest first
    step_ms: FloatArray  # (n,) wall time of each update
    wall_s: float
    truth: Trajectory | None = None
    landmarks: LandmarkMap | None = None  # the map that was given, or that was estimated
    spans: Mapping[str, TopicTimes] = field(default_factory=dict)  # by topic
    source: Path | None = None
    found: InstallationFound | None = None
    installation: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # found: value and sigma by name
    cost: float | None = None  # of the batch: half the sum of squared residuals, refused sightings as the gate's bound
    first_pose_s: float | None = None  # from the first step until a pose was known, as the run went
    config: Config | None = None  # as the run used it: with the mistakes undone
    odometry: Trajectory | None = None  # odometry alone, beside the run; None: nothing measured the motion

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences of all findings, the gravest first."""
        return tuple(finding.text for finding in self.findings)

    @property
    def mistakes(self) -> tuple[str, ...]:
        """Sentences of the findings because of which the poses are not to be trusted."""
        return tuple(finding.text for finding in self.findings if finding.severity is Severity.ERROR)

    def write(self, folder: Path) -> None:
        """Write all files of the run, as ``fgloc smooth`` and ``fgloc online`` do; see ``docs/formats.md``.

        Args:
            folder: made if missing; an error leaves what was there as it was.

        Raises:
            OutputError: the folder cannot be written.
            TrajectoryError: a pose is not finite.
            CovarianceError: a covariance is not positive definite.
        """
        from fgloc.config import Config
        from fgloc.evaluation.report import write_results

        write_results(self, self.config or Config(), folder, "fgloc.RunResult.write")
