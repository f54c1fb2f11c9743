"""Sensors whose raw data a detector has to look through first: the detector, and its place in a stream of events."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

import cv2

from fgloc.errors import RecordingError
from fgloc.types import Event, RawEvent, SightingsEvent

_LOOKAHEAD = 4  # images that may be detected before the consumer asks for them


class DetectionError(RecordingError):
    """Raw data cannot be decoded.

    Attributes:
        reason: short name to count by.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Detector(Protocol):
    """What finds landmarks in raw data."""

    def detect(self, event: Any) -> Any:
        """The sightings of one raw event.

        Raises:
            DetectionError: it cannot be decoded.
        """
        ...


class RememberingDetector(Detector, Protocol):
    """A detector that remembers.

    Attributes:
        found: what it found anew, by data.
    """

    found: dict[bytes, Any]

    def save(self) -> None:
        """Keep what was found for other runs."""
        ...


class SensorDetector(Detector, Protocol):
    """The detector of a sensor, as `fgloc.sensors.roles.RawLandmarksRole` makes it; it does not depend on earlier data.

    Attributes:
        dictionary: of the landmarks that it finds.
    """

    dictionary: str

    def following(self) -> Detector:
        """A detector that follows landmarks through the data, which have to come in their order."""
        ...

    def remembering(self, detector: Detector, file: Path | None, known: Any, note: bool = True) -> RememberingDetector:
        """A detector that asks another one only about data that is not known.

        Args:
            detector: to be asked.
            file: holds what other runs found; None: there is none.
            known: what an earlier detector found.
            note: whether to remember what is found anew.
        """
        ...

    def hints(self, recording: Any) -> tuple[tuple[str, ...], str | None]:
        """Sentences on what may be wrong where nothing is found; and the dictionary, if another one fits."""
        ...


def use_one_thread() -> None:
    """Switch OpenCV's own threads off for the process: beside a detection thread they take the estimator's core."""
    cv2.setNumThreads(1)


def detect_stream(events: Iterable[Event], detector: Detector, rejections: Counter[str]) -> Iterator[Event]:
    """All events in their order, with a sightings event in the place of each image.

    Detection runs in one thread of its own, at most a few images ahead of the consumer; OpenCV releases Python's lock
    meanwhile. OpenCV's own threads are switched off for the process, so that the rest keeps its core.

    Args:
        events: any events; an image that cannot be decoded is left out.
        detector: not to be used elsewhere at the same time.
        rejections: counts images left out, as "image." and the reason.
    """
    use_one_thread()
    waiting: deque[Event | Future[SightingsEvent]] = deque()
    images = 0
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="marker-detection")
    try:
        for event in events:
            if isinstance(event, RawEvent):
                waiting.append(worker.submit(detector.detect, event))
                images += 1
            else:
                waiting.append(event)
            while waiting and (images > _LOOKAHEAD or not isinstance(waiting[0], Future) or waiting[0].done()):
                images -= isinstance(waiting[0], Future)
                yield from _resolved(waiting.popleft(), rejections)
        while waiting:
            yield from _resolved(waiting.popleft(), rejections)
    finally:
        worker.shutdown(wait=True, cancel_futures=True)


def _resolved(item: Event | Future[SightingsEvent], rejections: Counter[str]) -> Iterator[Event]:
    if not isinstance(item, Future):
        yield item
        return
    try:
        yield item.result()
    except DetectionError as error:
        rejections[f"image.{error.reason}"] += 1
