"""A camera that is knocked in the run: its mounting is found again, and the covariance stays right meanwhile."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from robot_world import SIGMA_PX, START_NS, Chain, World, config, position_error, room
from world_bags import write_world

from fgloc import se2
from fgloc.config import config_of
from fgloc.evaluation.judgements import judgements
from fgloc.evaluation.metrics import match_result
from fgloc.runner import RunResult, run
from fgloc.types import ControlEvent, Severity

SETTINGS = {"wheels": {"source": "twist"}, "markers": {"sigma_px": SIGMA_PX}}
KNOCK_S, SECONDS = 20.0, 60.0
LEVEL, TILTED = (0.0, 0.0, 0.06), (0.03, -0.07, 0.01)  # rad: roll, pitch, yaw of the camera since then


@dataclass
class Knocked(World):
    """From ``knock_s`` on the camera looks elsewhere, and from ``again_s`` on straight ahead."""

    turned: tuple[float, float, float] = LEVEL
    knock_s: float = KNOCK_S
    again_s: float = math.inf

    def _view(self, stamp: int):
        pose = self.truth(stamp)
        if not self.knock_s <= (stamp - START_NS) * 1e-9 < self.again_s:
            return pose, (0.0, 0.0)
        return se2.compose(pose, (0.0, 0.0, self.turned[2])), self.turned[:2]


def recorded(folder: Path, turned: tuple[float, float, float]) -> Path:
    """Bag of a circle with a gyro."""
    world = Knocked(room(), seed=8, seconds=SECONDS, rate=5, late_s=0.04, turned=turned)
    return write_world(folder, world, leave_out=(ControlEvent,), gyro_sigma=0.004)


@pytest.fixture(scope="module", params=[LEVEL, TILTED], ids=["level", "tilted"])
def knocked(request, tmp_path_factory) -> Path:
    return recorded(tmp_path_factory.mktemp("knocked"), request.param)


def settled(result: RunResult) -> tuple[float, float]:
    """Largest error of the last 20 s [mm], and mean NEES/3."""
    matched = match_result(result, result.config)
    late = matched.stamps_ns > START_NS + (SECONDS - 20.0) * 1e9
    off = np.array([se2.between(t, e) for t, e in zip(matched.truth[late], matched.estimate[late], strict=True)])
    covs = [se2.rotate_cov(c, -float(e[2])) for c, e in zip(matched.covs[late], matched.estimate[late], strict=True)]
    nees = [float(d @ np.linalg.solve(cov, d)) / 3.0 for d, cov in zip(off, covs, strict=True)]
    return 1e3 * float(np.hypot(off[:, 0], off[:, 1]).max()), float(np.mean(nees))


@pytest.mark.parametrize("mode", ["online", "batch"])
def test_fault_72_a_knocked_camera_is_named_and_its_mounting_found_again(knocked, mode):
    result = run(knocked, knocked.parent / "map.yaml", config_of(SETTINGS), mode, check=False)
    found = [j for j in judgements(result) if j.kind == "mounting_changed"]
    assert [j.subject for j in found] == ["camera"]
    assert KNOCK_S <= found[0].from_s < KNOCK_S + 15.0
    assert any(f.severity is Severity.WARNING and "knocked" in f.text for f in result.findings)
    worst_mm, nees = settled(result)
    assert worst_mm < 60.0
    assert nees < 5.0


def test_a_camera_that_is_knocked_twice_is_another_one_since_the_first_time():
    """In a run of markers alone, at 10 images a second: each time it is found again within some of them."""
    world = Knocked(room(), seed=8, seconds=16.0, knock_s=5.0, again_s=10.0, turned=(0.05, -0.1, 0.1))
    chain = Chain(config(), room())
    estimates = chain.run(world.events())
    (change,) = chain.localizer.estimator.log.remounted
    assert 5.0 <= (change.stamp_ns - START_NS) * 1e-9 < 6.0
    assert [n for n in chain.localizer.notes if "knocked" in n]
    assert position_error(estimates[-1], world.truth(estimates[-1].stamp_ns)) < 0.05


def test_a_camera_that_stays_where_it_is_was_not_knocked(tmp_path):
    bag = recorded(tmp_path, (0.0, 0.0, 0.0))
    result = run(bag, tmp_path / "map.yaml", config_of(SETTINGS), "online", check=False)
    assert not [d for d in result.decisions if d.reason == "mounting_changed"]
    assert settled(result)[1] < 3.0


def test_one_graph_of_all_poses_has_one_mounting(knocked):
    settings = config_of(SETTINGS | {"estimator": {"kind": "isam2"}})
    result = run(knocked, knocked.parent / "map.yaml", settings, "online", check=False)
    assert not [d for d in result.decisions if d.reason == "mounting_changed"]
