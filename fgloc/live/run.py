"""A live run without its threads: events in order of receipt go in, estimates come out, as `fgloc.runner` has it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly, assemble_stream
from fgloc.config import Config
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.anchors import Anchor, Anchors
from fgloc.live.facts import LiveFacts
from fgloc.live.resume import carried_over, odometry_state
from fgloc.live.state import (
    GyroState,
    InstallationState,
    RunState,
    fingerprint,
    installation_of_state,
    matrix3,
    row3,
)
from fgloc.types import (
    Estimate,
    Event,
    Finding,
    FloatArray,
    LandmarkMap,
    Mode,
    MotionEvent,
    Severity,
    SightingsEvent,
    Step,
    note,
    ordered,
)


class OnlineRun:
    """Gate, steps, localizer and diagnosis of a stream; single-threaded.

    The parts are built once the facts of the stream are known. When a sensor begins later they are built again, and
    the new ones go on from the state of the old.

    Attributes:
        facts: what has come in.
        parts: of the run; None before they are built.
        anchors: of its estimates; None before.
        newest: the last estimate.
        keyframes: steps so far.
        reordering_s: how far the last keyframe was behind the newest stamp when it was made.
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, facts: LiveFacts, resumed: RunState | None = None
    ) -> None:
        """Nothing has come in.

        Args:
            config: all settings.
            landmark_map: the known map; None: landmarks are estimated.
            facts: of the stream.
            resumed: what an earlier run saved.
        """
        self.facts = facts
        self.parts: Assembly | None = None
        self.anchors: Anchors | None = None
        self.newest: Estimate | None = None
        self.keyframes = 0
        self.reordering_s = 0.0
        self._config = config
        self._map = landmark_map
        self._fingerprint = fingerprint(landmark_map)
        self._resumed = resumed
        self._reset: PoseWithCovariance | None = None  # a pose that was given, for the next step
        self._last_step: Step | None = None
        self._odometry: MotionEvent | None = None  # the newest that gives a pose
        self._fastest = (0.0, 0.0)
        self._past_rejections: Counter[str] = Counter()
        self._notes: list[str] = []

    def build(self) -> Assembly:
        """Build the parts, or build them again with what is known now.

        Raises:
            FglocError: as `fgloc.assembly.assemble_stream` has it.
        """
        old = self.parts
        if old is not None:
            self._resumed = self.snapshot() or self._resumed
            self._past_rejections += old.rejections
        parts = assemble_stream(self.facts, self._map, self._config, keep_all=self._map is None)
        if self._resumed is not None:
            self._take_over(parts, self._resumed)
        self.parts = parts
        self.anchors = Anchors(parts)
        return parts

    def reset_pose(self, belief: PoseWithCovariance) -> None:
        """Go on from this pose at the next step."""
        self._reset, self._resumed = belief, None

    def check(self, event: Event) -> Event | None:
        """Through the gate: the event, a repaired copy, or None."""
        assert self.parts is not None
        passed = self.parts.gate.check(event)
        in_pixels = isinstance(event, SightingsEvent) and event.in_pixels
        seen = passed if in_pixels else event
        if seen is not None:
            self.parts.diagnosis.add(seen)
        return passed

    def use(self, event: Event, detected: bool = False) -> Iterator[tuple[Step, Estimate | None]]:
        """Take the next event in order; ``detected``: markers found in an image that has passed the gate."""
        assert self.parts is not None
        if detected and isinstance(event, SightingsEvent):
            passed = self.parts.detections.check(event)
            if passed is None:
                return
            event = passed
            self.parts.diagnosis.add(event)
        if isinstance(event, MotionEvent) and event.odometer is not None:
            self._odometry = event
        for step in self.parts.stepper.push(event):
            self.reordering_s = (self.parts.stepper.newest_ns - step.stamp_ns) * 1e-9
            yield step, self._update(step)
            self._diagnose(step)

    def finish(self) -> Iterator[tuple[Step, Estimate | None]]:
        """The stream has ended: its last steps."""
        if self.parts is not None:
            for step in self.parts.stepper.flush():
                yield step, self._update(step)
                self._diagnose(step)

    def _update(self, step: Step) -> Estimate | None:
        parts = self.parts
        assert parts is not None
        if self._reset is not None:
            parts.localizer.restart_at(self._reset)
            parts.sanity.begin_anew()
        elif self._resumed is not None:
            belief, note = carried_over(self._resumed, step, self._config, time.time_ns())
            self._notes = [note]
            if belief is not None:
                parts.localizer.restart_at(belief)
        self._reset = self._resumed = None
        estimate = parts.localizer.update(step)
        estimate = parts.sanity.observe(step, estimate, keep=False, by_hand=parts.localizer.motion.is_carried)
        self.keyframes += 1
        self._last_step = step
        if estimate is not None:
            self.newest = estimate
        return estimate

    def _diagnose(self, step: Step) -> None:
        """After the estimate was handed out: whoever waits for it does not wait for this."""
        assert self.parts is not None
        measured = self.parts.wheels.measure(step)
        motion = None if measured is None else measured.motion
        self.parts.diagnosis.observe(step, self.parts.localizer.motion.is_carried, motion)

    def anchor(self, step: Step, estimate: Estimate) -> Anchor:
        """To propagate the newest estimate from; ask before the next event is used."""
        assert self.anchors is not None
        return self.anchors.make(step, estimate)

    def _take_over(self, parts: Assembly, state: RunState) -> None:
        """What an earlier run found, but for the pose, which waits for the first step."""
        localizer, gyro = parts.localizer, parts.localizer.motion.sources.gyro
        known = installation_of_state(state, localizer.factors.installation)
        if known is not None:
            localizer.factors.estimated = known
        if gyro is not None and state.gyro is not None:
            gyro.resume(state.gyro.bias, state.gyro.bias_variance)
        for landmark_id, displacement in state.excluded.items():
            localizer.sightings.modes.displacements[landmark_id] = np.array(displacement)
        self._fastest = state.fastest

    def snapshot(self) -> RunState | None:
        """What is to be saved; None while no pose is known."""
        parts, step, estimate = self.parts, self._last_step, self.newest
        if parts is None or step is None or estimate is None or estimate.mode is Mode.UNCONFIRMED:
            return None
        localizer, gyro = parts.localizer, parts.localizer.motion.sources.gyro
        twist = parts.wheels.twist(step, step.stamp_ns)
        self._fastest = (
            max(self._fastest[0], float(np.hypot(twist[0], twist[1]))),
            max(self._fastest[1], abs(float(twist[2]))),
        )
        installed = localizer.estimator.installed
        moved = localizer.sightings.modes.displacements
        return RunState(
            map_fingerprint=self._fingerprint,
            saved_ns=time.time_ns(),
            stamp_ns=estimate.stamp_ns,
            pose=row3(estimate.pose),
            cov=matrix3(_body_cov(estimate)),
            mode=estimate.mode,
            fastest=self._fastest,
            twist=row3(twist),
            installation=InstallationState(
                names=localizer.factors.installation.names,
                mean=tuple(installed.mean.tolist()),
                cov=tuple(tuple(row) for row in installed.cov.tolist()),
            ),
            gyro=None if gyro is None else GyroState(bias=gyro.bias, bias_variance=gyro.bias_variance),
            odometry=None if self._odometry is None else odometry_state(self._odometry),
            excluded={i: (float(d[0]), float(d[1])) for i, d in moved.items()},
        )

    @property
    def rejections(self) -> Counter[str]:
        """Everything refused so far, by reason."""
        return self._past_rejections + (Counter() if self.parts is None else self.parts.rejections)

    def comparison(self) -> Callable[[], None] | None:
        """A comparison of the signals so far, which takes a second or two and any thread may make; None: not due."""
        return None if self.parts is None else self.parts.diagnosis.comparison()

    def findings(self) -> tuple[Finding, ...]:
        """Findings on the running estimate, the gravest first; sentences of the parts get the code ``run``."""
        if self.parts is None:
            return tuple(note("run", self._notes))
        diagnosis = self.parts.diagnosis
        return ordered(
            [
                *note("run", self._notes),
                *self.parts.sanity.watch.findings(),
                *note("floor.uneven", diagnosis.mistakes, Severity.ERROR),
                *diagnosis.found,
                *note("run", self.parts.sentences),
            ]
        )


def _body_cov(estimate: Estimate) -> FloatArray:
    cov = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
    return np.asarray(0.5 * (cov + cov.T))
