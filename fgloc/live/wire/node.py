"""A live run on a network: its topics as events into `Live`, the poses out. ``fgloc live`` and ROS's node share it."""

from __future__ import annotations

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgloc.config import Config, RecordingConfig, Role, base_role
from fgloc.errors import FglocError, WireError
from fgloc.frames import quaternion_yaw
from fgloc.live import Live, LivePose, LiveStatus
from fgloc.live.live import TYPED_SIGMAS
from fgloc.live.process import EstimationProcess
from fgloc.live.run import LOOK, MOTION
from fgloc.live.wire.outputs import OdomFrame, Outputs, RecentPoses, odom_in_map
from fgloc.live.wire.transport import Clock, Publication, Received, Transport
from fgloc.recording.reader import TF_TYPES, MessageEvents, TopicInfo, select_roles, topic_key
from fgloc.recording.standard_messages import MAP_FRAME
from fgloc.recording.transforms import TF_TOPIC
from fgloc.sensors import registry
from fgloc.types import Estimate, Event, FloatArray, LandmarkMap, Severity

# --- Intake: topics found by type, selected by role, decoded as those of a recording ----------------------------------

SETTLED_S = 1.0  # no new topic for this long: all of a robot's have been found
_FOR_MOTION_S = 10.0  # that a source of motion is waited for where there is what sees landmarks
_TF, _TF_STATIC = "/tf", "/tf_static"


class Intake:
    """Selects topics as `Recording` does and pushes their events, each with the name of its publisher.

    Attributes:
        roles: topic of each role; empty until those are there that a run needs.
        undecodable: messages that could not be decoded, by topic.
        received: messages by topic.
        truth: whether a truth is read; only those who look on need it.
        mapped: whether there is a map, on which sightings alone tell the pose where nothing tells motion.
        rival: an output topic that somebody else publishes too; empty if nobody does.
    """

    def __init__(
        self, transport: Transport, clock: Clock, config: RecordingConfig, push: Callable[[Event, str], None]
    ) -> None:
        """Watch the network; `find` looks for topics, `subscribe` reads them."""
        self._transport = transport
        self._clock = clock
        self._config = config
        self._push = push
        self._events = MessageEvents(config)
        self._role_of: dict[str, Role | None] = {}
        self._also: set[str] = set()  # latched topics that are read from publishers that do not latch, too
        self._found: tuple[Publication, ...] = ()
        self._changed_s = time.monotonic()
        self.roles: dict[Role, str] = {}
        self._further: dict[str, Role] = {}  # topics of roles that have several
        self.undecodable: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self.truth, self.mapped = True, False
        self.rival = ""
        self._looked_s: float | None = None  # since when there is what sees landmarks
        self._counting = threading.Lock()

    def find(self) -> str:
        """Look for the topics that a run needs; call it a few times a second. What is found is in `roles`.

        Returns:
            What is missing, as one sentence; empty if nothing is.

        Raises:
            WireError: several topics could play one role, or a configured one has another type.
        """
        own = self._transport.full_name("~/")
        published = self._transport.publications()
        found = tuple(p for p in published if not p.topic.startswith(own))
        self.rival = next((p.topic for p in published if p.topic.startswith(own)), "")
        if found != self._found:
            self._found, self._changed_s = found, time.monotonic()
        if time.monotonic() - self._changed_s < SETTLED_S:
            return ""
        topics = [TopicInfo(p.topic, p.message_type, 1) for p in found]
        selection = select_roles(topics, self._config.topics, self._config.beside, growing=True)
        missing = "" if self.roles else self._missing(selection.roles)
        if selection.problems and not self.roles:
            raise WireError("\n".join(selection.problems))
        if not missing:
            self.roles = {**selection.roles, **self.roles}
            others = {topic: role for role, topic in selection.roles.items() if registry.of_several(role)}
            self._further |= {**others, **selection.also}
        return missing

    def subscribe(self) -> list[tuple[Role, str]]:
        """Read what was found and is not read yet; the roles and topics that are new."""
        types = {p.topic: p.message_type for p in self._found}
        for name in (_TF, _TF_STATIC):
            topic, latched = self._transport.full_name(name), name == _TF_STATIC
            if self.roles and types.get(topic) in TF_TYPES and topic not in self._role_of:
                self._role_of[topic] = None
                self._transport.read(topic, types[topic], self._on_message, latched=latched)
            is_new = latched and topic in self._role_of and topic not in self._also
            if is_new and self._transport.has_volatile(topic):
                self._also.add(topic)
                self._transport.read(topic, types[topic], self._on_message)
        wanted: dict[str, Role] = {topic: role for role, topic in self.roles.items()}
        wanted |= self._further
        wanted |= dict.fromkeys(self._config.topics.of_joints if self.roles else (), "joints")
        new = [(role, topic) for topic, role in wanted.items() if topic not in self._role_of and topic in types]
        new = [(role, topic) for role, topic in new if self.truth or role != "truth"]
        for role, topic in new:
            self._role_of[topic] = role
            self._transport.read(topic, types[topic], self._on_message)
        return new

    def _missing(self, roles: Mapping[Role, str]) -> str:
        lacking = []
        every = (*MOTION, *LOOK, "camera_info", *self._config.topics.of_cameras)
        wanted = [role for role in every if base_role(role) in LOOK and self._config.topics.given(role) != "none"]
        if not set(wanted) & roles.keys():
            self._looked_s = None
        elif self._looked_s is None:
            self._looked_s = time.monotonic()
        alone = self.mapped and self._looked_s is not None and time.monotonic() - self._looked_s > _FOR_MOTION_S
        if not set(MOTION) & roles.keys() and not alone:
            lacking.append("odometry, joint states, commands or an IMU")
        if wanted and not set(wanted) & roles.keys():
            lacking.append("images or marker sightings")
        names = {p.topic for p in self._found}
        for role in every:
            given = self._config.topics.given(role)
            if given not in (None, "none") and given not in names:
                why = ", which is read from recordings only: give a topic" if given.startswith(TF_TOPIC) else ""
                lacking.append(f"{given} ({topic_key(role)}{why})")
        lacking += [f"{topic} (recording.joints)" for topic in self._config.topics.of_joints[1:] if topic not in names]
        there = ", ".join(f"{p.topic} ({p.message_type})" for p in self._found) or "none"
        return f"Waiting for {' and '.join(lacking)}; topics there: {there}." if lacking else ""

    def _on_message(self, message: Received) -> None:
        topic = message.topic
        with self._counting:
            self.received[topic] += 1
        try:
            content = self._transport.decode(message)
            role, received_ns = self._role_of[topic], self._clock.received_ns(message)
            events = self._events.of(content, message.message_type, role, received_ns, topic)
        except Exception:  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
            with self._counting:
                self.undecodable[topic] += 1
            return
        several = topic in self._config.topics.of_joints  # an event of several topics is of several publishers
        for event in events:
            self._push(event, "" if several else message.publisher)


# --- What the user is told: each thing once ---------------------------------------------------------------------------

_PATIENCE_S = 2.0  # what is missing for less than this is not worth a sentence
_FIGURES = re.compile(r"\d+(\.\d+)?")


class Teller:
    """Passes sentences on, but none again that differs from an earlier one in its figures only."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """Take the function that is given one sentence at a time."""
        self._tell = tell
        self._told: set[str] = set()
        self._waiting = ""
        self._since_s = 0.0

    def tell(self, *sentences: str) -> None:
        """Pass sentences on at once."""
        for sentence in sentences:
            if (kind := _FIGURES.sub("", sentence)) not in self._told:
                self._told.add(kind)
                self._tell(sentence)

    def waiting(self, sentence: str) -> None:
        """Set the sentence on what is missing now (empty: nothing), which is passed on if it holds for a while."""
        if sentence != self._waiting:
            self._waiting, self._since_s = sentence, time.monotonic()
        if sentence and time.monotonic() - self._since_s >= _PATIENCE_S:
            self.tell(sentence)


# --- The node ---------------------------------------------------------------------------------------------------------

RATE_HZ = 50.0  # of the odometry: what controllers of wheeled robots usually ask for
_ASKED_EVERY = 3  # turns: the motion sources are read at 17 Hz, which is most of the work; between, the speed is held
_POLL_S = 0.2  # time between two looks at what there is on the wire
_LOST = "{}: {} message(s) were lost on their way, as on a busy machine or network; poses lack what was in them."
_RIVAL = (
    "Another fgloc, or a recording of one that is played, publishes {} too: whoever reads it, or /tf, gets poses of "
    "both. Give each robot a domain of its own, and do not play these topics; one that was killed is seen for ten "
    "seconds more."
)
_INITIAL_POSE = "initialpose"
_INITIAL_POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"


@dataclass(frozen=True, slots=True)
class Publishing:
    """How poses are published."""

    rate_hz: float = RATE_HZ  # of the odometry
    map_frame: str = MAP_FRAME
    odom_frame: str = ""  # empty: as messages say
    tf: bool = True
    tf_ahead_s: float = 0.0  # added to the stamps of /tf, so that it need not be waited for
    name: str = "fgloc"  # in the diagnostics


class Node:
    """One live run on a network. Use `run`, then `close`.

    Attributes:
        live: the run; None until the topics that it needs are there.
        intake: what comes in.
        published: messages sent, by kind.
        refused: messages of people that could not be used, by topic.
        watch: given every event that comes in, also a truth's.
    """

    def __init__(
        self,
        transport: Transport,
        config: Config,
        landmarks: LandmarkMap | None,
        state: Path | None = None,
        publishing: Publishing | None = None,
        process: EstimationProcess | None = None,
    ) -> None:
        """Announce the outputs; input is looked for by `run`.

        Args:
            transport: the network.
            config: all settings.
            landmarks: the map; None: landmarks are estimated.
            state: as `Live` has it.
            publishing: rate and frames; None: the usual ones.
            process: the process to estimate in, if it was started before.
        """
        self.live: Live | None = None
        self._process = process or EstimationProcess()  # publishing does not wait for an update
        self._as = publishing or Publishing()
        self._config = config
        self._landmarks = landmarks
        self._state = state
        self.watch: Callable[[Event], None] | None = None
        self._subscribers: list[Callable[[Estimate], None]] = [self._on_estimate]
        self._transport = transport
        self._clock = transport.clock()
        self._outputs = Outputs(transport, self._as.map_frame, self._as.name)
        self._odom = OdomFrame(config.recording, config.gate.max_position, self._as.odom_frame)
        self.intake = Intake(transport, self._clock, config.recording, self._push)
        self.published: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self._failure: FglocError | None = None
        self._notes: list[str] = []  # to be told
        self._given: tuple[tuple[float, ...], tuple[float, ...]] | None = None  # pose and sigmas, before the run begins
        self._stopping = threading.Event()
        self._turn = 0  # of publishing
        self._last: LivePose | None = None  # that was published
        self._T_map_odom: dict[str, FloatArray] = {}  # by name of the odometry frame
        if landmarks is not None:
            self._outputs.map(landmarks)
        self._given_by = transport.full_name(_INITIAL_POSE)
        transport.read(self._given_by, _INITIAL_POSE_TYPE, self._on_initial_pose)

    def close(self) -> None:
        """End the run, and save its state."""
        if self.live is not None:
            self.live.close()
        self._process.close()

    def use_map(self, landmarks: LandmarkMap) -> None:
        """Go on with another map, see `Live.use_map`; it is published too."""
        if self.live is not None:
            self.live.use_map(landmarks)
        self._landmarks = landmarks
        self._outputs.map(landmarks)

    def subscribe(self, callback: Callable[[Estimate], None]) -> None:
        """Call a function with every estimate, see `Live.subscribe`; to be called before `run`."""
        self._subscribers.append(callback)

    def run(self, stop: threading.Event, tell: Callable[[str], None]) -> None:
        """Localise until `stop` is set.

        Args:
            stop: ends it within a fraction of a second.
            tell: given what the user should know, one sentence at a time, each once.

        Raises:
            FglocError: what comes in cannot be used.
        """
        publishing: threading.Thread | None = None
        teller = Teller(tell)
        self.intake.truth, self.intake.mapped = self.watch is not None, self._landmarks is not None
        next_diagnostics_s, was_stale = time.monotonic(), False
        try:
            while not stop.wait(_POLL_S):
                if self._failure is not None:
                    raise self._failure
                missing = self.intake.find()
                if not missing and self.live is None and not self._process.ready:
                    missing = "Waiting for the process that estimates to start."
                if self.live is None and self.intake.roles and self._process.ready:
                    self._start()
                    publishing = threading.Thread(target=self._publish, name="fgloc-odometry", daemon=True)
                    publishing.start()
                for role, topic in self.intake.subscribe() if self.live is not None else ():
                    teller.tell(f"Subscribed: {topic} ({role}).")
                status = None if self.live is None else self.live.status()
                if status is not None:
                    missing = missing or (f"Waiting for {'; '.join(status.waiting_for)}." if status.waiting_for else "")
                    teller.tell(*status.notes)
                teller.waiting(missing)
                if self.intake.rival:
                    teller.tell(_RIVAL.format(self.intake.rival))
                teller.tell(
                    *self._take_notes(), *(_LOST.format(topic, n) for topic, n in self._transport.lost().items())
                )
                stale = "" if status is None else status.stale
                if bool(stale) != was_stale:
                    was_stale, next_diagnostics_s = bool(stale), 0.0
                    tell(f"{stale}." if stale else "Messages come again.")
                if time.monotonic() >= next_diagnostics_s:
                    next_diagnostics_s = time.monotonic() + 1.0
                    self._diagnose(status)
        finally:
            self._stopping.set()
            if publishing is not None:
                publishing.join()

    def _start(self) -> None:
        """Begin the run as soon as the topics are known, so that their first messages belong to it."""
        roles = tuple(self.intake.roles)
        self.live = Live(self._config, self._landmarks, state=self._state, roles=roles, process=self._process)
        self._take_given(self.live)
        self._recent = RecentPoses(self.live.pose_at)
        for callback in self._subscribers:
            self.live.subscribe(callback)

    def _push(self, event: Event, publisher: str) -> None:
        assert self.live is not None  # nothing is read before
        try:
            used = self.live.push(event, publisher)
        except FglocError as error:
            self._failure = error
            return
        for one in used:
            self._odom.add(one)
            if self.watch is not None:
                self.watch(one)

    def _on_estimate(self, estimate: Estimate) -> None:
        self._outputs.pose(estimate)
        self._outputs.protection(estimate)
        self.published["pose"] += 1

    def _on_initial_pose(self, given: Received) -> None:
        """Take a pose that a person gave; one of any other content is counted and said, and the run goes on."""
        try:
            message = self._transport.decode(given)
            frame = message.header.frame_id.lstrip("/")
            if frame not in ("", self._as.map_frame):
                raise ValueError(f"it is in frame {frame!r}, expected {self._as.map_frame!r}")
            self._given = self._planar(message.pose)
        except Exception as error:  # rosbags leaks struct, decoding, key and assertion errors on damaged bytes
            self.refused[self._given_by] += 1
            why = error if isinstance(error, ValueError) and not isinstance(error, UnicodeError) else "it is damaged"
            self._notes.append(f"{self._given_by} is not used: {why}.")
            return
        if self.live is not None:
            self._take_given(self.live)

    def _planar(self, given: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Pose and sigmas of a message.

        Raises:
            ValueError: values that no pose in a map has.
        """
        q, variances = given.pose.orientation, np.asarray(given.covariance)[[0, 7, 35]]
        if not (variances > 0.0).all():
            variances = np.square(TYPED_SIGMAS)
        pose = (given.pose.position.x, given.pose.position.y, quaternion_yaw((q.x, q.y, q.z, q.w)))
        farthest, widest = self._config.gate.max_position, self._config.gate.max_variance
        if not np.abs(pose).max() <= farthest:  # nor with a NaN in it
            raise ValueError(f"position {pose[0]:g}, {pose[1]:g} m, expected within {farthest:g} m")
        if not variances.max() <= widest:
            raise ValueError(f"a variance of {variances.max():g}, expected at most {widest:g}")
        if not abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1.0) <= 0.1:
            raise ValueError("its quaternion is none of a rotation")
        return pose, tuple(np.sqrt(variances).tolist())

    def _take_given(self, live: Live) -> None:
        """Go on from the pose that was given last, if one was."""
        given, self._given = self._given, None
        if given is None:
            return
        try:
            live.reset_pose(*given)
        except FglocError as error:
            self.refused[self._given_by] += 1
            self._notes.append(f"{self._given_by} is not used: {error}.")

    def _take_notes(self) -> list[str]:
        notes, self._notes = self._notes, []
        return notes

    def _publish(self) -> None:
        """Publish at `RATE_HZ` until the end; a turn that comes too late is left out."""
        period_s = 1.0 / self._as.rate_hz
        due = time.monotonic()
        while not self._stopping.is_set():
            due = max(due + period_s, time.monotonic())
            try:
                self._publish_once()
            except FglocError as error:
                self._failure = error
                return
            time.sleep(max(0.0, due - time.monotonic()))

    def _publish_once(self) -> None:
        assert self.live is not None
        clock_ns = self._clock.now_ns()
        self._turn += 1
        ahead = self._recent.ahead(clock_ns) if self._turn % _ASKED_EVERY else None
        now = ahead or self.live.pose_at(clock_ns) or self._of_newest_message()
        if now is None or (self._last is not None and now.stamp_ns == self._last.stamp_ns):  # simulation time stands
            return
        if ahead is None:
            self._recent.add(now)
        self._last = now
        base = self._odom.base
        self._outputs.odometry(now, *self._recent.twist(), base)
        self.published["odometry"] += 1
        if self._as.tf:
            self._publish_transforms(now, base)

    def _of_newest_message(self) -> LivePose | None:
        """Pose at the newest message, for a clock that is not that of the messages; None: they have stopped."""
        assert self.live is not None
        newest, last = self.live.pose_at(), self._last
        if newest is not None and last is not None and newest.keyframe_ns == last.keyframe_ns:
            return newest if newest.stamp_ns > last.stamp_ns else None
        return newest

    def _publish_transforms(self, now: LivePose, base: str) -> None:
        """Publish ``map → odom`` for each pose of the odometry, else ``map → base``.

        The transform of an odometry's pose that is newer than those asked for is the one before: it changes only by
        the odometry's error.
        """
        assert self.live is not None
        ahead_ns = round(self._as.tf_ahead_s * 1e9)
        if self._odom.latest() is None:
            return self._outputs.transform(now.stamp_ns + ahead_ns, now.pose, base)
        taken = self._odom.take(now.stamp_ns)
        for odom in taken:
            then = self._recent.at(odom.stamp_ns)
            if then is None and odom is taken[-1] and self._recent.is_before(odom.stamp_ns):
                late = self.live.pose_at(odom.stamp_ns)  # a slow network, or a clock that is behind
                then = None if late is None else late.pose
            if then is not None:
                self._T_map_odom = {odom.frame: odom_in_map(then, odom.T_odom_base)}
            if (known := self._T_map_odom.get(odom.frame)) is not None:
                self._outputs.transform(odom.stamp_ns + ahead_ns, known, odom.frame)
        return None

    def _diagnose(self, status: LiveStatus | None) -> None:
        mode = None if status is None or status.stale else status.mode
        message, values = described(status)
        values |= {f"refused {topic}": str(n) for topic, n in self.refused.items()}
        values |= {f"lost {topic}": str(n) for topic, n in self._transport.lost().items()}
        wrong = status is not None and (
            bool(status.alert) or any(f.severity is Severity.ERROR for f in status.findings)
        )
        self._outputs.diagnostics(self._clock.now_ns(), mode, message, values, wrong)
        self.published["diagnostics"] += 1


def described(status: LiveStatus | None) -> tuple[str, dict[str, str]]:
    """Status as a message and values for diagnostics."""
    if status is None:
        return "waiting for the robot's topics", {}
    values = {"keyframes": str(status.keyframes), "update [ms]": f"{status.step_ms:.1f}"}
    values["keyframe delay [s]"] = f"{status.reordering_s:.3f}"
    if (bound := status.protection) is not None:
        along, across, yaw = (f"{value:.3f}" for value in bound.bound)
        values |= {"bound along [m]": along, "bound across [m]": across, "bound of yaw [rad]": yaw}
        values["bound by"] = bound.cause
    for topic, of in status.topics.items():
        values[f"{of.role} topic"] = topic
        values[f"{of.role} rate [Hz]"] = f"{of.rate_hz:.1f}"
        values[f"{of.role} delay [s]"] = f"{of.delay_s:z.3f}"
    values |= {f"dropped {role}": str(n) for role, n in status.dropped.items()}
    values |= {f"rejected {reason}": str(n) for reason, n in status.rejections.items()}
    values |= {f"{f.severity.name.lower()} {f.code}": f.text for f in status.findings if f.severity > Severity.NOTE}
    values |= {f"note {k}": note for k, note in enumerate(status.notes, 1)}
    if status.stale:
        return status.stale, values
    if status.mode is not None:
        wrong = next((f": {f.text}" for f in status.findings if f.severity is Severity.ERROR), "")
        return status.alert or f"{status.mode}{wrong}", values
    return f"waiting for {'; '.join(status.waiting_for)}" if status.waiting_for else "no pose yet", values
