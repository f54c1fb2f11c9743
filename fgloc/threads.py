"""Threads of the linear algebra: none, as the matrices are small."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

_P = ParamSpec("_P")
_R = TypeVar("_R")


def one_blas_thread(work: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let BLAS use one thread meanwhile: threads that wait for one another cost a step ten times its time."""

    @wraps(work)
    def limited(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with threadpool_limits(limits=1, user_api="blas"):
            return work(*args, **kwargs)

    return limited
