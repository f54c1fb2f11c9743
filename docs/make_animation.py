"""Makes docs/pictures/run.gif: a run on slippery patches whose camera goes dark, as the robot would have known it.

    python docs/make_animation.py

The recording is the bundled ``patches_run``; from 36 s to 48 s its images are darkened. Shown are what the online run
knew at each time, what wheel odometry alone says, and the truth.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from PIL import Image

from fgloc import se2
from fgloc.ablation.failures import corrupt, generators
from fgloc.sensors.failures import Scene
from fgloc.ablation.suite import Suite
from fgloc.config import load_config
from fgloc.evaluation.metrics import match_result
from fgloc.evaluation.style import BLUE, GREY, ORANGE, RED, SKY
from fgloc.frames import quaternion_yaw
from fgloc.recording.reader import open_recording
from fgloc.runner import run
from fgloc.sensors.maps import load_map
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.runner import RunResult

ROOT = Path(__file__).resolve().parent.parent
SAMPLE = ROOT / "datasets" / "samples" / "patches_run"
OUT = ROOT / "docs" / "pictures" / "run.gif"
DARK_S = (36.0, 48.0)
STEP_S = 0.5  # of the recording, between frames
FRAME_MS = 90
SIZE_IN, DPI = (7.2, 3.6), 100
COLORS = 48


def recorded_run() -> tuple[RunResult, np.ndarray]:
    """The online run, and the pose ``(n, 3)`` of wheel odometry alone at its stamps, from the same start."""
    config = load_config(SAMPLE / "robot.yaml")
    chain = (
        Suite.model_validate(
            {
                "title": "dark",
                "recordings": [{"name": "patches", "bag": str(SAMPLE / "bag")}],
                "failures": [
                    {"name": "dark", "chain": [{"kind": "darkness", "gain": 0.003, "when": {"intervals": [DARK_S]}}]}
                ],
            }
        )
        .failures[0]
        .chain
    )
    stamps, poses = [], []
    with open_recording(SAMPLE / "bag", config.recording) as recording:
        start_ns, duration_s = recording.span_ns[0], recording.duration_s
        for event in recording.events():
            if isinstance(event, OdometryEvent):
                stamps.append(event.stamp_ns)
                poses.append((*event.position[:2], quaternion_yaw(event.orientation)))
    ids = tuple(load_map(SAMPLE / "map.yaml").landmarks)
    scenes = [Scene(start_ns, duration_s, config, ids, rng) for rng in generators(1, 0)]
    result = run(
        SAMPLE / "bag",
        SAMPLE / "map.yaml",
        config,
        "online",
        events=lambda events: corrupt(chain, "recorded", events, scenes),
        sightings=lambda events: corrupt(chain, "sightings", events, scenes),
    )
    wheels = se2.interpolate(np.array(stamps), np.array(poses), result.trajectory.stamps_ns)
    T_map_odom = se2.compose(result.trajectory.poses[0], se2.inverse(wheels[0]))
    return result, np.array([se2.compose(T_map_odom, pose) for pose in wheels])


def draw(result: RunResult, wheels: np.ndarray, slipping: np.ndarray, k: int) -> Image.Image:
    """The picture of keyframe ``k``."""
    times = (result.trajectory.stamps_ns - result.trajectory.stamps_ns[0]) * 1e-9
    matched = match_result(result, result.config)
    poses, covs = result.trajectory.poses, result.trajectory.covs
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
    left.plot(*matched.truth[:, :2].T, color="#bbbbbb", lw=3, label="truth")
    left.plot(*wheels[: k + 1, :2].T, color=ORANGE, lw=1.2, label="wheel odometry alone")
    left.plot(*poses[: k + 1, :2].T, color=BLUE, lw=1.8, label="fgloc, online")
    for landmark in result.landmarks.landmarks.values():
        left.plot(*landmark.corners()[:2, :2].T, color=RED, lw=3)
    values, vectors = np.linalg.eigh(covs[k, :2, :2])
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    sizes = 6.0 * np.sqrt(values)
    left.add_patch(Ellipse(poses[k, :2], sizes[1], sizes[0], angle=angle, color=SKY, alpha=0.6))
    left.plot(*poses[k, :2], marker=(3, 0, np.degrees(poses[k, 2]) - 90.0), ms=11, color=BLUE, mec="white")
    left.set(xlim=(-3.0, 3.0), ylim=(-2.95, 2.9), aspect="equal", xticks=[], yticks=[])
    left.legend(loc="upper center", ncols=3, fontsize=7, frameon=False, handlelength=1.2, columnspacing=1.0)
    dark = DARK_S[0] <= times[k] < DARK_S[1]
    states = [("camera dark", dark, "#222222"), ("wheels slip: left out", bool(slipping[k]), RED)]
    for place, (text, on, color) in zip((0.03, 0.36), states, strict=True):
        box = {"facecolor": color if on else "white", "edgecolor": "#cccccc", "boxstyle": "round,pad=0.3"}
        look = {"color": "white" if on else "#cccccc", "fontsize": 8, "bbox": box}
        left.text(place, 0.04, text, transform=left.transAxes, **look)
    sigma = 3e3 * np.sqrt(covs[:, 0, 0] + covs[:, 1, 1])
    off = 1e3 * np.hypot(*(wheels - poses)[:, :2].T)
    right.fill_between(
        times[: k + 1], 0.3, np.maximum(sigma[: k + 1], 0.3), color=SKY, alpha=0.5, lw=0, label="fgloc, 3σ"
    )
    right.plot(
        times[: k + 1], np.maximum(matched.distances[: k + 1] * 1e3, 0.3), color=BLUE, lw=1.4, label="fgloc, error"
    )
    right.plot(times[: k + 1], np.maximum(off[: k + 1], 0.3), color=ORANGE, lw=1.2, label="wheel odometry, error")
    right.axvspan(*DARK_S, color="#222222", alpha=0.15, lw=0)
    right.set(xlim=(0, times[-1]), ylim=(0.3, 30000.0), yscale="log", xlabel="time [s]", ylabel="[mm]")
    right.legend(loc="upper left", fontsize=7, frameon=False)
    right.tick_params(labelsize=7)
    right.grid(color=GREY, alpha=0.2)
    right.spines[["top", "right"]].set_visible(False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")


def main() -> None:
    """Write the animation and say how large it is."""
    result, wheels = recorded_run()
    stamps = result.trajectory.stamps_ns
    left_out = {d.step for d in result.decisions if d.kind == "wheels" and d.weight == 0.0}
    step_of = {d.stamp_ns: d.step for d in result.decisions if d.kind == "wheels"}
    slipping = np.array([step_of.get(stamp, -1) in left_out for stamp in stamps.tolist()])
    times = (stamps - stamps[0]) * 1e-9
    chosen = [int(np.searchsorted(times, t)) for t in np.arange(0.0, times[-1], STEP_S)]
    pictures = [draw(result, wheels, slipping, k) for k in chosen]
    palette = pictures[-1].quantize(COLORS)
    frames = [picture.quantize(COLORS, palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    OUT.parent.mkdir(exist_ok=True)
    frames[0].save(OUT, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True)
    print(f"{OUT}: {len(frames)} frames, {OUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
