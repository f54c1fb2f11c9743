"""Sightings that were all dropped for their stamps: the run is then dead reckoning, whatever else looks well."""

from __future__ import annotations

from collections.abc import Mapping

from fgloc.config import Role

_CLOCK_REASONS = ("late", "future", "stray", "stamp_zero", "duplicate", "duplicate_stamp")


def unused_sightings(rejections: Mapping[str, int], roles: Mapping[Role, str], used: int) -> tuple[str, ...]:
    """A sentence if no sighting reached the estimator and stamps are the main reason.

    Args:
        rejections: of the run, by "sensor.reason".
        roles: topics in use.
        used: sightings that the estimator was given, whatever it made of them.
    """
    role: Role = "image" if "image" in roles else "sightings"
    if used or role not in roles:
        return ()
    dropped = {k: n for k, n in rejections.items() if k.split(".")[0] in ("sightings", "image") and n}
    by_clock = {k: n for k, n in dropped.items() if k.split(".", 1)[1] in _CLOCK_REASONS}
    if 2 * sum(by_clock.values()) <= sum(dropped.values()):
        return ()
    reasons = ", ".join(f"{name} {n}" for name, n in sorted(by_clock.items(), key=lambda item: -item[1]))
    return (
        f"None of the sightings on {roles[role]} was used, for their stamps do not fit the clock of the other topics "
        f"({reasons}): the run is dead reckoning. `fgloc info` compares the clocks; recording.received_stamps: "
        f"[{role}] takes the receive times instead.",
    )
