"""How far an estimated trajectory is from the truth, and whether its covariance is right.

Errors live in the map frame. Where the truth's frame is another one (``truth.align: se2``), the truth is moved into the
map by the rigid motion that fits the positions best; the estimate and its covariance stay as they are. The NEES then
takes the frame that fits best by the covariances (`in_own_gauge`).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from fgloc import se2
from fgloc.calibration.installation import constants_found
from fgloc.config import Config, base_role, camera_role
from fgloc.diagnosis.pairs import MAD
from fgloc.diagnosis.truth import truth_sentence
from fgloc.errors import CovarianceError, TrajectoryError
from fgloc.evaluation.judgements import Figures, Judgement, episodes, judgements
from fgloc.results import RunData
from fgloc.types import Finding, FloatArray, IntArray, Mode, Severity, Trajectory, ordered

# --- Pairs of estimated and true poses at the same times --------------------------------------------------------------

FEWEST = 2  # matched poses; one cannot be aligned, and is no trajectory
_TRUTH = np.diag([0.005, 0.005, 0.01]) ** 2  # m², rad²: no positioning system, brought to other stamps, knows better
_ROUNDS = 10  # of Gauss-Newton; the problem is linear but for one angle


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """An estimate and a truth at the same stamps, both in the map frame."""

    stamps_ns: IntArray  # (n,)
    estimate: FloatArray  # (n, 3)
    truth: FloatArray  # (n, 3)
    covs: FloatArray | None  # (n, 3, 3) of the estimate
    T_map_truth: FloatArray  # (3,) how the truth was moved; zeros if it was not
    lever: FloatArray | None = None  # (n, 2) from the base to the point that a truth without yaw tracks; None: with yaw
    ground: FloatArray | None = None  # (n, 3) estimated height, roll and pitch; None: the floor is flat
    true_ground: FloatArray | None = None  # (n, 3); None: not known
    ground_covs: FloatArray | None = None  # (n, 6, 6) of x, y, z, roll, pitch, yaw

    @property
    def spatial_errors(self) -> FloatArray | None:
        """``(n, 6)`` estimate minus truth of x, y, z [m], roll, pitch and yaw; None where they were not estimated."""
        if self.ground is None or self.true_ground is None:
            return None
        planar, off = self.errors, self.ground - self.true_ground
        return np.column_stack([planar[:, :2], off[:, 0], se2.wrap_array(off[:, 1:]), planar[:, 2]])

    @property
    def has_yaw(self) -> bool:
        """Whether the truth has a yaw; else that here is the estimate's."""
        return self.lever is None

    @property
    def errors(self) -> FloatArray:
        """``(n, 3)`` estimate minus truth: x, y [m] and wrapped yaw [rad]."""
        difference = self.estimate - self.truth
        difference[:, 2] = se2.wrap_array(difference[:, 2])
        return difference

    @property
    def distances(self) -> FloatArray:
        """``(n,)`` distance from the truth [m]."""
        return np.asarray(np.hypot(*(self.estimate - self.truth)[:, :2].T))


def match(
    estimate: Trajectory,
    truth: Trajectory,
    align: Literal["none", "se2"] = "none",
    max_gap_s: float = 0.2,
    offset_m: tuple[float, float] = (0.0, 0.0),
) -> Matched:
    """Bring the truth to the estimate's stamps and, if asked, into its frame.

    Equal stamps match exactly; between two stamps of the truth no further apart than `max_gap_s` the truth is
    interpolated; elsewhere the estimate has no partner and is left out. A truth without a yaw is compared by positions
    alone, those of the point that it tracks.

    Args:
        estimate: poses of the base.
        truth: poses of the base, too; without a yaw positions of a point on the robot.
        align: how the truth is moved into the estimate's frame.
        max_gap_s: see above.
        offset_m: that point in the base frame, of a truth without a yaw.

    Raises:
        TrajectoryError: fewer than two poses have a partner, or the largest gap is negative or NaN.
    """
    indices = matchable(estimate, truth, max_gap_s)
    if len(indices) < FEWEST:
        raise TrajectoryError(
            f"{len(indices)} of {len(estimate)} poses have a truth at their time, expected {FEWEST} or more: the "
            f"estimate spans {_span(estimate)}, the truth {_span(truth)}, gaps over {max_gap_s} s are not bridged; "
            "check the clocks, or raise the largest gap"
        )
    stamps = estimate.stamps_ns[indices]
    poses = estimate.poses[indices]
    reference = se2.interpolate(truth.stamps_ns, truth.poses, stamps)
    T_map_truth = np.zeros(3)
    points = poses if truth.has_yaw else se2.compose_array(poses, np.tile((*offset_m, 0.0), (len(poses), 1)))
    if align == "se2":
        T_map_truth = se2.rigid(reference[:, :2], points[:, :2])
        reference = se2.compose_array(T_map_truth, reference)
    lever = None if truth.has_yaw else points[:, :2] - poses[:, :2]
    if lever is not None:
        reference = np.column_stack([reference[:, :2] - lever, poses[:, 2]])
    covs = None if estimate.covs is None else estimate.covs[indices]
    in_space = align == "none" and lever is None
    if not in_space or estimate.ground is None or estimate.ground_covs is None or truth.ground is None:
        return Matched(stamps, poses, reference, covs, T_map_truth, lever)
    true = np.column_stack([np.interp(stamps, truth.stamps_ns, column) for column in truth.ground.T])
    ground, spatial = estimate.ground[indices], estimate.ground_covs[indices]
    return Matched(stamps, poses, reference, covs, T_map_truth, ground=ground, true_ground=true, ground_covs=spatial)


def in_own_gauge(matched: Matched) -> tuple[FloatArray, FloatArray]:
    """Errors ``(n, d)`` and their covariances ``(n, d, d)`` where the truth's frame is fitted; see `compared`.

    Without a map the covariance is relative to the first pose, which is the origin, while a frame that is fitted to all
    positions alike spreads the drift over the whole path. So the frame is fitted by the covariances: weighted least
    squares over its rigid motion, the truth's own noise added.
    """
    assert matched.covs is not None
    errors, covs = compared(matched)
    d = errors.shape[1]
    covs = covs + _TRUTH[:d, :d]
    weights, truth, lever = np.linalg.inv(covs), matched.truth.copy(), matched.lever
    if lever is not None:  # it is the point that the frame moves
        truth[:, :2] += lever
    for _ in range(_ROUNDS):
        J = np.zeros((len(truth), d, 3))  # of the moved truth by x, y and yaw of the frame
        J[:] = np.eye(3)[:d]
        J[:, 0, 2], J[:, 1, 2] = -truth[:, 1], truth[:, 0]
        H, b = np.einsum("nij,nik,nkl->jl", J, weights, J), np.einsum("nij,nik,nk->j", J, weights, errors)
        step = np.linalg.lstsq(H, b, rcond=None)[0]
        truth = se2.compose_array(step, truth)
        errors = matched.estimate - truth
        errors[:, 2] = se2.wrap_array(errors[:, 2])
        errors = errors if lever is None else errors[:, :2] + lever
        if float(np.abs(step).max()) < 1e-9:
            break
    return errors, covs


def compared(matched: Matched) -> tuple[FloatArray, FloatArray]:
    """Errors ``(n, d)`` and their covariances ``(n, d, d)``; d is 3, or 2 where the truth has no yaw."""
    assert matched.covs is not None
    if matched.lever is None:
        return matched.errors, matched.covs
    J = np.tile(np.eye(2, 3), (len(matched.lever), 1, 1))  # of the point that is tracked
    J[:, 0, 2], J[:, 1, 2] = -matched.lever[:, 1], matched.lever[:, 0]
    return matched.errors[:, :2], J @ matched.covs @ J.transpose(0, 2, 1)


def matchable(estimate: Trajectory, truth: Trajectory, max_gap_s: float) -> IntArray:
    """Indices of the estimate's poses that have a truth at, or around, their stamp.

    Raises:
        TrajectoryError: the largest gap is negative or NaN.
    """
    if not max_gap_s >= 0.0:
        raise TrajectoryError(f"the largest gap of the truth is {max_gap_s} s, expected 0 or more")
    if len(estimate) == 0 or len(truth) == 0:
        return np.array([], dtype=np.int64)
    after = np.searchsorted(truth.stamps_ns, estimate.stamps_ns)
    inside = np.clip(after, 0, len(truth) - 1)
    exact = truth.stamps_ns[inside] == estimate.stamps_ns
    between = (after > 0) & (after < len(truth))
    gap_ns = truth.stamps_ns[inside] - truth.stamps_ns[np.maximum(inside - 1, 0)]
    return np.asarray(np.flatnonzero(exact | (between & (gap_ns <= round(min(max_gap_s, 1e9) * 1e9)))))


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "nothing"
    first, last = trajectory.stamps_ns[[0, -1]].tolist()
    return f"{first * 1e-9:.3f} to {last * 1e-9:.3f} s"


# --- Honesty of the covariance (Bar-Shalom, Li, Kirubarajan, "Estimation with Applications ...", 2001, section 5.4) ---


def nees(errors: FloatArray, covs: FloatArray) -> FloatArray:
    """Normalized estimation error squared ``(n,)``, ``eᵀ P⁻¹ e``; its mean is d for an honest covariance.

    Args:
        errors: ``(n, d)``.
        covs: ``(n, d, d)`` in the errors' frame.

    Raises:
        CovarianceError: a covariance is not positive definite.
    """
    try:
        whitening = np.linalg.cholesky(covs)
    except np.linalg.LinAlgError as error:
        bad = int(np.argmin(np.linalg.eigvalsh(covs)[:, 0]))
        raise CovarianceError(
            f"covariance {bad} is not positive definite: {covs[bad].tolist()}; it cannot weigh an error"
        ) from error
    whitened = np.linalg.solve(whitening, errors[..., None])[..., 0]
    return np.asarray(np.sum(whitened**2, axis=1))


def coverage(errors: FloatArray, covs: FloatArray, k: float) -> float:
    """Share of error components, over all times and axes, that lie inside ±k of their own standard deviation.

    An honest Gaussian covariance gives 0.683, 0.954, 0.997 for k = 1, 2, 3, whatever the correlation of the axes.
    """
    sigmas = np.sqrt(np.diagonal(covs, axis1=1, axis2=2))
    return float(np.mean(np.abs(errors) <= k * sigmas))


# --- Warnings that follow from the figures ----------------------------------------------------------------------------

_MOST_NEES = 3.0  # NEES/3: errors of √3 = 1.7 times what the covariance says; sound runs as installed stay below 2
_MOST_DROPPED = 0.2  # share of a sensor's messages
_FEWEST = 20  # dropped ones
_UNUSED = 0.9  # share of the steps without a model's prediction
_ORIGIN = 1e-3  # m and rad: no run on a map begins at its origin so exactly
_PRIOR = re.compile(r"(position|scale)_sigma")  # of a section's settings, the one that says most of its installation
_SETTINGS = {  # of a sensor whose messages are dropped
    "odometry": "expert.gate.max_speed, expert.gate.max_yaw_rate or recording.received_stamps",
    "joints": "recording.received_stamps",
    "command": "expert.gate.max_speed, expert.gate.max_yaw_rate",
    "imu": "expert.gate.max_yaw_rate or recording.received_stamps",
    "image": "camera.file, recording.topics.image",
}

_DOUBTFUL = ("truth.axes", "truth.frozen", "truth.jumps")  # findings by which a truth judges no covariance
_MOTION = ("odometry", "joints", "command")  # of which one is used


def all_findings(
    result: RunData,
    nees_over_3: float | None,
    rejections: Mapping[str, int],
    keyframes: int,
    size: Size | None = None,
    frame: Finding | None = None,
) -> tuple[Finding, ...]:
    """Findings of a run and the warnings by its figures, the gravest first.

    Args:
        result: the run.
        nees_over_3: mean normalised squared error over 3; None: there is no truth.
        rejections: rejected items by ``sensor.reason``.
        keyframes: number of poses.
        size: scale against the truth.
        frame: that the truth is in another frame or has other axes, which makes errors of what are none.
    """
    known = {finding.code for finding in result.findings}
    gross = size is not None and size.gross
    judged = [frame] if frame is not None else [] if gross else _optimistic(result, nees_over_3)
    misjudged = [finding for finding in judged if finding.code not in known]
    sized = [] if size is None or not size.told else [size.finding]
    dropped = [*_dropped(result, rejections, keyframes), *_unused(rejections, keyframes)]
    return ordered([*_timed(result), *sized, *misjudged, *dropped])


def _timed(result: RunData) -> list[Finding]:
    """Findings of the run; when the robot was lifted is as the run judged it, where it did."""
    found = list(result.findings)
    for k, finding in enumerate(found):
        if finding.code == "motion.lifted":
            lifts = [j for j in episodes(result.decisions, result.trajectory) if j.kind == "lifted"]
            if lifts:
                text = f"The robot was lifted or turned by hand, {', '.join(lift.when for lift in lifts)}."
                found[k] = replace(finding, text=text, value=lifts[0].from_s)
    return found


def _elsewhere(result: RunData, config: Config, matched: Matched) -> Finding | None:
    """Finding that the truth is not in the frame of the run: of its first pose, of anchors or positions, of a map.

    On a map a trajectory that a motion lays onto the truth is a right one, unless the robot was lost or hardly knew
    where it was.
    """
    at_origin = np.allclose(result.trajectory.poses[0], 0.0, atol=_ORIGIN)
    placed = result.landmarks is not None and not len(result.landmarks)  # by anchors or positions
    apart = float(np.median(np.hypot(*(matched.truth - matched.estimate)[:, :2].T)))
    sigmas = np.zeros(1) if matched.covs is None else np.sqrt(matched.covs[:, 0, 0] + matched.covs[:, 1, 1])
    unsure = apart < _ELSEWHERE_SIGMAS * float(np.median(sigmas))
    lost = sum(mode is Mode.LOST for mode in result.modes) > _LOST * len(result.modes)
    nowhere = any(finding.code == "map.unused" for finding in result.findings)  # poses are not in the map's frame
    if nowhere or config.estimator.initial_pose is not None or ((lost or unsure) and not (at_origin or placed)):
        return None
    times = (matched.stamps_ns - matched.stamps_ns[0]) * 1e-9
    sentence = truth_sentence(config, np.column_stack([times, matched.truth]), times, matched.estimate)
    lines = {"truth.align": "se2"}
    return None if sentence is None else Finding("truth.frame", sentence, Severity.WARNING, lines)


def _turned(config: Config, matched: Matched) -> Finding | None:
    """Finding that the truth's yaw is another axis than the robot's: off by one angle, where positions agree."""
    if not matched.has_yaw:
        return None
    off = se2.wrap_array(matched.errors[:, 2])
    mean = float(np.angle(np.exp(1j * off).mean()))
    spread = float(np.median(np.abs(se2.wrap_array(off - mean)))) * MAD
    agree = ate_rmse_m(matched) < _AGREE * float(np.hypot(*matched.truth[:, :2].std(axis=0)))
    if not agree or abs(mean) < _TURNED_RAD or spread > _AGREE * abs(mean):
        return None
    offset = round(math.remainder(config.truth.yaw_offset_rad - mean, math.tau), 3)
    text = (
        f"The truth's yaw is {math.degrees(-mean):+.1f}° (± {math.degrees(spread):.1f}) off the estimate's, while "
        f"positions agree: the tracked body is turned by that. If so, set truth.yaw_offset_rad: {offset:g}"
    )
    return Finding("truth.mounting", text, Severity.WARNING, {"truth.yaw_offset_rad": f"{offset:g}"}, -mean, spread)


_LOST = 0.1  # share of the poses
_ELSEWHERE_SIGMAS = 10.0  # of its position, beyond which a run on a map is no wrong place
_TURNED_RAD = 0.1  # yaw of a truth that is worth a word
_FRAME_M = 0.3  # rmse above which the frame of a truth is asked about
_AGREE = 0.25  # largest error of positions over the path's extent, and spread of the yaw over what it is off by


@dataclass(frozen=True, slots=True)
class Size:
    """Scale of an estimate against its truth.

    Attributes:
        scale: distances of the estimate over those of the truth.
        rigid_m: rmse of positions [m] after the best rigid motion, SE(2).
        scaled_m: after the best similarity, Sim(2).
        sigma_m: rms that the covariance expects of positions [m]; 0: there is none.
    """

    scale: float
    rigid_m: float
    scaled_m: float
    sigma_m: float

    @property
    def told(self) -> bool:
        """Whether the scale is what most of the error comes from, and the covariance does not explain it."""
        beyond = self.rigid_m > _SIZE_BEYOND * self.sigma_m
        return beyond and abs(self.scale - 1.0) >= _SIZE_OFF and self.scaled_m < _SIZE_EXPLAINS * self.rigid_m

    @property
    def gross(self) -> bool:
        """Whether so large a scale is no installation's error: a unit or a geometry is wrong."""
        return self.told and abs(math.log(self.scale)) > math.log(_SIZE_GROSS)

    @property
    def finding(self) -> Finding:
        """The scale, and where it may come from."""
        text = (
            f"The estimate is {self.scale:.4g} times as large as the truth: scaled, its error would be "
            f"{self.scaled_m:.3g} m (rmse) in place of {self.rigid_m:.3g} m. Distances come from marker sizes, the "
            "map, ranges or wheel radii; or the truth is in another unit."
        )
        return Finding("truth.size", text, Severity.ERROR if self.gross else Severity.WARNING, value=self.scale)


_SIZE_OFF = 0.01  # share; smaller scales are lost in other errors
_SIZE_GROSS = 2.0  # times, or one part of
_SIZE_EXPLAINS = 0.5  # largest share of the error that is left
_SIZE_BEYOND = 1.5  # sigmas


def size_of(matched: Matched) -> Size | None:
    """Scale that fits an estimate to its truth best (Umeyama 1991, in the plane); None where nothing moved."""
    estimate, truth = (poses[:, 0] + 1j * poses[:, 1] for poses in (matched.estimate, matched.truth))
    estimate, truth = estimate - estimate.mean(), truth - truth.mean()
    spread, common = float((abs(truth) ** 2).sum()), complex((truth.conj() * estimate).sum())
    if spread < 1e-6 * len(truth) or not abs(common):
        return None
    scale, turned = abs(common) / spread, truth * common / abs(common)
    left = [float(np.sqrt((abs(estimate - factor * turned) ** 2).mean())) for factor in (1.0, scale)]
    sigma = 0.0 if matched.covs is None else float(np.sqrt(matched.covs[:, [0, 1], [0, 1]].sum(axis=1).mean()))
    return Size(scale, left[0], left[1] / scale, sigma)


def frame_remark(matched: Matched) -> str | None:
    """The sentence on a truth that fits once it is moved rigidly, or mirrored; None: neither brings them together."""
    apart, size = ate_rmse_m(matched), size_of(matched)
    mirrored = size_of(replace(matched, truth=matched.truth * (1.0, -1.0, 1.0)))
    if size is None or mirrored is None or apart < _FRAME_M or size.told:
        return None
    if size.rigid_m < _AGREE * apart:
        return f"The truth is in another frame: of {apart:.3g} m (rmse) {size.rigid_m:.3g} m are left by --align se2."
    if mirrored.rigid_m < _AGREE * size.rigid_m:
        return (
            f"The truth is a mirror image: {mirrored.rigid_m:.3g} m (rmse) are left once x and y are exchanged, or one "
            "of them (and the yaw) has the other sign, and the two are aligned."
        )
    return None


def _optimistic(result: RunData, nees: float | None) -> Iterator[Finding]:
    lost = sum(mode is Mode.LOST for mode in result.modes)  # no sigma of a prior makes these right
    if nees is None or nees <= _MOST_NEES or 2 * lost > len(result.modes):
        return
    doubtful = [finding.code for finding in result.findings if finding.code in _DOUBTFUL]
    yield Finding(
        "covariance.optimistic",
        f"NEES/3 is {nees:.1f}, expected about 1: the errors are {nees**0.5:.1f} times what the covariance says. "
        + (
            f"The truth itself is in doubt ({', '.join(doubtful)}): mend it first."
            if doubtful
            else "Something is off by more than its sigma: see the faults that the report lists, and raise "
            f"{_prior_sigmas(result)} to what your installation really is."
        ),
        Severity.WARNING,
        value=nees,
    )


def _dropped(result: RunData, rejections: Mapping[str, int], keyframes: int) -> Iterator[Finding]:
    dropped: Counter[str] = Counter()
    told = {reason: n for reason, n in rejections.items() if not reason.endswith(".frozen")}  # has its own warning
    for reason, count in told.items():
        dropped[reason.partition(".")[0]] += count
    most = max((topic.count for topic in result.spans.values()), default=0)
    for sensor, count in dropped.most_common():
        if (kind := base_role(sensor)) not in (*_SETTINGS, "sightings"):
            continue
        received = keyframes if kind in ("image", "sightings") else most
        if count >= _FEWEST and count > _MOST_DROPPED * max(received, count):
            reasons = ", ".join(f"{r} {n}" for r, n in told.items() if r.startswith(f"{sensor}."))
            too_fast = rejections.get("joints.wheel_rate_bound", 0) if sensor == "joints" else 0
            used = sensor not in _MOTION or result.found is None or result.found.wheels in ("", sensor)
            remedy = f"look at {_settings_of(sensor, result)}" if used else "the run's motion is of another source"
            text = f"{count} messages of {sensor} were dropped ({reasons}); {remedy}."
            if 2 * too_fast > count:
                text = (
                    f"Velocities in {too_fast} messages of joints were beyond what wheels reach and were left out; "
                    "positions of these messages are used where there are any. If they count ticks or degrees, set "
                    "wheels.drive with its ticks_per_turn (docs/drives.md); else record velocities in rad/s."
                )
            if 2 * rejections.get(f"{sensor}.duplicate_stamp", 0) > count:
                text = (
                    f"{count} messages of {sensor} were dropped ({reasons}): their topic had a message of that stamp "
                    "already. Recorded twice, or of two publishers, nothing is lost; stamps of a clock that stands "
                    f"between messages are replaced by recording.received_stamps: [{sensor}]."
                )
            if 2 * rejections.get(f"{sensor}.unknown_id", 0) > count:
                text = (
                    f"{count} sightings of {sensor} were dropped ({reasons}): the map lacks their landmarks. `fgloc "
                    "map BAG --anchor MAP.yaml --out MAP2.yaml` adds them to it."
                )
            yield Finding(f"{sensor}.dropped", text, Severity.WARNING if used else Severity.NOTE, value=float(count))


def _unused(rejections: Mapping[str, int], keyframes: int) -> Iterator[Finding]:
    """Finding on a motion model that a run was given and never used."""
    why = {reason: n for reason, n in rejections.items() if reason.startswith("learned.")}
    without = rejections.get("learned.no_commands", 0)
    if sum(why.values()) < _UNUSED * keyframes or without < _FEWEST:
        return
    text = (
        f"The motion model was not used: for {without} of {keyframes} steps the recording has no commands that it "
        "reads. Set recording.topics.command, or leave the model out."
    )
    yield Finding("learned.unused", text, Severity.WARNING, value=float(without))


def _settings_of(sensor: str, result: RunData) -> str:
    """Settings that decide which messages of a sensor are dropped; of sightings, by what this run's are."""
    kind = base_role(sensor)
    if kind != "sightings":
        return _SETTINGS[kind]
    found = result.found
    corners = found is not None and any(camera_role(c.name, kind) == sensor for c in found.cameras)
    noise = ["markers.sigma_px"] if corners else ["landmarks.range_sigma_m", "landmarks.bearing_sigma_rad"]
    places = ["map.position_sigma_m"] if found is not None and found.landmarks is not None else []
    return ", ".join([*noise, *places, "expert.gate.max_range"])


def _prior_sigmas(result: RunData) -> str:
    """Settings that say how far off this run's installation may be."""
    found = result.found
    sections = [] if found is None else [setting.name.partition(".")[0] for setting in found.settings]
    if found is not None and found.landmarks is not None:
        sections.insert(0, "map")
    names = []
    if result.config is not None and result.config.wheels.drive is not None and "wheels" in sections:
        sections = [section for section in sections if section != "wheels"]
        names.append("wheels.drive.sigmas")
    if found is not None and result.landmarks is None:
        names.append("expert.wheels.noise (fgloc calibrate takes several recordings)")
    for section in dict.fromkeys(sections):
        field = Config.model_fields.get(section)  # "stamp_offset_s" is of the clocks
        keys = () if field is None else getattr(field.annotation, "model_fields", ())
        names += [f"{section}.{key}" for key in keys if _PRIOR.search(key)][:1]
    return " or ".join(names) or "the sigmas of its settings"


# --- Figures of a run -------------------------------------------------------------------------------------------------

_Figure = TypeVar("_Figure")
_LEG_M = 0.02  # shorter moves of the truth are its noise, not distance travelled


class StepTimes(Figures):
    """Wall time of one update [ms]."""

    median: float
    p95: float
    p99: float
    max: float


class FoundSetting(Figures):
    """A value of the installation as given and as found, in the units of the configuration."""

    given: float
    prior_sigma: float
    found: float
    sigma: float


class FoundFinding(Figures):
    """A finding, as `fgloc.types.Finding` has it; ``severity`` is "error", "warning" or "note"."""

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


class GroundMetrics(Figures):
    """Errors of the pose in space, on uneven ground: root mean squares, and the mean NEES over 6."""

    ate_rmse_m: float  # distance in space
    height_rmse_m: float
    roll_rmse_deg: float
    pitch_rmse_deg: float
    nees_over_6: float  # of x, y, z, roll, pitch and yaw


class ProtectionMetrics(Figures):
    """Bounds on the errors of the poses (docs/integrity.md), and how they held against the truth."""

    median_m: float | None  # of the bounds on the position; None: no pose has one
    p95_m: float | None
    median_yaw_deg: float | None
    alert_share: float  # of the poses whose bound is above the alert limit, or that have none
    causes: dict[str, float]  # shares of the poses, by what their bound is due to
    exceeded: float | None  # share of the poses that are wrong by more than their bound; None: no truth
    dangerous: float | None  # likewise, without an alert


class OdometryMetrics(Figures):
    """Odometry alone against the truth, moved onto it by the rigid motion that fits best: it has no frame."""

    ate_rmse_m: float
    ate_over_odometry: float | None  # of the run's `ate_rmse_m`; None: odometry alone is without error


class Metrics(Figures):
    """Content of ``metrics.json``. Keys that need a truth are None without one."""

    duration_s: float
    keyframes: int
    first_pose_s: float | None  # None: the place on the map was never known
    ate_mean_m: float | None
    ate_rmse_m: float | None
    yaw_mae_deg: float | None
    end_error_m: float | None
    drift_percent: float | None
    nees_over_3: float | None  # by position alone, and over 2, where the truth has no yaw
    coverage: dict[str, float] | None  # by number of sigmas: "1", "2", "3"
    ground: GroundMetrics | None  # None: estimated on a flat floor, or no truth
    odometry: OdometryMetrics | None  # None: no truth, or nothing measured the motion
    protection: ProtectionMetrics | None  # None: a smoothed run
    real_time_factor: float | None  # seconds of recording per second of work
    step_ms: StepTimes | None
    factors: dict[str, int]
    rejections: dict[str, int]
    installation: dict[str, FoundSetting]  # by setting
    findings: tuple[FoundFinding, ...]  # what is wrong and worth knowing, the gravest first
    judgements: tuple[Judgement, ...]  # what was judged to be wrong, when, and by which evidence


def _installation(result: RunData) -> dict[str, FoundSetting]:
    found, config = result.found, result.config
    settings = () if found is None else found.settings
    if found is not None and config is not None:
        settings = (*settings, *constants_found(found, config))
    return {
        s.name: FoundSetting(given=s.given, prior_sigma=s.prior_sigma, found=s.found, sigma=s.sigma) for s in settings
    }


def ate_mean_m(matched: Matched) -> float:
    """Mean distance from the truth [m]. Source: the paper, eq. 11, over the matched stamps."""
    return float(np.mean(matched.distances))


def ate_rmse_m(matched: Matched) -> float:
    """Root mean square distance from the truth [m]: evo's APE of the translation."""
    return float(np.sqrt(np.mean(matched.distances**2)))


def yaw_mae_deg(matched: Matched) -> float | None:
    """Mean absolute yaw error [°], wrapped; None: the truth has no yaw. Source: the paper, eq. 12."""
    return None if not matched.has_yaw else float(np.degrees(np.mean(np.abs(matched.errors[:, 2]))))


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
    """Relative pose error over pairs that are so far apart: root mean squares."""

    translation_m: float
    rotation_deg: float


def relative_error(matched: Matched, apart_m: float) -> RelativeError | None:
    """Error of the motion between poses that are so many metres of the estimate's path apart.

    Equals evo's RPE with consecutive pairs; None if no two poses are that far apart. Source: Sturm et al., "A benchmark
    for the evaluation of RGB-D SLAM systems", 2012, section V.
    """
    ends, travelled = [0], 0.0
    for i, step in enumerate(np.hypot(*np.diff(matched.estimate[:, :2], axis=0).T), start=1):
        travelled += float(step)
        if travelled >= apart_m:
            ends.append(i)
            travelled = 0.0
    if len(ends) < 2:
        return None
    errors = []
    for i, j in pairwise(ends):
        moved = se2.between(matched.estimate[i], matched.estimate[j])
        errors.append(se2.between(se2.between(matched.truth[i], matched.truth[j]), moved))
    translation, rotation = np.hypot(*np.array(errors)[:, :2].T), np.array(errors)[:, 2]
    return RelativeError(_rms(translation), math.degrees(_rms(rotation)))


def compute_metrics(result: RunData, config: Config) -> Metrics:
    """Compute the content of ``metrics.json``.

    Raises:
        CovarianceError: a covariance of the estimate is not positive definite.
    """
    matched = match_result(result, config)
    stamps = result.trajectory.stamps_ns
    duration = float(stamps[-1] - stamps[0]) * 1e-9 if len(stamps) else 0.0

    def against_truth(figure: Callable[[Matched], _Figure | None]) -> _Figure | None:
        return None if matched is None else figure(matched)

    nees_over_dof, covered = None, None
    if matched is not None and matched.covs is not None:
        errors, covs = in_own_gauge(matched) if config.truth.align == "se2" else compared(matched)
        nees_over_dof = float(np.mean(nees(errors, covs))) / errors.shape[1]
        covered = {str(k): coverage(errors, covs, k) for k in (1, 2, 3)}
    rejections = dict(sorted(result.rejections.items()))
    frame = against_truth(lambda m: _elsewhere(result, config, m) or _turned(config, m))
    findings = all_findings(result, nees_over_dof, rejections, len(stamps), against_truth(size_of), frame)
    return Metrics(
        duration_s=duration,
        keyframes=len(stamps),
        first_pose_s=result.first_pose_s,
        ate_mean_m=against_truth(ate_mean_m),
        ate_rmse_m=against_truth(ate_rmse_m),
        yaw_mae_deg=against_truth(yaw_mae_deg),
        end_error_m=against_truth(end_error_m),
        drift_percent=against_truth(drift_percent),
        nees_over_3=nees_over_dof,
        coverage=covered,
        ground=against_truth(ground_metrics),
        odometry=None if matched is None else odometry_metrics(result, config, ate_rmse_m(matched)),
        protection=protection_metrics(result, matched),
        real_time_factor=duration / result.wall_s if result.wall_s > 0 else None,
        step_ms=_step_times(result.step_ms),
        factors=dict(sorted(result.counts.items())),
        rejections=rejections,
        installation=_installation(result),
        findings=tuple(map(FoundFinding.of, findings)),
        judgements=judgements(result),
    )


def ground_metrics(matched: Matched) -> GroundMetrics | None:
    """Errors of the pose in space against the truth; None: it was not estimated."""
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


def protection_metrics(result: RunData, matched: Matched | None) -> ProtectionMetrics | None:
    """Figures of the bounds on the errors; None: the run has none."""
    if not result.protections:
        return None
    position = np.array([p.position_m for p in result.protections])
    yaw, alert = (np.array(values) for values in zip(*((p.bound[2], p.alert) for p in result.protections), strict=True))
    finite = np.isfinite(position)
    median, p95 = np.percentile(position[finite], [50, 95]).tolist() if finite.any() else (None, None)
    causes = Counter(p.cause.split(" ")[0] if finite[i] else "no fix" for i, p in enumerate(result.protections))
    beyond = None if matched is None else beyond_bounds(result, matched)
    return ProtectionMetrics(
        median_m=median,
        p95_m=p95,
        median_yaw_deg=math.degrees(float(np.median(yaw[finite]))) if finite.any() else None,
        alert_share=float(alert.mean()),
        causes={cause: count / len(position) for cause, count in causes.most_common()},
        exceeded=None if beyond is None else float(beyond[0].mean()),
        dangerous=None if beyond is None else float((beyond[0] & ~beyond[1]).mean()),
    )


def beyond_bounds(result: RunData, matched: Matched) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Two masks ``(n,)`` of the matched poses: those whose error exceeds its bound, and those with an alert."""
    at = np.searchsorted(result.trajectory.stamps_ns, matched.stamps_ns)
    bounds = np.array([result.protections[i].bound for i in at])
    errors = matched.errors
    own = np.column_stack([se2.turned(errors[:, :2], -matched.estimate[:, 2]), errors[:, 2]])
    far = matched.distances > np.array([result.protections[i].position_m for i in at])
    alert = np.array([result.protections[i].alert for i in at], dtype=np.bool_)
    return np.asarray(far | (np.abs(own) > bounds).any(axis=1)), alert


def odometry_metrics(result: RunData, config: Config, ate_m: float) -> OdometryMetrics | None:
    """Figures of odometry alone, beside the run's own error [m]; None: there is none at the truth's times."""
    truth, odometry = result.truth, result.odometry
    if truth is None or odometry is None or len(matchable(odometry, truth, config.truth.max_gap_s)) < FEWEST:
        return None
    alone = ate_rmse_m(match(odometry, truth, "se2", config.truth.max_gap_s, config.truth.offset_m))
    return OdometryMetrics(ate_rmse_m=alone, ate_over_odometry=ate_m / alone if alone > 0.0 else None)


def match_result(result: RunData, config: Config) -> Matched | None:
    """`match` of a run with its truth; None if there is no truth or it has no pose at the run's time."""
    truth = result.truth
    if truth is None or len(truth) == 0 or len(matchable(result.trajectory, truth, config.truth.max_gap_s)) < FEWEST:
        return None
    return match(result.trajectory, truth, config.truth.align, config.truth.max_gap_s, config.truth.offset_m)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _step_times(step_ms: FloatArray) -> StepTimes | None:
    if step_ms.size == 0:
        return None
    median, p95, p99, most = np.percentile(step_ms, [50, 95, 99, 100]).tolist()
    return StepTimes(median=median, p95=p95, p99=p99, max=most)
