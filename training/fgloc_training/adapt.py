"""A trained model fitted to another robot of its kind, from a minute of its driving.

Only gains and pull move, as far as the errors are larger than the model expects them to be: robots of a kind differ in
little else, and a minute holds too few turns to teach a network anything but its accidents.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import least_squares

from fgloc.errors import RecordingError
from fgloc.sensors.learned.card import ModelCard
from fgloc.sensors.learned.sensor import Tensors, model_of
from fgloc.types import FloatArray
from fgloc_training.config import AdaptationConfig
from fgloc_training.data import Run
from fgloc_training.rollouts import Rollout, roll_model

_STEP_S = 0.2


def adapted(
    tensors: Tensors, card: ModelCard, runs: list[Run], config: AdaptationConfig, window_s: float | None = None
) -> ModelCard:
    """The card with the kinematics that are most probable after these runs; the weights fit it unchanged.

    Args:
        tensors: the model's weights.
        card: the model's card; its covariance says how much of an error is chance.
        runs: of the new robot.
        config: how much robots of a kind differ, and the windows that are compared.
        window_s: other windows than the configuration's.

    Raises:
        RecordingError: no window has truth throughout.
    """
    window_s = config.window_s if window_s is None else window_s

    def moved(parameters: FloatArray) -> ModelCard:
        v, omega, pull = (parameters * np.array(config.sigmas)).tolist()
        k = card.kinematics
        kinematics = k.model_copy(
            update={
                "scale_v": k.scale_v * math.exp(v),
                "scale_omega": k.scale_omega * math.exp(omega),
                "yaw_per_m": k.yaw_per_m + pull,
            }
        )
        return card.model_copy(update={"kinematics": kinematics})

    def residuals(parameters: FloatArray) -> FloatArray:
        model = model_of(tensors, moved(parameters))
        white = [_whitened(roll_model(model, run, _STEP_S), window_s) for run in runs]
        return np.concatenate([*white, parameters])

    if len(residuals(np.zeros(3))) == 3:
        raise RecordingError(f"the recordings hold no {window_s:.0f} s of unbroken truth to adapt to; give longer ones")
    return moved(least_squares(residuals, np.zeros(3)).x)


def _whitened(rollout: Rollout, window_s: float) -> FloatArray:
    """Errors over windows side by side, in units of what the model expects."""
    k, _ = rollout.starts(window_s, window_s)
    every, _ = rollout.starts(window_s)
    picked = np.isin(every, k)
    if not picked.any():
        return np.zeros(0)
    roots = np.linalg.cholesky(rollout.end_covs(window_s)[picked])
    return np.asarray(np.linalg.solve(roots, rollout.errors(window_s)[picked][..., None])).ravel()
