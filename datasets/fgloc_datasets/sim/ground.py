"""The ground as two functions of place: friction μ(x, y) and height z(x, y), both on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fgloc.types import FloatArray
from fgloc_datasets.sim.floor import Humps, Patch, Ramp, RandomPatches, Rough
from fgloc_datasets.sim.scenario import World
from fgloc_datasets.sim.section import channel_rng

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
