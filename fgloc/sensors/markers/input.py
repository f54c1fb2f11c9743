"""Images, and markers that were found in them, from arrays."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fgloc.errors import RecordingError
from fgloc.sensors.event_input import SENSOR, EventInput
from fgloc.sensors.markers.events import CornersEvent, ImageEvent, MarkerCorners


class MarkersInput(EventInput):
    """What a camera sees."""

    def image(self, stamp_ns: int, image: NDArray[np.uint8] | bytes, frame_id: str = SENSOR) -> None:
        """An image: grey ``(h, w)``, colour ``(h, w, 3)`` in OpenCV's order (blue first), or encoded (JPEG, PNG).

        Raises:
            RecordingError: an array of another shape or type.
        """
        when = self._when("image", stamp_ns)
        if isinstance(image, bytes | bytearray | memoryview):
            data = np.frombuffer(image, dtype=np.uint8)
            kind = "png" if bytes(image[:4]) == b"\x89PNG" else "jpeg"
            return self._deliver(ImageEvent(*when, frame_id, kind, True, 0, 0, 0, False, data))
        shape = image.shape
        if image.dtype != np.uint8 or len(shape) not in (2, 3) or shape[2:] not in ((), (3,)):
            raise RecordingError(
                f"image of shape {shape} and type {image.dtype}; expected uint8, (h, w) grey or (h, w, 3) blue first, "
                "or the bytes of a JPEG or PNG"
            )
        encoding = "mono8" if len(shape) == 2 else "bgr8"
        step = shape[1] * (1 if len(shape) == 2 else 3)
        data = np.ascontiguousarray(image).reshape(-1).copy()  # the caller's buffer may be used again
        self._deliver(ImageEvent(*when, frame_id, encoding, False, shape[1], shape[0], step, False, data))

    def corners(self, stamp_ns: int, markers: Mapping[int, ArrayLike], frame_id: str = SENSOR) -> None:
        """Markers that were found in an image: corners ``(4, 2)`` [px] by id, clockwise from its top left."""
        found = tuple(MarkerCorners(int(i), np.asarray(c, dtype=float).reshape(4, 2)) for i, c in markers.items())
        self._deliver(CornersEvent(*self._when("sightings", stamp_ns), frame_id, found))
