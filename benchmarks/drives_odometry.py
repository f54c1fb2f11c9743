"""A second odometry beside the wheels of the simulated robot: error, consistency, and how soon its failure is named.

``python -m benchmarks.drives_odometry [--quick] [--json FILE]``

The robots are those of `benchmarks.installed` (floor with patches, as installed, ten seeds), with their cameras. Topic
``/odom`` holds another odometry, 20 Hz: the truth at a place 0.1 m ahead of the base and turned by 0.05 rad (the settings
say 0.09 m and 0.04 rad), distances 1 % long, stamps 10 ms late, increments with white noise of 5 mm and 3 mrad. Its twist
has the covariance of that noise, in ``scale10`` a tenth of it.

- ``sim.odometry.none.{ate_mm,nees}``: without it, as `benchmarks.installed` runs them online.
- ``sim.odometry.{sound,scale10,frozen,jump}.{ate_mm,nees}``: with it; frozen for 20 s from 30 s on, or its pose jumps by
  0.5 m and 0.3 rad at 30 s. ``nees`` is NEES/3 of all poses.
- ``sim.odometry.{frozen,jump}.named_s``: from the failure (frozen: from the first 0.02 m that the robot goes in it) to the
  first step that leaves the source out, the largest of the seeds. ``.wrongly_named``: share of the steps
  of ``sound`` in which it is left out.

Nothing was chosen on these seeds; thresholds were set by what robots do (docs/odometries.md).
"""

# ruff: noqa: E501 (lines of the description)
from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.common import Row, main
from benchmarks.recordings import SEEDS, Recorded, Take, changed, load
from benchmarks.replays import failure
from fgloc import se2
from fgloc.ablation.failures import corrupt, generators
from fgloc.evaluation.metrics import compute_metrics
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.runner import run
from fgloc.sensors.failures import Scene
from fgloc.sensors.odometry import BesideEvent
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.types import Estimate, Event, Step, TruthEvent

NAME = "odometry.visual"
FAILED_S = (30.0, 50.0)
_RATE_NS = 50_000_000
_LATE_NS = 10_000_000
_MOUNTED, _TOLD = (0.1, 0.0, 0.05), (0.09, 0.0, 0.04)
_LONG = 1.01
_SIGMAS = np.array([0.005, 0.005, 0.003])  # m, m, rad of an increment
_MOVED_M = 0.02
CASES = {
    "sound": (1.0, ()),
    "scale10": (0.1, ()),
    "frozen": (1.0, ({"kind": "odometries_frozen", "when": {"intervals": [FAILED_S]}},)),
    "jump": (1.0, ({"kind": "odometries_jump", "when": {"intervals": [FAILED_S]}},)),
}


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures of one run."""

    ate_mm: float
    nees: float
    named_s: float
    left_out: float


def second_odometry(recorded: Recorded, seed: int, told: float) -> list[BesideEvent]:
    """Messages of the second odometry, by the truth; ``told``: variance that it reports over its own."""
    rng = np.random.default_rng(seed)
    events: list[BesideEvent] = []
    last, pose, due = None, np.array([1.0, -2.0, 0.7]), 0
    cov = np.zeros((6, 6))
    cov[np.ix_((0, 1, 5), (0, 1, 5))] = told * np.diag(_SIGMAS**2) / (_RATE_NS * 1e-9) ** 2
    for event in recorded.events:
        if not isinstance(event, TruthEvent) or event.stamp_ns < due:
            continue
        true = np.array([event.position[0], event.position[1], quaternion_yaw(event.orientation)])
        tracked = se2.compose(true, _MOUNTED)
        step, seconds = np.zeros(3), 1.0
        if last is not None:
            step = se2.between(last[1], tracked) * (_LONG, _LONG, 1.0) + _SIGMAS * rng.standard_normal(3)
            seconds = (event.stamp_ns - last[0]) * 1e-9
        last, due = (event.stamp_ns, tracked), event.stamp_ns + _RATE_NS - 1_000_000
        pose = se2.compose(pose, step)
        vx, vy, w = se2.log(step) / seconds
        events.append(
            BesideEvent(
                event.stamp_ns + _LATE_NS,
                event.received_ns + _LATE_NS,
                "/odom",
                "visual",
                "",
                np.array([pose[0], pose[1], 0.0]),
                yaw_quaternion(float(pose[2])),
                np.zeros((6, 6)),
                np.array([vx, vy, 0.0]),
                np.array([0.0, 0.0, w]),
                cov,
            )
        )
    return events


def scored(seed: int, case: str | None) -> Scores:
    """One run of a seed's recording; ``case``: of `CASES`, None: without the second odometry."""
    recorded = load(Take("installed", "patches", "test", seed))
    told, described = CASES[case] if case is not None else (1.0, ())
    chain = [failure(dict(one)) for one in described]
    topics = {"topics": {"odometry": "none"}}
    if case is not None:
        topics["odometries"] = [{"name": "visual", "topic": "/odom", "pose": _TOLD}]  # type: ignore[assignment]
    config = changed(recorded.config, {"recording": topics, "motion": {"use": False}})
    added = second_odometry(recorded, seed, told) if case is not None else []
    kept = [e for e in recorded.events if not isinstance(e, OdometryEvent)]
    events: Sequence[Event] = sorted([*kept, *added], key=lambda e: e.received_ns)
    scenes = [Scene(recorded.start_ns, recorded.duration_s, config, (), rng) for rng in generators(len(chain), seed)]
    named: list[tuple[float, bool]] = []  # when a step was judged, and whether it left the source out

    def note(step: Step, estimate: Estimate | None) -> None:
        rows = [d for d in (estimate.decisions if estimate is not None else ()) if d.kind == NAME]
        if rows:
            named.append(((step.stamp_ns - recorded.start_ns) * 1e-9, any(d.reason for d in rows)))

    result = run(
        recorded.bag,
        recorded.map_path,
        config,
        "online",
        on_step=note,
        events=lambda _: corrupt(chain, "recorded", iter(events), scenes),
    )
    metrics = compute_metrics(result, config)
    begun = recorded.truth[recorded.truth[:, 0] >= FAILED_S[0]]
    went = np.append(0.0, np.cumsum(np.hypot(*np.diff(begun[:, 1:3], axis=0).T)))
    since_s = float(begun[np.argmax(went > _MOVED_M), 0]) if case == "frozen" else FAILED_S[0]
    after = [t for t, wrong in named if wrong and t >= FAILED_S[0]]
    return Scores(
        1e3 * (metrics.ate_mean_m or math.nan),
        metrics.nees_over_3 or math.nan,
        min(after, default=math.inf) - since_s,
        float(np.mean([wrong for _, wrong in named])) if named else 0.0,
    )


def measure(quick: bool) -> Iterator[Row]:
    """Rows of all cases."""
    seeds = SEEDS["test"][: 2 if quick else None]
    for case in (None, *CASES):
        found = [scored(seed, case) for seed in seeds]
        name, n = f"sim.odometry.{case or 'none'}", len(found)
        for key, unit in (("ate_mm", "mm"), ("nees", "")):
            values = [getattr(s, key) for s in found]
            yield Row(f"{name}.{key}", float(np.mean(values)), float(np.std(values)), n, unit)
        if case in ("frozen", "jump"):
            values = [s.named_s for s in found]
            yield Row(f"{name}.named_s", max(values), float(np.std(values)), n, "s")
        elif case == "sound":
            yield Row(f"{name}.wrongly_named", float(np.mean([s.left_out for s in found])), None, n)


if __name__ == "__main__":
    main(measure, __doc__ or "")
