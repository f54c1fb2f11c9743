"""The threads of a live run: one estimates, one finds markers in images, one compares signals, one saves the state."""

from __future__ import annotations

import ctypes
import math
import mmap
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from pathlib import Path

from fgloc.assembly import Assembly
from fgloc.config import ODOMETRIES, Config, Role, TopicsConfig, base_role
from fgloc.errors import EstimatorError, FglocError, OutputError, unexpected
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.instrumentation import giving_way, one_blas_thread
from fgloc.live.extrapolation import Outlet
from fgloc.live.run import LOOK, MOTION, LiveFacts, OnlineRun, role_name
from fgloc.live.state import Resumed, fingerprint, read_state, write_state
from fgloc.sensors.markers.detector import Detector, use_one_thread
from fgloc.sensors.markers.images import ImageError
from fgloc.types import Camera, Estimate, Event, Finding, LandmarkMap, Mode, Protection, RawEvent, SightingsEvent, Step


@dataclass(frozen=True, slots=True)
class TopicStatus:
    """Statistics of one topic as it is received."""

    role: str
    count: int
    rate_hz: float  # by receive times, lately
    delay_s: float  # receive time less stamp, lately; of sensors whose clock is another one, the offset is in it
    silent_s: float = 0.0  # since the last message, by this machine's clock
    missed: bool = False  # it used to come regularly, and is silent for longer than jitter explains


@dataclass(frozen=True, slots=True, eq=False)
class LiveStatus:
    """State of a live run at one time."""

    running: bool = False  # its parts are built; before that it waits for what `waiting_for` names
    mode: Mode | None = None  # of the last keyframe; None: no pose yet
    stamp_ns: int | None = None  # of the last keyframe
    protection: Protection | None = None  # bound on its error
    keyframes: int = 0
    step_ms: float = 0.0  # mean wall time of an update, lately
    step_ms_max: float = 0.0  # longest one so far
    reordering_s: float = 0.0  # how far the last keyframe was behind the newest stamp when it was made
    queued_events: int = 0
    queued_images: int = 0
    topics: Mapping[str, TopicStatus] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)  # by role: for overload, not for their contents
    rejections: Mapping[str, int] = field(default_factory=dict)  # by "sensor.reason", as in reports
    waiting_for: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # what is wrong, one sentence each
    findings: tuple[Finding, ...] = ()  # of sensors, settings and estimate; their sentences are notes too

    @property
    def alert(self) -> str:
        """Sentence on a bound above the alert limit; empty: it is below, or there is no limit."""
        bound = self.protection
        if bound is None or not bound.alert:
            return ""
        yaw = math.degrees(bound.bound[2])
        return f"ALERT: the pose may be off by {bound.position_m:.2f} m and {yaw:.1f}° ({bound.cause})"

    @property
    def stale(self) -> str:
        """Sentence on sources that have all fallen silent, so that the pose is not of now; empty: they have not.

        They are those of motion, or where there are none what sees landmarks. An odometry beside the wheels goes on
        when they fall silent; without any of them it is not used.
        """
        moving = not set(MOTION).isdisjoint(of.role for of in self.topics.values())
        roles = (*MOTION, ODOMETRIES) if moving else LOOK
        sources = {topic: of for topic, of in self.topics.items() if base_role(of.role) in roles}
        missed = [of.silent_s for of in sources.values() if of.missed]
        if not missed or min(of.silent_s for of in sources.values()) < min(missed):
            return ""
        return f"STALE: no message of {', '.join(sources)} for {min(missed):.1f} s"


# --- Marker detection: one worker, and a queue that drops the oldest waiting image ------------------------------------


class State(Enum):
    """State of a queued event."""

    WAITING = "an image whose markers are not looked for yet"
    DETECTING = "an image that the worker has"
    READY = "an event to be used"
    GONE = "an image that was dropped, or could not be decoded"


@dataclass(slots=True, eq=False)
class Queued:
    """An event on its way to the estimator. An image is replaced by the markers that are found in it."""

    event: Event | None
    state: State
    is_image: bool = False


class DetectionWorker:
    """Finds markers in one thread. All state is guarded by the condition that it is given.

    Attributes:
        detector: what finds them; may be exchanged.
        rejections: images that could not be decoded, by role and reason.
        dropped: images dropped, as too many waited.
        early: of them those dropped before the detector was there.
        error: what ended the thread, if it was not `stop`.
    """

    def __init__(self, changed: threading.Condition, most_waiting: int, topics: TopicsConfig) -> None:
        """Start the thread.

        Args:
            changed: notified whenever an image is done.
            most_waiting: images that may wait, from their arrival until the estimator has their markers.
            topics: by which images are counted as those of one of several cameras.
        """
        self._topics = topics
        use_one_thread()
        self.detector: Detector | None = None
        self.rejections: Counter[str] = Counter()
        self.dropped = self.early = 0
        self.error: Exception | None = None
        self._changed = changed
        self._most = most_waiting
        self._images: deque[Queued] = deque()  # from arrival until used
        self._todo: deque[Queued] = deque()
        self._detecting = self._stopping = False
        self._thread = threading.Thread(target=self._run, name="fgloc-detection", daemon=True)
        self._thread.start()

    @property
    def detecting(self) -> bool:
        """Whether markers are being looked for, or are about to be."""
        return self._detecting or bool(self._todo)

    @property
    def queued(self) -> int:
        """Number of images that wait."""
        return len(self._images)

    def arrived(self, image: Queued) -> None:
        """Count an image in; of too many the oldest that the worker does not have is dropped. Hold the condition."""
        self._images.append(image)
        waiting = [q for q in self._images if q.state is not State.DETECTING]
        if len(waiting) > self._most:
            self.dropped += 1
            self.early += self.detector is None
            self.discard(waiting[0])

    def discard(self, image: Queued) -> None:
        """Remove an image that was used or is of no use any more. Hold the condition."""
        if image.state is not State.DETECTING:
            image.event, image.state = None, State.GONE
        if image in self._images:
            self._images.remove(image)

    def submit(self, image: Queued) -> None:
        """Pass an image to the worker, which finds its markers. Hold the condition."""
        self._todo.append(image)
        self._changed.notify_all()

    def stop(self) -> None:
        """End the thread; images that wait are left."""
        with self._changed:
            self._stopping = True
            self._todo.clear()
            self._changed.notify_all()
        self._thread.join()

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _next(self) -> tuple[Queued, RawEvent, Detector] | None:
        with self._changed:
            while not self._stopping:
                while self._todo:
                    image = self._todo.popleft()
                    if isinstance(image.event, RawEvent) and self.detector is not None:
                        image.state, self._detecting = State.DETECTING, True
                        return image, image.event, self.detector
                self._changed.wait()
        return None

    def _run(self) -> None:
        while (task := self._next()) is not None:
            image, event, detector = task
            found: SightingsEvent | None = None
            reason = ""
            try:
                found = detector.detect(event)
            except ImageError as error:
                reason = error.reason
            except Exception as error:  # told by whoever feeds this thread
                self.error, self._detecting = error, False
                return self._wake()
            with self._changed:
                self._detecting = False
                if reason:
                    self.rejections[f"{self._topics.role_on(event.topic, 'image')}.{reason}"] += 1
                image.event, image.state = found, State.GONE if found is None else State.READY
                if found is None and image in self._images:
                    self._images.remove(image)
                self._changed.notify_all()


# --- Estimation -------------------------------------------------------------------------------------------------------

_MOST_EVENTS = 20_000  # that wait for the estimator: 30 s of a busy robot
_MEAN_OF = 20  # steps, in the mean of their time
_SAVE_EVERY_S = 1.0
_COMPARE_EVERY_S = 0.5  # or less often, where nothing new is to be compared
_COMPARED_SHARE = 0.03  # of the time, that comparisons may compute: on a slow computer they come less often ...
_WAY_S, _LONGEST_S = 0.03, 10.0  # that a comparison waits at a time, and in all, for the steps, which come first
_AT_THE_END_S = 2.0  # that one may go on when the run ends: on a busy machine it takes ten seconds and more
_COMPARED_FREELY_S = 1.0  # ... beyond so much: what is wrong from the start is named as soon as it shows
_GROWN_MB, _HEAP_EVERY_S = 4.0, 0.5  # memory since the heap was last given back, which takes 1 to 2 ms
_UNFOUND = (State.WAITING, State.DETECTING)


def overload_notes(images: int, events: int, early: int = 0) -> tuple[str, ...]:
    """Sentences on so many images and other events that came faster than they could be used, or before the run."""
    found = []
    if early:
        found.append(f"{early} image(s) dropped before the run, or its camera's calibration and mounting, were there")
    if images:
        found.append(
            f"{images} image(s) dropped: they come faster than markers can be found in them; poses are not those of "
            "a run on the recording; send smaller or fewer images, or free the processor"
        )
    if events:
        found.append(f"{events} message(s) dropped: they come faster than they can be used; free the processor")
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Settings:
    """Settings of a live run, as `Live` has them. Can be pickled."""

    config: Config
    landmark_map: LandmarkMap | None
    state: Path | None
    roles: Collection[Role] | None
    camera: Camera | None


class _EndedError(Exception):
    """The run ended while its signals were compared."""


class Keep(Enum):
    """Part of what a run knows that it goes on with when it begins again."""

    NOTHING = "nothing"
    INSTALLATION = "installation, bias of the gyro, and moved landmarks, but not the pose"
    ALL = "the pose too"


class Estimation:
    """Events go in by `put`, from any thread; estimates come out in the estimation thread.

    Attributes:
        run: what the threads feed.
    """

    def __init__(self, settings: Settings, outlet: Outlet) -> None:
        """Start the threads; what is found goes to ``outlet``."""
        config, landmark_map, self._state = settings.config, settings.landmark_map, settings.state
        read = Resumed(None, "") if self._state is None else read_state(self._state, fingerprint(landmark_map))
        facts = LiveFacts(config, settings.roles, settings.camera)
        self.run = OnlineRun(config, landmark_map, facts, read.state)
        self._busy = threading.RLock()  # held while the run is used
        self._changed = threading.Condition()  # guards the queues and what follows; notified of every change
        self._dropped: Counter[str] = Counter()  # for overload, by role; images are counted by the worker
        self._overflow = 0  # events among them that were too many
        self._notes: dict[str, None] = {read.note: None} if read.note else {}  # an ordered set
        self._step_s = self._longest_s = 0.0  # wall time of an update: mean of the last ones, and the longest
        self._outlet = outlet
        self._startup_s = config.live.startup_s
        self._inbox: deque[Queued | PoseWithCovariance] = deque()
        self._line: deque[Queued] = deque()  # gated, in order; only the estimation thread changes it
        self._held: deque[Queued] = deque(maxlen=_MOST_EVENTS)  # before the parts are built
        self._first_ns: int | None = None
        self._working = False
        self._closing = False
        self._leave_s = math.inf  # when a comparison that goes on is left (`time.monotonic`)
        self._failed: FglocError | None = None
        self._topics = config.recording.topics
        self._worker = DetectionWorker(self._changed, config.live.image_queue, self._topics)
        self._threads = [_started("estimation", self._estimate), _started("diagnosis", self._compare_regularly)]
        if self._state is not None:
            self._threads.append(_started("state", self._save_regularly))

    # --- any thread ---

    def put(self, events: Iterable[Event]) -> None:
        """Queue events; of too many, the oldest is dropped.

        Raises:
            EstimatorError: `close` was called.
            FglocError: the run has failed.
        """
        with self._changed:
            self._check_alive()
            for event in events:
                is_image = isinstance(event, RawEvent)
                queued = Queued(event, State.WAITING if is_image else State.READY, is_image)
                if is_image:
                    self._worker.arrived(queued)
                self._inbox.append(queued)
            while len(self._inbox) > _MOST_EVENTS:
                lost = self._inbox.popleft()
                if isinstance(lost, Queued) and lost.event is not None:
                    self._dropped[role_name(lost.event, self._topics)] += 1
                    self._overflow += 1
                    self._worker.discard(lost)
            self._changed.notify_all()

    def reset_pose(self, belief: PoseWithCovariance) -> None:
        """Queue a pose to go on from; raises as `put`."""
        with self._changed:
            self._check_alive()
            self._inbox.append(belief)
            self._changed.notify_all()

    def wait(self, timeout_s: float | None) -> bool:
        """Wait until everything queued has been used; False if it was not in time."""
        with self._changed:
            done = self._changed.wait_for(lambda: self._idle() or self._failed is not None, timeout_s)
            self.check_failed()
            return done

    def status(self) -> LiveStatus:
        """State of the run, but for the statistics of topics, which `Live` adds."""
        run, worker = self.run, self._worker
        with self._busy:
            newest, rejections, findings = run.newest, run.rejections, run.findings()
            keyframes, running, waiting = run.keyframes, run.parts is not None, run.facts.waiting_for()
            reordering_s = run.reordering_s
        with self._changed:
            rejections += worker.rejections
            overload = overload_notes(worker.dropped - worker.early, self._overflow, worker.early)
            return LiveStatus(
                running=running,
                mode=None if newest is None else newest.mode,
                stamp_ns=None if newest is None else newest.stamp_ns,
                protection=None if newest is None else newest.protection,
                keyframes=keyframes,
                step_ms=self._step_s * 1e3,
                step_ms_max=self._longest_s * 1e3,
                reordering_s=reordering_s,
                queued_events=len(self._inbox) + len(self._line) + len(self._held),
                queued_images=worker.queued,
                dropped=dict(self._dropped + Counter({"image": worker.dropped})),
                rejections=dict(sorted(rejections.items())),
                waiting_for=waiting,
                notes=tuple(dict.fromkeys((*self._notes, *overload, *(f.text for f in findings)))),
                findings=findings,
            )

    def save(self, path: Path) -> bool:
        """Save the state now; False while there is none to save."""
        with self._busy:
            snapshot = self.run.snapshot()
        if snapshot is not None:
            write_state(path, snapshot)
        return snapshot is not None

    def begin_again(self, keep: Keep, source: LandmarkMap | Path | None = None) -> None:
        """Estimate anew; see `Live.reset`, `search`, `load` and `use_map`.

        Args:
            keep: of what is known now.
            source: a map to go on with, or the file of a state to go on from; None: neither.

        Raises:
            EstimatorError: no state can be read from the file.
            FglocError: the sensors of this run cannot use the map.
        """
        with self._busy:
            landmark_map = source if isinstance(source, LandmarkMap) else self.run.map
            state = None if keep is Keep.NOTHING else self.run.snapshot()
            if state is not None and keep is Keep.INSTALLATION:
                state = state.model_copy(update={"mode": Mode.LOST})
            if isinstance(source, Path):
                read = read_state(source, fingerprint(landmark_map), "the run goes on as it was")
                if read.state is None:
                    raise EstimatorError(
                        read.note or f"{source}: no such file; give one that `save` or `--state` wrote"
                    )
                state = read.state
            self.run.begin_again(landmark_map, state)
            if self.run.parts is not None:
                self._parts_are_built(self.run.parts)

    def close(self) -> None:
        """Use what is queued, but for images, save the state, and end the threads; see `Live.close`."""
        with self._changed:
            closed, self._closing = self._closing, True
            self._leave_s = min(self._leave_s, time.monotonic() + _AT_THE_END_S)
        self._worker.stop()  # notifies the other threads too
        for thread in self._threads:
            thread.join()
        if self._state is not None and not closed:
            self.save(self._state)

    def check_failed(self) -> None:
        """Raise the `FglocError` that ended the estimation thread, if there is one."""
        if self._failed is not None:
            raise self._failed

    def _check_alive(self) -> None:
        self.check_failed()
        if self._closing:
            raise EstimatorError("the live run is closed; make a new Live")

    def _idle(self) -> bool:
        return not (self._inbox or self._working or self._line)

    # --- estimation thread ---

    @one_blas_thread
    def _estimate(self) -> None:
        heap = _Heap()
        try:
            while (batch := self._next_batch()) is not None:
                with self._busy:
                    for item in batch:
                        self._take(item)
                    self._use_line()
                heap.give_back()
                with self._changed:
                    self._working = False
                    self._changed.notify_all()
            with self._busy:
                self._use_line()
                self._report(self.run.finish())
        except Exception as error:  # raised again by the next call from outside
            failure = unexpected(error, "the live run")
            with self._changed:
                self._failed = failure
                self._working = False
                self._changed.notify_all()
            self._outlet.failed(failure)

    def _next_batch(self) -> list[Queued | PoseWithCovariance] | None:
        """Wait for new items, and return them: none if only an image is done; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._inbox or self._image_done())
            if self._worker.error is not None:
                raise self._worker.error
            if self._closing and not self._inbox:
                return None
            self._working = True
            batch = list(self._inbox)
            self._inbox.clear()
            return batch

    def _image_done(self) -> bool:
        done = bool(self._line) and self._line[0].state not in _UNFOUND
        return done or self._worker.error is not None

    def _take(self, item: Queued | PoseWithCovariance) -> None:
        """Pass an event through the gate, or hold it until the parts are built."""
        if isinstance(item, PoseWithCovariance):
            return self.run.reset_pose(item)
        event, facts = item.event, self.run.facts
        if event is None:  # an image that was dropped
            return
        if not facts.topic_is_used(event):
            return self._refuse(item, event)
        if self.run.parts is not None:
            if facts.is_news(event) and facts.note(event):
                self._build()
            return self._admit(item)
        facts.note(event)
        self._held.append(item)
        self._first_ns = event.received_ns if self._first_ns is None else self._first_ns
        waited_s = (event.received_ns - self._first_ns) * 1e-9
        if facts.complete(waited_s, self._startup_s, self.run.map is not None):
            self._build()
            while self._held:
                self._admit(self._held.popleft())

    def _build(self) -> None:
        self._parts_are_built(self.run.build())

    def _parts_are_built(self, parts: Assembly) -> None:
        self._worker.detector = None if parts.detector is None else parts.detector.following()
        assert self.run.anchors is not None
        self._outlet.built(self.run.anchors.parts)

    def _refuse(self, item: Queued, event: Event) -> None:
        """Drop an event of another topic than the one that plays its role, with a note."""
        role = role_name(event, self._topics)
        with self._changed:
            if not self.run.facts.is_configured(event):
                self._notes.setdefault(
                    f"{event.topic}: a second topic of the role {role} is not used; choose one by "
                    f"recording.topics.{role}"
                )
            self._dropped[role] += 1
            self._worker.discard(item)

    def _admit(self, item: Queued) -> None:
        event = item.event
        if event is None:
            return
        passed = self.run.check(event) if self.run.facts.is_there(event) else None
        with self._changed:
            if passed is None:
                return self._worker.discard(item)
            if item.state is State.GONE:
                return
            item.event = passed
            self._line.append(item)
            if item.is_image:
                self._worker.submit(item)

    def _use_line(self) -> None:
        """Use all events up to the first image whose markers are not yet found; at the end, up to the last."""
        while self._line:
            with self._changed:
                item = self._line[0]
                if item.state in _UNFOUND and not self._closing:
                    return
                self._line.popleft()
                event, ready = item.event, item.state is State.READY
                self._worker.discard(item)
            if ready and event is not None:
                self._report(self.run.use(event, item.is_image))

    def _report(self, steps: Iterable[tuple[Step, Estimate | None]]) -> None:
        began = time.perf_counter()
        for step, estimate in steps:
            took = time.perf_counter() - began
            with self._changed:
                self._step_s += (took - self._step_s) / min(self.run.keyframes, _MEAN_OF)
                self._longest_s = max(self._longest_s, took)
            if estimate is not None:
                self._outlet.estimated(self.run.anchor(step, estimate), estimate)
            began = time.perf_counter()

    # --- threads beside it ---

    def _pause(self, seconds: float) -> bool:
        """Sleep; False at once when the run ends."""
        with self._changed:
            return not self._changed.wait_for(lambda: self._closing or self._failed is not None, seconds)

    def _urgent(self) -> bool:
        ending = self._closing or self._failed is not None
        return not ending and (self._working or self._worker.detecting)

    def _wait_until_idle(self, last_s: float) -> None:
        """Wait for a moment in which nothing is estimated or detected, but not long, nor after a time ``last_s``."""
        if time.monotonic() > self._leave_s:
            raise _EndedError
        if self._urgent() and time.monotonic() < last_s:
            with self._changed:
                self._changed.wait_for(lambda: not self._urgent(), _WAY_S)

    def _compare_regularly(self) -> None:
        """Compare signals beside the estimation, which goes on meanwhile, also where this fails."""
        began, free_s = time.monotonic(), _COMPARED_FREELY_S
        while self._pause(max(_COMPARE_EVERY_S, -free_s / _COMPARED_SHARE)):
            computed = time.thread_time()
            with self._busy:
                comparison = self.run.comparison()
            try:
                if comparison is not None:
                    with giving_way(partial(self._wait_until_idle, time.monotonic() + _LONGEST_S)):
                        comparison()
            except _EndedError:
                return
            except Exception as error:
                with self._changed:
                    self._notes.setdefault(f"sensors are not compared any more: {unexpected(error, 'the comparison')}")
                return
            now = time.monotonic()
            free_s += (now - began) * _COMPARED_SHARE - (time.thread_time() - computed)
            free_s = min(free_s, _COMPARED_FREELY_S)
            began = now

    def _save_regularly(self) -> None:
        while self._pause(_SAVE_EVERY_S):
            try:
                assert self._state is not None
                self.save(self._state)
            except OutputError as error:
                with self._changed:
                    self._notes.setdefault(str(error))


class _Heap:
    """Gives memory that was used for a moment back to the system, where the C library can; glibc keeps some 25 MB."""

    def __init__(self) -> None:
        self._looked_s = time.monotonic()
        self._least_mb = math.inf

    def give_back(self) -> None:
        """Do so if this process has grown; call it often."""
        if (now := time.monotonic()) - self._looked_s < _HEAP_EVERY_S:
            return
        self._looked_s = now
        with suppress(AttributeError, OSError, TypeError):  # another system, or another C library
            if (resident := _resident_mb()) > self._least_mb + _GROWN_MB:
                ctypes.CDLL(None).malloc_trim(0)
                self._least_mb = _resident_mb()
            else:
                self._least_mb = min(self._least_mb, resident)


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * mmap.PAGESIZE * 1e-6


def _started(name: str, work: Callable[[], None]) -> threading.Thread:
    thread = threading.Thread(target=work, name=f"fgloc-{name}", daemon=True)
    thread.start()
    return thread
