"""The extended Kalman filter: the smoother's peer on the same measurements, behind the same interface."""

from dataclasses import replace

import numpy as np
import pytest
from robot_world import START_NS, Chain, World, beacons, config, nees, position_error, room
from scipy.stats import chi2

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.errors import ConfigError
from fgloc.graph.batch import BatchSmoother
from fgloc.sensors.markers.images import CornersEvent
from fgloc.sensors.range_bearing import RangeBearingEvent

MAPS = {"corners": room, "beacons": beacons}
GAUSSIAN = {"cauchy_k": 1000.0}


def follow(estimator, world_map, events, keep_all=False, **sections):
    chain = Chain(config(estimator={"kind": estimator}, **sections), world_map, keep_all=keep_all)
    return chain, chain.run(events)


@pytest.mark.parametrize("kind", MAPS)
def test_agrees_with_the_fixed_lag_smoother_within_its_sigmas(kind):
    world_map = MAPS[kind]()
    events = list(World(world_map, seed=1, seconds=12.0).events())
    kernels = {"markers": GAUSSIAN, "landmarks": GAUSSIAN}  # the filter has none
    (_, smooth), (_, ekf) = (follow(name, world_map, events, **kernels) for name in ("fixed_lag", "ekf"))
    assert [e.stamp_ns for e in ekf] == [e.stamp_ns for e in smooth]
    for a, b in zip(ekf, smooth, strict=True):
        apart = se2.log(se2.between(b.pose, a.pose))
        cov = se2.rotate_cov(b.cov, -float(b.pose[2]))
        assert apart @ np.linalg.solve(cov, apart) < 0.3
    assert np.diag(ekf[-1].cov) == pytest.approx(np.diag(smooth[-1].cov), rel=0.05)


def test_nees_is_within_its_chi2_bounds_over_seeds():
    last = []
    for seed in range(20):
        world_map = beacons()
        world = World(world_map, seed=seed, seconds=6.0)
        _, estimates = follow("ekf", world_map, world.events())
        last.append(nees(estimates[-1], world.truth(estimates[-1].stamp_ns)))
    low, high = chi2.ppf([0.001, 0.999], 3 * len(last))
    assert low < sum(last) < high


@pytest.mark.parametrize("kind", MAPS)
def test_wrong_sightings_do_not_pass_the_gates(kind):
    world_map = MAPS[kind]()
    world = World(world_map, seed=2, seconds=8.0)

    def misread(event):
        late = event.stamp_ns - START_NS > 4 * 10**9
        if late and isinstance(event, RangeBearingEvent):
            first, *rest = event.sightings
            return replace(event, sightings=(replace(first, range_m=first.range_m + 2.0), *rest))
        if late and isinstance(event, CornersEvent) and event.sightings:
            first, *rest = event.sightings
            return replace(event, sightings=(replace(first, corners_px=first.corners_px + 60.0), *rest))
        return event

    chain, estimates = follow("ekf", world_map, (misread(e) for e in world.events()))
    assert chain.localizer.rejections["sightings.gate"] > 10
    assert max(position_error(e, world.truth(e.stamp_ns)) for e in estimates) < 0.2


def test_batch_smooths_its_log_to_the_same_result():
    world_map = beacons()
    events = list(World(world_map, seed=3, seconds=6.0).events())
    results = []
    for name in ("fixed_lag", "ekf"):
        chain, _ = follow(name, world_map, events, keep_all=True)
        localizer = chain.localizer
        results.append(BatchSmoother(localizer.estimator.log, localizer.factors, BatchConfig(), 0.9999).result())
    assert results[1].poses == pytest.approx(results[0].poses, abs=1e-3)


def test_an_unknown_map_is_refused():
    with pytest.raises(ConfigError, match=r"estimator\.kind\b.*\bekf\b.*--map"):
        Chain(config(estimator={"kind": "ekf"}), None)
