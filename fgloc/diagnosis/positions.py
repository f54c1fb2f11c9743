"""Positions of a GNSS receiver against the wheels: whether they scatter as little as their messages say.

The wheels' path is cut into windows. Each is laid onto the positions by its own shift, turn and length, and with a
lever arm of its own, so that neither the place of the antenna nor a constant of the wheels counts; what is left is the
noise of the positions from one to the next. Errors that they have in common for longer are not seen here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.pairs import MAD, Figure
from fgloc.diagnosis.signals import Path, in_order
from fgloc.types import FloatArray

_LONGEST_S, _FEWEST, _FEWEST_WINDOWS = 20.0, 8, 3  # of a window, positions in one, and windows
_UNKNOWNS = 3  # complex ones of a window: its shift, its turn and length, and its lever arm
_FACTOR = 5.0  # noise over what is reported, from which on it is named ...
_LEAST_M = 0.1  # ... if it is more than this, which the wheels surely resolve
_MOST_SCALE = 100.0  # that `gnss.sigma_scale` may be


def check_positions(found: Conventions, path: Path) -> None:
    """Name positions whose covariance is too small by far."""
    section = getattr(found.config, "gnss", None)
    rows = in_order([row for row in found.signals.positions if row[3] > 0.0])
    if section is None or section.origin is None or len(rows) < _FEWEST * _FEWEST_WINDOWS:
        return
    windows = list(_left(path, rows))
    if len(windows) < _FEWEST_WINDOWS:
        return
    reported = section.sigma_scale * float(np.median(rows[:, 3]))
    scatter = MAD * float(np.median(np.abs(np.concatenate(windows))))
    least = MAD * float(np.median([np.median(np.abs(window)) for window in windows]))  # that most windows have
    if min(scatter, least) < max(_FACTOR * reported, _LEAST_M):
        return
    n = sum(map(len, windows))
    figure = Figure(scatter, scatter / math.sqrt(n))
    scale = min(float(f"{section.sigma_scale * scatter / reported:.2g}"), _MOST_SCALE)
    text = (
        f"GNSS positions scatter by {scatter:.2g} m about the wheels' path, {scatter / reported:.2g} times the "
        f"{reported:.2g} m that their covariance says: most would be refused, or drag the robot along"
    )
    found.add("gnss.sigma", text, {"gnss.sigma_scale": scale}, figure)


def _left(path: Path, rows: FloatArray) -> Iterator[FloatArray]:
    """Residuals [m] of the positions in each window about the wheels' path, scaled up for its fitted unknowns."""
    first, last = max(path.times[0], rows[0, 0]), min(path.times[-1], rows[-1, 0])
    length = min(_LONGEST_S, max((last - first) / _FEWEST_WINDOWS, 1.0))
    for k in range(int((last - first) / length + 1e-6)):
        began = first + k * length
        own = rows[(rows[:, 0] >= began) & (rows[:, 0] < began + length)]
        own = own[path.known(np.full(len(own), began), own[:, 0])]
        if len(own) < _FEWEST:
            continue
        poses = path.at(own[:, 0])
        z, yaw = poses[:, 0] + 1j * poses[:, 1], poses[:, 2] - poses[0, 2]
        A = np.column_stack([np.ones(len(z)), z - z[0], np.exp(1j * yaw)])
        measured = own[:, 1] + 1j * own[:, 2]
        solution, _, rank, _ = np.linalg.lstsq(A, measured, rcond=1e-6)
        off = (measured - A @ solution) / math.sqrt(1.0 - min(int(rank), _UNKNOWNS) / len(z))
        yield np.concatenate([off.real, off.imag])
