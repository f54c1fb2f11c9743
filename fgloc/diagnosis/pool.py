"""Evidence of many windows on parameters that they share, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgloc.types import FloatArray

_MOST = 512  # windows kept apart; of more, neighbors are added up
_REWEIGHTINGS = 10
_TYPICAL = 4.0  # squared misfit, per parameter, at which a window counts half


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """A quadratic of the parameters about one stretch of time: information ``(p, p)``, and information times value."""

    at_s: float
    information: FloatArray
    weighted: FloatArray  # (p,)


@dataclass(frozen=True, slots=True, eq=False)
class Pooled:
    """Parameters ``(p,)``, their sigmas ``(p,)``, and from how many windows."""

    values: FloatArray
    sigmas: FloatArray
    windows: int


class Pool:
    """Collects evidence in bounded memory."""

    def __init__(self, prior_sigmas: FloatArray) -> None:
        self._prior = np.diag(prior_sigmas**-2.0)
        self._evidence: list[Evidence] = []

    def __len__(self) -> int:
        return len(self._evidence)

    def add(self, evidence: Evidence) -> None:
        """Take in a window."""
        self._evidence.append(evidence)
        if len(self._evidence) > _MOST:
            merged = zip(self._evidence[::2], self._evidence[1::2], strict=False)
            rest = self._evidence[-1:] if len(self._evidence) % 2 else []
            self._evidence = [_sum(a, b) for a, b in merged] + rest

    def constant(self) -> Pooled:
        """The parameters taken as constant."""
        return _pooled(self._evidence, self._prior)

    def drifting(self, i: int) -> Pooled:
        """Likewise, but parameter ``i`` changes evenly with time; its change per second comes last.

        Its own value is that in the middle of the run.
        """
        if not self._evidence:
            return _pooled(self._evidence, self._prior)
        times = np.array([e.at_s for e in self._evidence])
        middle = 0.5 * (times.min() + times.max())
        p = len(self._prior)
        prior = np.zeros((p + 1, p + 1))
        prior[:p, :p] = self._prior
        prior[p, p] = 1e-12
        extended = []
        for e in self._evidence:
            A = np.zeros((p, p + 1))
            A[:, :p] = np.eye(p)
            A[i, p] = e.at_s - middle
            extended.append(Evidence(e.at_s, A.T @ e.information @ A, A.T @ e.weighted))
        return _pooled(extended, prior)

    @property
    def span_s(self) -> float:
        """Time between the first window and the last [s]."""
        return self._evidence[-1].at_s - self._evidence[0].at_s if self._evidence else 0.0


def eliminated(information: FloatArray, pull: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Information and pull of a linear problem without its first ``n`` unknowns (Schur complement)."""
    own = np.linalg.pinv(information[:n, :n], rcond=1e-9, hermitian=True)
    cross = information[n:, :n] @ own
    rest = information[n:, n:] - cross @ information[:n, n:]
    return 0.5 * (rest + rest.T), pull[n:] - cross @ pull[:n]


def _sum(a: Evidence, b: Evidence) -> Evidence:
    return Evidence(0.5 * (a.at_s + b.at_s), a.information + b.information, a.weighted + b.weighted)


def _pooled(evidence: Sequence[Evidence], prior: FloatArray) -> Pooled:
    """Robust mean of the windows; sigmas by leaving each of them out, at least those of the information.

    Source: the jackknife (Efron, "The jackknife, the bootstrap and other resampling plans", 1982, chapter 3).
    """
    p = len(prior)
    n = len(evidence)
    if n == 0:
        return Pooled(np.zeros(p), np.sqrt(1.0 / np.diag(prior)), 0)
    informations = np.array([e.information for e in evidence])
    weighted = np.array([e.weighted for e in evidence])
    weights = np.ones(n)
    for _ in range(_REWEIGHTINGS):
        total = np.einsum("n,nij->ij", weights, informations) + prior
        inverse = np.linalg.inv(total)
        values = inverse @ (weights @ weighted)
        scores = weighted - informations @ values
        widened = np.linalg.inv(informations + 1e-3 * prior)
        squares = np.einsum("ni,nij,nj->n", scores, widened, scores) / p
        weights = 1.0 / (1.0 + squares / _TYPICAL)
    without = np.linalg.solve(
        total - weights[:, None, None] * informations, (weights @ weighted - weights[:, None] * weighted)[..., None]
    )
    scatter = (n - 1) / n * ((without[..., 0] - values) ** 2).sum(axis=0)
    return Pooled(values, np.sqrt(np.maximum(scatter, np.diag(inverse))), n)
