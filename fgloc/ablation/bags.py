"""Batch smoothing of many bags: each is a job of a sweep, with a folder for all files of its run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fgloc.ablation.jobs import Job, make_jobs
from fgloc.ablation.suite import NOTHING, Cell
from fgloc.config import Config
from fgloc.errors import ConfigError, FglocError
from fgloc.recording.storage import find_beside

_TAKEN = {"jobs"}  # the sweep's own folder


@dataclass(frozen=True, slots=True)
class Plan:
    """What is to be done with each bag.

    Attributes:
        names: folders of the bags, in their order.
        jobs: of the bags that can be tried.
        errors: of the others, by name.
    """

    names: tuple[str, ...]
    jobs: tuple[Job, ...]
    errors: dict[str, str]


def plan_bags(bags: Sequence[Path], map_file: Path | None, configure: Callable[[Path], Config], command: str) -> Plan:
    """One job per bag. A bag that is missing, or whose configuration is wrong, is noted and does not stop the others.

    Args:
        bags: recordings.
        map_file: for all; None: the map beside each bag.
        configure: the configuration for a bag.
        command: what the user typed, for the results.

    Raises:
        ConfigError: a bag is given twice.
    """
    names = folder_names(bags)
    cells: list[Cell] = []
    errors: dict[str, str] = {}
    for name, bag in zip(names, bags, strict=True):
        try:
            if not bag.exists():
                raise ConfigError(f"{bag}: does not exist; expected a ROS 1 .bag, a rosbag2 folder, an .mcap or a .db3")
            config = configure(bag)
        except FglocError as error:
            errors[name] = str(error)
            continue
        cells.append(
            Cell(
                recording=name,
                variant="",
                failure=NOTHING,
                severity=None,
                seed=0,
                bag=bag,
                map=map_file or find_beside(bag, "map.yaml"),
                config_file=None,
                config=config,
                mode="batch",
                start="configured",
                chain=(),
            )
        )
    jobs = make_jobs(cells, {name: name for name in names}, command)
    return Plan(tuple(names), tuple(jobs), errors)


def folder_names(bags: Sequence[Path]) -> list[str]:
    """A folder name for each bag: its own, with the names of as many folders above as it takes to differ.

    Raises:
        ConfigError: a bag is given twice.
    """
    whole = [bag.resolve() for bag in bags]
    twice = [path for path, n in Counter(whole).items() if n > 1]
    if twice:
        raise ConfigError(f"{twice[0]}: given twice; give each recording once")
    depths = [1] * len(whole)
    while True:
        names = [_name(path, depth) for path, depth in zip(whole, depths, strict=True)]
        count = Counter(names)
        clash = [i for i, name in enumerate(names) if count[name] > 1 or name in _TAKEN]
        deeper = [i for i in clash if depths[i] < len(whole[i].parts) - 1]
        if not deeper:
            break
        for i in deeper:
            depths[i] += 1
    return [f"{name}_{k}" if count[name] > 1 or name in _TAKEN else name for k, name in enumerate(names, start=1)]


def _name(path: Path, depth: int) -> str:
    stem = path.name if path.is_dir() else path.stem
    return "_".join([*path.parts[-depth:-1], stem])
