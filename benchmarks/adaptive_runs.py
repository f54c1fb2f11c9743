"""One cell of the benchmark of adaptive weights: a failure on a floor, replayed for some seeds with some configuration.

    >>> from benchmarks.adaptive_runs import cell
    >>> cell("slip", (22, 23), {"weights": {"window_s": 1.0}}, split="validation")  # doctest: +SKIP

Failures are those of `fgloc.ablation.failures`; what is random in them is drawn anew for each seed. Online and batch
come from the same replay.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from benchmarks.adaptive_recordings import Floor, Recorded, Split, load, moved_interval, slip_intervals
from benchmarks.adaptive_scores import Figures, lost, score
from fgloc.ablation.failures import AnyFailure, corrupt, generators
from fgloc.config import Config, config_of
from fgloc.errors import EstimatorError
from fgloc.runner import RunResult, protections, run
from fgloc.sensors.failures import Failure, Scene
from fgloc.sensors.maps import write_map
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent
from fgloc.types import Estimate, Event, LandmarkMap, Step, Trajectory

Changes = Mapping[str, Any]
Interval = tuple[float, float]

FAILED_S = (30.0, 50.0)  # when encoders fail
KIDNAPPED_S, KIDNAPPED_M = 30.0, (3.0, 2.5, 2.0, 1.5, 1.0)  # the farthest that the drive allows
MOVED_M = 0.5
_FAILURE = TypeAdapter(AnyFailure)


@dataclass(frozen=True, slots=True)
class Case:
    """A failure on a floor."""

    floor: Floor
    chain: Callable[[Recorded], list[dict[str, Any]]] = lambda recorded: []
    wheels_wrong: Callable[[Recorded], list[Interval]] | None = (
        None  # when wheels fail, for the oracle [s]; None: not known
    )


def _dark(length_s: float) -> Case:
    start = 0.5 * (80.0 - length_s)
    failure = {"kind": "dropout", "sensor": "camera", "when": {"intervals": [(start, start + length_s)]}}
    return Case("patches", lambda recorded: [failure], slip_intervals)


def _wrong_ids(share: float) -> Case:
    return Case("unequal_radii", lambda recorded: [{"kind": "wrong_ids", "probability": share}])


def _encoders(failure: dict[str, Any]) -> Case:
    told = failure | {"when": {"intervals": [FAILED_S]}}
    return Case("unequal_radii", lambda recorded: [told], lambda recorded: [(FAILED_S[0], FAILED_S[1] + 0.2)])


CASES: dict[str, Case] = {
    "none": Case("unequal_radii"),
    "slip": Case("patches", wheels_wrong=slip_intervals),
    "mu01": Case("slippery", wheels_wrong=slip_intervals),
    "dark30": _dark(30.0),
    "dark60": _dark(60.0),
    "ids10": _wrong_ids(0.1),
    "ids30": _wrong_ids(0.3),
    "ids50": _wrong_ids(0.5),
    "moved": Case(
        "unequal_radii",
        lambda recorded: [{"kind": "moved_marker", "ids": [moved_id(recorded)], "distance_m": MOVED_M}],
    ),
    "frozen": _encoders({"kind": "encoder_frozen"}),
    "onewheel": _encoders({"kind": "encoder_dead", "wheel": "left"}),
    "kidnap": Case(
        "unequal_radii",
        lambda recorded: [{"kind": "kidnap", "when": {"intervals": [carried_interval(recorded)]}}],
    ),
    "lifted": Case(
        "unequal_radii",
        lambda recorded: [{"kind": "lift", "when": {"intervals": [carried_interval(recorded)]}}],
    ),
}


def cell(
    name: str,
    seeds: Iterable[int],
    changes: Changes | None = None,
    *,
    oracle: bool = False,
    batch: bool = False,
    split: Split = "test",
) -> list[Figures]:
    """Replay a case for each seed.

    Args:
        name: of `CASES`.
        seeds: of the split's recordings.
        changes: of the configuration, as nested mappings.
        oracle: give the weights the times when the wheels are wrong.
        batch: smooth as well.
        split: of the simulated suite.
    """
    case = CASES[name]
    out = []
    for seed in seeds:
        recorded = load(case.floor, split, seed)
        chain = [failure(described) for described in case.chain(recorded)]
        config = changed(recorded.config, changes or {})
        if oracle and case.wheels_wrong is not None:
            config = changed(config, distrusting(case.wheels_wrong(recorded)))
        out.append(replay(recorded, config, chain, seed, batch))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """Results of one run of a recording with failures.

    Attributes:
        online: the estimates as they were made, with all decisions.
        batch: the smoothed run, if it was asked for.
        chain: the failures.
        given: the images' corners that the localizer was given.
        steps: that it was given.
        landmarks: the map that it was given.
    """

    online: RunResult
    batch: RunResult | None
    chain: Sequence[Failure]
    given: Sequence[Event]
    steps: Sequence[Step]
    landmarks: LandmarkMap


def replay(recorded: Recorded, config: Config, chain: Sequence[Failure], seed: int, batch: bool) -> Figures:
    """Figures of one run of a recording with failures.

    Raises:
        FglocError: the configuration does not fit the recording.
    """
    made = replayed(recorded, config, chain, seed, batch)
    return lost(seed) if made is None else score(recorded, seed, config, made.online, made.batch, chain, made.given)


def replayed(recorded: Recorded, config: Config, chain: Sequence[Failure], seed: int, batch: bool) -> Replayed | None:
    """One run of a recording with failures; None if no pose was ever found.

    Raises:
        FglocError: the configuration does not fit the recording.
    """
    ids = tuple(sorted(recorded.landmarks.landmarks))
    scenes = [Scene(recorded.start_ns, recorded.duration_s, config, ids, rng) for rng in generators(len(chain), seed)]
    estimates: list[Estimate] = []
    steps: list[Step] = []
    given: list[Event] = []

    def note(step: Step, estimate: Estimate | None) -> None:
        steps.append(step)
        if estimate is not None:
            estimates.append(estimate)

    def keep(events: Iterator[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, CornersEvent):
                given.append(event)
            yield event

    with tempfile.TemporaryDirectory() as folder:
        map_path, landmarks = recorded.map_path, recorded.landmarks
        for failure, scene in zip(chain, scenes, strict=True):
            landmarks = failure.corrupt_map(landmarks, scene)
        if landmarks is not recorded.landmarks:
            map_path = Path(folder) / "map.yaml"
            write_map(landmarks, map_path)
        try:
            result = run(
                recorded.bag,
                map_path,
                config,
                "batch" if batch else "online",
                on_step=note,
                events=lambda _: corrupt(chain, "recorded", iter(recorded.events), scenes),
                sightings=lambda events: keep(corrupt(chain, "sightings", events, scenes)),
            )
        except EstimatorError:
            if estimates:
                raise
            return None
    online = replace(
        result,
        trajectory=_trajectory(estimates),
        modes=tuple(e.mode for e in estimates),
        protections=protections(estimates),
    )
    return Replayed(online, result if batch else None, chain, given, steps, landmarks)


def _trajectory(estimates: Sequence[Estimate]) -> Trajectory:
    return Trajectory(
        np.array([e.stamp_ns for e in estimates], dtype=np.int64),
        np.array([e.pose for e in estimates]),
        np.array([e.cov for e in estimates]),
    )


def changed(config: Config, changes: Changes) -> Config:
    """The configuration with some of its values replaced."""

    def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
        return {**old, **{k: merged(old[k], v) if isinstance(v, Mapping) else v for k, v in new.items()}}

    return config_of(merged(config.model_dump(), changes))


def distrusting(intervals: Sequence[Interval]) -> dict[str, Any]:
    """Configuration with the times when the wheels are wrong."""
    return {"weights": {"distrust": [{"source": "wheels", "start_s": a, "end_s": b} for a, b in intervals]}}


def failure(described: dict[str, Any]) -> Failure:
    """A failure as a suite of ablations describes it."""
    return _FAILURE.validate_python(described)


def carried_interval(recorded: Recorded) -> Interval:
    """Interval [s] that is cut out of a drive, so that the robot seems to be carried away.

    Raises:
        ValueError: the robot stays too near to where it is.
    """
    for distance_m in KIDNAPPED_M[:-1]:
        with suppress(ValueError):
            return moved_interval(recorded, KIDNAPPED_S, distance_m)
    return moved_interval(recorded, KIDNAPPED_S, KIDNAPPED_M[-1])


def moved_id(recorded: Recorded) -> int:
    """The landmark that is seen most often: moving another might change nothing."""
    seen = [s.landmark_id for e in recorded.events if isinstance(e, CornersEvent) for s in e.sightings]
    seen += [s.landmark_id for e in recorded.events if isinstance(e, RangeBearingEvent) for s in e.sightings]
    seen = [i for i in seen if i in recorded.landmarks]
    ids, counts = np.unique(seen, return_counts=True)
    return int(ids[int(np.argmax(counts))])
