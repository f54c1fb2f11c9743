"""A live run without its threads: events in order of receipt go in, estimates come out (recorded: `Replay`)."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from fnmatch import fnmatchcase

import numpy as np

from fgloc import se2
from fgloc.assembly import Assembly, assemble_stream
from fgloc.config import (
    CAMERA_ROLES,
    ODOMETRIES,
    Config,
    Role,
    TopicsConfig,
    base_role,
    camera_role,
    role_names,
)
from fgloc.graph.measurement_log import PoseWithCovariance
from fgloc.live.extrapolation import Anchor, Anchors
from fgloc.live.state import (
    GyroState,
    InstallationState,
    RunState,
    carried_over,
    fingerprint,
    matrix3,
    odometry_state,
    resumed_installation,
)
from fgloc.recording.transforms import FrameTree
from fgloc.sensor_setup import base_frame, camera_frame, given_pose
from fgloc.sensors import registry
from fgloc.sensors.base import with_values
from fgloc.types import (
    Camera,
    CameraInfoEvent,
    Estimate,
    Event,
    Finding,
    FloatArray,
    LandmarkMap,
    Mode,
    MotionEvent,
    RawEvent,
    Severity,
    SightingsEvent,
    Step,
    TransformEvent,
    TruthEvent,
    note,
    ordered,
)

# --- Facts of the stream, gathered from its first messages ------------------------------------------------------------


def role_of(event: Event, topics: TopicsConfig) -> Role | None:
    """Role of an event's topic, of one of several cameras by its topic; None if it needs none."""
    if isinstance(event, CameraInfoEvent | TruthEvent):
        role: Role | None = "camera_info" if isinstance(event, CameraInfoEvent) else "truth"
    else:
        role = registry.role_of_event(event)
    return role if role is None or role not in CAMERA_ROLES else topics.role_on(event.topic, role)


def role_name(event: Event, topics: TopicsConfig) -> str:
    """Role of an event's topic; "tf" if it needs none."""
    return role_of(event, topics) or "tf"


MOTION: tuple[Role, ...] = ("odometry", "joints", "command", "imu")
LOOK: tuple[Role, ...] = ("image", "sightings")
_NOT_BUILT_FROM: frozenset[Role] = frozenset({"camera_info", "truth"})
_FOR_MOTION = 5.0  # times the usual wait
MOST_NAMES = 1000  # of frames and publishers that are kept: a robot has tens, and what invents names has no end
_LONGEST_NAME = 255  # characters of a frame; ROS and tf2 set no bound


class LiveFacts:
    """Facts of the stream so far, see `fgloc.sensor_setup.StreamFacts`.

    A role counts as there once everything is known that its sensor is built from: for images and marker corners, the
    calibration and the mounting of the camera too.

    Attributes:
        roles: topic of each role that is there.
        left_out: transforms that were not kept, as there are too many pairs of frames.
    """

    name = "the live stream"

    def __init__(self, config: Config, expected: Collection[Role] | None, camera: Camera | None) -> None:
        """Take the roles that are to be waited for (None: whatever comes), and the camera if it is known already."""
        self.camera = camera
        self.roles: dict[Role, str] = {}
        self.left_out = 0
        self._seen: dict[type[Event], Event] = {}
        self._firsts: dict[tuple[type[Event], str], Event] = {}
        self._sizes: dict[str, tuple[int, int]] = {}  # of images, by topic
        self.expected = (
            None if expected is None else frozenset(r for r in expected if base_role(r) not in _NOT_BUILT_FROM)
        )
        self._config = config
        self._beside = config.recording.beside
        self._beside_of = {topic: role for role, topic in self._beside.items()}
        self._topics: dict[Role, str] = {}  # the first topic of each role; others are not used
        self._transforms: dict[bool, dict[tuple[str, str], list[TransformEvent]]] = {False: {}, True: {}}  # by static
        self._frames: FrameTree | None = None
        self._incomplete = False  # a role has come in that lacks something

    def topic_is_used(self, event: Event) -> bool:
        """Whether the event is of the one topic that plays its role: the configured one, else the first."""
        role = self._role_of(event)
        if role is None:
            return True
        given = self._given(role)
        several = registry.of_several(role)
        if given == "none" or (given not in (None, event.topic) and not (several and fnmatchcase(event.topic, given))):
            return False
        return self._topics.setdefault(role, event.topic) == event.topic or several

    def is_configured(self, event: Event) -> bool:
        """Whether the configuration names the topic that plays the event's role, or none."""
        role = self._role_of(event)
        return role is not None and self._given(role) is not None

    def _role_of(self, event: Event) -> Role | None:
        """Role of an event's topic, also of an odometry beside the wheels; None if it needs none."""
        return self._beside_of.get(event.topic) or role_of(event, self._config.recording.topics)

    def _given(self, role: Role) -> str | None:
        """Topic that the configuration gives a role; "none": it is not to be used."""
        return "none" if role == ODOMETRIES else self._beside.get(role) or self._config.recording.topics.given(role)

    @property
    def first(self) -> Mapping[type[Event], Event]:
        """First event of each class whose role is there."""
        return {kind: event for kind, event in self._seen.items() if self.is_there(event)}

    @property
    def firsts(self) -> list[Event]:
        """First event of each class on each topic whose role is there."""
        return [event for event in self._firsts.values() if self.is_there(event)]

    def image_size(self, topic: str | None) -> tuple[int, int] | None:
        """Width and height of the first image of a topic that could be decoded; None: there is none yet."""
        return self._sizes.get(topic or "")

    def is_there(self, event: Event) -> bool:
        """Whether everything is known that is needed to use an event."""
        role = self._role_of(event)
        return role is None or base_role(role) in _NOT_BUILT_FROM or role in self.roles

    def is_news(self, event: Event) -> bool:
        """Whether the event may hold facts that the run is not yet built from."""
        return self._incomplete or (type(event), event.topic) not in self._firsts

    def note(self, event: Event) -> bool:
        """Add an event to the facts; whether a role is there now that was not before."""
        if isinstance(event, TransformEvent):
            self._add_transform(event)
        else:
            self._seen.setdefault(type(event), event)
            self._firsts.setdefault((type(event), event.topic), event)
        if isinstance(event, RawEvent) and event.topic not in self._sizes:
            size = event.decoded_size()
            if size is None:
                return False
            self._sizes[event.topic] = size
        before = len(self.roles)
        for role, topic in self._topics.items():
            if role not in self.roles and base_role(role) not in _NOT_BUILT_FROM and not self._missing(role):
                self.roles[role] = topic
        self._incomplete = any(r not in self.roles and base_role(r) not in _NOT_BUILT_FROM for r in self._topics)
        return len(self.roles) > before

    def waiting_for(self) -> tuple[str, ...]:
        """Missing parts of the stream, a phrase each."""
        missing = []
        recording = self._config.recording
        for role in (*role_names(), *self._beside, *recording.topics.of_cameras):
            if role in self.roles or base_role(role) in _NOT_BUILT_FROM:
                continue
            if role in self._topics:
                missing.append(f"{role} ({self._topics[role]}): {self._missing(role)}")
            elif self.expected is not None and role in self.expected:
                missing.append(f"{role}: no message yet")
        if not set(MOTION) & set(self.roles) and (self.expected is None or set(MOTION) & self.expected):
            missing.append("a motion source: odometry, joints, command or imu")
        return tuple(missing)

    def complete(self, waited_s: float, patience_s: float, mapped: bool) -> bool:
        """Whether the run can be built: all that is expected is there, or the wait is over.

        What tells motion is waited for longer, unless none is expected: on a map, sightings alone tell the pose.

        Args:
            waited_s: since the first message.
            patience_s: for what may come.
            mapped: whether there is a map. Without one, motion that came later would begin another one.
        """
        moving = bool(set(MOTION) & set(self.roles))
        if not moving and set(LOOK).isdisjoint(map(base_role, self.roles)):
            return False
        if self.expected is not None and self.expected <= set(self.roles):
            return True
        return waited_s >= patience_s * (1.0 if moving else _FOR_MOTION if mapped else math.inf)

    @property
    def topics(self) -> str:
        """All topics with their roles."""
        return ", ".join(f"{topic} ({role})" for role, topic in self._topics.items()) or "none"

    @property
    def frames(self) -> FrameTree:
        """Tree of all transforms so far."""
        if self._frames is None:
            self._frames = FrameTree(t for pairs in self._transforms.values() for same in pairs.values() for t in same)
        return self._frames

    def _missing(self, role: Role) -> str:
        """Missing part without which the sensor of a role cannot be built; "" if nothing is missing."""
        camera, _, base = role.rpartition("/")
        config = self._config.of_camera(camera)
        own = {self._topics.get(camera_role(camera, r)) for r in CAMERA_ROLES}
        seen = {kind: event for (kind, topic), event in self._firsts.items() if topic in own} if camera else self._seen
        in_pixels = base == "sightings" and any(e.in_pixels for e in seen.values() if isinstance(e, SightingsEvent))
        if base not in LOOK or self.camera is not None or not (base == "image" or in_pixels):
            return ""
        if CameraInfoEvent not in seen and config.camera.file is None:
            return f"no CameraInfo yet, and no {'cameras.' + camera if camera else 'camera'}.file"
        if given_pose(config, "optical") is not None:
            return ""
        frame = camera_frame(seen)
        base_name = base_frame(self, self._config)
        if frame.lstrip("/") != base_name.lstrip("/") and not (frame in self.frames and base_name in self.frames):
            return f"no transform from {base_name} to {frame!r} yet, and no recording.sightings_pose"
        return ""

    def _add_transform(self, event: TransformEvent) -> None:
        """Keep of each pair of frames the first transform, and one that differs: the pair moves.

        Pairs beyond `MOST_NAMES` are left out, of fixed and of other transforms apart: what moves under ever new names
        takes no room of the robot's mountings.
        """
        pair, alike = (event.parent, event.child), self._transforms[event.static]
        same = alike.get(pair, [])
        if len(same) > 1 or (same and _equal(same[0], event)):
            return
        if not same:
            if len(alike) >= MOST_NAMES or max(map(len, pair)) > _LONGEST_NAME:
                self.left_out += 1
                return
            alike[pair] = same
        same.append(event)
        self._frames = None


def _equal(a: TransformEvent, b: TransformEvent) -> bool:
    return bool(np.array_equal(a.translation, b.translation) and np.array_equal(a.rotation, b.rotation))


# --- The run ----------------------------------------------------------------------------------------------------------


class OnlineRun:
    """Gate, steps, localizer and diagnosis of a stream; single-threaded.

    The parts are built once the facts of the stream are known. When a sensor begins later they are built again, and
    the new ones go on from the state of the old.

    Attributes:
        facts: what has come in.
        parts: of the run; None before they are built.
        anchors: of its estimates; None before.
        map: the known map; None: landmarks are estimated.
        newest: the last estimate.
        keyframes: steps so far.
        reordering_s: how far the last keyframe was behind the newest stamp when it was made.
    """

    def __init__(
        self, config: Config, landmark_map: LandmarkMap | None, facts: LiveFacts, resumed: RunState | None = None
    ) -> None:
        """Start without events.

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
        # A first pose is taken as one that is given while the robot drives: sightings that contradict it win
        first, sigmas = config.estimator.initial_pose, config.estimator.initial_sigmas
        self._first = None if first is None else PoseWithCovariance(np.array(first), np.diag(np.square(sigmas)))
        self._config = with_values(config, "estimator", {"initial_pose": None})
        self.map = landmark_map
        self._fingerprint = fingerprint(landmark_map)
        self._resumed = resumed
        self._reset = self._first if resumed is None else None  # a pose that was given, for the next step
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
        return self._begin(self.map, self._resumed)

    def begin_again(self, landmark_map: LandmarkMap | None, state: RunState | None) -> None:
        """Go on with another map (or the same) and from a state; None: the start is fresh.

        Parts that are built already are built anew, from what the stream has told so far.

        Raises:
            FglocError: as `build`; everything is then as before.
        """
        if (old := self.parts) is not None:
            self._begin(landmark_map, state)
            self._past_rejections += old.rejections
        self.map, self._fingerprint = landmark_map, fingerprint(landmark_map)
        self._resumed, self._reset, self.newest, self._notes = state, None, None, []
        if state is None:
            self._reset = self._first

    def _begin(self, landmark_map: LandmarkMap | None, state: RunState | None) -> Assembly:
        parts = assemble_stream(self.facts, landmark_map, self._config, keep_all=landmark_map is None)
        if state is not None:
            self._take_over(parts, state)
        self.parts, self.anchors = parts, Anchors(parts)
        return parts

    def reset_pose(self, belief: PoseWithCovariance) -> None:
        """Restart at this pose at the next step."""
        self._reset, self._resumed = belief, None

    def check(self, event: Event) -> Event | None:
        """Event as the gate lets it through, perhaps a repaired copy, or None."""
        assert self.parts is not None
        passed = self.parts.gate.check(event)
        in_pixels = isinstance(event, SightingsEvent) and event.in_pixels
        seen = passed if in_pixels else event
        if seen is not None:
            self.parts.diagnosis.add(seen)
        return passed

    def use(self, event: Event, detected: bool = False) -> Iterator[tuple[Step, Estimate | None]]:
        """Use the next event in order; ``detected``: markers found in an image that has passed the gate."""
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
        """Use the last steps at the end of the stream."""
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
        """Diagnose a step after its estimate was passed on, so that nothing waits for the diagnosis."""
        assert self.parts is not None
        measured = self.parts.wheels.measure(step)
        motion = None if measured is None else measured.motion
        self.parts.diagnosis.observe(step, self.parts.localizer.motion.is_carried, motion)

    def anchor(self, step: Step, estimate: Estimate) -> Anchor:
        """Anchor from which the newest estimate is propagated; ask before the next event is used."""
        assert self.anchors is not None
        return self.anchors.make(step, estimate)

    def _take_over(self, parts: Assembly, state: RunState) -> None:
        """Start from the state of an earlier run, but for its pose, which waits for the first step."""
        localizer, gyro = parts.localizer, parts.localizer.motion.sources.gyro
        known = resumed_installation(state.installation, localizer.factors.installation)
        if known is not None:
            localizer.factors.estimated = known
        if gyro is not None and state.gyro is not None:
            gyro.resume(state.gyro.bias, state.gyro.bias_variance)
        for landmark_id, displacement in state.excluded.items():
            localizer.sightings.modes.displacements[landmark_id] = np.array(displacement)
        self._fastest = state.fastest

    def snapshot(self) -> RunState | None:
        """State to be saved; None while no pose is known."""
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
            pose=se2.triple(estimate.pose),
            cov=matrix3(_body_cov(estimate)),
            mode=estimate.mode,
            fastest=self._fastest,
            twist=se2.triple(twist),
            installation=InstallationState(
                names=localizer.factors.installation.names,
                mean=tuple(installed.mean.tolist()),
                cov=tuple(tuple(row) for row in installed.cov.tolist()),
                gates=dict(localizer.factors.installation.gates),
            ),
            gyro=None if gyro is None else GyroState(bias=gyro.bias, bias_variance=gyro.bias_variance),
            odometry=None if self._odometry is None else odometry_state(self._odometry),
            excluded={i: (float(d[0]), float(d[1])) for i, d in moved.items()},
        )

    @property
    def rejections(self) -> Counter[str]:
        """Number of rejected events and parts of them, by reason."""
        now = Counter() if self.parts is None else self.parts.rejections
        return self._past_rejections + now + Counter({"transform.too_many_frames": self.facts.left_out})

    def comparison(self) -> Callable[[], None] | None:
        """Function that compares the signals so far, takes a second or two and may run in any thread; None: not due."""
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
                *note("motion.model", self.parts.localizer.motion.mistakes, Severity.ERROR),
                *diagnosis.found,
                *note("run", self.parts.sentences),
            ]
        )


def _body_cov(estimate: Estimate) -> FloatArray:
    cov = se2.rotate_cov(estimate.cov, -float(estimate.pose[2]))
    return np.asarray(0.5 * (cov + cov.T))
