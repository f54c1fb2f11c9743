"""A robot that is pushed over the floor: its wheels do not tell, and it was not carried elsewhere in no time."""

from __future__ import annotations

import numpy as np
import pytest
from robot_world import Chain, World, beacons, config, position_error, room, truth_at

from fgloc import se2
from fgloc.types import Estimate

_PUSHED_S = (6.0, 10.0)


class Pushed(World):
    """A world whose robot drifts away from where its wheels carry it, for four seconds."""

    drift = np.zeros(3)  # m/s, m/s, rad/s

    def truth(self, stamp_ns: int) -> np.ndarray:
        t = (stamp_ns - self.start_ns) * 1e-9
        pushed_s = min(max(t - _PUSHED_S[0], 0.0), _PUSHED_S[1] - _PUSHED_S[0])
        return se2.compose(self.drift * pushed_s, truth_at(t))


def landmarks_in(estimate: Estimate) -> int:
    """How many were seen; one alone may have been moved."""
    return len({d.landmark_id for d in estimate.decisions if d.kind in ("corners", "range_bearing")})


@pytest.mark.parametrize("drift", [(0.3, 0.1, 0.2), (0.8, 0.3, 0.5)])
@pytest.mark.parametrize("landmarks", [lambda: beacons(4), room], ids=["beacons", "markers"])
def test_a_robot_that_was_pushed_is_found_again(landmarks, drift):
    world = Pushed(landmarks(), seed=0, seconds=22.0)
    world.drift = np.array(drift)
    estimates = Chain(config(), world.map).run(world.events())
    late = [e for e in estimates if e.stamp_ns - world.start_ns > 13e9 and landmarks_in(e) > 1]
    assert len(late) > 10
    wrong = [e for e in late if position_error(e, world.truth(e.stamp_ns)) > 0.3]
    assert len(wrong) <= 0.05 * len(late)
