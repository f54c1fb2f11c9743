"""Recording of simulated runs: a scenario and a seed as bag, map, robot file and truth; suites in processes."""

from __future__ import annotations

import heapq
import multiprocessing
import os
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import mujoco
import yaml
from pydantic import Field

from fgloc.errors import ConfigError, FglocError
from fgloc.files.atomic import atomic_folder
from fgloc.files.settings import Settings
from fgloc.instrumentation import counted
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import write_robot
from fgloc_datasets.sim.drives import settings as drive_settings
from fgloc_datasets.sim.drives import wheel_names
from fgloc_datasets.sim.installed import INSTALLED, write_installed
from fgloc_datasets.sim.physics import Scene, SimulationError, make_scene, simulate
from fgloc_datasets.sim.scenario import Control, Scenario, Section
from fgloc_datasets.sim.sensors import command_topic, gnss_settings, streams, uwb_settings

# --- One run ----------------------------------------------------------------------------------------------------------

DONE = "scenario.yaml"  # a folder that holds it is complete
RUN_FILES = ("bag", "map.yaml", "robot.yaml", INSTALLED, DONE)


def record(scenario: Scenario, seed: int, out: Path, camera: bool = True) -> Path:
    """Record one run into ``out``: ``bag/``, ``map.yaml``, ``robot.yaml``, ``installed.yaml``, ``scenario.yaml``.

    Nothing appears in ``out`` before the run is complete; an earlier recording there is replaced.

    Args:
        scenario: what to record.
        seed: what is drawn; the same seed and versions give the same messages.
        out: folder.
        camera: render images (if the scenario has a camera); without, no OpenGL is needed.

    Returns:
        The bag's folder.

    Raises:
        SimulationError: the physics diverged.
        RenderError: there is no OpenGL.
    """
    scene = make_scene(scenario, seed)
    log = simulate(scene)
    with atomic_folder(out, own=RUN_FILES) as stage:
        with BagWriter(stage / "bag", compress=True) as bag:
            merged = heapq.merge(*streams(scene, log, bag, "images" if camera else "nothing"), key=itemgetter(0))
            for _, write in counted(merged, "recording", unit="messages"):
                write()
        write_beside(stage, scene, scenario, camera)
    return out / "bag"


def write_beside(folder: Path, scene: Scene, scenario: Scenario, camera: bool) -> None:
    """Write what lies beside a run's bag."""
    write_map(scene.surveyed, folder / "map.yaml")
    write_installed(scene.installed, folder / INSTALLED)
    write_robot(folder / "robot.yaml", robot_settings(scenario), f"Simulated robot of scenario {scenario.name}.")
    (folder / DONE).write_text(describe(scenario, scene.seed, camera), encoding="utf-8")


def is_recorded(scenario: Scenario, seed: int, out: Path, camera: bool) -> bool:
    """Whether ``out`` holds exactly this run, complete."""
    done = out / DONE
    return all((out / name).exists() for name in RUN_FILES) and done.read_text(encoding="utf-8") == describe(
        scenario, seed, camera
    )


def describe(scenario: Scenario, seed: int, camera: bool) -> str:
    """The resolved scenario with its seed and the versions that matter, as YAML."""
    content = {
        "seed": seed,
        "camera": camera,
        "mujoco": mujoco.__version__,
        "fgloc": version("fgloc"),
        "scenario": scenario.model_dump(mode="json", exclude=_unused(scenario)),
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110)


def _unused(scenario: Scenario) -> dict[str, Any]:
    """Options that were added later, where they are not used: older recordings stay what they are."""
    floor, markers = scenario.world.floor, scenario.world.markers
    steers, has_wheelbase = scenario.robot.kind == "ackermann", scenario.robot.kind in ("ackermann", "mecanum")
    return {
        "robot": {
            *(set() if steers else {"steering_zero_rad", "steering_ratio", "max_steering_rad", "steering_rad_s"}),
            *(set() if scenario.robot.kind == "mecanum" else {"rollers"}),
            *(set() if has_wheelbase else {"wheelbase_scale"}),
        },
        "installation": {
            *(set() if steers else {"steering_zero_deg", "steering_share"}),
            *(set() if has_wheelbase else {"wheelbase_share"}),
        },
        **{name: True for name in ("uwb", "gnss", "rear") if getattr(scenario, name) is None},
        "world": {
            "floor": {name for name in ("ramps", "tilt", "rough") if not getattr(floor, name)},
            "markers": {name for name in ("placed",) if not getattr(markers, name)},
        },
    }


def robot_settings(scenario: Scenario) -> dict[str, Any]:
    """``robot.yaml``: what a user would know of the robot: nominal geometry, not the true radii."""
    robot = scenario.robot
    wheels: dict[str, Any]
    if robot.kind == "diff_drive":
        left, right = wheel_names(robot)
        wheels = {"source": "ticks", "left_joint": left, "right_joint": right}
        wheels |= {"left_radius": robot.radius_m, "right_radius": robot.radius_m, "track": robot.track_m}
    else:
        wheels = {"drive": drive_settings(robot)}
    wheels["noise"] = {
        "x_per_sqrt_m": 0.02,
        "y_per_sqrt_m": 0.01,
        "yaw_per_sqrt_m": 0.04,
        "xy_per_sqrt_rad": 0.01,
        "yaw_per_sqrt_rad": 0.04 if robot.kind == "diff_drive" else 0.2,
        "xy_per_sqrt_s": 0.002,
        "yaw_per_sqrt_s": 0.002,
    }
    # Corners are good to 0.07 px at rest; what motion blur adds is in markers.blur_s. On validation recordings as
    # installed NEES/3 is 0.77 and 0.5 % of sound sightings are refused; with 0.09 px and no blur_s 3 %.
    markers = {"sigma_px": 0.1}
    topics = {"command": command_topic(robot), "odometry": "/odom", "truth": "/truth"}
    settings: dict[str, Any] = {"recording": {"topics": topics}, "wheels": wheels, "markers": markers}
    if scenario.world.floor.uneven:
        settings["estimator"] = {"ground": "uneven"}
    if scenario.rear is not None:
        settings["cameras"] = {name: {"image": f"/{name}/image/compressed"} for name in scenario.cameras}
    if scenario.uwb is not None:
        settings["uwb"] = uwb_settings(scenario, scenario.uwb)
    if scenario.gnss is not None:
        settings["gnss"] = gnss_settings(scenario.gnss)
    if robot.kind == "diff_drive":
        # Radii may be 1 % off. On validation recordings with 60 s of darkness the error falls from 10 to 6 cm by it.
        wheels |= {"scale_sigma": 0.01, "turn_scale_sigma": 0.01, "yaw_per_m_sigma": 0.05}
        settings["motion"] = {"model": "shipped:sim/diff_drive"}
    return settings


# --- A suite ----------------------------------------------------------------------------------------------------------

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


def record_suite(todo: list[Job], out: Path, camera: bool, workers: int) -> int:
    """Record runs in ``workers`` processes. Runs that ``out`` already holds are skipped, so a killed suite resumes.

    Args:
        todo: what to record.
        out: a folder for the suite; each run gets its own below it.
        camera: render images.
        workers: processes.

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
            try:
                future.result()
            except FglocError as error:
                failed.append(f"  {futures[future].folder}: {error}")
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
