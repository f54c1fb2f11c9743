"""Markers of another size than the map gives are named; those that hang elsewhere are not taken for them."""

import numpy as np
import pytest

from fgloc.diagnosis.marker_sizes import marker_sizes

SIZES = {1: 0.2, 2: 0.2, 3: 0.2, 4: 0.15}


def named(factors, moved=(), way=2.0):
    """Findings of a robot that drives towards and past four markers; some are of another size, or moved."""
    rng = np.random.default_rng(3)
    places = {1: (4.0, 1.0), 2: (4.0, -1.5), 3: (3.5, 0.3), 4: (5.0, 2.0)}
    ids, seen, expected = [], [], []
    for x in np.linspace(0.0, way, 30):
        for i, place in places.items():
            by_map = np.array(place) - [x, 0.0]
            hangs = by_map + (np.array([0.0, 0.8]) if i in moved else 0.0)
            ids.append(i)
            expected.append(by_map)
            seen.append(hangs / factors.get(i, 1.0) * (1.0 + rng.normal(0.0, 0.01)) + rng.normal(0.0, 0.005, 2))
    return marker_sizes(np.array(ids), np.array(seen), np.array(expected), SIZES)


def test_markers_of_another_size_are_named_together_with_it():
    one, two = named({1: 0.5, 3: 0.5, 4: 2.0})
    assert (one.code, one.value) == ("map.sizes", pytest.approx(0.5, rel=0.02))
    assert "1, 3" in one.text
    assert "0.1 m" in one.text
    assert two.value == pytest.approx(2.0, rel=0.02)
    assert "0.3 m" in two.text


def test_markers_that_hang_elsewhere_or_are_seen_from_one_distance_alone_are_not_of_another_size():
    assert not named({})
    assert not named({}, moved=(1, 2, 3, 4))
    assert not named({1: 0.5}, way=0.2)


def test_a_sighting_at_the_camera_is_one_of_many():
    rng = np.random.default_rng(1)
    expected = np.column_stack([np.linspace(1.0, 3.0, 20), rng.normal(0.0, 0.01, 20)])
    seen = np.where(np.arange(20)[:, None] == 7, 0.0, 2.0 * expected)
    (found,) = marker_sizes(np.ones(20, dtype=np.int64), seen, expected, SIZES)
    assert found.value == pytest.approx(0.5, rel=0.02)
