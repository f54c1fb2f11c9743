"""What a run has to say of itself, gravest first: mistakes, warnings, notes, each with the setting to change."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from fgloc.evaluation.metrics import Metrics
    from fgloc.types import RunResult

_MOST_NEES = 3.0  # NEES/3: errors of √3 = 1.7 times what the covariance says; sound runs as installed stay below 2
_MOST_DROPPED = 0.2  # share of a sensor's messages
_FEWEST = 20  # dropped ones
_GRAVE = re.compile(r"another (frame|clock)|is damaged|cannot be decoded|perhaps degrees")
_SIGMAS = {"camera": "position_sigma_m", "landmarks": "range_scale_sigma", "wheels": "scale_sigma"}  # by section
_SETTINGS = {  # of a sensor whose messages are dropped
    "odometry": "gate.max_speed, gate.max_yaw_rate or recording.received_stamps",
    "joints": "gate.max_wheel_rate or recording.received_stamps",
    "command": "gate.max_speed, gate.max_yaw_rate",
    "imu": "gate.max_yaw_rate or recording.received_stamps",
    "image": "camera.file, recording.topics.image",
    "sightings": "markers.sigma_px, map.position_sigma_m, gate.max_range",
}


class Remark(NamedTuple):
    """A sentence and how grave it is."""

    kind: str  # "mistake", "warning" or "note"
    text: str


def remarks(result: RunResult, metrics: Metrics) -> list[Remark]:
    """All remarks on a run, the gravest first; among notes, those that name a setting."""
    found = [Remark("mistake", text) for text in result.mistakes]
    found += [Remark("warning", text) for text in _warnings(result, metrics)]
    notes = [text for text in result.notes if text not in result.mistakes]
    found += [Remark("warning", text) for text in notes if _GRAVE.search(text)]
    setting = _setting_names()
    rest = sorted((text for text in notes if not _GRAVE.search(text)), key=lambda text: not setting.search(text))
    return found + [Remark("note", text) for text in rest]


def _warnings(result: RunResult, metrics: Metrics) -> Iterator[str]:
    nees = metrics.nees_over_3
    if nees is not None and nees > _MOST_NEES:
        yield (
            f"NEES/3 is {nees:.1f}, expected about 1: the errors are {nees**0.5:.1f} times what the covariance says. "
            "Something is off by more than its sigma: see what the report judged wrong, and raise "
            f"{_prior_sigmas(result)} to what your installation really is"
        )
    dropped: Counter[str] = Counter()
    for reason, count in metrics.rejections.items():
        dropped[reason.partition(".")[0]] += count
    most = max((topic.count for topic in result.spans.values()), default=0)
    for sensor, count in dropped.most_common():
        if sensor not in _SETTINGS:
            continue
        received = metrics.keyframes if sensor in ("image", "sightings") else most
        if count >= _FEWEST and count > _MOST_DROPPED * max(received, count):
            reasons = ", ".join(f"{r} {n}" for r, n in metrics.rejections.items() if r.startswith(f"{sensor}."))
            yield f"{count} messages of {sensor} were dropped ({reasons}); look at {_SETTINGS[sensor]}"


def _prior_sigmas(result: RunResult) -> str:
    """The settings that say how far off this run's installation may be."""
    found = [] if result.found is None else [s.name for s in result.found.settings]
    names = [f"{section}.{key}" for section, key in _SIGMAS.items() if any(n.startswith(f"{section}.") for n in found)]
    names = ["map.position_sigma_m"] * (result.found is not None and result.found.landmarks is not None) + names
    return " or ".join(names or ["wheels.scale_sigma"])


def _setting_names() -> re.Pattern[str]:
    from fgloc.config import Config

    return re.compile(rf"\b({'|'.join(Config.model_fields)})\.[a-z_]+")
