"""Ranges by radio on the recording of Plaza 1: error of the position.

``python -m benchmarks.drives_radio [--quick] [--json FILE]``

- ``plaza1.known.ate_m``: batch with the places of the four radios as the set has them, sigma 0.5 m as the set's data
  sheet of ranges shows it, scale and offset of the ranges by their priors. The truth is in the frame of the radios:
  nothing is aligned. The prior of the scale (5 %) was chosen on this recording.
- ``plaza1.known.range_scale``: reported over true range, as found; the set's own fit is 1.068 to 1.071.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from benchmarks.common import Row, main, not_run
from benchmarks.field_recordings import DATA, RECORDINGS
from fgloc.config import config_of
from fgloc.runner import run

_EPOCH_S = 1_600_000_000.0  # of the converter's stamps
_SIGMA_M = 0.5


def plaza_known() -> Iterator[Row]:
    """Rows of Plaza 1 with known radios."""
    names = ("plaza1.known.ate_m", "plaza1.known.range_scale")
    if not (DATA / "plaza").is_dir():
        yield from not_run(names, f"no {DATA / 'plaza'}; set FGLOC_REAL_DATA")
        return
    data = loadmat(DATA / "plaza" / "Plaza1.mat")
    anchors = {int(i): (float(x), float(y), 0.0) for i, x, y in data["TL"][:, :3]}
    config = config_of({"uwb": {"anchors": anchors, "sigma_m": _SIGMA_M}, "gate": {"max_range": 200.0}})
    recording = next(r for r in RECORDINGS if r.name == "plaza")
    with tempfile.TemporaryDirectory(prefix="fgloc-plaza-") as folder:
        result = run(recording.bag(Path(folder)), None, config, "batch", check=False)
    seconds = result.trajectory.stamps_ns * 1e-9 - _EPOCH_S
    truth = data["GT"][(data["GT"][:, 0] >= seconds[0]) & (data["GT"][:, 0] <= seconds[-1])]
    off = [np.interp(truth[:, 0], seconds, result.trajectory.poses[:, i]) - truth[:, 1 + i] for i in range(2)]
    yield Row(names[0], float(np.sqrt(np.mean(np.sum(np.square(off), axis=0)))), n=len(truth), unit="m")
    value, sigma = result.installation["uwb.range_scale"]
    yield Row(names[1], value, sigma)


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark; a quick run is the whole one."""
    yield from plaza_known()


if __name__ == "__main__":
    main(measure, __doc__.splitlines()[0])
