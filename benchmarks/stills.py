"""Published marker ids that are not found in photographs, and markers that tracking does not find.

stills.missed_ids            published ids that are not found
detect.over_full             time of a thorough search of every image over that of following markers
detect.search_over_full      likewise, without the fit of the markers' edges, which both do alike
detect.lost, detect.gained   markers that only the former finds, and only the latter: the bundled samples' images, and
                             the photographs, each shown five times
detect.corner_rms_px         difference of their corners
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from rosbags.highlevel import AnyReader

from benchmarks.common import DATA, SAMPLES, Row, main, not_run
from fgloc.config import MarkersConfig, load_config
from fgloc.recording.reader import open_recording
from fgloc.sensors.maps import load_map
from fgloc.sensors.markers.detector import MarkerDetector, TrackingDetector, use_one_thread
from fgloc.sensors.markers.edges import refine_all
from fgloc.sensors.markers.images import GrayImage, ImageEvent, decode
from fgloc.types import FloatArray

_ID = "stills.missed_ids"
_SHOWN, _SHOWN_EVERY_NS = 5, 50_000_000
_TUTORIAL_DICTIONARY = "opencv_aruco/tutorial_dict.yml"


@dataclass(frozen=True, slots=True)
class Still:
    """One photograph: file (below marker_images), dictionary (a file if it has a suffix), ids with repetitions."""

    file: str
    dictionary: str
    ids: tuple[int, ...]


# Where the ids come from. OpenCV: modules/objdetect/test/test_arucodetection.cpp, tests CV_ArucoTutorial. Ubiquity
# Robotics' fiducials: file names and prints ("403 D7": dictionary 7 is DICT_5X5_1000), aruco_detect/test and, for the
# bag, fiducial_slam/test/create_map_aruco.xml. dt_apriltags publishes no ids: these were read with the AprilTag
# project's own detector (pupil-apriltags 1.0.4, not decimated; all with hamming distance 0); the tags at the rim of
# test_image.png, dark or cut, it does not read.
STILLS = (
    Still("opencv_aruco/singlemarkersoriginal.jpg", "DICT_6X6_250", (23, 40, 62, 98, 124, 203)),
    Still("opencv_aruco/singlemarkerssource.jpg", "DICT_6X6_250", (23, 40, 62, 98, 124, 203)),
    Still("opencv_aruco/choriginal.jpg", "DICT_6X6_250", tuple(range(17))),
    Still("opencv_aruco/chocclusion_original.jpg", "DICT_6X6_250", (*range(11), 12, 15)),
    Still("opencv_aruco/gboriginal.jpg", _TUTORIAL_DICTIONARY, tuple(range(35))),
    Still("opencv_aruco/diamondmarkers.jpg", _TUTORIAL_DICTIONARY, (2, 3, 4, 10, 10, 10, 11, 11, 11, 12, 12, 12)),
    Still("ubiquity/403.jpg", "DICT_5X5_1000", (403,)),
    Still("ubiquity/tag_01_d7_14cm.png", "DICT_5X5_1000", (1,)),
    Still("ubiquity/aruco_images.bag", "DICT_5X5_1000", (100, 103, 106, 107, 110, 111, 112)),
    Still("dt_apriltags/test_image.png", "DICT_APRILTAG_36h11", (60, 82, 318, 328, 387)),
    Still("dt_apriltags/test_image_multiple_01.png", "DICT_APRILTAG_36h11", (22, 24, 58, 85, 144, 198)),
    Still("dt_apriltags/test_image_rotation_-30.png", "DICT_APRILTAG_36h11", (76,)),
    Still("dt_apriltags/test_image_rotation_0.png", "DICT_APRILTAG_36h11", (76,)),
    Still("dt_apriltags/test_image_rotation_30.png", "DICT_APRILTAG_36h11", (76,)),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Missed and false ids of one photograph."""

    still: Still
    missed: tuple[int, ...]
    false: tuple[int, ...]  # found, but not listed


def outcomes(folder: Path) -> Iterator[Outcome]:
    """Detect in each photograph below the folder marker_images."""
    for still in STILLS:
        found = Counter(s.landmark_id for s in _detector(still, folder).detect(_image(folder / still.file)).sightings)
        listed = Counter(still.ids)
        yield Outcome(still, tuple((listed - found).elements()), tuple((found - listed).elements()))


def _detector(still: Still, folder: Path) -> MarkerDetector:
    own_file = Path(still.dictionary).suffix != ""
    return MarkerDetector(str(folder / still.dictionary) if own_file else still.dictionary, MarkersConfig())


def measure(quick: bool) -> Iterator[Row]:
    """The row, after the table of photographs."""
    folder = DATA / "marker_images"
    yield from _tracking(folder, quick)
    if not folder.is_dir():
        yield from not_run([_ID], f"{folder} is absent; set FGLOC_REAL_DATA")
        return
    missed = 0
    for outcome in outcomes(folder):
        missed += len(outcome.missed)
        said = f"{len(outcome.still.ids):3d} listed, missed {list(outcome.missed)}, not listed {list(outcome.false)}"
        print(f"{outcome.still.file:45s} {said}")
    yield Row(_ID, float(missed), n=sum(len(s.ids) for s in STILLS), unit="ids")


def _sequences(folder: Path, quick: bool) -> Iterator[tuple[MarkerDetector, list[tuple[int, GrayImage]]]]:
    """Detector, and stamps with images of a camera: of the bundled samples, and of the photographs."""
    samples = sorted(path.parent for path in SAMPLES.glob("*/robot.yaml"))
    for sample in samples[:1] if quick else samples:
        config = load_config(sample / "robot.yaml")
        with open_recording(sample / "bag", config.recording) as recording:
            images = [(e.stamp_ns, decode(e)) for e in recording.events() if isinstance(e, ImageEvent)]
        yield MarkerDetector(load_map(sample / "map.yaml").dictionary, config.markers), images
    for still in STILLS if folder.is_dir() else ():
        image = decode(_image(folder / still.file))
        yield _detector(still, folder), [(k * _SHOWN_EVERY_NS, image) for k in range(_SHOWN)]


def _tracking(folder: Path, quick: bool) -> Iterator[Row]:
    use_one_thread()
    seconds, search_s = np.zeros(2), np.zeros(2)
    lost = gained = images = 0
    differences: list[FloatArray] = []
    for detector, sequence in _sequences(folder, quick):
        followed = TrackingDetector(detector)
        for stamp_ns, image in sequence:
            with _timed(seconds, search_s, 0):
                whole = detector.find(image)
            with _timed(seconds, search_s, 1):
                tracked = followed.find(image, stamp_ns)
            a, b = (Counter(i for i, _ in found) for found in (whole, tracked))
            lost, gained, images = lost + (a - b).total(), gained + (b - a).total(), images + 1
            same = dict(tracked)
            differences += [c - same[i] for i, c in whole if a[i] == b[i] == 1]
    rms = float(np.sqrt(np.mean(np.square(differences))))
    yield Row("detect.over_full", float(seconds[0] / seconds[1]), n=images)
    yield Row("detect.search_over_full", float(search_s[0] / search_s[1]), n=images)
    yield Row("detect.lost", float(lost), n=len(differences) + lost, unit="markers")
    yield Row("detect.gained", float(gained), n=len(differences) + lost, unit="markers")
    yield Row("detect.corner_rms_px", rms, n=len(differences), unit="px")


@contextmanager
def _timed(seconds: FloatArray, search_s: FloatArray, which: int) -> Iterator[None]:
    """Add the processor time of a search, and the same without the fit of edges."""
    edges_s = 0.0

    def timed(*arguments: Any) -> FloatArray:
        nonlocal edges_s
        start = time.thread_time()
        found = refine_all(*arguments)
        edges_s += time.thread_time() - start
        return found

    with (
        patch("fgloc.sensors.markers.detector.refine_all", timed),
        patch("fgloc.sensors.markers.edges.refine_all", timed),
    ):
        start = time.thread_time()
        yield
        taken = time.thread_time() - start
    seconds[which] += taken
    search_s[which] += taken - edges_s


def _image(path: Path) -> ImageEvent:
    """The photograph as the message of a camera."""
    data, encoding = path.read_bytes(), path.suffix[1:]
    if path.suffix == ".bag":
        with AnyReader([path]) as bag:
            wanted = [c for c in bag.connections if c.msgtype == "sensor_msgs/msg/CompressedImage"]
            connection, _, raw = next(bag.messages(wanted))
            message = bag.deserialize(raw, connection.msgtype)
        data, encoding = message.data.tobytes(), message.format
    return ImageEvent(1, 1, path.name, "", encoding, True, 0, 0, 0, False, np.frombuffer(data, dtype=np.uint8))


if __name__ == "__main__":
    main(measure, __doc__ or "")
