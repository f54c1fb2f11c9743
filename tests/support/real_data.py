"""Where the real recordings are that some tests need."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parent.parent.parent.parent / "shared" / "data"


def real_data(*parts: str) -> Path:
    """Path of a real recording; skips the test where it is absent."""
    path = Path(os.environ.get("FGLOC_REAL_DATA", _DEFAULT)).joinpath(*parts)
    if not path.exists():
        pytest.skip(f"real recording {path} is absent; set FGLOC_REAL_DATA to the folder that holds them")
    return path
