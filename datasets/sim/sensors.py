"""What the robot's channels say about a log: streams of messages in the order of their arrival."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from datasets.bag import BagWriter
from datasets.convert import Message
from datasets.sim.camera import frames, light_level
from datasets.sim.installed import camera_jitter_s
from datasets.sim.mjcf import wheel_names
from datasets.sim.physics import TICK_S, Log, Scene, base_twist, slipping, wheel_twist
from datasets.sim.positioning import gnss_places, uwb_ranges
from datasets.sim.scenario import Gnss, Robot, Uwb
from datasets.sim.section import channel_rng
from fgloc import se2
from fgloc.frames import quaternion_matrix, rpy_matrix
from fgloc.types import FloatArray, IntArray

EPOCH_NS = 1_760_000_000_000_000_000  # time 0 of every run
FULL_LIGHT_LUX = 500.0
_GRAVITY = np.array([0.0, 0.0, 9.81])
_LIGHT_HZ = 10.0
_ODOMETRY_VARIANCE = (4e-4, 2.5e-3)  # of v and ω: a constant that the driver sends, as drivers do


def streams(scene: Scene, log: Log, bag: BagWriter, camera: bool) -> list[Iterator[Message]]:
    """All channels of a run, to be merged by their receive times."""
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
    if camera and scene.scenario.camera is not None:
        channels += [_mounting(scene, bag), _images(scene, log, bag)]
    return channels


def stamp_ns(seconds: float) -> int:
    """Stamp of a time of the log."""
    return EPOCH_NS + round(seconds * 1e9)


def odometry(log: Log, robot: Robot, every: int) -> tuple[FloatArray, FloatArray]:
    """What the robot's driver makes of its encoders every ``every`` ticks.

    Returns:
        Poses ``(n, 3)`` and twists ``(n, 2)`` (v, ω) of the last interval, by the *nominal* radii and track.
    """
    angles = encoder_angles(log, robot)[::every]
    turned = np.diff(angles, axis=0, prepend=angles[:1])
    left = turned[:, 0::2].mean(axis=1) * robot.radius_m
    right = turned[:, 1::2].mean(axis=1) * robot.radius_m
    along, turn = 0.5 * (left + right), (right - left) / (robot.track_m * robot.track_scale)
    poses = np.zeros((len(angles), 3))
    for i in range(1, len(poses)):
        poses[i] = se2.compose(poses[i - 1], se2.exp((along[i], 0.0, turn[i])))
    return poses, np.column_stack([along, turn]) / (every * TICK_S)


def encoder_angles(log: Log, robot: Robot) -> FloatArray:
    """Wheel angles ``(n, wheels)`` in whole encoder ticks [rad]."""
    tick = 2.0 * math.pi / robot.ticks_per_turn
    return np.asarray(np.floor(log.wheel_angles / tick) * tick)


def _commands(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    stamps = _stamps(log.commands[:, 0])
    for stamp, received, (_, v, omega) in zip(stamps, _received(scene, "command", stamps), log.commands, strict=True):
        yield _message(bag.command, received, "/cmd_vel", stamp, v=v, omega=omega, frame_id="base_link")


def _wheels(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """``/odom`` and ``/joint_states``: both from one reading of the encoders, one packet."""
    robot = scene.scenario.robot
    every = round(1.0 / scene.scenario.rates.odometry / TICK_S)
    poses, twists = odometry(log, robot, every)
    angles = encoder_angles(log, robot)[::every]
    rates = np.diff(angles, axis=0, prepend=angles[:1]) / (every * TICK_S)
    rng = channel_rng(scene.seed, "effort")
    effort = _mean_over(log.torques, every) + rng.normal(0, robot.motor.effort_noise_nm, angles.shape)
    names = wheel_names(robot)
    twist_cov = np.diag([_ODOMETRY_VARIANCE[0], 1e-6, 1e-6, 1e-6, 1e-6, _ODOMETRY_VARIANCE[1]])
    stamps, late = _stamps(log.stamps_s[::every]), round(1e9 * scene.installed.wheels.time_offset_s)
    for i, received in enumerate(_received(scene, "odometry", stamps)):
        stamp = stamps[i] + late
        yield _message(bag.odometry, received, "/odom", stamp, poses[i], twists[i], twist_cov=twist_cov)
        yield _message(bag.joints, received, "/joint_states", stamp, names, angles[i], rates[i], effort[i])


def _imu(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    imu, installed = scene.scenario.imu, scene.installed.imu
    every = round(1.0 / scene.scenario.rates.imu / TICK_S)
    rng = channel_rng(scene.seed, "imu")
    rates = _mean_over(log.rates, every)
    rotation = np.array([quaternion_matrix(q) for q in log.quaternions[::every]])
    arm = np.einsum("nij,nj->ni", rotation, np.cross(log.rates[::every], imu.position))
    speeds = log.velocities[::every] + arm
    dt = every * TICK_S
    force = np.einsum("nji,nj->ni", rotation, np.diff(speeds, axis=0, prepend=speeds[:1]) / dt + _GRAVITY)
    walk = rng.normal(0, imu.gyro_walk * math.sqrt(dt), rates.shape).cumsum(axis=0)
    R_base_imu = rpy_matrix(*installed.rpy)
    rates, force = installed.gyro_scale * rates @ R_base_imu, force @ R_base_imu
    gyro = rates + rng.normal(0, imu.gyro_bias, 3) + walk + rng.normal(0, imu.gyro_noise, rates.shape)
    accel = force + rng.normal(0, imu.accel_bias, 3) + rng.normal(0, imu.accel_noise, force.shape)
    stamps, late = _stamps(log.stamps_s[::every]), round(1e9 * installed.time_offset_s)
    for i, received in enumerate(_received(scene, "imu", stamps)):
        yield _message(
            bag.imu,
            received,
            "/imu",
            stamps[i] + late,
            gyro[i],
            accel[i],
            angular_velocity_variance=imu.gyro_noise**2,
            linear_acceleration_variance=imu.accel_noise**2,
        )


def _truth(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """``/truth``, ``/truth/slip`` (true minus wheel twist) and ``/truth/slipping``."""
    robot = scene.scenario.robot
    every = round(1.0 / scene.scenario.rates.truth / TICK_S)
    true, wheels = base_twist(log)[::every], wheel_twist(log, robot)[::every]
    slips = slipping(log, robot)[::every]
    stamps = _stamps(log.stamps_s[::every])
    for i, received in enumerate(_received(scene, "truth", stamps)):
        k = i * every
        yield _message(bag.truth, received, "/truth", stamps[i], log.positions[k], log.quaternions[k])
        forward, left, turn = true[i] - (wheels[i, 0], 0.0, wheels[i, 1])
        yield _message(bag.twist, received, "/truth/slip", stamps[i], (forward, left, 0.0), (0.0, 0.0, turn))
        yield _message(bag.flag, received, "/truth/slipping", bool(slips[i]))


def _light(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    seconds = np.arange(0.0, log.stamps_s[-1], 1.0 / _LIGHT_HZ)
    stamps = _stamps(seconds)
    for i, received in enumerate(_received(scene, "truth", stamps)):
        lux = FULL_LIGHT_LUX * light_level(scene.scenario.world.light, seconds[i])
        yield _message(bag.illuminance, received, "/truth/light", stamps[i], lux)


def _ranges(scene: Scene, uwb: Uwb, log: Log, bag: BagWriter) -> Iterator[Message]:
    numbers, seconds, readings = uwb_ranges(scene.scenario, uwb, log, scene.seed)
    stamps = _stamps(seconds)
    for i, received in enumerate(_received(scene, "uwb", stamps)):
        yield _message(bag.range_reading, received, "/uwb/range", stamps[i], readings[i], f"anchor_{numbers[i]}")


def _fixes(scene: Scene, gnss: Gnss, log: Log, bag: BagWriter) -> Iterator[Message]:
    seconds, places = gnss_places(gnss, log, scene.seed)
    stamps, variances = _stamps(seconds), (gnss.sigma_m**2, gnss.sigma_m**2, 4.0 * gnss.sigma_m**2)
    for i, received in enumerate(_received(scene, "gnss", stamps)):
        yield _message(bag.satellite_fix, received, "/gnss/fix", stamps[i], places[i], variances)


def _mounting(scene: Scene, bag: BagWriter) -> Iterator[Message]:
    """What the installer believes of where camera and IMU are: the IMU is level."""
    camera = scene.installed.believed.camera
    assert camera is not None
    yield _message(
        bag.static_transform,
        EPOCH_NS,
        EPOCH_NS,
        "base_link",
        "camera_optical",
        camera.position,
        quaternion_of(camera.rotation),
    )
    yield _message(
        bag.static_transform, EPOCH_NS, EPOCH_NS, "base_link", "imu_link", scene.scenario.imu.position, (0, 0, 0, 1)
    )


def _images(scene: Scene, log: Log, bag: BagWriter) -> Iterator[Message]:
    """Images and what is believed of their lens, received in order; the clock of the stamps may be late."""
    camera, believed, installed = scene.scenario.camera, scene.installed.believed.camera, scene.installed.camera
    assert camera is not None
    assert believed is not None
    assert installed is not None
    rng = channel_rng(scene.seed, "latency of camera")
    jitter = camera_jitter_s(scene.scenario.installation, scene.seed, round(log.stamps_s[-1] * camera.rate_hz) + 1)
    least, mean = scene.scenario.latency.camera
    last = last_stamp = 0
    quality = [cv2.IMWRITE_JPEG_QUALITY, camera.jpeg_quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    for frame, extra_s in zip(frames(scene, log), jitter, strict=False):
        taken = stamp_ns(frame.stamp_s)
        stamp = last_stamp = max(taken + round(1e9 * (installed.time_offset_s + extra_s)), last_stamp + 1)
        received = taken + round(1e9 * (0.5 * frame.exposure_s + least + rng.exponential(mean)))
        received = last = max(received, last)
        data = cv2.imencode(".jpg", frame.image, quality)[1].tobytes()
        yield _message(
            bag.camera_info,
            received,
            "/camera/camera_info",
            stamp,
            camera.width,
            camera.height,
            believed.matrix,
            believed.distortion,
        )
        yield _message(bag.compressed_image, received, "/camera/image/compressed", stamp, data)


def _message(write: Callable[..., None], received_ns: int, *args: object, **fields: object) -> Message:
    return received_ns, lambda: write(*args, **fields, received_ns=received_ns)


def _stamps(seconds: FloatArray) -> list[int]:
    return [int(s) for s in EPOCH_NS + np.round(seconds * 1e9).astype(np.int64)]


def _received(scene: Scene, channel: str, stamps: list[int]) -> list[int]:
    """When messages arrive: after a latency, never overtaking."""
    least, mean = getattr(scene.scenario.latency, channel)
    rng = channel_rng(scene.seed, f"latency of {channel}")
    late: IntArray = np.array(stamps) + np.round(1e9 * (least + rng.exponential(mean, len(stamps)))).astype(np.int64)
    return [int(s) for s in np.maximum.accumulate(late)]


def _mean_over(values: FloatArray, every: int) -> FloatArray:
    """Mean ``(n, d)`` of the ``every`` ticks up to each message; the first has one."""
    rows = values[1 : 1 + (len(values) - 1) // every * every].reshape(-1, every, values.shape[1])
    return np.concatenate([values[:1], rows.mean(axis=1)])


def quaternion_of(rotation: NDArray[np.float64]) -> FloatArray:
    """Quaternion x, y, z, w of a rotation matrix ``(3, 3)``."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_quat())
