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
_PRIOR = re.compile(r"(position|scale)_sigma")  # of a section's settings, the one that says most of its installation
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
            "Something is off by more than its sigma: see the faults that the report lists, and raise "
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
    from fgloc.config import Config

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


def _setting_names() -> re.Pattern[str]:
    from fgloc.config import Config

    return re.compile(rf"\b({'|'.join(Config.model_fields)})\.[a-z_]+")
