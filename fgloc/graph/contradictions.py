"""A constant beyond the gate of its prior keeps its prior; what else explains the recording is compared by its cost.

What the model does not contain (an axis, a sign, a unit, a clock) goes into the nearest constant that is free, with a
tiny sigma. So a constant that leaves its prior is evidence that something is wrong, not of what: each of those that
left it, and each other one of the same effect, is freed alone, and only if one of them explains the recording clearly
best is it named as the cause.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgloc import se2
from fgloc.config import BatchConfig
from fgloc.graph.batch import BatchSmoother
from fgloc.graph.factors import LandmarkFactors
from fgloc.graph.installation import LENGTH, Installation, InstallationEstimate
from fgloc.graph.joint import considered
from fgloc.graph.measurement_log import MeasurementLog
from fgloc.stats import GATE, evidence_bound
from fgloc.types import FloatArray

_MOST_ROUNDS = 6  # of solutions until no constant is beyond its gate: one gives way to the next
_MOST_GATED = 3  # times that sightings are gated anew with what was freed
_MOST_RIVALS = 6  # solutions more, each with others freed
_SHARE = 0.05  # of what the best of them makes better, that another may lack to explain as much: models are no better
# Prior sigmas of constants that are freed, by the end of their name: of a robot that was put together by eye.
_BY_EYE = {"_m": 0.1, "_rad": 0.1, "_s": 0.1, "_px": 50.0}
_BY_EYE_RATIO = 0.15
RANGE_SCALE = "sightings.range_scale"
SENSIBLE = 3.0  # of these sigmas: further off is no installation


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """Constants that explain the recording if they alone are freed.

    Attributes:
        names: of the constants.
        mean: ``(c,)`` their values.
        sigmas: ``(c,)``.
        sensible: whether an installation can be like this.
        cost: of the batch with them, see `BatchSmoother.cost`.
        poses: ``(n, 3)`` of the keyframes with them.
    """

    names: tuple[str, ...]
    mean: FloatArray
    sigmas: FloatArray
    sensible: bool
    cost: float
    poses: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Contradiction:
    """Constants that are contradicted, and what explains it.

    Attributes:
        names: of those that were beyond the gate of their prior, and keep it.
        asked: the installation as it is found with these constants free.
        rivals: what explains as much as the best explanation, that first; empty: nothing alone does; None: it was not
            compared, online.
    """

    names: tuple[str, ...]
    asked: InstallationEstimate
    rivals: tuple[Rival, ...] | None = None


def smoothed_within_priors(
    log: MeasurementLog, factors: LandmarkFactors, config: BatchConfig, gate_probability: float
) -> tuple[BatchSmoother, Contradiction | None]:
    """The batch in which no constant is beyond the gate of its prior, and which ones would have been.

    Raises:
        EstimatorError: as `BatchSmoother` has it.
    """
    solver = BatchSmoother(log, factors, config, gate_probability)
    installation = factors.installation
    asked = solver.installed()
    beyond = installation.beyond_gate(asked) if installation.constants else ()
    held: tuple[str, ...] = ()
    for _ in range(_MOST_ROUNDS if beyond else 0):
        held = (*held, *(name for name in beyond[:1] if name not in held))  # what is wrong pulls others along
        inside = factors.with_installation(installation.with_sigmas(held, {}))
        solver = BatchSmoother(log, inside, config, gate_probability)
        beyond = inside.installation.beyond_gate(solver.installed())
        if not beyond:
            break
    if not held:
        return solver, None
    rivals: list[Rival] = []
    for freed in _candidates(installation, held, factors.known)[:_MOST_RIVALS]:
        free = factors.with_installation(installation.with_sigmas(held, freed))
        other = BatchSmoother(log, free, config, gate_probability)
        for _ in range(_MOST_GATED):
            if not other.reconsider():
                break
        rivals += _rivals(tuple(freed), other, free)
    return solver, Contradiction(held, asked, explaining(rivals, solver.cost(), solver.rows()))


def by_eye(name: str) -> float:
    """Prior sigma of a constant of which nothing is known but that somebody put it there."""
    return next((sigma for end, sigma in _BY_EYE.items() if name.endswith(end)), _BY_EYE_RATIO)


def explaining(rivals: Sequence[Rival], held: float, rows: int) -> tuple[Rival, ...]:
    """Rivals that explain as much as the best of them, the best first; none if the best explains nothing.

    Args:
        rivals: all that were tried.
        held: cost with the priors as they were given.
        rows: residuals of sightings: where the best explanation leaves them larger than their sigmas say, differences
            of cost count for less.
    """
    tried = sorted((r for r in rivals if np.isfinite(r.cost)), key=lambda r: r.cost)
    if not tried:
        return ()
    best = tried[0].cost
    tells = 0.5 * evidence_bound(GATE, len(tried)) * max(1.0, 2.0 * best / max(rows, 1))
    if held - best < tells:
        return ()
    alike = [r for r in tried if r.cost - best <= max(tells, _SHARE * (held - best))]
    return tuple(sorted(alike, key=lambda r: (len(r.names), r.cost)))


def _candidates(installation: Installation, held: Sequence[str], known: bool) -> list[dict[str, float]]:
    """Sets of constants to free, with sigmas: each one held, the length of the motion, others with the same effects."""
    effects, length = installation.effects, dict.fromkeys(installation.length, _BY_EYE_RATIO)
    concerned = {effect for name in held for effect in effects.get(name, ())}
    alone = [{name: by_eye(name)} for name in held]
    others = [n for n in installation.free if n not in held and concerned & set(effects.get(n, ()))]
    together = [length] if length and LENGTH in concerned and (len(length) > 1 or not known) else []
    return [*alone, *(t for t in together if t not in alone), *({n: by_eye(n)} for n in others)]


def _rivals(names: tuple[str, ...], solver: BatchSmoother, factors: LandmarkFactors) -> Iterator[Rival]:
    found, installation = solver.installed(), factors.installation
    rows = [installation.index[name] for name in names]
    mean, sigmas = found.mean[rows], np.sqrt(np.maximum(np.diag(found.cov)[rows], 0.0))
    eye = np.array([by_eye(name) for name in names])
    sensible = bool((np.abs(mean - installation.prior().mean[rows]) < SENSIBLE * eye).all())
    cost, poses = solver.cost(), solver.poses()
    if len(names) > 1:  # to the second order, turns are as they were
        by_turn = [LENGTH not in installation.effects.get(name, ()) for name in names]
        mean = np.where(by_turn, mean / (1.0 + mean), mean)
    yield Rival(names, mean, sigmas, sensible, cost, poses)
    if not factors.known and set(names) == set(installation.length) and mean[0] > -1.0:
        # Without a map motions that are longer by a factor are ranges that are shorter by it, bit by bit
        smaller = poses.copy()
        smaller[:, :2] /= 1.0 + mean[0]
        yield Rival((RANGE_SCALE,), -np.log1p(mean[:1]), sigmas[:1] / (1.0 + mean[0]), sensible, cost, smaller)


def spread(held: FloatArray, rivals: Sequence[Rival]) -> FloatArray:
    """Covariance ``(n, 3, 3)`` that the differences of the rivals' trajectories add to the poses.

    Args:
        held: poses ``(n, 3)`` with the priors as they were given.
        rivals: that explain as much.
    """
    total = np.zeros((len(held), 3, 3))
    for rival in rivals:
        apart = se2.between_array(held, rival.poses)
        total += apart[:, :, None] * apart[:, None, :]
    return total / max(len(rivals), 1)


def as_given(belief: InstallationEstimate, installation: Installation, held: Sequence[str]) -> InstallationEstimate:
    """Installation with the held constants at their prior, whose uncertainty the covariance includes."""
    rows = [installation.index[name] for name in held]
    prior = installation.prior()
    cov = considered(belief.cov, rows, prior.cov[np.ix_(rows, rows)])
    mean = belief.mean.copy()
    mean[rows] = prior.mean[rows]
    return InstallationEstimate(mean, cov)
