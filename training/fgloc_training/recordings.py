"""Recordings of an own robot before a training: their configuration, commented, and the speeds they cover."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fgloc.config import Config
from fgloc.errors import ConfigError, RecordingError
from fgloc.recording.reader import Recording
from fgloc.sensors.commands import told
from fgloc.types import ControlEvent, FloatArray
from fgloc_training.config import SpeedLimits
from fgloc_training.data import Run
from fgloc_training.evaluate import save

# --- First configuration ----------------------------------------------------------------------------------------------

_WANTED_MIN = 10.0  # of driving in all, that training takes to know a robot


@dataclass(frozen=True, slots=True)
class Found:
    """Facts of a recording that matter for training."""

    bag: Path
    duration_s: float
    has_truth: bool
    fastest: tuple[float, float, float]  # commanded: forward, turning, backward [m/s, rad/s, m/s]
    sideways: float = 0.0  # commanded to either side, of a drive that goes there [m/s]


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
        forward = turning = backward = sideways = 0.0
        drive = config.wheels.drive
        for event in recording.events():
            if isinstance(event, ControlEvent):
                command = told(event, drive)
                forward, backward = max(forward, command.v), max(backward, -command.v)
                turning = max(turning, abs(command.omega))
                sideways = max(sideways, abs(command.vy) if drive is not None and drive.slides else 0.0)
        fastest = forward, turning, backward
        return Found(bag, recording.duration_s, "truth" in recording.roles, fastest, sideways)


def missing(found: Sequence[Found]) -> list[str]:
    """Recordings that are still needed, one sentence each."""
    sentences = []
    minutes = round(sum(f.duration_s for f in found) / 60.0, 1)  # as it is told
    if minutes < _WANTED_MIN:
        sentences.append(
            f"{minutes:.1f} min of driving in all: record ten minutes, turning both ways, stopping and starting"
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
            f"got {len(found)} recording, expected 2 or more: one validates, others train, and of 3 or more one "
            "tests. The split is by recording, never within one, or the model would be judged by what it has learned"
        )
    names = _names([f.bag for f in found])
    held = max(1, len(names) // 5)  # of each kind that does not train
    test = names[-held:] if len(names) > 2 else []
    rest = names[: len(names) - len(test)]
    train, validation = rest[:-held], rest[-held:]
    limits = [max(f.fastest[i] for f in found) for i in range(3)]
    sideways = any(f.sideways > 0.0 for f in found)
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
        *(["network: {inputs: [commands, sideways]}  # this drive is commanded to the side too"] if sideways else []),
        "# On a floor where wheels slide, leave this out; elsewhere it cuts the jumps of a positioning system:",
        "# data: {max_sideways_mps: 0.02}",
    ]
    return "\n".join(lines) + "\n"


def _relative(path: Path, file: Path) -> str:
    return Path(os.path.relpath(path.resolve(), file.resolve().parent)).as_posix()


def _names(bags: Iterable[Path]) -> list[str]:
    """Name for each bag: of its file, or of the folder around a bag called bag or rosbag2; numbered if they repeat."""
    names: list[str] = []
    for bag in bags:
        path = bag.resolve()
        name = path.parent.name if path.stem in ("bag", "rosbag2") else path.stem
        name = "".join(c if c.isalnum() or c in "_-" else "_" for c in name) or "run"
        names.append(name if name not in names else f"{name}_{len(names)}")
    return names


# --- Coverage of the speeds -------------------------------------------------------------------------------------------

_BINS_V, _BINS_OMEGA = 4, 7  # odd, so that straight ahead is a range of its own
ENOUGH_S = 5.0  # in a range of one speed or of both


@dataclass(frozen=True, slots=True)
class Controls:
    """Seconds for which speeds were commanded, in ranges between the robot's limits."""

    v_edges: FloatArray  # (a + 1,) m/s
    omega_edges: FloatArray  # (b + 1,) rad/s
    seconds: FloatArray  # (a, b)
    commanded: FloatArray  # (n, 2) v, ω at each sample
    limits: SpeedLimits | None

    def missing(self) -> list[str]:
        """Ranges of speed of which the recordings hold too little, a phrase each; empty if no limits are known."""
        if self.limits is None:
            return []
        found = []
        for edges, seconds, name, unit in (
            (self.v_edges, self.seconds.sum(axis=1), "v", "m/s"),
            (self.omega_edges, self.seconds.sum(axis=0), "ω", "rad/s"),
        ):
            for (low, high), spent in zip(pairwise(edges), seconds, strict=True):
                if spent < ENOUGH_S:
                    found.append(f"{name} from {low:.2g} to {high:.2g} {unit}: {spent:.1f} s, want {ENOUGH_S:.0f} s")
        for side, fast in (("left", self.commanded[:, 1]), ("right", -self.commanded[:, 1])):
            both = (self.commanded[:, 0] > 0.5 * self.limits.v_mps) & (fast > 0.5 * self.limits.omega_radps)
            spent = self.seconds.sum() * float(both.mean())
            if spent < ENOUGH_S:
                found.append(
                    f"fast and turning {side} (v over {0.5 * self.limits.v_mps:.2g} m/s, |ω| over "
                    f"{0.5 * self.limits.omega_radps:.2g} rad/s): {spent:.1f} s, want {ENOUGH_S:.0f} s"
                )
        return found


def controls(runs: list[Run], limits: SpeedLimits | None) -> Controls:
    """Count the seconds for which speeds were commanded while there was a truth.

    Args:
        runs: those that train.
        limits: of the robot; None: the ranges end at the largest commands.
    """
    commanded, seconds = [], []
    for run in runs:
        commanded.append(run.track.means(np.append(run.times, len(run.poses) * run.dt_s))[run.valid])
        seconds.append(np.full(len(commanded[-1]), run.dt_s))
    commands, weights = np.concatenate(commanded), np.concatenate(seconds)
    if limits is None:
        lowest, (v, omega) = min(0.0, float(commands[:, 0].min())), np.maximum(1e-3, np.abs(commands).max(axis=0))
    else:
        lowest, v, omega = -limits.reverse_mps, limits.v_mps, limits.omega_radps
    edges = np.linspace(lowest, v, _BINS_V + 1), np.linspace(-omega, omega, _BINS_OMEGA + 1)
    inside = np.clip(commands, [lowest, -omega], [v, omega])
    counted, _, _ = np.histogram2d(inside[:, 0], inside[:, 1], bins=list(edges), weights=weights)
    return Controls(*edges, counted, commands, limits)


def draw_controls(path: Path, found: Controls) -> None:
    """Commands as points over the seconds in each range; ranges with too few of them are hatched."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    axes = figure.subplots()
    image = axes.pcolormesh(
        found.omega_edges, found.v_edges, np.log10(np.maximum(found.seconds, 0.1)), cmap="Blues", vmin=-1.0
    )
    for i, j in np.argwhere(found.seconds < ENOUGH_S):
        (left, right), (low, high) = found.omega_edges[j : j + 2], found.v_edges[i : i + 2]
        axes.fill([left, right, right, left], [low, low, high, high], fill=False, hatch="//", color="C3", alpha=0.4)
    axes.plot(found.commanded[:, 1], found.commanded[:, 0], ".", color="0.2", markersize=1.5)
    for i, row in enumerate(found.seconds):
        for j, spent in enumerate(row):
            middle = 0.5 * (found.omega_edges[j] + found.omega_edges[j + 1]), 0.5 * sum(found.v_edges[i : i + 2])
            box = {"facecolor": "white", "alpha": 0.7, "edgecolor": "none", "pad": 1.0}
            axes.text(*middle, f"{spent:.0f} s", ha="center", va="center", fontsize=8, bbox=box)
    figure.colorbar(image, label="log10 of seconds")
    limits = "the robot's limits" if found.limits is not None else "the largest commands"
    axes.set(title=f"Commands up to {limits}; hatched: under {ENOUGH_S:.0f} s")
    axes.set(xlabel="ω [rad/s]", ylabel="v [m/s]")
    save(figure, path)
