"""Wheels calibrated on whole recordings of one robot, with nothing but its own sightings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fgloc.config import Config
from fgloc.errors import EstimatorError
from fgloc.runner import Progress, find_beside, run
from fgloc.types import WheelCalibration

_DIGITS = 5
_SIGHTINGS = ("corners", "range_bearing", "marker_pose")
_ROUNDS = 2  # with the gains of the first, sightings are believed and refused that were not before


def calibrate(
    bags: Sequence[Path], map_path: Path | None, config: Config, progress: Progress | None = None
) -> tuple[Config, WheelCalibration]:
    """Find the gains of the wheels, or of commands in their place.

    Args:
        bags: one or more recordings of the robot.
        map_path: marker map; None: that beside each bag, if any.
        config: of the robot. A learned motion in it is not used.
        progress: called now and then.

    Returns:
        The configuration with the gains in it, and the gains with their covariance.

    Raises:
        FglocError: a recording cannot be used, or holds no wheels or no sightings.
    """
    for _ in range(_ROUNDS):
        alone = config.model_copy(
            update={
                "motion": config.motion.model_copy(update={"use": False}),
                "batch": config.batch.model_copy(update={"calibrate_wheels": True}),
            }
        )
        pooled = _pooled([_calibrated(bag, map_path, alone, progress) for bag in bags])
        gains = dict(zip(pooled.names, pooled.value.round(_DIGITS).tolist(), strict=True))
        config = config.model_copy(update={"wheels": config.wheels.model_copy(update=gains)})
    return config, pooled


def _calibrated(bag: Path, map_path: Path | None, config: Config, progress: Progress | None) -> WheelCalibration:
    result = run(bag, map_path or find_beside(bag, "map.yaml"), config, "batch", progress)
    assert result.wheels is not None  # asked for by the configuration
    if not any(result.counts.get(kind) for kind in _SIGHTINGS):
        raise EstimatorError(
            f"{bag}: no sighting of a landmark was used, and without sightings nothing tells what the wheels' gains "
            f"are; see `fgloc info {bag}`"
        )
    return result.wheels


def _pooled(found: Sequence[WheelCalibration]) -> WheelCalibration:
    """The mean of several calibrations, each with the weight of what it knows."""
    names = found[0].names
    if any(other.names != names for other in found):
        raise EstimatorError(
            "some of the recordings have wheels and others only commands; calibrate on those with wheels, or set "
            "wheels.source"
        )
    information = [np.linalg.inv(wheels.cov) for wheels in found]
    cov = np.linalg.inv(np.sum(information, axis=0))
    told = np.sum([i @ wheels.value for i, wheels in zip(information, found, strict=True)], axis=0)
    return WheelCalibration(names, np.asarray(cov @ told), np.asarray(cov))
