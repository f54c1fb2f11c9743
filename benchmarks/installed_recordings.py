"""Recordings of `benchmarks.installed`: drives of the simulated suite by robots that are not quite as written.

They are kept as those of `benchmarks.adaptive_recordings` are, whose floors and control functions they take, with seeds
of their own that no setting was chosen on. In an ``installed`` recording every error of a careful installation is drawn
by the seed (`fgloc_datasets.sim.scenario`), and the floor's own error of the wheels is left out; ``map5mm`` errs in
the places of the markers only; ``perfect`` in nothing. The last two keep the wheels of `benchmarks.adaptive`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from benchmarks import adaptive_recordings
from benchmarks.adaptive_recordings import Change, Floor, Recorded, Split
from fgloc_datasets.sim.scenario import Installation, Scenario

Variant = Literal["installed", "map5mm", "perfect", "found"]
SEEDS: dict[Split, tuple[int, ...]] = {
    "validation": tuple(range(41, 46)),
    "test": tuple(range(61, 71)),
}
FOUND_S = 120.0  # how long a drive is from which the installation is to be found
_MAP_M = 0.005


@dataclass(frozen=True, slots=True, order=True)
class Take:
    """One recording."""

    variant: Variant
    floor: Floor
    split: Split
    seed: int


def installed(made: Scenario) -> Scenario:
    """The scenario with all errors of a careful installation, and none besides."""
    robot = made.robot.model_copy(update={"radius_scale": (1.0, 1.0)})
    return made.model_copy(update={"robot": robot, "installation": Installation.as_installed()})


def long(made: Scenario) -> Scenario:
    """The scenario as `installed` has it, with a longer drive."""
    return installed(made).model_copy(update={"duration_s": FOUND_S})


def map5mm(made: Scenario) -> Scenario:
    """The scenario with markers that hang some millimetres from where the map has them."""
    return made.model_copy(update={"installation": Installation(marker_position_m=_MAP_M)})


_CHANGES: dict[Variant, Change] = {
    "installed": installed,
    "map5mm": map5mm,
    "perfect": adaptive_recordings.unchanged,
    "found": long,
}


def prepare(takes: Iterable[Take]) -> None:
    """Record what is not yet there, in as many processes as there are cores.

    Raises:
        RenderError: there is no OpenGL.
        SimulationError: a run failed.
    """
    jobs = {t: adaptive_recordings.job(t.floor, t.split, t.seed, _CHANGES[t.variant]) for t in sorted(set(takes))}
    adaptive_recordings.record_missing(sorted(jobs.values(), key=lambda job: -job.scenario.duration_s))


def folder(take: Take) -> str:
    """Name of the recording's folder, which changes with its scenario."""
    return adaptive_recordings.job(take.floor, take.split, take.seed, _CHANGES[take.variant]).folder


def load(take: Take) -> Recorded:
    """One recording, made first if it is not there."""
    return adaptive_recordings.load(take.floor, take.split, take.seed, _CHANGES[take.variant])
