"""What may be wrong with a camera in whose images no marker of the map is found."""

from __future__ import annotations

from itertools import islice

from fgloc.recording.reader import Recording
from fgloc.sensors.markers.detector import MarkerDetector, suggest_dictionary
from fgloc.sensors.markers.events import ImageEvent
from fgloc.sensors.markers.images import GrayImage, ImageError, decode

_IMAGES = 5  # looked at, spread over the recording
_SCANNED = 200


def image_hints(recording: Recording, detector: MarkerDetector) -> tuple[tuple[str, ...], str | None]:
    """One sentence for each thing that would explain it: another dictionary, mirrored images, inverted prints.

    Returns:
        The sentences; and the dictionary, if it is another one.
    """
    images = _some_images(recording)
    hints = list(dict.fromkeys(hint for image in images for hint in detector.diagnose(image)))
    fitting = None if any(detector.find(image) for image in images) else suggest_dictionary(images)
    if fitting is None or fitting == detector.dictionary:
        return tuple(hints), None
    sentence = f"No marker of {detector.dictionary} is seen, but of {fitting}: set markers.dictionary: {fitting}."

    return (*hints, sentence), fitting


def fitting_dictionary(recording: Recording) -> str | None:
    """The marker dictionary that fits what is seen in a recording; None if none does."""
    return suggest_dictionary(_some_images(recording))


def _some_images(recording: Recording) -> list[GrayImage]:
    events = list(islice((e for e in recording.events() if isinstance(e, ImageEvent)), _SCANNED))
    images = []
    for event in events[:: max(1, len(events) // _IMAGES)]:
        try:
            images.append(decode(event))
        except ImageError:
            continue
    return images
