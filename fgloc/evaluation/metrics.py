"""How far an estimated trajectory is from the truth, and whether its covariance is right.

Errors live in the map frame. Where the truth's frame is another one (``truth.align: se2``), the truth is moved into the
map by the rigid motion that fits the positions best; the estimate and its covariance stay as they are. The NEES then
takes the frame that fits best by the covariances (`in_own_gauge`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict

from fgloc import se2
from fgloc.config import Config
from fgloc.evaluation.consistency import coverage, nees
from fgloc.evaluation.judgements import Judgement, judgements
from fgloc.evaluation.matching import FEWEST, Matched, in_own_gauge, match, matchable
from fgloc.evaluation.warnings import all_findings
from fgloc.types import Finding, FloatArray, RunResult

_Figure = TypeVar("_Figure")
_LEG_M = 0.02  # shorter moves of the truth are its noise, not distance travelled


class StepTimes(BaseModel):
    """Wall time of one update [ms]."""

    model_config = ConfigDict(frozen=True)

    median: float
    p95: float
    p99: float
    max: float


class FoundSetting(BaseModel):
    """A value of the installation as given and as found, in the units of the configuration."""

    model_config = ConfigDict(frozen=True)

    given: float
    prior_sigma: float
    found: float
    sigma: float


class FoundFinding(BaseModel):
    """A finding, as `fgloc.types.Finding` has it; ``severity`` is "error", "warning" or "note"."""

    model_config = ConfigDict(frozen=True)

    code: str
    severity: str
    text: str
    lines: dict[str, str]
    value: float | None
    sigma: float | None

    @classmethod
    def of(cls, finding: Finding) -> FoundFinding:
        """The finding as it is written; a figure that is not finite is left out."""
        value, sigma = (v if v is not None and math.isfinite(v) else None for v in (finding.value, finding.sigma))
        severity, lines = finding.severity.name.lower(), dict(finding.lines)
        return cls(code=finding.code, severity=severity, text=finding.text, lines=lines, value=value, sigma=sigma)


class GroundMetrics(BaseModel):
    """Of the pose in space, on uneven ground; root mean squares."""

    model_config = ConfigDict(frozen=True)

    ate_rmse_m: float  # distance in space
    height_rmse_m: float
    roll_rmse_deg: float
    pitch_rmse_deg: float
    nees_over_6: float  # of x, y, z, roll, pitch and yaw


class OdometryMetrics(BaseModel):
    """Odometry alone against the truth, moved onto it by the rigid motion that fits best: it has no frame."""

    model_config = ConfigDict(frozen=True)

    ate_rmse_m: float
    ate_over_odometry: float | None  # of the run's `ate_rmse_m`; None: odometry alone is without error


class Metrics(BaseModel):
    """What ``metrics.json`` holds. Keys that need a truth are None without one."""

    model_config = ConfigDict(frozen=True)

    duration_s: float
    keyframes: int
    first_pose_s: float | None  # None: the place on the map was never known
    ate_mean_m: float | None
    ate_rmse_m: float | None
    yaw_mae_deg: float | None
    end_error_m: float | None
    drift_percent: float | None
    nees_over_3: float | None
    coverage: dict[str, float] | None  # by number of sigmas: "1", "2", "3"
    ground: GroundMetrics | None  # None: estimated on a flat floor, or no truth
    odometry: OdometryMetrics | None  # None: no truth, or nothing measured the motion
    real_time_factor: float | None  # seconds of recording per second of work
    step_ms: StepTimes | None
    factors: dict[str, int]
    rejections: dict[str, int]
    installation: dict[str, FoundSetting]  # by setting
    findings: tuple[FoundFinding, ...]  # what is wrong and worth knowing, the gravest first
    judgements: tuple[Judgement, ...]  # what was judged to be wrong, when, and by which evidence


def _installation(result: RunResult) -> dict[str, FoundSetting]:
    settings = () if result.found is None else result.found.settings
    return {
        s.name: FoundSetting(given=s.given, prior_sigma=s.prior_sigma, found=s.found, sigma=s.sigma) for s in settings
    }


def ate_mean_m(matched: Matched) -> float:
    """Mean distance from the truth [m]. Source: the paper, eq. 11, over the matched stamps."""
    return float(np.mean(matched.distances))


def ate_rmse_m(matched: Matched) -> float:
    """Root mean square distance from the truth [m]: evo's APE of the translation."""
    return float(np.sqrt(np.mean(matched.distances**2)))


def yaw_mae_deg(matched: Matched) -> float:
    """Mean absolute yaw error [°], wrapped. Source: the paper, eq. 12."""
    return float(np.degrees(np.mean(np.abs(matched.errors[:, 2]))))


def end_error_m(matched: Matched) -> float:
    """Distance from the truth [m] at the last matched stamp."""
    return float(matched.distances[-1])


def path_length_m(positions: FloatArray) -> float:
    """Length [m] of the path ``(n, 2)``, leaving out moves shorter than the truth's own noise."""
    total, anchor = 0.0, positions[0]
    for position in positions[1:]:
        leg = math.hypot(position[0] - anchor[0], position[1] - anchor[1])
        if leg >= _LEG_M:
            total, anchor = total + leg, position
    return total


def drift_percent(matched: Matched) -> float | None:
    """End error over the distance travelled [%]; None for a robot that stood still."""
    travelled = path_length_m(matched.truth[:, :2])
    return 100.0 * end_error_m(matched) / travelled if travelled > 0 else None


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Relative pose error over pairs that are `delta` apart: root mean squares and the number of pairs."""

    translation_m: float
    rotation_deg: float
    pairs: int


def relative_error(matched: Matched, delta: float, unit: Literal["frames", "m"]) -> RelativeError | None:
    """Error of the motion between poses that are `delta` frames, or metres of the estimate's path, apart.

    Equals evo's RPE with consecutive pairs; None if no two poses are that far apart. Source: Sturm et al., "A benchmark
    for the evaluation of RGB-D SLAM systems", 2012, section V.
    """
    ends = _frame_ends(len(matched.estimate), delta) if unit == "frames" else _path_ends(matched.estimate, delta)
    if len(ends) < 2:
        return None
    errors = []
    for i, j in pairwise(ends):
        moved = se2.between(matched.estimate[i], matched.estimate[j])
        errors.append(se2.between(se2.between(matched.truth[i], matched.truth[j]), moved))
    translation, rotation = np.hypot(*np.array(errors)[:, :2].T), np.array(errors)[:, 2]
    return RelativeError(_rms(translation), math.degrees(_rms(rotation)), len(errors))


def compute_metrics(result: RunResult, config: Config) -> Metrics:
    """Everything that ``metrics.json`` holds.

    Raises:
        CovarianceError: a covariance of the estimate is not positive definite.
    """
    matched = match_result(result, config)
    stamps = result.trajectory.stamps_ns
    duration = float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) else 0.0

    def against_truth(figure: Callable[[Matched], _Figure | None]) -> _Figure | None:
        return None if matched is None else figure(matched)

    honest: tuple[float | None, dict[str, float] | None] = (None, None)
    if matched is not None and matched.covs is not None:
        fitted = config.truth.align == "se2"
        errors, covs = in_own_gauge(matched) if fitted else (matched.errors, matched.covs)
        honest = (float(np.mean(nees(errors, covs))) / 3.0, {str(k): coverage(errors, covs, k) for k in (1, 2, 3)})
    return Metrics(
        duration_s=duration,
        keyframes=len(stamps),
        first_pose_s=result.first_pose_s,
        ate_mean_m=against_truth(ate_mean_m),
        ate_rmse_m=against_truth(ate_rmse_m),
        yaw_mae_deg=against_truth(yaw_mae_deg),
        end_error_m=against_truth(end_error_m),
        drift_percent=against_truth(drift_percent),
        nees_over_3=honest[0],
        coverage=honest[1],
        ground=against_truth(ground_metrics),
        odometry=None if matched is None else odometry_metrics(result, config, ate_rmse_m(matched)),
        real_time_factor=duration / result.wall_s if result.wall_s > 0 else None,
        step_ms=_step_times(result.step_ms),
        factors=dict(sorted(result.counts.items())),
        rejections=dict(sorted(result.rejections.items())),
        installation=_installation(result),
        findings=tuple(
            map(FoundFinding.of, all_findings(result, honest[0], dict(sorted(result.rejections.items())), len(stamps)))
        ),
        judgements=judgements(result),
    )


def ground_metrics(matched: Matched) -> GroundMetrics | None:
    """Of the pose in space; None: it was not estimated."""
    errors, covs = matched.spatial_errors, matched.ground_covs
    if errors is None or covs is None:
        return None
    return GroundMetrics(
        ate_rmse_m=_rms(np.linalg.norm(errors[:, :3], axis=1)),
        height_rmse_m=_rms(errors[:, 2]),
        roll_rmse_deg=math.degrees(_rms(errors[:, 3])),
        pitch_rmse_deg=math.degrees(_rms(errors[:, 4])),
        nees_over_6=float(np.mean(nees(errors, covs))) / 6.0,
    )


def odometry_metrics(result: RunResult, config: Config, ate_m: float) -> OdometryMetrics | None:
    """Figures of odometry alone, beside the run's own error [m]; None: there is none at the truth's times."""
    truth, odometry = result.truth, result.odometry
    if truth is None or odometry is None or len(matchable(odometry, truth, config.truth.max_gap_s)) < FEWEST:
        return None
    alone = ate_rmse_m(match(odometry, truth, "se2", config.truth.max_gap_s))
    return OdometryMetrics(ate_rmse_m=alone, ate_over_odometry=ate_m / alone if alone > 0.0 else None)


def match_result(result: RunResult, config: Config) -> Matched | None:
    """`match` of a run with its truth; None if there is no truth or it has no pose at the run's time."""
    truth = result.truth
    if truth is None or len(truth) == 0 or len(matchable(result.trajectory, truth, config.truth.max_gap_s)) < FEWEST:
        return None
    return match(result.trajectory, truth, config.truth.align, config.truth.max_gap_s)


def _frame_ends(count: int, delta: float) -> list[int]:
    return list(range(0, count, max(1, round(delta))))


def _path_ends(poses: FloatArray, delta: float) -> list[int]:
    ends, travelled = [0], 0.0
    for i, step in enumerate(np.hypot(*np.diff(poses[:, :2], axis=0).T), start=1):
        travelled += float(step)
        if travelled >= delta:
            ends.append(i)
            travelled = 0.0
    return ends


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _step_times(step_ms: FloatArray) -> StepTimes | None:
    if step_ms.size == 0:
        return None
    median, p95, p99 = np.percentile(step_ms, [50, 95, 99]).tolist()
    return StepTimes(median=median, p95=p95, p99=p99, max=float(step_ms.max()))
