"""Warnings that follow from the figures of a run: an optimistic covariance, and sensors whose messages were dropped."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping

from fgloc.config import Config
from fgloc.types import Finding, RunResult, Severity, ordered

_MOST_NEES = 3.0  # NEES/3: errors of √3 = 1.7 times what the covariance says; sound runs as installed stay below 2
_MOST_DROPPED = 0.2  # share of a sensor's messages
_FEWEST = 20  # dropped ones
_PRIOR = re.compile(r"(position|scale)_sigma")  # of a section's settings, the one that says most of its installation
_SETTINGS = {  # of a sensor whose messages are dropped
    "odometry": "gate.max_speed, gate.max_yaw_rate or recording.received_stamps",
    "joints": "gate.max_wheel_rate or recording.received_stamps",
    "command": "gate.max_speed, gate.max_yaw_rate",
    "imu": "gate.max_yaw_rate or recording.received_stamps",
    "image": "camera.file, recording.topics.image",
    "sightings": "markers.sigma_px, map.position_sigma_m, gate.max_range",
}


def all_findings(
    result: RunResult, nees_over_3: float | None, rejections: Mapping[str, int], keyframes: int
) -> tuple[Finding, ...]:
    """Findings of a run and the warnings by its figures, the gravest first.

    Args:
        result: the run.
        nees_over_3: mean normalised squared error over 3; None: there is no truth.
        rejections: rejected items by ``sensor.reason``.
        keyframes: number of poses.
    """
    warned = [*_optimistic(result, nees_over_3), *_dropped(result, rejections, keyframes)]
    return ordered([*result.findings, *warned])


def _optimistic(result: RunResult, nees: float | None) -> Iterator[Finding]:
    if nees is None or nees <= _MOST_NEES:
        return
    yield Finding(
        "covariance.optimistic",
        f"NEES/3 is {nees:.1f}, expected about 1: the errors are {nees**0.5:.1f} times what the covariance says. "
        "Something is off by more than its sigma: see the faults that the report lists, and raise "
        f"{_prior_sigmas(result)} to what your installation really is.",
        Severity.WARNING,
        value=nees,
    )


def _dropped(result: RunResult, rejections: Mapping[str, int], keyframes: int) -> Iterator[Finding]:
    dropped: Counter[str] = Counter()
    for reason, count in rejections.items():
        dropped[reason.partition(".")[0]] += count
    most = max((topic.count for topic in result.spans.values()), default=0)
    for sensor, count in dropped.most_common():
        if sensor not in _SETTINGS:
            continue
        received = keyframes if sensor in ("image", "sightings") else most
        if count >= _FEWEST and count > _MOST_DROPPED * max(received, count):
            reasons = ", ".join(f"{r} {n}" for r, n in rejections.items() if r.startswith(f"{sensor}."))
            too_fast = rejections.get("joints.wheel_rate_bound", 0) if sensor == "joints" else 0
            unit = " Angles that change so fast are ticks or degrees, not radians." if 2 * too_fast > count else ""
            yield Finding(
                f"{sensor}.dropped",
                f"{count} messages of {sensor} were dropped ({reasons}); look at {_SETTINGS[sensor]}.{unit}",
                Severity.WARNING,
                value=float(count),
            )


def _prior_sigmas(result: RunResult) -> str:
    """Settings that say how far off this run's installation may be."""
    found = result.found
    sections = [] if found is None else [setting.name.partition(".")[0] for setting in found.settings]
    if found is not None and found.landmarks is not None:
        sections.insert(0, "map")
    names = []
    for section in dict.fromkeys(sections):
        field = Config.model_fields.get(section)  # "stamp_offset_s" is of the clocks
        keys = () if field is None else getattr(field.annotation, "model_fields", ())
        names += [f"{section}.{key}" for key in keys if _PRIOR.search(key)][:1]
    return " or ".join(names) or "the sigmas of its settings"
