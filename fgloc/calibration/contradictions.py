"""Which given values of the installation a run contradicts, in sentences with the line to be set.

A careful installation is off by its prior sigmas, and finding that is what the state is for: it is no reason to write.
Said is what is further off than three of them, surely (three of its own sigmas), and, of clocks, by what matters.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fgloc.config import Config
from fgloc.types import InstallationFound, Setting

_SURE = 3.0  # sigmas, of what was found and of what was given
_SURE_2 = 11.8  # χ² of two degrees of freedom, as rare as three sigmas of one
_LATE_S = 0.03  # less is within what drivers mean by a stamp
_MOST_NAMED = 5  # landmarks


def contradictions(found: InstallationFound, config: Config) -> tuple[str, ...]:
    """A sentence for every given value that is contradicted; clocks, and landmarks, share one."""
    clocks = [s for s in found.settings if s.name.startswith("stamp_offset_s.")]
    others = [s for s in found.settings if s not in clocks and contradicted(s)]
    said = [f"{s.name} is {_number(s)}, {s.given:.6g} was given: set {_line(s)}." for s in others]
    return (*said, *_clocks(clocks, config), *_landmarks(found))


def contradicted(s: Setting) -> bool:
    """Whether what was found is surely further from what was given than that may be off."""
    change = abs(s.found - s.given)
    return change > _SURE * s.sigma and change > _SURE * s.prior_sigma


def _clocks(clocks: list[Setting], config: Config) -> Iterator[str]:
    """Whose clock is wrong: the one that all others disagree with."""
    off = {s.name.split(".")[1]: s for s in clocks if contradicted(s) and abs(s.found - s.given) > _LATE_S}
    if not off:
        return
    gyro = any(s.name.endswith((".joints", ".odometry", ".command")) for s in clocks)
    change = {role: s.found - s.given for role, s in off.items()}
    spread = max(change.values()) - min(change.values())
    if gyro and len(clocks) > 1 and len(off) == len(clocks) and spread < _LATE_S:
        late, sigma = float(np.mean(list(change.values()))), max(s.sigma for s in off.values())
        given = config.recording.stamp_offset_s.get("imu", 0.0)
        yield _offset("imu", late, sigma, given - late, "all others, which agree")
        return
    for role, s in off.items():
        agree = " and ".join(["imu", *(s.name.split(".")[1] for s in clocks if s.name.split(".")[1] not in off)])
        against = agree if gyro else "the wheels (either clock may be wrong)"
        yield _offset(role, -change[role], s.sigma, s.found, against)


def _offset(role: str, late_s: float, sigma_s: float, setting_s: float, against: str) -> str:
    return (
        f"The stamps of {role} are {abs(late_s):.3f} ± {sigma_s:.3f} s {'late' if late_s > 0 else 'early'} against "
        f"{against}: set recording.stamp_offset_s: {{{role}: {setting_s:.3f}}}."
    )


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
