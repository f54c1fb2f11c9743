"""The threads of a live run: one estimates, one finds markers in images."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Iterable

from fgloc.config import LiveConfig
from fgloc.errors import EstimatorError, FglocError, unexpected
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.instrumentation import one_blas_thread
from fgloc.live.anchors import Outlet
from fgloc.live.detection import DetectionWorker, Queued, State
from fgloc.live.reception import role_of
from fgloc.live.run import OnlineRun
from fgloc.types import Estimate, Event, RawEvent, Step

_MOST_EVENTS = 20_000  # that wait for the estimator: 30 s of a busy robot
_MEAN_OF = 20  # steps, in the mean of their time
_UNFOUND = (State.WAITING, State.DETECTING)


class Engine:
    """Events go in by `put`, from any thread; estimates come out in the estimation thread.

    Attributes:
        busy: held while the run is used; take it to look into the run.
        changed: guards the queues and the counters; notified of every change.
        dropped: events that were not used whatever is in them, by role; images are counted by the worker.
        notes: what the user should know, one sentence each.
        step_s, longest_s: wall time of an update: mean of the last ones, and the longest.
    """

    def __init__(self, run: OnlineRun, outlet: Outlet, config: LiveConfig) -> None:
        """Start the threads.

        Args:
            run: what is to be fed.
            outlet: takes what comes out.
            config: how long its roles are waited for, by receive times, and how many images may wait.
        """
        self.busy = threading.RLock()
        self.changed = threading.Condition()
        self.dropped: Counter[str] = Counter()
        self.notes: dict[str, None] = {}  # an ordered set
        self.step_s = self.longest_s = 0.0
        self._run = run
        self._outlet = outlet
        self._startup_s = config.startup_s
        self._inbox: deque[Queued | PoseWithCovariance] = deque()
        self._line: deque[Queued] = deque()  # gated, in order; only the estimation thread changes it
        self._held: deque[Queued] = deque(maxlen=_MOST_EVENTS)  # before the parts are built
        self._first_ns: int | None = None
        self._working = False
        self._closing = False
        self._failed: FglocError | None = None
        self.worker = DetectionWorker(self.changed, config.image_queue)
        self._thread = threading.Thread(target=self._estimate, name="fgloc-estimation", daemon=True)
        self._thread.start()

    # --- any thread ---

    def put(self, events: Iterable[Event]) -> None:
        """Queue events; of too many, the oldest is dropped."""
        with self.changed:
            self.check_alive()
            for event in events:
                is_image = isinstance(event, RawEvent)
                queued = Queued(event, State.WAITING if is_image else State.READY, is_image)
                if is_image:
                    self.worker.arrived(queued)
                self._inbox.append(queued)
            while len(self._inbox) > _MOST_EVENTS:
                lost = self._inbox.popleft()
                if isinstance(lost, Queued) and lost.event is not None:
                    self.dropped[role_of(lost.event)] += 1
                    self.worker.discard(lost)
            self.changed.notify_all()

    def reset_pose(self, belief: PoseWithCovariance) -> None:
        """Queue a pose to go on from."""
        with self.changed:
            self.check_alive()
            self._inbox.append(belief)
            self.changed.notify_all()

    def wait(self, timeout_s: float | None) -> bool:
        """Until everything queued has been used; False if it was not in time."""
        with self.changed:
            done = self.changed.wait_for(lambda: self._idle() or self._failed is not None, timeout_s)
            self.check_failed()
            return done

    def pause(self, seconds: float) -> bool:
        """Sleep; False at once when the run ends."""
        with self.changed:
            return not self.changed.wait_for(lambda: self._closing or self._failed is not None, seconds)

    def close(self) -> bool:
        """Use what is queued, but for images, and end the threads; False if that was done before."""
        with self.changed:
            closed, self._closing = self._closing, True
            self.changed.notify_all()
        self.worker.stop()
        self._thread.join()
        return not closed

    @property
    def queued(self) -> int:
        """Events that wait."""
        return len(self._inbox) + len(self._line) + len(self._held)

    def check_alive(self) -> None:
        """Raises: EstimatorError: closed, or failed."""
        self.check_failed()
        if self._closing:
            raise EstimatorError("the live run is closed; make a new Live")

    def check_failed(self) -> None:
        """Raises: FglocError: what ended the estimation thread."""
        if self._failed is not None:
            raise self._failed

    def _idle(self) -> bool:
        return not (self._inbox or self._working or self._line)

    # --- estimation thread ---

    @one_blas_thread
    def _estimate(self) -> None:
        try:
            while (batch := self._next_batch()) is not None:
                with self.busy:
                    for item in batch:
                        self._take(item)
                    self._use_line()
                with self.changed:
                    self._working = False
                    self.changed.notify_all()
            with self.busy:
                self._use_line()
                self._report(self._run.finish())
        except Exception as error:  # raised again by the next call from outside
            failure = unexpected(error, "the live run")
            with self.changed:
                self._failed = failure
                self._working = False
                self.changed.notify_all()
            self._outlet.failed(failure)

    def _next_batch(self) -> list[Queued | PoseWithCovariance] | None:
        """What has come in, possibly nothing when only an image is done; None at the end."""
        with self.changed:
            self.changed.wait_for(lambda: self._closing or self._inbox or self._image_done())
            if self.worker.error is not None:
                raise self.worker.error
            if self._closing and not self._inbox:
                return None
            self._working = True
            batch = list(self._inbox)
            self._inbox.clear()
            return batch

    def _image_done(self) -> bool:
        done = bool(self._line) and self._line[0].state not in _UNFOUND
        return done or self.worker.error is not None

    def _take(self, item: Queued | PoseWithCovariance) -> None:
        """Take an event through the gate, or hold it until the parts are built."""
        if isinstance(item, PoseWithCovariance):
            return self._run.reset_pose(item)
        event, facts = item.event, self._run.facts
        if event is None:  # an image that was dropped
            return
        if not facts.topic_is_used(event):
            return self._refuse(item, event)
        if self._run.parts is not None:
            if facts.is_news(event) and facts.note(event):
                self._build()
            return self._admit(item)
        facts.note(event)
        self._held.append(item)
        self._first_ns = event.received_ns if self._first_ns is None else self._first_ns
        if facts.complete((event.received_ns - self._first_ns) * 1e-9, self._startup_s):
            self._build()
            while self._held:
                self._admit(self._held.popleft())

    def _build(self) -> None:
        detector = self._run.build().detector
        self.worker.detector = None if detector is None else detector.following()
        assert self._run.anchors is not None
        self._outlet.built(self._run.anchors.parts)

    def _refuse(self, item: Queued, event: Event) -> None:
        """An event of another topic than the one that plays its role."""
        role = role_of(event)
        with self.changed:
            if not self._run.facts.is_configured(event):
                self.notes.setdefault(
                    f"{event.topic}: a second topic of the role {role} is not used; choose one by "
                    f"recording.topics.{role}"
                )
            self.dropped[role] += 1
            self.worker.discard(item)

    def _admit(self, item: Queued) -> None:
        event = item.event
        if event is None:
            return
        passed = self._run.check(event) if self._run.facts.is_there(event) else None
        with self.changed:
            if passed is None:
                return self.worker.discard(item)
            if item.state is State.GONE:
                return
            item.event = passed
            self._line.append(item)
            if item.is_image:
                self.worker.submit(item)

    def _use_line(self) -> None:
        """Use all events up to the first image whose markers are not yet found; at the end, up to the last."""
        while self._line:
            with self.changed:
                item = self._line[0]
                if item.state in _UNFOUND and not self._closing:
                    return
                self._line.popleft()
                event, ready = item.event, item.state is State.READY
                self.worker.discard(item)
            if ready and event is not None:
                self._report(self._run.use(event, item.is_image))

    def _report(self, steps: Iterable[tuple[Step, Estimate | None]]) -> None:
        began = time.perf_counter()
        for step, estimate in steps:
            took = time.perf_counter() - began
            with self.changed:
                self.step_s += (took - self.step_s) / min(self._run.keyframes, _MEAN_OF)
                self.longest_s = max(self.longest_s, took)
            if estimate is not None:
                self._outlet.estimated(self._run.anchor(step, estimate), estimate)
            began = time.perf_counter()
