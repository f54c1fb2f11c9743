"""The child process of `fgloc.live.process`: an `Estimation` that is fed from a pipe."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import groupby
from multiprocessing.connection import Connection
from typing import Any

from fgloc.errors import FglocError, unexpected
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.anchors import Anchor, MotionParts
from fgloc.live.estimation import Estimation
from fgloc.types import Estimate, Event

_ANSWERING = 4  # threads that answer questions


def main() -> None:
    """Of the child process: do what comes through the pipe."""
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
        """Until the parent has what it asked of the end, or has ended itself: then nothing is left to do."""
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
        """In order."""
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
