"""Complaints on a wrong settings file name its file, line and key, in terms of YAML, not of Python and pydantic."""

import re

import pytest

from fgloc.config import load_config
from fgloc.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "key", "wanted"),
    [
        ("recording: {sightings_pose: [1, 2, 3]}", "recording.sightings_pose", "6 numbers"),
        ("recording: {sightings_pose: [1, 2, 3, 4, 5, 6, 7]}", "recording.sightings_pose", "6 numbers"),
        ("recording: {sightings_pose: 1}", "recording.sightings_pose", "6 numbers"),
        ("estimator: {initial_pose: {x: 1}}", "estimator.initial_pose", "3 numbers"),
        ("estimator: {initial_pose: [1, 2, 90]}", "estimator.initial_pose", "radians (90° are 1.5708)"),
        ("expert: {estimator: {initial_sigmas: [1]}}", "expert.estimator.initial_sigmas", "3 numbers"),
        ("cameras: {front: {image: /i, pose: [1, 2]}}", "cameras.front.pose", "6 numbers"),
        ("uwb: {anchors: {1: [1, 2]}}", "uwb.anchors.1", "3 numbers"),
        ("recording: {odometries: 3}", "recording.odometries", "a list"),
        ("recording: {received_stamps: odometry}", "recording.received_stamps", "a list"),
        ("recording: {stamp_offset_s: 3}", "recording.stamp_offset_s", "keys with values"),
        ("camera: {file: 3}", "camera.file", "file"),
        ("wheels: {drive: {wheels: 3}}", "wheels.drive", "kind"),
        ("uwb: {anchors_sigma_m: [1]}", "uwb.anchors_sigma_m", "number or keys with values"),
    ],
)
def test_one_complaint_names_the_key_and_what_is_wanted(tmp_path, text, key, wanted):
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"{path}:1: {key}: ")
    assert wanted in line
    assert not re.search("tuple|dict|Path|constrained|pydantic|Input|Unable|Field", line)
