"""Suites: scenarios with their runs, read from YAML."""

from __future__ import annotations

from pathlib import Path

import yaml
from pydantic import Field, ValidationError

from datasets.sim.scenario import Control, Scenario, Section
from fgloc.errors import ConfigError

BUNDLED = Path(__file__).parent / "suite.yaml"


class Run(Section):
    """One recording of a scenario: a seed, and what differs from the scenario."""

    split: str = Field(pattern="^(train|validation|test|sample)$")
    seed: int = Field(ge=0)
    duration_s: float | None = Field(None, gt=0)
    control: Control | None = None


class Entry(Section):
    """A scenario and its runs."""

    scenario: Scenario
    runs: tuple[Run, ...]


class Suite(Section):
    """Several scenarios."""

    entries: tuple[Entry, ...]

    def find(self, name: str) -> Entry | None:
        """The scenario of this name."""
        return next((e for e in self.entries if e.scenario.name == name), None)


def resolve(entry: Entry, run: Run) -> Scenario:
    """The scenario of one run."""
    changes: dict[str, object] = {}
    if run.duration_s is not None:
        changes["duration_s"] = run.duration_s
    if run.control is not None:
        changes["control"] = run.control
    return entry.scenario.model_copy(update=changes)


def load_suite(path: Path) -> Suite:
    """Read a suite, or a single scenario as a suite of one without runs.

    Raises:
        ConfigError: no such file, no YAML, an unknown key or a value out of range; all are named.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error}") from error
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping with 'entries' (a suite) or the keys of a scenario")
    data.pop("anchors", None)
    try:
        if "entries" in data:
            return Suite.model_validate(data)
        return Suite(entries=(Entry(scenario=Scenario.model_validate(data), runs=()),))
    except ValidationError as error:
        lines = [f"  {'.'.join(str(p) for p in e['loc'])}: {e['msg']} (got {e['input']!r})" for e in error.errors()]
        raise ConfigError(f"{path}: {len(lines)} wrong value(s)\n" + "\n".join(lines)) from error
