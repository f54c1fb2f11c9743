"""The state of a live run, saved as JSON with a checksum, and where the robot is after a time away."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError

from fgloc import se2
from fgloc.config import Config, Section
from fgloc.errors import FglocError, OutputError
from fgloc.files.atomic import atomic_file
from fgloc.files.documents import read_text
from fgloc.graph.installation import GROUND, Installation, InstallationEstimate, is_vacant
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.types import FloatArray, LandmarkMap, Mode, MotionEvent, Step

_SYMMETRIC, _NEGATIVE = 1e-6, -1e-9  # of the largest variance: what rounding leaves

Row3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class OdometryState(Section):
    """The odometry's own pose at a time, from which it measures the motion while its frame goes on."""

    topic: str
    frame_id: str
    stamp_ns: int
    pose: Row3


class InstallationState(Section):
    """Estimate of the installation: names, mean and covariance, and gates of constants that a knock has changed."""

    names: tuple[str, ...]
    mean: tuple[FiniteFloat, ...]
    cov: tuple[tuple[FiniteFloat, ...], ...]
    gates: dict[str, FiniteFloat] = Field({})


class GyroState(Section):
    """Bias of the gyro [rad/s] and its variance [rad²/s²]."""

    bias: FiniteFloat
    bias_variance: Annotated[FiniteFloat, Field(gt=0)]


class RunState(Section):
    """State of a run, as it is saved."""

    format: Literal["fgloc-live-state"] = "fgloc-live-state"
    version: Literal[1] = 1
    map_fingerprint: str
    saved_ns: int  # wall clock
    stamp_ns: int  # of the pose
    pose: Row3  # T_map_base
    cov: tuple[Row3, Row3, Row3]  # of its right perturbation
    mode: Mode
    fastest: tuple[FiniteFloat, FiniteFloat]  # m/s, rad/s: largest speeds of the run
    twist: Row3  # m/s, m/s, rad/s of the base at that time
    installation: InstallationState
    gyro: GyroState | None = None
    odometry: OdometryState | None = None
    excluded: Mapping[int, tuple[FiniteFloat, FiniteFloat]] = Field({})  # landmark: how far [m] it was moved on the map


@dataclass(frozen=True, slots=True, eq=False)
class Resumed:
    """State that was read, or one sentence on why none was, with its code (``state.damaged`` and so on)."""

    state: RunState | None
    note: str
    code: str = ""


def fingerprint(landmark_map: LandmarkMap | None) -> str:
    """Hash of a map's ids, places and sizes, by which maps are told apart."""
    digest = hashlib.sha256()
    if landmark_map is not None:
        for i, landmark in sorted(landmark_map.landmarks.items()):
            digest.update(f"{i} {landmark.size_m:.6f} ".encode())
            digest.update(np.round(np.concatenate([landmark.position, landmark.rotation.ravel()]), 6).tobytes())
    return digest.hexdigest()[:32]


def write_state(path: Path, state: RunState) -> None:
    """Replace the file as a whole; a process killed meanwhile leaves the old one.

    Raises:
        OutputError: it cannot be written.
    """
    body = state.model_dump_json()
    with atomic_file(path) as file:
        json.dump({"sha256": _checksum(body), "state": body}, file)


_FRESH = "it is not used, the start is fresh, and the file will be replaced"


def read_state(path: Path, map_fingerprint: str, remedy: str = _FRESH) -> Resumed:
    """Read the state of an earlier run; a file that is damaged, or of another map, is refused with a note."""
    if not path.exists():
        return Resumed(None, "")
    try:
        content = json.loads(read_text(path, OutputError, "give a file that `--state` wrote"))
        body, checksum = content["state"], content["sha256"]
    except (FglocError, ValueError, KeyError, TypeError, RecursionError) as error:
        return Resumed(None, f"{path}: no saved state ({_short(error)}); {remedy}", "state.unreadable")
    if not isinstance(body, str) or checksum != _checksum(body):
        return Resumed(None, f"{path}: damaged, its checksum does not fit; {remedy}", "state.damaged")
    try:
        state = RunState.model_validate_json(body)
    except ValidationError as error:
        wrong = ", ".join(".".join(map(str, e["loc"])) or e["msg"] for e in error.errors()[:3])
        return Resumed(None, f"{path}: not a state of this version of fgloc ({wrong}); {remedy}", "state.version")
    if state.map_fingerprint != map_fingerprint:
        return Resumed(None, f"{path}: saved with another map than the one given; {remedy}", "state.other_map")
    if problem := _problem(state):
        return Resumed(None, f"{path}: {problem}; {remedy}", "state.covariance")
    return Resumed(state, "")


def resumed_installation(saved: InstallationState, installation: Installation) -> InstallationEstimate | None:
    """Saved estimate of the installation, but for the ground; None if the parameters are not the same.

    Gains of a learned motion may come and go, with a model or a setting: those that were not saved keep their prior.

    Of a map with more landmarks than can be states, those are that were, as far as there are rows for them.
    """
    at = {name: i for i, name in enumerate(saved.names) if name not in GROUND and not is_vacant(name)}
    for landmark_id in dict.fromkeys(int(name.split(".")[1]) for name in at if name.startswith("map.")):
        if landmark_id in installation.stateless and installation.vacancies:
            installation.occupy(landmark_id)
    here = {name: i for i, name in enumerate(installation.names[: installation.constants]) if not is_vacant(name)}
    gains = {name for name in (*at, *here) if name.startswith("learned.")}
    left_out = [name for name in at if name not in here and not (installation.stateless and name.startswith("map."))]
    if not at or here.keys() - at.keys() - gains or set(left_out) - gains:
        return None
    here = {name: i for name, i in here.items() if name in at}
    prior, rows, to = installation.prior(), [at[name] for name in here], list(here.values())
    installation.gates |= {name: sigma for name, sigma in saved.gates.items() if name in here}
    prior.mean[to] = np.array(saved.mean)[rows]
    prior.cov[np.ix_(to, to)] = np.array(saved.cov)[np.ix_(rows, rows)]
    return prior


def matrix3(cov: FloatArray) -> tuple[Row3, Row3, Row3]:
    """A ``(3, 3)`` array as tuples."""
    a, b, c = map(se2.triple, cov)
    return a, b, c


def _problem(state: RunState) -> str:
    """Reason why a state cannot be used; "" if it can."""
    if not _is_cov(np.array(state.cov)):
        return f"the covariance of the pose is none: {state.cov}"
    n = len(state.installation.names)
    shape = (len(state.installation.mean), len(state.installation.cov), *{len(r) for r in state.installation.cov})
    if any(size != n for size in shape) or (n and not _is_cov(np.array(state.installation.cov))):
        return f"the installation has {n} names, and its mean and covariance do not fit"
    return ""


def _is_cov(cov: FloatArray) -> bool:
    scale = float(np.abs(np.diag(cov)).max())
    if not scale > 0.0 or np.abs(cov - cov.T).max() > _SYMMETRIC * scale:
        return False
    return bool(np.linalg.eigvalsh(cov).min() >= _NEGATIVE * scale)


def _checksum(body: str) -> str:
    return hashlib.sha256(body.encode()).hexdigest()


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"[:100]


# --- Resuming: the saved pose, and what is known of the motion since --------------------------------------------------

_KNOWN = (Mode.OK, Mode.DEAD_RECKONING)  # modes whose pose is worth going on from
_USELESS_M, _USELESS_RAD = 3.0, 0.7  # sigmas above which the map is searched anyway
_LEAST_SPEED, _LEAST_TURN = 0.5, 0.5  # m/s, rad/s that a robot is capable of at least
_HASTE = 1.5  # times its fastest: an odometry that went further than this was set anew
_AT_ORIGIN_M, _AT_ORIGIN_RAD = 0.05, 0.05  # an odometry this near to zero has perhaps just been started
_STAMP_S = 0.02  # how far the odometry's pose and the saved one may be apart in time


def odometry_state(event: MotionEvent) -> OdometryState | None:
    """Pose of a motion event as it is saved; None if the event gives no pose."""
    told = event.odometer
    if told is None or not np.isfinite(told.pose).all():
        return None
    return OdometryState(topic=event.topic, frame_id=told.frame_id, stamp_ns=event.stamp_ns, pose=se2.triple(told.pose))


def carried_over(state: RunState, step: Step, config: Config, wall_ns: int) -> tuple[PoseWithCovariance | None, str]:
    """Pose at the first step of a new run, from the state of the last one.

    Args:
        state: what the last run saved.
        step: the first one.
        config: error model of the odometer.
        wall_ns: wall clock at the step; gives the time away if the stamps' clock was set back.

    Returns:
        The pose, or None if too little is known of it; and a sentence on what was done.
    """
    gap_s = (step.stamp_ns - state.stamp_ns) * 1e-9
    if gap_s < 0.0:
        gap_s = max((wall_ns - state.saved_ns) * 1e-9, 0.0)
    if state.mode not in _KNOWN:
        return None, f"Resumed {gap_s:.1f} s later, without a pose: the last run was {state.mode}."
    saved = PoseWithCovariance(np.array(state.pose), np.array(state.cov))
    motion = _by_odometry(state, step, gap_s)
    if motion is not None:
        cov, how = _odometry_cov(state, motion, gap_s, config), "the odometry went on and has measured the motion since"
    else:
        how = "nothing has measured the motion since"
        speed, turn = max(state.fastest[0], _LEAST_SPEED), max(state.fastest[1], _LEAST_TURN)
        cov = np.diag(np.square([speed * gap_s, speed * gap_s, turn * gap_s]) + 1e-9)
    moved = np.zeros(3) if motion is None else motion
    ad = se2.adjoint(se2.inverse(moved))
    belief = PoseWithCovariance(se2.compose(saved.pose, moved), ad @ saved.cov @ ad.T + cov)
    x, y, yaw = np.sqrt(np.diag(belief.cov))
    if max(x, y) > _USELESS_M or yaw > _USELESS_RAD:
        how += "" if motion is None else " too badly"
        return None, f"Resumed {gap_s:.1f} s later; {how}, so the pose is searched for on the whole map."
    return belief, f"Resumed {gap_s:.1f} s later; {how}: the pose is known to {math.hypot(x, y):.2f} m, {yaw:.2f} rad."


def _by_odometry(state: RunState, step: Step, gap_s: float) -> FloatArray | None:
    """``T_saved_now (3,)`` by the odometry's pose, if its frame went on."""
    saved = state.odometry
    if saved is None:
        return None
    told = [(e.stamp_ns, e.odometer) for events in step.motion.values() for e in events if e.topic == saved.topic]
    poses = [(at, p) for at, p in told if p is not None and p.frame_id == saved.frame_id and np.isfinite(p.pose).all()]
    if not poses:
        return None
    at_ns, now_told = min(poses, key=lambda found: abs(found[0] - step.stamp_ns))
    twist = np.array(state.twist)
    then = se2.compose(np.array(saved.pose), se2.exp(twist * (state.stamp_ns - saved.stamp_ns) * 1e-9))
    now_twist = np.where(np.isfinite(now_told.twist), now_told.twist, 0.0)
    now = se2.compose(now_told.pose, se2.exp(now_twist * (step.stamp_ns - at_ns) * 1e-9))
    if _at_origin(now) and not _at_origin(then):
        return None
    motion = se2.between(then, now)
    within_s = gap_s + 1.0
    if math.hypot(*motion[:2]) > _HASTE * max(state.fastest[0], _LEAST_SPEED) * within_s:
        return None
    return None if abs(motion[2]) > max(_HASTE * max(state.fastest[1], _LEAST_TURN) * within_s, math.pi) else motion


def _odometry_cov(state: RunState, motion: FloatArray, gap_s: float, config: Config) -> FloatArray:
    """Covariance ``(3, 3)`` of the motion since the state was saved, by the longer of chord and expected path."""
    errors = config.wheels
    noise = errors.noise
    speed, turn = math.hypot(*state.twist[:2]), abs(state.twist[2])
    path = max(math.hypot(*motion[:2]), speed * gap_s)
    turned = max(abs(float(motion[2])), turn * gap_s)
    yaw = noise.yaw_per_sqrt_m**2 * path + noise.yaw_per_sqrt_rad**2 * turned + noise.yaw_per_sqrt_s**2 * gap_s
    yaw += (errors.turn_scale_sigma * turned) ** 2 + (errors.yaw_per_m_sigma * path) ** 2 + (_STAMP_S * turn) ** 2
    common = noise.xy_per_sqrt_rad**2 * turned + noise.xy_per_sqrt_s**2 * gap_s
    common += (errors.scale_sigma * path) ** 2 + (_STAMP_S * speed) ** 2 + yaw * path**2 / 3.0
    x = noise.x_per_sqrt_m**2 * path + common
    y = noise.y_per_sqrt_m**2 * path + common
    return np.diag([x, y, yaw]) + 1e-9 * np.eye(3)


def _at_origin(pose: FloatArray) -> bool:
    return bool(math.hypot(pose[0], pose[1]) < _AT_ORIGIN_M and abs(pose[2]) < _AT_ORIGIN_RAD)
