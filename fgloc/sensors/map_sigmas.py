"""How well landmarks are known, in maps: ``sigma_m`` and ``sigma_rad``, or ``cov``."""

from __future__ import annotations

import numpy as np

from fgloc.files.documents import Item
from fgloc.types import FloatArray, Landmark

KEYS = ("cov", "sigma_m", "sigma_rad")
_OF = {2: "x, y", 3: "x, y, z", 6: "x, y, z and the rotation about the marker's axes"}


def read_cov(item: Item, turned: bool) -> FloatArray | None:
    """Covariance of an entry's pose: ``(2, 2)``, ``(3, 3)`` or ``(6, 6)`` as `Landmark` has it; None if not given.

    Args:
        item: the entry; ``sigma_m`` [m] is one number or one for each of x, y, z, ``sigma_rad`` likewise about the
            marker's axes, ``cov`` a matrix of x, y, of x, y, z, or of these and the rotation [m, rad].
        turned: whether the landmark has an orientation.

    Raises:
        MapError: a sigma that is not positive, a matrix that is no covariance, or both given.
    """
    matrix, m, rad = (item.get(key) for key in KEYS)
    if matrix is not None:
        if m is not None or rad is not None:
            raise matrix.fail("give either cov or sigma_m and sigma_rad, not both")
        return _cov(matrix, (2, 3, 6) if turned else (2, 3))
    if rad is not None and not turned:
        raise rad.fail("sigma_rad of a landmark without an orientation; give one, or leave sigma_rad out")
    if rad is not None and m is None:
        raise rad.fail("sigma_rad without sigma_m; give both, or neither")
    if m is None:
        return None
    sigmas = [_sigmas(part) for part in (m, rad) if part is not None]
    return np.diag(np.concatenate(sigmas) ** 2)


def sigma_fields(landmark: Landmark) -> list[str]:
    """What `read_cov` reads back, as ``key: value``; sigmas where nothing is correlated."""
    cov = landmark.cov
    if cov is None:
        return []
    if len(cov) == 2 or np.count_nonzero(cov - np.diag(np.diag(cov))):
        return [f"cov: [{', '.join(_row(row) for row in cov)}]"]
    sigmas = np.sqrt(np.diag(cov))
    fields = [f"sigma_m: {_row(sigmas[:3])}"]
    return fields if len(cov) == 3 else [*fields, f"sigma_rad: {_row(sigmas[3:])}"]


def _sigmas(item: Item) -> FloatArray:
    values = item.numbers(3) if item.is_sequence else np.full(3, item.number())
    if (values <= 0.0).any():
        raise item.fail(f"sigma {values.tolist()}, expected more than 0")
    return values


def _cov(item: Item, sizes: tuple[int, ...]) -> FloatArray:
    rows = [row.numbers() for row in item.entries()]
    n = len(rows)
    cov = np.array(rows) if n in sizes and all(len(row) == n for row in rows) else np.zeros((1, 1))
    if len(cov) != n or np.abs(cov - cov.T).max() > 1e-9 * np.abs(cov).max() or np.linalg.eigvalsh(cov)[0] <= 0.0:
        wanted = " or ".join(f"{k} by {k} (of {_OF[k]})" for k in sizes)
        shown = [row.tolist() for row in rows]
        raise item.fail(f"cov {shown} is not a covariance: expected {wanted}, symmetric, positive definite")
    return cov


def _row(values: FloatArray) -> str:
    return f"[{', '.join(repr(float(v)) for v in values)}]"
