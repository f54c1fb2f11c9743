"""fgloc: where a wheeled robot is, without GPS, with an honest covariance."""

from __future__ import annotations

import os
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fgloc.live import Live as Live

try:
    __version__ = version("fgloc")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0+unknown"


def __getattr__(name: str) -> Any:
    """`Live`, imported when it is asked for: it loads the estimator's libraries."""
    if name == "Live":
        from fgloc.live import Live

        return Live
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


# Larger images are rejected, by their headers: finding markers takes some 30 bytes a pixel. OpenCV reads this when it
# is loaded, and keeps to it whatever the format.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 24))
