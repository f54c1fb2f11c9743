"""Floors, paths and failing sensors that the demonstration and the benchmark drive with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from fgloc.ablation.failures import AnyFailure
from fgloc.sensors.failures import Failure
from fgloc_datasets.sim.floor import Floor
from fgloc_datasets.sim.following.loop import Drive
from fgloc_datasets.sim.following.path import load_path
from fgloc_datasets.sim.following.poses import PoseName
from fgloc_datasets.sim.installation import Installation
from fgloc_datasets.sim.physics import make_scene
from fgloc_datasets.sim.scenario import Camera, Scenario
from fgloc_datasets.sim.sensors import Sees
from fgloc_datasets.sim.suite import BUNDLED, load_suite

FAILED_S = (16.0, 36.0)  # when a sensor fails: from the first lane to the last but one
MOVED_M = 0.5
_CAMERA_HZ = 5.0
_BLIND = ("truth", "wheels", "learned")  # need no images
_FAILURE: TypeAdapter[Failure] = TypeAdapter(AnyFailure)


@dataclass(frozen=True, slots=True)
class Case:
    """A scenario of the simulated suite, a path, and what fails.

    Attributes:
        title: for figures.
        floor: name of the scenario.
        path: name of the path.
        ground: heights of the floor, as in ``world.floor``; the robot's configuration then says that it is uneven.
        failing: as in a suite of ablations; a moved marker without ids is the one that the robot has before it first.
    """

    title: str
    floor: str
    path: str
    failing: dict[str, Any] | None = None
    ground: dict[str, Any] | None = None


_IN_TIME = {"intervals": [FAILED_S]}
CASES: dict[str, Case] = {
    "flat30": Case("waypoints 0.3 m apart", "calibrated", "grid30"),
    "flat20": Case("waypoints 0.2 m apart", "calibrated", "grid20"),
    "ice": Case("ice", "slippery", "grid30"),
    "dark20": Case(
        "ice, no images for 20 s", "slippery", "grid30", {"kind": "dropout", "sensor": "camera", "when": _IN_TIME}
    ),
    "onewheel": Case(
        "left encoder dead for 20 s", "calibrated", "grid30",
        {"kind": "encoder_dead", "wheel": "left", "when": _IN_TIME},
    ),
    "slope": Case(
        "a ramp of 15° and humps", "calibrated", "ramp",
        ground={"ramp": {"start_x": -1.5, "angle_deg": 15.0}, "humps": {"count": 8}},
    ),
    "rough": Case("a rough field", "calibrated", "ramp", ground={"rough": {"height_m": 0.03}}),
    "level": Case("the same path on a flat floor", "calibrated", "ramp"),
    "moved": Case("a marker moved", "calibrated", "grid30", {"kind": "moved_marker", "distance_m": MOVED_M}),
}  # fmt: skip


def drive_of(name: str, pose: PoseName, seed: int, sees: Sees = "images", always: bool = False) -> Drive:
    """A drive of a case: as installed by a careful person, and with no error besides.

    Args:
        name: of the case.
        pose: that guides the robot; for some there is nothing to be seen.
        seed: of all that is drawn.
        sees: what the camera sends otherwise.
        always: send it although it does not guide the robot.
    """
    case = CASES[name]
    made = load_suite(BUNDLED).find(case.floor)
    robot = made.robot.model_copy(update={"radius_scale": (1.0, 1.0)})
    changes = {"robot": robot, "camera": Camera(rate_hz=_CAMERA_HZ), "installation": Installation.as_installed()}
    scenario, path = made.model_copy(update=changes), load_path(case.path)
    if case.ground is not None:
        floor = Floor.model_validate(scenario.world.floor.model_dump() | case.ground)
        scenario = scenario.model_copy(update={"world": scenario.world.model_copy(update={"floor": floor})})
    failing = case.failing
    if failing is not None and failing["kind"] == "moved_marker":
        placed = scenario.model_copy(update={"start": path.start})
        failing = failing | {"ids": [_ahead(placed, seed)]}
    failures = () if failing is None else (_FAILURE.validate_python(failing),)
    return Drive(scenario, path, pose, seed, failures, "nothing" if pose in _BLIND and not always else sees)


def _ahead(scenario: Scenario, seed: int) -> int:
    """The marker that a robot at the start has nearest before it: moving one that it seldom sees changes nothing."""
    x, y, yaw = scenario.start
    landmarks = make_scene(scenario, seed).landmarks.landmarks
    places = np.array([m.position[:2] for m in landmarks.values()]) - (x, y)
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(places[:, 1], places[:, 0]) - yaw))))
    return list(landmarks)[int(np.argmin(off))]
