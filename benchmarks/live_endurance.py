"""Long live runs, and live runs where nothing fits the map: `python -m benchmarks.live_endurance`.

- ``live.million_*``: a million keyframes of a robot that drives in a circle among beacons, at once, in one process:
  processor time of a keyframe in the last tenth over that in the first, each over that of a run that has just begun, in
  another process, so that other work on the machine does not count; memory gained after the first tenth.
- ``live.wrong_ids_ratio``: on recordings as installed with every marker read as another one, and with the mirrored map:
  processor time of an update over that of the sound run, the larger of the two.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.common import Row, main
from benchmarks.live_streams import (
    SIGHTINGS_HZ,
    circle,
    circle_config,
    circle_map,
    mirrored,
    wrong_ids,
)
from benchmarks.recordings import SEEDS, Recorded, Take, load, prepare
from fgloc.config import Config, Role
from fgloc.live.run import LiveFacts, OnlineRun
from fgloc.sensors.markers.images import CornersEvent
from fgloc.types import Camera, Event, LandmarkMap, Step

_MILLION = 1_000_000
_BLOCKS = 50  # parts of the run that are timed one by one
_FRESH = 60  # keyframes of the runs that they are compared with
_WARM_UP_S = 20.0


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    yield from wrong(quick)
    yield from million(20_000 if quick else _MILLION)


def run_of(
    config: Config, landmark_map: LandmarkMap, events: Iterable[Event], camera: Camera | None = None
) -> Iterator[tuple[Step, float]]:
    """Every step of a live run without its threads, and the processor time [s] of the run since the one before."""
    held = iter(events)
    begun: list[Event] = []
    facts = LiveFacts(config, None, camera)
    expected: set[Role] = set()
    for event in held:
        begun.append(event)
        if facts.topic_is_used(event):
            facts.note(event)
        expected = set(facts.roles)
        if event.received_ns - begun[0].received_ns > 1e9 and expected:
            break
    run = OnlineRun(config, landmark_map, facts)
    run.build()
    spent = 0.0
    for event in _chained(begun, held):
        began = time.thread_time()
        passed = run.check(event)
        steps = [] if passed is None else [step for step, _ in run.use(passed, isinstance(passed, CornersEvent))]
        spent += time.thread_time() - began
        for step in steps:
            yield step, spent / len(steps)
        spent = 0.0 if steps else spent


def _chained(first: list[Event], rest: Iterator[Event]) -> Iterator[Event]:
    yield from first
    first.clear()
    yield from rest


def million(count: int) -> Iterator[Row]:
    """Cost and memory of so many keyframes."""
    block = count // _BLOCKS
    costs, memory, spent_s = [], [], 0.0
    events = circle(count / SIGHTINGS_HZ + _WARM_UP_S)
    with ProcessPoolExecutor(1, get_context("spawn")) as beside:
        for k, (_, spent) in zip(range(count), run_of(circle_config(), circle_map(), events), strict=False):
            spent_s += spent
            if k % block == block - 1:
                memory.append(_resident_mb())
                costs.append(spent_s / block / beside.submit(_fresh_s).result())
                spent_s = 0.0
    tenth = _BLOCKS // 10
    growth = float(np.median(costs[-tenth:]) / np.median(costs[:tenth]))
    yield Row("live.million_growth", growth, n=count)
    yield Row("live.million_mb", max(memory[tenth:]) - memory[tenth - 1], n=count, unit="MB")


def _fresh_s() -> float:
    """Processor time of a keyframe of a run that has just begun [s]: how fast this machine is at the moment."""
    steps = run_of(circle_config(), circle_map(), circle(_FRESH / SIGHTINGS_HZ + _WARM_UP_S, seed=1))
    return float(np.mean([spent for k, (_, spent) in enumerate(steps) if k >= _FRESH // 2]))


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() * 1e-6


def wrong(quick: bool) -> Iterator[Row]:
    """Row of the cost of updates where nothing that is seen fits the map."""
    takes = [Take("installed", "unequal_radii", "test", seed) for seed in SEEDS["test"][: 1 if quick else 5]]
    prepare(takes)
    ratios = [_ratio(load(take), take.seed) for take in takes]
    yield Row("live.wrong_ids_ratio", float(np.mean(ratios)), float(np.std(ratios)), len(ratios))


def _ratio(recorded: Recorded, seed: int) -> float:
    ids = wrong_ids(recorded.events, recorded.landmarks.landmarks, np.random.default_rng(seed))
    sound = _cost(recorded, recorded.landmarks, recorded.events)
    misread = _cost(recorded, recorded.landmarks, ids)
    return max(misread, _cost(recorded, mirrored(recorded.landmarks), recorded.events)) / sound


def _cost(recorded: Recorded, landmark_map: LandmarkMap, events: Iterable[Event]) -> float:
    """Mean processor time of a keyframe [s]."""
    return float(np.mean([spent for _, spent in run_of(recorded.config, landmark_map, events, recorded.camera)]))


if __name__ == "__main__":
    main(measure, __doc__)
