"""The estimate that is reported of each keyframe: its mode, its covariance, and the rows of ``steps.csv``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.graph.ground import spatial
from fgloc.graph.measurement_log import Keyframe
from fgloc.relocalization.tracking_state import Tracking
from fgloc.robust.decision_log import mode_decisions, segment_decision
from fgloc.robust.motion_judge import MotionJudge
from fgloc.robust.sensor_measurements import kind_of
from fgloc.robust.sighting_judge import SightingJudge
from fgloc.sensors.equipment import MotionCompensation
from fgloc.types import Decision, Estimate, FloatArray, Ground, Mode, Step


class Recorder:
    """Adds to the graph's covariance what the graph does not know: clock, kidnapping, the whole map where lost.

    Attributes:
        counts: factors added, by kind.
        rejections: what was not used, by reason, beside what the judges rejected.
    """

    def __init__(
        self,
        config: Config,
        tracking: Tracking,
        motion: MotionJudge,
        sightings: SightingJudge,
        compensation: MotionCompensation,
    ) -> None:
        """Take the parts that know it."""
        self.counts: Counter[str] = Counter()
        self.rejections: Counter[str] = Counter()
        self._clock_sigma_s = config.recording.clock_sigma_s
        self._dead_reckoning_after_s = config.estimator.dead_reckoning_after_s
        self._tracking, self._motion, self._sightings, self._compensation = tracking, motion, sightings, compensation
        self._installation = tracking.installation
        self._last_ground: FloatArray | None = None
        self._clock_jumps: list[Decision] = []  # not yet reported with an estimate

    def count(self, frame: Keyframe) -> None:
        """Count the factors of a new keyframe."""
        self.counts.update(() if frame.prior is None else ("prior",))
        self.counts.update(m.source for m in frame.motions)
        self.counts.update(kind_of(s.measurement) for s in frame.sightings)

    def clock_jumped(self, k: int, step: Step) -> None:
        """Note a new segment, to be reported with its first estimate."""
        self._clock_jumps.append(segment_decision(k, step.start_ns))

    def record(self, step: Step, frame: Keyframe, decisions: Sequence[Decision]) -> Estimate:
        """The estimate of the newest keyframe; its mode and added covariance are kept in the log for the smoother."""
        tracking, belief = self._tracking, frame.belief
        frame.step, frame.mode = step, tracking.mode
        if self._motion.is_carried and frame.mode is Mode.OK and tracking.since_fix_s > 0.0:
            frame.mode = Mode.DEAD_RECKONING
        twist = self._compensation.twist(step, step.stamp_ns)
        by_clock = np.asarray(np.outer(twist, twist) * self._clock_sigma_s**2)
        frame.added_cov = by_clock + tracking.kidnapped_cov(self._sightings.contradicting, belief)
        if frame.mode is Mode.LOST:
            frame.added_cov = frame.added_cov + tracking.lost_cov(belief)
        modes = mode_decisions(frame.k, step.stamp_ns, frame.mode, tracking.since_fix_s, self._dead_reckoning_after_s)
        before, self._clock_jumps = [*self._clock_jumps, *self._motion.take_signs()], []
        cov = se2.rotate_cov(belief.cov + frame.added_cov, float(belief.pose[2]))
        ground = spatial(belief, self._installation, frame.added_cov)
        if ground is not None:
            frame.ground_clock_cov = self._ground_by_clock(step, ground)
            ground = replace(ground, cov=ground.cov + frame.ground_clock_cov)
        return Estimate(step.stamp_ns, belief.pose, cov, frame.mode, (*before, *decisions, *modes), ground)

    def _ground_by_clock(self, step: Step, ground: Ground) -> FloatArray:
        """Covariance ``(6, 6)`` of height, roll and pitch for a clock that is off, as `record` has it of x, y, yaw."""
        now, before = np.array([ground.z, ground.roll, ground.pitch]), self._last_ground
        self._last_ground = now
        rates: FloatArray = np.zeros(6)
        if before is not None and step.dt > 0.0:
            rates[2:5] = (now - before) / step.dt
        return np.asarray(np.outer(rates, rates) * self._clock_sigma_s**2)

    def unconfirmed(self, k: int, step: Step) -> Estimate | None:
        """The pose before the sightings are enough to begin the graph with; None: they hardly tell it."""
        belief = self._tracking.unconfirmed()
        if belief is None:
            return None
        cov = se2.rotate_cov(belief.cov, float(belief.pose[2]))
        rows = mode_decisions(k, step.stamp_ns, Mode.UNCONFIRMED, self._tracking.since_fix_s, np.nan)
        return Estimate(step.stamp_ns, belief.pose, cov, Mode.UNCONFIRMED, rows)

    def never_confirmed(self, estimates: Sequence[Estimate], frames: Sequence[Keyframe], mode: Mode) -> list[Estimate]:
        """Estimates of a segment whose first pose was never found, in the mode for it.

        Args:
            estimates: as recorded from the most probable place on.
            frames: their keyframes.
            mode: ``UNCONFIRMED``; or ``LOST``, with a covariance that allows for the whole map.
        """
        for frame in frames:
            if mode is Mode.LOST is not frame.mode:
                frame.added_cov = frame.added_cov + self._tracking.lost_cov(frame.belief)
            frame.mode = mode
        if mode is not Mode.LOST:
            return [replace(e, mode=mode) for e in estimates]
        covs = {f.stamp_ns: se2.rotate_cov(f.belief.cov + f.added_cov, float(f.belief.pose[2])) for f in frames}
        return [_with_cov(replace(e, mode=mode), covs.get(e.stamp_ns)) for e in estimates]


def _with_cov(estimate: Estimate, cov: FloatArray | None) -> Estimate:
    if cov is None:
        return estimate
    ground = estimate.ground
    return replace(estimate, cov=cov, ground=None if ground is None else ground.with_planar(cov))
