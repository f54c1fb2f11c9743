"""robot_localization's EKF, built from its sources and fed as its node feeds it, for `benchmarks.peers`.

The filter is theirs, unchanged; what is ours is what its node does around it: measurements in the order of their stamps
(its ``smooth_lagged_data``, which is the best that it can be given), ``two_d_mode``, rejection thresholds, a first pose
from the first image.
"""

from __future__ import annotations

import ctypes
import hashlib
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.adaptive_recordings import cache_folder
from fgloc.types import FloatArray, IntArray

X, Y, Z, ROLL, PITCH, YAW, VX, VY, VZ, V_ROLL, V_PITCH, V_YAW, AX, AY, AZ = range(15)
_FLAT = [Z, ROLL, PITCH, VZ, V_ROLL, V_PITCH, AZ]  # measured as zero in two_d_mode ...
_FLAT_VARIANCE = 1e-6  # ... with this, as the node has it
_SOURCE = Path(__file__).parent / "robot_localization" / "filter.cpp"
_INCLUDES = ("/usr/include/eigen3", "/usr/include/xmlrpcpp", "/usr/include/angles")
_APT = "apt install g++ libeigen3-dev libboost-dev libangles-dev libxmlrpcpp-dev"
_D = np.ctypeslib.ndpointer(dtype=np.float64, flags="C_CONTIGUOUS")
_I = np.ctypeslib.ndpointer(dtype=np.int32, flags="C_CONTIGUOUS")


def build(sources: Path) -> Path | str:
    """Compile the filter; the library, or why it cannot be had.

    Args:
        sources: robot_localization's folder (noetic-devel), with ``include/`` and ``src/``.
    """
    parts = [sources / "src" / f"{name}.cpp" for name in ("ekf", "filter_base", "filter_utilities")]
    if missing := [path for path in parts if not path.is_file()]:
        return f"{missing[0]} does not exist; give robot_localization's sources with --robot-localization"
    if shutil.which("g++") is None:
        return f"no g++; {_APT}"
    key = hashlib.sha256(b"".join(path.read_bytes() for path in (_SOURCE, *parts))).hexdigest()[:12]
    library = cache_folder() / "peers" / f"robot_localization_{key}.so"
    if not library.is_file():
        library.parent.mkdir(parents=True, exist_ok=True)
        include = [f"-I{folder}" for folder in (sources / "include", *_INCLUDES)]
        command = ["g++", "-std=c++14", "-O2", "-shared", "-fPIC", *include, "-o", str(library)]
        done = subprocess.run([*command, str(_SOURCE), *map(str, parts)], capture_output=True, text=True, check=False)
        if done.returncode:
            return f"robot_localization does not build ({_APT}?): {done.stderr.splitlines()[0]}"
    return library


def sources_key(library: Path, *settings: str) -> str:
    """What a result of a peer depends on, as a short name."""
    folder = Path(__file__).parent
    parts = [(folder / f"{name}.py").read_bytes() for name in ("peers", "peers_filter", "peers_localizer", "textbook")]
    return hashlib.sha256(b"".join([*parts, library.name.encode(), *(s.encode() for s in settings)])).hexdigest()[:12]


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """What a filter is fed with, in its order; variances of what is not measured do not matter."""

    times_s: FloatArray  # (n,)
    values: FloatArray  # (n, 15)
    variances: FloatArray  # (n, 15)
    measured: IntArray  # (n, 15) 1 or 0
    thresholds: FloatArray  # (n,) Mahalanobis distance above which one is rejected; 0: none is


def run_filter(
    library: Path, noise: FloatArray, given: Measurements, after: IntArray, asked_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses ``(m, 3)`` and covariances ``(m, 3, 3)`` in the map at the times that are asked for.

    Args:
        library: made by `build`.
        noise: ``(15,)`` variances of the process per second.
        given: the measurements; the first one starts the filter.
        after: ``(m,)`` how many measurements come before each of these times.
        asked_s: ``(m,)``.
    """
    values, variances, measured = given.values.copy(), given.variances.copy(), given.measured.copy()
    values[:, _FLAT], variances[:, _FLAT], measured[:, _FLAT] = 0.0, _FLAT_VARIANCE, 1  # two_d_mode
    states, covs = np.zeros((len(asked_s), 15)), np.zeros((len(asked_s), 15, 15))
    run = ctypes.CDLL(str(library)).filter_run
    run.argtypes = [_D, ctypes.c_int, _D, _D, _D, _I, _D, ctypes.c_int, _I, _D, _D, _D]
    run.restype = None
    whole = [np.ascontiguousarray(a, dtype=np.int32) for a in (measured, after)]
    run(
        noise, len(given.times_s), given.times_s, values, variances, whole[0], given.thresholds,
        len(asked_s), whole[1], asked_s, states, covs,
    )  # fmt: skip
    planar = np.array([X, Y, YAW])
    return states[:, planar], covs[:, planar[:, None], planar]
