"""What the curves of a training say: where the validation got worse, or never got better."""

from __future__ import annotations

import math
from collections.abc import Mapping

from fgloc_training.checkpoint import Curve

_WORSE_DRIFT = 1.2  # last validated drift over the best one; less is the scatter between validations
_WORSE_NLL = 3.0  # nats of the mean negative log-likelihood of a window: its errors are e³ times less likely


def warnings_of(curves: Mapping[str, Curve]) -> list[str]:
    """Sentences on stages whose validation went wrong; none if all is well.

    Args:
        curves: by stage: ``mean`` scores are drifts [%], ``variance`` scores negative log-likelihoods.
    """
    return [text for stage, curve in curves.items() if (text := _warning(stage, curve)) is not None]


def _warning(stage: str, curve: Curve) -> str | None:
    if not curve.scores:
        return None
    kind = "drift of the validation recordings [%]" if stage.startswith("mean") else "negative log-likelihood"
    finite = [(i, s) for i, s in curve.scores if math.isfinite(s)]
    if not finite:
        return f"{stage}: the {kind} is not finite; the recordings hold errors that no variance explains"
    (first_at, first), (last_at, last) = finite[0], finite[-1]
    best_at, best = min(finite, key=lambda pair: pair[1])
    worse = last > _WORSE_DRIFT * best if stage.startswith("mean") else last > best + _WORSE_NLL
    if not worse:
        return None
    kept = f"the state of iteration {best_at} is kept"
    if best_at == first_at and len(finite) > 1:
        return (
            f"{stage}: the {kind} got worse from the first validation on, from {first:.3g} to {last:.3g} at iteration "
            f"{last_at} ({kept}): the validation recordings differ from those that train, or these are too few; record "
            "more like them, or give a smaller network (network.hidden)"
        )
    return (
        f"{stage}: the {kind} got worse after iteration {best_at}, from {best:.3g} to {last:.3g} at iteration "
        f"{last_at} ({kept}): the network learns the training recordings by heart; record more, or give a smaller "
        "network (network.hidden)"
    )
