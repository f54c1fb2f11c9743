"""Marker detection beside the estimation: one worker, and a queue that drops the oldest waiting image."""

from __future__ import annotations

import threading
from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum

from fgloc.sensors.markers.detector import Detector, use_one_thread
from fgloc.sensors.markers.images import ImageError
from fgloc.types import Event, RawEvent, SightingsEvent


class State(Enum):
    """Of a queued event."""

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
        rejections: images that could not be decoded, as "image." and the reason.
        dropped: images dropped under overload.
        error: what ended the thread, if it was not `stop`.
    """

    def __init__(self, changed: threading.Condition, most_waiting: int) -> None:
        """Start the thread.

        Args:
            changed: notified whenever an image is done.
            most_waiting: images that may wait, from their arrival until the estimator has their markers.
        """
        use_one_thread()
        self.detector: Detector | None = None
        self.rejections: Counter[str] = Counter()
        self.dropped = 0
        self.error: Exception | None = None
        self._changed = changed
        self._most = most_waiting
        self._images: deque[Queued] = deque()  # from arrival until used
        self._todo: deque[Queued] = deque()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="fgloc-detection", daemon=True)
        self._thread.start()

    @property
    def queued(self) -> int:
        """Images that wait."""
        return len(self._images)

    def arrived(self, image: Queued) -> None:
        """Count an image in; of too many the oldest that the worker does not have is dropped. Hold the condition."""
        self._images.append(image)
        waiting = [q for q in self._images if q.state is not State.DETECTING]
        if len(waiting) > self._most:
            self.dropped += 1
            self.discard(waiting[0])

    def discard(self, image: Queued) -> None:
        """An image is of no use any more, or was used. Hold the condition."""
        if image.state is not State.DETECTING:
            image.event, image.state = None, State.GONE
        if image in self._images:
            self._images.remove(image)

    def submit(self, image: Queued) -> None:
        """Have an image's markers found. Hold the condition."""
        self._todo.append(image)
        self._changed.notify_all()

    def stop(self) -> None:
        """End the thread; images that wait are left."""
        with self._changed:
            self._stopping = True
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
                        image.state = State.DETECTING
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
                self.error = error
                return self._wake()
            with self._changed:
                if reason:
                    self.rejections[f"image.{reason}"] += 1
                image.event, image.state = found, State.GONE if found is None else State.READY
                if found is None and image in self._images:
                    self._images.remove(image)
                self._changed.notify_all()
