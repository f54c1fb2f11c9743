"""Positions as drivers publish them: exchanged, in radians, as integers, or none at all; each is named."""

import math

import numpy as np
import pytest

from fgloc import run
from fgloc.calibration.first_settings import first_settings
from fgloc.config import config_of
from fgloc.diagnosis.comparison import Conventions
from fgloc.diagnosis.mistakes import find_mistakes, inspect_all
from fgloc.diagnosis.positions import check_positions
from fgloc.diagnosis.signals import Path, Signals
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


# --- Noise ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sigma", "cov", "named"), [(1.0, 0.0004, True), (1.0, 1.0, False), (0.05, 0.0004, False)])
def test_a_covariance_that_is_too_small_by_far_is_named_with_the_scale(tmp_path, sigma, cov, named):
    bag = write(tmp_path, seconds=60, cov=cov, sigma=sigma)
    config = settings(antenna=(0.0, 0.0))
    found = [f for f in find_mistakes(bag, None, config).findings if f.code == "gnss.sigma"]
    assert bool(found) == named
    if named:
        assert found[0].severity is Severity.ERROR
        assert float(found[0].lines["gnss.sigma_scale"]) == pytest.approx(sigma / math.sqrt(cov), rel=0.3)


def test_an_antenna_far_from_the_base_does_not_make_noise():
    """A lever arm of a metre that is not known, and wheels 2 % long, with positions of 2 cm."""
    rng, t = np.random.default_rng(1), np.arange(0.0, 80.0, 0.05)
    yaw = 0.8 * np.sin(0.4 * t)
    place = np.cumsum(0.05 * np.exp(1j * yaw))
    path = Path(t, np.column_stack([1.02 * place.real, 1.02 * place.imag, yaw]), np.zeros(len(t), np.int64), "odometry")
    fixes = (place + (1.0 + 0.4j) * np.exp(1j * yaw))[::20]
    fixes += rng.normal(0.0, 0.02, len(fixes)) + 1j * rng.normal(0.0, 0.02, len(fixes))
    rows = [(s, z.real, z.imag, 0.02) for s, z in zip(t[::20], fixes, strict=True)]
    found = Conventions(settings(), Signals(positions=rows))
    check_positions(found, path)
    assert not found.codes
    check_positions(found := Conventions(settings(), Signals(positions=[(*row[:3], 0.001) for row in rows])), path)
    assert not found.codes  # too little to be told from the wheels' errors
    noisy = [(s, x + rng.normal(0.0, 0.5), y + rng.normal(0.0, 0.5), 0.02) for s, x, y, _ in rows]
    check_positions(found := Conventions(settings(), Signals(positions=noisy)), path)
    assert found.codes == {"gnss.sigma"}


# --- One witness ------------------------------------------------------------------------------------------------------


def test_a_jump_of_one_receiver_that_the_wheels_contradict_is_a_warning_and_the_position_uncertain(tmp_path):
    count = iter(range(1000))

    def after_a_tunnel(place):
        k = next(count)
        return (math.nan, math.nan) if 20 <= k < 30 else (place[0] + 25.0 / M_PER_DEG * (k >= 30), place[1])

    bag = write(tmp_path, after_a_tunnel, seconds=50, cov=0.0004, sigma=0.02)
    result = run(bag, None, settings(), "batch")
    (finding,) = (f for f in result.findings if "which of both is wrong is not known" in f.text)
    assert finding.severity is Severity.WARNING
    assert finding.text.startswith("The sensor gnss alone put the robot 2")
    sigma = np.sqrt(result.trajectory.covs[:, 0, 0] + result.trajectory.covs[:, 1, 1])
    assert sigma[-1] > 10.0
    assert sigma[len(sigma) // 4] < 0.1
