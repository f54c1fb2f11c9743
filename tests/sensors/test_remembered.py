"""Remembered detections are those that would be found, and a broken file costs time, not results."""

from dataclasses import replace

import numpy as np
import pytest
from event_makers import image
from marker_scenes import forward_camera, render, standing

from fgloc.ablation.jobs import execute, make_jobs, read_record
from fgloc.ablation.suite import Suite, expand
from fgloc.config import MarkersConfig
from fgloc.sensors.markers.detector import MarkerDetector, RememberedDetections
from fgloc.sensors.markers.images import ImageError
from fgloc_datasets import SAMPLE

DICTIONARY = "DICT_4X4_50"


class Counted(MarkerDetector):
    """A detector that counts how often it is asked."""

    def __init__(self):
        super().__init__(DICTIONARY, MarkersConfig())
        self.asked = 0

    def detect(self, event):
        """The markers of one image."""
        self.asked += 1
        return super().detect(event)


def pictures():
    """Images with two markers, with one, and with none."""
    camera = forward_camera(width=160, height=120, focal=130.0)
    markers = [standing(i, (1.2, y, 0.25), np.pi, 0.2) for i, y in ((5, 0.2), (8, -0.2))]
    for k, shown in enumerate((markers, markers[:1], [])):
        pixels = render(camera, (0.0, 0.0, 0.0), shown, DICTIONARY)
        yield image(0.1 * k, pixels.tobytes(), compressed=False, width=160, height=120, step=160)


def same(a, b):
    return (a.stamp_ns, a.received_ns, a.topic, a.frame_id) == (b.stamp_ns, b.received_ns, b.topic, b.frame_id) and all(
        s.landmark_id == t.landmark_id and np.array_equal(s.corners_px, t.corners_px)
        for s, t in zip(a.sightings, b.sightings, strict=True)
    )


def test_second_run_asks_nothing_and_gets_the_same(tmp_path):
    plain, first, second = Counted(), Counted(), Counted()
    one = RememberedDetections(tmp_path / "x.npz", first)
    for event in pictures():
        one.detect(event)
    one.save()
    two = RememberedDetections(tmp_path / "x.npz", second)
    for event in pictures():
        moved = replace(event, stamp_ns=event.stamp_ns + 5, received_ns=event.received_ns + 7, topic="/other")
        assert same(two.detect(moved), plain.detect(moved))
    assert [len(two.detect(e).sightings) for e in pictures()] == [2, 1, 0]
    assert (first.asked, second.asked) == (3, 0)


def test_other_pixels_are_another_image(tmp_path):
    detector = Counted()
    memory = RememberedDetections(tmp_path / "x.npz", detector)
    event = next(pictures())
    changed = event.data.copy()
    changed[0] ^= 1
    memory.detect(event)
    memory.detect(replace(event, data=changed))
    assert detector.asked == 2


def test_runs_side_by_side_add_to_one_file(tmp_path):
    events = list(pictures())
    a, b = (RememberedDetections(tmp_path / "x.npz", Counted()) for _ in range(2))
    a.detect(events[0])
    b.detect(events[1])
    a.save()
    b.save()
    detector = Counted()
    both = RememberedDetections(tmp_path / "x.npz", detector)
    for event in events[:2]:
        both.detect(event)
    assert detector.asked == 0


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 half a file", b"something else"])
def test_a_broken_file_is_made_anew(tmp_path, content):
    (tmp_path / "x.npz").write_bytes(content)
    for asked in (3, 0):
        detector = Counted()
        memory = RememberedDetections(tmp_path / "x.npz", detector)
        for event in pictures():
            memory.detect(event)
        memory.save()
        assert detector.asked == asked


def test_what_cannot_be_decoded_is_refused_every_time(tmp_path):
    memory = RememberedDetections(tmp_path / "x.npz", Counted())
    for _ in range(2):
        with pytest.raises(ImageError):
            memory.detect(image(0.0, b"\xff\xd8 no image"))
    memory.save()
    assert not (tmp_path / "x.npz").exists()


def test_runs_of_a_sweep_share_detections_unless_pixels_differ(tmp_path):
    """The second run of the same images is told what the first has found, and ends alike."""
    cut = {"kind": "truncated", "keep": 0.1}
    failures = [
        {"name": "short", "chain": [cut]},
        {"name": "deaf", "chain": [cut, {"kind": "dropout", "sensor": "command"}]},
        {"name": "dark", "chain": [cut, {"kind": "darkness", "gain": 0.5}]},
    ]
    suite = Suite.model_validate(
        {"title": "", "recordings": [{"name": "first", "bag": str(SAMPLE)}], "failures": failures}
    )
    jobs = {job.cell.failure: job for job in make_jobs(expand(suite, tmp_path))}
    assert jobs["short"].images == jobs["deaf"].images == jobs["none"].images != jobs["dark"].images
    for name in ("short", "deaf", "dark"):
        execute(jobs[name], tmp_path)
    assert {f.stem for f in (tmp_path / "detections").iterdir()} == {jobs["short"].images, jobs["dark"].images}
    execute(jobs["deaf"], tmp_path / "apart")
    together, apart = (read_record(folder, jobs["deaf"].key) for folder in (tmp_path, tmp_path / "apart"))
    assert together.outcome == "done"
    assert together.model_dump(exclude={"cost"}) == apart.model_dump(exclude={"cost"})
