"""Marker maps: formats, round trip, and what is refused with its line."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from real_data import real_data
from refusal import refusal
from scipy.spatial.transform import Rotation

from fgloc.config import Config, load_config
from fgloc.errors import MapError
from fgloc.files.documents import HostileError
from fgloc.graph.installation import MARKER, installation_of
from fgloc.recording.reader import Recording
from fgloc.sensor_setup import recorded_setup
from fgloc.sensors.maps import configured_map, load_map, write_map
from fgloc.types import Landmark, LandmarkMap

OURS = """dictionary: DICT_4X4_50
size: 0.2
landmarks:
  - {id: 0, position: [4.0, 1.5, 0.5], facing: 3.141592653589793}
  - {id: 3, position: [1, 2, 0], rpy: [0, 0, 0], size: 0.15}
  - {id: 4, position: [1.0, 3.0, 2.4], quaternion: [1, 0, 0, 0]}
  - {id: 7, position: [2.0, 2.5], cov: [[0.01, 0.002], [0.002, 0.02]]}
"""


def written(folder: Path, text: str, name: str = "map.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_our_format(tmp_path: Path) -> None:
    m = load_map(written(tmp_path, OURS))
    assert (m.dictionary, len(m), m.notes) == ("DICT_4X4_50", 4, ())
    wall, floor, ceiling, point = (m.landmarks[i] for i in (0, 3, 4, 7))
    assert (wall.size_m, floor.size_m, ceiling.size_m, point.size_m) == (0.2, 0.15, 0.2, 0.0)
    # Upright, facing -x: who looks at it looks along +x and has -y on the right.
    assert np.allclose(wall.corners()[0], [4.0, 1.6, 0.6])  # top left
    assert np.allclose(wall.corners()[2], [4.0, 1.4, 0.4])  # bottom right
    assert np.allclose(wall.rotation[:, 2], [-1.0, 0.0, 0.0])
    assert np.allclose(floor.corners()[0], [0.925, 2.075, 0.0])
    assert np.allclose(ceiling.rotation[:, 2], [0.0, 0.0, -1.0])
    assert point.cov is not None
    assert point.cov.tolist() == [[0.01, 0.002], [0.002, 0.02]]
    assert wall.cov is None


def test_a_default_size_fills_what_the_file_leaves_open(tmp_path: Path) -> None:
    bare = OURS.replace("size: 0.2\n", "")
    sizes = {i: m.size_m for i, m in load_map(written(tmp_path, bare), 0.3).landmarks.items()}
    assert sizes == {0: 0.3, 3: 0.15, 4: 0.3, 7: 0.0}
    [note] = load_map(written(tmp_path, bare)).notes
    assert "[0, 4]" in note


def test_fault_54_id_0_works_like_any_other(tmp_path: Path) -> None:
    m = load_map(written(tmp_path, OURS))
    assert 0 in m
    assert m.landmarks[0].landmark_id == 0


def test_written_maps_read_back_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    landmarks = {
        i: Landmark(i, rng.normal(size=3), Rotation.random(rng=rng).as_matrix(), float(rng.uniform(0.05, 1.0)))
        for i in range(0, 40, 3)
    }
    A = rng.normal(size=(2, 2))
    landmarks[41] = Landmark(41, np.array([1.0 / 3.0, -2.0, 0.0]), np.eye(3), 0.0, A @ A.T + 0.01 * np.eye(2))
    B = rng.normal(size=(6, 6))
    landmarks[42] = Landmark(42, np.array([1.0, 2.0, 0.5]), np.eye(3), 0.1, B @ B.T + np.eye(6))
    path = tmp_path / "new" / "map.yaml"
    write_map(LandmarkMap(landmarks, "DICT_4X4_100"), path)
    again = load_map(path)
    assert (again.dictionary, set(again.landmarks), again.notes) == ("DICT_4X4_100", set(landmarks), ())
    for i, m in landmarks.items():
        back = again.landmarks[i]
        assert np.array_equal(back.position, m.position)
        assert back.size_m == m.size_m
        assert np.abs(back.rotation - m.rotation).max() < 1e-14
        assert (back.cov is None) == (m.cov is None)
    for i in (41, 42):
        assert np.array_equal(again.landmarks[i].cov, landmarks[i].cov)
    assert list(path.parent.iterdir()) == [path]


def test_sigmas_of_landmarks(tmp_path: Path) -> None:
    text = """
landmarks:
  - {id: 1, position: [1, 2, 0.5], facing: 0, size: 0.1, sigma_m: 0.01, sigma_rad: [0.1, 0.2, 0.3]}
  - {id: 2, position: [1, 2], sigma_m: [0.1, 0.2, 0.3]}
  - {id: 3, position: [1, 2, 0.5], facing: 0, size: 0.1, sigma_m: 0.01}
"""
    m = load_map(written(tmp_path, text))
    write_map(m, tmp_path / "again.yaml")
    again = load_map(tmp_path / "again.yaml")
    expected = {1: [0.01, 0.01, 0.01, 0.1, 0.2, 0.3], 2: [0.1, 0.2, 0.3], 3: [0.01] * 3}
    for read in (m, again):
        for i, sigmas in expected.items():
            cov = read.landmarks[i].cov
            assert cov is not None
            assert np.allclose(cov, np.diag(np.square(sigmas)), rtol=1e-12, atol=0)
    prior = installation_of(Config(), m, corners=True)
    assert np.allclose(prior.sigmas[[prior.index[f"map.1.{name}"] for name in MARKER]], expected[1])
    assert prior.sigmas[prior.index["map.3.rx_rad"]] == Config().map.rotation_sigma_rad


@pytest.mark.parametrize(
    ("fields", "facts"),
    [
        ("facing: 0, sigma_m: 0", r"\[0\.0, 0\.0, 0\.0\]"),
        ("sigma_m: 0.1, sigma_rad: 0.1", "sigma_rad .*orientation"),
        ("facing: 0, sigma_rad: 0.1", "sigma_rad .*sigma_m"),
        ("facing: 0, sigma_m: 0.1, cov: [[1, 0], [0, 1]]", "cov .*sigma_m .*sigma_rad"),
        ("cov: [[1, 0, 0], [0, 1]]", "cov .*2"),
    ],
)
def test_sigmas_that_are_none(tmp_path: Path, fields: str, facts: str) -> None:
    with pytest.raises(MapError, match=rf"map\.yaml:2: .*{facts}"):
        load_map(written(tmp_path, f"landmarks:\n  - {{id: 1, position: [1, 2, 0.5], {fields}}}\n"))


def test_tagslam_format(tmp_path: Path) -> None:
    text = """
tagslam_parameters: {pixel_noise: 1.0}
bodies:
 - lab:
     is_static: true
     type: simple
     default_tag_size: 0.12
     pose:
       position: {x: 1.0, y: 2.0, z: 0.0}
       rotation: {x: 0, y: 0, z: 1.5707963267948966}
     tags:
     - id: 0
       size: 0.3
       pose:
         position: {x: 0.5, y: 0, z: 1.0}
         rotation: {x: 1.5707963267948966, y: 0, z: 0}
     - id: 9
       pose:
         position: {x: 0, y: 0, z: 0}
         rotation: {x: 0, y: 0, z: 0}
     - id: 10
 - rig:
     is_static: false
     type: simple
     default_tag_size: 0.1
     tags:
     - {id: 11}
"""
    m = load_map(written(tmp_path, text))
    assert set(m.landmarks) == {0, 9}
    assert (m.landmarks[0].size_m, m.landmarks[9].size_m) == (0.3, 0.12)
    assert np.allclose(m.landmarks[0].position, [1.0, 2.5, 1.0])
    # The tag stands, its face to -y of the lab, which is +x of the map.
    assert np.allclose(m.landmarks[0].rotation[:, 2], [1.0, 0.0, 0.0])
    assert np.allclose(m.landmarks[0].rotation[:, 1], [0.0, 0.0, 1.0])
    assert len(m.notes) == 2
    assert "tag 10" in m.notes[0]
    assert "'rig'" in m.notes[1]


def wpilib() -> dict[str, object]:
    def tag(number: int, xyz: tuple[float, ...], yaw: float) -> dict[str, object]:
        quaternion = {"W": np.cos(yaw / 2), "X": 0.0, "Y": 0.0, "Z": np.sin(yaw / 2)}
        translation = dict(zip("xyz", xyz, strict=True))
        return {"ID": number, "pose": {"translation": translation, "rotation": {"quaternion": quaternion}}}

    tags = [tag(1, (16.697, 0.655, 1.486), 2.2), tag(2, (16.697, 7.396, 1.486), np.pi)]
    return {"tags": tags, "field": {"length": 17.5, "width": 8.05}}


@pytest.mark.parametrize("indent", [None, 1, "\t"])
def test_wpilib_format(tmp_path: Path, indent: int | str | None) -> None:
    m = load_map(written(tmp_path, json.dumps(wpilib(), indent=indent), "field.json"))
    assert set(m.landmarks) == {1, 2}
    assert m.landmarks[1].size_m == 0.1651
    assert "0.1651" in m.notes[0]
    facing = m.landmarks[2]  # turned by 180 degrees: it looks along -x
    assert np.allclose(facing.rotation[:, 2], [-1.0, 0.0, 0.0])
    assert np.allclose(facing.rotation[:, 1], [0.0, 0.0, 1.0])
    assert np.allclose(facing.rotation[:, 0], [0.0, -1.0, 0.0])
    assert abs(m.landmarks[1].planar[2] - 2.2) < 1e-12
    assert np.linalg.det(facing.rotation) > 0.99


def test_lists_of_unequal_length(tmp_path: Path) -> None:
    text = "landmarks:\n  id: [4, 5, 6]\n  x: [1.0, 2.0]\n  y: [3.0, 4.0]\n  z: [0.1, 0.2]\n"
    m = load_map(written(tmp_path, text))
    assert set(m.landmarks) == {4, 5}
    assert m.landmarks[5].position.tolist() == [2.0, 4.0, 0.2]
    assert "3 id, 2 x, 2 y, 2 z" in m.notes[0]


@pytest.mark.real_data
def test_the_turtlebots_map_is_read() -> None:
    m = load_map(real_data("turtlebot3", "landmarks_2025_real.yaml"))
    assert set(m.landmarks) == set(range(8))
    assert m.landmarks[7].position.tolist() == [2.94, 2.7, 0.73]
    assert "9 id, 8 x" in m.notes[0]


def refused(tmp_path: Path, text: str, match: str, name: str = "map.yaml") -> None:
    """The error names the file, and what `match` has: line, key, value."""
    with pytest.raises(MapError, match=rf"{name}.*{match}"):
        load_map(written(tmp_path, text, name))


def test_fault_53_duplicate_id_names_both_lines(tmp_path: Path) -> None:
    refused(tmp_path, OURS.replace("id: 7", "id: 3"), r":7: .*\b3\b.* 5\b")


def test_fault_53_duplicate_id_in_json_names_both_lines(tmp_path: Path) -> None:
    data = wpilib()
    data["tags"][1]["ID"] = 1  # type: ignore[index]
    refused(tmp_path, json.dumps(data, indent=1), r":2\d: .*\b1\b.* 3\b", "field.json")


def test_fault_53_duplicate_key_names_both_lines(tmp_path: Path) -> None:
    refused(tmp_path, OURS + "size: 0.3\n", r"'size'.* 2 .* 8\b")


@pytest.mark.parametrize(("size", "hint"), [("20", "20 cm"), ("200", "200 mm")])
def test_fault_41_marker_size_in_cm(tmp_path: Path, size: str, hint: str) -> None:
    refused(tmp_path, OURS.replace("size: 0.2", f"size: {size}"), rf":2: .*{hint}.* 0\.2$")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("4.0, 1.5", ".nan, 1.5", r":4: .*'\.nan'"),
        ("4.0, 1.5", "nan, 1.5", r":4: .*'nan'"),
        ("4.0, 1.5", ".inf, 1.5", r":4: .*'\.inf'"),
        ("4.0, 1.5", "1e300, 1.5", r":4: .*\[1e\+300, 1\.5, 0\.5\]"),
        ("id: 0", "id: -1", r":4: .* -1 "),
        ("id: 0", "id: 1.5", r":4: .*'1\.5'"),
        ("id: 0, ", "", r":4: 'id' .*position, facing"),
        ("[1, 0, 0, 0]", "[1, 1, 0, 0]", r":6: quaternion .* 1\.41\b.* 1\b"),
        ("[1, 0, 0, 0]", "[0, 0, 0, 0]", r":6: quaternion .* 0, .* 1\b"),
        ("[1, 0, 0, 0]", "[1, 0, 0]", r":6: .*\b4\b.*\b3\b"),
        ("rpy: [0, 0, 0]", "rpy: [0, 0, 90]", r":5: rpy \[0\.0, 0\.0, 90\.0\].*radians"),
        ("facing: 3.14", "rpy: [0, 0, 0], facing: 3.14", r":4: .*\b2\b.*facing, rpy"),
        ("position: [2.0, 2.5]", "position: [2.0, 2.5], size: 0.2", r":7: .*\b7\b.*size.*facing"),
        ("position: [1, 2, 0]", "position: [1, 2]", r":5: .*position.*x, y, z"),
        ("0.02]]", "-0.02]]", r":7: cov .*-0\.02"),
        ("[0.002, 0.02]", "[0.003, 0.02]", r":7: cov .*0\.003"),
        ("size: 0.15", "side: 0.15", r":5: .*'side'.*\bid, .*\bsize\b"),
        ("size: 0.15", "size: 0", r":5: .*\b0 m\b"),
        ("DICT_4X4_50", "DICT_4X4_51", r":1: .*'DICT_4X4_51'.*DICT_4X4_50"),
        ("landmarks:", "markers:", r":1: .*'landmarks'.*dictionary, size, markers"),
    ],
)
def test_wrong_maps_are_refused_with_the_line(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in OURS
    refused(tmp_path, OURS.replace(old, new, 1), match)


def test_rotation_that_is_none_is_refused_in_json(tmp_path: Path) -> None:
    data = wpilib()
    data["tags"][0]["pose"]["rotation"]["quaternion"]["W"] = 3.0  # type: ignore[index]
    refused(tmp_path, json.dumps(data), r":1: .* 3\.1", "field.json")


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", None),
        ("landmarks: []", None),
        ("- 1\n- 2", None),
        ("landmarks: [{id: 1", yaml.YAMLError),
        ("landmarks: !!python/object/apply:os.system [ls]", None),
        ("landmarks: " + "[" * 5000 + "]" * 5000, HostileError),
    ],
)
def test_what_is_no_map_is_refused(tmp_path: Path, text: str, cause: type[Exception] | None) -> None:
    path = written(tmp_path, text)
    with refusal(MapError, path, cause=cause):
        load_map(path)


def test_fault_65_yaml_bomb_is_refused_at_once(tmp_path: Path) -> None:
    levels = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    levels += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    began = time.perf_counter()
    bomb = written(tmp_path, "\n".join(levels) + "\nlandmarks: *a11\n")
    with refusal(MapError, bomb, cause=HostileError):
        load_map(bomb)
    assert time.perf_counter() - began < 1.0


def test_missing_file_and_binary_file(tmp_path: Path) -> None:
    with refusal(MapError, tmp_path / "absent.yaml", cause=FileNotFoundError):
        load_map(tmp_path / "absent.yaml")
    binary = tmp_path / "map.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x01" * 10)
    with refusal(MapError, binary, cause=UnicodeDecodeError):
        load_map(binary)


def test_ids_that_the_dictionary_lacks_are_noted(tmp_path: Path) -> None:
    [note] = load_map(written(tmp_path, OURS.replace("id: 7", "id: 70"))).notes
    assert re.search(r"\bDICT_4X4_50\b.*\b50\b.*\[70\]", note)


def test_units_of_a_map_are_those_of_the_settings(tmp_path):
    path = written(tmp_path, OURS)
    config = Config.model_validate({"map": {"scale": 0.3048, "size_scale": 0.5}})
    plain, metres = load_map(path), configured_map(path, config)
    for i, landmark in plain.landmarks.items():
        assert np.allclose(metres.landmarks[i].position, 0.3048 * landmark.position)
        assert metres.landmarks[i].size_m == pytest.approx(0.5 * landmark.size_m)
    assert np.allclose(metres.landmarks[7].cov, 0.3048**2 * plain.landmarks[7].cov)


def test_a_run_has_the_map_in_the_units_of_the_settings():
    sample = Path(__file__).resolve().parent.parent.parent / "datasets" / "samples" / "first_run"
    config = load_config(sample / "robot.yaml")
    config = config.model_copy(update={"map": config.map.model_copy(update={"scale": 2.0})})
    with Recording(sample / "bag", config.recording) as recording:
        landmark_map = recorded_setup(recording, sample / "map.yaml", config).landmark_map
    assert landmark_map is not None
    for i, landmark in load_map(sample / "map.yaml").landmarks.items():
        assert np.allclose(landmark_map.landmarks[i].position, 2.0 * landmark.position)


def test_a_map_larger_than_any_building_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("landmarks:\n" + "".join(f"  - {{id: {i}, position: [{i}, 0, 0]}}\n" for i in range(170_000)))
    began = time.process_time()
    with pytest.raises(MapError, match="bytes"):
        load_map(path)
    assert time.process_time() - began < 1.0
