"""The log of measurements: what is added to smoothed covariances."""

import numpy as np

from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import InstallationEstimate
from fgloc.graph.measurement_log import Keyframe, MeasurementLog, PoseWithCovariance
from fgloc.sensors.measurements import PointMeasurement
from fgloc.types import Landmark, LandmarkMap

POINT = PointMeasurement(0, 1, 2.0, 0.1, np.eye(2) * 1e-4)
SEEN = (LandmarkFactors(LandmarkMap({1: Landmark(1, np.ones(3), np.eye(3), 0.0)})).sighting(0, POINT, None),)


def test_that_a_robot_was_carried_counts_in_a_batch_until_a_fix_of_its_segment_agrees():
    log, belief = MeasurementLog(10.0, keep_all=True), PoseWithCovariance(np.zeros(3), np.eye(3))
    for k, seen in enumerate([SEEN, (), SEEN, (), (), SEEN, ()]):
        starts = belief if k in (0, 5) else None  # found elsewhere at 5
        frame = Keyframe(
            k, k, 0.1 * k, belief, starts, sightings=seen, added_cov=np.eye(3), carried_cov=2.0 * np.eye(3)
        )
        log.append(frame)
    assert [cov[0, 0] for cov in log.added_covs()] == [1.0, 1.0, 1.0, 3.0, 3.0, 1.0, 3.0]


def test_of_all_that_is_kept_the_window_alone_keeps_what_was_known_of_the_installation():
    log, known = MeasurementLog(0.25, keep_all=True), InstallationEstimate(np.zeros(2), np.eye(2))
    for k in range(6):
        belief = PoseWithCovariance(np.full(3, k), np.eye(3), np.zeros((3, 2)), known)
        log.append(Keyframe(k, k, 0.1 * k, belief))
    assert [frame.belief.pose[0] for frame in log.keyframes.values()] == [0, 1, 2, 3, 4, 5]
    assert [frame.belief.installation is known for frame in log.keyframes.values()] == [False] * 3 + [True] * 3
    assert [frame.belief.cross is None for frame in log.keyframes.values()] == [True] * 3 + [False] * 3
