"""Marker detection: dictionaries, whole images, following through a stream, remembered detections, hints."""

from __future__ import annotations

import hashlib
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any, Protocol
from zipfile import BadZipFile

import cv2
import numpy as np
from cv2.typing import MatLike

from fgloc.config import Config, MarkersConfig, Role
from fgloc.errors import ConfigError
from fgloc.files.atomic import atomic_file
from fgloc.files.documents import nested, read_text
from fgloc.sensors.markers.edges import (
    ALL_WINDOWS,
    SMALLEST,
    CoarseSearch,
    Found,
    detector_parameters,
    in_order,
    inside,
    pairs,
    refine_all,
    subpixel,
)
from fgloc.sensors.markers.images import CornersEvent, GrayImage, ImageError, ImageEvent, MarkerCorners, decode, decoded
from fgloc.types import Event, FloatArray, LandmarkMap, RawEvent, SightingsEvent

_LOOKAHEAD = 4  # images that may be detected before the consumer asks for them


class Detector(Protocol):
    """Interface of a detector of landmarks in raw data."""

    def detect(self, event: Any) -> Any:
        """The sightings of one raw event.

        Raises:
            ImageError: it cannot be decoded.
        """
        ...


def use_one_thread() -> None:
    """Switch OpenCV's own threads off for the process: beside a detection thread they take the estimator's core."""
    cv2.setNumThreads(1)


def detect_stream(
    events: Iterable[Event],
    detector: Detector,
    rejections: Counter[str],
    image_role: Callable[[str], Role] = lambda topic: "image",
) -> Iterator[Event]:
    """All events in their order, with a sightings event in the place of each image.

    Detection runs in one thread of its own, at most a few images ahead of the consumer; OpenCV releases Python's lock
    meanwhile. OpenCV's own threads are switched off for the process, so that the rest keeps its core.

    Args:
        events: any events; an image that cannot be decoded is left out.
        detector: not to be used elsewhere at the same time.
        rejections: counts images left out, by role and reason.
        image_role: gives the role of a topic of images.
    """
    use_one_thread()
    waiting: deque[Event | tuple[str, Future[SightingsEvent]]] = deque()
    images = 0
    worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="marker-detection")
    try:
        for event in events:
            if isinstance(event, RawEvent):
                waiting.append((event.topic, worker.submit(detector.detect, event)))
                images += 1
            else:
                waiting.append(event)
            while waiting and (images > _LOOKAHEAD or isinstance(waiting[0], Event) or waiting[0][1].done()):
                images -= not isinstance(waiting[0], Event)
                yield from _resolved(waiting.popleft(), rejections, image_role)
        while waiting:
            yield from _resolved(waiting.popleft(), rejections, image_role)
    finally:
        worker.shutdown(wait=True, cancel_futures=True)


def _resolved(
    item: Event | tuple[str, Future[SightingsEvent]], rejections: Counter[str], image_role: Callable[[str], Role]
) -> Iterator[Event]:
    if isinstance(item, Event):
        yield item
        return
    topic, found = item
    try:
        yield found.result()
    except ImageError as error:
        rejections[f"{image_role(topic)}.{error.reason}"] += 1


_FILE_SUFFIXES = {".yml", ".yaml", ".json", ".xml"}
_MAX_BYTES = 1_000_000  # of a dictionary file; the largest that OpenCV ships has 1000 markers in 120 kB
_APRILTAG = "DICT_APRILTAG_"
_TAG36H11_0 = 0xD5D628584  # bits of tag 0 of tag36h11 from the top left, row by row, as the AprilTag project prints it
_LEAST_EVIDENCE_BITS = 6.0  # log2 of how much less likely than this chance has to be


def dictionary_names() -> tuple[str, ...]:
    """Names of the predefined dictionaries, in OpenCV's spelling, those spelled in two ways once."""
    names = {n.upper(): n for n in sorted(dir(cv2.aruco)) if n.startswith("DICT_")}  # "36h11" sorts behind "36H11"
    return tuple(sorted(names.values()))


def load_dictionary(name: str) -> cv2.aruco.Dictionary:
    """A predefined dictionary by its name in any case, or one of OpenCV's dictionary files.

    Raises:
        ConfigError: no such name (all are listed), or the file holds no dictionary.
    """
    known = {n.upper(): n for n in dictionary_names()}
    if name.upper() in known:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, known[name.upper()]))
    if Path(name).suffix.lower() not in _FILE_SUFFIXES:
        raise ConfigError(f"marker dictionary '{name}' is not known; known are {', '.join(known.values())}")
    dictionary = cv2.aruco.Dictionary()
    text = read_text(Path(name), ConfigError, "give the name or the file of a marker dictionary", _MAX_BYTES)
    if nested(text):  # OpenCV's reader would exhaust the stack
        raise ConfigError(f"{name}: not a marker dictionary of OpenCV: brackets are nested too deeply")
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        good = storage.isOpened() and dictionary.readDictionary(storage.root())
        storage.release()
    except (cv2.error, SystemError) as error:
        raise ConfigError(f"{name}: not a marker dictionary of OpenCV: {error}") from error
    if not good or len(dictionary.bytesList) == 0:
        raise ConfigError(f"{name}: not a marker dictionary of OpenCV (keys nmarkers, markersize, marker_0, ...)")
    return dictionary


def turned_by_180(name: str) -> bool:
    """Whether OpenCV's picture of these markers stands on its head, compared with the AprilTag project's prints.

    Source: OpenCV pull request 28823; the check of one known tag keeps this right before and after it.
    """
    if not name.upper().startswith(_APRILTAG):
        return False
    drawn = cv2.aruco.generateImageMarker(load_dictionary("DICT_APRILTAG_36h11"), 0, 8)[1:7, 1:7].ravel() > 0
    return int("".join("1" if bit else "0" for bit in drawn), 2) != _TAG36H11_0


def _evidence_bits(dictionary: cv2.aruco.Dictionary) -> float:
    """Negative binary logarithm of the probability that a random square reads as one of the markers [bits]."""
    bits = int(dictionary.markerSize) ** 2
    wrong = int(0.6 * dictionary.maxCorrectionBits)  # OpenCV's default error correction rate
    accepted = sum(math.comb(bits, k) for k in range(wrong + 1))
    return bits - math.log2(4 * len(dictionary.bytesList) * accepted)


_LEAST_SIDE_PX = 16  # of an image
_SECOND_LOOKS = 12  # small unreadable squares of an image that are enlarged and read again
_SECOND_LOOK_SIDE_PX = (6.0, 32.0)  # smaller ones cannot be read, larger ones needed no enlarging
_ENLARGE = 3
_HINT_RATIO = 2  # a changed image has to show more than this many times the markers to be worth a hint


Box = tuple[int, int, int, int]
"""Part of an image [px]: left, top, and the first column and row beyond it."""


class MarkerDetector:
    """Finds the markers of one dictionary.

    Corners are in the order of MarkerCorners. AprilTags count as upright in the way that the AprilTag project prints
    them, whichever way the installed OpenCV draws them (before 5.1 it draws them turned by 180 degrees).

    Small squares that OpenCV finds but cannot read are enlarged and read once more: this finds markers of little more
    than one pixel per cell without correcting more wrong bits, which would let false markers in.
    """

    def __init__(self, dictionary: str, config: MarkersConfig) -> None:
        """Prepare detection.

        Args:
            dictionary: OpenCV's name ("DICT_4X4_50", "DICT_APRILTAG_36h11") or an OpenCV dictionary file (.yml).
            config: detection settings.

        Raises:
            ConfigError: there is no such dictionary; the names that there are are listed.
        """
        self._config = config
        self.dictionary = dictionary
        self.unseen = (
            f"No image that was looked at shows a marker of {dictionary}: they are dark or blurred, or the markers are "
            "absent, too small or of another dictionary."
        )
        self._dictionary = load_dictionary(dictionary)
        self._cells = int(self._dictionary.markerSize) + 2
        self._turn = 2 if turned_by_180(dictionary) else 0
        self._whole = cv2.aruco.ArucoDetector(self._dictionary, detector_parameters(ALL_WINDOWS))
        enlarged = detector_parameters(ALL_WINDOWS, smallest=1.0)
        enlarged.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._second = cv2.aruco.ArucoDetector(self._dictionary, enlarged)

    def following(self) -> Detector:
        """A detector that follows the markers from image to image, which have to come in their order."""
        return TrackingDetectors(self)

    def coarse(self) -> CoarseSearch:
        """A faster search, for images between those that this one searches."""
        return CoarseSearch(self._dictionary, self._turn)

    def remembering(self, detector: Detector, file: Path | None, known: Any, note: bool = True) -> RememberedDetections:
        """A detector that asks another one only about images that are not known, from a file or an earlier run."""
        return RememberedDetections(file, detector, known, note)

    def hints(self, recording: Any) -> tuple[tuple[str, ...], str | None]:
        """Hints on why no marker is found, a sentence each: another dictionary, mirrored images, inverted prints.

        Returns:
            The sentences, `unseen` where nothing else is known; and the dictionary, if it is another one.
        """
        images = _some_images(recording)
        hints = list(dict.fromkeys(hint for image in images for hint in self.diagnose(image)))
        found = any(self.find(image) for image in images)
        fitting = None if found else suggest_dictionary(images)
        if fitting is None or fitting == self.dictionary:
            return tuple(hints or [self.unseen] * (bool(images) and not found)), None
        sentence = f"No marker of {self.dictionary} is seen, but of {fitting}: set markers.dictionary: {fitting}."
        return (*hints, sentence), fitting

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image, ordered by id and place; an image without markers gives an event without sightings.

        Raises:
            ImageError: the image cannot be decoded.
        """
        return CornersEvent.found_in(event, (MarkerCorners(i, corners) for i, corners in self.find(decode(event))))

    def find(self, image: GrayImage) -> Found:
        """Id and corners ``(4, 2)`` of each marker in a gray image, ordered by id, then from the left."""
        return self.read(image)[0]

    def read(self, image: GrayImage) -> tuple[Found, int]:
        """Markers, as `find` gives them, and the number of squares that could have been markers."""
        found, squares = self._search(image, None)
        return self._refined(image, found), squares

    def find_within(self, image: GrayImage, box: Box) -> Found:
        """Markers in a part of an image, see `find`, that lie wholly some ten pixels from its borders."""
        return self._refined(image, self._search(image, box)[0])

    def _search(self, image: GrayImage, box: Box | None) -> tuple[Found, int]:
        """Ids with corners in the whole image's pixels, not refined by their edges, and the number of squares."""
        left, top, right, bottom = box or (0, 0, image.shape[1], image.shape[0])
        part = np.ascontiguousarray(image[top:bottom, left:right])
        if min(part.shape) < _LEAST_SIDE_PX:
            return [], 0
        detector = self._whole
        if box is not None:
            smallest = SMALLEST * max(image.shape) / max(part.shape)
            detector = cv2.aruco.ArucoDetector(self._dictionary, detector_parameters(ALL_WINDOWS, smallest))
        corners, ids, rejected = detector.detectMarkers(part)
        at = np.array([left, top], dtype=float)
        # From here on in the whole image, so that a part of it gives the same numbers.
        found: Found = []
        if ids is not None:
            exact = subpixel(image, np.concatenate(corners) + at, self._cells)
            found = [(int(i), c) for i, c in zip(ids.ravel(), exact, strict=True)]
        found += self._look_again(image, [square + at for square in rejected], found)
        return found, len(corners) + len(rejected)

    def _refined(self, image: GrayImage, found: Found) -> Found:
        """Corners from the markers' edges, in the order of `find`."""
        if not found:
            return []
        refined = refine_all(image, np.array([c for _, c in found]), self._cells)
        turned = [(i, np.roll(c, self._turn, axis=0)) for (i, _), c in zip(found, refined, strict=True)]
        return in_order(turned)

    def diagnose(self, image: GrayImage) -> list[str]:
        """Hints, one sentence each, on an image in which fewer markers are found than there should be."""
        hints = []
        here = len(self.find(image))
        if len(self.find(np.ascontiguousarray(image[:, ::-1]))) > _HINT_RATIO * here:
            hints.append(
                "The markers are seen mirrored: the camera driver flips the image, or they were printed mirrored."
            )
        if len(self.find(255 - image)) > _HINT_RATIO * here:
            hints.append("The markers are seen inverted, white on black: print them black on white.")
        return hints

    def _look_again(self, image: GrayImage, rejected: Sequence[MatLike], found: Found) -> Found:
        """Markers among the small squares that could not be read."""
        more: Found = []
        for square in _small_squares(rejected):
            center = square.mean(axis=0)
            if any(inside(c, center) for _, c in [*found, *more]):
                continue
            reach = np.ptp(square, axis=0).max()
            low = np.maximum(np.floor(center - reach), 0).astype(int)
            high = np.minimum(np.ceil(center + reach).astype(int) + 1, image.shape[::-1])
            part = image[low[1] : high[1], low[0] : high[0]]
            large = cv2.resize(part, None, fx=_ENLARGE, fy=_ENLARGE, interpolation=cv2.INTER_CUBIC)
            corners, ids, _ = self._second.detectMarkers(large)
            for i, c in pairs(ids, corners):
                original = (c + 0.5) / _ENLARGE - 0.5 + low
                if not any(inside(k, original.mean(axis=0)) for _, k in [*found, *more]):
                    more.append((i, original))
        return more


def suggest_dictionary(images: Iterable[GrayImage]) -> str | None:
    """The smallest predefined dictionary that fits what is seen in the images, or None if that could be chance.

    It is the one whose sightings are the least likely to be chance, in its smallest size that holds the ids.
    """
    config, gray = MarkersConfig(), list(images)
    families: dict[str, list[str]] = {}
    for name in dictionary_names():
        stem, _, count = name.rpartition("_")
        families.setdefault(stem if count.isdigit() else name, []).append(name)
    best, best_evidence = None, _LEAST_EVIDENCE_BITS
    for names in families.values():
        names.sort(key=lambda n: len(load_dictionary(n).bytesList))
        detector = MarkerDetector(names[-1], config)
        looks = [detector.read(image) for image in gray]
        ids = [i for found, _ in looks for i, _ in found]  # once for each sighting
        squares = sum(tried for _, tried in looks)
        by_chance = math.log2(math.comb(max(squares, len(ids)), len(ids)))  # the ways to pick those that read wrongly
        evidence = len(ids) * _evidence_bits(load_dictionary(names[-1])) - by_chance
        if evidence > best_evidence:
            best_evidence = evidence
            best = next(n for n in names if len(load_dictionary(n).bytesList) > max(ids))
    return best


def configured_detector(config: Config, landmark_map: LandmarkMap | None) -> MarkerDetector:
    """The detector of the configured dictionary, or of the map's.

    Raises:
        ConfigError: neither names one.
    """
    dictionary = config.markers.dictionary or (landmark_map.dictionary if landmark_map is not None else "")
    if not dictionary:
        raise ConfigError("no marker dictionary: set markers.dictionary (such as DICT_4X4_50) in --config or the map")
    return MarkerDetector(dictionary, config.markers)


def _small_squares(rejected: Sequence[MatLike]) -> list[FloatArray]:
    """Squares ``(4, 2)`` worth a second look, largest first."""
    low, high = _SECOND_LOOK_SIDE_PX
    squares = [np.asarray(r, dtype=np.float64).reshape(4, 2) for r in rejected]
    sides = [np.linalg.norm(s - np.roll(s, 1, axis=0), axis=1) for s in squares]
    kept = [(float(e.sum()), s) for e, s in zip(sides, squares, strict=True) if low < e.min() and e.max() < high]
    return [s for _, s in sorted(kept, key=lambda item: -item[0])[:_SECOND_LOOKS]]


_EVERY = 30  # images from one search of the whole image at full resolution to the next
_EVERY_WITHOUT = 4  # likewise, while there are no markers
_MOST_SHARE = 0.5  # of the image that is read in parts; beyond that, all of it costs no more
_MAX_GAP_NS = 1_000_000_000  # markers that were seen longer ago are not looked for
_ROOM_PX = 16.0  # around a marker, for the detector's widest threshold and contours that touch the part's border
_ROOM_SHARE = 0.5  # of its side, for motion that differs from that of the other markers
_MARGIN_PX = 12.0  # of that room: for the widest threshold alone
_BORDER_PX = 2.0  # squares that come nearer to the image's border are cut by it


class TrackingDetector:
    """Finds the markers of a camera's images, which have to come in their order.

    Attributes:
        counts: images searched at full resolution ("whole"), coarsely ("coarse"), and the latter's parts that were read
            at full resolution ("parts").
    """

    def __init__(self, detector: MarkerDetector) -> None:
        """Take a detector, which may be used elsewhere too."""
        self.counts: Counter[str] = Counter()
        self._detector = detector
        self._coarse = detector.coarse()
        self._last: Found = []
        self._last_ns = -math.inf
        self._shape: tuple[int, ...] = ()
        self._since_whole = 0

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image, ordered by id and place; an image without markers gives an event without sightings.

        Raises:
            ImageError: the image cannot be decoded.
        """
        found = self.find(decode(event), event.stamp_ns)
        return CornersEvent.found_in(event, (MarkerCorners(i, corners) for i, corners in found))

    def find(self, image: GrayImage, stamp_ns: int) -> Found:
        """Id and corners ``(4, 2)`` of each marker in a gray image, ordered by id, then from the left."""
        known = self._last if image.shape == self._shape else []
        follows = image.shape == self._shape and 0 <= stamp_ns - self._last_ns <= _MAX_GAP_NS
        self._since_whole += 1
        found = None
        if follows and self._since_whole < (_EVERY if known else _EVERY_WITHOUT):
            self.counts["coarse"] += 1
            found = self._coarsely(image, known)
        if found is None:
            self.counts["whole"] += 1
            self._since_whole = 0
            found = self._detector.find(image)
        self._last, self._last_ns, self._shape = found, stamp_ns, image.shape
        return found

    def _coarsely(self, image: GrayImage, known: Found) -> Found | None:
        """Markers by a coarse search and a close look at some parts; None if the whole image has to be searched."""
        found, squares = self._coarse.find(image)
        missing, moved = _compare(known, found)
        if missing:
            shift = np.median(moved, axis=0) if moved else np.zeros(2)
            squares += [corners + shift for corners in missing]
        parts = _parts(squares, found, image.shape) if squares else []
        if sum((right - left) * (bottom - top) for left, top, right, bottom in parts) > _MOST_SHARE * image.size:
            return None
        for part in parts:
            self.counts["parts"] += 1
            read = self._detector.find_within(image, part)
            found += [(i, c) for i, c in read if not any(i == j and _near(c, d) for j, d in found)]
        return None if known and not found else in_order(found)


class TrackingDetectors:
    """Finds the markers of the images of any number of cameras, each followed by itself."""

    def __init__(self, detector: MarkerDetector) -> None:
        """Take the detector that all of them share."""
        self._detector = detector
        self._of_topic: dict[str, TrackingDetector] = {}

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; raises as `TrackingDetector.detect` does."""
        if event.topic not in self._of_topic:
            self._of_topic[event.topic] = TrackingDetector(self._detector)
        return self._of_topic[event.topic].detect(event)


def _compare(known: Found, found: Found) -> tuple[list[FloatArray], list[FloatArray]]:
    """Corners of the last image's markers that are missing now, and how far those that are not have moved ``(2,)``."""
    left: dict[int, deque[FloatArray]] = {}
    for i, corners in found:
        left.setdefault(i, deque()).append(corners)
    missing, moved = [], []
    for i, corners in known:
        if left.get(i):
            moved.append(left[i].popleft()[0] - corners[0])
        else:
            missing.append(corners)
    return missing, moved


def _parts(squares: Iterable[FloatArray], found: Found, shape: tuple[int, ...]) -> list[Box]:
    """The parts of an image in which squares are to be read, but for those of markers that were found."""
    size = np.array([shape[1], shape[0]])
    parts: list[Box] = []
    for square in squares:
        low, high = square.min(axis=0), square.max(axis=0)
        leaves = (low < _BORDER_PX).any() or (high > size - 1.0 - _BORDER_PX).any()
        if leaves or any(_near(c, square) for _, c in found) or any(_contains(p, low, high) for p in parts):
            continue
        parts.append(_box_around(low, high, size))
    return parts


def _contains(part: Box, low: FloatArray, high: FloatArray) -> bool:
    """Whether a part holds a square with the room that a search of it needs."""
    return bool((low - part[:2] >= _MARGIN_PX).all() and (part[2:] - high > _MARGIN_PX).all())


def _box_around(low: FloatArray, high: FloatArray, size: FloatArray) -> Box:
    """The part of an image around a square."""
    room = _ROOM_PX + _ROOM_SHARE * float((high - low).max())
    left, top = np.maximum(np.floor(low - room), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(high + room) + 1, size).astype(int).tolist()
    return left, top, right, bottom


def _near(a: FloatArray, b: FloatArray) -> bool:
    """Whether two quadrilaterals are one and the same marker."""
    side = float(np.linalg.norm(a - np.roll(a, 1, axis=0), axis=1).max())
    return bool(np.linalg.norm(a.mean(axis=0) - b.mean(axis=0)) < 0.5 * side)


Detections = tuple[MarkerCorners, ...]
"""Of one image."""


class RememberedDetections:
    """Asks a detector only about images that no run before has asked about.

    What is remembered goes by the image's content: a result is the same whether it was remembered or found anew. The
    file is for one dictionary and one version of the detector, which its name has to tell. Images that cannot be
    decoded are not remembered. Several processes may use the file at once: what one of them fails to add is found anew.

    Attributes:
        found: what is not in the file, by image: ``known`` for another detector of the same images.
    """

    def __init__(
        self,
        path: Path | None,
        detector: Detector,
        known: Mapping[bytes, Detections] | None = None,
        note: bool = True,
    ) -> None:
        """Take what a file and an earlier run know.

        Args:
            path: file; None: nothing is written.
            detector: asked about all other images.
            known: found by a detector of the same dictionary; goes into the file as well.
            note: whether to remember what is found anew: memory grows with the images.
        """
        self.found: dict[bytes, Detections] = dict(known or {})
        self._path = path
        self._detector = detector
        self._note = note
        self._known = (_read(path) if path is not None else {}) | self.found

    def detect(self, event: ImageEvent) -> CornersEvent:
        """The markers of one image; raises as the detector does."""
        key = _key(event)
        sightings = self._known.get(key)
        if sightings is None:
            sightings = self._detector.detect(event).sightings
            if self._note:
                self._known[key] = self.found[key] = sightings
        return CornersEvent.found_in(event, sightings)

    def save(self) -> None:
        """Add what was new to the file, if there is one.

        Raises:
            OutputError: it cannot be written.
        """
        if self._path is not None and self.found:
            _write(self._path, _read(self._path) | self.found)
            self.found.clear()


def _key(event: ImageEvent) -> bytes:
    form = f"{event.encoding} {event.compressed} {event.width} {event.height} {event.step} {event.is_bigendian}"
    digest = hashlib.sha256(form.encode())
    digest.update(event.data.tobytes())
    return digest.digest()


def _read(path: Path) -> dict[bytes, Detections]:
    """Detections of a file by image; empty if there is no file, or none that can be read."""
    try:
        with path.open("rb") as content, np.load(content, allow_pickle=False) as file:
            keys, counts, ids, corners = (file[name] for name in ("keys", "counts", "ids", "corners"))
    except (OSError, ValueError, KeyError, BadZipFile, EOFError):
        return {}
    sightings = [MarkerCorners(i, c) for i, c in zip(ids.tolist(), corners, strict=True)]
    ends = np.cumsum(counts).tolist()
    return {
        key.tobytes(): tuple(sightings[end - count : end])
        for key, count, end in zip(keys, counts.tolist(), ends, strict=True)
    }


def _write(path: Path, known: dict[bytes, Detections]) -> None:
    found = [s for sightings in known.values() for s in sightings]
    with atomic_file(path, binary=True) as file:
        np.savez(
            file,
            keys=np.frombuffer(b"".join(known), dtype=np.uint8).reshape(len(known), 32),
            counts=np.array([len(sightings) for sightings in known.values()], dtype=np.int64),
            ids=np.array([s.landmark_id for s in found], dtype=np.int64),
            corners=np.array([s.corners_px for s in found], dtype=float).reshape(len(found), 4, 2),
        )


_IMAGES = 5  # looked at, spread over the recording
_SCANNED = 200


def fitting_dictionary(recording: Any) -> str | None:
    """The marker dictionary that fits what is seen in a recording; None if none does."""
    return suggest_dictionary(_some_images(recording))


def _some_images(recording: Any) -> list[GrayImage]:
    events = list(islice((e for e in recording.events() if isinstance(e, ImageEvent)), _SCANNED))
    images = map(decoded, events[:: max(1, len(events) // _IMAGES)])
    return [image for image in images if image is not None]
