"""Every error the package raises on purpose.

    FglocError
    ├── ConfigError          a configuration file or value
    ├── RecordingError       a bag, its topics or its messages
    ├── MapError             a marker map file
    ├── CameraError          a calibration: file, CameraInfo or extrinsic
    ├── ModelError           a learned motion model file
    ├── CovarianceError      a covariance that is not one
    ├── TrajectoryError      a trajectory file, or two that do not overlap
    ├── OutputError          a result that cannot be written
    ├── WireError            ROS 2's wire: DDS is not installed, or refuses
    └── EstimatorError       the estimator was given what it cannot use

A message gives the value found, what was expected and the remedy. The command line turns these into exit code 1.
"""

import traceback
from pathlib import Path


class FglocError(Exception):
    """Base of all errors raised on purpose."""


class ConfigError(FglocError):
    """A configuration file or value cannot be used."""


class RecordingError(FglocError):
    """A recording cannot be read, or lacks what the task needs."""


class MapError(FglocError):
    """A marker map cannot be used."""


class CameraError(FglocError):
    """A camera calibration or extrinsic cannot be used."""


class ModelError(FglocError):
    """A learned motion model cannot be used."""


class CovarianceError(FglocError):
    """A matrix is not a covariance: not symmetric, not finite or not positive definite."""


class TrajectoryError(FglocError):
    """A trajectory cannot be read, or trajectories cannot be compared."""


class OutputError(FglocError):
    """A result file cannot be written."""


class WireError(FglocError):
    """Messages cannot be exchanged on ROS 2's wire."""


class EstimatorError(FglocError):
    """The estimator was given something that it cannot use."""


def unexpected(error: Exception, what: str) -> FglocError:
    """The error itself if it was raised on purpose; else one that says where in fgloc the other came from."""
    if isinstance(error, FglocError):
        return error
    root = Path(__file__).parent
    frames = [f for f in traceback.extract_tb(error.__traceback__) if root in Path(f.filename).parents]
    where = f" in {Path(frames[-1].filename).relative_to(root.parent)}:{frames[-1].lineno}" if frames else ""
    failure = EstimatorError(f"{what} failed: {error!r}{where}; this is a defect of fgloc: please report it")
    failure.__cause__ = error
    return failure
