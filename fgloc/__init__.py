"""fgloc: where a wheeled robot is, without GPS, with an honest covariance.

The public API. Everything else may change from one version to the next::

    from pathlib import Path

    import fgloc

    config = fgloc.load_config(Path("robot.yaml"))
    result = fgloc.run(Path("bag"), Path("map.yaml"), config, "batch")
    result.write(Path("out"))

A sensor of another package is a class like `Sensor`; docs/adding-a-sensor.md goes through one.

Names are imported when they are first used: the estimator's libraries take a second to load.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fgloc.errors import (
    CameraError,
    ConfigError,
    CovarianceError,
    EstimatorError,
    FglocError,
    MapError,
    ModelError,
    OutputError,
    RecordingError,
    TrajectoryError,
    WireError,
)

if TYPE_CHECKING:
    from fgloc.config import Config, Section, load_config
    from fgloc.evaluation.results import Results, read_results
    from fgloc.live import Live
    from fgloc.runner import RunResult, run
    from fgloc.sensors.base import Context, Sensor, Stream
    from fgloc.sensors.maps import load_map
    from fgloc.sensors.measurements import PoseMeasurement
    from fgloc.types import Decision, Estimate, LandmarkMap, Mode, SensorEvent, Trajectory

__all__ = [
    "CameraError",
    "Config",
    "ConfigError",
    "Context",
    "CovarianceError",
    "Decision",
    "Estimate",
    "EstimatorError",
    "FglocError",
    "LandmarkMap",
    "Live",
    "MapError",
    "Mode",
    "ModelError",
    "OutputError",
    "PoseMeasurement",
    "RecordingError",
    "Results",
    "RunResult",
    "Section",
    "Sensor",
    "SensorEvent",
    "Stream",
    "Trajectory",
    "TrajectoryError",
    "WireError",
    "load_config",
    "load_map",
    "read_results",
    "run",
]

_IMPORTED_LATE = {
    name: module
    for module, names in (
        ("fgloc.config", ("Config", "Section", "load_config")),
        ("fgloc.evaluation.results", ("Results", "read_results")),
        ("fgloc.live", ("Live",)),
        ("fgloc.runner", ("RunResult", "run")),
        ("fgloc.sensors.base", ("Context", "Sensor", "Stream")),
        ("fgloc.sensors.maps", ("load_map",)),
        ("fgloc.sensors.measurements", ("PoseMeasurement",)),
        ("fgloc.types", ("Decision", "Estimate", "LandmarkMap", "Mode", "SensorEvent", "Trajectory")),
    )
    for name in names
}

# Larger images are rejected, by their headers: finding markers takes some 30 bytes a pixel. OpenCV reads this when it
# is loaded, and keeps to it whatever the format.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 24))


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first used."""
    if name == "__version__":
        return _version()
    if name not in _IMPORTED_LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_IMPORTED_LATE[name]), name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # takes as long as all the rest of `fgloc --help`

    try:
        return version("fgloc")
    except PackageNotFoundError:  # run from a source tree that is not installed
        return "0+unknown"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
