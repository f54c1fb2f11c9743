"""Wheel motion from odometry messages: twists and pose differences, each a check on the other."""

from __future__ import annotations

import cmath
import math

from fgloc import se2
from fgloc.errors import ConfigError
from fgloc.frames import quaternion_yaw
from fgloc.sensors.wheels.config import WheelsConfig
from fgloc.sensors.wheels.events import OdometryEvent
from fgloc.sensors.wheels.timeline import Twist
from fgloc.sensors.wheels.tracks import MAX_GAP_S, MAX_SPEED, MAX_TURN, Track, mean_twist

Pose = tuple[float, float, float]  # x, y [m], yaw [rad]

_CHECK_TURN, _CHECK_PATH = 0.5, 5.0  # rad or m of motion after which twist and pose are compared
_CHECK_HEADING = 0.5  # m of motion after which the pose's heading is held against the direction of its motion
_HEADING_RAD = 0.03  # of a pose's heading off its motion's direction: no offset of two clocks or axles makes more
_STILL = 0.01  # a path shorter than this share of the other did not move (degrees for radians: 0.017)
_BRIDGED_M, _BRIDGED_RAD = 0.5, 0.5  # over a long gap a motion of less is told by its ends
_BEGINS_M = 0.5  # from its origin: there an odometry is that was started just now
_SLACK_M, _SLACK_RAD = 0.03, 0.1
_DEGREES = (40.0, 80.0)  # a reported rotation this many times the pose's was given in degrees


class OdometryTrack(Track):
    """Between two messages, the mean of their twists or the exact motion between their poses.

    Either stands in where the other cannot be used (the gate marks that with NaN). With source "auto" pose differences
    are used, which the driver has summed up from every reading of its encoders, whatever the rate and the stamps of its
    messages; twists instead if the pose does not move, or if its heading is not that of its motion by the twists (a
    heading from elsewhere, or set by hand). A pose that jumps (odometry set to zero) is re-based: only differences
    count.
    """

    kind = "odometry"
    events = OdometryEvent

    def __init__(self, config: WheelsConfig) -> None:
        """Start with nothing received."""
        super().__init__(config)
        self._mode: str = config.source if config.source in ("twist", "pose") else "auto"
        self._compared = self._mode == "pose"
        self._paths = [0.0, 0.0, 0.0, 0.0]  # pose: m, rad; twist: m, rad
        self._along = 0j  # sum of the pose's motions times the conjugate of the twist's [m²]

    def _forget(self) -> None:
        self._pose: Pose | None = None
        self._twist: Twist | None = None
        self._moving: Twist | None = None  # the last piece of the timeline

    def _take(self, event: OdometryEvent) -> None:
        vx, vy, _ = event.linear.tolist()
        w = float(event.angular[2])
        x, y, _ = event.position.tolist()
        twist = None if math.isnan(vx + vy + w) else (vx, vy, w)
        pose = None if math.isnan(x + y) else (x, y, quaternion_yaw(event.orientation))
        if twist is None and pose is None:
            return
        piece = None
        if self._last_ns is not None:
            piece = self._connect((event.stamp_ns - self._last_ns) * 1e-9, pose, twist)
        self._extend(event.stamp_ns, piece, self._twist or self._moving)
        self._pose, self._twist, self._moving = pose, twist, piece or self._moving
        self._reach(event.stamp_ns, (self._mode == "twist" and twist) or self._moving or twist)

    def _connect(self, seconds: float, pose: Pose | None, twist: Twist | None) -> Twist | None:
        """The twist between the last message and this one; None if neither twists nor poses tell."""
        both = self._twist is not None and twist is not None
        mean = mean_twist(self._twist, twist) if seconds <= self._config.hold_s else None
        moved = self._between_poses(pose, mean, seconds)
        if both and mean is not None and moved is not None and not self._compared:
            self._compare(moved, mean, seconds)
        if moved is None or mean is None:
            return moved or mean
        if self._mode == "pose":
            return moved
        if self._mode == "twist":
            return mean if both else moved
        return moved if any(moved) else mean

    def _bridges(self, pose: Pose) -> bool:
        """Whether the pose tells the motion over a long gap: it is used, it moves little, and it was not begun anew.

        Where it moved far only the end is known, and what is seen meanwhile would contradict a way made up between.
        """
        before = self._pose or pose
        stands = pose == before and self._twist is not None and any(self._twist)
        restarted = math.hypot(*pose[:2]) < _BEGINS_M < math.hypot(*before[:2])
        dx, dy, dyaw = _difference(before, pose)
        little = math.hypot(dx, dy) < _BRIDGED_M and abs(dyaw) < _BRIDGED_RAD
        return self._mode != "twist" and little and not stands and not restarted

    def _between_poses(self, pose: Pose | None, mean: Twist | None, seconds: float) -> Twist | None:
        """The constant twist from the last pose to this one; None if that cannot be known."""
        if pose is None or self._pose is None:
            return None
        if seconds > MAX_GAP_S and not self._bridges(pose):
            return None
        dx, dy, dyaw = _difference(self._pose, pose)
        # Less than the slack is no jump, however short the time: stamps of receipt come in bursts.
        speed = max(math.hypot(dx, dy) - _SLACK_M, 0.0) / seconds
        turn = max(abs(dyaw) - _SLACK_RAD, 0.0) / seconds
        # Judged by the twist or, without one, by the motion just before.
        slack = 1.0
        reference = mean if mean is not None and any(mean) else None
        if reference is None:
            reference, slack = self._moving or (MAX_SPEED, 0.0, MAX_TURN), 1.0 + 10.0 * seconds
        may = min(slack + 1.5 * math.hypot(reference[0], reference[1]), MAX_SPEED)
        may_turn = min(3.0 * slack + 1.5 * abs(reference[2]), MAX_TURN)
        if speed > may or turn > may_turn:
            self.rejections["wheels.pose_reset"] += 1
            self.notes["reset"] = (
                f"the odometry's pose jumped {self.rejections['wheels.pose_reset']} time(s), the last by "
                f"{math.hypot(dx, dy):.3g} m and {dyaw:.3g} rad: taken as a reset, motion goes on from the new value"
            )
            return None
        return dx / seconds, dy / seconds, dyaw / seconds

    def _compare(self, moved: Twist, mean: Twist, seconds: float) -> None:
        """Cross-check twist and pose once enough was driven, and settle which is used.

        Raises:
            ConfigError: the configuration insists on a twist that is in degrees per second.
        """
        for k, value in enumerate((math.hypot(*moved[:2]), moved[2], math.hypot(*mean[:2]), mean[2])):
            self._paths[k] += abs(value) * seconds
        self._along += complex(*moved[:2]) * complex(*mean[:2]).conjugate() * seconds**2
        pose_path, pose_turn, twist_path, twist_turn = self._paths
        pose_still = pose_path <= _STILL * twist_path and pose_turn <= _STILL * twist_turn
        twist_still = twist_path <= _STILL * pose_path and twist_turn <= _STILL * pose_turn
        moved_enough = pose_turn > _CHECK_TURN or pose_path > _CHECK_PATH
        if not moved_enough and not (pose_still and (twist_turn > _CHECK_TURN or twist_path > _CHECK_PATH)):
            return
        self._compared = pose_still or pose_path > _CHECK_HEADING
        insists = self._config.source == "twist"
        ratio, heading = twist_turn / max(pose_turn, 1e-9), cmath.phase(self._along)
        mode = "pose"
        if pose_still:
            mode, text = "twist", "the odometry's pose does not move: its twist is used"
        elif twist_still:
            text = "the odometry's twist is zero while its pose moves: "
            text += "set wheels.source to pose" if insists else "pose differences are used"
        elif pose_turn > _CHECK_TURN and _DEGREES[0] < ratio < _DEGREES[1]:
            text = f"the odometry's yaw rate is {ratio:.1f} times the rotation of its pose: degrees, not radians"
            if insists:
                raise ConfigError(f"{text}; set wheels.source to pose, or wheels.scale_omega to {math.pi / 180:.6f}")
            text += ": pose differences are used"
        elif abs(heading) > _HEADING_RAD:
            mode, text = (
                "twist",
                (
                    f"the odometry's twist is used: the heading of its pose is {math.degrees(-heading):+.1f}° off the "
                    "direction in which the pose moves"
                ),
            )
        elif _differ(twist_path, pose_path) or _differ(twist_turn, pose_turn):
            text = (
                f"differences of the odometry's pose are used; its twist disagrees: {twist_path:.2f} m and "
                f"{twist_turn:.2f} rad against {pose_path:.2f} m and {pose_turn:.2f} rad; see wheels.source"
            )
        else:
            text = "differences of the odometry's pose are used; its twist agrees"
        self._mode = "twist" if insists else mode
        self.notes["source"] = text


def _difference(a: Pose, b: Pose) -> Twist:
    """``log(a⁻¹ b)``, as `fgloc.se2` has it, without arrays: it runs for every message."""
    c, s = math.cos(a[2]), math.sin(a[2])
    x, y, turn = c * (b[0] - a[0]) + s * (b[1] - a[1]), c * (b[1] - a[1]) - s * (b[0] - a[0]), se2.wrap(b[2] - a[2])
    half = 0.5 * turn
    k = 1.0 - half * half / 3.0 if abs(turn) < 1e-5 else half / math.tan(half)
    return k * x + half * y, k * y - half * x, turn


def _differ(a: float, b: float) -> bool:
    """Whether two lengths that should be equal differ by more than a third."""
    return max(a, b) > _CHECK_TURN and not 0.75 * b < a < 1.34 * b
