"""The wheels as a sensor: their topics, settings and failures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from fgloc.config import Config
from fgloc.errors import ConfigError
from fgloc.frames import quaternion_yaw
from fgloc.sensors.base import (
    Asked,
    BuiltIn,
    Channel,
    FirstLook,
    FirstSection,
    FirstSettings,
    Mounting,
    Question,
    RawMistake,
    Signal,
    Stream,
    WheelJoints,
    of_stamps,
    seconds,
    with_values,
)
from fgloc.sensors.wheels import failures
from fgloc.sensors.wheels.driven import wheel_names
from fgloc.sensors.wheels.events import (
    JointsEvent,
    OdometryChecks,
    OdometryEvent,
    from_ackermann,
    from_joints,
    joints_validator,
    odometry_converters,
    odometry_validator,
)
from fgloc.sensors.wheels.motion import INSTALLATION
from fgloc.sensors.wheels.naming import TICKS, NamedDrive, by_side, count_ticks, joint_names, name_drive
from fgloc.types import ControlEvent, Event, FloatArray

if TYPE_CHECKING:
    from fgloc.config import WheelsConfig


def _effort(events: Sequence[JointsEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """Torque [Nm] of both wheels together, and of the right less the left."""
    if mounting.joints is None:
        return None
    stamps, (left, right) = _pairs(events, mounting.joints, "effort")
    return of_stamps(stamps, np.array([right + left, right - left]), origin_ns)


def _motion(events: Sequence[JointsEvent], origin_ns: int, mounting: Mounting) -> Signal | None:
    """V [m/s] and ω [rad/s] by the angles or, where the joints report none, by the rates."""
    joints = mounting.joints
    if joints is None or joints.left_radius is None or joints.right_radius is None or joints.track is None:
        return None
    stamps, pair = _pairs(events, joints, "position")
    of_angles = len(stamps) > 1
    if not of_angles:
        stamps, pair = _pairs(events, joints, "velocity")
    left, right = joints.left_radius * pair[0], joints.right_radius * pair[1]
    body = np.array([0.5 * (left + right), (right - left) / joints.track])
    return Signal(seconds(stamps, origin_ns), body) if of_angles else of_stamps(stamps, body, origin_ns)


def _pairs(events: Sequence[JointsEvent], joints: WheelJoints, what: str) -> tuple[list[int], FloatArray]:
    """Stamps and values ``(2, n)`` of the left and the right wheel, where both are known."""
    stamps: list[int] = []
    values: list[FloatArray] = [np.empty((0, 2))]
    for names, group in groupby(events, key=lambda event: event.names):
        pair = wheel_names(names, joints.left, joints.right) or ("", "")
        at = [names.index(name) for name in pair if name in names]
        reported = [(event.stamp_ns, getattr(event, what)) for event in group]
        reported = [(stamp, found) for stamp, found in reported if len(found) == len(names)]
        if len(at) == 2 and reported:
            stamps += [stamp for stamp, _ in reported]
            values.append(np.array([found for _, found in reported])[:, at])
    both = np.concatenate(values)
    known = np.flatnonzero(np.isfinite(both).all(axis=1)).tolist()
    return [stamps[k] for k in known], both[known].T


CHANNELS = (
    Channel("effort", 2, 1, JointsEvent, _effort, needs_joints=True),
    Channel("wheels", 2, 2, JointsEvent, _motion, needs_joints=True, needs_geometry=True),
)


_FEWEST = 50  # messages of each, for a fit
_FITS = 0.98  # share of the odometry's variance that the wheels must explain
_CAUCHY, _ITERATIONS = 3.5, 5  # median absolute deviations beyond which a residual counts less: 95 % efficiency
_LEAST_TURNING = 0.05  # rad/s: standard deviation of the yaw rate below which the track does not show
_WINDOW_S = 0.3  # over which rates are means: stamps of single messages jitter
_STEADY_S = 1.0  # after a command: by then the wheels turn as they are told
_ASKEW = 0.01  # rad: a pose whose heading is off its way by more has the heading from elsewhere
_ALIKE = 0.05  # relative spread of the track that commands give at different times


@dataclass(frozen=True, slots=True)
class WheelPair:
    """Joints of the left and the right wheel."""

    left: str
    right: str


_SIGNS = ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))  # of counts of the left and the right wheel


@dataclass(frozen=True, slots=True)
class WheelGeometry:
    """Nominal values [m], as the robot's driver has them.

    Attributes:
        radii_m: of the left and the right wheel, alike; negative where the joint counts backwards.
        track_m: between them.
        by_commands: the track is that of the commands: the odometry's turn is not the wheels'.
    """

    radii_m: tuple[float, float]
    track_m: float
    by_commands: bool = False


def wheel_pair(names: Sequence[str]) -> WheelPair | None:
    """The joints that are the left and right wheel by their names; None if that is not clear."""
    left, right = by_side([name for name in names if "wheel" in name.lower()] or names)
    return WheelPair(left[0], right[0]) if len(left) == len(right) == 1 else None


def fit_geometry(
    pair: WheelPair,
    joints: Sequence[JointsEvent],
    odometry: Sequence[OdometryEvent],
    commands: Sequence[ControlEvent] = (),
) -> WheelGeometry | None:
    """Radius and track with which the wheels' angles give the driver's motion; None if they do not explain it.

    The odometry gives the radius, and the track unless its turn is another sensor's; then the commands give it.

    Args:
        pair: which joints.
        joints: in the order of their stamps.
        odometry: of the same drive, likewise.
        commands: likewise.
    """
    angles = np.array([event.of((pair.left, pair.right), "position") for event in joints])
    stamps = np.array([event.stamp_ns for event in joints], dtype=np.int64)
    keep = np.flatnonzero(np.diff(stamps, prepend=-1) > 0)
    if len(keep) < _FEWEST or len(odometry) < _FEWEST or not np.isfinite(angles[keep]).all():
        return None
    origin_ns = int(stamps[keep[0]])
    seconds, angles = (stamps[keep] - origin_ns) * 1e-9, angles[keep]
    later = np.minimum(np.searchsorted(seconds, seconds + _WINDOW_S), len(seconds) - 1)
    lasted = seconds[later] - seconds
    by_commands = None
    for at, gone in _paths(odometry, origin_ns):
        heard = np.searchsorted(at, seconds[later], side="right") - np.searchsorted(at, seconds)
        whole = (lasted > 0.5 * _WINDOW_S) & (lasted < 2.0 * _WINDOW_S) & (heard > 1)  # no silence in it
        if whole.sum() < _FEWEST:
            continue
        path = np.stack([np.interp(seconds, at, gone[:, k]) for k in range(2)], axis=1)
        rates, means = (((x[later] - x)[whole] / lasted[whole, None]) for x in (angles, path))
        for signs in _SIGNS:
            left, right = (rates * signs).T
            radius = _slope(0.5 * (left + right), means[:, 0])
            if radius is None:
                continue
            radii = (radius * signs[0], radius * signs[1])
            per_difference = _slope(right - left, means[:, 1]) if means[:, 1].std() > _LEAST_TURNING else None
            if per_difference is not None:
                return WheelGeometry(radii, radius / per_difference)
            commanded = _commanded(np.asarray(seconds[whole] + origin_ns * 1e-9), right - left, commands)
            if by_commands is None and commanded is not None:
                by_commands = WheelGeometry(radii, radius / commanded, by_commands=True)
    return by_commands


def _paths(odometry: Sequence[OdometryEvent], origin_ns: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Times ``(n,)`` [s] and way along the heading [m] and turn [rad] ``(n, 2)`` since the first, in order of time.

    First those of the poses, if they move where they head: the driver has summed them up from each of its readings, of
    which silences and twists at single times show a part only. Then those of the twists.
    """
    rows = [
        (e.stamp_ns - origin_ns, *e.position[:2], quaternion_yaw(e.orientation), e.linear[0], e.angular[2])
        for e in sorted(odometry, key=lambda e: e.stamp_ns)
    ]
    table = np.array(rows, dtype=float)
    table[:, 0] *= 1e-9
    for columns in ((1, 2, 3), (4, 5)):  # the gate refuses some
        known = table[np.isfinite(table[:, columns]).all(axis=1)]
        if len(known) < _FEWEST:
            continue
        at, told = known[:, 0], known[:, columns]
        if len(columns) == 2:
            steps = 0.5 * (told[1:] + told[:-1]) * np.diff(at)[:, None]
        else:
            turns = np.remainder(np.diff(told[:, 2]) + math.pi, math.tau) - math.pi
            heading = told[:-1, 2] + 0.5 * turns
            dx, dy = np.diff(told[:, :2], axis=0).T
            ahead, aside = np.cos(heading) * dx + np.sin(heading) * dy, np.cos(heading) * dy - np.sin(heading) * dx
            if abs(float(np.sign(ahead) @ aside)) > _ASKEW * float(np.abs(ahead).sum()):
                continue
            steps = np.column_stack([ahead, turns])
        yield at, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _commanded(times: FloatArray, difference: FloatArray, commands: Sequence[ControlEvent]) -> float | None:
    """Commanded yaw rate over the difference of the wheels' rates while a command holds; None: it is not constant."""
    if len(commands) < 2:
        return None
    at = np.array([event.stamp_ns * 1e-9 for event in commands])
    omega = np.array([event.omega for event in commands])
    since = at[np.append(True, np.diff(omega) != 0.0)]
    last = np.searchsorted(at, times, side="right") - 1
    held = times - since[np.maximum(np.searchsorted(since, times, side="right") - 1, 0)]
    turning = (last >= 0) & (held > _STEADY_S) & (times < at[np.maximum(last, 0)] + _STEADY_S)
    turning &= (np.abs(omega[np.maximum(last, 0)]) > _LEAST_TURNING) & (difference != 0.0)
    if turning.sum() < _FEWEST:
        return None
    ratios = omega[last[turning]] / difference[turning]
    ratio = float(np.median(ratios))
    return ratio if ratio > 0.0 and np.median(np.abs(ratios - ratio)) < _ALIKE * ratio else None


def settings_of(events: Sequence[Event]) -> dict[str, Any] | None:
    """Keys of the section `wheels` with which the angles of the wheels are used; None: they are not determined."""
    joints = [event for event in events if isinstance(event, JointsEvent)]
    pair = wheel_pair(joint_names(joints))
    odometry = [event for event in events if isinstance(event, OdometryEvent)]
    commands = [event for event in events if isinstance(event, ControlEvent)]
    found = None if pair is None else fit_geometry(pair, joints, odometry, commands)
    if pair is None or found is None:
        return None
    left, right = (float(f"{radius:.4g}") for radius in found.radii_m)
    return {
        "source": "ticks",
        "left_joint": pair.left,
        "right_joint": pair.right,
        "left_radius": left,
        "right_radius": right,
        "track": float(f"{found.track_m:.4g}"),
    }


def _slope(x: FloatArray, y: FloatArray) -> float | None:
    """Robust regression without offset; None if it is not positive or leaves too much of the squares.

    Messages that came late are outliers, and shorten the slope of least squares.
    """
    power = float(x @ x)
    if power <= 0.0 or float(y @ y) <= 0.0:
        return None
    slope = float(x @ y) / power
    left = float(((y - slope * x) ** 2).sum() / (y @ y))
    for _ in range(_ITERATIONS):
        residual = np.abs(y - slope * x)
        moving = np.abs(x) > 0.1 * np.abs(x).max()
        weights = 1.0 / (1.0 + (residual / (_CAUCHY * float(np.median(residual[moving])) + 1e-9)) ** 2)
        slope = float((weights * x) @ y) / float((weights * x) @ x)
    return slope if slope > 0.0 and left < 1.0 - _FITS else None


def _first_section(look: FirstLook) -> FirstSection:
    """Joints, radii and track, as far as the recording shows them."""
    joints, odometry, commands = look.of(JointsEvent), look.of(OdometryEvent), look.of(ControlEvent)
    names = joint_names(joints)
    if look.wheels:
        return FirstSection(look.wheels)
    if not names and not odometry and any(command.steering is not None for command in commands):
        why = "commands give a steering angle, and nothing else measures motion"
        missing = (
            f"the wheelbase, since {why}: fill in wheels.drive, which is in the file as a comment (docs/drives.md)"
        )
        lines = _drive_to_fill_in(NamedDrive("ackermann", why, ("wheelbase:  # m",)))
        return FirstSection((*lines, "#   source: command  # commands stand in for wheels"), (missing,))
    if not names:
        return FirstSection()
    pair = wheel_pair(names)
    geometry = None if pair is None or not odometry else fit_geometry(pair, joints, odometry, commands)
    head = f"# Joints in the recording: {', '.join(names)}."
    if pair is not None and geometry is not None:
        return FirstSection((head, *_found(pair, geometry)))
    drive = name_drive(joints, odometry, commands)
    if drive is None and pair is not None and count_ticks(joints, (pair.left, pair.right)):
        sides = (f"left: [{pair.left}]", f"right: [{pair.right}]", "radius:  # m", "track:  # m", TICKS)
        drive = NamedDrive("differential", "one wheel on each side, whose positions are ticks", sides)
    if drive is not None:
        missing = (
            f"the geometry of the drive: by its joints its kind is {drive.kind} ({drive.why}); fill in "
            "wheels.drive, which is in the file as a comment (docs/drives.md)"
        )
        return FirstSection((head, *_drive_to_fill_in(drive)), (missing,))
    if pair is None:
        missing = (
            f"which joints are the wheels: {', '.join(names)}; give wheels.left_joint and wheels.right_joint, their "
            "radii and the track, or wheels.drive (docs/drives.md) if it has another drive than two wheels"
        )
    else:
        missing = "radii and track of the wheels: measure them (wheels.left_radius, right_radius, track)"
    lines = _to_fill_in(pair)
    return FirstSection((head, *lines), (missing,), asked=(_asked(pair, names, missing, lines),))


def _asked(pair: WheelPair | None, names: tuple[str, ...], missing: str, lines: tuple[str, ...]) -> Asked:
    """Questions on the geometry of two wheels, and on their joints where their names do not tell."""
    sides = () if pair is not None else ("left", "right")
    questions = (
        *(Question(f"Joint of the {side} wheel", (f"wheels.{side}_joint",), among=names) for side in sides),
        Question("Radius of the wheels [m]", ("wheels.left_radius", "wheels.right_radius"), 10.0),
        Question("Track, the distance of the wheels' contact points [m]", ("wheels.track",), 10.0),
    )
    known = () if pair is None else (f"left_joint: {pair.left}", f"right_joint: {pair.right}")
    return Asked(missing, questions, ("source: ticks", *known), lines)


def _found(pair: WheelPair, geometry: WheelGeometry) -> tuple[str, ...]:
    track = "the track that with which it obeys commands" if geometry.by_commands else "likewise the track"
    return (
        f"# The radius is that with which the driver made its odometry, {track}; measure them all the same.",
        "wheels:",
        "  source: ticks",
        f"  left_joint: {pair.left}",
        f"  right_joint: {pair.right}",
        f"  left_radius: {geometry.radii_m[0]:.4g}  # m; negative: it counts backwards",
        f"  right_radius: {geometry.radii_m[1]:.4g}",
        f"  track: {geometry.track_m:.4g}  # m, between the wheels' contact points",
        "  # scale_sigma: 0.01  # how far the radii may be off; fgloc calibrate finds by how much they are",
    )


def _drive_to_fill_in(drive: NamedDrive) -> tuple[str, ...]:
    return (
        f"# A drive of kind {drive.kind}: {drive.why}.",
        "# Fill in to use it (all keys: docs/drives.md):",
        "# wheels:",
        "#   drive:",
        f"#     kind: {drive.kind}",
        *(f"#     {line}" for line in drive.lines),
    )


def _to_fill_in(pair: WheelPair | None) -> tuple[str, ...]:
    return (
        "# Fill in to use the angles of the wheels, which are better than the driver's odometry:",
        "# wheels:",
        "#   source: ticks",
        f"#   left_joint: {pair.left if pair else ''}",
        f"#   right_joint: {pair.right if pair else ''}",
        "#   left_radius:   # m",
        "#   right_radius:  # m",
        "#   track:         # m, between the wheels' contact points",
    )


FIRST_SETTINGS = FirstSettings((JointsEvent, OdometryEvent, ControlEvent), _first_section)


def correct(kind: str, factor: float, turned: FloatArray, by_ticks: bool, wheels: WheelsConfig) -> RawMistake:
    """Sentence for the user on a mistake in the odometer's settings, and the settings that correct it.

    Args:
        kind: ``radius``, ``track``, ``odometry_frame``, or a key of `WRONG_SIDES`.
        factor: of radius and track: true over given.
        turned: of the others: what brings its twist ``(3,)`` into the base's axes, ``(3, 3)``.
        by_ticks: whether its motion is that of the joints.
        wheels: as given.
    """
    new: dict[str, Any]
    if kind == "track":
        new = {"scale_omega": wheels.scale_omega / factor}
        if by_ticks and wheels.track is not None:
            new = {"track": wheels.track * factor}
        sentence = f"The wheels turn the robot {1.0 / factor:.3f} times as far as given: set {_lines(new)}."
        return RawMistake("wheels.turn", sentence, "wheels", new)
    if kind == "radius":
        by_radii = by_ticks and None not in (wheels.left_radius, wheels.right_radius)
        keys = ("left_radius", "right_radius") if by_radii else ("scale_v", "scale_omega")
        new = {key: getattr(wheels, key) * factor for key in keys}
        sentence = (
            f"The wheels' radii are {factor:.3f} times those given"
            if by_radii
            else f"The robot moves {factor:.3f} times as far as its odometry says"
        )
        return RawMistake("wheels.scale", f"{sentence}: set {_lines(new)}.", "wheels", new)
    if kind == "odometry_frame":
        c, s = turned[:2, 0]
        sentence = (
            f"The odometry's twist is in axes turned by {-math.degrees(math.atan2(s, c)):.0f}° against the base: "
            "set wheels.source: pose, or correct its child_frame_id."
        )
        return RawMistake("odometry.twist_frame", sentence, "wheels", {"source": "pose"})
    new = right_sides(kind, wheels) if by_ticks else {}
    by_hand = "exchange wheels.left_joint and wheels.right_joint, or correct the driver's signs"
    line = f"set {_lines(new)}" if new else by_hand
    code = "wheels.sign" if kind == "exchanged" else "wheels.reversed"
    return RawMistake(code, f"The wheels {WRONG_SIDES[kind]}: {line}.", "wheels", new)


WRONG_SIDES = {
    "exchanged": "turn the robot the other way (left and right exchanged)",
    "reversed": "count backwards",
    "both_reversed": "count backwards, and left and right are exchanged",
    "left_reversed": "count backwards on the left side",
    "right_reversed": "count backwards on the right side",
}
"""Joints of the wheels that are on the wrong side or count backwards, by kind of mistake, in words."""


def right_sides(kind: str, wheels: WheelsConfig) -> dict[str, Any]:
    """Settings of joints that undo a mistake of `WRONG_SIDES`; empty: names or radii are not configured."""
    if (drive := wheels.drive) is not None:
        sides = {
            "reversed": drive.driven,
            **{f"{side}_reversed": getattr(drive, side, ()) for side in ("left", "right")},
        }
        names = sides.get(kind, ())
        return {"drive.reversed": tuple(sorted({*drive.reversed} ^ {*names}))} if names else {}
    joints = {"left_joint": wheels.right_joint, "right_joint": wheels.left_joint}
    exchanged = joints if None not in joints.values() else {}
    if kind == "exchanged":
        return exchanged
    if wheels.left_radius is None or wheels.right_radius is None or (kind == "both_reversed" and not exchanged):
        return {}
    new: dict[str, Any] = dict(exchanged) if kind == "both_reversed" else {}
    if kind != "right_reversed":
        new["left_radius"] = -wheels.left_radius
    if kind != "left_reversed":
        new["right_radius"] = -wheels.right_radius
    return new


def _lines(values: Mapping[str, Any]) -> str:
    shown = {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in values.items()}
    return " and ".join(f"wheels.{name}: {value}" for name, value in shown.items())


_JUMP = 8.0  # times a usual step of a wheel's angle, and ...
_LEAST_JUMP_RAD = 0.5  # ... at least so much
_ROLLS = 2  # jumps of one size that make it a roll-over; an encoder that restarts jumps by any amount
_SAME_JUMP = 0.03  # share by which they may differ
_LEAST_RADIUS = 1e-3  # m: a smaller one is a way per tick
_BEYOND = 0.1  # share of messages whose velocities are beyond the bound: more are no spikes
_MOST_NAMES = 20
_WHOLE_TURN = 0.02  # share by which a range may be off one turn to be taken as one turn


def mistakes(motion: Sequence[Event], config: Config) -> tuple[RawMistake, ...]:
    """Mistakes in the settings that the messages show: angles that roll over, or that cannot be turned into a way.

    Args:
        motion: events in order of receipt that no bound on speeds has sifted.
        config: as given.
    """
    found = []
    rolled = roll_over(motion, config)
    if rolled is not None:
        of_drive = config.wheels.drive is not None
        unit, line = ("rad" if config.wheels.in_radians else "ticks", "drive.rolls_over" if of_drive else "angle_range")
        sentence = (
            f"The wheel angles roll over after {rolled[0]:.4f} {unit} ({rolled[1]} times in what was looked at): "
            f"set {'' if of_drive else 'expert.'}wheels.{line}: {rolled[0]:.4f}."
        )
        found.append(RawMistake("wheels.roll_over", sentence, "wheels", {line: rolled[0]}))
    wheels = config.wheels
    joints = [e for e in motion if isinstance(e, JointsEvent) and e.names]
    others = any(isinstance(e, (OdometryEvent, ControlEvent)) for e in motion)
    if len(joints) < 10 or wheels.source not in ("auto", "ticks"):
        return tuple(found)
    if absent := _absent(joints, wheels):
        found.append(RawMistake("wheels.joints", absent, "wheels", {}, grave=not others))
    elif not others or wheels.source == "ticks" or wheels.drive is not None or None not in _geometry(wheels):
        found += _units(joints, config)
    return tuple(found)


def _geometry(wheels: WheelsConfig) -> tuple[float | None, ...]:
    """Radii and track of two wheels; None: not given."""
    return wheels.left_radius, wheels.right_radius, wheels.track


def _absent(joints: Sequence[JointsEvent], wheels: WheelsConfig) -> str:
    """Sentence on configured joints that no message holds; empty: there are none."""
    there = tuple(dict.fromkeys(name for event in joints for name in event.names))
    if wheels.drive is None:
        sides = (("left_joint", wheels.left_joint), ("right_joint", wheels.right_joint))
        absent = [f"{name} (wheels.{key})" for key, name in sides if name is not None and name not in there]
    else:
        absent = [name for name in (*wheels.drive.driven, *wheels.drive.steered) if name not in there]
    if not absent:
        return ""
    return (
        f"No joint state holds {', '.join(absent)}: the joints in the recording are {', '.join(there[:_MOST_NAMES])}. "
        "Set those of the wheels."
    )


def _units(joints: Sequence[JointsEvent], config: Config) -> list[RawMistake]:
    """Mistakes of joints that are the motion of the wheels: no geometry is given, or they are in another unit."""
    wheels, bound = config.wheels, config.gate.max_wheel_rate
    turning = [e for e in joints if len(e.position) == len(e.names)]
    names = joint_names(joints)
    pair = wheel_pair(names) or WheelPair("", "")
    sides = (wheels.left_joint or pair.left, wheels.right_joint or pair.right)
    own = wheels.drive.driven if wheels.drive is not None else sides if all(sides) else names
    radii = _geometry(wheels)[:2] if wheels.drive is None else (wheels.drive.radius,)
    rate = _joint_rate(turning)
    ticks = max(radius or 1.0 for radius in radii) > _LEAST_RADIUS and (rate > bound or count_ticks(turning, own))
    if wheels.drive is None and None in _geometry(wheels):
        drive = name_drive(joints, (), ())
        line = (
            f"wheels.drive, whose kind is {drive.kind} by its joints ({drive.why})"
            if drive is not None
            else "wheels.left_radius, wheels.right_radius and wheels.track, or wheels.drive"
        )
        unit = ", with its ticks_per_turn, as positions are ticks or degrees" if ticks else ""
        sentence = (
            "Joint states are the only motion of the wheels in the recording, and how they move the robot is not "
            f"given: set {line}{unit} (docs/drives.md). `fgloc init` writes the lines that are to be filled in."
        )
        return [RawMistake("wheels.geometry", sentence, "wheels", {})]
    if not wheels.in_radians:
        return []
    if ticks:
        seen = f"change by {rate:.4g} rad/s" if rate > bound else "are whole numbers only"
        sentence = (
            f"The angles of the wheels' joints {seen}: they are ticks or degrees, not radians. "
            "Set wheels.drive with its ticks_per_turn (360 for degrees; docs/drives.md)."
        )
        return [RawMistake("wheels.ticks", sentence, "wheels", {})]
    share = _beyond(joints, own, bound)
    if share < _BEYOND:
        return []
    used = (
        "Those messages count by their positions alone."
        if turning
        else "Without positions they tell no motion: record positions, or velocities in rad/s."
    )
    sentence = (
        f"The velocities of the wheels' joints exceed {bound:g} rad/s in {share:.0%} of the messages: they are in "
        f"another unit, and are not used there. {used}"
    )
    return [RawMistake("wheels.rates", sentence, "wheels", {}, grave=not turning)]


def _beyond(joints: Sequence[JointsEvent], names: Sequence[str], bound: float) -> float:
    """Share of the messages in which one of these joints turns faster than this [rad/s]."""
    places = [[e.names.index(name) for name in names if name in e.names] for e in joints]
    given = [(e.velocity, at) for e, at in zip(joints, places, strict=True) if at and len(e.velocity) == len(e.names)]
    return float(np.mean([(np.abs(rates[at]) > bound).any() for rates, at in given])) if given else 0.0


def _joint_rate(joints: Sequence[JointsEvent]) -> float:
    """Rate [rad/s] that the fastest joint exceeds for a tenth of the time, if its angles are radians."""
    if not joints:
        return 0.0
    names = joints[0].names
    alike = [e for e in joints if e.names == names]
    times = np.array([e.stamp_ns for e in alike]) * 1e-9
    passed = np.diff(times)
    steps = np.abs(np.diff([e.position for e in alike], axis=0))[passed > 0.0] / passed[passed > 0.0, None]
    steps = steps[np.isfinite(steps).all(axis=1)]
    return float(np.quantile(steps, 0.9, axis=0).max()) if len(steps) else 0.0


def roll_over(motion: Sequence[Event], config: Config) -> tuple[float, int] | None:
    """Position after which the wheels' positions roll over, and how often they did; None: they do not.

    Args:
        motion: events in order of receipt, among them joint states.
        config: of the wheels.
    """
    joints = [e for e in motion if isinstance(e, JointsEvent) and len(e.position) == len(e.names)]
    wheels = config.wheels
    given = wheels.angle_range if wheels.drive is None else wheels.drive.rolls_over
    if given is not None or len(joints) < 10:
        return None
    try:
        pair = wheel_names(joints[0].names, wheels.left_joint, wheels.right_joint) if wheels.drive is None else None
    except ConfigError:  # ambiguous: the run reports it
        return None
    jumps: list[float] = []
    for name in pair or (() if wheels.drive is None else wheels.drive.driven):
        read = np.array([(e.stamp_ns * 1e-9, e.position[e.names.index(name)]) for e in joints if name in e.names])
        jumps += _jumps(*read[np.isfinite(read[:, 1])].T) if len(read) else []
    if len(jumps) < _ROLLS:
        return None
    size = float(np.median(jumps))
    if float(np.mean(np.abs(np.array(jumps) - size) < _SAME_JUMP * size)) < 0.9:
        return None
    whole = [math.tau]  # counters have so many bits, or begin anew with each turn
    if wheels.drive is not None and wheels.drive.ticks_per_turn is not None:
        whole = [wheels.drive.ticks_per_turn, 2.0 ** round(math.log2(size))]
    return next((turn for turn in whole if abs(size - turn) < _WHOLE_TURN * turn), size), len(jumps)


def _jumps(times: FloatArray, angles: FloatArray) -> list[float]:
    """Difference [rad] of each jump from the steps beside it; no jump is what the wheel turns in that time."""
    steps, passed = np.diff(angles), np.diff(times)
    if np.count_nonzero(passed > 0.0) < 3:
        return []
    usual = max(_JUMP * float(np.median(np.abs(steps))), _LEAST_JUMP_RAD)
    found = []
    turned = 2.0 * np.quantile(np.abs(steps[passed > 0.0]) / passed[passed > 0.0], 0.9) * passed
    for k in np.flatnonzero(np.abs(steps) > np.maximum(usual, turned)).tolist():
        beside = [steps[i] for i in (k - 1, k + 1) if 0 <= i < len(steps) and abs(steps[i]) <= usual]
        if beside:
            found.append(abs(float(steps[k] - np.mean(beside))))
    return found


DISTANCE_GAIN = "wheels.scale_v"  # the setting that sightings determine wherever the robot moves
_FREED = {"scale_sigma": 0.2, "turn_scale_sigma": 0.2, "yaw_per_m_sigma": 0.2}  # priors before anything was seen
_FREED_DRIVE = 10.0  # likewise, times the sigma of a geometry that was measured by hand
_FREED_COMMANDS = _FREED | {"slowdown_sigma": 1.0, "delay_sigma_s": 0.2}


def with_wheels(config: Config, values: Mapping[str, float]) -> Config:
    """Settings with some values of `wheels` replaced, by their keys; those of its drive begin with "drive."."""
    own = {key: value for key, value in values.items() if "." not in key}
    of_drive = {key.partition(".")[2]: value for key, value in values.items() if "." in key}
    if of_drive and config.wheels.drive is not None:
        return with_values(config, "wheels", own | {"drive": config.wheels.drive.with_values(of_drive)})
    return with_values(config, "wheels", own)


def freed(config: Config) -> tuple[Config, ...]:
    """Settings with wide priors on the gains, to be calibrated: of the wheels, and of commands in their place."""
    of_commands = with_values(config, "wheels", _FREED_COMMANDS)
    drive = config.wheels.drive
    if drive is not None and config.wheels.source != "command":
        wide = {name: _FREED_DRIVE * sigma for name, sigma in drive.usual_sigmas().items() if sigma > 0.0}
        sigmas = {name: max(wide.get(name, sigma), sigma) for name, sigma in drive.states.items()}
        return (with_values(config, "wheels", {**_FREED, "drive": drive.with_values({}, sigmas)}),)
    return (of_commands,) if config.wheels.source == "command" else (with_values(config, "wheels", _FREED), of_commands)


WHEELS = BuiltIn(
    name="wheels",
    installation=INSTALLATION,
    first_settings=FIRST_SETTINGS,
    streams=(
        Stream(
            "odometry",
            OdometryEvent,
            odometry_converters(OdometryEvent),
            ("odom", "wheel_odom", "wheel_odometry", "wheel/odometry", "wheels/odom"),
            validator=odometry_validator,
            findings=OdometryChecks,
        ),
        Stream(
            "joints",
            JointsEvent,
            {
                "sensor_msgs/msg/JointState": from_joints,
                "ackermann_msgs/msg/AckermannDrive": from_ackermann,
                "ackermann_msgs/msg/AckermannDriveStamped": lambda m, when: from_ackermann(m.drive, when),
            },
            ("joint_states",),
            validator=joints_validator,
        ),
    ),
    failures=(
        failures.WheelSlip,
        failures.EncoderDead,
        failures.EncoderFrozen,
        failures.EncoderQuantized,
        failures.EncoderRollover,
        failures.WheelScaleDrift,
        failures.OdometryReset,
        failures.WheelNan,
        failures.WrongCovariance,
    ),
    carried=failures.carried,
    joined=failures.JoinedWheels,
)
