"""A suite file: recordings × failures × severities × variants × seeds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from fgloc.ablation.failures import AnyFailure
from fgloc.config import Config, Section, config_of, config_type, load_config, robot_file
from fgloc.errors import ConfigError
from fgloc.files.settings import Settings, joined, merged, refuse_misplaced, sentences
from fgloc.recording.storage import find_beside, refuse_repeats
from fgloc.replay import RunMode

_MOST_RUNS = 1_000_000
_WHEN = {"when.burst_s": "duration", "when.share": "share of the messages"}
_UNITS = {"s", "ms", "m", "mm", "rad", "deg", "px", "ticks", "hz"}
_Seed = Annotated[int, Field(ge=0, lt=2**32)]
_Severity = Annotated[float, Field(ge=-1e6, le=1e6)]


class RecordingEntry(Section):
    """One recording. Paths are relative to the suite file; map and config default to those beside the bag."""

    name: str
    bag: Path
    map: Path | None = None
    config: Path | None = None
    settings: dict[str, Any] = Field({}, description="what differs from its configuration, for all variants")


class Variant(Section):
    """One way to run the localizer."""

    name: str
    config: dict[str, Any] = Field({}, description="what differs from the recording's configuration")
    mode: RunMode | None = Field(None, description="None: the suite's")
    start: Literal["configured", "truth"] = Field(
        "configured", description="truth: the run starts at the truth's first pose; for dead reckoning"
    )


class Severity(Section):
    """A number of a failure that is varied."""

    field: str = Field(description="of the chain's first failure; a dot leads into 'when', such as when.burst_s")
    values: tuple[_Severity, ...] = Field(min_length=1)
    unit: str = ""
    label: str = Field("", description="of the axis; empty: made of the field's name")

    @property
    def axis(self) -> str:
        """Label of the varied quantity, with its unit."""
        name = self.label or _words(self.field)
        return f"{name} [{self.unit}]" if self.unit else name


def _words(field: str) -> str:
    """A name such as ``distance_m`` in words: without its unit."""
    if field in _WHEN:
        return _WHEN[field]
    name = field.rpartition(".")[2]
    stem, _, unit = name.rpartition("_")
    return (stem if stem and unit in _UNITS else name).replace("_", " ")


class FailureEntry(Section):
    """A named chain of failures."""

    name: str
    chain: tuple[AnyFailure, ...] = Field(min_length=1)
    severity: Severity | None = None

    @model_validator(mode="after")
    def _severities_fit(self) -> FailureEntry:
        for _ in self.severities():
            pass
        return self

    @property
    def nothing_at_zero(self) -> bool:
        """Whether severity 0 is the run without failure; False if not known."""
        first = self.chain[0]
        if self.severity is None or len(self.chain) > 1:
            return False
        field = self.severity.field
        if field in _WHEN:
            return field == "when.share" or not first.when.intervals
        return field in first.sizes and not any(np.any(getattr(first, name)) for name in {*first.sizes} - {field})

    def severities(self) -> Iterator[tuple[float | None, tuple[AnyFailure, ...]]]:
        """Each severity with its chain; a failure without any gives one, None."""
        if self.severity is None:
            yield None, self.chain
            return
        first, rest = self.chain[0], self.chain[1:]
        for value in self.severity.values:
            content = first.model_dump()
            target: dict[str, Any] = content
            path = self.severity.field.split(".")
            for name in path[:-1]:
                inner = target.get(name)
                target = inner if isinstance(inner, dict) else {}
            if path[-1] not in target:
                raise ValueError(f"{first.kind} has no number '{self.severity.field}' to be varied")
            whole = isinstance(target[path[-1]], int) and value == int(value)
            target[path[-1]] = int(value) if whole else value
            yield value, (type(first).model_validate(content), *rest)


class Suite(Section):
    """An ablation."""

    title: str
    mode: RunMode = "online"
    seeds: tuple[_Seed, ...] = Field((0,), min_length=1, description="of random failures")
    recordings: tuple[RecordingEntry, ...] = Field(min_length=1)
    variants: tuple[Variant, ...] = Field((Variant(name="full"),), min_length=1)
    failures: tuple[FailureEntry, ...] = ()

    @model_validator(mode="after")
    def _names_differ(self) -> Suite:
        for entries in (self.recordings, self.variants, self.failures):
            names = [entry.name for entry in entries]
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"the name '{twice[0]}' is used twice")
        if NOTHING in {entry.name for entry in self.failures}:
            raise ValueError(f"'{NOTHING}' is run without being listed")
        return self


NOTHING = "none"
"""The failure that is none: every recording and variant is run without failure too, to compare with."""


class Cell(Section):
    """One run of a suite, with all that it needs, and its place in the report."""

    recording: str
    variant: str = ""
    failure: str = NOTHING
    severity: float | None = None
    seed: int = 0
    bag: Path
    map: Path | None
    config_file: Path | None = None
    config: Config
    mode: RunMode
    start: Literal["configured", "truth"] = "configured"
    chain: tuple[AnyFailure, ...] = ()


def load_suite(path: Path) -> Suite:
    """Read a suite file.

    Raises:
        ConfigError: the file is missing, is not YAML, or has an unknown key or a wrong value; all are named.
    """
    suite = Settings(path, "give a suite file").validated(Suite)
    each = sum(1 for failure in suite.failures for _ in failure.severities())
    runs = len(suite.recordings) * len(suite.variants) * (1 + each * len(suite.seeds))
    if runs > _MOST_RUNS:
        raise ConfigError(f"{path}: asks for {runs} runs, expected at most {_MOST_RUNS}; split it")
    return suite


def expand(suite: Suite, folder: Path) -> list[Cell]:
    """All runs of a suite. Without failure there is nothing to draw: then the first seed stands for all.

    Args:
        suite: from `load_suite`.
        folder: that relative paths refer to, the suite file's.

    Raises:
        ConfigError: a recording, map or configuration is missing, or a variant's configuration is wrong.
        RecordingError: two entries that differ by nothing else have the same recording.
    """
    _refuse_repeats(suite, folder)
    cells = []
    for entry, variant in product(suite.recordings, suite.variants):
        bag = folder / entry.bag
        if not bag.exists():
            raise ConfigError(f"{bag}: recording '{entry.name}' is missing; make it, or take it out of the suite")
        map_file = folder / entry.map if entry.map is not None else find_beside(bag, "map.yaml")
        config_file = folder / entry.config if entry.config is not None else find_beside(bag, "robot.yaml")
        base = config_of({}) if config_file is None else load_config(config_file)
        common = dict(
            recording=entry.name,
            variant=variant.name,
            bag=bag,
            map=map_file,
            config_file=config_file,
            config=_varied(base, entry, variant, folder),
            mode=variant.mode or suite.mode,
            start=variant.start,
        )
        cells.append(Cell(**common, seed=suite.seeds[0]))
        for failure, seed in product(suite.failures, suite.seeds):
            for severity, chain in failure.severities():
                cells.append(Cell(**common, failure=failure.name, severity=severity, seed=seed, chain=chain))
    return cells


def _refuse_repeats(suite: Suite, folder: Path) -> None:
    alike: dict[str, list[RecordingEntry]] = defaultdict(list)
    for entry in suite.recordings:
        alike[entry.model_dump_json(exclude={"name", "bag"})].append(entry)
    for entries in alike.values():
        refuse_repeats([folder / entry.bag for entry in entries], [entry.name for entry in entries])


def _varied(base: Config, entry: RecordingEntry, variant: Variant, folder: Path) -> Config:
    content = merged(merged(base.model_dump(), joined(entry.settings)), joined(variant.config))
    for section, key in (("camera", "file"), ("motion", "model")):
        part = content[section]
        if isinstance(part, dict) and isinstance(part.get(key), str):  # of the suite; the base's are paths already
            content[section] = part | {key: folder / part[key]}
    try:
        for change in (entry.settings, variant.config):
            refuse_misplaced(change, config_type())
            robot_file().model_validate(change)
        return config_of(content)
    except (ValidationError, ConfigError) as error:
        given = merged(entry.settings, variant.config)
        lines = sentences(error, robot_file(), given) if isinstance(error, ValidationError) else str(error).splitlines()
        raise ConfigError(
            "\n  ".join([f"variant '{variant.name}' of recording '{entry.name}': wrong configuration", *lines])
        ) from error
