"""Where the follower's pose comes from."""

from __future__ import annotations

from typing import Any, Literal, Protocol, get_args

import numpy as np

from fgloc.config import Config, config_of
from fgloc.errors import EstimatorError
from fgloc.live import Live
from fgloc.types import Event, FloatArray, LandmarkMap, Mode

PoseName = Literal["truth", "fgloc", "fgloc-no-model", "fgloc-no-model-no-gyro", "fgloc-constant", "wheels", "learned"]
POSES: tuple[PoseName, ...] = get_args(PoseName)
_START_SIGMA = 1e-3  # m and rad: dead reckoning begins at the true pose
_PATIENCE_S = 120.0  # of wall time, for what has been pushed
_BLIND: dict[str, Any] = {"recording": {"topics": {"image": "none", "camera_info": "none", "sightings": "none"}}}
_CHANGES: dict[PoseName, dict[str, Any]] = {
    "fgloc": {},
    "fgloc-no-model": {"motion": {"use": False}},
    "fgloc-no-model-no-gyro": {"motion": {"use": False}, "gyro": {"use": False}},
    "fgloc-constant": {"weights": {"adaptive": False}},
    "wheels": {**_BLIND, "motion": {"use": False}, "gyro": {"use": False}},
    "learned": {
        "recording": {"topics": {**_BLIND["recording"]["topics"], "odometry": "none"}},
        "wheels": {"source": "none"},
    },
}


class PoseSource(Protocol):
    """Takes the robot's messages as they arrive, and tells its pose."""

    def push(self, event: Event) -> None:
        """Take an event, in order of receipt."""

    def pose(self, stamp_ns: int, truth: FloatArray) -> tuple[FloatArray | None, float]:
        """Pose ``(3,)`` (None: not known) and the standard deviation of its position in the worst direction [m]."""

    def close(self) -> None:
        """End."""


class TruePose:
    """The pose itself, for comparison."""

    def push(self, event: Event) -> None:
        """Nothing is needed."""

    def pose(self, stamp_ns: int, truth: FloatArray) -> tuple[FloatArray | None, float]:
        """The truth."""
        return truth, 0.0

    def close(self) -> None:
        """Nothing is to be ended."""


class LivePose:
    """The pose of a `Live`: everything that has arrived is used before it is asked, so that runs can be repeated."""

    def __init__(self, config: Config, landmark_map: LandmarkMap | None, roles: set[str], heeds_sigma: bool) -> None:
        """Start it.

        Args:
            config: as on the robot.
            landmark_map: None: dead reckoning.
            roles: what will arrive; the run begins when all of it is there.
            heeds_sigma: tell the pose's covariance; a dead-reckoned robot would stop at some time.
        """
        self._heeds_sigma = heeds_sigma
        self._live = Live(config, landmark_map, roles=roles)

    def push(self, event: Event) -> None:
        """Take an event."""
        self._live.push(event)

    def pose(self, stamp_ns: int, truth: FloatArray) -> tuple[FloatArray | None, float]:
        """The newest pose, carried on to the stamp."""
        if not self._live.wait(_PATIENCE_S):
            raise EstimatorError(f"the live run did not use its events within {_PATIENCE_S:.0f} s")
        known = self._live.pose_at(stamp_ns)
        if known is None or known.mode in (Mode.UNCONFIRMED, Mode.LOST):
            return None, 0.0
        sigma = float(np.sqrt(np.linalg.eigvalsh(known.cov[:2, :2])[-1])) if self._heeds_sigma else 0.0
        return known.pose, sigma

    def close(self) -> None:
        """End its threads."""
        self._live.close()


def pose_source(
    name: PoseName, config: Config, landmark_map: LandmarkMap, sees: str, start: tuple[float, float, float]
) -> PoseSource:
    """A source by name.

    Args:
        name: "truth"; "fgloc", and the same without its learned motion, without that and the gyro, or with constant
            weights; "wheels" or "learned": wheel odometry or the learned motion alone, carried on from the true start.
        config: as in ``robot.yaml``.
        landmark_map: as surveyed.
        sees: role of the camera: "image" or "sightings".
        start: true pose.
    """
    if name == "truth":
        return TruePose()
    changes = _CHANGES[name]
    roles = {"odometry", "joints", "command", "imu"}
    if name.startswith("fgloc"):
        return LivePose(changed(config, changes), landmark_map, roles | {sees}, heeds_sigma=True)
    begin = {"estimator": {"initial_pose": start, "initial_sigmas": (_START_SIGMA,) * 3}}
    roles -= {"odometry"} if name == "learned" else set()
    return LivePose(changed(changed(config, changes), begin), None, roles, heeds_sigma=False)


def changed(config: Config, changes: dict[str, Any]) -> Config:
    """The configuration with some of its values replaced, given as nested mappings."""

    def merged(old: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
        inner = {k: merged(old.get(k) or {}, v) if isinstance(v, dict) else v for k, v in new.items()}
        return {**old, **inner}

    return config_of(merged(config.model_dump(exclude_unset=True), changes))
