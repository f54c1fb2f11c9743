"""The facts of a live stream, gathered from its first messages."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from fgloc.config import Config, Role, role_names
from fgloc.recording.transforms import FrameTree
from fgloc.sensor_setup import base_frame, camera_frame, given_pose
from fgloc.sensors import registry
from fgloc.types import Camera, CameraInfoEvent, Event, RawEvent, SightingsEvent, TransformEvent, TruthEvent


def role_of(event: Event) -> Role | None:
    """Role of an event's topic; None if it needs none."""
    if isinstance(event, CameraInfoEvent | TruthEvent):
        return "camera_info" if isinstance(event, CameraInfoEvent) else "truth"
    return registry.role_of_event(event)


_MOTION: frozenset[Role] = frozenset({"odometry", "joints", "command", "imu"})
_WITH_CAMERA: frozenset[Role] = frozenset({"image", "sightings"})
_NOT_BUILT_FROM: frozenset[Role] = frozenset({"camera_info", "truth"})


class LiveFacts:
    """What has come in so far, as `fgloc.sensor_setup.StreamFacts` has it.

    A role counts as there once everything is known that its sensor is built from: for images and marker corners, the
    calibration and the mounting of the camera too.

    Attributes:
        roles: topic of each role that is there.
    """

    name = "the live stream"

    def __init__(self, config: Config, expected: Collection[Role] | None, camera: Camera | None) -> None:
        """Take the roles that are to be waited for (None: whatever comes), and the camera if it is known already."""
        self.camera = camera
        self.roles: dict[Role, str] = {}
        self._seen: dict[type[Event], Event] = {}
        self.image_size: tuple[int, int] | None = None
        self.expected = None if expected is None else frozenset(expected) - _NOT_BUILT_FROM
        self._config = config
        self._topics: dict[Role, str] = {}  # the first topic of each role; others are not used
        self._transforms: dict[tuple[str, str], list[TransformEvent]] = {}
        self._frames: FrameTree | None = None
        self._incomplete = False  # a role has come in that lacks something

    def topic_is_used(self, event: Event) -> bool:
        """Whether the event is of the one topic that plays its role: the configured one, else the first."""
        role = role_of(event)
        if role is None:
            return True
        given: str | None = getattr(self._config.recording.topics, role)
        if given == "none" or given not in (None, event.topic):
            return False
        return self._topics.setdefault(role, event.topic) == event.topic

    def is_configured(self, event: Event) -> bool:
        """Whether the configuration names the topic that plays the event's role, or none."""
        role = role_of(event)
        return role is not None and getattr(self._config.recording.topics, role) is not None

    @property
    def first(self) -> Mapping[type[Event], Event]:
        """The first event of each kind whose role is there."""
        return {kind: event for kind, event in self._seen.items() if self.is_there(event)}

    def is_there(self, event: Event) -> bool:
        """Whether all is known that is needed to use an event."""
        role = role_of(event)
        return role is None or role in _NOT_BUILT_FROM or role in self.roles

    def is_news(self, event: Event) -> bool:
        """Whether the event may tell what the run is not yet built from."""
        return self._incomplete or type(event) not in self._seen

    def note(self, event: Event) -> bool:
        """Take in an event; whether a role is there now that was not before."""
        if isinstance(event, TransformEvent):
            self._add_transform(event)
        else:
            self._seen.setdefault(type(event), event)
        if isinstance(event, RawEvent) and self.image_size is None:
            self.image_size = event.decoded_size()
            if self.image_size is None:
                return False
        before = len(self.roles)
        for role, topic in self._topics.items():
            if role not in self.roles and role not in _NOT_BUILT_FROM and not self._missing(role):
                self.roles[role] = topic
        self._incomplete = any(r not in self.roles and r not in _NOT_BUILT_FROM for r in self._topics)
        return len(self.roles) > before

    def waiting_for(self) -> tuple[str, ...]:
        """What is missing, a phrase each."""
        missing = []
        for role in role_names():
            if role in self.roles or role in _NOT_BUILT_FROM:
                continue
            if role in self._topics:
                missing.append(f"{role} ({self._topics[role]}): {self._missing(role)}")
            elif self.expected is not None and role in self.expected:
                missing.append(f"{role}: no message yet")
        if not _MOTION & set(self.roles):
            missing.append("a motion source: odometry, joints, command or imu")
        return tuple(missing)

    def complete(self, waited_s: float, patience_s: float) -> bool:
        """Whether the parts of the run can be built: all that is expected is there, or was waited for long enough."""
        if not _MOTION & set(self.roles):
            return False
        if self.expected is not None and self.expected <= set(self.roles):
            return True
        return waited_s >= patience_s

    @property
    def topics(self) -> str:
        """All topics with their roles."""
        return ", ".join(f"{topic} ({role})" for role, topic in self._topics.items()) or "none"

    @property
    def frames(self) -> FrameTree:
        """All transforms so far."""
        if self._frames is None:
            self._frames = FrameTree(t for same in self._transforms.values() for t in same)
        return self._frames

    def _missing(self, role: Role) -> str:
        """What the sensor of a role cannot be built without; "" if it is all there."""
        in_pixels = role == "sightings" and any(
            e.in_pixels for e in self._seen.values() if isinstance(e, SightingsEvent)
        )
        if role not in _WITH_CAMERA or self.camera is not None or not (role == "image" or in_pixels):
            return ""
        if CameraInfoEvent not in self._seen and self._config.camera.file is None:
            return "no CameraInfo yet, and no camera.file"
        if given_pose(self._config, "optical") is not None:
            return ""
        frame = camera_frame(self._seen)
        base = base_frame(self, self._config, self.first)
        if frame.lstrip("/") != base.lstrip("/") and not (frame in self.frames and base in self.frames):
            return f"no transform from {base} to {frame!r} yet, and no recording.sightings_pose"
        return ""

    def _add_transform(self, event: TransformEvent) -> None:
        """Keep of each pair of frames the first transform, and one that differs: the pair moves."""
        same = self._transforms.setdefault((event.parent, event.child), [])
        if len(same) > 1 or (same and _equal(same[0], event)):
            return
        same.append(event)
        self._frames = None


def _equal(a: TransformEvent, b: TransformEvent) -> bool:
    return bool(np.array_equal(a.translation, b.translation) and np.array_equal(a.rotation, b.rotation))
