"""Recordings of others with one thing changed, as it happens on robots: `changed` for `benchmarks.field`.

A change edits the messages of a window of a recording (stamps, values, or which are there), or its map; never the
truth.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from benchmarks.common import stamp_of
from benchmarks.field_recordings import Recording
from fgloc import se2
from fgloc.frames import quaternion_yaw, yaw_quaternion
from fgloc.recording.messages import default_typestore
from fgloc.sensors.maps import load_map, write_map
from fgloc.types import LandmarkMap

_S = 1_000_000_000
_SIGHTINGS = ("LandmarkArray", "MarkerArray")
_COMMANDS = ("Twist", "TwistStamped")


@dataclass(slots=True)
class Heard:
    """One message: topic, name of its type without the package, receive time [ns], content."""

    topic: str
    kind: str
    received: int
    message: Any


Messages = list[Heard]
Change = Callable[[Messages, random.Random], Messages]


def changed(recording: Recording, name: str, seed: int) -> Recording:
    """A recording after the change of this name (a key of `CHANGES` or `MAPS`)."""
    make = partial(_changed, recording, name, seed)
    part = replace(recording, name=f"{recording.name}_{name}_{seed}", make=make, map="", development=True)
    return replace(part, frame="se2") if name == "map_turned" else part


def _changed(recording: Recording, name: str, seed: int, _: Path, out: Path) -> None:
    rng = random.Random(f"{name} {seed}")
    with TemporaryDirectory() as scratch:
        bag = recording.bag(Path(scratch))
        found = recording.map_path(Path(scratch))
        with AnyReader([bag], default_typestore=default_typestore()) as reader:
            messages = [
                Heard(c.topic, c.msgtype.split("/")[-1], received, reader.deserialize(raw, c.msgtype))
                for c, received, raw in reader.messages()
            ]
            types = {c.topic: c.msgtype for c in reader.connections}
            store = reader.typestore
            if name in CHANGES:
                truth = [m for m in messages if m.topic == recording.truth]
                others = CHANGES[name]([m for m in messages if m.topic != recording.truth], rng)
                messages = sorted([*truth, *others], key=lambda m: m.received)
            with Writer(out / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                topics = {t: writer.add_connection(t, kind, typestore=store) for t, kind in types.items()}
                for m in messages:
                    writer.write(topics[m.topic], m.received, store.serialize_cdr(m.message, types[m.topic]))
        if found is not None:
            landmarks = load_map(found)
            write_map(MAPS[name](landmarks, rng) if name in MAPS else landmarks, out / "map.yaml")


# --- which messages are there, and when -----------------------------------------------------------------------------


def _moment(messages: Messages, rng: random.Random) -> int:
    begin, end = messages[0].received, messages[-1].received
    return begin + round(rng.uniform(0.4, 0.7) * (end - begin))


def _without(kinds: tuple[str, ...] | None, seconds: float) -> Change:
    """No message of these kinds (None: of any) for a time in the middle."""

    def change(messages: Messages, rng: random.Random) -> Messages:
        at = _moment(messages, rng)
        return [
            m for m in messages if not (at <= m.received < at + seconds * _S and (kinds is None or m.kind in kinds))
        ]

    return change


def _every(kinds: tuple[str, ...], n: int) -> Change:
    def change(messages: Messages, _: random.Random) -> Messages:
        counts: dict[str, int] = {}
        out = []
        for m in messages:
            counts[m.topic] = counts.get(m.topic, -1) + 1
            if m.kind not in kinds or counts[m.topic] % n == 0:
                out.append(m)
        return out

    return change


def _some_lost(messages: Messages, rng: random.Random) -> Messages:
    return [m for m in messages if "static" in m.topic or rng.random() > 0.3]


def _twice(messages: Messages, _: random.Random) -> Messages:
    return [one for m in messages for one in (m, replace(m, received=m.received + 1_000_000))]


def _late(kinds: tuple[str, ...], seconds: float) -> Change:
    """Messages arrive later; their stamps are right."""

    def change(messages: Messages, _: random.Random) -> Messages:
        return [replace(m, received=m.received + round(seconds * _S)) if m.kind in kinds else m for m in messages]

    return change


def _stamped(kinds: tuple[str, ...], seconds: float, jump: bool = False) -> Change:
    """Stamps of these kinds are off; ``jump``: from a moment on."""

    def change(messages: Messages, rng: random.Random) -> Messages:
        since = _moment(messages, rng) if jump else 0
        for header in (h for m in messages if m.kind in kinds and m.received >= since for h in _headers(m.message)):
            total = stamp_of(header) + round(seconds * _S)
            header.stamp.sec, header.stamp.nanosec = total // _S, total % _S
        return messages

    return change


def _headers(message: Any) -> list[Any]:
    """Headers of a message and of the markers in it."""
    parts = (message, *getattr(message, "markers", ()))
    return [part.header for part in parts if hasattr(part, "header")]


def _jittered(messages: Messages, rng: random.Random) -> Messages:
    return [
        m if "static" in m.topic else replace(m, received=m.received + rng.randrange(200_000_000)) for m in messages
    ]


def _unstamped(messages: Messages, _: random.Random) -> Messages:
    for m in messages:
        for header in _headers(m.message):
            header.stamp.sec, header.stamp.nanosec = 0, 0
    return messages


# --- odometry -------------------------------------------------------------------------------------------------------


def _poses(messages: Messages) -> tuple[list[Heard], np.ndarray]:
    own = [m for m in messages if m.kind == "Odometry"]
    return own, np.array([_pose(m.message.pose.pose) for m in own])


def _pose(pose: Any) -> list[float]:
    q = pose.orientation
    return [pose.position.x, pose.position.y, quaternion_yaw(np.array([q.x, q.y, q.z, q.w]))]


def _set(pose: Any, to: Any) -> None:
    x, y, yaw = (float(v) for v in to)
    pose.position.x, pose.position.y = x, y
    q = pose.orientation
    q.x, q.y, q.z, q.w = (float(v) for v in yaw_quaternion(yaw))


def _steps(edit: Callable[[int, np.ndarray], np.ndarray]) -> Change:
    """Odometry whose motions from message to message, and twists alike, are edited: ``edit(received, step)``.

    Commands in its place: their twist.
    """

    def change(messages: Messages, _: random.Random) -> Messages:
        own, poses = _poses(messages)
        pose = poses[0] if len(poses) else np.zeros(3)
        for k, m in enumerate(own):
            if k:
                pose = se2.compose(pose, edit(m.received, se2.between(poses[k - 1], poses[k])))
            _set(m.message.pose.pose, pose)
            _set_twist(m.message.twist.twist, m.received, edit)
        if not own:
            for m in messages:
                if m.kind in _COMMANDS:
                    _set_twist(m.message.twist if m.kind == "TwistStamped" else m.message, m.received, edit)
        return messages

    return change


def _set_twist(twist: Any, received: int, edit: Callable[[int, np.ndarray], np.ndarray]) -> None:
    to = edit(received, np.array([twist.linear.x, twist.linear.y, twist.angular.z]))
    twist.linear.x, twist.linear.y, twist.angular.z = (float(v) for v in to)


def _scaled(distance: float, turn: float) -> Change:
    return _steps(lambda _, step: step * np.array([distance, distance, turn]))


def _for_a_while(distance: float, turn: float, seconds: float) -> Change:
    """Wheels slip (or stand) for a time: motions are scaled."""

    def change(messages: Messages, rng: random.Random) -> Messages:
        at = _moment(messages, rng)
        factor = np.array([distance, distance, turn])
        return _steps(lambda t, step: step * factor if at <= t < at + seconds * _S else step)(messages, rng)

    return change


def _restarted(messages: Messages, rng: random.Random) -> Messages:
    """The driver restarts: its pose begins at zero again."""
    at = _moment(messages, rng)
    own, poses = _poses(messages)
    first = next((k for k, m in enumerate(own) if m.received >= at), None)
    for k, m in enumerate(own):
        if first is not None and k >= first:
            _set(m.message.pose.pose, se2.between(poses[first], poses[k]))
    return messages


def _pose_alone(messages: Messages, _: random.Random) -> Messages:
    for m in messages:
        if m.kind == "Odometry":
            _set_twist(m.message.twist.twist, 0, lambda _, twist: 0.0 * twist)
    return messages


def _twist_alone(messages: Messages, _: random.Random) -> Messages:
    for m in messages:
        if m.kind == "Odometry":
            _set(m.message.pose.pose, np.zeros(3))
    return messages


def _turned_base(angle: float) -> Change:
    """Odometry of a base whose x axis points elsewhere."""

    def change(messages: Messages, _: random.Random) -> Messages:
        own, poses = _poses(messages)
        base = np.array([0.0, 0.0, angle])
        for m, pose in zip(own, poses, strict=True):
            _set(m.message.pose.pose, se2.compose(pose, base))
            t = m.message.twist.twist
            x, y = t.linear.x, t.linear.y
            c, s = math.cos(angle), math.sin(angle)
            t.linear.x, t.linear.y = c * x + s * y, -s * x + c * y
        return messages

    return change


# --- sightings -------------------------------------------------------------------------------------------------------


def _each(edit: Callable[[Any, random.Random], None]) -> Change:
    def change(messages: Messages, rng: random.Random) -> Messages:
        for m in messages:
            if m.kind in _SIGHTINGS:
                for one in _sighted(m):
                    edit(one, rng)
        return messages

    return change


def _sighted(m: Heard) -> list[Any]:
    return list(m.message.landmarks if m.kind == "LandmarkArray" else m.message.markers)


def _ids(messages: Messages) -> list[int]:
    return sorted({int(one.id) for m in messages if m.kind in _SIGHTINGS for one in _sighted(m)})


def _misread(share: float) -> Change:
    def change(messages: Messages, rng: random.Random) -> Messages:
        ids = _ids(messages)

        def edit(one: Any, rng: random.Random) -> None:
            if ids and rng.random() < share:
                one.id = rng.choice(ids)

        return _each(edit)(messages, rng)

    return change


def _seen(distance: float = 1.0, turn: float = 0.0, noise: float = 0.0, wild: float = 0.0) -> Change:
    """Distances scaled; bearings turned; noise relative to the distance; a share of wild sightings."""

    def edit(one: Any, rng: random.Random) -> None:
        if hasattr(one, "range"):
            r = float(one.range) * (distance + rng.gauss(0.0, noise))
            b = float(one.bearing) + turn + rng.gauss(0.0, noise)
            if rng.random() < wild:
                r, b = r * rng.uniform(0.5, 2.0), b + rng.uniform(-0.7, 0.7)
            one.range, one.bearing = r, b
            return
        p = one.pose.pose.position  # the axis that is up is not known: a pose is not turned
        k = distance + rng.gauss(0.0, noise)
        if rng.random() < wild:
            k *= rng.uniform(0.5, 2.0)
        p.x, p.y, p.z = p.x * k, p.y * k, p.z * k

    return _each(edit)


def _nameless(messages: Messages, rng: random.Random) -> Messages:
    """Half of the ids are others: the map lacks them."""
    ids = _ids(messages)
    hidden = set(rng.sample(ids, len(ids) // 2))

    def edit(one: Any, _: random.Random) -> None:
        if int(one.id) in hidden:
            one.id = int(one.id) + 100

    return _each(edit)(messages, rng)


# --- maps ------------------------------------------------------------------------------------------------------------


def _moved_landmark(landmarks: LandmarkMap, rng: random.Random) -> LandmarkMap:
    key = rng.choice(sorted(landmarks.landmarks))
    return _with(landmarks, {key: np.array([0.5, 0.3, 0.0])})


def _two_exchanged(landmarks: LandmarkMap, rng: random.Random) -> LandmarkMap:
    a, b = rng.sample(sorted(landmarks.landmarks), 2)
    between = landmarks.landmarks[b].position - landmarks.landmarks[a].position
    return _with(landmarks, {a: between, b: -between})


def _rough(landmarks: LandmarkMap, rng: random.Random) -> LandmarkMap:
    return _with(
        landmarks,
        {k: np.array([rng.gauss(0.0, 0.1), rng.gauss(0.0, 0.1), 0.0]) for k in landmarks.landmarks},
    )


def _map_turned(landmarks: LandmarkMap, _: random.Random) -> LandmarkMap:
    c, s = math.cos(2.0), math.sin(2.0)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return _with(
        landmarks,
        {k: R @ one.position + np.array([40.0, -25.0, 0.0]) - one.position for k, one in landmarks.landmarks.items()},
    )


def _mirrored(landmarks: LandmarkMap, _: random.Random) -> LandmarkMap:
    return _with(landmarks, {k: np.array([0.0, -2.0 * one.position[1], 0.0]) for k, one in landmarks.landmarks.items()})


def _half(landmarks: LandmarkMap, rng: random.Random) -> LandmarkMap:
    kept = rng.sample(sorted(landmarks.landmarks), (len(landmarks.landmarks) + 1) // 2)
    return replace(landmarks, landmarks={k: landmarks.landmarks[k] for k in kept})


def _with(landmarks: LandmarkMap, by: dict[int, np.ndarray]) -> LandmarkMap:
    out = dict(landmarks.landmarks)
    for k, offset in by.items():
        out[k] = replace(out[k], position=out[k].position + offset)
    return replace(landmarks, landmarks=out)


CHANGES: dict[str, Change] = {
    "all_gone_8s": _without(None, 8.0),
    "odometry_gone_3s": _without(("Odometry", *_COMMANDS), 3.0),
    "landmarks_gone_20s": _without(_SIGHTINGS, 20.0),
    "odometry_slow": _every(("Odometry",), 4),
    "landmarks_slow": _every(_SIGHTINGS, 8),
    "some_lost": _some_lost,
    "twice": _twice,
    "landmarks_late": _late(_SIGHTINGS, 0.6),
    "landmarks_stamped_late": _stamped(_SIGHTINGS, 0.3),
    "odometry_stamped_late": _stamped(("Odometry",), 0.3),
    "landmarks_clock": _stamped(_SIGHTINGS, 7200.0),
    "odometry_clock_steps": _stamped(("Odometry",), 1.0, jump=True),
    "jittered": _jittered,
    "unstamped": _unstamped,
    "far": _scaled(1.25, 1.0),
    "turns": _scaled(1.0, 1.15),
    "mirrored_turns": _scaled(1.0, -1.0),
    "backwards": _scaled(-1.0, 1.0),
    "slip": _for_a_while(2.0, 1.0, 3.0),
    "spin": _for_a_while(1.0, 3.0, 2.0),
    "stuck": _for_a_while(0.0, 0.0, 3.0),
    "restarted": _restarted,
    "pose_alone": _pose_alone,
    "twist_alone": _twist_alone,
    "base_turned": _turned_base(0.5 * math.pi),
    "misread": _misread(0.05),
    "noisy": _seen(noise=0.08),
    "wild": _seen(wild=0.1),
    "ranges_long": _seen(distance=1.12),
    "bearings_turned": _seen(turn=0.12),
    "sensor_turned": _seen(turn=0.5 * math.pi),
    "bearings_mirrored": _each(
        lambda one, _: setattr(one, "bearing", -one.bearing) if hasattr(one, "bearing") else None
    ),
    "nameless": _nameless,
}
MAPS: dict[str, Callable[[LandmarkMap, random.Random], LandmarkMap]] = {
    "one_moved": _moved_landmark,
    "two_exchanged": _two_exchanged,
    "rough": _rough,
    "map_turned": _map_turned,
    "map_mirrored": _mirrored,
    "map_half": _half,
}
