"""A live run in one process, against the truth: `python -m benchmarks.live`.

- ``live.latency_ms_*``: bundled samples pushed in real time: from an image's arrival to the estimate of its exposure,
  that is, exposure to pose less the recorded transport delay.
- ``live.extrapolated_over_keyframe``: meanwhile the newest pose is asked for at 50 Hz: its mean error over that of the
  keyframes.
- ``live.extrapolated_gripping``: likewise of those poses only since whose keyframe no wheel has slipped: the beginning
  of a slip is in no measurement before the next sighting.
- ``live.disorder_ate_ratio``: simulated recordings as installed, with all that `benchmarks.live_streams` calls
  disordered, over the orderly stream: mean error of the keyframes; ``live.disorder_now_ratio``: of the newest pose,
  which has a camera that is 300 ms late behind it.
- ``live.resume_*``: killed while driving and started again: see `benchmarks.live_resume`.
- ``live.million_*``, ``live.wrong_ids_ratio``: see `benchmarks.live_endurance`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from benchmarks import live_endurance, live_resume
from benchmarks.common import Row, main
from benchmarks.live_streams import disordered, roles_of, truth_of
from benchmarks.recordings import SEEDS, Recorded, Take, load, prepare
from fgloc import se2
from fgloc.config import load_config
from fgloc.frames import quaternion_yaw
from fgloc.live import Live, LivePose
from fgloc.recording.messages import Messages
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import Storage
from fgloc.sensors.markers.images import ImageEvent
from fgloc.types import Estimate, Event, FloatArray, IntArray, TruthEvent

SAMPLES = Path(__file__).resolve().parent.parent / "datasets" / "samples"
_TIMED = ("installed_run", "patches_run", "light_drop_run")
_SLIPPING = "/truth/slipping"  # std_msgs/Bool, at 50 Hz
_TOLD_NS = 20_000_000
_QUICK_S = 10.0
_ASK_HZ = 50.0
_ASK_EVERY = 20  # events, where the stream is faster than real time


def measure(quick: bool) -> Iterator[Row]:
    """Rows of the benchmark."""
    yield from timed(_TIMED[:1] if quick else _TIMED, _QUICK_S if quick else None)
    yield from disorder(SEEDS["test"][: 1 if quick else 5])
    yield from live_resume.measure(quick)
    yield from live_endurance.measure(quick)


# --- In real time -----------------------------------------------------------------------------------------------------


def timed(samples: Iterable[str], seconds: float | None) -> Iterator[Row]:
    """Latency, and the error of poses at 50 Hz."""
    latencies: list[float] = []
    ratios, gripping = [], []
    for name in samples:
        sample = _Timed(SAMPLES / name, seconds)
        sample.run()
        latencies += sample.latencies_ms
        ratios.append(sample.ratio())
        gripping.append(sample.ratio(gripping=True))
    yield Row("live.latency_ms_p50", float(np.percentile(latencies, 50)), n=len(latencies), unit="ms")
    yield Row("live.latency_ms_p99", float(np.percentile(latencies, 99)), n=len(latencies), unit="ms")
    yield Row("live.extrapolated_over_keyframe", float(np.mean(ratios)), float(np.std(ratios)), len(ratios))
    yield Row("live.extrapolated_gripping", float(np.mean(gripping)), float(np.std(gripping)), len(gripping))


class _Timed:
    """One recording, pushed with its own timing."""

    def __init__(self, folder: Path, seconds: float | None) -> None:
        self.latencies_ms: list[float] = []
        self._config = load_config(folder / "robot.yaml")
        with open_recording(folder / "bag", self._config.recording) as recording:
            self._roles = set(recording.roles)
            self._events = list(recording.events())
        if seconds is not None:
            end = self._events[0].received_ns + round(seconds * 1e9)
            self._events = [e for e in self._events if e.received_ns < end]
        truths = [e for e in self._events if isinstance(e, TruthEvent)]
        self._stamps = np.array([e.stamp_ns for e in truths])
        self._truth = np.array([(*e.position[:2], quaternion_yaw(e.orientation)) for e in truths])
        self._map = folder / "map.yaml"
        self._slips = _slips(folder / "bag")
        self._pushed: dict[int, float] = {}
        self._estimates: list[Estimate] = []
        self._asked: list[LivePose] = []

    def run(self) -> None:
        """Push the recording's events with their timing, and ask for poses meanwhile."""
        done = threading.Event()
        with Live(self._config, self._map, roles=self._roles) as live:  # type: ignore[arg-type]
            live.subscribe(self._take)
            asking = threading.Thread(target=self._ask, args=(live, done))
            asking.start()
            began, first = time.perf_counter(), self._events[0].received_ns
            for event in self._events:
                time.sleep(max(0.0, (event.received_ns - first) * 1e-9 - (time.perf_counter() - began)))
                if isinstance(event, ImageEvent):
                    self._pushed[event.stamp_ns] = time.perf_counter()
                live.push(event)
            live.wait()
            done.set()
            asking.join()

    def _take(self, estimate: Estimate) -> None:
        self._estimates.append(estimate)
        pushed = self._pushed.get(estimate.stamp_ns)
        if pushed is not None:
            self.latencies_ms.append((time.perf_counter() - pushed) * 1e3)

    def _ask(self, live: Live, done: threading.Event) -> None:
        due = time.perf_counter()
        while not done.is_set():
            pose = live.pose_at()
            if pose is not None:
                self._asked.append(pose)
            due += 1.0 / _ASK_HZ
            time.sleep(max(0.0, due - time.perf_counter()))

    def ratio(self, gripping: bool = False) -> float:
        """Mean error of the poses at 50 Hz over that of the keyframes; ``gripping``: while no wheel slips."""
        asked, made = self._asked, self._estimates
        if gripping:
            asked = [p for p in asked if not self._slipped(p.keyframe_ns, p.stamp_ns)]
            made = [e for e in made if not self._slipped(e.stamp_ns, e.stamp_ns)]
        return self._error(asked) / self._error(made)

    def _slipped(self, start_ns: int, end_ns: int) -> bool:
        first, last = np.searchsorted(self._slips, [start_ns - _TOLD_NS, end_ns + _TOLD_NS])
        return bool(last > first)

    def _error(self, told: Iterable[Estimate | LivePose]) -> float:
        inside = [p for p in told if self._stamps[0] <= p.stamp_ns <= self._stamps[-1]]
        truth = se2.interpolate(self._stamps, self._truth, np.array([p.stamp_ns for p in inside]))
        return float(np.hypot(*(np.array([p.pose for p in inside]) - truth)[:, :2].T).mean())


def _slips(bag: Path) -> IntArray:
    """Times ``(n,)`` at which a wheel slips, as the simulation has it."""
    storage, messages = Storage(bag), Messages()
    told = [(stamp, messages.decode(kind, raw).data) for _, kind, stamp, raw in storage.messages({_SLIPPING})]
    storage.close()
    return np.array([stamp for stamp, slips in told if slips], dtype=np.int64)


# --- Disorder ---------------------------------------------------------------------------------------------------------


def disorder(seeds: Iterable[int]) -> Iterator[Row]:
    """Rows of the errors where everything goes wrong on the way at once, over those of orderly events."""
    takes = [Take("installed", "unequal_radii", "test", seed) for seed in seeds]
    prepare(takes)
    keyframes, now = [], []
    for take in takes:
        recorded = load(take)
        orderly = _errors(recorded, recorded.events)
        rng = np.random.default_rng(take.seed)
        wild = _errors(recorded, disordered(recorded.events, recorded.start_ns, rng))
        keyframes.append(wild[0] / orderly[0])
        now.append(wild[1] / orderly[1])
    yield Row("live.disorder_ate_ratio", float(np.mean(keyframes)), float(np.std(keyframes)), len(keyframes))
    yield Row("live.disorder_now_ratio", float(np.mean(now)), float(np.std(now)), len(now))


def _errors(recorded: Recorded, events: Iterable[Event]) -> tuple[float, float]:
    """Mean distances from the truth [m]: of the keyframes, and of the newest pose at all times."""
    made: list[Estimate] = []
    asked: list[LivePose] = []
    roles = roles_of(recorded.events)
    with Live(recorded.config, recorded.landmarks, roles=roles, camera=recorded.camera) as live:  # type: ignore[arg-type]
        live.subscribe(made.append)
        for k, event in enumerate(events):
            live.push(event)
            if k % _ASK_EVERY == 0:
                live.wait()
                pose = live.pose_at()
                asked += [] if pose is None else [pose]
        live.wait()
    truth = truth_of(recorded)
    return _mean_distance(made, truth), _mean_distance(asked, truth)


def _mean_distance(told: Iterable[Estimate | LivePose], truth: Callable[[int], FloatArray]) -> float:
    return float(np.nanmean([np.hypot(*(p.pose - truth(p.stamp_ns))[:2]) for p in told]))


if __name__ == "__main__":
    main(measure, __doc__)
