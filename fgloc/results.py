"""Data of a whole run: evaluation, displays and exports are computed from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from fgloc.config import Config
from fgloc.types import (
    Decision,
    Finding,
    FloatArray,
    InstallationFound,
    LandmarkMap,
    Mode,
    Protection,
    Severity,
    TopicTimes,
    Trajectory,
)


@dataclass(frozen=True, slots=True, eq=False)
class RunData:
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
    protections: tuple[Protection, ...] = ()  # of each pose, online; empty: smoothed
    odometry: Trajectory | None = None  # odometry alone, beside the run; None: nothing measured the motion

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences of all findings, the gravest first."""
        return tuple(finding.text for finding in self.findings)

    @property
    def mistakes(self) -> tuple[str, ...]:
        """Sentences of the findings because of which the poses are not to be trusted."""
        return tuple(finding.text for finding in self.findings if finding.severity is Severity.ERROR)
