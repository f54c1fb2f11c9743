"""The textbook's smoother: what it takes motions to be wrong by."""

import numpy as np
import pytest

from fgloc.graph.textbook import Seen, textbook_poses

PLACES = {1: np.array([2.0, 0.0]), 2: np.array([0.0, 2.0]), 3: np.array([-2.0, -1.0])}


@pytest.mark.parametrize(("forward", "least", "most"), [(0.0, 0.02, 0.05), (0.1, 0.08, 0.15)])
def test_a_robot_of_which_nothing_is_seen_is_as_unsure_as_its_way_is_long(forward, least, most):
    """Seen at the first of 100 poses; the way to the others is odometry alone. One that stands stays nearly there."""
    motions = np.tile([forward, 0.0, 0.0], (99, 1))
    start = np.column_stack([forward * np.arange(100), np.zeros(100), np.zeros(100)])
    first = Seen(np.zeros(3, dtype=np.int64), np.array(list(PLACES)), np.array(list(PLACES.values())), np.full(3, 0.01))
    poses, covs = textbook_poses(start, motions, first, PLACES)
    assert poses == pytest.approx(start, abs=1e-6)
    assert np.sqrt(covs[0][0, 0]) < 0.02
    assert least < np.sqrt(covs[-1][0, 0]) < most
