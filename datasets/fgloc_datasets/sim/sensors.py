"""Streams of messages from the robot's channels about a log, in the order of their arrival.

When a message is received is known from the start; what it says is computed when it is written. So a finished log is
written as a whole, and one that is still being filled as far as it reaches (`fgloc_datasets.sim.following`).

Errors of UWB ranges and GNSS positions that last (no line of sight, multipath) come in stretches: a two-state Markov
chain of the given share and mean length, with one draw of the error for each stretch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Generic, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fgloc import se2
from fgloc.frames import quaternion_matrix, rpy_matrix
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message
from fgloc_datasets.sim.camera import CornerDetector, Image, Shot, exposures, light_level, shots
from fgloc_datasets.sim.drives import Command, believed, steering_names, twists, wheel_names
from fgloc_datasets.sim.installed import camera_jitter_s
from fgloc_datasets.sim.physics import TICK_S, Log, Scene, base_twist, slipping, wheel_twist
from fgloc_datasets.sim.scenario import FRONT, Gnss, Robot, Scenario, Uwb, channel_rng

# --- Rows -------------------------------------------------------------------------------------------------------------

T = TypeVar("T")


class Rows(Generic[T]):
    """Values of messages in order, computed in blocks as far as the log reaches."""

    def __init__(self, log: Log, ticks: IntArray, make: Callable[[int, int], T]) -> None:
        """Compute nothing yet.

        Args:
            log: of the run, which may still go on.
            ticks: ``(n,)`` row of the log that each message is of, ascending.
            make: values of the messages from the first to before the last; asked in order, without gaps.
        """
        self._log, self._ticks, self._make = log, ticks, make
        self._first = self._last = 0
        self._block: T | None = None

    def at(self, i: int) -> tuple[T, int]:
        """A block of values and the message's row in it. Messages of earlier blocks are gone.

        Raises:
            IndexError: the log does not reach the message, or its block is gone.
        """
        if i >= self._last:
            self._first, self._last = self._last, int(np.searchsorted(self._ticks, self._log.ticks))
            self._block = self._make(self._first, self._last) if self._last > self._first else None
        if self._block is None or not self._first <= i < self._last:
            raise IndexError(
                f"message {i}: the log has {self._log.ticks} ticks, the block {self._first} to {self._last}"
            )
        return self._block, i - self._first


# --- Wheels and inertial sensors --------------------------------------------------------------------------------------

_STEERING_STEP_RAD = math.tau / 4096  # of an absolute encoder of 12 bits
_GRAVITY = np.array([0.0, 0.0, 9.81])


def odometry(
    log: Log, robot: Robot, every: int, messages: slice = slice(0, None), before: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Odometry of the robot's driver, computed from the encoders every ``every`` ticks.

    Args:
        log: of the run.
        robot: whose *nominal* radii and track are taken.
        every: ticks.
        messages: which of them.
        before: ``(3,)`` pose at the message before the first; None: there is none.

    Returns:
        Poses and twists ``(n, 3)`` of the last interval.
    """
    turned = encoders(log, robot, every, messages)[1]
    steering = steering_angles(log, every, messages)
    moved = twists(robot, believed(robot), robot.track_m * robot.track_scale, turned, steering)
    poses = np.zeros((len(turned), 3))
    for i in range(len(poses)):
        last = poses[i - 1] if i else before
        if last is not None:
            poses[i] = se2.compose(last, se2.exp(moved[i]))
    return poses, moved / (every * TICK_S)


def steering_angles(log: Log, every: int, messages: slice) -> FloatArray:
    """Angles ``(n, k)`` [rad] of the steering that messages report, in whole steps of its encoder."""
    last = None if messages.stop is None else (messages.stop - 1) * every + 1
    return np.round(log.steering[messages.start * every : last : every] / _STEERING_STEP_RAD) * _STEERING_STEP_RAD


def encoders(log: Log, robot: Robot, every: int, messages: slice) -> tuple[FloatArray, FloatArray]:
    """Wheel angles of messages in whole encoder ticks, and how far each has turned since the message before [rad]."""
    first = max(messages.start - 1, 0)  # the one before
    last = None if messages.stop is None else (messages.stop - 1) * every + 1
    tick = 2.0 * math.pi / robot.ticks_per_turn
    angles = np.asarray(np.floor(log.wheel_angles[first * every : last : every] / tick) * tick)
    turned = np.diff(angles, axis=0, prepend=angles[:1])
    return angles[messages.start - first :], turned[messages.start - first :]


def specific_force(log: Log, every: int, first: int, last: int, at: Sequence[float]) -> FloatArray:
    """Means of the specific force over the samples ``(n, 3)`` [m/s²] at a place of the base, in its axes."""
    before = max(first - 1, 0)
    part = log.part(slice(before * every, (last - 1) * every + 1, every))
    rotation = np.array([quaternion_matrix(q) for q in part.quaternions])
    speeds = part.velocities + np.einsum("nij,nj->ni", rotation, np.cross(part.rates, at))
    gained = np.diff(speeds, axis=0, prepend=speeds[:1]) / (every * TICK_S) + _GRAVITY
    return np.asarray(np.einsum("nji,nj->ni", rotation, gained)[first - before :])


def mean_over(values: FloatArray, every: int, first: int, last: int) -> FloatArray:
    """Means ``(n, d)`` of the ``every`` ticks up to each of the messages from the first to before the last.

    Message 0 has one tick.
    """
    head = values[:1] if first == 0 else values[:0]
    after = max(first - 1, 0)
    rows = values[1 + after * every : 1 + (last - 1) * every].reshape(-1, every, values.shape[1])
    return np.concatenate([head, rows.mean(axis=1)])


# --- GNSS and UWB -----------------------------------------------------------------------------------------------------

Values = Callable[[int, int], FloatArray]
_SEMI_MAJOR_M, _FLATTENING = 6378137.0, 1.0 / 298.257223563  # of the ellipsoid of WGS 84
_ITERATIONS = 8  # of the latitude; each gains two digits


def anchors(scenario: Scenario, uwb: Uwb) -> FloatArray:
    """Places ``(n, 3)`` in the map, evenly along the walls; anchor i has the number i + 1."""
    length, width = scenario.world.size_m
    along = (np.arange(uwb.anchors) + 0.5) / uwb.anchors * 2.0 * (length + width)
    places = np.zeros((uwb.anchors, 3))
    for i, s in enumerate(along):
        if s < length:
            x, y = s, 0.0
        elif s < length + width:
            x, y = length, s - length
        elif s < 2.0 * length + width:
            x, y = 2.0 * length + width - s, width
        else:
            x, y = 0.0, 2.0 * (length + width) - s
        places[i] = x - 0.5 * length, y - 0.5 * width, uwb.heights_m[i % 2]
    return places


def uwb_ranges(scenario: Scenario, uwb: Uwb, log: Log, seed: int) -> tuple[IntArray, IntArray, Values]:
    """Ticks of the log and numbers of the anchors, each ``(n,)``; and the ranges [m] of messages i to j."""
    rng = channel_rng(seed, "uwb")
    ticks = _fix_ticks(log, uwb.rate_hz)
    which = np.arange(len(ticks)) % uwb.anchors
    places = anchors(scenario, uwb)
    seconds = log.stamps_s[ticks]
    excess = np.zeros(len(ticks))
    for anchor in range(uwb.anchors):
        mine = np.flatnonzero(which == anchor)
        stretch = _stretches(rng, seconds[mine], uwb.nlos_share, uwb.nlos_s)
        draws = rng.exponential(uwb.nlos_mean_m, int(stretch.max(initial=0)) + 1)
        excess[mine] = np.where(stretch > 0, draws[stretch], 0.0)
    noise = rng.normal(0.0, uwb.sigma_m, len(ticks))

    def ranges(first: int, last: int) -> FloatArray:
        these = slice(first, last)
        true = np.linalg.norm(_points(log, ticks[these], uwb.tag) - places[which[these]], axis=1)
        return np.asarray(np.maximum(true + excess[these] + noise[these], 0.1))

    return ticks, which + 1, ranges


def uwb_settings(scenario: Scenario, uwb: Uwb) -> dict[str, Any]:
    """Section ``uwb`` of ``robot.yaml``: what the installer surveyed, exactly."""
    places = {i + 1: [round(float(v), 4) for v in place] for i, place in enumerate(anchors(scenario, uwb))}
    return {"anchors": places, "tag": list(uwb.tag), "sigma_m": uwb.sigma_m}


def gnss_places(gnss: Gnss, log: Log, seed: int) -> tuple[IntArray, Values]:
    """Ticks of the log ``(n,)``; and latitude, longitude [degrees], altitude [m] ``(., 3)`` of messages i to j."""
    rng = channel_rng(seed, "gnss")
    ticks = _fix_ticks(log, gnss.rate_hz)
    stretch = _stretches(rng, log.stamps_s[ticks], gnss.multipath_share, gnss.multipath_s)
    count = int(stretch.max(initial=0)) + 1
    far, direction = rng.exponential(gnss.multipath_mean_m, count), rng.uniform(-math.pi, math.pi, count)
    off = np.where(stretch > 0, far[stretch], 0.0)
    c, s = math.cos(gnss.yaw_rad), math.sin(gnss.yaw_rad)
    east, north = (rng.normal(0.0, gnss.sigma_m, len(ticks)) for _ in range(2))
    east, north = off * np.cos(direction[stretch]) + east, off * np.sin(direction[stretch]) + north

    def places(first: int, last: int) -> FloatArray:
        enu = _points(log, ticks[first:last], gnss.antenna) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
        enu[:, 0] += east[first:last]
        enu[:, 1] += north[first:last]
        return geodetic(enu, gnss.origin)

    return ticks, places


def gnss_settings(gnss: Gnss) -> dict[str, Any]:
    """Section ``gnss`` of ``robot.yaml``."""
    return {"origin": list(gnss.origin), "yaw_rad": gnss.yaw_rad, "antenna": list(gnss.antenna[:2])}


def geodetic(enu: FloatArray, origin: tuple[float, float, float]) -> FloatArray:
    """Latitude, longitude [degrees], altitude [m] ``(n, 3)`` of points east, north and up of an origin ``(n, 3)``.

    Source: NIMA TR8350.2; the latitude by fixed-point iteration.
    """
    e2 = _FLATTENING * (2.0 - _FLATTENING)
    phi, lam = math.radians(origin[0]), math.radians(origin[1])
    normal = _SEMI_MAJOR_M / math.sqrt(1.0 - e2 * math.sin(phi) ** 2)
    across, along = (normal + origin[2]) * math.cos(phi), (normal * (1.0 - e2) + origin[2]) * math.sin(phi)
    center = np.array([across * math.cos(lam), across * math.sin(lam), along])
    axes = np.array(
        [
            [-math.sin(lam), math.cos(lam), 0.0],
            [-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam), math.cos(phi)],
            [math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam), math.sin(phi)],
        ]
    )
    x, y, z = (center + enu @ axes).T
    p = np.hypot(x, y)
    latitude = np.arctan2(z, p * (1.0 - e2))
    altitude = np.zeros_like(p)
    for _ in range(_ITERATIONS):
        normals = _SEMI_MAJOR_M / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
        altitude = p / np.cos(latitude) - normals
        latitude = np.arctan2(z, p * (1.0 - e2 * normals / (normals + altitude)))
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), altitude])


def _fix_ticks(log: Log, rate_hz: float) -> IntArray:
    """Rows ``(n,)`` of the log at a rate [Hz]."""
    wanted = np.arange(log.stamps_s[0] + 1.0 / rate_hz, log.stamps_s[-1], 1.0 / rate_hz)
    return np.asarray(np.unique(np.searchsorted(log.stamps_s, wanted).clip(max=len(log.stamps_s) - 1)))


def _points(log: Log, ticks: IntArray, offset: tuple[float, float, float]) -> FloatArray:
    """Positions ``(n, 3)`` [m] in the map of a point of the base."""
    turned = np.array([quaternion_matrix(q) @ np.array(offset) for q in log.quaternions[ticks]])
    return np.asarray(log.positions[ticks] + turned)


def _stretches(rng: np.random.Generator, seconds: FloatArray, share: float, mean_s: float) -> IntArray:
    """Number of the stretch that each time is in, from 1; 0: in none."""
    number = np.zeros(len(seconds), dtype=np.int64)
    if share <= 0.0 or not len(seconds):
        return number
    inside, count = bool(rng.uniform() < share), 0
    count += inside
    end = float(seconds[0])
    for i, at in enumerate(seconds):
        while at >= end:
            if i or end > seconds[0]:
                inside = not inside
                count += inside
            end += rng.exponential(mean_s if inside else mean_s * (1.0 - share) / share)
        number[i] = count if inside else 0
    return number


# --- Streams ----------------------------------------------------------------------------------------------------------

Sees = Literal["images", "corners", "nothing"]
"""What the camera sends."""
EPOCH_NS = 1_760_000_000_000_000_000  # time 0 of every run
FULL_LIGHT_LUX = 500.0
_LIGHT_HZ = 10.0
_ODOMETRY_VARIANCE = (4e-4, 2.5e-3)  # of v and ω: a constant that the driver sends, as drivers do


def streams(scene: Scene, log: Log, bag: BagWriter, camera: Sees) -> list[Iterator[Message]]:
    """All channels of a run, to be merged by receive times; a message is written before the next one is asked for."""
    channels: list[Iterator[Message]] = [
        _commands(scene, log, bag),
        _wheels(scene, log, bag),
        _imu(scene, log, bag),
        _truth(scene, log, bag),
        _light(scene, log, bag),
    ]
    if scene.scenario.uwb is not None:
        channels.append(_ranges(scene, scene.scenario.uwb, log, bag))
    if scene.scenario.gnss is not None:
        channels.append(_fixes(scene, scene.scenario.gnss, log, bag))
    if camera != "nothing" and scene.scenario.camera is not None:
        send = _images if camera == "images" else _corners
        channels.append(_mounting(scene, bag))
        names = scene.scenario.cameras
        channels += [_with_lens(scene, log, bag, name, send(scene, log, bag, name)) for name in names]
    return channels


def stamp_ns(seconds: float) -> int:
    """Stamp of a time of the log."""
    return EPOCH_NS + round(seconds * 1e9)


def command_topic(robot: Robot) -> str:
    """Topic of the commands."""
    return "/ackermann_cmd" if robot.kind == "ackermann" else "/cmd_vel"


def _commands(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    stamps = _stamps(log.commands[:, 0])
    topic, steers = command_topic(scene.scenario.robot), scene.scenario.robot.kind == "ackermann"

    def write(i: int, received: int) -> None:
        command = Command(*log.commands[i, 1:].tolist())
        if steers:
            bag.ackermann(topic, stamps[i], command.v, command.steering, received_ns=received)
        else:
            moved = {"v": command.v, "omega": command.omega, "vy": command.vy}
            bag.command(topic, stamps[i], **moved, frame_id="base_link", received_ns=received)

    return _messages(_received(scene, "command", stamps), write)


def _wheels(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """``/odom`` and ``/joint_states``: both from one reading of the encoders, one packet."""
    robot = scene.scenario.robot
    every, ticks = _ticks(log, scene.scenario.rates.odometry)
    stamps, late = _stamps(log.stamps_s[ticks]), round(1e9 * scene.installed.wheels.time_offset_s)
    names, steered = wheel_names(robot), steering_names(robot)
    noise = channel_rng(scene.seed, "effort").normal(0, robot.motor.effort_noise_nm, (len(ticks), len(names)))
    twist_cov = np.diag([_ODOMETRY_VARIANCE[0], 1e-6, 1e-6, 1e-6, 1e-6, _ODOMETRY_VARIANCE[1]])
    reached: FloatArray | None = None

    def make(first: int, last: int) -> tuple[FloatArray, ...]:
        nonlocal reached
        poses, twists = odometry(log, robot, every, slice(first, last), reached)
        reached = poses[-1]
        angles, turned = encoders(log, robot, every, slice(first, last))
        effort = mean_over(log.torques, every, first, last) + noise[first:last]
        rates = turned / (every * TICK_S)
        if steered:  # they report angles alone
            steering = steering_angles(log, every, slice(first, last))
            unknown = np.full_like(steering, np.nan)
            angles, rates, effort = (np.hstack(p) for p in ((angles, steering), (rates, unknown), (effort, unknown)))
        return poses, twists, angles, rates, effort

    rows = Rows(log, ticks, make)

    def write_odometry(i: int, received: int) -> None:
        (poses, twists, *_), k = rows.at(i)
        bag.odometry("/odom", stamps[i] + late, poses[k], twists[k], received, (None, twist_cov))

    def write_joints(i: int, received: int) -> None:
        (*_, angles, rates, effort), k = rows.at(i)
        these = (*names, *steered)
        bag.joints("/joint_states", stamps[i] + late, these, angles[k], rates[k], effort[k], received_ns=received)

    return _messages(_received(scene, "odometry", stamps), write_odometry, write_joints)


def _imu(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    imu, installed = scene.scenario.imu, scene.installed.imu
    every, ticks = _ticks(log, scene.scenario.rates.imu)
    dt, shape = every * TICK_S, (len(ticks), 3)
    rng = channel_rng(scene.seed, "imu")
    walk = rng.normal(0, imu.gyro_walk * math.sqrt(dt), shape).cumsum(axis=0)
    gyro_bias, gyro_noise = rng.normal(0, imu.gyro_bias, 3), rng.normal(0, imu.gyro_noise, shape)
    accel_bias, accel_noise = rng.normal(0, imu.accel_bias, 3), rng.normal(0, imu.accel_noise, shape)
    R_base_imu = rpy_matrix(*installed.rpy)

    def make(first: int, last: int) -> tuple[FloatArray, FloatArray]:
        rates = mean_over(log.rates, every, first, last)
        force = specific_force(log, every, first, last, imu.position)
        rates, force = installed.gyro_scale * rates @ R_base_imu, force @ R_base_imu
        these = slice(first, last)
        return rates + gyro_bias + walk[these] + gyro_noise[these], force + accel_bias + accel_noise[these]

    rows = Rows(log, ticks, make)
    stamps, late = _stamps(log.stamps_s[ticks]), round(1e9 * installed.time_offset_s)

    def write(i: int, received: int) -> None:
        (gyro, accel), k = rows.at(i)
        bag.imu(
            "/imu",
            stamps[i] + late,
            gyro[k],
            accel[k],
            variances=(imu.gyro_noise**2, imu.accel_noise**2),
            received_ns=received,
        )

    return _messages(_received(scene, "imu", stamps), write)


def _truth(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """``/truth``, ``/truth/slip`` (true minus wheel twist) and ``/truth/slipping``."""
    robot = scene.scenario.robot
    every, ticks = _ticks(log, scene.scenario.rates.truth)

    def make(first: int, last: int) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        part = log.part(slice(first * every, (last - 1) * every + 1, every))
        return base_twist(part), wheel_twist(part, robot), slipping(part, robot)

    rows = Rows(log, ticks, make)
    stamps = _stamps(log.stamps_s[ticks])

    def write_pose(i: int, received: int) -> None:
        k = ticks[i]
        bag.truth("/truth", stamps[i], log.positions[k], log.quaternions[k], received_ns=received)

    def write_slip(i: int, received: int) -> None:
        (true, wheels, _), k = rows.at(i)
        forward, left, turn = true[k] - wheels[k]
        bag.twist("/truth/slip", stamps[i], (forward, left, 0.0), (0.0, 0.0, turn), received_ns=received)

    def write_flag(i: int, received: int) -> None:
        (*_, slips), k = rows.at(i)
        bag.flag("/truth/slipping", bool(slips[k]), received)

    return _messages(_received(scene, "truth", stamps), write_pose, write_slip, write_flag)


def _light(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    seconds = np.arange(0.0, log.stamps_s[-1], 1.0 / _LIGHT_HZ)
    stamps = _stamps(seconds)

    def write(i: int, received: int) -> None:
        lux = FULL_LIGHT_LUX * light_level(scene.scenario.world.light, seconds[i])
        bag.illuminance("/truth/light", stamps[i], lux, received_ns=received)

    return _messages(_received(scene, "truth", stamps), write)


def _ranges(scene: Scene, uwb: Uwb, log: Log, bag: BagWriter) -> Iterator[Message]:
    ticks, numbers, make = uwb_ranges(scene.scenario, uwb, log, scene.seed)
    rows, stamps = Rows(log, ticks, make), _stamps(log.stamps_s[ticks])

    def write(i: int, received: int) -> None:
        readings, k = rows.at(i)
        bag.range_reading("/uwb/range", stamps[i], readings[k], f"anchor_{numbers[i]}", received_ns=received)

    return _messages(_received(scene, "uwb", stamps), write)


def _fixes(scene: Scene, gnss: Gnss, log: Log, bag: BagWriter) -> Iterator[Message]:
    ticks, make = gnss_places(gnss, log, scene.seed)
    rows, stamps = Rows(log, ticks, make), _stamps(log.stamps_s[ticks])
    variances = (gnss.sigma_m**2, gnss.sigma_m**2, 4.0 * gnss.sigma_m**2)

    def write(i: int, received: int) -> None:
        places, k = rows.at(i)
        bag.satellite_fix("/gnss/fix", stamps[i], places[k], variances, received_ns=received)

    return _messages(_received(scene, "gnss", stamps), write)


def _mounting(scene: Scene, bag: BagWriter) -> Iterator[Message]:
    """Static transforms of camera and IMU, as the installer believes them: the IMU is level."""
    cameras = {name: scene.installed.believed_camera(name) for name in scene.scenario.cameras}
    mounted = {
        **{f"{name}_optical": (c.position, Rotation.from_matrix(c.rotation).as_quat()) for name, c in cameras.items()},
        "imu_link": (scene.scenario.imu.position, np.array([0.0, 0.0, 0.0, 1.0])),
    }
    for frame, (position, quaternion) in mounted.items():
        yield (
            EPOCH_NS,
            partial(bag.static_transform, EPOCH_NS, "base_link", frame, position, tuple(quaternion), EPOCH_NS),
        )


Sent = Iterator[tuple[Shot, Callable[[int, int], None]]]  # shots, and what writes their message of a stamp and receipt


def _images(scene: Scene, log: Log, bag: BagWriter, name: str) -> Sent:
    """Images of a camera."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, scene.scenario.cameras[name].jpeg_quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    for shot, take in exposures(scene, log, name):

        def write(stamp: int, received: int, take: Callable[[], Image] = take) -> None:
            data = cv2.imencode(".jpg", take(), quality)[1].tobytes()
            topic = f"/{name}/image/compressed"
            bag.compressed_image(topic, stamp, data, received_ns=received, frame_id=f"{name}_optical")

        yield shot, write


def _corners(scene: Scene, log: Log, bag: BagWriter, name: str) -> Sent:
    """Corners that a detector finds without rendering."""
    detector = CornerDetector(scene, log, name)
    for shot in shots(scene, log, name):

        def write(stamp: int, received: int, shot: Shot = shot) -> None:
            seen, frame = detector.find(shot), f"{name}_optical"
            bag.corners(f"/{name}/corners", stamp, seen, received_ns=received, frame_id=frame)

        yield shot, write


def _with_lens(scene: Scene, log: Log, bag: BagWriter, name: str, sent: Sent) -> Iterator[Message]:
    """Messages of a camera, before each the calibration that is believed; the clock of the stamps may be late."""
    camera, late_s = scene.scenario.cameras[name], scene.installed.true_camera(name).time_offset_s
    believed, frame = scene.installed.believed_camera(name), f"{name}_optical"
    lens = ((camera.width, camera.height), believed.matrix, believed.distortion)
    rng = channel_rng(scene.seed, f"latency of {name}")
    n = round(log.stamps_s[-1] * camera.rate_hz) + 1
    seed = scene.seed if name == FRONT else scene.seed + 1
    late = iter(late_s + camera_jitter_s(scene.scenario.installation, seed, n))
    least, mean = scene.scenario.latency.camera
    stamp = received = 0
    for shot, write in sent:
        taken = stamp_ns(shot.stamp_s)
        stamp = max(taken + round(1e9 * next(late)), stamp + 1)
        received = max(taken + round(1e9 * (0.5 * shot.exposure_s + least + rng.exponential(mean))), received)
        told = partial(bag.camera_info, f"/{name}/camera_info", stamp, *lens, received_ns=received, frame_id=frame)
        yield received, told
        yield received, partial(write, stamp, received)


def _messages(received: Sequence[int], *write: Callable[[int, int], None]) -> Iterator[Message]:
    """Messages i = 0, 1, ... of one channel, each by all of its writers, which are given i and when it is received."""
    for i, at_ns in enumerate(received):
        for one in write:
            yield at_ns, partial(one, i, at_ns)


def _ticks(log: Log, rate_hz: float) -> tuple[int, IntArray]:
    """Number of ticks between messages at a rate [Hz], and the ticks ``(n,)`` of the messages."""
    every = round(1.0 / rate_hz / TICK_S)
    return every, np.arange(0, len(log.stamps_s), every)


def _stamps(seconds: FloatArray) -> list[int]:
    return [int(s) for s in EPOCH_NS + np.round(seconds * 1e9).astype(np.int64)]


def _received(scene: Scene, channel: str, stamps: list[int]) -> list[int]:
    """Receive times [ns] of messages: after a latency, never overtaking."""
    least, mean = getattr(scene.scenario.latency, channel)
    rng = channel_rng(scene.seed, f"latency of {channel}")
    late: IntArray = np.array(stamps) + np.round(1e9 * (least + rng.exponential(mean, len(stamps)))).astype(np.int64)
    return [int(s) for s in np.maximum.accumulate(late)]
