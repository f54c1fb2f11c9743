"""Live runs of the synthetic worlds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from types import SimpleNamespace

import numpy as np
import typer
from robot_world import CAMERA, World, config, position_error

from fgloc.cli.live import _exit_if_wrong
from fgloc.live import Live
from fgloc.live.engine import LiveStatus
from fgloc.types import Estimate, Event

ROLES = ("odometry", "command", "sightings")
PATIENCE_S = 60.0  # of a test; far more than is ever needed


def live_in(world: World, settings=None, **options) -> Live:
    """A live run that waits for all that the world tells."""
    camera = CAMERA if world.sees_corners else None
    return Live(settings or config(), world.map, **({"camera": camera, "roles": ROLES} | options))


def feed(live: Live, events: Iterable[Event]) -> list[Estimate]:
    """Push all events; the estimates that they led to."""
    made: list[Estimate] = []
    live.subscribe(made.append)
    for event in events:
        live.push(event)
    assert live.wait(PATIENCE_S)
    return made


def exit_code(status: LiveStatus) -> int:
    """Exit code of `fgloc live` for a run that ends with this status."""
    try:
        _exit_if_wrong(SimpleNamespace(live=SimpleNamespace(status=lambda: status)))
    except typer.Exit as ended:
        return ended.exit_code
    return 0


def errors(world: World, estimates: Iterable[Estimate]) -> np.ndarray:
    """Distances from the truth [m]."""
    return np.array([position_error(e, world.truth(e.stamp_ns)) for e in estimates])


def received(event: Event, later_s: float) -> Event:
    """The event, received later."""
    return dataclasses.replace(event, received_ns=event.received_ns + round(later_s * 1e9))


def in_order(events: Iterable[Event]) -> list[Event]:
    """Of receipt."""
    return sorted(events, key=lambda e: e.received_ns)
