"""Figures with their sigmas, in as many digits as are known."""

from __future__ import annotations

import math


def rounded(value: float, sigma: float, sign: str = "") -> tuple[str, str]:
    """Value and sigma in words: the sigma with two significant digits, the value with as many decimals, never -0.

    Args:
        value: the figure.
        sigma: its standard deviation; where it is 0, not finite or out of proportion six digits of the value are shown.
        sign: "+" to show that of a positive value, too.
    """
    if not (math.isfinite(value) and 1e-9 < sigma < 1e6):
        return f"{value:{sign}z.6g}", f"{sigma:.2g}"
    places = max(0, -int(f"{sigma:.1e}".partition("e")[2]) + 1)
    return f"{value:{sign}z.{places}f}", f"{sigma:.{places}f}"
