"""The installation as a state: what map, camera, clocks, wheels and gyro are off by, estimated beside the poses.

The state θ ``(n,)`` holds deviations from the given map and configuration. Each has a prior sigma; one of sigma 0 is
taken as exact and is no state. What can't be observed stays at its prior, and its sigma reaches the pose's covariance
through the joint covariance of pose and θ.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from fgloc.config import Config
from fgloc.sensors import registry
from fgloc.sensors.base import Parameter
from fgloc.stats import PRIOR_GATE, SURE_SIGMAS
from fgloc.types import Board, FloatArray, IntArray, Landmark, LandmarkMap

CAMERA = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "focal", "cx_px", "cy_px", "k1", "k2", "time_offset_s")
SENSOR = ("range_scale", "bearing_offset_rad", "time_offset_s")
PLACE = ("x_m", "y_m")  # of that sensor in the base frame, where it may be off: behind the others in its block
MARKER = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
POINT = ("x_m", "y_m")
VACANT, VACANT_SIGMA = "vacant", 10.0  # rows that no landmark has now; their sigma [m, rad] is that of anything
GROUND = ("ground.z_m", "ground.roll_rad", "ground.pitch_rad")
LENGTH, HEADING, TURN = "length", "heading", "turn"
# What constants of sightings change alike: distances, the direction of landmarks while the robot turns, the turn
_EFFECTS = {
    "sightings.range_scale": (LENGTH,),
    "sightings.bearing_offset_rad": (HEADING,),
    "sightings.time_offset_s": (HEADING,),
}
_EFFECTS_OF_CAMERA = {"focal": (LENGTH,), "ry_rad": (HEADING,), "time_offset_s": (HEADING,)}
_ANEW_M, _ANEW_RAD = 0.1, 0.3  # sigmas of a mounting that is found anew, about what it was
_GROUND_SIGMAS = (0.3, 0.15, 0.15)  # m, rad, rad: of a robot somewhere on an uneven floor; ramps of 15° are 0.26 rad
_SENSORS = ("camera", "cameras", "sightings")  # first part of the names of parameters of what sees landmarks
_CLOCK_OF_CAMERA, _CLOCK_OF_SIGHTINGS = 11, 2  # row of the clock within its block


def camera_block(name: str) -> str:
    """Block of a camera's parameters: ``camera``; ``cameras.front`` of one of several."""
    return f"cameras.{name}" if name else "camera"


def _vacant_names(first: int, end: int, width: int) -> tuple[str, ...]:
    """Names of rows that no landmark has, of slots of this width."""
    return tuple(f"map.{VACANT}{i - (i - first) % width}.{MARKER[(i - first) % width]}" for i in range(first, end))


def is_vacant(name: str) -> bool:
    """Whether a parameter of this name belongs to no landmark now."""
    return name.startswith(f"map.{VACANT}")


@dataclass(frozen=True, slots=True, eq=False)
class InstallationEstimate:
    """Mean ``(n,)`` and covariance ``(n, n)`` of the installation state."""

    mean: FloatArray
    cov: FloatArray

    def anew(self, rows: IntArray, cov: FloatArray, mean: FloatArray | None = None) -> Self:
        """Copy with nothing but this known of rows ``(k,)``: a covariance ``(k, k)`` and, if given, a mean ``(k,)``."""
        means, covs = self.mean.copy(), self.cov.copy()
        covs[rows], covs[:, rows] = 0.0, 0.0
        covs[np.ix_(rows, rows)] = cov
        if mean is not None:
            means[rows] = mean
        return replace(self, mean=means, cov=covs)


@dataclass(frozen=True, slots=True, eq=False)
class BoardPrior:
    """Prior of the markers of a rigid board, which are displaced together."""

    ids: tuple[int, ...]  # of its k markers
    derivative: FloatArray  # (6 k, 6) of their poses by the board's
    cov: FloatArray  # (6, 6) of the board's pose
    own: FloatArray  # (6,) variances of each marker's pose on the board

    def joint(self, rows: IntArray) -> FloatArray:
        """Covariance ``(m, m)`` of some rows ``(m,)`` of the markers' poses."""
        A = self.derivative[rows]
        return np.asarray(A @ self.cov @ A.T + np.diag(self.own[rows % len(MARKER)]))

    def alone(self) -> Iterator[tuple[int, FloatArray]]:
        """Each marker, and the covariance ``(6, 6)`` of its pose."""
        for j, i in enumerate(self.ids):
            yield i, self.joint(np.arange(len(MARKER) * j, len(MARKER) * (j + 1)))


class Installation:
    """Names, priors and places of all parameters in the state.

    Camera translation and rotation are right perturbations in the optical frame (x right, y down, z forward); a
    marker's translation is in the map frame, its rotation in its own.

    A map may have more landmarks than can be states. Then those seen last are: each takes vacant rows, and gives them
    up again (`occupy`, `vacate`); there are few at first (`grow`). The others are `stateless`.

    Attributes:
        names: ``section.parameter``, of markers ``map.ID.parameter``, of several cameras ``cameras.NAME.parameter``.
        sigmas: ``(n,)`` of the prior.
        blocks: rows ``(first, count)`` of `camera_block` and "sightings", where there are such.
        landmarks: likewise, by id; 6 rows for a marker seen by its corners, else 2.
        stateless: prior covariance of the places of landmarks that are no states now, ``(6, 6)`` or ``(2, 2)``, by id.
        most: how many landmarks of such a map can be states at a time.
        ground: on uneven ground the last three rows are `GROUND`: height, roll and pitch of the base. They are of the
            newest pose; in the graph each keyframe has its own.
        effects: what a constant changes; constants of one effect may be taken for one another.
        length: constants that change the length of motions, and no turn, if all change alike.
        gates: sigmas of the gates of those that may change by more than their prior says.
        constants: how many rows are the same for all poses: all, or all but those.
    """

    def __init__(
        self,
        parameters: Mapping[str, float],
        landmark_cov: Mapping[int, FloatArray] | None = None,
        effects: Mapping[str, Sequence[str]] | None = None,
        length: Sequence[str] = (),
        gates: Mapping[str, float] | None = None,
        boards: Sequence[BoardPrior] = (),
    ) -> None:
        """Set prior sigmas by name; those of one block in the order of `CAMERA`, `SENSOR`, `MARKER` or `POINT`.

        Args:
            parameters: prior sigmas; one of 0 is left out but in a block that holds others (there it is a state that
                is held).
            landmark_cov: covariance of landmarks for which the map gives it, as `Landmark` has it; what it leaves out
                (z, the rotation) keeps its sigma, what is no state is passed over.
            effects: as the attribute; default: none is known.
            length: likewise.
            gates: likewise.
            boards: those whose markers are displaced together.
        """
        blocks = {_block(name) for name, s in parameters.items() if s > 0.0} - {""}
        blocks |= {f"map.{i}" for i in landmark_cov or {}}
        kept = {name: s for name, s in parameters.items() if s > 0.0 or _block(name) in blocks}
        self.names = tuple(kept)
        self.effects = {name: tuple(effects[name]) for name in kept if effects and name in effects}
        self.length = tuple(name for name in length if kept.get(name))
        self.gates = {name: sigma for name, sigma in (gates or {}).items() if kept.get(name)}
        sigmas = np.array(list(kept.values()))
        self.index = {name: i for i, name in enumerate(self.names)}
        self.blocks: dict[str, tuple[int, int]] = {}
        self.landmarks: dict[int, tuple[int, int]] = {}
        self.stateless: dict[int, FloatArray] = {}
        self.most = 0
        self._width = len(POINT)  # rows of each landmark of such a map: of a marker's, if it has one
        self._vacant: list[int] = []
        for i, name in enumerate(self.names):
            section, *rest = name.split(".")
            if section == "map":
                first, count = self.landmarks.get(int(rest[0]), (i, 0))
                self.landmarks[int(rest[0])] = (first, count + 1)
            elif section in _SENSORS:
                block = _block(name)
                first, count = self.blocks.get(block, (i, 0))
                self.blocks[block] = (first, count + 1)
        self.ground = self.names[-len(GROUND) :] == GROUND
        self.constants = len(kept) - len(GROUND) * self.ground
        self._prior_cov = np.diag(np.maximum(sigmas, _HELD) ** 2)
        for landmark_id, cov in (landmark_cov or {}).items():
            if landmark_id in self.landmarks:
                first, count = self.landmarks[landmark_id]
                n = min(count, len(cov))
                self._prior_cov[first : first + n, first : first + n] = cov[:n, :n]
        self._boards = boards
        for board in boards:
            rows, of = self._rows_on(board)
            self._prior_cov[np.ix_(rows, rows)] = board.joint(of)
        self.sigmas = np.sqrt(np.diag(self._prior_cov))
        self._prior_mean = np.zeros(len(kept))

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def motion_rows(self) -> IntArray:
        """Rows of the parameters that belong neither to landmarks nor to the sensor that sees them."""
        of_sensors = {first + i for first, count in self.blocks.values() for i in range(count)}
        return np.array(
            [i for i, name in enumerate(self.names) if i not in of_sensors and not name.startswith("map.")],
            dtype=np.int64,
        )

    def grow(self) -> slice:
        """Add vacant rows, behind those that are the same for all poses, as long as there may be more.

        Returns:
            The rows.
        """
        slots, width = len(self.landmarks) + self.vacancies, self._width
        count, at = width * max(min(self.most - slots, _SLOTS), 0), self.constants
        self.names = (*self.names[:at], *_vacant_names(at, at + count, width), *self.names[at:])
        self.index = {name: i for i, name in enumerate(self.names)}
        self._vacant += range(at, at + count, width)
        self._prior_cov = np.insert(np.insert(self._prior_cov, [at] * count, 0.0, axis=0), [at] * count, 0.0, axis=1)
        self._prior_mean = np.insert(self._prior_mean, [at] * count, 0.0)
        rows = slice(at, at + count)
        self._prior_cov[rows, rows] = VACANT_SIGMA**2 * np.eye(count)
        self.sigmas = np.insert(self.sigmas, [at] * count, VACANT_SIGMA)
        self.constants += count
        return rows

    def _rows_on(self, board: BoardPrior) -> tuple[IntArray, IntArray]:
        """Rows ``(m,)`` of the markers of a board that are states, and which of all of its markers they are."""
        places = [(*self.landmarks[i], len(MARKER) * j) for j, i in enumerate(board.ids) if i in self.landmarks]
        pairs = [(first + r, at + r) for first, count, at in places for r in range(count)]
        rows, of = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
        return rows, of

    def boards_found(self, belief: InstallationEstimate) -> Iterator[tuple[tuple[int, ...], FloatArray]]:
        """Markers of each board whose markers are all states, and the covariance ``(6, 6)`` of the board's pose now.

        Left out: where by rounding it is none.
        """
        for board in self._boards:
            if all(i in self.landmarks for i in board.ids):
                rows, of = self._rows_on(board)
                A = board.derivative[of]
                weighted = A.T / board.own[of % len(MARKER)]
                left = np.linalg.inv(np.linalg.inv(board.cov) + weighted @ A)  # if the markers' poses were known
                gain = left @ weighted
                cov = left + gain @ belief.cov[np.ix_(rows, rows)] @ gain.T
                if np.linalg.eigvalsh(cov)[0] > 0.0:
                    yield board.ids, 0.5 * (cov + cov.T)

    @property
    def vacancies(self) -> int:
        """How many more landmarks can become states."""
        return len(self._vacant)

    def occupy(self, landmark_id: int) -> slice:
        """Make a stateless landmark a state, in vacant rows.

        Returns:
            The rows; their prior is that of the landmark now.
        """
        cov, first = self.stateless.pop(landmark_id), self._vacant.pop()
        rows = slice(first, first + len(cov))
        self.landmarks[landmark_id] = first, len(cov)
        self._rename(rows, (f"map.{landmark_id}.{name}" for name in (MARKER if len(cov) > len(POINT) else POINT)))
        self._prior_cov[rows, rows] = cov
        self.sigmas[rows] = np.sqrt(np.diag(cov))
        return rows

    def vacate(self, landmark_id: int) -> slice:
        """Make a landmark stateless again.

        Returns:
            Its rows; their prior is that of vacant ones now.
        """
        first, count = self.landmarks.pop(landmark_id)
        rows = slice(first, first + count)
        self.stateless[landmark_id] = self._prior_cov[rows, rows].copy()
        self._rename(rows, _vacant_names(first, first + count, len(MARKER)))
        self._prior_cov[rows, rows] = VACANT_SIGMA**2 * np.eye(count)
        self.sigmas[rows] = VACANT_SIGMA
        self._vacant.append(first)
        return rows

    def mounting(self, kind: str) -> tuple[IntArray, FloatArray]:
        """Rows of the mounting of a sensor, and the variance of each about what it was, if it is found anew.

        Args:
            kind: of its sightings (`LandmarkMeasurement.row_kind`).
        """
        camera, _, made = kind.rpartition("/")
        block, parts = (camera_block(camera), CAMERA[:6]) if made == "corners" else ("sightings", (SENSOR[1], *PLACE))
        names = [name for name in (f"{block}.{part}" for part in parts) if name in self.index]
        anew = [_ANEW_RAD if name.endswith("_rad") else _ANEW_M for name in names]
        return np.array([self.index[name] for name in names], dtype=np.int64), np.square(anew)

    def with_mounting(self, kind: str, name: str) -> Installation:
        """Copy with a knocked camera a second time, as another one of this name: its mounting may be another.

        Args:
            kind: of its sightings; that of no camera is none of several: the copy is as this one.
            name: of the camera since then.
        """
        camera, _, made = kind.rpartition("/")
        if made != "corners" or camera_block(camera) not in self.blocks:
            return self
        first, count = self.blocks[camera_block(camera)]
        rows, at = np.arange(first, first + count), self.constants
        other = copy.copy(self)
        for cached in ("_gated", "_least_spread", "motion_rows"):
            other.__dict__.pop(cached, None)
        mounting, knock = self.mounting(kind)
        apart = 1e-6 * self._prior_cov[rows, rows]  # what is still the same: constants of the lens, and the clock
        apart[mounting - first] = knock
        added = self._prior_cov[rows]  # rows of what is to be added ...
        cov = np.insert(np.insert(self._prior_cov, [at] * count, added, axis=0), [at] * count, 0.0, axis=1)
        new = np.arange(at, at + count)
        cov[:, new] = cov[new].T  # ... wherever they are no landmarks'
        cov[np.ix_(new, new)] = self._prior_cov[np.ix_(rows, rows)] + np.diag(apart)
        other._prior_cov, other._prior_mean = cov, np.insert(self._prior_mean, [at] * count, self._prior_mean[rows])
        other.sigmas = np.sqrt(np.diag(cov))
        names = [f"{camera_block(name)}.{part}" for part in CAMERA]
        other.names = (*self.names[:at], *names, *self.names[at:])
        other.index = {n: i for i, n in enumerate(other.names)}
        other.blocks = {**self.blocks, camera_block(name): (at, count)}
        other.constants += count
        other.gates = {**self.gates, **dict.fromkeys(names, math.inf)}
        return other

    def widen_gate(self, rows: IntArray, variances: FloatArray) -> None:
        """Allow constants to be further off their prior than it says, by variances ``(k,)``."""
        for i, variance in zip(rows.tolist(), variances.tolist(), strict=True):
            name = self.names[i]
            self.gates[name] = math.hypot(self.gates.get(name, float(self.sigmas[i])), math.sqrt(variance))
        self.__dict__.pop("_least_spread", None)

    def _rename(self, rows: slice, names: Iterable[str]) -> None:
        changed = list(self.names)
        changed[rows] = [name for name, _ in zip(names, changed[rows], strict=False)]
        self.names = tuple(changed)
        self.index = {name: i for i, name in enumerate(self.names)}

    def with_states(self, ids: Iterable[int]) -> Installation:
        """Copy in which just these landmarks are states, and no rows are vacant."""
        kept = [i for i, name in enumerate(self.names) if not name.startswith("map.")]
        covs = {i: self._prior_cov[f : f + n, f : f + n] for i, (f, n) in self.landmarks.items()} | self.stateless
        chosen = {i: covs[i] for i in sorted(ids)}
        own = {self.names[i]: float(self.sigmas[i]) for i in kept}
        ground = {name: own.pop(name) for name in GROUND if name in own}
        places = {
            f"map.{i}.{name}": math.sqrt(v)
            for i, cov in chosen.items()
            for name, v in zip(MARKER, np.diag(cov).tolist(), strict=False)
        }
        other = Installation(own | places | ground, chosen, self.effects, self.length, self.gates, self._boards)
        rows = [other.index[self.names[i]] for i in kept]
        other._prior_cov[np.ix_(rows, rows)] = self._prior_cov[np.ix_(kept, kept)]
        other._prior_mean[rows] = self._prior_mean[kept]
        other.stateless = {i: cov for i, cov in covs.items() if i not in chosen}
        return other

    def prior(self) -> InstallationEstimate:
        """Mean and covariance of the installation before any measurement."""
        return InstallationEstimate(self._prior_mean.copy(), self._prior_cov.copy())

    def beyond_gate(self, belief: InstallationEstimate) -> tuple[str, ...]:
        """Constants that measurements put further off than the gate of their prior, the furthest first.

        No landmark, and none that is taken as exact.

        What measurements say lies beyond what was found, which the prior pulls: as `Setting.off` has it.
        The gate of a constant of `gates` is no narrower than that.
        """
        rows = self._gated
        off = np.abs(belief.mean[rows] - self._prior_mean[rows])
        prior, found = np.diag(self._prior_cov)[rows], np.diag(belief.cov)[rows]
        spread = np.maximum(np.sqrt(np.maximum(prior - found, _UNSEEN * prior)), self._least_spread)
        beyond = (off > PRIOR_GATE * spread) & (off > SURE_SIGMAS * np.sqrt(np.maximum(found, 0.0)))
        order = np.argsort(-off / spread, kind="stable")
        return tuple(self.names[rows[i]] for i in order if beyond[i])

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the estimated constants, without landmarks."""
        return tuple(self.names[i] for i in self._gated)

    @cached_property
    def _gated(self) -> IntArray:
        """Rows of the constants that have a prior to leave."""
        own = [i for i, name in enumerate(self.names[: self.constants]) if not name.startswith("map.")]
        return np.array([i for i in own if self.sigmas[i] > _HELD], dtype=np.int64)

    @cached_property
    def _least_spread(self) -> FloatArray:
        """Least sigma ``(n,)`` of the gates of those rows."""
        return np.array([self.gates.get(self.names[i], 0.0) for i in self._gated])

    def with_sigmas(self, held: Iterable[str], freed: Mapping[str, float]) -> Installation:
        """Copy with some parameters held as exact at their given values, some free together in one direction.

        Args:
            held: constants that are taken as exact.
            freed: prior sigmas of those that are free; of several they change in this proportion.
        """
        other = copy.copy(self)
        for cached in ("_gated", "_least_spread"):
            other.__dict__.pop(cached, None)
        other.sigmas, other._prior_cov = self.sigmas.copy(), self._prior_cov.copy()
        for name, sigma in {**dict.fromkeys(held, _HELD), **freed}.items():
            i = self.index[name]
            other._prior_cov[i], other._prior_cov[:, i] = 0.0, 0.0
            other._prior_cov[i, i], other.sigmas[i] = _HELD**2, sigma
        rows = [self.index[name] for name in freed]
        other._prior_cov[np.ix_(rows, rows)] += np.outer(list(freed.values()), list(freed.values()))
        return other

    def measured(self, row: FloatArray, value: float, sigma: float) -> None:
        """Update the prior by a measurement of the parameters.

        Args:
            row: ``(n,)`` derivative of what was measured by the parameters.
            value: measured, less what it would be if all parameters were 0.
            sigma: of the measurement.
        """
        gain = self._prior_cov @ row / (row @ self._prior_cov @ row + sigma**2)
        self._prior_mean = self._prior_mean + gain * (value - row @ self._prior_mean)
        cov = self._prior_cov - np.outer(gain, row @ self._prior_cov)
        self._prior_cov = 0.5 * (cov + cov.T)

    def time_offset(self, belief: InstallationEstimate, camera: str = "") -> float:
        """How much later than the exposure the stamps of the sightings are, as far as is known [s].

        Args:
            belief: of the installation.
            camera: name of the one that they are of, among several.
        """
        for block, row in ((camera_block(camera), _CLOCK_OF_CAMERA), ("sightings", _CLOCK_OF_SIGHTINGS)):
            if block in self.blocks:
                return float(belief.mean[self.blocks[block][0] + row])
        return 0.0


def _block(name: str) -> str:
    """Name of the block that a parameter belongs to; "" for a single one, which is a state if its sigma is not 0."""
    return name.rpartition(".")[0] if name.split(".")[0] in ("map", *_SENSORS) else ""


_UNSEEN = 1e-6  # share of its variance by which measurements make a constant surer that they say nothing of
_HELD = 1e-5  # sigma of a parameter that is taken as exact although its block is a state
MOST_LANDMARKS = 40  # that are states at a time, to bound the work of a step
_SLOTS = 8  # landmarks for which rows are added at a time


def installation_of(
    config: Config,
    landmark_map: LandmarkMap | None,
    corners: bool,
    has_gyro: bool = False,
    most: int | None = None,
    gains: Sequence[str] = ("scale",),
    sensed: Sequence[Parameter] = (),
    cameras: Sequence[str] = ("",),
) -> Installation:
    """The parameters of a run, with their priors.

    The clock of the gyro is what all others are compared to, as it alone sees how the robot itself moves; without a
    gyro it is that of the wheels.

    Args:
        config: the prior sigmas.
        landmark_map: the known map; None: landmarks are variables of their own, only motion has parameters here.
        corners: whether sightings are corners of markers in images; otherwise ranges and bearings, or marker poses.
        has_gyro: whether there is a gyro.
        most: landmarks of a map that are states at a time; of a larger map those that are seen (`Installation.occupy`).
            Default: `MOST_LANDMARKS`.
        gains: of the learned motion that may differ; none: there is no such motion.
        sensed: parameters of registered sensors.
        cameras: names of the cameras that see corners.
    """
    rb, most = config.landmarks, MOST_LANDMARKS if most is None else most
    roles = ["wheels", *(["gyro"] if has_gyro else []), *(f"learned.{gain}" for gain in gains)]
    parameters = (*registry.motion_parameters(config, roles), *sensed)
    sigmas = {parameter.name: parameter.sigma for parameter in parameters}
    effects: dict[str, tuple[str, ...]] = dict(_EFFECTS)
    effects |= {f"{camera_block(c)}.{name}": e for c in cameras for name, e in _EFFECTS_OF_CAMERA.items()}
    effects |= {parameter.name: parameter.effects for parameter in parameters}
    length = [parameter.name for parameter in parameters if parameter.lengthens]
    gates = {parameter.name: parameter.gate_sigma for parameter in parameters if parameter.gate_sigma > 0.0}
    ground = dict(zip(GROUND, _GROUND_SIGMAS, strict=True)) if config.estimator.ground == "uneven" else {}
    if landmark_map is None:
        return Installation(sigmas | ground, None, effects, length, gates)
    if corners:
        for name in cameras:
            camera = config.of_camera(name).camera
            m, r = camera.position_sigma_m, camera.rotation_sigma_rad
            focal, pp, k = camera.focal_sigma, camera.principal_sigma_px, camera.distortion_sigma
            values = (m, m, m, r, r, r, focal, pp, pp, k, k, camera.time_offset_sigma_s)
            sigmas |= {f"{camera_block(name)}.{key}": v for key, v in zip(CAMERA, values, strict=True)}
    else:
        sensor = (rb.range_scale_sigma, rb.bearing_bias_sigma_rad, rb.time_offset_sigma_s)
        sigmas |= {f"sightings.{name}": v for name, v in zip(SENSOR, sensor, strict=True)}
        if rb.position_sigma_m > 0.0:
            sigmas |= {f"sightings.{name}": rb.position_sigma_m for name in PLACE}
    by_id = dict(sorted(landmark_map.landmarks.items()))
    places = {i: _landmark_sigmas(landmark, config, corners) for i, landmark in by_id.items()}
    given = {i: landmark.cov for i, landmark in by_id.items() if landmark.cov is not None}
    boards = _boards(by_id.values(), config)
    given |= dict(pair for board in boards for pair in board.alone())
    if len(by_id) <= most:
        sigmas |= {f"map.{i}.{name}": v for i, place in places.items() for name, v in place.items()}
        return Installation(sigmas | ground, given, effects, length, gates, boards)
    # one by one markers of a board would tell more of it than they know together
    given |= {i: len(board.ids) * given[i] for board in boards for i in board.ids}
    made = Installation(sigmas | ground, None, effects, length, gates, boards)
    made.stateless = {
        i: _prior(place, given.get(i)) for i, place in places.items() if i in given or any(place.values())
    }
    made.most, made._width = most, max(map(len, made.stateless.values()), default=0)
    whole = ground or config.estimator.kind == "isam2"  # what holds all poses is not made anew for a few landmarks
    while made.stateless and made.vacancies < (most if whole else min(most, _SLOTS)):
        made.grow()
    return made


def _boards(landmarks: Iterable[Landmark], config: Config) -> list[BoardPrior]:
    """Boards that are not known exactly."""
    m, r = config.map.position_sigma_m, config.map.rotation_sigma_rad
    on: dict[int, list[tuple[int, Board, FloatArray]]] = {}
    for landmark in landmarks:
        if landmark.board is not None and (m > 0.0 or landmark.board[0].cov is not None):
            on.setdefault(id(landmark.board[0]), []).append((landmark.landmark_id, *landmark.board))
    found = []
    for members in on.values():
        board = members[0][1]
        cov = np.diag([m**2] * 3 + [r**2] * 3) if board.cov is None else board.cov
        own = np.square([max(board.sigma_m, _HELD)] * 3 + [_HELD] * 3)
        ids, levers = tuple(i for i, _, _ in members), np.vstack([lever for _, _, lever in members])
        found.append(BoardPrior(ids, levers, cov, own))
    return found


def _landmark_sigmas(landmark: Landmark, config: Config, corners: bool) -> dict[str, float]:
    m, r = config.map.position_sigma_m, config.map.rotation_sigma_rad
    if corners and landmark.size_m > 0.0:
        return dict(zip(MARKER, (m, m, m, r, r, r), strict=True))
    return dict.fromkeys(POINT, m)


def _prior(place: Mapping[str, float], given: FloatArray | None) -> FloatArray:
    """Covariance of a landmark's place by these sigmas, where the map does not give it."""
    cov = np.diag(np.maximum(list(place.values()), _HELD) ** 2)
    if given is not None:
        n = min(len(cov), len(given))
        cov[:n, :n] = given[:n, :n]
    return cov
