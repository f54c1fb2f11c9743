"""Statistics: quantiles that decide, in one place, and figures rounded by their standard deviation.

There are four levels: `GATE` of a single measurement (``estimator.gate_probability``), one false alarm a day of a
monitor (`alarm_bound`), the gate's of several hypotheses over a whole run (`evidence_bound`): by it a landmark is named
to the user, and `PRIOR_GATE` of a constant: what is further off contradicts what was given, and is not used.
"""

from __future__ import annotations

import math
import sys
from functools import lru_cache

# Prior sigmas that a constant of the installation may be off by. A careful installation is off by one of them, a
# careless one by twice as much, and three sigmas of that are as far as it goes: beyond, something else is wrong.
PRIOR_GATE = 6.0
SURE_SIGMAS = 3.0  # sigmas, of what was found and of what was given, from which a constant is surely another one
GATE = 0.9999  # a measurement that is less likely than one minus this is not fused
ROUNDING = math.sqrt(sys.float_info.epsilon)  # relative error that rounding may leave in what is solved for
_ALARM_EVERY_S = 86400.0  # where nothing is wrong: a robot drives all day, some 20 km


@lru_cache
def chi2_bound(probability: float, dof: int) -> float:
    """χ² quantile: a sum of ``dof`` squared standard normal variables exceeds it with one minus this probability."""
    from scipy.special import gammaincinv  # not where the configuration alone is needed; scipy.stats takes longer still

    return float(2.0 * gammaincinv(0.5 * dof, probability))


def alarm_bound(seconds: float, tests: int, dof: int, samples: float = math.inf) -> float:
    """χ² quantile that raises at most one false alarm a day (Bonferroni).

    Args:
        seconds: after which it is tested again.
        tests: how many statistics are held against it each time.
        dof: of each of them.
        samples: that the standard deviation was estimated from: of few it is the square of Student's t; one dof only.
    """
    probability = 1.0 - seconds / (tests * _ALARM_EVERY_S)
    return chi2_bound(probability, dof) if math.isinf(samples) else _t_bound(probability, max(int(samples), 1))


@lru_cache
def _t_bound(probability: float, samples: int) -> float:
    from scipy.special import stdtrit  # as above

    return float(stdtrit(samples, 0.5 + 0.5 * probability) ** 2)


def few_samples(samples: int) -> float:
    """Student's t that is as sure as five standard deviations of many samples, over five."""
    return math.sqrt(_t_bound(math.erf(5.0 / math.sqrt(2.0)), max(samples - 1, 1))) / 5.0


def evidence_bound(probability: float, hypotheses: int) -> float:
    """Twice the log-likelihood ratio of one of several hypotheses to "none" that is seldom reached if none is right.

    Source: the likelihood ratio exceeds x with a probability of at most 1/x (Ville 1939), for each of them.
    """
    return 2.0 * math.log(hypotheses / (1.0 - probability))


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
