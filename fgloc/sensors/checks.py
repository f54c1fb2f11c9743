"""Checks that the sensors share: of the fields of one message, and of a topic of a recording.

A judgement of a field is the thing itself (perhaps a repaired copy) or a ``str``: the reason why it cannot be used.
"""

from __future__ import annotations

import math
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fgloc.types import MAX_LANDMARK_ID, Event, FloatArray, Grave, RawEvent, Sighting, SightingsEvent

if TYPE_CHECKING:
    from fgloc.config import Config, GateConfig


# --- fields of a message ----------------------------------------------------------------------------------------------

_ASYMMETRY = 1e-4  # of a correlation: less is rounding, more is a mistake
_INDEFINITE = 1e-6  # an eigenvalue of a correlation matrix may be this negative
Changes = dict[str, Any]  # fields of a repaired copy
PLANAR = (0, 1, 5)  # x, y, yaw of a ROS covariance
EMPTIED = "emptied"  # reason of an event all parts of which were rejected, and counted, one by one
_SHOWN_IDS = 12
_KEPT_IDS = 1000
E = TypeVar("E", bound=SightingsEvent)


def judge_covariance(cov: FloatArray, axes: Sequence[int], max_variance: float) -> tuple[FloatArray | str, str]:
    """Judge the block of a covariance that somebody will read.

    Args:
        cov: ``(n, n)``.
        axes: rows and columns that are read. Of the others only the variances are looked at: planar robots like to
            fill them with 1e6 or infinity.
        max_variance: above it a variance says "unknown".

    Returns:
        The verdict and, if the verdict is all zeros ("unknown: use the default"), what the covariance was. A negative
        variance, an asymmetric or an indefinite block gives a reason instead; rounding is repaired.
    """
    n = len(cov)
    flat: list[float] = cov.ravel().tolist()
    variances = flat[:: n + 1]
    needed = [variances[i] for i in axes]
    if any(value != value for value in flat):
        return np.zeros_like(cov), "NaN"
    if min(variances) < 0.0:
        return "negative_variance", ""
    if max(needed) > max_variance:
        return np.zeros_like(cov), f"larger than {max_variance:g}"
    if flat.count(0.0) - variances.count(0.0) < n * n - n:  # not diagonal
        sigmas = [math.sqrt(value) or 1.0 for value in needed]  # a zero variance allows no correlation
        asymmetry, r = 0.0, []
        for k, i in enumerate(axes):
            for m, j in enumerate(axes[:k]):
                a, b = flat[i * n + j] / sigmas[k] / sigmas[m], flat[j * n + i] / sigmas[k] / sigmas[m]
                asymmetry = max(asymmetry, abs(a - b) if math.isfinite(a - b) else math.inf)
                r.append(0.5 * (a + b))
        if asymmetry > _ASYMMETRY:
            return "asymmetric_cov", ""
        if _indefinite(r, [float(value > 0.0) for value in needed]):
            return "indefinite_cov", ""
        if asymmetry > 0.0:
            cov = cov.copy()
            block = cov[np.ix_(axes, axes)]
            cov[np.ix_(axes, axes)] = 0.5 * (block + block.T)
    if min(needed) == 0.0:
        return np.zeros_like(cov), "zero" if max(needed) == 0.0 else "zero in part"
    return cov, ""


def _indefinite(r: list[float], diagonal: list[float]) -> bool:
    """Whether a correlation matrix, given as lower triangle without and with its diagonal, is not semi-definite."""
    if any(abs(value) > 1.0 + _INDEFINITE for value in r):
        return True
    n = len(diagonal)
    if n == 3 and min(diagonal) > 0.0:  # spelled out: it runs for each odometry message of a growing covariance
        a, b, c = r
        return 1.0 + 2.0 * a * b * c - a * a - b * b - c * c < -_INDEFINITE
    matrix = np.diag(diagonal)
    matrix[np.tril_indices(n, -1)] = r
    return bool(np.linalg.eigvalsh(matrix, UPLO="L")[0] < -_INDEFINITE)


def listed(ids: Collection[int]) -> str:
    """The first of some ids or numbers, for a sentence."""
    return ", ".join(map(str, sorted(ids)[:_SHOWN_IDS])) + (", ..." if len(ids) > _SHOWN_IDS else "")


class FieldChecks:
    """Shared state of the validators of one run: bounds, notes, counts of rejected parts, and ids of known landmarks.

    Attributes:
        config: bounds.
        note: adds a note for the user.
        rejections: parts of events that were rejected, by "role.reason"; whole events are counted by `EventValidator`.
    """

    def __init__(
        self,
        config: GateConfig,
        note: Callable[[str], None],
        rejections: Counter[str] | None = None,
        known_ids: Collection[int] | None = None,
        named: Mapping[str, str] | None = None,
    ) -> None:
        """Set up with a place for notes and counts; ``known_ids`` None: every id passes.

        ``named`` has the camera of each topic where there are several.
        """
        self._named = named or {}
        self.config = config
        self.rejections: Counter[str] = Counter() if rejections is None else rejections
        self.note = note
        self._known = None if known_ids is None else frozenset(known_ids)
        self._unknown: set[int] = set()
        self._any_known = False
        self._covs: dict[tuple[str, str], tuple[bytes, FloatArray | str]] = {}  # last covariance and its verdict

    @property
    def notes(self) -> tuple[str, ...]:
        """Note for the user on ids that were ignored, as the map does not have them; empty if there are none."""
        if not self._unknown:
            return ()
        unknown, known = listed(self._unknown), listed(self._known or ())
        if not self._any_known:
            return (Grave(f"none of the ids that were seen ({unknown}) is in the map, which has {known or 'none'}"),)
        return (f"sightings of ids that are not in the map are ignored: {unknown} (it has {known})",)

    def sift(self, event: E, judge: Callable[[str, Any], Sighting | str]) -> E | str:
        """The event, a copy without the bad entries, or the reason for rejection.

        Args:
            event: sightings.
            judge: from topic and entry to the entry, a repaired copy, or the reason why it cannot be used.
        """
        kept: list[Sighting] = []
        changed = False
        for sighting in event.sightings:
            number = sighting.landmark_id
            verdict: Sighting | str = "id_bound"
            if 0 <= number <= MAX_LANDMARK_ID:
                verdict = "unknown_id" if self._is_unknown(number) else judge(event.topic, sighting)
            if isinstance(verdict, str):
                camera = self._named.get(event.topic, "")
                self.rejections[f"{camera}{'/' if camera else ''}sightings.{verdict}"] += 1
                changed = True
            else:
                kept.append(verdict)
                changed = changed or verdict is not sighting
        if not changed:
            return event
        return replace(event, sightings=tuple(kept)) if kept else EMPTIED

    def _is_unknown(self, landmark_id: int) -> bool:
        if self._known is None or landmark_id in self._known:
            self._any_known = True
            return False
        if len(self._unknown) < _KEPT_IDS:
            self._unknown.add(landmark_id)
        return True

    def quaternion(self, quaternion: FloatArray, name: str, changes: Changes) -> str:
        """Check a quaternion ``(4,)``: reason for rejection or ""; one made unit goes into ``changes[name]``."""
        x, y, z, w = quaternion.tolist()
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if not abs(norm - 1.0) <= self.config.quaternion_tolerance:  # also NaN
            return "quaternion" if math.isfinite(norm) else "non_finite"
        if abs(norm - 1.0) > 1e-6:
            changes[name] = quaternion / norm
        return ""

    def covariance(
        self, topic: str, what: str, cov: FloatArray, axes: Sequence[int], name: str, changes: Changes
    ) -> str:
        """Check a covariance: reason for rejection or ""; a repaired copy goes into ``changes[name]``."""
        raw = cov.tobytes()
        key = (topic, what)
        last = self._covs.get(key)
        if last is not None and last[0] == raw:  # most drivers send the same one for ever
            verdict = last[1]
        else:
            verdict, was = judge_covariance(cov, axes, self.config.max_variance)
            if was:
                self.note(f"{topic}: {what} covariance is {was}; the configured default is used")
            self._covs[key] = (raw, verdict)
        if isinstance(verdict, str):
            return verdict
        if verdict is not cov and verdict.tobytes() != raw:
            changes[name] = verdict
        return ""


# --- a topic of a recording, for `fgloc info` -------------------------------------------------------------------------

_UNIT_TOLERANCE = 0.05


class Collector(Protocol):
    """Collects the events of one topic and reports what is wrong with them."""

    def add(self, event: Event) -> None:
        """Add one event."""

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each; ``seconds``: receive times ``(n,)`` from the recording's start."""


class TimingOnly:
    """Collector without checks of its own, for topics of which only the timing is checked."""

    def add(self, event: Event) -> None:
        """Ignore the event."""

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Return no faults."""
        return []


class Table:
    """Table of floats that grows row by row, stored compactly."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._values = array("d")

    def add(self, *values: float) -> None:
        """Add a row."""
        self._values.extend(values)

    def array(self) -> FloatArray:
        """All rows ``(n, width)``."""
        return np.array(self._values, dtype=float).reshape(-1, self._width)


def finite_rows(rows: FloatArray) -> NDArray[np.bool_]:
    """Mask ``(n,)`` of the rows that hold neither NaN nor infinity."""
    return np.asarray(np.isfinite(rows).all(axis=1))


def count(mask: NDArray[np.bool_]) -> str:
    """Number of true entries and of all entries, as in "3 of 10"."""
    return f"{int(mask.sum())} of {mask.size}"


def times(n: int) -> str:
    """Number of times as text: "once", or "3 times"."""
    return "once" if n == 1 else f"{n} times"


def spikes(topic: str, name: str, unit: str, values: FloatArray, bound: float, seconds: FloatArray) -> list[str]:
    """Sentence on values beyond a bound, with the largest; empty if there are none."""
    beyond = values > bound
    if not beyond.any():
        return []
    at = int(np.argmax(np.where(beyond, values, 0.0)))
    return [
        f"{topic}: {count(beyond)} have a {name} beyond {bound:g} {unit} (up to {values[at]:.4g}, at "
        f"{seconds[at]:.1f} s) and will be rejected."
    ]


def unit_length(topic: str, quaternions: FloatArray) -> list[str]:
    """Sentence on quaternions ``(n, 4)`` that are not of unit length; empty if all are."""
    off = np.abs(np.linalg.norm(quaternions, axis=1) - 1.0) > _UNIT_TOLERANCE
    return [f"{topic}: {count(off)} have a quaternion that is not of unit length."] if off.any() else []


class RawChecks:
    """Checks of a topic of images: empty images and changing sizes; also keeps sizes and frame."""

    def __init__(self) -> None:
        self._empty = 0
        self._count = 0
        self.frame_id = ""
        self.sizes: Counter[tuple[int, int]] = Counter()

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, RawEvent)
        self._count += 1
        self.frame_id = self.frame_id or event.frame_id
        self._empty += event.empty
        if event.size is not None:
            self.sizes[event.size] += 1

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        found = []
        if self._empty:
            found.append(f"{topic}: {self._empty} of {self._count} images are empty and will be skipped.")
        if len(self.sizes) > 1:
            sizes = ", ".join(f"{w}x{h}" for w, h in self.sizes)
            found.append(f"{topic}: the image size changes ({sizes}).")
        return found


class SightingsChecks:
    """Checks of a topic of sightings: gaps, ids that are seen rarely, and ranges outside the gate's bounds."""

    def __init__(self) -> None:
        self.ids: Counter[int] = Counter()
        self.frame_id = ""
        self.in_pixels = False
        self._filled = array("b")  # whether each message holds a sighting
        self._ranges = Table(1)

    def add(self, event: Event) -> None:
        """Add one event."""
        assert isinstance(event, SightingsEvent)
        self._filled.append(bool(event.sightings))
        self.frame_id = self.frame_id or event.frame_id
        self.in_pixels = event.in_pixels
        self.ids.update(s.landmark_id for s in event.sightings)
        for sighting in event.sightings:
            if (distance := sighting.distance()) is not None:
                self._ranges.add(distance)

    def findings(self, topic: str, seconds: FloatArray, config: Config) -> list[str]:
        """Faults that were found, one sentence each."""
        found = []
        if not self.ids:
            return [f"{topic}: none of its {len(self._filled)} messages holds a sighting."]
        seen = seconds[np.array(self._filled, dtype=bool)]
        gaps = np.diff(seen, prepend=0.0, append=seconds[-1])
        if (blackouts := gaps > config.estimator.dead_reckoning_after_s).any():
            at = int(np.argmax(gaps))
            found.append(
                f"{topic}: no sighting for more than {config.estimator.dead_reckoning_after_s:g} s "
                f"{times(int(blackouts.sum()))}, the longest {gaps[at]:.1f} s from "
                f"{seen[at - 1] if at else 0.0:.1f} s on."
            )
        rare = [str(i) for i, n in sorted(self.ids.items()) if n < config.landmarks.min_sightings]
        if rare:
            found.append(f"{topic}: seen fewer than {config.landmarks.min_sightings} times: id {', '.join(rare)}.")
        ranges = self._ranges.array()
        bad = ~((ranges > config.gate.min_range) & (ranges <= config.gate.max_range))
        if bad.any():
            found.append(
                f"{topic}: {count(bad)} sightings are not between {config.gate.min_range:g} and "
                f"{config.gate.max_range:g} m off and will be rejected."
            )
        return found
