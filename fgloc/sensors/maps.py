"""Marker maps: our YAML, TagSLAM's YAML, WPILib's field JSON and plain lists of points.

Our format, all in metres and radians::

    dictionary: DICT_4X4_50   # OpenCV's name
    size: 0.2                 # side of the black square, for markers that give none
    landmarks:
      - {id: 0, position: [4.0, 1.5, 0.5], facing: 3.1416}             # upright, its face looks along this yaw
      - {id: 3, position: [1.0, 2.0, 0.0], rpy: [0, 0, 1], size: 0.1}  # turned by fixed-axis roll, pitch, yaw
      - {id: 4, position: [1.0, 3.0, 2.4], quaternion: [1, 0, 0, 0]}   # turned by a quaternion x, y, z, w
      - {id: 7, position: [2.0, 2.5], cov: [[0.01, 0], [0, 0.01]]}     # a point, perhaps with covariance of x, y
      - {id: 8, position: [3.0, 0.0, 0.5], facing: 0, sigma_m: 0.005, sigma_rad: 0.01}  # how well it is known

``rpy`` and ``quaternion`` turn the marker frame into the map's: x to the marker's right as seen, y to its top, z out of
its face. Without any turn a marker lies on the floor, face up, its right along the map's x. Sigmas: `read_cov`.

A rigid board of markers is one entry, placed as a marker is; its markers are displaced together::

    boards:
      - {kind: aruco_grid, columns: 5, rows: 7, size: 0.04, gap: 0.01, first_id: 0, position: [2, 0, 0.5], facing: 0}
      - {kind: charuco, columns: 5, rows: 7, square: 0.04, size: 0.03, position: [0, 2, 0.5], facing: 0}
      - {kind: bundle, position: [0, 0, 2], quaternion: [1, 0, 0, 0], markers: [{id: 9, position: [-0.1, 0, 0]}]}
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from fgloc.config import Config
from fgloc.errors import ConfigError, MapError
from fgloc.files.atomic import atomic_file
from fgloc.files.documents import Item, read_document
from fgloc.frames import homogeneous, quaternion_matrix, rotation_of, rpy_matrix
from fgloc.sensors.markers.detector import load_dictionary
from fgloc.types import MAX_LANDMARK_ID, Board, FloatArray, Grave, Landmark, LandmarkMap

KEYS = ("cov", "sigma_m", "sigma_rad")
_OF = {2: "x, y", 3: "x, y, z", 6: "x, y, z and the rotation about the marker's axes"}


def read_cov(item: Item, turned: bool) -> FloatArray | None:
    """Covariance of an entry's pose: ``(2, 2)``, ``(3, 3)`` or ``(6, 6)`` as `Landmark` has it; None if not given.

    Args:
        item: the entry; ``sigma_m`` [m] is one number or one for each of x, y, z, ``sigma_rad`` likewise about the
            marker's axes, ``cov`` a matrix of x, y, of x, y, z, or of these and the rotation [m, rad].
        turned: whether the landmark has an orientation.

    Raises:
        MapError: a sigma that is not positive, a matrix that is no covariance, or both given.
    """
    matrix, m, rad = (item.get(key) for key in KEYS)
    if matrix is not None:
        if m is not None or rad is not None:
            raise matrix.fail("give either cov or sigma_m and sigma_rad, not both")
        return _cov(matrix, (2, 3, 6) if turned else (2, 3))
    if rad is not None and not turned:
        raise rad.fail("sigma_rad of a landmark without an orientation; give one, or leave sigma_rad out")
    if rad is not None and m is None:
        raise rad.fail("sigma_rad without sigma_m; give both, or neither")
    if m is None:
        return None
    sigmas = [_sigmas(part) for part in (m, rad) if part is not None]
    return np.diag(np.concatenate(sigmas) ** 2)


def sigma_fields(landmark: Landmark) -> list[str]:
    """Covariance of a landmark as ``key: value`` for `read_cov`; by sigmas where nothing is correlated."""
    cov = landmark.cov
    if cov is None:
        return []
    if len(cov) == 2 or np.count_nonzero(cov - np.diag(np.diag(cov))):
        return [f"cov: [{', '.join(_row(row) for row in cov)}]"]
    sigmas = np.sqrt(np.diag(cov))
    fields = [f"sigma_m: {_row(sigmas[:3])}"]
    return fields if len(cov) == 3 else [*fields, f"sigma_rad: {_row(sigmas[3:])}"]


def _sigmas(item: Item) -> FloatArray:
    values = item.numbers(3) if item.is_sequence else np.full(3, item.number())
    if (values <= 0.0).any():
        raise item.fail(f"sigma {values.tolist()}, expected more than 0")
    return values


def _cov(item: Item, sizes: tuple[int, ...]) -> FloatArray:
    rows = [row.numbers() for row in item.entries()]
    n = len(rows)
    cov = np.array(rows) if n in sizes and all(len(row) == n for row in rows) else np.zeros((1, 1))
    if len(cov) != n or np.abs(cov - cov.T).max() > 1e-9 * np.abs(cov).max() or np.linalg.eigvalsh(cov)[0] <= 0.0:
        wanted = " or ".join(f"{k} by {k} (of {_OF[k]})" for k in sizes)
        shown = [row.tolist() for row in rows]
        raise item.fail(f"cov {shown} is not a covariance: expected {wanted}, symmetric, positive definite")
    return cov


def _row(values: FloatArray) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"


_MAX_BYTES = 5_000_000  # some 50 000 landmarks, 15 s to read; a building has hundreds
_MAX_SIZE_M = 5.0
_MAX_POSITION_M = 1e6
_QUATERNION_TOLERANCE = 0.05
_MARKER_ON_BOARD_M = 5e-4  # sigma of a marker's place on a printed board
_MOST_ON_BOARD = 100  # columns or rows
_ORIENTATIONS = ("facing", "rpy", "quaternion")
_WPILIB_SIZE_M = 0.1651  # 6.5 inches, FRC since 2024
_WPILIB_AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # our axes in WPILib's: x out of the face


def _ids(dictionary: str) -> int:
    """Number of ids of a marker dictionary."""
    return len(load_dictionary(dictionary).bytesList)


def _id(item: Item) -> int:
    """Id of a landmark."""
    number = item.integer()
    if number < 0:
        raise item.fail(f"landmark id {number} is negative; ids count from 0")
    if number > MAX_LANDMARK_ID:
        raise item.fail(f"landmark id {number:g} is too large; expected at most {MAX_LANDMARK_ID}")
    return number


class _Builder:
    """Collects landmarks; refuses an id given twice, naming both lines."""

    def __init__(self, default_size_m: float | None, scale: float, size_scale: float) -> None:
        self.default_size_m = default_size_m
        self.scale, self.size_scale = scale, size_scale
        self.landmarks: dict[int, Landmark] = {}
        self._lines: dict[int, int] = {}

    def add(
        self,
        item: Item,
        landmark_id: Item,
        position: FloatArray,
        rotation: FloatArray | None = None,
        size: Item | None = None,
        cov: FloatArray | None = None,
    ) -> None:
        """Add a marker, or a point if it has no rotation, in the file's units."""
        number = _id(landmark_id)
        if rotation is None and size is not None:
            raise size.fail(f"landmark {number} has a size but no orientation; give one of {', '.join(_ORIENTATIONS)}")
        side = 0.0 if rotation is None else self.side(size)
        turned = np.eye(3) if rotation is None else rotation
        self.place(item, Landmark(number, self.metres(position, item), turned, side, self.covariance(cov)))

    def place(self, item: Item, landmark: Landmark) -> None:
        """Add a landmark; its id may stand once."""
        number = landmark.landmark_id
        if number in self._lines:
            raise item.fail(f"landmark id {number} is already in line {self._lines[number]}; every id may stand once")
        self._lines[number] = item.line
        self.landmarks[number] = landmark

    def metres(self, position: FloatArray, item: Item) -> FloatArray:
        """Position of an entry [m]."""
        if (np.abs(position) > _MAX_POSITION_M).any():
            raise item.fail(f"position {position.tolist()} is out of bounds; expected metres")
        return self.scale * position

    def covariance(self, cov: FloatArray | None) -> FloatArray | None:
        """Covariance of an entry in metres."""
        if cov is None:
            return None
        units = np.append(np.full(min(len(cov), 3), self.scale), np.ones(max(len(cov) - 3, 0)))
        return cov * np.outer(units, units)

    def side(self, size: Item | None) -> float:
        """Side of a marker [m]: the file's, else the default; 0 if there is none."""
        return self.default_size_m or 0.0 if size is None else self.size(size)

    def size(self, item: Item) -> float:
        """Side of a marker [m] that the file gives."""
        size = self.size_scale * item.number()
        if size <= 0.0:
            raise item.fail(f"marker size {size:g} m, expected more than 0")
        if size > _MAX_SIZE_M:
            unit, metres = ("cm", size / 100.0) if size < 100.0 else ("mm", size / 1000.0)
            raise item.fail(
                f"marker size {size:g} m is too large; sizes are in metres: if it is {size:g} {unit}, write {metres:g}"
            )
        return size

    def finish(self, path: Path, root: Item, dictionary: str, notes: list[str]) -> LandmarkMap:
        """The checked map."""
        if not self.landmarks:
            raise root.fail("no landmarks in the map")
        if dictionary:
            capacity = _ids(dictionary)
            beyond = [i for i in self.landmarks if i >= capacity]
            if beyond:
                notes.append(f"{path}: {dictionary} has ids below {capacity}; {beyond} will never be seen.")
        sizeless = [
            i for i, m in self.landmarks.items() if m.size_m == 0.0 and not np.array_equal(m.rotation, np.eye(3))
        ]
        if sizeless:
            notes.append(f"{path}: markers {sizeless} have no size; their corners cannot be used.")
        return LandmarkMap(self.landmarks, dictionary, str(path), tuple(notes))


def load_map(
    path: Path, default_size_m: float | None = None, scale: float = 1.0, size_scale: float = 1.0
) -> LandmarkMap:
    """Read a map in any of the known formats.

    Args:
        path: the file.
        default_size_m: side of markers for which the file gives none.
        scale: metres of one unit of its positions.
        size_scale: metres of one unit of its sizes.

    Raises:
        MapError: the file cannot be read or is in no known format; or an id is given twice (both lines are named) or is
            negative, a number is not finite, a size is not in metres, or a rotation is not one.
    """
    root = read_document(path, MapError, _MAX_BYTES)
    builder = _Builder(default_size_m, scale, size_scale)
    if not root.is_mapping:
        raise root.fail("expected keys such as 'landmarks' (ours), 'bodies' (TagSLAM) or 'tags' (WPILib)")
    landmarks, bodies, tags = (root.get(key) for key in ("landmarks", "bodies", "tags"))
    if bodies is not None:
        return _tagslam(path, root, bodies, builder)
    if tags is not None:
        return _wpilib(path, root, tags, builder)
    if landmarks is None and root.get("boards") is None:
        raise root.fail(
            "no map in it: expected 'landmarks' or 'boards' (ours), 'bodies' (TagSLAM) or 'tags' (WPILib), "
            f"got the keys {', '.join(k for k, _ in root.pairs())}"
        )
    if landmarks is not None and landmarks.is_mapping:
        if (boards := root.get("boards")) is not None:
            raise boards.fail("boards beside columns of landmarks; give each landmark its own entry")
        return _columns(path, root, landmarks, builder)
    return _ours(path, root, builder)


def configured_map(path: Path, config: Config, default_size_m: float | None = None) -> LandmarkMap:
    """Map of a file in the units that the configuration says it has; ``default_size_m`` takes the place of its own.

    Raises:
        MapError: as `load_map` has it.
    """
    size = default_size_m or config.markers.default_size_m
    return load_map(path, size, config.map.scale, config.map.size_scale)


def write_map(landmark_map: LandmarkMap, path: Path, head: Sequence[str] = ()) -> None:
    """Write our format after comment lines, whole or not at all; boards as bundles.

    Reading it gives the same map to the last bit but for rotations and boards (1e-15).

    Raises:
        OutputError: the file cannot be written.
    """
    from scipy.spatial.transform import Rotation  # takes a fifth of a second to load, and reading needs none

    lines = [*head, *([f"dictionary: {landmark_map.dictionary}"] if landmark_map.dictionary else [])]
    on: dict[int, list[Landmark]] = {}
    alone: list[Landmark] = []
    for _, landmark in sorted(landmark_map.landmarks.items()):
        (alone if landmark.board is None else on.setdefault(id(landmark.board[0]), [])).append(landmark)
    lines += ["boards:"] * bool(on)
    for members in on.values():
        board, R, origin = _board_pose(members[0])
        fields = [f"position: {_row(origin)}", f"quaternion: {_row(Rotation.from_matrix(R).as_quat())}"]
        fields += sigma_fields(replace(members[0], cov=board.cov))
        lines.append(f"  - {{kind: bundle, {', '.join(fields)}, markers_sigma_m: {board.sigma_m!r}, markers: [")
        for one in members:
            quaternion = Rotation.from_matrix(R.T @ one.rotation).as_quat()
            fields = [f"id: {one.landmark_id}", f"position: {_row(R.T @ (one.position - origin))}"]
            fields += [f"quaternion: {_row(quaternion)}", *([f"size: {one.size_m!r}"] if one.size_m > 0.0 else [])]
            lines.append(f"      {{{', '.join(fields)}}},")
        lines.append("    ]}")
    lines += ["landmarks:"] * (bool(alone) or not on)
    for landmark in alone:
        number = landmark.landmark_id
        fields = [f"id: {number}", f"position: {_row(landmark.position)}"]
        if landmark.size_m > 0.0:
            quaternion = Rotation.from_matrix(landmark.rotation).as_quat()
            fields += [f"quaternion: {_row(quaternion)}", f"size: {landmark.size_m!r}"]
        fields += sigma_fields(landmark)
        lines.append(f"  - {{{', '.join(fields)}}}")
    with atomic_file(path) as file:
        file.write("\n".join(lines) + "\n")


def _board_pose(landmark: Landmark) -> tuple[Board, FloatArray, FloatArray]:
    """Board that a marker is on, its rotation ``(3, 3)`` and position ``(3,)`` in the map, by the marker's."""
    assert landmark.board is not None
    board, lever = landmark.board
    R = landmark.rotation @ lever[3:, 3:]
    across = lever[:3, 3:] @ R.T  # of a vector: its cross product with the way from the board to the marker
    return board, R, landmark.position - np.array([across[1, 2], across[2, 0], across[0, 1]])


def _ours(path: Path, root: Item, builder: _Builder) -> LandmarkMap:
    root.only("dictionary", "size", "landmarks", "boards")
    named, size, landmarks, boards = (root.get(key) for key in ("dictionary", "size", "landmarks", "boards"))
    dictionary = "" if named is None else named.text()
    if named is not None:
        try:
            _ids(dictionary)
        except ConfigError as error:
            raise named.fail(str(error)) from error
    if size is not None:
        builder.default_size_m = builder.size(size)
    for item in [] if boards is None else boards.entries():
        _board(item, builder)
    for item in [] if landmarks is None else landmarks.entries():
        item.only("id", "position", "size", *KEYS, *_ORIENTATIONS)
        position, rotation = _placed(item)
        cov = read_cov(item, rotation is not None)
        builder.add(item, item.need("id"), position, rotation, item.get("size"), cov)
    return builder.finish(path, root, dictionary, [])


def _placed(item: Item) -> tuple[FloatArray, FloatArray | None]:
    """Position ``(3,)`` of an entry in the file's units, and its rotation ``(3, 3)``; None: it has none."""
    position = item.need("position").numbers(2, 3)
    given = [(key, value) for key in _ORIENTATIONS if (value := item.get(key)) is not None]
    if len(given) > 1:
        raise item.fail(f"orientation given {len(given)} times, as {', '.join(k for k, _ in given)}; give one")
    if given and len(position) == 2:
        raise item.fail("a marker with an orientation needs a position of x, y, z")
    return np.append(position, 0.0)[:3], _orientation(*given[0]) if given else None


def _board(item: Item, builder: _Builder) -> None:
    """Add the markers of a board: its pose is of its middle, of a bundle of the frame that its markers are placed in.

    Source of the geometry of the printed ones: OpenCV's GridBoard and CharucoBoard.
    """
    kinds: dict[str, tuple[tuple[str, ...], Callable[[Item, _Builder], Iterator[_Member]]]] = {
        "aruco_grid": (("columns", "rows", "size", "gap", "first_id"), _printed),
        "charuco": (("columns", "rows", "square", "size", "first_id", "legacy"), _printed),
        "bundle": (("markers",), _bundled),
    }
    kind = item.need("kind")
    if kind.text() not in kinds:
        raise kind.fail(f"board of kind '{kind.text()}', expected one of {', '.join(kinds)}")
    keys, members = kinds[kind.text()]
    item.only("kind", "position", "markers_sigma_m", *KEYS, *_ORIENTATIONS, *keys)
    given, cov = item.get("markers_sigma_m"), read_cov(item, turned=True)
    sigma = _MARKER_ON_BOARD_M if given is None else given.number()
    if given is not None and sigma <= 0.0:
        raise given.fail(f"sigma {sigma:g}, expected more than 0")
    if cov is not None and len(cov) < 6:
        raise item.fail(
            "sigmas of a board without its rotation; give sigma_m and sigma_rad, a cov of 6 by 6, or neither"
        )
    board = Board(builder.covariance(cov), sigma)
    position, turned = _placed(item)
    origin, rotation = builder.metres(position, item), np.eye(3) if turned is None else turned
    for entry, number, size_m, place, R_board_marker in members(item, builder):
        along = rotation @ place
        lever = np.eye(6)
        lever[:3, 3:] = np.cross(rotation.T, along).T
        lever[3:, 3:] = R_board_marker.T
        marker = Landmark(number, origin + along, rotation @ R_board_marker, size_m, board=(board, lever))
        builder.place(entry, marker)


_Member = tuple[Item, int, float, FloatArray, FloatArray]
"""Entry, id, side [m], position (3,) [m] and rotation (3, 3) of a marker on its board."""


def _printed(item: Item, builder: _Builder) -> Iterator[_Member]:
    """Markers of a grid or a chessboard of OpenCV, whose frame has y down and z into the board."""
    shape = item.need("columns").integer(), item.need("rows").integer()
    named, kept = item.get("first_id"), item.get("legacy")
    first = 0 if named is None else _id(named)
    if not all(1 <= n <= _MOST_ON_BOARD for n in shape):
        raise item.fail(f"board of {shape[0]} columns and {shape[1]} rows, expected 1 to {_MOST_ON_BOARD} of each")
    side = builder.side(item.get("size")) or builder.size(item.need("size"))
    if kept is not None and kept.text().lower() not in ("true", "false"):
        raise kept.fail(f"legacy is '{kept.text()}', expected true or false")
    if first + shape[0] * shape[1] > MAX_LANDMARK_ID:
        raise item.fail(f"first_id {first} is too large; ids are at most {MAX_LANDMARK_ID}")
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)  # the geometry is the same for all
    ids = np.arange(first, first + shape[0] * shape[1], dtype=np.int32)
    try:
        if item.need("kind").text() == "charuco":
            square = builder.size(item.need("square"))
            chess = cv2.aruco.CharucoBoard(shape, square, side, codes, ids[: shape[0] * shape[1] // 2])
            chess.setLegacyPattern(kept is not None and kept.text().lower() == "true")
            board: cv2.aruco.Board = chess
        else:
            board = cv2.aruco.GridBoard(shape, side, builder.size(item.need("gap")), codes, ids)
    except (cv2.error, SystemError) as error:
        raise item.fail(f"OpenCV has no such board: {error}") from error
    middle = 0.5 * np.array(board.getRightBottomCorner())
    for number, corners in zip(np.ravel(board.getIds()).tolist(), board.getObjPoints(), strict=True):
        yield item, number, side, (np.mean(corners, axis=0) - middle) * [1.0, -1.0, 1.0], np.eye(3)


def _bundled(item: Item, builder: _Builder) -> Iterator[_Member]:
    for entry in item.need("markers").entries():
        entry.only("id", "position", "size", *_ORIENTATIONS)
        position, turned = _placed(entry)
        rotation = np.eye(3) if turned is None else turned
        yield (
            entry,
            _id(entry.need("id")),
            builder.side(entry.get("size")),
            builder.metres(position, entry),
            rotation,
        )


def _columns(path: Path, root: Item, landmarks: Item, builder: _Builder) -> LandmarkMap:
    """Lists of ids and coordinates. Where they differ in length, the ids that have coordinates are used."""
    columns = {key: landmarks.need(key).entries() for key in ("id", "x", "y")}
    heights = landmarks.get("z")
    if heights is not None:
        columns["z"] = heights.entries()
    count = min(len(c) for c in columns.values())
    notes: list[str] = []
    if any(len(c) != count for c in columns.values()):
        lengths = ", ".join(f"{len(c)} {key}" for key, c in columns.items())
        text = f"{path}: lists of unequal length ({lengths}); the first {count} of each are taken for each other's."
        notes.append(Grave(f"{text} Give each landmark its own entry."))
    for k in range(count):
        xyz = [columns[key][k].number() if key in columns else 0.0 for key in ("x", "y", "z")]
        builder.add(columns["id"][k], columns["id"][k], np.array(xyz))
    return builder.finish(path, root, "", notes)


def _tagslam(path: Path, root: Item, bodies: Item, builder: _Builder) -> LandmarkMap:
    """Tags of the static bodies whose pose is known.

    Source: TagSLAM's documentation, "Input Files and Parameters"; its tag frame has x right, y up, z out of the face.
    """
    notes = []
    for body in (pair for entry in bodies.entries() for pair in entry.pairs()):
        name, item = body
        tags, static, pose = item.get("tags"), item.get("is_static"), item.get("pose")
        if tags is None:
            continue
        if static is None or static.text().lower() != "true":
            notes.append(f"{path}: the tags of body '{name}' are left out: it is not static.")
            continue
        T_map_body = np.eye(4) if pose is None else _tagslam_pose(pose)
        size = item.get("default_tag_size")
        for tag in tags.entries():
            placed = tag.get("pose")
            if placed is None:
                notes.append(f"{path}: tag {tag.need('id').text()} of body '{name}' has no pose and is left out.")
                continue
            T = T_map_body @ _tagslam_pose(placed)
            builder.add(tag, tag.need("id"), T[:3, 3], T[:3, :3], tag.get("size") or size)
    return builder.finish(path, root, "DICT_APRILTAG_36h11", notes)


def _tagslam_pose(pose: Item) -> FloatArray:
    position = _xyz(pose.need("position"))
    return homogeneous(rotation_of(_xyz(pose.need("rotation"))), position)


def _wpilib(path: Path, root: Item, tags: Item, builder: _Builder) -> LandmarkMap:
    """Tags of an FRC field, in its own coordinates (origin in a corner of the field).

    Source: WPILib's documentation of AprilTagFieldLayout: a tag's x looks out of its face, z up.
    """
    builder.default_size_m = builder.default_size_m or _WPILIB_SIZE_M
    notes = [
        f"{path}: WPILib's files name neither tag family nor size; DICT_APRILTAG_36h11 and "
        f"{builder.default_size_m:g} m are taken."
    ]
    for tag in tags.entries():
        pose = tag.need("pose")
        quaternion = pose.need("rotation").need("quaternion")
        xyzw = np.array([quaternion.need(key).number() for key in ("X", "Y", "Z", "W")])
        rotation = quaternion_matrix(_unit(quaternion, xyzw)) @ _WPILIB_AXES
        builder.add(tag, tag.need("ID"), _xyz(pose.need("translation")), rotation)
    return builder.finish(path, root, "DICT_APRILTAG_36h11", notes)


def _orientation(key: str, item: Item) -> FloatArray:
    if key == "facing":
        yaw = item.number()
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([[-s, 0.0, c], [c, 0.0, s], [0.0, 1.0, 0.0]])
    if key == "rpy":
        roll, pitch, yaw = item.numbers(3)
        if max(abs(roll), abs(pitch), abs(yaw)) > 2.0 * np.pi:
            raise item.fail(
                f"rpy {[float(roll), float(pitch), float(yaw)]} is more than a turn; expected radians, not degrees"
            )
        return rpy_matrix(roll, pitch, yaw)
    return quaternion_matrix(_unit(item, item.numbers(4)))


def _unit(item: Item, quaternion: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > _QUATERNION_TOLERANCE:
        raise item.fail(f"quaternion {quaternion.tolist()} has length {length:.3g}, expected 1: it is not a rotation")
    return quaternion / length


def _xyz(item: Item) -> FloatArray:
    return np.array([item.need(key).number() for key in ("x", "y", "z")])
