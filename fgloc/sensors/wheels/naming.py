"""Which drive a robot has, by the names of its joints and by how they turn: for the first settings."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fgloc.sensors.wheels.events import JointsEvent, OdometryEvent
from fgloc.types import ControlEvent, FloatArray

_FRONT, _REAR = (
    re.compile(r"(?<![a-z])(front|f|fl|fr)(?![a-z])", re.I),
    re.compile(r"(?<![a-z])(rear|back|b|r|rl|rr|bl|br)(?![a-z])", re.I),
)
_LEFT, _RIGHT = (
    re.compile(r"(?<![a-z])(left|l|fl|rl|bl)(?![a-z])", re.I),
    re.compile(r"(?<![a-z])(right|fr|rr|br)(?![a-z])", re.I),
)
_BEHIND = re.compile(r"(?<![a-z])(rear|back|left|right|rl|rr|bl|br)(?![a-z])", re.I)  # of a wheel that does not steer
_SIDES = (
    re.compile(r"(?<![a-z])(left|l)(?![a-z])|left.*wheel|wheel.*left", re.I),
    re.compile(r"(?<![a-z])(right|r)(?![a-z])|right.*wheel|wheel.*right", re.I),
)
_STEERING = re.compile(r"steer", re.I)
_DIAGONAL = 0.1  # share of four wheels' motion in which diagonal ones turn alike, against the others: rollers
_SIDE = 0.02  # likewise that tells wheels of one side from one another: below it they turn alike
_FEWEST = 50  # samples
_NAMED_BY = 100  # messages whose joints are looked at: arm and wheels may take turns on a topic
_ASIDE, _MOVES = 0.1, 0.05  # share of moving samples that go more sideways than ahead; m/s
TICKS = "ticks_per_turn:  # positions are ticks: so many a turn of the wheel, or of the motor with radius over the gear"


@dataclass(frozen=True, slots=True)
class NamedDrive:
    """Drive that a recording shows.

    Attributes:
        kind: as `wheels.drive` has it.
        why: evidence, in a sentence.
        lines: keys of `wheels.drive` below its kind, those to be filled in without a value.
    """

    kind: str
    why: str
    lines: tuple[str, ...]


def by_side(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Names of the left and of the right: those that hold the word or the letter by itself, a wheel's also within."""
    left, right = ({name for name in names if side.search(name)} for side in _SIDES)
    return [name for name in names if name in left - right], [name for name in names if name in right - left]


def joint_names(joints: Sequence[JointsEvent]) -> tuple[str, ...]:
    """Names of the joints in the first messages, in their order."""
    return tuple(dict.fromkeys(name for event in joints[:_NAMED_BY] for name in event.names))


def goes_sideways(told: Sequence[Sequence[float]]) -> float | None:
    """Share of the moving samples in which a robot goes more sideways than ahead; None: hardly ever, or nearly always.

    One that never goes ahead has its axes turned.

    Args:
        told: rows of vx, vy [m/s].
    """
    rows = np.asarray(told, dtype=float).reshape(-1, 2)
    speed = np.hypot(*rows.T)
    moving = speed > _MOVES  # not those that are no numbers
    if moving.sum() < _FEWEST:
        return None
    share = float(np.mean(np.abs(rows[moving, 1]) > 0.707 * speed[moving]))
    return share if _ASIDE < share < 1.0 - _ASIDE else None


def count_ticks(joints: Sequence[JointsEvent], names: Sequence[str]) -> bool:
    """Whether these joints report ticks: whole numbers only while they move, which no angle in radians is."""
    angles = _values(joints, names, "position") if names else np.empty((0, 0))
    moved = np.count_nonzero(np.diff(angles, axis=0).any(axis=1))
    return bool(moved >= _FEWEST and (angles == np.rint(angles)).all())


def name_drive(
    joints: Sequence[JointsEvent], odometry: Sequence[OdometryEvent], commands: Sequence[ControlEvent]
) -> NamedDrive | None:
    """Drive with more than two wheels that joints show; None: they show none, or do not tell which.

    Where positions are ticks, its lines have the ticks of a turn.
    """
    names = joint_names(joints)
    steering = [name for name in names if _STEERING.search(name)]
    wheels = [name for name in names if name not in steering and not re.search("arm|gripper|head", name, re.I)]
    wheels = [name for name in wheels if "wheel" in name.lower()] or wheels
    drive = _named(joints, wheels, steering, odometry, commands)
    if drive is None:
        return None
    ticks = ((wheels, TICKS), (steering, "steering_ticks:  # a turn of the steering's encoder"))
    return replace(drive, lines=(*drive.lines, *(line for of, line in ticks if count_ticks(joints, of))))


def _named(
    joints: Sequence[JointsEvent],
    wheels: Sequence[str],
    steering: Sequence[str],
    odometry: Sequence[OdometryEvent],
    commands: Sequence[ControlEvent],
) -> NamedDrive | None:
    """Drive by the names of wheels and steering, and by how they move."""
    if len(steering) > 2 and len(wheels) == len(steering):
        lists = _list("wheels", wheels), _list("steering_joints", steering)
        why = f"each of {len(wheels)} wheels has a steering joint"
        return NamedDrive("swerve", why, (*lists, "radius:  # m", "places:  # m: [[x, y], ...], in the same order"))
    if len(steering) == len(wheels) == 1 and not _BEHIND.search(_words(wheels[0])) and wheels != ["speed"]:
        why = (
            f"{steering[0]} steers and {wheels[0]} drives; if that wheel is not the one that steers, the kind is "
            "ackermann, with wheels and steering_joints as lists"
        )
        keys = (f"wheel: {wheels[0]}", f"steering_joint: {steering[0]}", "radius:  # m", "wheelbase:  # m")
        return NamedDrive("tricycle", why, keys)
    if steering and wheels:
        rear = [name for name in wheels if not _FRONT.search(_words(name))] or wheels
        left_first = sorted(steering, key=lambda name: bool(_RIGHT.search(_words(name))))
        measured = (_list("wheels", rear), _list("steering_joints", left_first), "radius:  # m")
        keys = (*(measured if wheels != ["speed"] else ()), "wheelbase:  # m")  # a speed is the default
        return NamedDrive("ackermann", f"steered by {' and '.join(steering)}", keys)
    placed = [
        [name for name in wheels if end.search(_words(name)) and side.search(_words(name))]
        for end in (_FRONT, _REAR)
        for side in (_LEFT, _RIGHT)
    ]
    if [len(found) for found in placed] != [1, 1, 1, 1]:
        return _by_motion(wheels, odometry, commands)
    corner = [found[0] for found in placed]  # front left, front right, rear left, rear right
    return _four(joints, corner)


def _words(name: str) -> str:
    return re.sub(r"[_\-/.]|joint|wheel|motor", " ", name, flags=re.I)


def _list(key: str, names: Sequence[str]) -> str:
    return f"{key}: [{', '.join(names)}]"


def _four(joints: Sequence[JointsEvent], corner: Sequence[str]) -> NamedDrive | None:
    """Four wheels at the corners: rollers where diagonal ones turn alike, else two sides."""
    rates = np.diff(_values(joints, corner, "position"), axis=0)
    if not len(rates):
        rates = _values(joints, corner, "velocity")
    total = float(np.sum(rates**2))
    if len(rates) < _FEWEST or total <= 0.0:
        return None
    fl, fr, rl, rr = rates.T
    across = float(np.sum((fl - fr - rl + rr) ** 2)) / 4.0 / total
    if across > _DIAGONAL:
        share = math.sqrt(across)
        why = f"{share:.0%} of the wheels' motion is alike across the diagonals, as that of rollers going sideways"
        half_sum = "half_sum:  # m: half the wheelbase and half the track, added"
        return NamedDrive("mecanum", why, (_list("wheels", corner), "radius:  # m", half_sum))
    if across < _SIDE:
        why = "the wheels of each side turn alike; rollers that never went sideways would, too (kind mecanum)"
        sides = _list("left", corner[::2]), _list("right", corner[1::2])
        return NamedDrive("skid_steer", why, (*sides, "radius:  # m", "track:  # m"))
    return None


def _values(joints: Sequence[JointsEvent], names: Sequence[str], what: Literal["position", "velocity"]) -> FloatArray:
    """Rows ``(n, joints)`` of what these joints report, where all of them do."""
    table = np.array([event.of(names, what) for event in joints], dtype=float).reshape(-1, len(names))
    return np.asarray(table[np.isfinite(table).all(axis=1)])


def _by_motion(
    wheels: Sequence[str], odometry: Sequence[OdometryEvent], commands: Sequence[ControlEvent]
) -> NamedDrive | None:
    """Three or more wheels in no known places, of a robot that goes sideways."""
    share = goes_sideways([e.linear[:2].tolist() for e in odometry] or [(c.v, c.vy) for c in commands])
    if share is None or len(wheels) < 3:
        return None
    places = "angles_deg:  # of each wheel, to the left from ahead"
    why = f"the robot goes sideways in {share:.0%} of its motion"
    return NamedDrive("omni", why, (_list("wheels", wheels), "radius:  # m", "ring:  # m", places))
