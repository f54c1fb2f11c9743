"""Suites: scenarios with their runs, read from YAML and recorded side by side."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from fgloc.errors import ConfigError, FglocError
from fgloc.files.settings import Settings
from fgloc.instrumentation import counted
from fgloc_datasets.sim.physics import SimulationError
from fgloc_datasets.sim.record import is_recorded, record
from fgloc_datasets.sim.scenario import Control, Scenario
from fgloc_datasets.sim.section import Section

BUNDLED = Path(__file__).parent / "suite.yaml"


class Run(Section):
    """One recording of a scenario: a seed, and what differs from the scenario."""

    split: Literal["train", "validation", "test"]
    seed: int = Field(ge=0)
    duration_s: float | None = Field(None, gt=0)
    control: Control | None = None


class Entry(Section):
    """A scenario and its runs."""

    scenario: Scenario
    runs: tuple[Run, ...] = ()


class Suite(Section):
    """Several scenarios."""

    entries: tuple[Entry, ...]

    def find(self, name: str) -> Scenario:
        """The scenario of this name.

        Raises:
            ConfigError: there is none; those that there are are listed.
        """
        for entry in self.entries:
            if entry.scenario.name == name:
                return entry.scenario
        names = ", ".join(e.scenario.name for e in self.entries)
        raise ConfigError(f"scenario '{name}' is not in the suite; it has {names}; or give a YAML file")

    def perfect(self) -> Suite:
        """The same scenarios where all is exactly as written."""
        entries = (
            entry.model_copy(update={"scenario": entry.scenario.model_copy(update={"installation": None})})
            for entry in self.entries
        )
        return Suite(entries=tuple(entries))


@dataclass(frozen=True, slots=True)
class Job:
    """One run to be recorded."""

    scenario: Scenario
    seed: int
    folder: str  # below the suite's
    split: str


def jobs(suite: Suite, longest_s: float | None = None) -> list[Job]:
    """All runs of a suite, longest first, each cut to ``longest_s``."""
    out = []
    for entry in suite.entries:
        for run in entry.runs:
            seconds = run.duration_s or entry.scenario.duration_s
            changes = {
                "duration_s": seconds if longest_s is None else min(seconds, longest_s),
                "control": run.control or entry.scenario.control,
            }
            scenario = entry.scenario.model_copy(update=changes)
            out.append(Job(scenario, run.seed, f"{scenario.name}/{run.split}_{run.seed}", run.split))
    return sorted(out, key=lambda job: -job.scenario.duration_s)


def record_suite(
    todo: list[Job], out: Path, camera: bool, workers: int, said: Callable[[str], None] = lambda _: None
) -> int:
    """Record runs in ``workers`` processes. Runs that ``out`` already holds are skipped, so a killed suite resumes.

    Args:
        todo: what to record.
        out: a folder for the suite; each run gets its own below it.
        camera: render images.
        workers: processes.
        said: told of each run that was recorded.

    Returns:
        How many runs were recorded now.

    Raises:
        SimulationError: runs failed; the others are recorded all the same.
    """
    left = [job for job in todo if not is_recorded(job.scenario, job.seed, out / job.folder, camera)]
    failed: list[str] = []
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's: one core for each worker
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _end_with_parent) as pool:
        futures = {pool.submit(record, j.scenario, j.seed, out / j.folder, camera): j for j in left}
        for future in counted(as_completed(futures), "recording", len(left), "runs"):
            folder = futures[future].folder
            try:
                future.result()
                said(folder)
            except FglocError as error:
                failed.append(f"  {folder}: {error}")
    if failed:
        raise SimulationError(f"{len(failed)} of {len(left)} runs failed:\n" + "\n".join(failed))
    return len(left)


def _end_with_parent() -> None:
    """Let a worker end when its parent is killed, so that none writes into a suite that is being resumed."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def load_suite(path: Path) -> Suite:
    """Read a suite, or a single scenario as a suite of one. A key ``parts`` holds what is only referred to.

    Raises:
        ConfigError: no such file, no YAML, an unknown key or a value out of range; all are named.
    """
    settings = Settings(path, "give 'entries' (a suite) or the keys of a scenario")
    settings.content.pop("parts", None)
    if "entries" in settings.content:
        return settings.validated(Suite)
    return Suite(entries=(Entry(scenario=settings.validated(Scenario)),))


def find_scenario(what: str) -> Scenario:
    """A scenario of the bundled suite by name, or of a YAML file."""
    if Path(what).suffix in (".yaml", ".yml"):
        return load_suite(Path(what)).entries[0].scenario
    return load_suite(BUNDLED).find(what)
