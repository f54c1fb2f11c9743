"""Pictures of a recorded run: trajectory, controls, slip, frames.

Source: the first two show what the paper's Figures 2 and 3 show.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import yaml
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader

from fgloc.config import MarkersConfig
from fgloc.errors import RecordingError
from fgloc.frames import quaternion_yaw
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import MarkerDetector
from fgloc.types import FloatArray, LandmarkMap
from fgloc_datasets.sim.scenario import Scenario
from fgloc_datasets.sim.scene import make_ground, outline
from fgloc_datasets.sim.sensors import EPOCH_NS

STYLE: Any = {
    "font.size": 9,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_SHEET = (4, 3)  # columns and rows
_EPOCH_S = EPOCH_NS // 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class _Channels:
    """Signals of a bag that are drawn; times in seconds from its start."""

    truth: FloatArray  # (n, 4) t, x, y, yaw
    odometry: FloatArray  # (n, 3) t, x, y
    commands: FloatArray  # (n, 3) t, v, omega
    slip: FloatArray  # (n, 2) true minus wheel v, omega
    slipping: NDArray[np.bool_]  # (n,)
    light: FloatArray  # (n, 2) t, lux
    images: list[tuple[float, bytes]]


def draw(run: Path, out: Path) -> list[Path]:
    """Draw the pictures of a run recorded by the simulator.

    Args:
        run: its folder (``bag/``, ``map.yaml``, ``scenario.yaml``).
        out: folder for the PNG files.

    Raises:
        RecordingError: the folder is not a recorded run.
    """
    if not (run / "scenario.yaml").is_file():
        raise RecordingError(f"{run}: no scenario.yaml; give a folder that `fgloc sim record` has made")
    described = yaml.safe_load((run / "scenario.yaml").read_text(encoding="utf-8"))
    scenario, seed = Scenario.model_validate(described["scenario"]), int(described["seed"])
    channels = _read(run / "bag")
    landmarks = load_map(run / "map.yaml")
    out.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        made = {
            "trajectory.png": _trajectory(scenario, seed, landmarks, channels),
            "control.png": _control(channels),
            "slip.png": _slip(channels),
        }
    paths = []
    for name, figure in made.items():
        figure.savefig(out / name, dpi=130)
        paths.append(out / name)
    if channels.images:
        cv2.imwrite(str(out / "frames.png"), _contact_sheet(channels.images, landmarks.dictionary))
        paths.append(out / "frames.png")
    return paths


def _trajectory(scenario: Scenario, seed: int, landmarks: LandmarkMap, c: _Channels) -> Figure:
    figure = Figure(figsize=(6.4, 5.2), layout="constrained")
    ax = figure.add_subplot()
    ground = make_ground(scenario.world, seed)
    sx, sy = scenario.world.size_m
    if ground.height is not None:
        shown = ax.imshow(
            ground.height * 100, origin="lower", extent=(-sx / 2, sx / 2, -sy / 2, sy / 2), cmap="Greys", alpha=0.6
        )
        figure.colorbar(shown, ax=ax, label="height [cm]", shrink=0.7)
    for patch in ground.patches:
        ax.add_patch(Polygon(outline(patch) + patch.center, color="tab:cyan", alpha=0.25, lw=0))
        ax.annotate(f"{patch.mu:.2f}", patch.center, fontsize=6, color="tab:cyan", ha="center")
    for landmark in landmarks.landmarks.values():
        corners = landmark.corners()
        ax.plot(corners[:2, 0], corners[:2, 1], color="k", lw=3, solid_capstyle="butt")
        at = landmark.position + 0.18 * landmark.rotation[:, 2]
        ax.annotate(str(landmark.landmark_id), (at[0], at[1]), fontsize=7, ha="center", va="center")
    start = c.truth[0, 1:3]
    yaw = scenario.start[2]
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    odometry = start + c.odometry[:, 1:] @ turn.T
    ax.plot(odometry[:, 0], odometry[:, 1], color="tab:orange", lw=1, label="wheel odometry")
    ax.plot(c.truth[:, 1], c.truth[:, 2], color="tab:blue", lw=1.4, label="truth")
    ax.plot(c.truth[c.slipping, 1], c.truth[c.slipping, 2], ".", color="tab:red", ms=2, label="slipping")
    ax.plot(*start, "o", color="tab:green", ms=6, label="start")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=f"{scenario.name}, seed {seed}")
    ax.set_xlim(-sx / 2 - 0.2, sx / 2 + 0.2)
    ax.set_ylim(-sy / 2 - 0.2, sy / 2 + 0.2)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


def _control(c: _Channels) -> Figure:
    figure = Figure(figsize=(8, 4.4), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    true = _true_twist(c)
    for i, (ax, name) in enumerate(zip(axes, ("v [m/s]", "ω [rad/s]"), strict=True)):
        ax.step(c.commands[:, 0], c.commands[:, 1 + i], where="post", color="k", lw=0.9, label="command")
        ax.plot(c.truth[:, 0], true[:, i], color="tab:blue", lw=1, label="truth")
        ax.set_ylabel(name)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    axes[1].set_xlabel("time [s]")
    return figure


def _slip(c: _Channels) -> Figure:
    figure = Figure(figsize=(8, 4.4), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    true, seconds = _true_twist(c), c.truth[:, 0]
    for i, (ax, name) in enumerate(zip(axes, ("v [m/s]", "ω [rad/s]"), strict=True)):
        ax.plot(seconds, true[:, i] - c.slip[:, i], color="tab:orange", lw=1, label="wheels")
        ax.plot(seconds, true[:, i], color="tab:blue", lw=1, label="truth")
        shade = ax.get_xaxis_transform()
        ax.fill_between(seconds, 0, 1, where=c.slipping, transform=shade, color="tab:red", alpha=0.15, lw=0)
        ax.set_ylabel(name)
    if np.ptp(c.light[:, 1]) > 0:
        light = axes[1].twinx()
        light.step(c.light[:, 0], c.light[:, 1], where="post", color="tab:olive", lw=1)
        light.set(ylabel="light [lux]", ylim=(0, None))
        light.grid(False)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    axes[1].set_xlabel("time [s]; shaded: slipping")
    return figure


def _true_twist(c: _Channels) -> FloatArray:
    """Forward speed [m/s] and yaw rate [rad/s] ``(n, 2)``, from differences of the true poses."""
    seconds, yaw = c.truth[:, 0], np.unwrap(c.truth[:, 3])
    vx, vy = (np.gradient(c.truth[:, i], seconds) for i in (1, 2))
    return np.column_stack([np.cos(yaw) * vx + np.sin(yaw) * vy, np.gradient(yaw, seconds)])


def _read(bag: Path) -> _Channels:
    rows: dict[str, list[tuple[float, ...]]] = {}
    images: list[tuple[float, bytes]] = []
    with AnyReader([bag]) as reader:
        for connection, _, raw in reader.messages():
            m: Any = reader.deserialize(raw, connection.msgtype)
            t = (m.header.stamp.sec - _EPOCH_S) + m.header.stamp.nanosec * 1e-9 if hasattr(m, "header") else 0.0
            row: tuple[float, ...] | None = None
            match connection.topic:
                case "/truth":
                    p, q = m.pose.position, m.pose.orientation
                    row = (t, p.x, p.y, quaternion_yaw((q.x, q.y, q.z, q.w)))
                case "/odom":
                    row = (t, m.pose.pose.position.x, m.pose.pose.position.y)
                case "/cmd_vel":
                    row = (t, m.twist.linear.x, m.twist.angular.z)
                case "/truth/slip":
                    row = (m.twist.twist.linear.x, m.twist.twist.angular.z)
                case "/truth/slipping":
                    row = (float(m.data),)
                case "/truth/light":
                    row = (t, m.illuminance)
                case "/camera/image/compressed":
                    images.append((t, m.data.tobytes()))
            if row is not None:
                rows.setdefault(connection.topic, []).append(row)
    try:
        table = {name: np.array(values) for name, values in rows.items()}
        return _Channels(
            truth=table["/truth"],
            odometry=table["/odom"],
            commands=table["/cmd_vel"],
            slip=table["/truth/slip"],
            slipping=table["/truth/slipping"][:, 0] > 0,
            light=table["/truth/light"],
            images=images,
        )
    except KeyError as error:
        raise RecordingError(f"{bag}: no messages on {error}; give a run recorded by the simulator") from error


def _contact_sheet(images: list[tuple[float, bytes]], dictionary: str) -> NDArray[np.uint8]:
    """Frames evenly spread over the run, detections drawn."""
    detector = MarkerDetector(dictionary, MarkersConfig())
    columns, rows = _SHEET
    cells = []
    for k in np.linspace(0, len(images) - 1, columns * rows).round().astype(int):
        seconds, data = images[k]
        gray = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        color = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
        found = detector.find(gray)
        for marker_id, corners in found:
            cv2.polylines(color, [np.round(corners).astype(np.int32)], True, (0, 220, 0), 2)
            at = tuple(int(x) for x in corners.min(axis=0) - (0, 6))
            cv2.putText(color, str(marker_id), at, cv2.FONT_HERSHEY_SIMPLEX, 0.8, (0, 140, 255), 2)
        cv2.putText(color, f"{seconds:.1f} s", (8, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2)
        cells.append(cv2.resize(color, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA))
    return np.vstack([np.hstack(cells[r * columns : (r + 1) * columns]) for r in range(rows)])
