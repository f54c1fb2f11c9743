"""Which given values of the installation a run contradicts, in sentences with the line to be set.

A careful installation is off by its prior sigmas, and finding that is what the state is for: it is no reason to write.
Reported is what the measurements alone have further off than three sigmas of the two together (`Setting.off`), and
what was found further off than three of its own: of 20 parameters of a careful installation one in every 19 runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fgloc.stats import SURE_SIGMAS
from fgloc.types import InstallationFound, Setting

_SURE_2 = 11.8  # χ² of two degrees of freedom, as rare as three sigmas of one
_MOST_NAMED = 5  # landmarks


def contradictions(found: InstallationFound) -> tuple[str, ...]:
    """A sentence for every given value that is contradicted, one for all landmarks; clocks: `clock_trials`."""
    off = [s for s in found.settings if not s.name.startswith("stamp_offset_s.") and contradicted(s)]
    sentences = [f"{s.name} is {_number(s)}, {s.given:.6g} was given: set {_line(s)}." for s in off]
    return (*sentences, *_landmarks(found))


def contradicted(s: Setting) -> bool:
    """Whether what was found is surely further from what was given than that may be off."""
    return abs(s.off) > SURE_SIGMAS and abs(s.found - s.given) > SURE_SIGMAS * s.sigma


def _landmarks(found: InstallationFound) -> Iterator[str]:
    """Landmarks that stand elsewhere, in the plane."""
    index = {name: i for i, name in enumerate(found.names)}
    off: list[tuple[float, int]] = []
    for i in found.landmarks.landmarks if found.landmarks is not None else ():
        rows = [index[name] for name in (f"map.{i}.x_m", f"map.{i}.y_m") if name in index]
        if not rows:
            continue
        d = found.mean[rows]
        sizes = [float(d @ np.linalg.solve(cov[np.ix_(rows, rows)], d)) for cov in (found.cov, found.prior_cov)]
        if min(sizes) > _SURE_2:
            off.append((math.hypot(*d), i))
    if off:
        named = ", ".join(f"{i} ({1e3 * m:.0f} mm)" for m, i in sorted(off, reverse=True)[:_MOST_NAMED])
        more = f" and {len(off) - _MOST_NAMED} more" if len(off) > _MOST_NAMED else ""
        yield f"Landmarks do not stand where the map has them: {named}{more}; take the run's map.yaml or survey them."


def _line(s: Setting) -> str:
    if s.name.split(".")[1] in ("x", "y", "z", "roll", "pitch", "yaw"):
        return "recording.sightings_pose, as the run's installation.yaml has it"
    return f"{s.name}: {s.found:.5g}"


def _number(s: Setting) -> str:
    return f"{s.found:.5g} ± {s.sigma:.2g}"
