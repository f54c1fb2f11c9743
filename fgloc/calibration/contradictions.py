"""Which given values of the installation a run contradicts, in sentences with the line to be set.

A careful installation is off by its prior sigmas, and finding that is what the state is for: it is no reason to write.
Reported is what the measurements alone have further off than three sigmas of the two together (`Setting.off`), and
what was found further off than three of its own: of 20 parameters of a careful installation one in every 19 runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from fgloc.calibration.settings import settings_found
from fgloc.config import Config
from fgloc.graph.contradictions import Contradiction, Rival
from fgloc.stats import PRIOR_GATE, ROUNDING, SURE_SIGMAS
from fgloc.types import Finding, FloatArray, InstallationFound, Setting, Severity, note

_SURE_2 = 11.8  # χ² of two degrees of freedom, as rare as three sigmas of one
CODES = ("installation.contradiction", "installation.off", "map.moved")
_WHEELS = ("joints", "odometry")  # a robot follows its commands late: that is no clock's fault
_LATE_S = 0.03  # less is within what drivers mean by a stamp
_MOST_NAMED = 5  # landmarks
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_NOT_COMPARED = "; `fgloc smooth` compares what explains it."
_UNEXPLAINED = ". No constant alone explains it: look for a wrong axis, sign, unit or clock."


def contradictions(found: InstallationFound, config: Config) -> list[Finding]:
    """One finding for every given value that is contradicted, one for all landmarks.

    What was found is used, as it is within the gate of its prior; what is not: `contradiction_findings`.
    """
    off = [s for s in found.settings if contradicted(s)]
    findings = [
        Finding(
            CODES[1],
            f"{s.name} is {_number(s)}, {s.given:.6g} was given: set {_line(s)}.",
            Severity.WARNING,
            _lines([s]),
            s.found,
            s.sigma,
        )
        for s in off
        if not _is_clock(s)
    ]
    clocks = [s for s in off if _is_clock(s) and abs(s.unpulled) > _LATE_S] if found.wheels in _WHEELS else []
    return [*findings, *_clocks(clocks, config), *note(CODES[2], _landmarks(found), Severity.WARNING)]


def _clocks(off: Sequence[Setting], config: Config) -> Iterator[Finding]:
    """Clocks that are late or early; all of them to one side: the gyro's, which they are compared to."""
    late = {s.name.split(".")[1]: (s.given, -s.unpulled, s.sigma) for s in off}
    if len(off) > 1 and len({s.unpulled > 0.0 for s in off}) == 1:
        mean = sum(s.unpulled for s in off) / len(off)
        given = {str(r): offset for r, offset in config.recording.stamp_offset_s.items()}.get("imu", 0.0)
        late = {"imu": (given, mean, max(s.sigma for s in off))}
    for role, (given, late_s, sigma) in late.items():
        text = (
            f"The stamps of {role} are {abs(late_s):.3f} ± {sigma:.3f} s {'late' if late_s > 0.0 else 'early'} against "
            f"the others: set recording.stamp_offset_s: {{{role}: {given - late_s:.3f}}}, or correct the others."
        )
        lines = {"recording.stamp_offset_s": f"{{{role}: {given - late_s:.3f}}}"}
        yield Finding(f"clock.{role}", text, Severity.WARNING, lines, late_s, sigma)


def contradiction_findings(
    found: InstallationFound, contradiction: Contradiction | None, config: Config
) -> list[Finding]:
    """The finding about constants that are beyond the gate of their prior, with what explains it; at most one.

    Args:
        found: the installation as it was used.
        contradiction: of the run.
        config: as the run used it.
    """
    if contradiction is None:
        return []
    names, rivals = _listed(s.name for s in _settings(found, contradiction.names, config)), contradiction.rivals
    text = (
        f"The recording contradicts what was given of {names} by more than {PRIOR_GATE:g} sigmas, and it was not used"
    )
    if rivals is None:
        return [Finding(CODES[0], f"{text}{_NOT_COMPARED}", Severity.ERROR)]
    if not rivals:
        return [Finding(CODES[0], f"{text}{_UNEXPLAINED}", Severity.ERROR)]
    options = [_told(found, rival, config) for rival in rivals]
    lines = _lines(options[0]) if len(rivals) == 1 and rivals[0].sensible else {}
    shown = " or ".join(" with ".join(f"{s.name} {_number(s)}" for s in option) for option in options)
    if lines:
        told = f"{text}: {shown} explains it best. Set {', '.join(f'{key}: {value}' for key, value in lines.items())}."
    elif len(rivals) > 1:
        told = f"{text}: {shown} explain it alike, and the data cannot tell which."
    else:
        told = (
            f"{text}: {shown} would explain it, which is no installation. Look for a wrong axis, sign, unit or clock."
        )
    value = (options[0][0].found, options[0][0].sigma) if len(rivals) == 1 else (None, None)
    return [Finding(CODES[0], told, Severity.ERROR, lines, *value)]


def _told(found: InstallationFound, rival: Rival, config: Config) -> list[Setting]:
    return _settings(found, rival.names, config, rival.mean, rival.sigmas)


def _settings(
    found: InstallationFound,
    names: Sequence[str],
    config: Config,
    mean: FloatArray | None = None,
    sigmas: FloatArray | None = None,
) -> list[Setting]:
    """Settings that these constants alone change; without values, by one prior sigma each."""
    every = (*found.names, *(name for name in names if name not in found.names))
    rows, n = [every.index(name) for name in names], len(every)
    prior = np.eye(n)
    prior[: len(found.names), : len(found.names)] = found.prior_cov
    theta, cov = np.zeros(n), np.zeros((n, n))
    theta[rows] = np.sqrt(np.diag(prior)[rows]) if mean is None else mean
    cov[rows, rows] = 0.0 if sigmas is None else sigmas**2
    state = replace(found, names=every, mean=theta, cov=cov, prior_cov=prior)
    return [s for s in settings_found(state, config) if abs(s.found - s.given) > ROUNDING]


def _lines(settings: Sequence[Setting]) -> dict[str, str]:
    """Keys of ``robot.yaml`` with the values of these settings; the camera's pose is in the run's installation.yaml."""
    lines: dict[str, str] = {}
    for s in settings:
        section, key = s.name.split(".")
        if section == "stamp_offset_s":
            lines["recording.stamp_offset_s"] = f"{{{key}: {s.found:.3f}}}"
        elif key not in _AXES:
            lines[s.name] = f"{s.found:.5g}"
    return lines


def _listed(names: Iterable[str]) -> str:
    every = list(names)
    return " and ".join([", ".join(every[:-1]), every[-1]] if len(every) > 1 else every)


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


def _is_clock(s: Setting) -> bool:
    return s.name.startswith("stamp_offset_s.")


def _line(s: Setting) -> str:
    if s.name.split(".")[1] in _AXES:
        return "recording.sightings_pose, as the run's installation.yaml has it"
    return f"{s.name}: {s.found:.5g}"


def _number(s: Setting) -> str:
    return f"{s.found:.5g} ± {s.sigma:.2g}"
