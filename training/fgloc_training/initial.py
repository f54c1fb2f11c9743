"""A training configuration for recordings of an own robot: split by recording, commented."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fgloc.config import Config
from fgloc.errors import ConfigError, RecordingError
from fgloc.recording.reader import Recording
from fgloc.types import ControlEvent

_WANTED_S = 600.0  # of driving in all, that training takes to know a robot


@dataclass(frozen=True, slots=True)
class Found:
    """What a recording holds for training."""

    bag: Path
    duration_s: float
    has_truth: bool
    fastest: tuple[float, float, float]  # commanded: forward, turning, backward [m/s, rad/s, m/s]


def look(bag: Path, config: Config) -> Found:
    """Read the commands of a recording.

    Raises:
        RecordingError: it cannot be read, or holds no commands.
    """
    with Recording(bag, config.recording) as recording:
        if "command" not in recording.roles:
            raise RecordingError(
                f"{bag}: no commands, which are what a model of motion reads; record the topic that drives the robot "
                "(geometry_msgs/Twist or TwistStamped), or name it: recording.topics.command in robot.yaml"
            )
        forward = turning = backward = 0.0
        for event in recording.events():
            if isinstance(event, ControlEvent):
                forward, backward = max(forward, event.v), max(backward, -event.v)
                turning = max(turning, abs(event.omega))
        return Found(bag, recording.duration_s, "truth" in recording.roles, (forward, turning, backward))


def missing(found: Sequence[Found]) -> list[str]:
    """What should still be recorded, in sentences."""
    sentences = []
    total = sum(f.duration_s for f in found)
    if total < _WANTED_S:
        sentences.append(
            f"{total / 60.0:.1f} min of driving in all: record ten minutes, turning both ways, stopping and starting"
        )
    if len(found) < 3:
        sentences.append("2 recordings train and validate, none is left to test: record a third")
    return sentences


def training_yaml(found: Sequence[Found], file: Path, robot: str = "my robot") -> str:
    """The configuration, for a file at this place. The last recordings test and validate, the others train.

    Raises:
        ConfigError: there is only one recording.
    """
    if len(found) < 2:
        raise ConfigError(
            f"got {len(found)} recording, expected three or more: some train, one validates, one tests. The split is "
            "by recording, never within one, or the model would be judged by what it has learned"
        )
    names = _names([f.bag for f in found])
    held = max(1, len(names) // 5)  # of each kind that does not train
    test = names[-held:] if len(names) > 2 else []
    rest = names[: len(names) - len(test)]
    train, validation = rest[:-held], rest[-held:]
    limits = [max(f.fastest[i] for f in found) for i in range(3)]
    lines = [
        "# Training of a motion model; every key with its default is in docs/identification.md.",
        f"#   fgloc train {file.name} --out models",
        f"robot: {robot}",
        "recordings:  # relative to this file",
        *(f"  {name}: {_relative(f.bag, file)}" for name, f in zip(names, found, strict=True)),
    ]
    without = [name for name, f in zip(names, found, strict=True) if not f.has_truth]
    if without:
        lines += [
            "# No positioning system is recorded: the smoothed trajectory is the truth. Make each first, with",
            "#   fgloc smooth BAG --out smoothed/NAME",
            "truth:",
            *(f"  {name}: smoothed/{name}" for name in without),
            "adaptation: {after_training_s: 60.0}  # a smoothed truth is right in the long run",
        ]
    lines += [
        "split:  # by recording, never within one",
        f"  train: [{', '.join(train)}]",
        f"  validation: [{', '.join(validation)}]  # says when to stop, and how sure the model may be",
        f"  test: [{', '.join(test)}]  # what the model is judged by; it learns nothing of them",
        "# The fastest commands of these recordings. Give the robot's own limits, and training says what was left out.",
        f"limits: {{v_mps: {limits[0] or 0.1:.3g}, omega_radps: {limits[1] or 0.1:.3g}, reverse_mps: {limits[2]:.3g}}}",
        "# On a floor where wheels slide, leave this out; elsewhere it cuts the jumps of a positioning system:",
        "# data: {max_sideways_mps: 0.02}",
    ]
    return "\n".join(lines) + "\n"


def _relative(path: Path, file: Path) -> str:
    return Path(os.path.relpath(path.resolve(), file.resolve().parent)).as_posix()


def _names(bags: Iterable[Path]) -> list[str]:
    """A name for each: of the file, or of the folder around a bag that is called bag; numbered if they repeat."""
    names: list[str] = []
    for bag in bags:
        path = bag.resolve()
        name = path.parent.name if path.stem in ("bag", "rosbag2") else path.stem
        name = "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "run"
        names.append(name if name not in names else f"{name}_{len(names)}")
    return names
