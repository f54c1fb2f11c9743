"""The state of a live run, to be saved and resumed: JSON with a checksum, replaced as a whole."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat, ValidationError

from fgloc.config import Section
from fgloc.errors import FglocError, OutputError
from fgloc.files.atomic import atomic_file
from fgloc.files.documents import read_text
from fgloc.graph.installation import Installation, InstallationEstimate
from fgloc.types import FloatArray, LandmarkMap, Mode

_SYMMETRIC, _NEGATIVE = 1e-6, -1e-9  # of the largest variance: what rounding leaves

Row3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class OdometryState(Section):
    """The odometry's own pose at a time: while its frame goes on, it has measured the motion in between."""

    topic: str
    frame_id: str
    stamp_ns: int
    pose: Row3


class InstallationState(Section):
    """What was found of the installation."""

    names: tuple[str, ...]
    mean: tuple[FiniteFloat, ...]
    cov: tuple[tuple[FiniteFloat, ...], ...]


class GyroState(Section):
    """The gyro's bias [rad/s], [rad²/s²]."""

    bias: FiniteFloat
    bias_variance: Annotated[FiniteFloat, Field(gt=0)]


class RunState(Section):
    """All that is saved."""

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
    """A state that was read, or why none was: one sentence."""

    state: RunState | None
    note: str


def fingerprint(landmark_map: LandmarkMap | None) -> str:
    """Tells maps apart: by their ids, places and sizes."""
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


def read_state(path: Path, map_fingerprint: str) -> Resumed:
    """What an earlier run left; a file that is damaged, or not of this map, is refused and the start is fresh."""
    if not path.exists():
        return Resumed(None, "")
    remedy = "it is not used, the start is fresh, and the file will be replaced"
    try:
        content = json.loads(read_text(path, OutputError, "give a file that `--state` wrote"))
        body, checksum = content["state"], content["sha256"]
    except (FglocError, ValueError, KeyError, TypeError, RecursionError) as error:
        return Resumed(None, f"{path}: no saved state ({_short(error)}); {remedy}")
    if not isinstance(body, str) or checksum != _checksum(body):
        return Resumed(None, f"{path}: damaged, its checksum does not fit; {remedy}")
    try:
        state = RunState.model_validate_json(body)
    except ValidationError as error:
        wrong = ", ".join(".".join(map(str, e["loc"])) or e["msg"] for e in error.errors()[:3])
        return Resumed(None, f"{path}: not a state of this version of fgloc ({wrong}); {remedy}")
    if state.map_fingerprint != map_fingerprint:
        return Resumed(None, f"{path}: saved with another map than the one given; {remedy}")
    if problem := _problem(state):
        return Resumed(None, f"{path}: {problem}; {remedy}")
    return Resumed(state, "")


def installation_of_state(state: RunState, installation: Installation) -> InstallationEstimate | None:
    """What was found, if the parameters are still the same; the ground is that of where the robot is now: not known."""
    saved = state.installation
    if saved.names != installation.names or not saved.names:
        return None
    prior, constants = installation.prior(), installation.constants
    mean, cov = prior.mean, prior.cov
    mean[:constants] = saved.mean[:constants]
    cov[:constants, :constants] = np.array(saved.cov)[:constants, :constants]
    return InstallationEstimate(mean, cov)


def matrix3(cov: FloatArray) -> tuple[Row3, Row3, Row3]:
    """A ``(3, 3)`` array as tuples."""
    a, b, c = (row3(row) for row in np.asarray(cov))
    return a, b, c


def row3(values: FloatArray) -> Row3:
    """A ``(3,)`` array as a tuple."""
    x, y, z = np.asarray(values).tolist()
    return x, y, z


def _problem(state: RunState) -> str:
    """What cannot be computed with; "" if all is well."""
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
