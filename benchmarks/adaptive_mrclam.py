"""Failures injected into MRCLAM 6: the first minutes of five real robots, for `benchmarks.adaptive`.

The robots recorded commands and no wheels. So that wheels can slip here, an odometry is made that repeats the commands
and is corrupted; the learned motion reads the commands. Each robot's model and constants come from the other four.
*Fixed* keeps the covariances of ``robot.yaml``; the oracle is fixed and given the times when the wheels are wrong.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.adaptive_recordings import Recorded
from benchmarks.adaptive_runs import MOVED_M, changed, distrusting, failure, moved_id, replay
from benchmarks.adaptive_scores import Figures
from benchmarks.common import Row, not_run
from fgloc import se2
from fgloc.config import load_config
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import find_beside
from fgloc.sensors.maps import load_map
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import ControlEvent, Event, TruthEvent
from fgloc_datasets import mrclam

_ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("FGLOC_REAL_DATA", _ROOT.parent / "shared" / "data"))
_MODELS = _ROOT / "fgloc" / "sensors" / "learned" / "models" / "mrclam"
_LENGTH_S = 200.0
_SLIPS = [(40.0, 46.0), (80.0, 86.0), (120.0, 126.0), (160.0, 166.0)]
_DARK = (60.0, 120.0)
CASES = ("none", "slip", "dropout", "ids30", "moved")
_FIXED = {"weights": {"adaptive": False}}


def measure(quick: bool) -> Iterator[Row]:
    """Rows of every failure; a quick run takes one robot."""
    source = DATA / "mrclam6"
    if not source.is_dir():
        yield from not_run([f"mrclam.{name}.over_fixed" for name in CASES], f"no {source}; set FGLOC_REAL_DATA")
        return
    found: dict[tuple[str, str], list[Figures]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        for robot in (3,) if quick else mrclam.ROBOTS:
            recorded = load(source, robot, Path(scratch))
            for name in CASES:
                for variant in ("ours", "fixed", *(("oracle",) if name == "slip" else ())):
                    found.setdefault((name, variant), []).append(_run(recorded, name, variant, robot))
    for name in CASES:
        ours = [f.ate_m for f in found[name, "ours"]]
        yield _ratio(f"mrclam.{name}.over_fixed", ours, [f.ate_m for f in found[name, "fixed"]])
        if name == "slip":
            yield _ratio("mrclam.slip.over_oracle", ours, [f.ate_m for f in found[name, "oracle"]])
        if name != "none":
            yield _ratio(f"mrclam.{name}.over_none", ours, [f.ate_m for f in found["none", "ours"]])
        nees = [f.nees_over_3 for f in found[name, "ours"]]
        yield Row(f"mrclam.{name}.nees_over_3", float(np.mean(nees)), float(np.std(nees)), len(nees))
    named = [f.named == f.moved for f in found["moved", "ours"]]
    yield Row("mrclam.moved.named", float(np.mean(named)), n=len(named))


def _run(recorded: Recorded, name: str, variant: str, robot: int) -> Figures:
    config = recorded.config if variant == "ours" else changed(recorded.config, _FIXED)
    if variant == "oracle":
        config = changed(config, distrusting(_SLIPS))
    return replay(recorded, config, [failure(f) for f in chain(recorded, name)], robot, batch=False)


def chain(recorded: Recorded, name: str) -> list[dict[str, Any]]:
    """Failures of a case, as a suite of ablations describes them."""
    cases: dict[str, list[dict[str, Any]]] = {
        "none": [],
        "slip": [{"kind": "wheel_slip", "speed": 0.08, "yaw_rate": 0.15, "when": {"intervals": _SLIPS}}],
        "dropout": [{"kind": "dropout", "sensor": "camera", "when": {"intervals": [_DARK]}}],
        "ids30": [{"kind": "wrong_ids", "probability": 0.3}],
        "moved": [{"kind": "moved_marker", "ids": [moved_id(recorded)], "distance_m": MOVED_M}],
    }
    return cases[name]


def load(source: Path, robot: int, scratch: Path) -> Recorded:
    """The first minutes of a robot, converted into a folder, with an odometry that repeats the commands."""
    bag = mrclam.convert(source, robot, scratch / f"robot{robot}")
    robot_yaml, map_path = find_beside(bag, "robot.yaml"), find_beside(bag, "map.yaml")
    assert robot_yaml is not None
    assert map_path is not None
    settings = {
        "wheels": {"source": "twist"},
        "motion": {"model": _MODELS / f"without_robot{robot}.safetensors"},
    }
    config = changed(load_config(robot_yaml), settings)
    with open_recording(bag, config.recording) as recording:
        start_ns = recording.span_ns[0]
        until_ns = start_ns + round(_LENGTH_S * 1e9)
        events = tuple(_with_odometry(e for e in recording.events() if e.received_ns < until_ns))
    truth = [
        ((e.stamp_ns - start_ns) * 1e-9, e.position[0], e.position[1], quaternion_yaw(e.orientation))
        for e in events
        if isinstance(e, TruthEvent)
    ]
    none = np.zeros((0, 3))
    return Recorded(
        name=f"mrclam/robot{robot}",
        bag=bag,
        map_path=map_path,
        config=config,
        landmarks=load_map(map_path),
        events=events,
        start_ns=start_ns,
        slip_s=none[:, 0],
        slipping=none[:, 0] > 0,
        slip=none,
        truth=np.array(truth),
        duration_s=_LENGTH_S,
    )


def _with_odometry(events: Iterable[Event]) -> Iterator[Event]:
    """The events, and after each command what a wheel odometry that follows at once would report."""
    pose, twist = np.zeros(3), (0.0, 0.0)
    last_ns: int | None = None
    unknown = np.zeros((6, 6))
    for event in events:
        yield event
        if not isinstance(event, ControlEvent):
            continue
        if last_ns is not None:
            seconds = (event.stamp_ns - last_ns) * 1e-9
            pose = se2.compose(pose, se2.exp((twist[0] * seconds, 0.0, twist[1] * seconds)))
        last_ns, twist = event.stamp_ns, (event.v, event.omega)
        position, turn = np.array([pose[0], pose[1], 0.0]), yaw_quaternion(float(pose[2]))
        linear, angular = np.array([event.v, 0.0, 0.0]), np.array([0.0, 0.0, event.omega])
        stamps = (event.stamp_ns, event.received_ns, "/odom", "odom", "base_link")
        yield OdometryEvent(*stamps, position, turn, unknown, linear, angular, unknown)


def _ratio(row_id: str, ours: list[float], theirs: list[float]) -> Row:
    a, b = np.array(ours), np.array(theirs)
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return Row(row_id, None, n=len(a), reason="in some runs no pose was ever found")
    return Row(row_id, float(a.mean() / b.mean()), float(np.std(a / b)), len(a))
