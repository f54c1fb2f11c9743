"""The estimation of a live run in a process of its own, so that nothing in this one waits for it.

Python runs one thread of a process at a time. An update that computes for 10 ms, or that other processes interrupt,
would hold up the threads that receive messages and publish poses.
"""

from __future__ import annotations

import gc
import itertools
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeAlias

from fgloc.config import TopicsConfig
from fgloc.errors import EstimatorError, FglocError, unexpected
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.engine import Estimation, Keep, LiveStatus, Settings, overload_notes
from fgloc.live.extrapolation import Anchor, MotionParts, Outlet
from fgloc.live.run import role_name
from fgloc.types import Estimate, Event, LandmarkMap, MotionEvent, RawEvent, SensorEvent, SightingsEvent

_START = "import json, sys; sys.path[:] = json.loads(sys.argv[2]); from fgloc.live.process import main; main()"
_MOST_WAITING = 20_000  # events that wait for being sent: 30 s of a busy robot
_STATUS_S = 0.5  # if the process does not say how it fares in this time, what it said last is told ...
_SILENT_S = 3.0  # ... and from then on that it does not answer: an update takes milliseconds, a search of the map 1 s
# Motion events only matter to the estimation when a sighting or a question comes, and to close a sighting's keyframe.
_GATHER_S = 0.02  # for which they wait for one another: sent at once they cost 0.40 of a core in place of 0.29 ...
_GATHER_BRIEFLY_S = 0.003  # ... and while the estimate of a sighting is awaited
_END_S = 10.0  # that it may take to use what it has and to save its state

_SILENT = (
    "The process of the estimation has not answered for {:.0f} s: it hangs, or this machine has too much to do; "
    "start again: with a state file (`--state`) it goes on from there."
)

_Question: TypeAlias = tuple[int, str, tuple[Any, ...]]  # number, method of `Estimation`, arguments


class EstimationProcess:
    """`Estimation` in a child process, which ends when this one does. Give it to `Live`, or `close` it."""

    def __init__(self) -> None:
        """Start the process; it imports what it needs while this one goes on."""
        self._connection, theirs = Pipe()
        self._child = subprocess.Popen(
            [sys.executable, "-c", _START, str(theirs.fileno()), json.dumps(sys.path)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            process_group=0,  # Ctrl-C is for this process, which then ends the other
        )
        theirs.close()
        self._changed = threading.Condition()  # guards all that follows
        self._waiting: deque[Event | PoseWithCovariance | _Question] = deque()
        self._images = 0  # among them
        self._urgent = False  # one of them is to be sent at once
        self._awaited_ns: int | None = None  # stamp of a sighting whose estimate has not come yet
        self._most_images = 0
        self._topics = TopicsConfig()
        self._dropped: Counter[str] = Counter()
        self._dropped_images = 0  # among them
        self._numbers = itertools.count()
        self._asked: dict[int, Future[Any]] = {}
        self._status = LiveStatus()
        self._answered_s = math.inf  # when it last did (`time.monotonic`)
        self._failed: FglocError | None = None
        self._closing = False
        self._threads: list[threading.Thread] = []

    @property
    def ready(self) -> bool:
        """Whether the process has started up, so that a run that begins now loses no time."""
        return bool(self._connection.poll())

    def begin(self, settings: Settings, outlet: Outlet) -> None:
        """Set up the run; the arguments are those of `Estimation`."""
        self._most_images = settings.config.live.image_queue
        self._topics = settings.config.recording.topics
        self._connection.send(settings)
        for name, work in (("send", self._send), ("receive", lambda: self._receive(outlet))):
            thread = threading.Thread(target=work, name=f"fgloc-{name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def put(self, events: Iterable[Event]) -> None:
        """Queue events; see `Estimation.put`."""
        with self._changed:
            for event in events:
                self._queue(event)
                if isinstance(event, RawEvent):
                    self._images += 1
                    if self._images > self._most_images:
                        self._drop(next(e for e in self._waiting if isinstance(e, RawEvent)))
                if len(self._waiting) > _MOST_WAITING:
                    self._drop(next(e for e in self._waiting if isinstance(e, Event)))

    def reset_pose(self, belief: PoseWithCovariance) -> None:
        """Queue a pose to go on from; see `Estimation.reset_pose`."""
        with self._changed:
            self._queue(belief)

    def check_failed(self) -> None:
        """Raise the error that ended the run, if there is one; see `Estimation.check_failed`."""
        if self._failed is not None:
            raise self._failed

    def wait(self, timeout_s: float | None) -> bool:
        """Wait until everything queued has been used; see `Estimation.wait`."""
        longest_s = None if timeout_s is None else timeout_s + _STATUS_S
        try:
            return bool(self._ask("wait", timeout_s).result(longest_s))
        except TimeoutError:  # it does not even answer
            return False

    def status(self) -> LiveStatus:
        """State of the run, see `Estimation.status`; the last known one if the process is busy or has ended."""
        notes: tuple[str, ...] = ()
        if not self._closing and self._failed is None:
            with suppress(TimeoutError, FglocError):
                self._status = self._ask("status").result(_STATUS_S)
                self._answered_s = time.monotonic()
            silent_s = time.monotonic() - self._answered_s
            if silent_s > _SILENT_S:
                notes = (_SILENT.format(silent_s),)
        dropped = dict(self._dropped + Counter(self._status.dropped))
        notes += overload_notes(self._dropped_images, self._dropped.total() - self._dropped_images)
        return replace(self._status, dropped=dropped, notes=notes + self._status.notes)

    def save(self, path: Path) -> bool:
        """Save the state now; see `Estimation.save`."""
        return bool(self._ask("save", path).result())

    def begin_again(self, keep: Keep, source: LandmarkMap | Path | None = None) -> None:
        """Estimate anew; see `Estimation.begin_again`."""
        self._ask("begin_again", keep, source).result()

    def close(self) -> None:
        """End the run and the process; see `Estimation.close`."""
        with self._changed:
            if self._closing:
                return
            ending = self._ask("close") if self._threads and self._failed is None else None
            self._closing = True
            self._changed.notify_all()
        try:
            if ending is not None:
                self._status = ending.result(_END_S)
        except TimeoutError:
            raise EstimatorError(
                f"the process of the estimation did not end within {_END_S:g} s: ended without saving its last state"
            ) from None
        finally:
            self._child.kill()  # it has nothing more to do
            self._child.wait()
            for thread in self._threads:
                thread.join()
            self._connection.close()

    # --- under the condition ---

    def _queue(self, item: Event | PoseWithCovariance | _Question) -> None:
        self.check_failed()
        if self._closing:
            raise EstimatorError("the live run is closed; make a new Live")
        self._waiting.append(item)
        self._urgent = self._urgent or not isinstance(item, MotionEvent)
        if isinstance(item, RawEvent | SightingsEvent | SensorEvent):
            self._awaited_ns = item.stamp_ns
        if self._urgent or len(self._waiting) == 1:
            self._changed.notify_all()

    def _drop(self, event: Event) -> None:
        self._waiting.remove(event)
        self._images -= isinstance(event, RawEvent)
        self._dropped_images += isinstance(event, RawEvent)
        self._dropped[role_name(event, self._topics)] += 1

    def _ask(self, method: str, *arguments: Any) -> Future[Any]:
        """Call a method in the process; its answer comes after the results of everything queued before."""
        with self._changed:
            number, answer = next(self._numbers), Future[Any]()
            self._queue((number, method, arguments))
            self._asked[number] = answer
        return answer

    # --- threads ---

    def _send(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing or self._failed is not None)
                gather_s = _GATHER_S if self._awaited_ns is None else _GATHER_BRIEFLY_S
                self._changed.wait_for(lambda: self._urgent or self._closing, gather_s)
                batch = list(self._waiting)
                self._waiting.clear()
                self._images, self._urgent = 0, False
            if not batch:
                return
            try:
                self._connection.send(batch)
            except OSError:  # the process has ended: `_receive` tells
                return

    def _has_come(self, estimated_ns: int) -> None:
        with self._changed:
            if self._awaited_ns is not None and estimated_ns >= self._awaited_ns:
                self._awaited_ns = None

    def _receive(self, outlet: Outlet) -> None:
        while True:
            try:
                kind, *content = self._connection.recv()
            except (EOFError, OSError):
                return self._ended()
            if kind == "ready":
                self._answered_s = time.monotonic()
                continue
            if kind == "built":
                outlet.built(*content)
            elif kind == "estimated":
                outlet.estimated(*content)
                self._has_come(content[1].stamp_ns)
            elif kind == "failed":
                self._fail(*content)
            else:
                number, result = content
                with self._changed:
                    answer = self._asked.pop(number, None)
                if answer is None:  # the run has failed meanwhile
                    continue
                if isinstance(result, Exception):
                    answer.set_exception(result)
                else:
                    answer.set_result(result)

    def _ended(self) -> None:
        code = self._child.wait()
        if not self._closing:
            self._fail(
                EstimatorError(
                    f"the process of the estimation ended with exit code {code} (negative: the signal that ended it); "
                    "start again: with a state file (`--state`) it goes on from there"
                )
            )

    def _fail(self, error: FglocError) -> None:
        with self._changed:
            self._failed = self._failed or error
            asked, self._asked = self._asked, {}
            self._changed.notify_all()
        for answer in asked.values():
            answer.set_exception(error)


# --- The child process ------------------------------------------------------------------------------------------------

_ANSWERING = 4  # threads that answer questions


def main() -> None:
    """Run the child process: serve what comes through the pipe."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a service manager ends the parent too, which ends this one in order
    _Worker(Connection(int(sys.argv[1]))).run()


class _Worker:
    """Feeds an `Estimation` from a pipe, and answers through it."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = threading.Lock()

    def built(self, parts: MotionParts) -> None:
        self._tell("built", parts)

    def estimated(self, anchor: Anchor, estimate: Estimate) -> None:
        self._tell("estimated", anchor, estimate)

    def failed(self, error: FglocError) -> None:
        self._tell("failed", error)

    def run(self) -> None:
        """Serve the parent until the answer to `close` is sent, or the parent has ended."""
        gc.freeze()  # what was imported stays: nothing is to be collected there
        try:
            self._tell("ready")
            estimation = Estimation(self._connection.recv(), self)
            pool = ThreadPoolExecutor(_ANSWERING)
            while True:
                self._use(estimation, pool, self._connection.recv())
        except (EOFError, OSError):
            os._exit(1)
        except Exception as error:
            self._tell("failed", unexpected(error, "the live run"))  # the settings cannot be used

    def _use(self, estimation: Estimation, pool: ThreadPoolExecutor, batch: Iterable[Any]) -> None:
        """Pass a batch on in its order."""
        for is_event, items in groupby(batch, lambda item: isinstance(item, Event)):
            with suppress(FglocError):  # it has failed, and has told so
                if is_event:
                    estimation.put(items)
                    continue
                for item in items:
                    if isinstance(item, PoseWithCovariance):
                        estimation.reset_pose(item)
                    else:
                        pool.submit(self._answer, estimation, *item)

    def _answer(self, estimation: Estimation, number: int, method: str, arguments: tuple[Any, ...]) -> None:
        try:
            result = getattr(estimation, method)(*arguments)
            if method == "close":
                result = estimation.status()
        except Exception as error:
            result = unexpected(error, "the live run")
        self._tell("answer", number, result)

    def _tell(self, *message: Any) -> None:
        with self._sending:
            self._connection.send(message)
