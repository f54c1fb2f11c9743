"""Sensors by entry point: UWB, GNSS and reflectors of fgloc, and those that packages declare in ``fgloc.sensors``.

What such a class has to offer is in `fgloc.sensors.base`; `fgloc.sensors.registry` looks them up by role and event.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from fgloc.errors import ConfigError

GROUP = "fgloc.sensors"
BUILT_IN = (
    EntryPoint("uwb", "fgloc.sensors.uwb:Uwb", GROUP),
    EntryPoint("gnss", "fgloc.sensors.gnss:Gnss", GROUP),
    EntryPoint("reflectors", "fgloc.sensors.reflectors:Reflectors", GROUP),
)
"""Sensors of fgloc itself that are found in the same way as those of other packages."""
_NEEDED = ("name", "Config", "streams", "failures", "build", "measure")
_NEEDED_BY_OPTIONAL = ("needs", "purpose")


@cache
def outside_sensors() -> tuple[type[Any], ...]:
    """All sensor classes that are found by entry point, by name: those of fgloc itself first.

    Raises:
        ConfigError: one cannot be imported or is no sensor, or two have one name or role.
    """
    found: dict[str, type[Any]] = {}
    roles: dict[str, str] = {}
    for point in (*BUILT_IN, *sorted(entry_points(group=GROUP), key=lambda p: (p.name, p.value))):
        package = point.dist.name if point.dist is not None else "an installed package"
        where = f"sensor '{point.name}' of {package} ({point.value})"
        try:
            sensor = point.load()
        except Exception as error:  # whatever another package's import raises
            raise ConfigError(
                f"{where} cannot be imported ({type(error).__name__}: {error}); repair or uninstall {package}"
            ) from error
        needed = (*_NEEDED, *(_NEEDED_BY_OPTIONAL if getattr(sensor, "optional", False) else ()))
        missing = [name for name in needed if not hasattr(sensor, name)]
        if missing or sensor.name != point.name:
            wrong = f"lacks {', '.join(missing)}" if missing else f"has the name '{sensor.name}', expected that"
            raise ConfigError(f"{where} {wrong}; see docs/adding-a-sensor.md")
        if found.setdefault(sensor.name, sensor) is not sensor:
            raise ConfigError(f"{where}: another package has a sensor of this name; uninstall one of them")
        for stream in sensor.streams:
            if other := roles.get(stream.role):
                raise ConfigError(f"{where}: role '{stream.role}' is that of sensor '{other}' too; rename one of them")
            roles[stream.role] = sensor.name
    return tuple(found.values())
