"""Constants put together by eye: their rivals, and what they may be off by."""

import math

import numpy as np
import pytest

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.graph.contradictions import SENSIBLE, by_eye, smoothed_within_priors
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import Installation
from fgloc.graph.measurement_log import Keyframe, MeasurementLog, PoseWithCovariance
from fgloc.sensors.measurements import PointMeasurement
from fgloc.types import Landmark, LandmarkMap, MotionMeasurement


@pytest.mark.parametrize(
    ("name", "sensible", "not_sensible"),
    [
        ("sightings.x_m", 0.2, 0.5),
        ("camera.rx_rad", 0.2, 0.5),
        ("camera.cx_px", 100.0, 200.0),
        ("gyro.scale", 0.3, 0.6),
    ],
)
def test_what_was_put_together_by_eye_is_off_by_so_much_and_not_more(name, sensible, not_sensible):
    assert sensible < SENSIBLE * by_eye(name) < not_sensible


def test_six_constants_give_way_at_most():
    """Each of eight is that of every eighth motion, half as long as it is said to be: sightings contradict all."""
    names = [f"learned.{i}_m" for i in range(8)]
    places = {i: np.array([4.0 * (i % 2), 3.0 * (i // 2) - 3.0, 0.0]) for i in range(4)}
    factors = LandmarkFactors(
        LandmarkMap({i: Landmark(i, place, np.eye(3), 0.0) for i, place in places.items()}),
        Installation(dict.fromkeys(names, 0.02)),
    )
    log, pose, said = MeasurementLog(10.0, keep_all=True), np.zeros(3), np.array([0.1, 0.0, 0.05])
    for k in range(33):
        motions, prior = (), PoseWithCovariance(pose, np.eye(3) * 1e-6)
        if k:
            by = {names[k % 8]: (said, 0.0)}
            motions, prior = (MotionMeasurement("learned", k - 1, k, said, np.eye(3) * 1e-6, by),), None
            pose = se2.compose(pose, se2.exp(0.5 * se2.log(said)))
        seen = []
        for i, place in places.items():
            x, y, _ = se2.between(pose, np.array([*place[:2], 0.0]))
            seen.append(PointMeasurement(k, i, math.hypot(x, y), math.atan2(y, x), np.eye(2) * 1e-6))
        held = tuple(factors.sighting(k, m, None) for m in seen)
        belief = PoseWithCovariance(pose, np.eye(3))
        log.append(Keyframe(k, k * 10**8, 0.1 * k, belief, prior, motions, held))
    _, contradiction = smoothed_within_priors(log, factors, BatchConfig(), 0.9999)
    assert len(contradiction.names) == 6
    assert contradiction.asked.mean == pytest.approx(-0.5, abs=0.1)
