"""How a setting that was found is shown: with its unit, and as many digits as its sigma knows."""

from __future__ import annotations

from fgloc.rounding import rounded
from fgloc.types import Setting

_SUFFIXES = {"s": "s", "m": "m", "px": "px", "rad": "rad"}
_UNITS = dict.fromkeys(("x", "y", "z"), "m") | dict.fromkeys(("roll", "pitch", "yaw"), "rad")
_UNITS |= {"yaw_per_m": "rad/m", "slowdown": "s/rad"}


def unit(name: str) -> str:
    """Of a setting such as ``camera.cx_px``; "-" of a ratio."""
    section, _, key = name.partition(".")
    named = section if section.startswith("stamp_offset") else key
    return _UNITS.get(named) or (_SUFFIXES.get(named.rpartition("_")[2], "-") if "_" in named else "-")


def given(s: Setting) -> str:
    """What was given, with the digits that what was found has."""
    return rounded(s.given, s.sigma)[0]


def found(s: Setting) -> str:
    """What was found and its sigma."""
    return " ± ".join(rounded(s.found, s.sigma))
