"""`Live`: a stream of events in, poses out, for robots' own loops and for ROS 2's wire."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from fgloc.config import Config, Role
from fgloc.errors import EstimatorError, FglocError, OutputError
from fgloc.graph.measurement_log import Belief
from fgloc.live.detection import DetectionWorker, Queued, State
from fgloc.live.events import EventMaker
from fgloc.live.facts import ROLE_OF, LiveFacts
from fgloc.live.run import OnlineRun
from fgloc.live.state import RunState, fingerprint, read_state, write_state
from fgloc.live.status import LivePose, LiveStatus, TopicMeter
from fgloc.motion import load_model
from fgloc.sensors.maps import load_map
from fgloc.threads import one_blas_thread
from fgloc.types import Camera, Estimate, Event, ImageEvent, LandmarkMap, Step

_MOST_EVENTS = 20_000  # that wait for the estimator: 30 s of a busy robot
_SAVE_EVERY_S = 1.0
_SILENT_S = 2.0  # a topic that others outlive by this long is reported
_SUBSCRIBER = "A subscriber failed and is not called any more"


class Live(EventMaker):
    """Localizes a robot while it drives.

    Events may be pushed from any thread, in the order in which they arrive; `push` takes microseconds. One thread
    estimates, one finds markers in images. Poses are the same as those of `fgloc online` on a recording of the events,
    unless images had to be dropped.

    The parts of the run are built when everything has come in that they are built from (see ``roles``).

    Example:
        >>> from fgloc.config import Config
        >>> with Live(Config(), roles=("command",)) as live:
        ...     for k in range(40):
        ...         live.command(1_000_000_000 + k * 50_000_000, 0.2, 0.0)
        ...     done = live.wait(10.0)
        ...     pose = live.pose_at()
    """

    def __init__(
        self,
        config: Config,
        landmark_map: LandmarkMap | Path | None = None,
        *,
        state: Path | None = None,
        roles: Collection[Role] | None = None,
        camera: Camera | None = None,
        startup_s: float = 2.0,
        image_queue: int = 4,
    ) -> None:
        """Start the threads; nothing is estimated before events come in.

        Args:
            config: all settings, as `load_config` reads them.
            landmark_map: the map, or its file; None: landmarks are estimated too.
            state: file that the state is saved to every second and at the end, and resumed from.
            roles: what will come in. The run begins when all of it is there; None: after ``startup_s``.
            camera: the calibrated and mounted camera, if no CameraInfo and transforms will tell it.
            startup_s: how long roles are waited for, by receive times. What comes later joins later.
            image_queue: images that may wait for detection; of more the oldest is dropped.

        Raises:
            MapError, ModelError: as their loaders have it.
        """
        if isinstance(landmark_map, Path):
            landmark_map = load_map(landmark_map, config.markers.default_size_m)
        if config.motion.use and config.motion.model is not None:
            load_model(config.motion.model)  # a file that cannot be used is refused now, not when the robot drives
        self._recording = config.recording
        self._startup_s = startup_s
        self._state_path = state
        self._notes: list[str] = []
        resumed: RunState | None = None
        if state is not None:
            read = read_state(state, fingerprint(landmark_map))
            resumed = read.state
            self._notes += [read.note] if read.note else []
        self._facts = LiveFacts(config, roles, camera)
        self._run = OnlineRun(config, landmark_map, self._facts, resumed)
        self._busy = threading.RLock()  # held while the run is used
        self._changed = threading.Condition()  # guards all below
        self._inbox: deque[Queued | Belief] = deque()
        self._line: deque[Queued] = deque()  # gated, in order; only the estimation thread touches it
        self._held: deque[Queued] = deque(maxlen=_MOST_EVENTS)  # before the parts are built
        self._working = False
        self._closing = False
        self._failed: BaseException | None = None
        self._first_ns: int | None = None
        self._subscribers: list[Callable[[Estimate], None]] = []
        self._meters: dict[str, TopicMeter] = {}
        self._dropped: Counter[str] = Counter()
        self._step_s = self._longest_s = 0.0
        self._worker = DetectionWorker(self._changed, image_queue)
        self._thread = threading.Thread(target=self._estimate, name="fgloc-estimation", daemon=True)
        self._thread.start()
        self._saver: threading.Thread | None = None
        if state is not None:
            self._saver = threading.Thread(target=self._save_regularly, name="fgloc-state", daemon=True)
            self._saver.start()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    # --- in ---

    def push(self, event: Event) -> None:
        """Take an event, in order of receipt. Never waits for estimation or detection.

        Raises:
            EstimatorError: `close` was called.
            FglocError: the run has failed: what it was fed cannot be used.
        """
        is_image = isinstance(event, ImageEvent)
        queued = Queued(event, State.WAITING if is_image else State.READY, is_image)
        with self._changed:
            self._alive()
            meter = self._meters.get(event.topic)
            if meter is None:
                meter = self._meters[event.topic] = TopicMeter(ROLE_OF.get(type(event), "tf"))
            meter.add(event.stamp_ns, event.received_ns)
            if is_image:
                self._worker.arrived(queued)
            self._inbox.append(queued)
            if len(self._inbox) > _MOST_EVENTS:
                lost = self._inbox.popleft()
                if isinstance(lost, Queued) and lost.event is not None:
                    self._dropped[ROLE_OF.get(type(lost.event), "tf")] += 1
                    self._worker.discard(lost)
            self._changed.notify_all()

    def _deliver(self, event: Event) -> None:
        self.push(event)

    def reset_pose(self, pose: Sequence[float], sigmas: Sequence[float] = (0.5, 0.5, 0.26)) -> None:
        """Go on from a pose that somebody tells: x, y [m], yaw [rad] in the map, and their sigmas.

        Sightings that contradict it win: the robot is then found again on the map.
        """
        belief = Belief(np.asarray(pose, dtype=float), np.diag(np.square(np.asarray(sigmas, dtype=float))))
        if belief.pose.shape != (3,) or not np.isfinite(belief.pose).all() or not (np.diag(belief.cov) > 0.0).all():
            raise EstimatorError(f"pose {pose} with sigmas {sigmas}; expected three finite values and sigmas above 0")
        with self._changed:
            self._alive()
            self._inbox.append(belief)
            self._changed.notify_all()

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        """Have a function called with every keyframe's estimate, in the estimation thread: it should be quick."""
        with self._changed:
            self._subscribers.append(callback)

    # --- out ---

    def pose_at(self, stamp_ns: int | None = None) -> LivePose | None:
        """The pose at a time, carried on from the last keyframe before it by the motion sources.

        Args:
            stamp_ns: up to 5 s back; None: the newest that is known.

        Returns:
            None while no pose is known, or for a time of which nothing is known.

        Raises:
            FglocError: the run has failed.
        """
        with self._changed:
            self._fail()
        extrapolator = self._run.extrapolator
        return None if extrapolator is None else extrapolator.pose_at(stamp_ns)

    def status(self) -> LiveStatus:
        """How the run fares."""
        with self._busy:
            newest, rejections = self._run.newest, self._run.rejections
            notes, keyframes = self._run.notes(), self._run.keyframes
            running, waiting = self._run.parts is not None, self._facts.waiting_for()
            reordering_s = self._run.reordering_s
        with self._changed:
            topics = {topic: meter.status() for topic, meter in sorted(self._meters.items())}
            dropped = self._dropped + Counter({"image": self._worker.dropped})
            rejections += self._worker.rejections
            silent = self._silent()
            return LiveStatus(
                running=running,
                mode=None if newest is None else newest.mode,
                stamp_ns=None if newest is None else newest.stamp_ns,
                keyframes=keyframes,
                step_ms=self._step_s * 1e3,
                step_ms_max=self._longest_s * 1e3,
                reordering_s=reordering_s,
                queued_events=len(self._inbox) + len(self._line) + len(self._held),
                queued_images=self._worker.queued,
                topics=topics,
                dropped=dict(dropped),
                rejections=dict(sorted(rejections.items())),
                waiting_for=waiting,
                notes=tuple(dict.fromkeys((*self._notes, *silent, *notes))),
            )

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until everything that was pushed has been used; False if it was not in time.

        Raises:
            FglocError: the run has failed.
        """
        with self._changed:
            done = self._changed.wait_for(lambda: self._idle() or self._failed is not None, timeout_s)
            self._fail()
            return done

    # --- end ---

    def save(self, path: Path) -> bool:
        """Save the state now; False while there is none to save.

        Raises:
            OutputError: the file cannot be written.
        """
        with self._busy:
            snapshot = self._run.snapshot()
        if snapshot is not None:
            write_state(path, snapshot)
        return snapshot is not None

    def close(self) -> None:
        """Use what waits but for images, save the state, and end the threads. May be called again.

        Raises:
            OutputError: the state cannot be written.
        """
        with self._changed:
            closed, self._closing = self._closing, True
            self._changed.notify_all()
        if closed:
            return
        self._worker.stop()
        self._thread.join()
        if self._saver is not None:
            self._saver.join()
        if self._state_path is not None:
            self.save(self._state_path)

    # --- estimation thread ---

    @one_blas_thread
    def _estimate(self) -> None:
        try:
            while (batch := self._next_batch()) is not None:
                with self._busy:
                    for item in batch:
                        self._take(item)
                    self._advance()
                with self._changed:
                    self._working = False
                    self._changed.notify_all()
            with self._busy:
                self._advance()
                self._report(self._run.finish())
        except Exception as error:  # told by the next call
            with self._changed:
                self._failed = error
                self._working = False
                self._changed.notify_all()

    def _next_batch(self) -> list[Queued | Belief] | None:
        """What has come in, possibly nothing when only an image is done; None at the end."""
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
        waiting = self._line and self._line[0].state in (State.WAITING, State.DETECTING)
        return self._worker.error is not None or bool(self._line and not waiting)

    def _take(self, item: Queued | Belief) -> None:
        """Take an event through the gate, or hold it until the parts are built."""
        if isinstance(item, Belief):
            return self._run.reset_pose(item)
        event = item.event
        if event is None:  # an image that was dropped
            return
        if not self._facts.topic_is_used(event):
            return self._refuse(item, event)
        if self._first_ns is None:
            self._first_ns = event.received_ns
        if self._run.parts is None or self._facts.incomplete or type(event) not in self._facts.first:
            joined = self._facts.note(event)
            waited_s = (event.received_ns - self._first_ns) * 1e-9
            if self._run.parts is not None and joined:
                self._build()
            elif self._run.parts is None:
                self._held.append(item)
                if self._facts.complete(waited_s, self._startup_s):
                    self._build()
                    while self._held:
                        self._admit(self._held.popleft())
                return
        self._admit(item)

    def _build(self) -> None:
        self._worker.detector = self._run.build().detector

    def _refuse(self, item: Queued, event: Event) -> None:
        """An event of a second topic for one role."""
        role = ROLE_OF.get(type(event), "tf")
        note = f"{event.topic}: a second topic of the role {role} is not used; choose one by recording.topics.{role}"
        with self._changed:
            if note not in self._notes:
                self._notes.append(note)
            self._dropped[role] += 1
            self._worker.discard(item)

    def _admit(self, item: Queued) -> None:
        event = item.event
        if event is None:
            return
        passed = self._run.check(event)
        with self._changed:
            if passed is None or (item.is_image and self._worker.detector is None):
                return self._worker.discard(item)
            if item.state is State.GONE:
                return
            item.event = passed
            self._line.append(item)
            if item.is_image:
                self._worker.submit(item)

    def _advance(self) -> None:
        """Use all events up to the first image whose markers are not yet found."""
        while self._line:
            with self._changed:
                item = self._line[0]
                if item.state in (State.WAITING, State.DETECTING) and not self._closing:
                    return
                self._line.popleft()
                event, ready = item.event, item.state is State.READY
                self._worker.discard(item)
            if ready and event is not None:
                self._report(self._run.use(event, item.is_image))

    def _report(self, steps: Iterable[tuple[Step, Estimate | None]]) -> None:
        began = time.perf_counter()
        for _, estimate in steps:
            took = time.perf_counter() - began
            with self._changed:
                self._step_s += (took - self._step_s) / min(self._run.keyframes, 20)
                self._longest_s = max(self._longest_s, took)
                subscribers = list(self._subscribers)
            for callback in subscribers if estimate is not None else ():
                assert estimate is not None
                try:
                    callback(estimate)
                except Exception as error:  # theirs, not ours: the robot still needs its pose
                    with self._changed:
                        self._subscribers.remove(callback)
                        self._notes.append(f"{_SUBSCRIBER}: {type(error).__name__}: {error}")
            began = time.perf_counter()

    # --- state ---

    def _save_regularly(self) -> None:
        assert self._state_path is not None
        while True:
            with self._changed:
                if self._changed.wait_for(lambda: self._closing or self._failed is not None, _SAVE_EVERY_S):
                    return
            try:
                self.save(self._state_path)
            except OutputError as error:
                with self._changed:
                    self._notes = [*dict.fromkeys([*self._notes, str(error)])]

    # --- with the condition held ---

    def _idle(self) -> bool:
        return not (self._inbox or self._working or self._line)

    def _alive(self) -> None:
        self._fail()
        if self._closing:
            raise EstimatorError("the live run is closed; make a new Live")

    def _fail(self) -> None:
        if isinstance(self._failed, FglocError):
            raise self._failed
        if self._failed is not None:
            raise EstimatorError(f"the live run failed: {self._failed!r}") from self._failed

    def _silent(self) -> list[str]:
        """Topics that others have outlived."""
        newest = max((meter.last_ns for meter in self._meters.values()), default=0)
        return [
            f"{topic}: silent for {(newest - meter.last_ns) * 1e-9:.0f} s"
            for topic, meter in sorted(self._meters.items())
            if meter.is_regular and newest - meter.last_ns > _SILENT_S * 1e9
        ]
