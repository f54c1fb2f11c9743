"""``fgloc live`` as a participant: events of the wire into `Live`, its poses out."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from fgloc import se2
from fgloc.config import Config
from fgloc.errors import FglocError
from fgloc.live import Live, LivePose, LiveStatus
from fgloc.live.wire.clock import WireClock
from fgloc.live.wire.intake import Intake
from fgloc.live.wire.odom_frame import OdomFrame
from fgloc.live.wire.outputs import MAP_FRAME, BaseState, Outputs, odom_in_map
from fgloc.live.wire.participant import Participant, Sample
from fgloc.types import Estimate, Event, FloatArray, LandmarkMap

RATE_HZ = 50.0  # of the odometry: what controllers of wheeled robots usually ask for
_POLL_S = 0.2  # time between two looks at what there is on the wire
_TWIST_S = 0.1  # the twist is the motion over this long
_INITIAL_POSE = "/initialpose"
_INITIAL_POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"


_FIGURES = re.compile(r"\d+")


class Node:
    """One live run on the wire. Use `run`, then `close`.

    Attributes:
        published: messages sent, by kind.
    """

    def __init__(self, live: Live, landmarks: LandmarkMap | None, config: Config, participant: Participant) -> None:
        """Announce the outputs; input is looked for by `run`."""
        self._live = live
        self._config = config
        self._clock = WireClock(participant)
        self._outputs = Outputs(participant)
        self._odom = OdomFrame(config.recording)
        self.intake = Intake(participant, self._clock, config.recording, self._push)
        self.published: Counter[str] = Counter()
        self._messages = participant.messages
        self._failure: FglocError | None = None
        self._notes: list[str] = []  # to be told
        self._stopping = threading.Event()
        self._last_ns = 0  # stamp of the last odometry published
        self._last_odom_ns = 0
        if landmarks is not None:
            self._outputs.map(landmarks)
        participant.read(_INITIAL_POSE, _INITIAL_POSE_TYPE, self._on_initial_pose)
        live.subscribe(self._on_estimate)

    def run(self, stop: threading.Event, tell: Callable[[str], None]) -> None:
        """Localise until `stop` is set.

        Args:
            stop: ends it within a fraction of a second.
            tell: given what the user should know, one sentence at a time, each once.

        Raises:
            FglocError: what comes in cannot be used.
        """
        publishing = threading.Thread(target=self._publish, name="fgloc-odometry", daemon=True)
        publishing.start()
        told: set[str] = set()  # without their figures, which change
        subscribed = 0
        next_diagnostics_s = time.monotonic()
        try:
            while not stop.wait(_POLL_S):
                if self._failure is not None:
                    raise self._failure
                missing = self.intake.poll()
                sentences = [missing] if missing else []
                if len(self.intake.roles) > subscribed:
                    subscribed = len(self.intake.roles)
                    sentences.append(f"Subscribed: {', '.join(f'{t} ({r})' for r, t in self.intake.roles.items())}.")
                status = self._live.status()
                if self.intake.roles and status.waiting_for:
                    sentences.append(f"Waiting for {'; '.join(status.waiting_for)}.")
                sentences += status.notes + tuple(self._take_notes())
                for sentence in sentences:
                    if (kind := _FIGURES.sub("", sentence)) not in told:
                        told.add(kind)
                        tell(sentence)
                if time.monotonic() >= next_diagnostics_s:
                    next_diagnostics_s = time.monotonic() + 1.0
                    self._diagnose(status)
        finally:
            self._stopping.set()
            publishing.join()

    def _push(self, event: Event) -> None:
        self._odom.add(event)
        try:
            self._live.push(event)
        except FglocError as error:
            self._failure = error

    def _on_estimate(self, estimate: Estimate) -> None:
        self._outputs.pose(estimate)
        self.published["pose"] += 1

    def _on_initial_pose(self, sample: Sample) -> None:
        message = self._messages.decode(sample.message_type, sample.cdr)
        frame = message.header.frame_id.lstrip("/")
        if frame not in ("", MAP_FRAME):
            self._notes.append(f"{_INITIAL_POSE} is in frame {frame!r}, expected {MAP_FRAME!r}: not used.")
            return
        pose, variances = message.pose.pose, np.asarray(message.pose.covariance)[[0, 7, 35]]
        if not (variances > 0.0).all():
            variances = np.square(self._config.estimator.initial_sigmas)
        q = pose.orientation
        yaw = np.arctan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        try:
            self._live.reset_pose(np.array([pose.position.x, pose.position.y, yaw]), np.sqrt(variances))
        except FglocError as error:
            self._notes.append(f"{_INITIAL_POSE} is not used: {error}.")

    def _take_notes(self) -> list[str]:
        notes, self._notes = self._notes, []
        return notes

    def _publish(self) -> None:
        """At `RATE_HZ` until the end; a turn that comes too late is left out."""
        period_s = 1.0 / RATE_HZ
        due = time.monotonic()
        while not self._stopping.is_set():
            due = max(due + period_s, time.monotonic())
            self._publish_once()
            time.sleep(max(0.0, due - time.monotonic()))

    def _publish_once(self) -> None:
        now = self._live.pose_at(self._clock.now_ns()) or self._live.pose_at()
        if now is None or now.stamp_ns == self._last_ns:  # no time has passed: simulation time stands still
            return
        base = self._odom.base
        self._last_ns = now.stamp_ns
        self._outputs.odometry(BaseState(now.stamp_ns, now.pose, now.cov, self._twist(now)), base)
        self.published["odometry"] += 1
        odom = self._odom.latest()
        if odom is None:
            self._outputs.transform(now.stamp_ns, now.pose, base)
        elif odom.stamp_ns != self._last_odom_ns:
            then = self._live.pose_at(odom.stamp_ns)
            if then is not None:
                self._last_odom_ns = odom.stamp_ns
                self._outputs.transform(odom.stamp_ns, odom_in_map(then.pose, odom.T_odom_base), odom.frame)

    def _twist(self, now: LivePose) -> FloatArray:
        """Of the base in its own axes, from the pose a moment before."""
        before = self._live.pose_at(now.stamp_ns - round(_TWIST_S * 1e9))
        return np.zeros(3) if before is None else se2.log(se2.between(before.pose, now.pose)) / _TWIST_S

    def _diagnose(self, status: LiveStatus) -> None:
        values = {"keyframes": str(status.keyframes), "update [ms]": f"{status.step_ms:.1f}"}
        for topic, of in status.topics.items():
            values[f"{of.role} [Hz]"] = f"{of.rate_hz:.1f}"
            values[f"{of.role} delay [s]"] = f"{of.delay_s:.3f}"
            values[f"{of.role} topic"] = topic
        values |= {f"dropped {role}": str(n) for role, n in status.dropped.items()}
        values |= {f"rejected {reason}": str(n) for reason, n in status.rejections.items()}
        values |= {f"note {k}": note for k, note in enumerate(status.notes, 1)}
        waiting = f"waiting for {'; '.join(status.waiting_for)}" if status.waiting_for else "no pose yet"
        message = waiting if status.mode is None else str(status.mode)
        self._outputs.diagnostics(self._clock.now_ns(), status.mode, message, values)
        self.published["diagnostics"] += 1
