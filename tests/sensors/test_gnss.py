"""Positions as drivers publish them: exchanged, in radians, as integers, or none at all; each is named."""

import math

import numpy as np
import pytest

from fgloc import run
from fgloc.calibration.first_settings import first_settings
from fgloc.config import config_of
from fgloc.diagnosis.mistakes import inspect_all
from fgloc.types import Severity
from fgloc_datasets.bag import BagWriter

START_NS = 1_700_000_000_000_000_000
ORIGIN = (48.137154, 11.576124, 519.0)
M_PER_DEG = 111_200.0  # of latitude; of longitude by its cosine


def write(folder, change=lambda place: place, seconds=20, cov=0.01, sigma=0.1):
    """A robot on a curve with odometry at 20 Hz, and positions at 1 Hz, changed as ``(latitude, longitude)``."""
    rng = np.random.default_rng(3)
    x = y = yaw = 0.0
    with BagWriter(folder / "bag") as bag:
        for k in range(20 * seconds):
            v, w = 1.0, 0.4 * math.sin(0.05 * k * 2.0 * math.pi / 9.0) + 0.05
            stamp = START_NS + k * 50_000_000
            bag.odometry("/odom", stamp, (x, y, yaw), (v, w), stamp)
            if k % 20 == 0:
                north, east = np.array([y, x]) + rng.normal(0.0, sigma, 2)
                place = ORIGIN[0] + north / M_PER_DEG, ORIGIN[1] + east / M_PER_DEG / math.cos(math.radians(ORIGIN[0]))
                bag.satellite_fix("/fix", stamp, (*change(place), ORIGIN[2]), (cov, cov, 4.0 * cov), stamp, "base_link")
            x, y, yaw = x + 0.05 * v * math.cos(yaw), y + 0.05 * v * math.sin(yaw), yaw + 0.05 * w
    return folder / "bag"


def settings(**gnss):
    return config_of({"gnss": {"origin": ORIGIN} | gnss})


FORMS = {
    "exchanged": lambda place: place[::-1],
    "in radians": lambda place: tuple(map(math.radians, place)),
    "degrees times 1e7": lambda place: tuple(1e7 * value for value in place),
}


@pytest.mark.parametrize("form", FORMS)
def test_positions_that_are_not_degrees_are_named_with_an_origin(tmp_path, form):
    texts = [f.text for f in inspect_all(write(tmp_path, FORMS[form], 6), None, settings()).found]
    assert any(f"latitude and longitude seem to be {form}" in text for text in texts), texts
    if form != "degrees times 1e7":
        assert any("km from gnss.origin, expected at most 20 km" in text for text in texts)
    else:
        assert any("6 of 6 messages have a latitude beyond 90°" in text for text in texts)


@pytest.mark.parametrize("form", ["in radians", "degrees times 1e7"])
def test_no_origin_is_proposed_of_positions_that_are_not_degrees(tmp_path, form):
    bag = write(tmp_path, FORMS[form], 6)
    texts = [f.text for f in inspect_all(bag, None, config_of({})).found]
    assert any(f"seem to be {form}" in text for text in texts)
    assert not any("set gnss.origin" in text for text in texts)
    made = first_settings(bag)
    assert "origin:" not in made.text
    assert any(f"which cannot be used: latitude and longitude seem to be {form}" in text for text in made.missing)


def test_positions_that_are_not_numbers_are_named(tmp_path):
    bag = write(tmp_path, lambda place: (math.nan, math.nan), 6)
    texts = [f.text for f in inspect_all(bag, None, settings()).found]
    assert any("/fix: 6 of 6 messages hold NaN or infinity" in text for text in texts)
    assert any("no message holds a position" in text for text in first_settings(bag).missing)


def test_an_origin_elsewhere_is_a_warning_of_the_run_with_the_place_of_the_positions(tmp_path):
    bag, elsewhere = write(tmp_path, seconds=6), settings(origin=(52.5, 13.4, 40.0))
    result = run(bag, None, elsewhere.model_copy(update={"estimator": started(elsewhere)}), "online")
    for found in (result.findings, inspect_all(bag, None, elsewhere).found):
        (finding,) = (f for f in found if "km from gnss.origin" in f.text)
        assert finding.severity is Severity.WARNING
        assert "correct gnss.origin (latitude first), which they would have at 48.137" in finding.text


def started(config):
    return config.estimator.model_copy(update={"initial_pose": (0.0, 0.0, 0.0)})


def test_sound_positions_are_not_doubted(tmp_path):
    bag = write(tmp_path, seconds=6)
    assert not [f for f in inspect_all(bag, None, settings()).found if "/fix" in f.text]
    assert "# origin: [48.137" in first_settings(bag).text
