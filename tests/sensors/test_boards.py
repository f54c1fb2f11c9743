"""Rigid boards of markers in a map: their geometry is the printed one, and their markers are displaced together."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgloc.ablation.failures import MovedMarker
from fgloc.calibration.installation import map_found
from fgloc.config import Config
from fgloc.diagnosis.setup import mirrored
from fgloc.errors import MapError
from fgloc.frames import rotation_of
from fgloc.graph.installation import Installation, InstallationEstimate, installation_of
from fgloc.sensors.failures import Scene
from fgloc.sensors.maps import load_map, write_map
from fgloc.types import FloatArray, LandmarkMap

GRID = "kind: aruco_grid, columns: 4, rows: 3, size: 0.08, gap: 0.02, first_id: 3"
CHESS = "kind: charuco, columns: 5, rows: 4, square: 0.1, size: 0.07"
PLACE = "position: [2.0, 0.5, 0.7], facing: 3.141592653589793"
SIGMAS = "sigma_m: 0.02, sigma_rad: 0.03"
BUNDLE = """kind: bundle, markers: [
    {id: 1, position: [-0.2, 0.0, 0.0]}, {id: 2, position: [0.2, 0.1, 0.3], rpy: [0.4, -0.3, 1.2], size: 0.05}]"""


def board_map(folder: Path, fields: str, head: str = "size: 0.1\n") -> LandmarkMap:
    path = folder / "map.yaml"
    path.write_text(f"dictionary: DICT_4X4_50\n{head}boards:\n  - {{{fields}}}\n", encoding="utf-8")
    return load_map(path)


def printed(fields: str) -> cv2.aruco.Board:
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    if "grid" in fields:
        return cv2.aruco.GridBoard((4, 3), 0.08, 0.02, codes, np.arange(3, 15))
    chess = cv2.aruco.CharucoBoard((5, 4), 0.1, 0.07, codes)
    chess.setLegacyPattern("legacy: true" in fields)
    return chess


@pytest.mark.parametrize("fields", [GRID, CHESS, CHESS + ", legacy: true"])
def test_corners_of_a_printed_board_are_where_its_picture_shows_them(tmp_path: Path, fields: str) -> None:
    """A pinhole camera at the map's origin looks along x at the board, 2 m ahead and facing it."""
    landmarks = board_map(tmp_path, f"{fields}, {PLACE}").landmarks
    board = printed(fields)
    width, height, _ = board.getRightBottomCorner()
    picture = board.generateImage((round(1000 * width), round(1000 * height)), marginSize=0, borderBits=1)
    picture = cv2.copyMakeBorder(picture, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    ends = np.array([[60, 60], [60 + 1000 * width, 60], [60, 60 + 1000 * height]], dtype=np.float32)
    y, z = 0.5 + 0.5 * width * np.array([1, -1, 1]), 0.7 + 0.5 * height * np.array([1, 1, -1])
    f, c = 800.0, 640.0
    seen = np.column_stack([c - f * y / 2.0, c - f * z / 2.0]).astype(np.float32)
    image = cv2.warpAffine(picture, cv2.getAffineTransform(ends, seen), (1280, 1280), borderValue=255)
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    corners, ids, _ = cv2.aruco.ArucoDetector(codes).detectMarkers(image)
    assert sorted(np.ravel(ids)) == sorted(landmarks)
    for number, found in zip(np.ravel(ids).tolist(), corners, strict=True):
        P = landmarks[number].corners()
        assert np.abs(np.column_stack([c - f * P[:, 1] / P[:, 0], c - f * P[:, 2] / P[:, 0]]) - found[0]).max() < 2.0


@pytest.mark.parametrize("fields", [GRID, BUNDLE])
def test_markers_of_a_board_are_displaced_together(tmp_path: Path, fields: str) -> None:
    """The prior of the markers is what a displaced board does to them, held against boards displaced a little."""
    before = board_map(tmp_path, f"{fields}, {PLACE}, {SIGMAS}, markers_sigma_m: 0.001")
    installation = installation_of(Config(), before, corners=True)
    cov = installation.prior().cov
    rows = np.concatenate([np.arange(f, f + n) for f, n in installation.landmarks.values()])
    step = 1e-4
    A = np.zeros((len(rows), 6))
    R = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for k in range(6):
        shift, turn = (step * np.eye(6)[k]).reshape(2, 3)
        place, quaternion = np.array([2.0, 0.5, 0.7]) + shift, as_quaternion(R @ rotation_of(turn))
        moved = board_map(tmp_path, f"{fields}, position: {place.tolist()}, quaternion: {quaternion}")
        for j, number in enumerate(installation.landmarks):
            old, new = before.landmarks[number], moved.landmarks[number]
            about = cv2.Rodrigues(old.rotation.T @ new.rotation)[0].ravel()
            A[6 * j : 6 * j + 6, k] = np.concatenate([new.position - old.position, about]) / step
    own = np.tile([1e-6] * 3 + [0.0] * 3, len(rows) // 6)
    assert np.allclose(
        cov[np.ix_(rows, rows)], A @ np.diag([0.02**2] * 3 + [0.03**2] * 3) @ A.T + np.diag(own), atol=1e-7
    )


def as_quaternion(R: FloatArray) -> list[float]:
    rotation = cv2.Rodrigues(R)[0].ravel()
    angle = float(np.linalg.norm(rotation))
    return [*(np.sin(0.5 * angle) * rotation / angle).tolist(), float(np.cos(0.5 * angle))]


def test_many_sightings_of_one_board_tell_no_more_than_the_board_is_known_to(tmp_path: Path) -> None:
    """The mean place of its markers keeps the board's sigma, which independent markers would divide by their number."""
    landmarks = board_map(tmp_path, f"{GRID}, {PLACE}, {SIGMAS}")
    installation = installation_of(Config(), landmarks, corners=True)
    row = np.zeros(len(installation))
    for first, _ in installation.landmarks.values():
        row[first] = 1.0 / len(landmarks)
    assert np.sqrt(row @ installation.prior().cov @ row) == pytest.approx(0.02, rel=0.01)
    few = installation.with_states([3, 8])
    a, b = (few.landmarks[i][0] for i in (3, 8))
    assert few.prior().cov[a, b] == installation.prior().cov[installation.landmarks[3][0], installation.landmarks[8][0]]


def test_boards_of_a_map_with_more_landmarks_than_states_keep_their_sigma(tmp_path: Path) -> None:
    """Markers that become states one by one know together what the board is known to."""
    landmarks = board_map(tmp_path, f"{GRID}, {PLACE}, {SIGMAS}")
    covs = installation_of(Config(), landmarks, corners=True, most=4).stateless
    assert np.sqrt(sum(cov[0, 0] for cov in covs.values())) / len(covs) > 0.02


def mean_sigma(installation: Installation, belief: InstallationEstimate) -> float:
    """Sigma [m] of the mean x of all landmarks."""
    row = np.zeros(len(installation))
    for first, _ in installation.landmarks.values():
        row[first] = 1.0 / len(installation.landmarks)
    return float(np.sqrt(row @ belief.cov @ row))


@pytest.mark.parametrize("head", ["size: 0.1\n", ""])
def test_markers_seen_as_points_are_displaced_together_too(tmp_path: Path, head: str) -> None:
    """Poses of markers by others need no size, and their places are states in the plane."""
    installation = installation_of(Config(), board_map(tmp_path, f"{BUNDLE}, {PLACE}, {SIGMAS}", head), corners=False)
    assert {count for _, count in installation.landmarks.values()} == {2}
    prior = installation.prior()
    first, second = (start for start, _ in installation.landmarks.values())
    assert prior.cov[first, second] == pytest.approx(0.02**2, rel=0.1)
    assert mean_sigma(installation, prior) > 0.0199


def test_a_board_of_a_thousand_markers_takes_no_memory_of_their_square(tmp_path: Path) -> None:
    many = board_map(tmp_path, f"{GRID}, {PLACE}, {SIGMAS}".replace("columns: 4, rows: 3", "columns: 50, rows: 40"))
    tracemalloc.start()
    installation_of(Config(), many, corners=True)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 100e6


@pytest.mark.parametrize("fields", [GRID, CHESS, BUNDLE])
@pytest.mark.parametrize("sigmas", [SIGMAS, "markers_sigma_m: 0.002"])
def test_a_map_that_is_written_has_its_boards(tmp_path: Path, fields: str, sigmas: str) -> None:
    before = board_map(tmp_path, f"{fields}, {PLACE}, {sigmas}")
    write_map(before, tmp_path / "again.yaml")
    again = load_map(tmp_path / "again.yaml")
    assert list(again.landmarks) == list(before.landmarks)
    for number, one in before.landmarks.items():
        other = again.landmarks[number]
        assert np.allclose(other.position, one.position, atol=1e-12)
        assert np.allclose(other.rotation, one.rotation, atol=1e-12)
        assert other.size_m == one.size_m
    old, new = (installation_of(Config(), m, corners=True).prior().cov for m in (before, again))
    assert np.allclose(new, old, rtol=1e-9, atol=1e-12)


def test_a_map_with_a_moved_marker_keeps_its_board(tmp_path: Path) -> None:
    """A sweep writes it to a file for the run."""
    before = board_map(tmp_path, f"{GRID}, {PLACE}, {SIGMAS}")
    scene = Scene(0, 1.0, Config(), (5,), np.random.default_rng(1))
    moved = MovedMarker(ids=(5,)).corrupt_map(before, scene)
    write_map(moved, tmp_path / "moved.yaml")
    read = load_map(tmp_path / "moved.yaml")
    assert np.linalg.norm(read.landmarks[5].position - before.landmarks[5].position) == pytest.approx(0.3)
    assert np.allclose(read.landmarks[6].position, before.landmarks[6].position)
    installation = installation_of(Config(), read, corners=True)
    assert mean_sigma(installation, installation.prior()) > 0.0199


def test_what_is_found_of_a_board_is_no_surer_in_the_next_run(tmp_path: Path) -> None:
    """A run that has measured the board's height, and along x has hardly seen it, tells of x as much as was known."""
    given = board_map(tmp_path, f"{GRID}, {PLACE}, {SIGMAS}")
    installation = installation_of(Config(), given, corners=True)
    prior, z = installation.prior(), installation.landmarks[7][0] + 2
    gain = prior.cov[:, z] / (prior.cov[z, z] + 1e-6)
    belief = InstallationEstimate(0.01 * gain, prior.cov - np.outer(gain, prior.cov[z]))
    write_map(map_found(given, installation, belief), tmp_path / "found.yaml")
    read = load_map(tmp_path / "found.yaml")
    again = installation_of(Config(), read, corners=True)
    assert mean_sigma(again, again.prior()) == pytest.approx(mean_sigma(installation, belief), rel=0.01)
    assert again.prior().cov[z, z] < 2.0 * belief.cov[z, z] + 1e-6
    assert read.landmarks[7].position[2] - given.landmarks[7].position[2] == pytest.approx(0.01, rel=0.01)


def test_a_covariance_that_is_none_by_rounding_leaves_the_board_as_it_was(tmp_path: Path) -> None:
    given = board_map(tmp_path, f"{GRID}, {PLACE}, {SIGMAS}")
    installation = installation_of(Config(), given, corners=True)
    for variance in (1e-8, -1e-6):
        belief = InstallationEstimate(np.zeros(len(installation)), variance * np.eye(len(installation)))
        found = map_found(given, installation, belief)
        board, _ = found.landmarks[7].board or pytest.fail("no board")
        assert board.cov is not None
        assert np.sqrt(board.cov[0, 0]) == pytest.approx(0.02 if variance < 0.0 else 1.5e-4, rel=0.2)


def test_a_map_in_a_mirror_has_no_boards(tmp_path: Path) -> None:
    assert all(m.board is None for m in mirrored(board_map(tmp_path, f"{GRID}, {PLACE}")).landmarks.values())


def test_boards_beside_columns_of_landmarks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="columns"):
        board_map(tmp_path, f"{GRID}, {PLACE}", "landmarks: {id: [90], x: [0], y: [1]}\n")


def test_a_board_without_a_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="'size' is missing"):
        board_map(tmp_path, f"{GRID}, {PLACE}".replace("size: 0.08, ", ""), "")


def test_an_exact_map_has_exact_boards(tmp_path: Path) -> None:
    landmarks = board_map(tmp_path, f"{GRID}, {PLACE}")
    exact = Config.model_validate({"map": {"position_sigma_m": 0.0, "rotation_sigma_rad": 0.0}})
    assert not installation_of(exact, landmarks, corners=True).landmarks
    assert len(installation_of(Config(), landmarks, corners=True).landmarks) == 12


def test_a_board_in_other_units(tmp_path: Path) -> None:
    """Positions have the unit of the map, printed sizes that of sizes."""
    path = tmp_path / "map.yaml"
    path.write_text(
        "boards: [{kind: aruco_grid, columns: 1, rows: 2, size: 80, gap: 20, position: [200, 50, 70], facing: 0,"
        " sigma_m: 1, sigma_rad: 0.1}]\n",
        encoding="utf-8",
    )
    read = load_map(path, scale=0.01, size_scale=0.001)
    assert np.allclose(read.landmarks[0].position, [2.0, 0.5, 0.75])
    assert np.allclose(read.landmarks[1].position, [2.0, 0.5, 0.65])
    assert read.landmarks[0].size_m == pytest.approx(0.08)
    board, lever = read.landmarks[0].board or pytest.fail("no board")
    assert board.cov is not None
    assert board.cov[0, 0] == pytest.approx(1e-4)
    assert np.allclose(lever[:3, 3:] @ [1.0, 0.0, 0.0], [0.05, 0.0, 0.0])  # about its own right: the top comes forward


@pytest.mark.parametrize(
    ("fields", "facts"),
    [
        ("kind: chessboard, position: [0, 0, 0]", ["chessboard", "charuco"]),
        (f"{GRID}, gap: -1, {PLACE}".replace("gap: 0.02, ", ""), ["-1"]),
        (f"{CHESS}, {PLACE}".replace("size: 0.07", "size: 0.12"), ["OpenCV"]),
        (f"{GRID}, {PLACE}".replace("columns: 4", "columns: 0"), ["0 columns"]),
        (f"{GRID}, {PLACE}, sigma_m: 0.1", ["sigma_rad"]),
        (f"{GRID}, {PLACE}, markers_sigma_m: 0", ["0", "more than 0"]),
        (f"{GRID}, {PLACE}, square: 0.1", ["square"]),
        (f"{GRID}, {PLACE}".replace("first_id: 3", "first_id: 2147483640"), ["2147483640"]),
        (f"{CHESS}, {PLACE}, first_id: 2147483647", ["2147483647"]),
        (f"{CHESS}, {PLACE}, legacy: yes", ["yes", "true or false"]),
        (f"{BUNDLE}, {PLACE}".replace("id: 2", "id: 1"), ["landmark id 1"]),
        (f"{BUNDLE}, {PLACE}".replace("id: 2", "id: -2"), ["-2"]),
    ],
)
def test_boards_that_are_none_are_refused_with_the_line(tmp_path: Path, fields: str, facts: list[str]) -> None:
    with pytest.raises(MapError) as caught:
        board_map(tmp_path, fields)
    assert "map.yaml:" in str(caught.value)
    for fact in facts:
        assert fact in str(caught.value)
