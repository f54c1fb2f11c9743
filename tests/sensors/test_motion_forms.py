"""Every form of model, trained on the same runs and judged on another."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest
import torch
from synthetic_robot import synthetic

from fgloc.sensors.learned.card import FAMILIES, Kind, Split
from fgloc.sensors.learned.sensor import load_model
from fgloc_training import train as training
from fgloc_training.config import CalibrationConfig, NetworkConfig, OptimizationConfig, TrainConfig
from fgloc_training.evaluate import Figures, evaluate
from fgloc_training.rollouts import roll_model

pytestmark = pytest.mark.slow  # seven trainings
SPLIT = Split(train=("run1", "run2", "run3"), validation=("run4",), test=("run0",))


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Figures]:
    """Of free rollouts of 10 s, by kind."""
    torch.set_num_threads(1)
    runs = {f"run{seed}": synthetic(seed) for seed in range(5)}
    out = {}
    for kind in get_args(Kind):
        config = TrainConfig(
            robot="synthetic",
            recordings={name: Path(name) for name in runs},
            split=SPLIT,
            network=NetworkConfig(kind=kind, hidden=(16, 16) if kind == "gru" else (32, 32)),
            optimization=OptimizationConfig(
                horizon_s=1.0, batch=64, iterations=150, validate_every=50, variance_iterations=40
            ),
            calibration=CalibrationConfig(horizons_s=(2.0, 5.0), short_s=(0.2,), window_s=2.0),
        )
        path = tmp_path_factory.mktemp(kind) / "model.safetensors"
        card = training.train(config, SPLIT, runs, path, "a test")
        model = load_model(path)
        assert model.card == card
        assert card.kind == kind
        assert (card.noise is None) == (FAMILIES[kind] == "displacement")
        out[kind] = evaluate([roll_model(model, runs["run0"], 0.2)], 10.0)
    return out


def test_what_is_known_more_drifts_less(figures: dict[str, Figures]) -> None:
    drift = {kind: f.drift_percent for kind, f in figures.items()}
    assert drift["lag"] < 0.8 * drift["naive"]
    assert drift["arx"] < drift["naive"]
    for kind in ("velocity", "rate", "displacement", "gru"):
        assert drift[kind] < 0.6 * drift["naive"], drift


def test_every_form_is_calibrated(figures: dict[str, Figures]) -> None:
    for kind, f in figures.items():
        assert f.nis_over_3 is not None
        assert 0.1 < f.nis_over_3 < 6.0, kind
