"""State of the comparison of a recording's signals: what they are, and what was found so far."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fgloc.config import Config, Role, WheelsConfig, one_line, setting, with_value
from fgloc.diagnosis.landmark_fits import Noise
from fgloc.diagnosis.pairs import Figure, RateFit, fit_rate
from fgloc.diagnosis.signals import Path, Signals, turn_by
from fgloc.drives.steered import Ackermann, Tricycle
from fgloc.sensors.wheels.events import JointsEvent
from fgloc.sensors.wheels.sensor import right_sides
from fgloc.types import Finding, FloatArray, LandmarkMap, Severity

WHEELS: dict[str, Role] = {"ticks": "joints", "odometry": "odometry"}  # role by source of the motion
_UNITS = {0.3048: "feet", 0.0254: "inches", 0.01: "centimetres", 0.001: "millimetres", 1 / 3.6: "km/h"}
_UNIT = 0.04  # logarithm by which a scale may miss a unit's
_WHEEL_UNITS = {math.pi / 180.0: "degrees", math.tau: "revolutions"}
_RATE_UNITS = _WHEEL_UNITS | {math.tau / 60.0: "revolutions per minute"}  # no angle is in the last
_BEYOND = 0.005  # share of rates beyond a bound, which is of another unit then
GEAR = 0.25  # logarithm from which way and turn that are off alike are no radii that were measured badly
_WHEEL_UNIT = 0.2  # logarithm by which wheels may be off besides: radii and a track that nobody has measured


def unit_of(scale: float, within: float = _UNIT, speeds: bool = True) -> tuple[float, str] | None:
    """Factor and name of the unit that a scale (true over reported) is near; None: no usual one.

    Args:
        scale: of lengths, or of what is measured in them.
        within: logarithm by which it may miss the unit's.
        speeds: whether it may be a unit of speed.
    """
    known = {factor: name for factor, name in _UNITS.items() if speeds or "/" not in name}
    units = known | {1.0 / factor: f"metres for {name}" for factor, name in known.items()}
    return _nearest(units, abs(scale), within)


def _nearest(units: Mapping[float, str], scale: float, within: float) -> tuple[float, str] | None:
    factor = min(units, key=lambda unit: abs(math.log(scale / unit)))
    return (factor, units[factor]) if abs(math.log(scale / factor)) < within else None


@dataclass
class Conventions:
    """Findings on the conventions of a recording, the configuration with their lines set, and the evidence.

    Attributes:
        config: as configured, then with the lines of the findings.
        signals: of the recording; what passed while a person had the robot in hand is removed once that is found.
        T_base_sensor: ``(4, 4)`` place of the sensor that reports ranges or marker poses; None: the base.
        imu_up: ``(3,)`` the base's z axis in the IMU's frame, as configured; None: z.
        landmark_map: None: nothing is compared with a map.
        findings: with the lines that undo them.
        noise: of the sensor of landmarks, where its axes are right; no finding, but a better start than the defaults.
        opposite: whether wheels and gyro turn in opposite directions, and gravity does not tell which is wrong.
        commanded: whether commands stand in for wheels.
        wheels: with which the wheels' path was read; what is found since then is not in it.
        turns: fits of turns about axes of the IMU that were made so far, with what they were made of.
    """

    config: Config
    signals: Signals
    T_base_sensor: FloatArray | None = None
    imu_up: FloatArray | None = None
    landmark_map: LandmarkMap | None = None
    findings: list[Finding] = field(default_factory=list)
    noise: Noise | None = None
    opposite: bool = False
    commanded: bool = False
    wheels: WheelsConfig = field(default_factory=WheelsConfig)
    turns: list[tuple[Path, Signals, FloatArray, RateFit | None]] = field(default_factory=list)

    def turn_about(self, path: Path, axis: FloatArray) -> RateFit | None:
        """Fit of the IMU's turn about an axis ``(3,)`` of its own against a path's turn, made once."""
        for of_path, signals, about, fit in self.turns:
            if of_path is path and signals is self.signals and np.array_equal(about, axis):
                return fit
        rates = self.signals.rates()
        fit = None if rates is None else fit_rate(path, rates[0], turn_by(rates[0], rates[1] @ axis))
        self.turns.append((path, self.signals, axis, fit))
        return fit

    @property
    def up(self) -> FloatArray:
        """Unit vector ``(3,)`` of the base's z axis in the IMU's frame, as configured."""
        axis = np.array([0.0, 0.0, 1.0]) if self.imu_up is None else np.asarray(self.imu_up, dtype=float)
        return np.asarray(axis / max(float(np.linalg.norm(axis)), 1e-12))

    @property
    def places(self) -> dict[int, FloatArray]:
        """Places ``(2,)`` of the map's landmarks [m], by id; empty: there is no map."""
        known = {} if self.landmark_map is None else self.landmark_map.landmarks
        return {i: landmark.position[:2] for i, landmark in known.items()}

    @property
    def codes(self) -> set[str]:
        """Codes of the findings so far."""
        return {finding.code for finding in self.findings}

    def earlier(self, role: str, late_s: float) -> dict[str, Any]:
        """Line that makes the stamps of a role earlier by so much, and leaves those of the others as they are set."""
        given = {str(r): offset for r, offset in self.config.recording.stamp_offset_s.items()}
        return {"recording.stamp_offset_s": given | {role: round(given.get(role, 0.0) - late_s, 3)}}

    def right_sides(self, kind: str = "exchanged") -> dict[str, Any]:
        """Lines that undo a mistake of `WRONG_SIDES`; empty: joints have no names, or no radii."""
        return {f"wheels.{key}": value for key, value in right_sides(kind, self.config.wheels).items()}

    @property
    def steered(self) -> Ackermann | Tricycle | None:
        """The drive, if it has a steered axle."""
        drive = self.config.wheels.drive
        return drive if isinstance(drive, Ackermann | Tricycle) else None

    @property
    def wheel_units(self) -> Mapping[float, str]:
        """Units [rad] and their names that the joints may be in: of angles where they have any, else of rates."""
        joints = (event for event in self.signals.motion if isinstance(event, JointsEvent))
        return _WHEEL_UNITS if any(np.isfinite(event.position).any() for event in joints) else _RATE_UNITS

    def in_wheel_unit(self, path: Path, scale: float, within: float = _WHEEL_UNIT) -> tuple[float, str] | None:
        """Factor and name of the unit that wheels are in which were taken to be in radians; None: no usual one.

        Args:
            path: motion of the wheels; None is returned unless it is that of joints in radians.
            scale: of the true way or turn over the wheels', which such a unit changes alike.
            within: logarithm by which it may miss the unit's.
        """
        if path.source != "ticks" or not self.config.wheels.in_radians or scale <= 0.0:
            return None
        return _nearest(self.wheel_units, scale, within)

    def wheels_off_by(self, path: Path, scale: float) -> tuple[float, str, str] | None:
        """Factor, code and clause of what scales way and turn of the wheels alike; None: nothing does by so much.

        Args:
            path: motion of the wheels; None is returned where it is none of theirs.
            scale: of the true turn over the wheels'; their way has to be looked at.
        """
        if (unit := self.in_wheel_unit(path, scale)) is not None:
            return unit[0], "wheels.unit", f"their angles or rates are in {unit[1]}"
        if path.source not in WHEELS or not abs(math.log(max(scale, 1e-9))) > GEAR:
            return None
        gear = f"they are measured before a gear of {1.0 / scale:.4g} : 1, or " if scale < 1.0 else ""
        wrong = "radii" if path.source == "ticks" and self.config.wheels.in_radians else "radii or counts of a turn"
        return scale, "wheels.gear", f"{gear}their {wrong} are wrong"

    def wheel_lines(self, factor: float) -> dict[str, Any]:
        """Lines by which the wheels move and turn the robot so many times as much."""
        wheels, bound = self.config.wheels, self.config.gate.max_wheel_rate
        rates = [
            float(np.abs(e.velocity).max())
            for e in self.signals.motion
            if isinstance(e, JointsEvent) and len(e.velocity)
        ]
        fast = rates and float(np.quantile(rates, 1.0 - _BEYOND)) > bound  # by a bound in radians they would be refused
        lines = {"gate.max_wheel_rate": float(f"{bound / factor:.4g}")} if fast else {}
        by_radii = wheels.drive is None and wheels.left_radius and wheels.right_radius
        keys = ("left_radius", "right_radius") if by_radii else ("scale_v", "scale_omega")
        return lines | {f"wheels.{key}": float(f"{getattr(wheels, key) * factor:.6g}") for key in keys}

    def read_again(self, path: Path) -> Path:
        """Motion by the wheels with what was found of them; the path given where there is none."""
        return self.signals.path(self.config) or path

    def path_with(self, lines: Mapping[str, Any]) -> Path | None:
        """Motion by wheels with other settings; None: no wheels are like this."""
        config = self.config
        try:
            for key, value in lines.items():
                config = with_value(config, key, value)
        except ValueError:
            return None
        return self.signals.path(config)

    def trial(self) -> Conventions:
        """A comparison of the same signals whose findings do not count yet."""
        return replace(self, findings=[])

    def add(
        self,
        code: str,
        text: str,
        lines: Mapping[str, Any] | None = None,
        figure: Figure | None = None,
        severity: Severity = Severity.ERROR,
    ) -> None:
        """Note a finding, and set its lines; a key that an earlier one has set is the newer one's, built on it."""
        lines = lines or {}
        shown = {setting(key): one_line(value) for key, value in lines.items()}
        value, sigma = (None, None) if figure is None else (figure.value, figure.sigma)
        for k, earlier in enumerate(self.findings):
            if earlier.lines.keys() & shown.keys():
                left = {key: line for key, line in earlier.lines.items() if key not in shown}
                fact = earlier.text.removesuffix(_remedy(earlier.lines))
                self.findings[k] = replace(earlier, text=fact + _remedy(left), lines=left)
        self.findings.append(Finding(code, text + _remedy(shown), severity, shown, value, sigma))
        for key, given in lines.items():
            with suppress(ValueError):  # beyond what a setting may be: it is said, and left as it is
                self.config = with_value(self.config, key, given)


def _remedy(lines: Mapping[str, str]) -> str:
    return f"{': ' if lines else ''}{'; '.join(f'set {key}: {line}' for key, line in lines.items())}."
