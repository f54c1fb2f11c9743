"""Constant covariances for the peer that does not adapt: ``python -m benchmarks.adaptive_fixed`` tunes and prints them.

The wheels' noise densities of ``robot.yaml`` are multiplied by two factors, one for the way and one for the turn, the
same on every floor, for a robot does not know what floor it will meet. The factors are those with the least geometric
mean of the online ATE over `_CASES` on recordings of the training split; no other split is looked at.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from benchmarks.adaptive_recordings import SEEDS, prepare
from benchmarks.adaptive_runs import CASES, cell
from fgloc_datasets.sim.record import robot_settings
from fgloc_datasets.sim.scenario import Scenario

WAY, TURN = 5.0, 5.0  # as tuned
_FACTORS = (1.0, 3.0, 10.0, 30.0)
_CASES = ("none", "slip", "mu01", "dark30")


def constant(way: float = WAY, turn: float = TURN) -> dict[str, Any]:
    """Configuration of a run without adaptation, its wheels' noise multiplied by these factors."""
    noise = robot_settings(Scenario(name="any"))["wheels"]["noise"]
    scaled = {name: value * (turn if name.startswith("yaw") else way) for name, value in noise.items()}
    systematic = dict.fromkeys(("scale_sigma", "turn_scale_sigma", "yaw_per_m_sigma"), 0.0)  # these grow with the way
    return {"weights": {"adaptive": False}, "wheels": {"noise": scaled, **systematic}}


def tune(changes: dict[str, Any]) -> Iterator[tuple[float, float, list[float]]]:
    """Factors and the geometric means of the ATE [m] of each case over the training seeds.

    Args:
        changes: of the configuration, common to all (such as the motion model).
    """
    for way, turn in product(_FACTORS, _FACTORS):
        found = {name: cell(name, SEEDS["train"], changes | constant(way, turn), split="train") for name in _CASES}
        yield way, turn, [float(np.exp(np.mean([np.log(o.ate_m) for o in found[name]]))) for name in _CASES]


if __name__ == "__main__":
    prepare(sorted({CASES[name].floor for name in _CASES}), "train", SEEDS["train"])
    best = np.inf
    for way, turn, means in tune({}):
        total = float(np.exp(np.mean(np.log(means))))
        mark = " <-" if total < best else ""
        best = min(best, total)
        print(f"{way:4g} {turn:4g}  {total:.5f}  {' '.join(f'{m:.4f}' for m in means)}{mark}")
        sys.stdout.flush()
