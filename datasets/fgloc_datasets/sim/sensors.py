"""What the robot's channels say about a log: streams of messages in the order of their arrival.

When a message is received is known from the start; what it says is computed when it is written. So a finished log is
written as a whole, and one that is still being filled as far as it reaches (`fgloc_datasets.sim.following`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fgloc.frames import rpy_matrix
from fgloc.types import FloatArray, IntArray
from fgloc_datasets.bag import BagWriter
from fgloc_datasets.convert import Message
from fgloc_datasets.sim.camera import Exposure, Shot, exposures, light_level, shots
from fgloc_datasets.sim.corners import CornerDetector
from fgloc_datasets.sim.installed import camera_jitter_s
from fgloc_datasets.sim.mjcf import wheel_names
from fgloc_datasets.sim.physics import TICK_S, Log, Scene, base_twist, slipping, wheel_twist
from fgloc_datasets.sim.positioning import gnss_places, uwb_ranges
from fgloc_datasets.sim.readings import encoders, mean_over, odometry, specific_force
from fgloc_datasets.sim.rows import Rows
from fgloc_datasets.sim.scenario import Gnss, Uwb
from fgloc_datasets.sim.section import channel_rng

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
        channels += [_mounting(scene, bag), (_images if camera == "images" else _corners)(scene, log, bag)]
    return channels


def stamp_ns(seconds: float) -> int:
    """Stamp of a time of the log."""
    return EPOCH_NS + round(seconds * 1e9)


def _commands(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    stamps = _stamps(log.commands[:, 0])

    def write(i: int, received: int) -> None:
        _, v, omega = log.commands[i]
        bag.command("/cmd_vel", stamps[i], v=v, omega=omega, frame_id="base_link", received_ns=received)

    return _messages(_received(scene, "command", stamps), write)


def _wheels(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """``/odom`` and ``/joint_states``: both from one reading of the encoders, one packet."""
    robot = scene.scenario.robot
    every, ticks = _ticks(log, scene.scenario.rates.odometry)
    stamps, late = _stamps(log.stamps_s[ticks]), round(1e9 * scene.installed.wheels.time_offset_s)
    names = wheel_names(robot)
    noise = channel_rng(scene.seed, "effort").normal(0, robot.motor.effort_noise_nm, (len(ticks), len(names)))
    twist_cov = np.diag([_ODOMETRY_VARIANCE[0], 1e-6, 1e-6, 1e-6, 1e-6, _ODOMETRY_VARIANCE[1]])
    reached: FloatArray | None = None

    def make(first: int, last: int) -> tuple[FloatArray, ...]:
        nonlocal reached
        poses, twists = odometry(log, robot, every, slice(first, last), reached)
        reached = poses[-1]
        angles, turned = encoders(log, robot, every, slice(first, last))
        effort = mean_over(log.torques, every, first, last) + noise[first:last]
        return poses, twists, angles, turned / (every * TICK_S), effort

    rows = Rows(log, ticks, make)

    def write_odometry(i: int, received: int) -> None:
        (poses, twists, *_), k = rows.at(i)
        bag.odometry("/odom", stamps[i] + late, poses[k], twists[k], received, (None, twist_cov))

    def write_joints(i: int, received: int) -> None:
        (*_, angles, rates, effort), k = rows.at(i)
        bag.joints("/joint_states", stamps[i] + late, names, angles[k], rates[k], effort[k], received_ns=received)

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
        forward, left, turn = true[k] - (wheels[k, 0], 0.0, wheels[k, 1])
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
    """What the installer believes of where camera and IMU are: the IMU is level."""
    camera = scene.installed.believed.camera
    assert camera is not None
    mounted = {
        "camera_optical": (camera.position, Rotation.from_matrix(camera.rotation).as_quat()),
        "imu_link": (scene.scenario.imu.position, np.array([0.0, 0.0, 0.0, 1.0])),
    }
    for frame, (position, quaternion) in mounted.items():
        yield (
            EPOCH_NS,
            partial(bag.static_transform, EPOCH_NS, "base_link", frame, position, tuple(quaternion), EPOCH_NS),
        )


def _images(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """Images and what is believed of their lens."""
    camera = scene.scenario.camera
    assert camera is not None
    quality = [cv2.IMWRITE_JPEG_QUALITY, camera.jpeg_quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    arrive = _Arrival(scene, log)
    for exposure in exposures(scene, log):
        stamp, received = arrive.of(exposure.stamp_s, exposure.exposure_s)

        def write(exposure: Exposure = exposure, stamp: int = stamp, received: int = received) -> None:
            data = cv2.imencode(".jpg", exposure.take(), quality)[1].tobytes()
            bag.compressed_image("/camera/image/compressed", stamp, data, received_ns=received)

        yield received, partial(_write_lens, scene, bag, stamp, received)
        yield received, write


def _corners(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """The corners that a detector finds in the images, and what is believed of their lens; nothing is rendered."""
    detector, arrive = CornerDetector(scene, log), _Arrival(scene, log)
    for shot in shots(scene, log):
        stamp, received = arrive.of(shot.start_s + 0.5 * shot.exposure_s, shot.exposure_s)

        def write(shot: Shot = shot, stamp: int = stamp, received: int = received) -> None:
            bag.corners("/camera/corners", stamp, detector.find(shot), received_ns=received)

        yield received, partial(_write_lens, scene, bag, stamp, received)
        yield received, write


class _Arrival:
    """Stamps and receive times of a camera's messages: in order, and the clock of the stamps may be late."""

    def __init__(self, scene: Scene, log: Log) -> None:
        camera, installed = scene.scenario.camera, scene.installed.camera
        assert camera is not None
        assert installed is not None
        self._rng = channel_rng(scene.seed, "latency of camera")
        n = round(log.stamps_s[-1] * camera.rate_hz) + 1
        self._late_s = iter(installed.time_offset_s + camera_jitter_s(scene.scenario.installation, scene.seed, n))
        self._latency = scene.scenario.latency.camera
        self._stamp = self._received = 0

    def of(self, taken_s: float, exposure_s: float) -> tuple[int, int]:
        """Stamp and receive time [ns] of the next exposure, by its middle and its length."""
        taken, (least, mean) = stamp_ns(taken_s), self._latency
        self._stamp = max(taken + round(1e9 * next(self._late_s)), self._stamp + 1)
        received = taken + round(1e9 * (0.5 * exposure_s + least + self._rng.exponential(mean)))
        self._received = max(received, self._received)
        return self._stamp, self._received


def _write_lens(scene: Scene, bag: BagWriter, stamp: int, received: int) -> None:
    camera, believed = scene.scenario.camera, scene.installed.believed.camera
    assert camera is not None
    assert believed is not None
    size = (camera.width, camera.height)
    bag.camera_info("/camera/camera_info", stamp, size, believed.matrix, believed.distortion, received_ns=received)


def _messages(received: Sequence[int], *write: Callable[[int, int], None]) -> Iterator[Message]:
    """Messages i = 0, 1, ... of one channel, each by all of its writers, which are given i and when it is received."""
    for i, at_ns in enumerate(received):
        for one in write:
            yield at_ns, partial(one, i, at_ns)


def _ticks(log: Log, rate_hz: float) -> tuple[int, IntArray]:
    """A message every so many ticks, and all of the ticks."""
    every = round(1.0 / rate_hz / TICK_S)
    return every, np.arange(0, len(log.stamps_s), every)


def _stamps(seconds: FloatArray) -> list[int]:
    return [int(s) for s in EPOCH_NS + np.round(seconds * 1e9).astype(np.int64)]


def _received(scene: Scene, channel: str, stamps: list[int]) -> list[int]:
    """When messages arrive: after a latency, never overtaking."""
    least, mean = getattr(scene.scenario.latency, channel)
    rng = channel_rng(scene.seed, f"latency of {channel}")
    late: IntArray = np.array(stamps) + np.round(1e9 * (least + rng.exponential(mean, len(stamps)))).astype(np.int64)
    return [int(s) for s in np.maximum.accumulate(late)]
