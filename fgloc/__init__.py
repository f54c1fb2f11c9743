"""fgloc: where a wheeled robot is, without GPS, with an honest covariance."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("fgloc")
except PackageNotFoundError:  # run from a source tree that is not installed
    __version__ = "0+unknown"
