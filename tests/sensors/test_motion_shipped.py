"""The shipped models: they load, are small, keep to their split, and dead-reckon the robot that they have not seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real_data import real_data

import fgloc.sensors.learned
from fgloc.sensors.learned.card import Kinematics
from fgloc.sensors.learned.sensor import load_model
from fgloc.types import ControlEvent
from fgloc_datasets import mrclam
from fgloc_training.config import DataConfig
from fgloc_training.data import make_run
from fgloc_training.evaluate import evaluate
from fgloc_training.rollouts import roll_kinematics, roll_model

MODELS = Path(fgloc.sensors.learned.__file__).parent / "models"


def test_shipped_models_load() -> None:
    files = sorted(MODELS.glob("**/*.safetensors"))
    assert len(files) >= 6
    for path in files:
        card = load_model(path).card
        assert path.stat().st_size < 300_000
        assert (path.parent / "MODEL_CARD.md").is_file()
        assert card.joint is not None
        assert card.wheels_noise is not None
        assert card.figures
        assert not {*card.split.train, *card.split.validation} & set(card.split.test)
        if path.stem.startswith("without_"):
            assert card.split.test == (path.stem.removeprefix("without_"),)


@pytest.mark.real_data
@pytest.mark.parametrize("robot", [2, 4])
def test_model_halves_the_drift_of_an_unseen_robot(robot: int) -> None:
    run = mrclam.read(real_data("mrclam6"), robot)
    commands = [
        ControlEvent(int(t), int(t), "/cmd_vel", float(v), float(omega))
        for t, (v, omega) in zip(run.commands_ns, run.commands, strict=True)
    ]
    samples = make_run("r", commands, run.truth_ns, run.truth, 0.1, 3.0, DataConfig())
    model = load_model(MODELS / "mrclam" / f"without_robot{robot}.safetensors")
    learned = roll_model(model, samples, 0.2)
    figures = evaluate([learned], 10.0)
    raw = evaluate([roll_kinematics(Kinematics(), samples, 0.2)], 10.0)
    assert figures.drift_percent < 0.5 * raw.drift_percent
    assert figures.drift_percent == pytest.approx(model.card.figures["drift_percent_10s"], abs=0.3)
    assert figures.nis_over_3 is not None
    assert 0.5 < figures.nis_over_3 < 2.0
    assert np.isfinite(learned.covs).all()
