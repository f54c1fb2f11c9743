"""A live run in one process, against the truth: `python -m benchmarks.live`.

- ``live.latency_ms_*``: bundled samples pushed in real time: from an image's arrival to the estimate of its exposure,
  that is, exposure to pose less the recorded transport delay.
- ``live.extrapolated_over_keyframe``: meanwhile the newest pose is asked for at 50 Hz: its mean error over that of the
  keyframes.
- ``live.extrapolated_gripping``: likewise of those poses only since whose keyframe no wheel has slipped: the beginning
  of a slip is in no measurement before the next sighting.
- ``live.disorder_ate_ratio``: simulated recordings as installed, with all that goes wrong on the way at once
  (`disordered`), over the orderly stream: mean error of the keyframes; ``live.disorder_now_ratio``: of the newest
  pose, which has a camera that is 300 ms late behind it.
- ``live.resume_s``: a process of its own replays a recording as installed in real time and saves its state; it is
  killed with SIGKILL at random times, and started again, while the recording goes on: time from its start until it has
  told a pose of mode OK, its libraries being loaded (what that takes is in the time away). ``live.resume_lost``: how
  often the first such pose, or the last before the next kill, was off by more than its covariance allows at three
  sigmas.
- ``live.million_*``: a million keyframes of a robot that drives in a circle among beacons, at once, in one process:
  processor time of a keyframe in the last tenth over that in the first, each over that of a run that has just begun, in
  another process, so that other work on the machine does not count; memory gained after the first tenth.
- ``live.wrong_ids_ratio``: on recordings as installed with every marker read as another one, and with the mirrored map:
  processor time of an update over that of the sound run, the larger of the two.
"""

from __future__ import annotations

import dataclasses
import json
import math
import resource
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from benchmarks.common import SAMPLES, Row, main, mean_row
from benchmarks.recordings import SEEDS, Recorded, Take, load, prepare
from fgloc import se2
from fgloc.config import Config, Role, config_of, load_config
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.live import Live, LivePose
from fgloc.live.run import LiveFacts, OnlineRun, role_of
from fgloc.recording.messages import Messages
from fgloc.recording.reader import open_recording
from fgloc.recording.storage import Storage
from fgloc.sensors.gyro import ImuEvent
from fgloc.sensors.markers.images import CornersEvent, ImageEvent, MarkerCorners
from fgloc.sensors.range_bearing import RangeBearing, RangeBearingEvent
from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import Camera, Estimate, Event, FloatArray, IntArray, Landmark, LandmarkMap, Mode, Step, TruthEvent

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
    yield from resumed(quick)
    yield from wrong(quick)
    yield from million(20_000 if quick else _MILLION)


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
    yield mean_row("live.extrapolated_over_keyframe", ratios)
    yield mean_row("live.extrapolated_gripping", gripping)


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
    yield mean_row("live.disorder_ate_ratio", keyframes)
    yield mean_row("live.disorder_now_ratio", now)


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


# --- Killed and started again -----------------------------------------------------------------------------------------


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


def resumed(quick: bool) -> Iterator[Row]:
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
            child = _FORK.Process(target=_replay, args=(recorded, epoch, Path(folder) / "state.json", writer))
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


def _replay(recorded: Recorded, epoch: float, state: Path, out: Connection) -> None:
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


# --- A million keyframes, and sightings that fit nothing --------------------------------------------------------------


_MILLION = 1_000_000
_BLOCKS = 50  # parts of the run that are timed one by one
_FRESH = 60  # keyframes of the runs that they are compared with
_WARM_UP_S = 20.0


def run_of(
    config: Config, landmark_map: LandmarkMap, events: Iterable[Event], camera: Camera | None = None
) -> Iterator[tuple[Step, Estimate | None, float]]:
    """Step and estimate of a live run without its threads, and its processor time [s] since the one before."""
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
        steps = [] if passed is None else list(run.use(passed, isinstance(passed, CornersEvent)))
        spent += time.thread_time() - began
        for step, estimate in steps:
            yield step, estimate, spent / len(steps)
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
        for k, (*_, spent) in zip(range(count), run_of(circle_config(), circle_map(), events), strict=False):
            spent_s += spent
            if k % block == block - 1:
                memory.append(resident_mb())
                costs.append(spent_s / block / beside.submit(_fresh_s).result())
                spent_s = 0.0
    tenth = _BLOCKS // 10
    growth = float(np.median(costs[-tenth:]) / np.median(costs[:tenth]))
    yield Row("live.million_growth", growth, n=count)
    yield Row("live.million_mb", max(memory[tenth:]) - memory[tenth - 1], n=count, unit="MB")


def _fresh_s() -> float:
    """Processor time of a keyframe of a run that has just begun [s]: how fast this machine is at the moment."""
    steps = run_of(circle_config(), circle_map(), circle(_FRESH / SIGHTINGS_HZ + _WARM_UP_S, seed=1))
    return float(np.mean([spent for k, (*_, spent) in enumerate(steps) if k >= _FRESH // 2]))


def resident_mb() -> float:
    """Memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() * 1e-6


def wrong(quick: bool) -> Iterator[Row]:
    """Row of the cost of updates where nothing that is seen fits the map."""
    takes = [Take("installed", "unequal_radii", "test", seed) for seed in SEEDS["test"][: 1 if quick else 5]]
    prepare(takes)
    ratios = [_ratio(load(take), take.seed) for take in takes]
    yield mean_row("live.wrong_ids_ratio", ratios)


def _ratio(recorded: Recorded, seed: int) -> float:
    ids = wrong_ids(recorded.events, recorded.landmarks.landmarks, np.random.default_rng(seed))
    sound = _cost(recorded, recorded.landmarks, recorded.events)
    misread = _cost(recorded, recorded.landmarks, ids)
    return max(misread, _cost(recorded, mirrored(recorded.landmarks), recorded.events)) / sound


def _cost(recorded: Recorded, landmark_map: LandmarkMap, events: Iterable[Event]) -> float:
    """Mean processor time of a keyframe [s]."""
    return float(np.mean([spent for _, _, spent in run_of(recorded.config, landmark_map, events, recorded.camera)]))


# --- Streams ----------------------------------------------------------------------------------------------------------


START_NS = 1_700_000_000_000_000_000
_FED_AT_ONCE = 500  # events, between waits: a replay is faster than the estimator
_DROPPED, _TWICE, _DELAYED = 0.02, 0.02, 0.05  # shares of messages
_DELAY_S = 0.08  # up to so much, so that messages overtake one another
_CAMERA_LATE_S = 0.3
_STALLS = ((20.0, 21.5), (55.0, 55.8))  # s: nothing arrives, then all at once
_RESTART_S = 40.0  # the wheels' publisher restarts ...
_RESTART_OFF_S = 0.6  # ... and is away for this long; its clock then begins at 0


def truth_of(recorded: Recorded) -> Callable[[int], FloatArray]:
    """True pose ``(3,)`` by stamp [ns]; NaN outside of the recording."""
    stamps = recorded.start_ns + np.round(recorded.truth[:, 0] * 1e9).astype(np.int64)
    poses = recorded.truth[:, 1:4]

    def at(stamp_ns: int) -> FloatArray:
        if not stamps[0] <= stamp_ns <= stamps[-1]:
            return np.full(3, np.nan)
        return se2.interpolate(stamps, poses, np.array([stamp_ns]))[0]

    return at


def roles_of(events: Iterable[Event]) -> set[Role]:
    """Roles that the events play."""
    topics = Config().recording.topics
    return {role for event in events if (role := role_of(event, topics)) is not None}


def feed(live: Live, events: Iterable[Event]) -> None:
    """Push events as fast as they are used."""
    for k, event in enumerate(events):
        live.push(event)
        if k % _FED_AT_ONCE == 0:
            live.wait()
    live.wait()


# --- Disorder ---------------------------------------------------------------------------------------------------------


def disordered(events: Iterable[Event], start_ns: int, rng: np.random.Generator) -> list[Event]:
    """All that goes wrong on the way, at once, in the new order of receipt.

    Messages are lost, doubled and delayed so that they overtake one another; the camera is 300 ms late; the network
    stalls and then delivers all at once; the publisher of the joints and the odometry restarts with its clock at zero;
    a second publisher of the joints tells of an arm.
    """
    out: list[Event] = []
    for event in events:
        at_s = (event.received_ns - start_ns) * 1e-9
        wheels = isinstance(event, JointsEvent | OdometryEvent)
        if rng.random() < _DROPPED or (wheels and _RESTART_S <= at_s < _RESTART_S + _RESTART_OFF_S):
            continue
        if wheels and at_s >= _RESTART_S:
            event = dataclasses.replace(event, stamp_ns=event.stamp_ns - start_ns - round(_RESTART_S * 1e9))
        late_s = _CAMERA_LATE_S if isinstance(event, CornersEvent) else 0.0
        late_s += float(rng.uniform(0.0, _DELAY_S)) if rng.random() < _DELAYED else 0.0
        arrives = _after_stalls(at_s + late_s)
        out.append(_received(event, start_ns, arrives))
        if rng.random() < _TWICE:
            out.append(_received(event, start_ns, arrives + 0.001))
        if isinstance(event, JointsEvent):
            stamp = event.received_ns + 1
            arm = JointsEvent(stamp, stamp, event.topic, ("arm_joint",), np.zeros(1), np.zeros(1), np.zeros(1))
            out.append(_received(arm, start_ns, arrives + 0.002))
    return sorted(out, key=lambda e: e.received_ns)


def _after_stalls(at_s: float) -> float:
    return next((end for start, end in _STALLS if start <= at_s < end), at_s)


def _received(event: Event, start_ns: int, at_s: float) -> Event:
    return dataclasses.replace(event, received_ns=start_ns + round(at_s * 1e9))


# --- Sightings that are wrong -----------------------------------------------------------------------------------------


def wrong_ids(events: Iterable[Event], ids: Iterable[int], rng: np.random.Generator) -> Iterator[Event]:
    """The events with every marker read as another one of the map."""
    known = np.array(sorted(ids))
    for event in events:
        if isinstance(event, CornersEvent):
            seen = [
                MarkerCorners(int(rng.choice(known[known != s.landmark_id])), s.corners_px) for s in event.sightings
            ]
            event = dataclasses.replace(event, sightings=tuple(seen))
        yield event


def mirrored(landmark_map: LandmarkMap) -> LandmarkMap:
    """The map as it is seen from below: the sign of y changed, markers upright as before."""
    flip = np.diag([1.0, -1.0, 1.0])
    landmarks = {
        i: dataclasses.replace(m, position=flip @ m.position, rotation=flip @ m.rotation @ np.diag([-1.0, 1.0, 1.0]))
        for i, m in landmark_map.landmarks.items()
    }
    return dataclasses.replace(landmark_map, landmarks=landmarks)


# --- A circle without end ---------------------------------------------------------------------------------------------

PERIOD_S, RADIUS_M = 20.0, 1.2
_ODOMETRY_HZ, SIGHTINGS_HZ = 10, 5
_SIGMA_RANGE, _SIGMA_BEARING = 0.06, 0.015


def circle_config() -> Config:
    """Settings that fit the noise of `circle`."""
    return config_of(
        {
            "wheels": {"source": "twist"},
            "landmarks": {"range_sigma_m": _SIGMA_RANGE, "bearing_sigma_rad": _SIGMA_BEARING},
        }
    )


def circle_map() -> LandmarkMap:
    """Seven beacons around the circle."""
    angles = np.linspace(0.0, 2.0 * math.pi, 7, endpoint=False)
    places = [3.0 * np.array([math.cos(a + 0.1 * a * a), math.sin(a + 0.1 * a * a), 0.0]) for a in angles]
    return LandmarkMap({i: Landmark(i, p, np.eye(3), 0.0) for i, p in enumerate(places)})


def circle_truth(stamp_ns: int) -> FloatArray:
    """True pose ``(3,)`` of the robot on the circle."""
    angle = 2.0 * math.pi * ((stamp_ns - START_NS) * 1e-9 % PERIOD_S) / PERIOD_S
    return np.array([RADIUS_M * math.sin(angle), -RADIUS_M * math.cos(angle), se2.wrap(angle)])


def circle(seconds: float, seed: int = 0) -> Iterator[Event]:
    """Events of a robot that drives in a circle: odometry at 10 Hz, an IMU at 20 Hz, two beacons seen at 5 Hz."""
    rng = np.random.default_rng(seed)
    landmarks = list(circle_map().landmarks.values())
    speed, turn = 2.0 * math.pi * RADIUS_M / PERIOD_S, 2.0 * math.pi / PERIOD_S
    zeros6, zeros3 = np.zeros((6, 6)), np.zeros((3, 3))
    spread = math.sqrt(_ODOMETRY_HZ)
    for tick in range(round(seconds * 20)):
        stamp = START_NS + tick * 50_000_000
        rate = np.array([0.0, 0.0, turn + rng.normal(0.0, 0.005)])
        yield ImuEvent(stamp, stamp, "/imu", "base_link", rate, np.zeros(3), zeros3)
        pose = circle_truth(stamp)
        if tick % 2 == 0:
            linear = np.array([speed + rng.normal(0.0, 0.03 * math.sqrt(speed) * spread), 0.0, 0.0])
            angular = np.array([0.0, 0.0, turn + rng.normal(0.0, 0.03 * math.sqrt(speed) * spread)])
            place = np.array([pose[0], pose[1], 0.0]), yaw_quaternion(float(pose[2])), zeros6
            yield OdometryEvent(stamp, stamp, "/odom", "odom", "base_link", *place, linear, angular, zeros6)
        if tick % (20 // SIGHTINGS_HZ) == 0:
            seen = []
            for k in rng.choice(len(landmarks), 2, replace=False):
                x, y, _ = se2.between(pose, np.array([*landmarks[k].position[:2], 0.0]))
                r, bearing = math.hypot(x, y), math.atan2(y, x)
                r, bearing = r + rng.normal(0.0, _SIGMA_RANGE), bearing + rng.normal(0.0, _SIGMA_BEARING)
                seen.append(RangeBearing(landmarks[k].landmark_id, float(r), float(bearing)))
            yield RangeBearingEvent(stamp, stamp, "/landmarks", "base_link", tuple(seen))


if __name__ == "__main__":
    main(measure, __doc__)
