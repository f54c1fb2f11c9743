"""Commands to a run that goes on: search, reset, load, another map."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from live_feed import errors, feed, live_in
from robot_world import START_NS, World, room

from fgloc import se2
from fgloc.errors import EstimatorError, FglocError
from fgloc.types import LandmarkMap, Mode

HALF_S = 6.0


@pytest.fixture(scope="module")
def world():
    return World(room(), seed=4, seconds=12.0)


def halves(world):
    events = list(world.events())
    cut = next(k for k, e in enumerate(events) if (e.received_ns - START_NS) * 1e-9 >= HALF_S)
    return events[:cut], events[cut:]


@pytest.fixture(params=[False, True], ids=["threads", "process"])
def driven(request, world):
    """A run that has seen half of the drive, and the rest."""
    first, rest = halves(world)
    with live_in(world, process=request.param) as live:
        feed(live, first)
        yield live, rest


def test_search_forgets_the_pose_and_finds_it_again(driven, world):
    live, rest = driven
    live.search()
    assert live.status().mode is None
    assert live.pose_at() is None
    estimates = feed(live, rest)
    assert any(re.search(rf"^Resumed\b.*\b{Mode.LOST}\b", note) for note in live.status().notes)
    assert estimates[-1].mode is Mode.OK
    assert errors(world, estimates)[-1] < 0.05


def test_reset_begins_as_a_new_run_does(world, tmp_path):
    first, rest = halves(world)
    with live_in(world) as live:
        feed(live, first)
        live.save(tmp_path / "before.json")
        live.reset()
        assert not live.save(tmp_path / "after.json")  # nothing is known
        again = feed(live, rest)
    with live_in(world) as fresh:
        expected = feed(fresh, rest)
    assert len(again) == pytest.approx(len(expected), abs=2)
    assert np.abs(again[-1].pose - expected[-1].pose).max() < 2e-3


def test_load_goes_on_from_the_saved_pose(driven, world, tmp_path):
    live, rest = driven
    saved = tmp_path / "state.json"
    assert live.save(saved)
    live.reset()
    live.load(saved)
    estimates = feed(live, rest)
    assert estimates[0].mode is Mode.OK
    assert errors(world, estimates).max() < 0.1


@pytest.mark.parametrize("damage", [None, b"", b"\xff{", "map"])
def test_a_state_that_cannot_be_used_leaves_the_run_as_it_was(world, tmp_path, damage):
    first, rest = halves(world)
    saved = tmp_path / "state.json"
    with live_in(world) as live:
        feed(live, first)
        assert live.save(saved)
        if damage == "map":
            text = saved.read_text()
            content = json.loads(text)
            assert content["state"]
            other = LandmarkMap({k: m for k, m in world.map.landmarks.items() if k % 2}, world.map.dictionary)
            live.use_map(other)
        elif damage is None:
            saved.unlink()
        else:
            saved.write_bytes(damage)
        before = live.status().mode
        with pytest.raises(EstimatorError):
            live.load(saved)
        assert live.status().mode is before
        assert feed(live, rest)[-1].mode is Mode.OK


def test_another_map_moves_the_robot_with_it(driven, world):
    live, rest = driven
    moved = (0.3, -0.2, 0.1)
    c, s = np.cos(moved[2]), np.sin(moved[2])
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    elsewhere = {
        k: replace(m, position=rotation @ m.position + [*moved[:2], 0.0], rotation=rotation @ m.rotation)
        for k, m in world.map.landmarks.items()
    }
    live.use_map(LandmarkMap(elsewhere, world.map.dictionary))
    last = feed(live, rest)[-1]
    expected = se2.compose(np.array(moved), world.truth(last.stamp_ns))
    assert last.mode is Mode.OK
    assert np.hypot(*(last.pose - expected)[:2]) < 0.05


def test_commands_before_the_run_begins(world, tmp_path):
    with live_in(world) as live:
        live.search()
        live.reset()
        with pytest.raises(FglocError):
            live.load(tmp_path / "none.json")
        assert errors(world, feed(live, world.events()))[-1] < 0.05
