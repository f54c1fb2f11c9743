"""The simulated world: markers on the walls of a room, its floor, and both with the robot as a MuJoCo model."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import mujoco
import numpy as np

from fgloc.frames import OPTICAL_TO_BODY, rpy_matrix
from fgloc.types import FloatArray, Landmark, LandmarkMap
from fgloc_datasets.sim.drives import Wheel, wheels
from fgloc_datasets.sim.scenario import (
    Camera,
    Humps,
    Motor,
    Patch,
    Payload,
    Ramp,
    RandomPatches,
    Robot,
    Rough,
    Scenario,
    World,
    channel_rng,
)

# --- Room -------------------------------------------------------------------------------------------------------------

_FROM_CORNER_M = 0.35
_GAP_M = 0.002  # in front of the wall


def make_map(world: World, seed: int) -> LandmarkMap:
    """Markers at nearly even distances around the room, their ids, places and heights drawn by the seed; and others."""
    rng = channel_rng(seed, "markers")
    spec = world.markers
    sx, sy = world.size_m
    runs = np.array([sx, sy, sx, sy]) - 2 * _FROM_CORNER_M
    ends = np.cumsum(runs)
    ids = rng.permutation(spec.count)
    landmarks = {}
    for i in range(spec.count):
        along = (i + 0.5 + rng.uniform(-0.2, 0.2)) * ends[-1] / spec.count
        wall = int(np.searchsorted(ends, along, side="right"))
        offset = along - (ends[wall] - runs[wall]) - 0.5 * runs[wall]  # from the wall's middle
        normal = np.array([(0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)][wall])
        up = np.array([0.0, 0.0, 1.0])
        right = np.cross(up, normal)
        depth = 0.5 * (sy if wall % 2 == 0 else sx) - _GAP_M
        position = -normal * depth - right * offset + up * rng.uniform(*spec.heights_m)
        rotation = np.column_stack([right, up, normal])
        if world.floor.tilt is not None:
            position = position + up * world.floor.tilt.height(position[0], position[1])
        marker_id = int(ids[i])
        landmarks[marker_id] = Landmark(marker_id, position.round(4), rotation, spec.size_m)
    for placed in spec.placed:
        rotation = _facing(placed.facing_deg, placed.elevation_deg, placed.roll_deg)
        landmarks[placed.id] = Landmark(placed.id, np.array(placed.position), rotation, spec.size_m)
    return LandmarkMap(dict(sorted(landmarks.items())), spec.dictionary)


def _facing(yaw_deg: float, elevation_deg: float, roll_deg: float) -> FloatArray:
    """Rotation ``(3, 3)`` of a marker whose normal has this yaw and elevation, turned about it."""
    turn = rpy_matrix(0.0, -math.radians(elevation_deg), math.radians(yaw_deg))
    upright = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # its right, up and normal, facing x
    return np.asarray(turn @ upright @ rpy_matrix(0.0, 0.0, math.radians(roll_deg)))


# --- Ground -----------------------------------------------------------------------------------------------------------

FRICTION_CELL_M = 0.02
HEIGHT_CELL_M = 0.04
_LAYER = np.iinfo(np.uint8).max


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Friction by cells of FRICTION_CELL_M; height at the corners of cells, None on level ground.

    Rows run along y, columns along x, both from the corner of the room with the smallest coordinates.
    """

    size_m: tuple[float, float]
    mu: FloatArray  # (rows, columns)
    height: FloatArray | None  # (rows, columns) m
    patches: tuple[Patch, ...]

    @property
    def low_m(self) -> float:
        """Height of the lowest ground, at most 0."""
        return 0.0 if self.height is None else min(float(self.height.min()), 0.0)

    @property
    def high_m(self) -> float:
        """Height of the highest ground, at least 0."""
        return 0.0 if self.height is None else max(float(self.height.max()), 0.0)

    def mu_at(self, x: float, y: float) -> float:
        """Friction coefficient at a place [m]; outside the room that of the nearest cell."""
        column = int((x + 0.5 * self.size_m[0]) / FRICTION_CELL_M)
        row = int((y + 0.5 * self.size_m[1]) / FRICTION_CELL_M)
        rows, columns = self.mu.shape
        return float(self.mu[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)])

    def height_at(self, x: float, y: float, reach_m: float = 0.0) -> float:
        """Highest ground [m] within ``reach_m`` of a place."""
        if self.height is None:
            return 0.0
        rows, columns = self.height.shape
        c = (x / self.size_m[0] + 0.5) * (columns - 1)
        r = (y / self.size_m[1] + 0.5) * (rows - 1)
        n = 1 + int(reach_m / HEIGHT_CELL_M)
        low_r, low_c = max(int(r) - n, 0), max(int(c) - n, 0)
        return float(self.height[low_r : int(r) + n + 1, low_c : int(c) + n + 1].max())


def make_ground(world: World, seed: int) -> Ground:
    """Lay patches and heights; those that are drawn are drawn by the seed."""
    floor = world.floor
    patches = floor.patches
    if floor.random_patches is not None:
        patches += _draw_patches(floor.random_patches, world, seed)
    height = None
    if floor.uneven:
        ramps = () if floor.ramp is None else (floor.ramp,)
        height = _heights(world, seed, (*ramps, *floor.ramps), floor.humps)
    return Ground(world.size_m, _friction(world, patches), height, patches)


def _friction(world: World, patches: tuple[Patch, ...]) -> FloatArray:
    columns, rows = (round(s / FRICTION_CELL_M) for s in world.size_m)
    mu = np.full((rows, columns), world.floor.mu)
    for patch in patches:
        mask = np.zeros(mu.shape, np.uint8)
        offset = np.asarray(patch.center) + 0.5 * np.asarray(world.size_m)
        cells = (outline(patch) + offset) / FRICTION_CELL_M - 0.5
        cv2.fillPoly(mask, [np.round(cells).astype(np.int32)], _LAYER)
        mu[mask > 0] = patch.mu
    return mu


def outline(patch: Patch) -> FloatArray:
    """Corners ``(n, 2)`` [m] of a patch about its center, turned by its yaw."""
    half = 0.5 * np.asarray(patch.size)
    if patch.shape == "polygon":
        points = np.asarray(patch.points, dtype=float).reshape(-1, 2)
    elif patch.shape == "rectangle":
        points = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    else:
        angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        points = np.column_stack([np.cos(angles), np.sin(angles)]) * half
    c, s = np.cos(np.radians(patch.yaw_deg)), np.sin(np.radians(patch.yaw_deg))
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def _draw_patches(spec: RandomPatches, world: World, seed: int) -> tuple[Patch, ...]:
    rng = channel_rng(seed, "patches")
    reach = 0.5 * np.asarray(world.size_m) - world.keep_off_m
    patches = []
    for _ in range(spec.count):
        shape = ("ellipse", "rectangle", "polygon")[int(rng.integers(3))]
        size = rng.uniform(*spec.size_m, 2)
        angles = np.sort(rng.uniform(0, 2 * np.pi, 7))
        radii = 0.5 * size.mean() * rng.uniform(0.6, 1.0, 7)
        corners = tuple((float(r * np.cos(a)), float(r * np.sin(a))) for r, a in zip(radii, angles, strict=True))
        center = rng.uniform(-reach, reach)
        patches.append(
            Patch(
                shape=shape,
                center=(float(center[0]), float(center[1])),
                size=(float(size[0]), float(size[1])),
                yaw_deg=float(rng.uniform(0, 180)),
                points=corners if shape == "polygon" else (),
                mu=float(rng.uniform(*spec.mu)),
            )
        )
    return tuple(patches)


def _heights(world: World, seed: int, ramps: tuple[Ramp, ...], humps: Humps | None) -> FloatArray:
    columns, rows = (round(s / HEIGHT_CELL_M) + 1 for s in world.size_m)
    x = np.linspace(-0.5, 0.5, columns) * world.size_m[0]
    y = (np.linspace(-0.5, 0.5, rows) * world.size_m[1])[:, None]
    height = np.zeros((rows, columns))
    for ramp in ramps:
        slope = np.tan(np.radians(ramp.angle_deg))
        corners = ramp.start_x + np.cumsum([0.0, ramp.rise_m, ramp.top_m, ramp.rise_m])
        profile = np.interp(x, corners, np.array([0.0, 1.0, 1.0, 0.0]) * ramp.rise_m * slope)
        side = np.clip((0.5 * ramp.width_m - np.abs(y - ramp.center_y)) / 0.6, 0.0, 1.0)  # shoulders, drivable
        height = np.maximum(height, profile * side)
    if humps is not None:
        rng = channel_rng(seed, "humps")
        reach = 0.5 * np.asarray(world.size_m) - world.keep_off_m
        for _ in range(humps.count):
            cx, cy = rng.uniform(-reach, reach)
            sigma, top = rng.uniform(*humps.sigma_m), rng.uniform(*humps.height_m)
            height = np.maximum(height, top * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2)))
    if world.floor.rough is not None:
        height = height + _roughness(world.floor.rough, (rows, columns), seed)
    if world.floor.tilt is not None:
        height = height + world.floor.tilt.height(x, y)
    return height


def _roughness(rough: Rough, shape: tuple[int, int], seed: int) -> FloatArray:
    """Smoothed white noise, scaled to the wanted height."""
    noise = channel_rng(seed, "rough").standard_normal(shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), rough.length_m / HEIGHT_CELL_M, borderType=cv2.BORDER_REFLECT)
    smooth -= 0.5 * (smooth.max() + smooth.min())
    return np.asarray(smooth * (rough.height_m / np.abs(smooth).max()))


# --- MuJoCo model -----------------------------------------------------------------------------------------------------

_CELL_PX = 64  # of a marker's texture
_CHASSIS_CLEARANCE_M = 0.04
_CASTER_RADIUS_M = 0.02
_STEERING_KP, _STEERING_KV, _STEERING_ARMATURE = 200.0, 3.0, 0.005  # Nm/rad, Nm s/rad, kg m²
_ROLLER_SHARE = 0.24  # thickness in the middle over the wheel's diameter
_ROLLER_MASS_KG, _ROLLER_ARMATURE, _ROLLER_DAMPING = 0.005, 1e-6, 1e-6


def camera_rotation(camera: Camera) -> FloatArray:
    """Rotation R_base_cam ``(3, 3)`` of the optical frame."""
    return optical_rotation(np.radians(camera.rpy_deg))


def optical_rotation(rpy: Sequence[float] | FloatArray) -> FloatArray:
    """Rotation ``(3, 3)`` of an optical frame whose forward looking body axes are turned by roll, pitch, yaw [rad]."""
    return np.asarray(rpy_matrix(*rpy) @ OPTICAL_TO_BODY)


def render_size(camera: Camera) -> tuple[int, int, float]:
    """Width and height of the undistorted render [px] that covers the lens's view, and its focal length [px]."""
    border = np.array(
        [(u, v) for u in np.linspace(-0.5, camera.width - 0.5, 33) for v in (-0.5, camera.height - 0.5)]
        + [(u, v) for u in (-0.5, camera.width - 0.5) for v in np.linspace(-0.5, camera.height - 0.5, 33)]
    )
    rays = cv2.undistortPoints(border[:, None], intrinsics(camera), np.asarray(camera.distortion))[:, 0]
    focal = camera.focal_px * camera.oversampling
    half = np.ceil(np.abs(rays).max(axis=0) * focal) + 4  # a few pixels for the blur
    return 2 * int(half[0]), 2 * int(half[1]), focal


def intrinsics(camera: Camera) -> FloatArray:
    """Camera matrix K ``(3, 3)``; the middle of the first pixel is (0, 0)."""
    f = camera.focal_px
    return np.array([[f, 0.0, camera.width / 2 - 0.5], [0.0, f, camera.height / 2 - 0.5], [0.0, 0.0, 1.0]])


def marker_texture(dictionary: str, marker_id: int) -> bytes:
    """PNG of a marker with one white cell around it."""
    d = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    cells = d.markerSize + 2
    bits = cv2.aruco.generateImageMarker(d, marker_id, cells)
    image = np.pad(bits, 1, constant_values=255).repeat(_CELL_PX, 0).repeat(_CELL_PX, 1)
    return bytes(cv2.imencode(".png", image)[1])


def build_model(scenario: Scenario, ground: Ground, landmarks: LandmarkMap) -> mujoco.MjModel:
    """Compile the model of a scenario."""
    assets: dict[str, bytes] = {}
    contact = scenario.robot.contact
    root = ET.Element("mujoco", model=scenario.name)
    _add(root, "compiler", angle="radian", autolimits="true")
    option = _add(
        root,
        "option",
        timestep=contact.timestep_s,
        integrator="implicitfast",
        cone="elliptic",
        impratio=contact.impratio,
    )
    _add(option, "flag", multiccd="enable" if ground.height is not None else "disable")
    _add(root, "statistic", extent=4.0, center=(0.0, 0.0, 0.5))
    visual = _add(root, "visual")
    _add(visual, "map", znear=0.005, zfar=10)
    _add(visual, "quality", offsamples=0, shadowsize=0)
    _add(visual, "headlight", ambient=(0.72, 0.72, 0.72), diffuse=(0.0, 0.0, 0.0), specular=(0.0, 0.0, 0.0))
    if scenario.cameras:
        sizes = [render_size(camera) for camera in scenario.cameras.values()]
        _add(visual, "global", offwidth=max(w for w, _, _ in sizes), offheight=max(h for _, h, _ in sizes))
    asset = _add(root, "asset")
    world = _add(root, "worldbody")
    _room(asset, world, scenario, ground)
    _markers(asset, world, landmarks, assets)
    _robot(root, world, scenario)
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"), assets)
    if ground.height is not None:
        model.hfield_data[:] = ((ground.height - ground.low_m) / (ground.high_m - ground.low_m)).ravel()
    return model


def _room(asset: ET.Element, world: ET.Element, scenario: Scenario, ground: Ground) -> None:
    sx, sy = (0.5 * s for s in scenario.world.size_m)
    _add(
        asset,
        "texture",
        name="floor",
        type="2d",
        builtin="checker",
        rgb1=(0.42, 0.42, 0.42),
        rgb2=(0.5, 0.5, 0.5),
        width=256,
        height=256,
    )
    _add(asset, "material", name="floor", texture="floor", texrepeat=(1, 1), texuniform="true", specular=0)
    _add(asset, "texture", type="skybox", builtin="flat", rgb1=(0.3, 0.3, 0.3), width=8, height=48)
    lamp = {"diffuse": (0.22, 0.22, 0.22), "ambient": (0, 0, 0), "specular": (0, 0, 0), "castshadow": "false"}
    _add(world, "light", type="directional", dir=(-0.5, 0.3, -0.6), pos=(0, 0, 3), **lamp)
    _add(asset, "material", name="wall", rgba=(0.62, 0.62, 0.62, 1), specular=0)
    if ground.height is None:
        _add(world, "geom", name="ground", type="plane", size=(sx, sy, 0.1), material="floor")
    else:
        rows, columns = ground.height.shape
        _add(asset, "hfield", name="h", nrow=rows, ncol=columns, size=(sx, sy, ground.high_m - ground.low_m, 0.1))
        _add(world, "geom", name="ground", type="hfield", hfield="h", material="floor", pos=(0, 0, ground.low_m))
    tilt = scenario.world.floor.tilt
    low, high = (0.0, 0.0) if tilt is None else (ground.low_m, ground.high_m)  # walls stand on a leaning floor
    h, z = 0.5 * (scenario.world.wall_height_m + high - low), 0.5 * (scenario.world.wall_height_m + high + low)
    for name, place, size in (
        ("east", (sx + 0.05, 0, z), (0.05, sy + 0.1, h)),
        ("west", (-sx - 0.05, 0, z), (0.05, sy + 0.1, h)),
        ("north", (0, sy + 0.05, z), (sx, 0.05, h)),
        ("south", (0, -sy - 0.05, z), (sx, 0.05, h)),
    ):
        _add(world, "geom", name=name, type="box", pos=place, size=size, material="wall", friction=(0.1, 0.001, 0.0001))


def _markers(asset: ET.Element, world: ET.Element, landmarks: LandmarkMap, assets: dict[str, bytes]) -> None:
    for marker_id, landmark in landmarks.landmarks.items():
        name = f"marker{marker_id}"
        assets[f"{name}.png"] = marker_texture(landmarks.dictionary, marker_id)
        cells = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, landmarks.dictionary)).markerSize + 2
        half = 0.5 * landmark.size_m * (cells + 2) / cells
        axes = (*landmark.rotation[:, 0], *landmark.rotation[:, 1])
        _add(asset, "texture", name=name, type="2d", file=f"{name}.png")
        _add(asset, "material", name=name, texture=name, specular=0)
        shared = {"xyaxes": axes, "contype": 0, "conaffinity": 0}
        place = {"pos": landmark.position, **shared}
        _add(world, "geom", name=name, type="plane", size=(half, half, 0.01), material=name, **place)
        _add(
            world,
            "geom",
            name=f"screen{marker_id}",
            type="box",
            size=(1.3 * half, 1.3 * half, 0.005),
            pos=landmark.position + 0.02 * landmark.rotation[:, 2],
            rgba=(0.35, 0.35, 0.35, 0),
            **shared,
        )


def _robot(root: ET.Element, world: ET.Element, scenario: Scenario) -> None:
    robot = scenario.robot
    base = _add(world, "body", name="base")
    _add(base, "freejoint", name="base")
    mass = robot.mass_kg - robot.wheel_mass_kg * len(wheels(robot))
    length, width, height = robot.chassis
    inertia = mass / 12 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    _add(base, "inertial", pos=robot.center_of_mass, mass=mass, diaginertia=inertia)
    middle = {"diff_drive": -0.05, "ackermann": 0.5 * robot.wheelbase_m}.get(robot.kind, 0.0)
    _add(
        base,
        "geom",
        name="chassis",
        type="box",
        size=(length / 2, width / 2, height / 2),
        pos=(middle, 0, _CHASSIS_CLEARANCE_M + height / 2),
        rgba=(0.2, 0.3, 0.6, 1),
        friction=(0.1, 0.001, 0.0001),
        **_touches(robot),
    )
    for name, camera in scenario.cameras.items():
        rotation = camera_rotation(camera)
        _, render_height, focal = render_size(camera)
        _add(
            base,
            "camera",
            name=name,
            pos=camera.position,
            xyaxes=(*rotation[:, 0], *-rotation[:, 1]),
            fovy=math.degrees(2 * math.atan(0.5 * render_height / focal)),
        )
    actuator = _add(root, "actuator")
    for wheel in wheels(robot):
        _wheel(base, robot, wheel)
        if wheel.driven:
            _motor(actuator, robot.motor, wheel.joint)
    for wheel in wheels(robot):
        if wheel.steered_by:
            _add(actuator, "position", name=wheel.steered_by, joint=wheel.steered_by, kp=_STEERING_KP, kv=_STEERING_KV)
    if robot.kind == "diff_drive":
        _caster(base, robot)
    if robot.payload is not None:
        _payload(base, actuator, robot.payload)


def _caster(base: ET.Element, robot: Robot) -> None:
    _add(
        base,
        "geom",
        name="caster",
        type="sphere",
        size=(_CASTER_RADIUS_M,),
        pos=(-robot.caster_behind_m, 0, _CASTER_RADIUS_M),
        condim=3,
        priority=3,
        friction=(robot.contact.caster_friction, 0.001, 0.0001),
        solref=robot.contact.solref,
        solimp=robot.contact.solimp,
        mass=0,
    )


def _wheel(base: ET.Element, robot: Robot, wheel: Wheel) -> None:
    name, place = wheel.joint.removesuffix("_joint"), (wheel.x, wheel.y, wheel.radius)
    if wheel.steered_by:
        base = _add(base, "body", name=wheel.steered_by.removesuffix("_joint"), pos=place)
        _add(base, "joint", name=wheel.steered_by, axis=(0, 0, 1), armature=_STEERING_ARMATURE)
        _add(base, "inertial", pos=(0, 0, 0), mass=0.05, diaginertia=(1e-5, 1e-5, 1e-5))
        place = (0.0, 0.0, 0.0)
    body = _add(base, "body", name=name, pos=place)
    motor = robot.motor
    turned = {"armature": motor.armature, "damping": motor.damping, "frictionloss": motor.friction_nm}
    _add(body, "joint", name=wheel.joint, axis=(0, 1, 0), **(turned if wheel.driven else {"damping": 1e-4}))
    rolls = {} if wheel.rollers else {"condim": 4, "priority": 1, **_tyre(robot)}
    _add(
        body,
        "geom",
        name=name,
        type="cylinder",
        size=(wheel.radius if not wheel.rollers else 0.6 * wheel.radius, robot.wheel_width_m / 2),
        euler=(math.pi / 2, 0, 0),
        mass=robot.wheel_mass_kg,
        **(rolls or {"contype": 0, "conaffinity": 0}),
        rgba=(0.1, 0.1, 0.1, 1),
    )
    if wheel.rollers:
        _rollers(body, robot, wheel)


def _touches(robot: Robot) -> dict[str, object]:
    """Attributes by which parts of the robot that overlap touch the room and not each other."""
    return {"conaffinity": 0} if robot.kind in ("ackermann", "mecanum") else {}


def _tyre(robot: Robot) -> dict[str, object]:
    contact = robot.contact
    return {
        **_touches(robot),
        "friction": (0.8, contact.torsional_friction, contact.rolling_friction),
        "solref": contact.solref,
        "solimp": contact.solimp,
    }


def _rollers(hub: ET.Element, robot: Robot, wheel: Wheel) -> None:
    """Rollers of a mecanum wheel: ellipsoids whose axes lie at 45° to the axle, with joints of their own.

    Their curvature along the axis makes the wheel round: a point of the axis at s from its middle is farther from the
    axle by s² / 4d, where d is the distance of the middle, and the ellipsoid of half length √(2 d ρ) is thinner by as
    much (to second order).
    """
    thick = _ROLLER_SHARE * wheel.radius
    middle = wheel.radius - thick
    for k in range(robot.rollers):
        angle = math.tau * k / robot.rollers
        c, s = math.cos(angle), math.sin(angle)
        along = np.array([c, wheel.rollers, -s]) / math.sqrt(2.0)  # (1, ±1, 0) / √2 of the lowest, about the axle
        name = f"{wheel.joint.removesuffix('_joint')}_roller{k}"
        body = _add(hub, "body", name=name, pos=(-middle * s, 0.0, -middle * c))
        _add(body, "joint", name=f"{name}_joint", axis=along, armature=_ROLLER_ARMATURE, damping=_ROLLER_DAMPING)
        _add(
            body,
            "geom",
            name=name,
            type="ellipsoid",
            size=(thick, thick, math.sqrt(2.0 * middle * thick)),
            zaxis=along,
            mass=_ROLLER_MASS_KG,
            condim=3,  # a point: no torsional friction
            priority=1,
            **_tyre(robot),
            rgba=(0.2, 0.2, 0.2, 1),
        )


def _motor(actuator: ET.Element, motor: Motor, joint: str) -> None:
    """Torque = K (u - k ω): a DC motor without inductance, driven by its voltage u."""
    torque_per_volt = motor.stall_torque_nm / motor.supply_v
    drag = motor.stall_torque_nm / motor.no_load_rad_s
    _add(
        actuator,
        "general",
        name=joint,
        joint=joint,
        ctrlrange=(-motor.supply_v, motor.supply_v),
        gainprm=(torque_per_volt,),
        biastype="affine",
        biasprm=(0, 0, -drag),
    )


def _payload(base: ET.Element, actuator: ET.Element, payload: Payload) -> None:
    rail = np.subtract(payload.end, payload.start)
    body = _add(base, "body", name="payload", pos=payload.start)
    _add(body, "joint", name="payload", type="slide", axis=rail / np.linalg.norm(rail), damping=20)
    _add(
        body,
        "geom",
        type="box",
        size=(0.05, 0.05, 0.03),
        mass=payload.mass_kg,
        contype=0,
        conaffinity=0,
        rgba=(0.6, 0.4, 0.2, 1),
    )
    _add(actuator, "position", name="payload", joint="payload", kp=800, kv=150)


def _add(parent: ET.Element, tag: str, **attributes: object) -> ET.Element:
    return ET.SubElement(parent, tag, {key: _text(value) for key, value in attributes.items()})


def _text(value: object) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, Sequence | np.ndarray):
        return " ".join(repr(float(v)) for v in value)
    return repr(value)
