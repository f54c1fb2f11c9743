"""Real photographs of markers."""

from __future__ import annotations

import pytest
from real_data import real_data

from benchmarks.stills import STILLS, outcomes


@pytest.mark.real_data
def test_every_listed_id_is_found_and_no_other() -> None:
    found = list(outcomes(real_data("marker_images")))
    assert len(found) == len(STILLS)
    assert [(o.still.file, o.missed, o.false) for o in found if o.missed or o.false] == []
