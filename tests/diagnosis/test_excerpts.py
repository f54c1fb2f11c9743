"""Excerpts of a recording: some of its images, with wheels and gyro about them."""

from __future__ import annotations

import numpy as np
import pytest
from event_makers import corners, odometry
from robot_world import START_NS, World, room
from world_bags import write_world

from fgloc.config import Config, config_of
from fgloc.diagnosis.setup_fit import Excerpt, ExcerptCollector, wheel_increments
from fgloc.diagnosis.signals import Signals
from fgloc.recording.reader import open_recording


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("room"), World(room(), seconds=1.0))


@pytest.mark.parametrize(
    ("times", "taken", "is_enough"),
    [
        ((110.0,), 1, False),  # markers that come into view late
        ((125.0,), 0, True),
        ((0.0, 51.5, 53.0), 2, False),  # of the last stretch; between stretches
        ((0.0, 56.0), 1, True),
    ],
)
def test_images_are_waited_for_and_looked_at_for_a_bounded_time(bag, times, taken, is_enough):
    config = Config()
    with open_recording(bag, config.recording) as recording:
        collector = ExcerptCollector(recording, config, None)
        for t in times:
            collector.add(corners(START_NS * 1e-9 + t, 1, 2))
    assert sum(map(len, collector.found.pictures)) == taken
    assert collector.pictured == is_enough


def test_wheel_messages_that_were_received_in_another_order_give_the_same_motion():
    t = np.arange(0.0, 4.0, 0.05)
    events = [odometry(s, twist=(0.3 + 0.1 * np.sin(3.0 * s), 0.4 * np.cos(s))) for s in t]
    mixed = [events[k] for k in np.random.default_rng(2).permutation(len(events))]
    grid, config = np.arange(1_000_000_000, 3_000_000_000, 20_000_000), config_of({"wheels": {"source": "twist"}})
    as_sent, as_received = (wheel_increments(Excerpt(Signals(motion=m)), config, grid) for m in (events, mixed))
    assert as_sent[:, 0].sum() == pytest.approx(0.3 * 2.0, rel=0.2)
    np.testing.assert_allclose(as_received, as_sent, atol=1e-12)
