"""Constants put together by eye: their rivals, and what they may be off by."""

import pytest

from fgloc.graph.contradictions import SENSIBLE, by_eye


@pytest.mark.parametrize(
    ("name", "sensible", "not_sensible"),
    [
        ("sightings.x_m", 0.2, 0.5),
        ("camera.rx_rad", 0.2, 0.5),
        ("camera.cx_px", 100.0, 200.0),
        ("gyro.scale", 0.3, 0.6),
    ],
)
def test_what_was_put_together_by_eye_is_off_by_so_much_and_not_more(name, sensible, not_sensible):
    assert sensible < SENSIBLE * by_eye(name) < not_sensible
