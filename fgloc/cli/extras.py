"""What a command needs besides the base install, and how it is installed."""

from __future__ import annotations

import shlex
import sys
from importlib.util import find_spec

from fgloc.errors import ConfigError

_NEEDED = {  # extra of pyproject.toml: what it brings
    "train": ("torch",),
    "sim": ("mujoco",),
    "sweep": ("dask", "distributed"),
    "live": ("cyclonedds",),
    "view": ("rerun",),
}
_HINTS = {"train": "; on Linux, --extra-index-url https://download.pytorch.org/whl/cpu spares 2 GB of CUDA"}


def need(extra: str, command: str) -> None:
    """Find out before a command runs whether its extra is installed.

    Raises:
        ConfigError: it is not; the message says how to install it.
    """
    missing = [name for name in _NEEDED[extra] if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"{command} needs {' and '.join(missing)}, which the base install leaves out; "
            f"install the extra '{extra}': {shlex.quote(sys.executable)} -m pip install 'fgloc[{extra}]'"
            f"{_HINTS.get(extra, '')}"
        )
