"""The node of ``ros/fgloc_ros`` in a real ROS 2, by each of its middlewares: `python -m benchmarks.ros`.

Source ROS's setup first; where rclpy is missing, the rows say so. A player in rclpy publishes bundled recordings.

- ``ros.equal_mm``: largest distance between the node's poses and those of ``fgloc online`` on the same recording, at
  common keyframes; ``ros.equal_keyframes``: the share of the latter's keyframes that were published. On a machine that
  is too busy for all images the node drops some, and its poses are others: what it says of that is printed.
- ``ros.rate_hz``: rate of the node's odometry as it is heard; ``ros.latency_ms_*``: from the sending of an image to the
  arrival of the pose of its exposure; ``ros.cpu_share``: processor time of the node with all of its processes, of one
  core. Each with 5 images a second, ``ros.fast_*`` with 30; ``*relay*`` is a node in rclpy that does nothing but read
  the same topics and publish the same two, at the same time.
- ``ros.two_robots``: two robots in namespaces of one domain, each with its own recording: keyframes that differ from
  those of ``fgloc online`` by more than 1 mm, topics that one reads of the other, transforms on the shared ``/tf``.
- ``ros.lifecycle_*``: random transitions and kills while a recording is played: processes that ended or transitions
  that did what they should not, children that stayed after a kill, memory gained since the fifth unconfigured state.
- ``ros.cli_wrong``: commands of ROS (``ros2 topic``, ``param``, ``lifecycle``, ...; tf2), asked of the node and of
  ``fgloc live``, that did not answer, or warned, also when asked again; ``ros.cli_again``: share that was
  asked again; ``ros.cli_bare_again``: of such commands about a bare node in rclpy, as ROS does not find all at once.
- ``ros.load``: processes that ran or wanted to, mean over a minute: more than the machine's cores disturb the rates.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from benchmarks.common import SAMPLES, Row, main, not_run
from benchmarks.ros_peer import INPUTS, ask, middlewares, why_not
from fgloc.config import load_config
from fgloc.runner import run

_NAMES = ("first_run", "installed_run")
_FAST_HZ, _FAST_S = 30.0, 40.0  # images, and the length of their drive
_SAME_MM = 1.0
_SETTLED = 5  # unconfigured states before which memory is not counted: libraries are loaded, threads start
_IDS = (
    *("ros.equal_mm", "ros.equal_keyframes", "ros.two_robots", "ros.two_robots_keyframes"),
    *("ros.lifecycle_crashes", "ros.lifecycle_orphans", "ros.lifecycle_mb", "ros.cli_wrong", "ros.load"),
    *("ros.cli_again", "ros.cli_bare_again"),
    *(f"ros.{fast}{name}" for fast in ("", "fast_") for name in ("rate_hz", "latency_ms_p50", "latency_ms_p99")),
    *(f"ros.{fast}{name}cpu_share" for fast in ("", "fast_") for name in ("", "relay_")),
)


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    if reason := why_not():
        yield from not_run(_IDS, reason)
        return
    kinds = middlewares()
    print(f"middlewares: {', '.join(kinds)}", file=sys.stderr)
    yield from equal(kinds, _NAMES[:1] if quick else _NAMES, 4.0 if quick else 1.0)
    yield from timing("ros.", kinds, SAMPLES / _NAMES[-1])
    if not quick:
        yield from fast(kinds)
    yield Row("ros.load", os.getloadavg()[0])
    yield from two_robots(kinds)
    yield from lifecycle(kinds, 20 if quick else 200)
    yield from cli(kinds)


def parameters(sample: Path) -> dict[str, str]:
    """Parameters of the node for a bundled recording."""
    return {"config": str(sample / "robot.yaml"), "map": str(sample / "map.yaml")}


def apart_mm(poses: Sequence[Sequence[float]], sample: Path) -> tuple[list[float], float]:
    """Distances [mm] of the node's poses from those of an online run, and the share of its keyframes that are there."""
    online = run(sample / "bag", sample / "map.yaml", load_config(sample / "robot.yaml"), "online").trajectory
    stamps = np.array([row[1] for row in poses], dtype=np.int64)
    positions = np.array([row[2:4] for row in poses]).reshape(-1, 2)
    _, published, expected = np.intersect1d(stamps, online.stamps_ns, return_indices=True)
    off = positions[published] - online.poses[expected, :2]
    return (np.hypot(*off.T) * 1e3).tolist(), len(expected) / len(online)


def equal(kinds: Sequence[str], names: Sequence[str], rate: float) -> Iterator[Row]:
    """Rows of the node's poses beside those of an online run."""
    found = []
    for kind in kinds:
        for name in names:
            sample = SAMPLES / name
            drive = ask(
                "drive",
                kind,
                bag=str(sample / "bag"),
                parameters=parameters(sample),
                needed=list(INPUTS),
                rate=rate,
            )
            found.append(apart_mm(drive["poses"], sample))
            off, share = found[-1]
            print(f"{kind} {name}: {max(off, default=np.nan):.4g} mm, {share:.3f}; {drive['missed']}", file=sys.stderr)
    yield Row("ros.equal_mm", max(max(off, default=np.inf) for off, _ in found), n=len(found), unit="mm")
    yield Row("ros.equal_keyframes", min(share for _, share in found), n=len(found))


def timing(prefix: str, kinds: Sequence[str], sample: Path) -> Iterator[Row]:
    """Rows of rate, latency and processor time, the worst over the middlewares; latencies over all."""
    runs = [ask("timed", kind, bag=str(sample / "bag"), parameters=parameters(sample)) for kind in kinds]
    for kind, one in zip(kinds, runs, strict=True):
        print(f"{kind} {prefix}: {_described(one)}", file=sys.stderr)
    rates = [1e3 / float(np.mean(one["gaps"]["fgloc"])) for one in runs]
    yield Row(prefix + "rate_hz", min(rates), n=len(runs), unit="Hz")
    for name, label in (("fgloc", ""), ("relay", "relay_")):
        latencies = np.concatenate([one["latencies"][name] for one in runs])
        for share in (50, 99):
            value = float(np.percentile(latencies, share))
            yield Row(f"{prefix}{label}latency_ms_p{share}", value, n=len(latencies), unit="ms")
        yield Row(f"{prefix}{label}cpu_share", max(one["shares"][name] for one in runs), n=len(runs))


def _described(one: Mapping[str, Any]) -> str:
    rates = {name: round(1e3 / float(np.mean(gaps)), 2) for name, gaps in one["gaps"].items()}
    latencies = {n: np.percentile(of, (50, 99, 100)).round(1).tolist() for n, of in one["latencies"].items()}
    poses = {name: len(of) for name, of in one["latencies"].items()}
    shares = {name: round(share, 3) for name, share in one["shares"].items()}
    load = os.getloadavg()[0]
    return f"Hz {rates}, ms {latencies}, cores {shares}, {poses} of {one['images']} images, load {load:.1f}"


def fast(kinds: Sequence[str]) -> Iterator[Row]:
    """Rows with 30 images a second, of a drive that is recorded in the simulator first."""
    from fgloc_datasets.sim.camera import RenderError
    from fgloc_datasets.sim.record import record
    from fgloc_datasets.sim.scenario import Scenario

    content = yaml.safe_load((SAMPLES / _NAMES[-1] / "scenario.yaml").read_text("utf-8"))
    scenario = Scenario.model_validate(content["scenario"])
    assert scenario.camera is not None
    camera = scenario.camera.model_copy(update={"rate_hz": _FAST_HZ})
    with TemporaryDirectory(prefix="fgloc-ros-") as folder:
        try:
            made = scenario.model_copy(update={"camera": camera, "duration_s": _FAST_S})
            record(made, content["seed"], Path(folder) / "run")
        except RenderError as error:
            yield from not_run((name for name in _IDS if name.startswith("ros.fast_")), str(error))
            return
        yield from timing("ros.fast_", kinds, Path(folder) / "run")


def two_robots(kinds: Sequence[str]) -> Iterator[Row]:
    """Rows of two robots in one domain."""
    crossed, shares = 0, []
    samples = [SAMPLES / name for name in _NAMES]
    for kind in kinds:
        found = ask("two", kind, bags=[str(s / "bag") for s in samples], parameters=[parameters(s) for s in samples])
        for (name, one), other, sample in zip(found.items(), reversed(found), samples, strict=True):
            off, share = apart_mm(one["poses"], sample)
            reads = [topic for topic in one["reads"] if topic.startswith(f"/{other}/")]
            wrong = sum(distance > _SAME_MM for distance in off)
            crossed += wrong + len(reads) + one["shared_tf"] + (one["code"] != 0)
            shares.append(share)
            print(
                f"{kind} {name}: {wrong} keyframes differ, by {max(off, default=np.nan):.4g} mm; {share:.3f} there; "
                f"reads of the other {reads}; {one['tf']} own messages of tf, {one['shared_tf']} shared; "
                f"{one['code']}; {one['dropped']}",
                file=sys.stderr,
            )
    yield Row("ros.two_robots", crossed, n=2 * len(kinds))
    yield Row("ros.two_robots_keyframes", min(shares), n=2 * len(kinds))


def lifecycle(kinds: Sequence[str], count: int) -> Iterator[Row]:
    """Rows of random transitions and kills."""
    sample, gained, crashes, orphans = SAMPLES / _NAMES[0], [], 0, 0
    for seed, kind in enumerate(kinds):
        found = ask(
            *("lifecycle", kind, 3600.0),
            bag=str(sample / "bag"),
            parameters=parameters(sample),
            count=count // len(kinds),
            seed=seed,
        )
        memory = found["memory_mb"]
        crashes += len(found["crashes"]) + (found["code"] != 0)
        orphans += found["orphans"]
        settled = memory[min(_SETTLED, len(memory)) - 1] if memory else 0.0
        gained.append(max(memory[_SETTLED:], default=settled) - settled)
        print(f"{kind}: { {k: v for k, v in found.items() if k != 'log'} }", file=sys.stderr)
    yield Row("ros.lifecycle_crashes", crashes, n=count)
    yield Row("ros.lifecycle_orphans", orphans, n=count)
    yield Row("ros.lifecycle_mb", max(gained), n=len(gained), unit="MB")


def cli(kinds: Sequence[str]) -> Iterator[Row]:
    """Row of the commands of ROS."""
    sample, asked = SAMPLES / _NAMES[0], []
    for kind in kinds:
        for participant in (False, True):
            for one in ask(
                *("commands", kind, 1800.0),
                bag=str(sample / "bag"),
                parameters=parameters(sample),
                participant=participant,
            ):
                asked.append(one)
                if one["first_wrong"]:
                    print(f"{kind} {'live' if participant else 'node'}: {one}", file=sys.stderr)
    own, bare = ([one for one in asked if one["bare"] is is_bare] for is_bare in (False, True))
    yield Row("ros.cli_wrong", sum(bool(one["wrong"]) for one in own), n=len(own))
    for name, group in (("", own), ("bare_", bare)):
        again = [one for one in group if one["first_wrong"]]
        yield Row(f"ros.cli_{name}again", len(again) / len(group), n=len(group))


if __name__ == "__main__":
    main(measure, __doc__ or "")
