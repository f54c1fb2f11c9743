"""A live run that is killed while the robot drives, and started again: `python -m benchmarks.live_resume`.

A process of its own replays a recording as installed in real time and saves its state; it is killed with SIGKILL at
random times, and started again, while the recording goes on. ``live.resume_s``: from its start until it has told a pose
of mode OK, its libraries being loaded (what that takes is in the time away); ``live.resume_lost``: how often the first
such pose, or the last before the next kill, was off by more than its covariance allows at three sigmas.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from benchmarks.common import Row, main
from benchmarks.live_streams import roles_of, truth_of
from benchmarks.recordings import SEEDS, Recorded, Take, load, prepare
from fgloc import se2
from fgloc.live import Live
from fgloc.types import Estimate, FloatArray, Mode

_KILLS = 20
_DRIVES_S = (5.0, 9.0)  # from a start to the next kill ...
_AWAY_S = (1.0, 3.0)  # ... and from that to the next start: what the interpreter and its libraries take
_FORK = get_context("fork")  # the recording is in memory already
_LEAST_LEFT_S = 8.0  # of a recording, for another kill
_THREE_SIGMAS = 14.16  # chi-square of three degrees of freedom that is exceeded as seldom as three sigmas


@dataclass(frozen=True, slots=True)
class _Start:
    """Seconds until OK in one process, and squared Mahalanobis distances of its first OK pose and of its last pose."""

    ok_s: float
    first: float
    last: float


def measure(quick: bool) -> Iterator[Row]:
    """Both rows."""
    takes = [Take("installed", "unequal_radii", "test", seed) for seed in SEEDS["test"]]
    prepare(takes[:1] if quick else takes)
    rng = np.random.default_rng(0)
    starts: list[_Start] = []
    for take in takes:
        starts += _drive(take, rng)
        if quick or len(starts) >= _KILLS:
            break
    starts = starts[:_KILLS]
    seconds = [start.ok_s for start in starts]
    lost = sum(max(start.first, start.last) > _THREE_SIGMAS for start in starts)
    yield Row("live.resume_s", float(np.mean(seconds)), float(np.max(seconds)), len(starts), "s (spread: the longest)")
    yield Row("live.resume_lost", lost, n=len(starts))


def _drive(take: Take, rng: np.random.Generator) -> Iterator[_Start]:
    """Start again and again while one recording goes on; without the first start, which has nothing to resume."""
    recorded = load(take)
    truth = truth_of(recorded)
    with tempfile.TemporaryDirectory() as folder:
        epoch, first = time.time(), True
        while first or time.time() - epoch < recorded.duration_s - _LEAST_LEFT_S:
            reader, writer = _FORK.Pipe(duplex=False)
            child = _FORK.Process(target=_live, args=(recorded, epoch, Path(folder) / "state.json", writer))
            child.start()
            writer.close()
            time.sleep(float(rng.uniform(*_DRIVES_S)))
            child.kill()
            child.join()
            told = _told(reader)
            if not first and told:
                yield _scored(told, truth)
            first = False
            time.sleep(float(rng.uniform(*_AWAY_S)))


def _told(reader: Connection) -> list[tuple[float, Estimate]]:
    """Seconds since its start, and the estimate, of every keyframe of a child that was killed."""
    told = []
    try:
        while True:
            since_s, stamp_ns, mode, pose, cov = json.loads(reader.recv_bytes())
            told.append((since_s, Estimate(stamp_ns, np.array(pose), np.array(cov), Mode(mode))))
    except (EOFError, OSError, ValueError):  # it was killed, perhaps while it wrote
        return told


def _scored(told: list[tuple[float, Estimate]], truth: Callable[[int], FloatArray]) -> _Start:
    sound = [(since_s, e) for since_s, e in told if e.mode is Mode.OK]
    if not sound:
        return _Start(float(told[-1][0]), np.inf, np.inf)
    return _Start(sound[0][0], _distance(sound[0][1], truth), _distance(told[-1][1], truth))


def _distance(estimate: Estimate, truth: Callable[[int], FloatArray]) -> float:
    """Squared Mahalanobis distance from the truth."""
    error = se2.log(se2.between(estimate.pose, truth(estimate.stamp_ns)))
    cov = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
    return float(error @ np.linalg.solve(cov, error))


def _live(recorded: Recorded, epoch: float, state: Path, out: Connection) -> None:
    """Replay from now on, in real time, until killed; send every estimate."""
    began = time.time()

    def tell(e: Estimate) -> None:
        row = [time.time() - began, e.stamp_ns, e.mode.value, e.pose.tolist(), e.cov.tolist()]
        out.send_bytes(json.dumps(row).encode())

    roles = roles_of(recorded.events)
    live = Live(recorded.config, recorded.landmarks, state=state, roles=roles, camera=recorded.camera)  # type: ignore[arg-type]
    live.subscribe(tell)
    start_ns = recorded.start_ns + round((time.time() - epoch) * 1e9)
    for event in recorded.events:
        if event.received_ns < start_ns:
            continue
        time.sleep(max(0.0, (event.received_ns - recorded.start_ns) * 1e-9 - (time.time() - epoch)))
        live.push(event)
    time.sleep(60.0)  # to be killed


if __name__ == "__main__":
    main(measure, __doc__)
