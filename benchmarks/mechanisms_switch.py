"""Switches that turn mechanisms off for `benchmarks.mechanisms`, and counters of whether a mechanism acts at all.

A switch replaces one function or constant of fgloc by `unittest.mock.patch` for as long as a context holds; fgloc has
no settings for this. A probe wraps one function and counts the calls whose result differs from what the mechanism would
give if it were off. Where a probe counts nothing in a run, the run with the mechanism off is the same run.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from copy import copy
from dataclasses import dataclass
from functools import wraps
from pkgutil import resolve_name
from types import CodeType
from typing import Any
from unittest.mock import patch

Function = Callable[..., Any]
JOIN = "+"  # between the names of mechanisms that are switched off at once


@dataclass(frozen=True, slots=True)
class Returns:
    """Replaces a function by one that returns a copy of a value, which the caller may change."""

    value: Any

    def __call__(self, real: Any) -> Function:
        """The replacement."""
        return lambda *args, **kwargs: copy(self.value)


@dataclass(frozen=True, slots=True)
class Constant:
    """Replaces a module's constant."""

    value: Any

    def __call__(self, real: Any) -> Any:
        """The replacement."""
        return self.value


@dataclass(frozen=True, slots=True)
class Argument:
    """Replaces a function by one that returns one of its positional arguments."""

    index: int

    def __call__(self, real: Any) -> Function:
        """The replacement."""
        return lambda *args, **kwargs: args[self.index]


@dataclass(frozen=True, slots=True)
class Switch:
    """One replacement.

    Attributes:
        target: ``package.module:name`` or ``package.module:Class.name``.
        off: makes the replacement of what is there.
    """

    target: str
    off: Callable[[Any], Any]

    def place(self) -> tuple[Any, str]:
        """The object that holds what is replaced, and its name there.

        Raises:
            AttributeError: fgloc has no such name; where the mechanism was deleted, delete its row as well.
        """
        owner, _, name = self.target.rpartition("." if "." in self.target.partition(":")[2] else ":")
        holder = resolve_name(owner)
        if not hasattr(holder, name):
            raise AttributeError(f"{self.target} does not exist; is the mechanism gone? Then delete its row")
        return holder, name

    @contextmanager
    def replaced(self) -> Iterator[None]:
        """The replacement stands while this holds."""
        holder, name = self.place()
        with patch.object(holder, name, self.off(getattr(holder, name))):
            yield


def _nothing(*args: Any) -> None:
    return None


@dataclass(frozen=True, slots=True)
class Probe:
    """A function to be watched.

    Attributes:
        target: as that of a switch.
        acts: given the result, what `before` gave, and the positional arguments: whether the mechanism acted.
        before: given the positional arguments before the call.
    """

    target: str
    acts: Callable[..., Any]
    before: Callable[..., Any] = _nothing


@dataclass(frozen=True, slots=True)
class Mechanism:
    """Mechanism that adapts a weight, a covariance, an association or a state by evidence.

    Attributes:
        name: in the ids of rows.
        purpose: what it is for.
        modules: that hold it, below ``fgloc``.
        switches: all of them together take it away.
        probe: observes where it acts; None: it acts always, or no single function shows it.
        batch: whether the smoothed result can depend on it.
        case: a failure that it is for; it is run first.
    """

    name: str
    purpose: str
    modules: tuple[str, ...]
    switches: tuple[Switch, ...]
    probe: Probe | None = None
    batch: bool = False
    case: str = "none"

    @contextmanager
    def off(self) -> Iterator[None]:
        """Switch the mechanism off inside a ``with``."""
        with ExitStack() as stack:
            for switch in self.switches:
                stack.enter_context(switch.replaced())
            yield

    @property
    def signature(self) -> str:
        """Hash that changes with the switches."""
        return _digest(part for s in self.switches for part in (s.target, _fingerprint(s.off)))


def together(mechanisms: Sequence[Mechanism]) -> Mechanism:
    """Join mechanisms into one."""
    modules = tuple(dict.fromkeys(module for m in mechanisms for module in m.modules))
    switches = tuple(switch for m in mechanisms for switch in m.switches)
    return Mechanism(JOIN.join(m.name for m in mechanisms), "Several at once.", modules, switches, batch=True)


@contextmanager
def watched(mechanisms: Iterable[Mechanism]) -> Iterator[Counter[str]]:
    """Counts, by the name of the mechanism, how often each one with a probe acts while this holds."""
    counts: Counter[str] = Counter()
    with ExitStack() as stack:
        for mechanism in mechanisms:
            if mechanism.probe is not None:
                counting = Switch(mechanism.probe.target, _Counting(mechanism.name, mechanism.probe, counts))
                stack.enter_context(counting.replaced())
        yield counts


def probes_signature(mechanisms: Iterable[Mechanism]) -> str:
    """Hash that changes with the probes."""
    probed = [(m.name, m.probe) for m in mechanisms if m.probe is not None]
    return _digest(part for name, p in probed for part in (name, p.target, _fingerprint(p.acts)))


@dataclass(frozen=True, slots=True)
class _Counting:
    name: str
    probe: Probe
    counts: Counter[str]

    def __call__(self, real: Function) -> Function:
        @wraps(real)
        def counted(*args: Any, **kwargs: Any) -> Any:
            before = self.probe.before(*args)
            result = real(*args, **kwargs)
            self.counts[self.name] += bool(self.probe.acts(result, before, *args))
            return result

        return counted


def _digest(parts: Iterable[str]) -> str:
    made = hashlib.sha256()
    for part in parts:
        made.update(part.encode() + b"\0")
    return made.hexdigest()[:8]


def _fingerprint(function: Any) -> str:
    """Text that depends on the code of a function, but not on its line; of a value object its representation."""
    code = getattr(function, "__code__", None)
    return repr(function) if code is None else _of_code(code)


def _of_code(code: CodeType) -> str:
    constants = [_of_code(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {constants}"


# --- Probes -----------------------------------------------------------------------------------------------------------


def something(result: Any, *args: Any) -> bool:
    """Whether the result is not empty, zero or false, so that the mechanism acted."""
    return bool(result)


def not_none(result: Any, *args: Any) -> bool:
    """Whether there is a result, so that the mechanism acted."""
    return result is not None


def called(*args: Any) -> bool:
    """Whether the function was called, so that the mechanism acted: always."""
    return True
