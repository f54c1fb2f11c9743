"""Recording: a scenario and a seed in; a bag, a map, a robot file, the truth and the resolved scenario out."""

from __future__ import annotations

import heapq
from importlib.metadata import version
from operator import itemgetter
from pathlib import Path
from typing import Any

import mujoco
import yaml

from fgloc.files.atomic import atomic_folder
from fgloc.instrumentation import counted
from fgloc.sensors.maps import write_map
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import write_robot
from fgloc_datasets.sim.installed import INSTALLED, write_installed
from fgloc_datasets.sim.mjcf import wheel_names
from fgloc_datasets.sim.physics import Scene, make_scene, simulate
from fgloc_datasets.sim.positioning import gnss_settings, uwb_settings
from fgloc_datasets.sim.scenario import Scenario
from fgloc_datasets.sim.sensors import streams

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
    return {
        **{name: True for name in ("uwb", "gnss") if getattr(scenario, name) is None},
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
        wheels = {"source": "twist"}
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
    topics = {"command": "/cmd_vel", "odometry": "/odom", "truth": "/truth"}
    settings: dict[str, Any] = {"recording": {"topics": topics}, "wheels": wheels, "markers": markers}
    if scenario.world.floor.uneven:
        settings["estimator"] = {"ground": "uneven"}
    if scenario.uwb is not None:
        settings["uwb"] = uwb_settings(scenario, scenario.uwb)
    if scenario.gnss is not None:
        settings["gnss"] = gnss_settings(scenario.gnss)
    if robot.kind == "diff_drive":
        # Radii may be 1 % off. On validation recordings with 60 s of darkness the error falls from 10 to 6 cm by it.
        wheels |= {"scale_sigma": 0.01, "turn_scale_sigma": 0.01, "yaw_per_m_sigma": 0.05}
        settings["motion"] = {"model": "shipped:sim/diff_drive"}
    return settings
