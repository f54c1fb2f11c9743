"""fgloc: where a wheeled robot is, without GPS, with an honest covariance."""

import os
from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("fgloc")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0+unknown"

# Larger images are rejected, by their headers: finding markers takes some 30 bytes a pixel. OpenCV reads this when it
# is loaded, and keeps to it whatever the format.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 24))
