"""Drives of the benchmark and the demonstration: floors, paths and failing sensors by name, a picture and a table.

Source of the picture: the paper's Figure 4: waypoints in green, the true path in red; the pose that guided the robot
in blue.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from pydantic import TypeAdapter

from fgloc.ablation.failures import AnyFailure
from fgloc.files.atomic import atomic_folder
from fgloc.sensors.failures import Failure
from fgloc_datasets.sim.figures import STYLE
from fgloc_datasets.sim.following.loop import Drive, Followed, PoseName, follow
from fgloc_datasets.sim.following.pursuit import load_path
from fgloc_datasets.sim.physics import make_scene
from fgloc_datasets.sim.record import BUNDLED, load_suite
from fgloc_datasets.sim.scenario import Camera, Floor, Installation, Scenario
from fgloc_datasets.sim.scene import make_ground, make_map, outline
from fgloc_datasets.sim.sensors import Sees

# --- Cases ------------------------------------------------------------------------------------------------------------

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


# --- Picture and table ------------------------------------------------------------------------------------------------

_COLUMNS = 3
_AROUND_M = 0.35
_HEAD = ("drive", "pose", "track", "worst", "reached", "pose error", "time")


def draw_drives(drives: Mapping[str, tuple[Drive, Followed]], out: Path, close: bool = True) -> None:
    """One panel for each drive.

    Args:
        drives: by title.
        out: the PNG file.
        close: show the path alone, not the whole room.
    """
    columns = min(_COLUMNS, len(drives))
    rows = -(-len(drives) // columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.9 * columns, 3.1 * rows + 0.4), layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False)
        for ax in axes.flat[len(drives) :]:
            ax.axis("off")
        for ax, (title, (drive, followed)) in zip(axes.flat, drives.items(), strict=False):
            _panel(ax, drive, followed, close)
            ax.set_title(f"{title}\npose: {drive.pose}, {followed.score.track_mm:.0f} mm from the path", fontsize=9)
        figure.legend(*axes.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
        figure.savefig(out, dpi=110)


def _panel(ax: Axes, drive: Drive, followed: Followed, close: bool) -> None:
    world, seed = drive.scenario.world, drive.seed
    for patch in make_ground(world, seed).patches:
        ax.add_patch(Polygon(outline(patch) + patch.center, color="tab:cyan", alpha=0.25, lw=0))
    waypoints = np.array(drive.path.waypoints)
    ax.plot(*waypoints.T, "o", color="tab:green", ms=4, label="waypoints")
    ax.plot(*followed.poses[:, :2].T, color="tab:blue", lw=1.0, label="estimated path")
    ax.plot(*followed.true_path[:, :2].T, color="tab:red", lw=1.2, label="true path")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    if close:
        shown = np.concatenate([waypoints, followed.true_path[:, :2]])
        low, high = shown.min(axis=0) - _AROUND_M, shown.max(axis=0) + _AROUND_M
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        return
    for landmark in make_map(world, seed).landmarks.values():
        corners = landmark.corners()
        ax.plot(corners[:2, 0], corners[:2, 1], color="k", lw=3, solid_capstyle="butt")


def table(drives: Mapping[str, tuple[Drive, Followed]]) -> str:
    """Scores as text."""
    lines: list[Sequence[str]] = [_HEAD]
    for title, (drive, followed) in drives.items():
        s = followed.score
        error = "" if s.pose_mm is None else f"{s.pose_mm:.1f} mm"
        time = f"{s.seconds:.0f} s" if s.arrived else "not arrived"
        shares = f"{100 * s.reached:.0f} %"
        lines.append((title, drive.pose, f"{s.track_mm:.1f} mm", f"{s.worst_mm:.0f} mm", shares, error, time))
    widths = [max(len(line[i]) for line in lines) for i in range(len(_HEAD))]
    return "\n".join(
        "  ".join(
            c.ljust(w) if i < 2 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


# --- Demonstration ----------------------------------------------------------------------------------------------------

SEED = 141  # of the benchmark's validation split
_DRIVES: tuple[tuple[str, PoseName], ...] = (
    ("flat30", "fgloc"),
    ("flat20", "fgloc"),
    ("onewheel", "fgloc"),
    ("ice", "wheels"),
    ("ice", "fgloc"),
    ("dark20", "fgloc"),
)
PICTURE, TABLE = "following.png", "following.txt"


def demonstrate(out: Path, jobs: int = 2, sees: Sees = "images") -> str:
    """Drive, draw ``following.png``, write ``following.txt``; nothing appears in ``out`` before all is done.

    Args:
        out: folder.
        jobs: processes.
        sees: what the camera sends.

    Returns:
        The table.

    Raises:
        RenderError: images are wanted and there is no OpenGL.
    """
    with ProcessPoolExecutor(min(jobs, len(_DRIVES)), get_context("spawn")) as pool:
        waiting = [pool.submit(_driven, case, pose, sees) for case, pose in _DRIVES]
        made = [job.result() for job in waiting]
    drives = {
        CASES[case].title + (", wheel odometry" if pose == "wheels" else ""): done
        for (case, pose), done in zip(_DRIVES, made, strict=True)
    }
    text = table(drives)
    with atomic_folder(out, own=(PICTURE, TABLE)) as stage:
        draw_drives(drives, stage / PICTURE)
        (stage / TABLE).write_text(text + "\n", encoding="utf-8")
    return text


def _driven(case: str, pose: PoseName, sees: Sees) -> tuple[Drive, Followed]:
    drive = drive_of(case, pose, SEED, sees)
    return drive, follow(drive)
