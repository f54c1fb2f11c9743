"""A drive as equations of its wheels: from rates and steering angles to the body's twist, with derivatives.

Each wheel says something about the twist ξ = (vx, vy, ω) of the base, in m/s: how fast its contact point goes along the
way it rolls (``a · ξ = r q``) and, where it cannot slide sideways, that it does not (``a · ξ = 0``). A drive is these
rows ``A ξ = b``, with their derivatives by its geometry. Where there are more rows than unknowns the twist is that of
least squares, and what is left over tells of wheels that contradict each other.

Source: Campion, Bastin, D'Andréa-Novel, "Structural properties and classification of kinematic and dynamic models of
wheeled mobile robots", 1996.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from fgloc.files.settings import Section

FloatArray = NDArray[np.float64]
Metres = Annotated[float, Field(ge=1e-6, le=100.0)]
Place = Annotated[float, Field(ge=-100.0, le=100.0)]
LENGTH_SIGMA = 0.01  # share by which a radius or a length that was measured by hand may be off
ZERO_SIGMA = 0.02  # rad: of a steering that was set straight by eye
_LEAST_SINGULAR = 1e-3  # of A, whose rows have about length one: below it the wheels leave a motion open


@dataclass(slots=True, eq=False)
class Equations:
    """Rows ``A ξ = b`` of a drive at one time, and their derivatives by its parameters.

    Attributes:
        A: ``(n, 3)``.
        b: ``(n,)`` m/s.
        A_by: derivatives ``(n, 3)`` by name of the parameter; one that is left out is zero.
        b_by: derivatives ``(n,)``, likewise.
    """

    A: FloatArray
    b: FloatArray
    A_by: dict[str, FloatArray] = field(default_factory=dict)
    b_by: dict[str, FloatArray] = field(default_factory=dict)

    def solve(self, names: Sequence[str] = ()) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Twist ``(3,)``, its derivatives ``(3, p)`` by the named parameters, and what is left of the rows ``(n,)``.

        Source: Golub and Pereyra 1973, "The differentiation of pseudo-inverses", equation 4.12:
        ``d(A⁺b) = A⁺ (b_by - A_by ξ) + (AᵀA)⁻¹ dAᵀ (b - A ξ)``.
        """
        inverse = np.linalg.inv(self.A.T @ self.A)
        twist = inverse @ (self.A.T @ self.b)
        left = self.b - self.A @ twist
        by = np.zeros((3, len(names)))
        for k, name in enumerate(names):
            change = np.zeros(3)
            if name in self.b_by:
                change += self.A.T @ self.b_by[name]
            if name in self.A_by:
                change += self.A_by[name].T @ left - self.A.T @ (self.A_by[name] @ twist)
            by[:, k] = inverse @ change
        return twist, by, left


class Drive(Section):
    """Base of the drives. One is a section of settings, the names of its joints, its rows and their derivatives."""

    slides: ClassVar[bool] = False  # whether it can go sideways
    unequal: ClassVar[bool] = True  # whether unequal wheels turn it on the straight: `wheels.yaw_per_m`

    kind: str
    radius: Metres = Field(description="of the driven wheels, over the gear ratio of ticks_per_turn")
    ticks_per_turn: float | None = Field(
        None, ge=1e-3, le=1e9, description="encoder ticks a turn of the driven joints; None: rad"
    )
    rolls_over: float | None = Field(None, ge=1e-3, le=1e15, description="where their positions roll over; None: never")
    reversed: tuple[str, ...] = Field((), description="joints of wheels that count backwards")
    sigmas: dict[str, Annotated[float, Field(ge=0, le=100)]] = Field(
        {}, description="by parameter, in its unit; 0: exact; else as in docs/drives.md"
    )

    # --- what each drive says of itself ---

    @property
    @abstractmethod
    def driven(self) -> tuple[str, ...]:
        """Joints whose travel is measured."""

    @property
    def steered(self) -> tuple[str, ...]:
        """Joints whose angle steers."""
        return ()

    @abstractmethod
    def usual_sigmas(self) -> dict[str, float]:
        """Prior sigma of each parameter that may be estimated, in its unit; 0: it is taken as exact."""

    @abstractmethod
    def equations(self, rates: FloatArray, angles: FloatArray) -> Equations:
        """Rows of the wheels.

        Args:
            rates: ``(n,)`` of the driven joints [rad/s].
            angles: ``(m,)`` of the steered ones [rad], as they report them.
        """

    def steering(self, reported: float) -> float:
        """Angle [rad] that a steered joint reports; of a drive without steering as given."""
        return reported

    def commanded(self, speed: float, angle: float) -> tuple[float, float, float] | None:
        """Twist [m/s, m/s, rad/s] at a speed [m/s] and steering angle [rad]; None: it has no such angle."""
        return None

    # --- what follows from it ---

    @property
    def states(self) -> dict[str, float]:
        """Prior sigmas of the parameters that are estimated, by name and in their unit."""
        sigmas = {**self.usual_sigmas(), **self.sigmas}
        return {name: sigma for name, sigma in sigmas.items() if sigma > 0.0}

    def value(self, name: str) -> float:
        """Value of a parameter: a key, or ``key_i`` of a list."""
        key, index = self._entry(name)
        return float(getattr(self, key) if index is None else getattr(self, key)[index])

    def with_values(self, values: Mapping[str, float], sigmas: Mapping[str, float] | None = None) -> Self:
        """Copy with other values of some parameters and, if given, other sigmas."""
        content: dict[str, Any] = self.model_dump(exclude_unset=True)
        for name, value in values.items():
            key, index = self._entry(name)
            if index is None:
                content[key] = value
            else:
                content[key] = [value if i == index else v for i, v in enumerate(getattr(self, key))]
        if sigmas is not None:
            content["sigmas"] = {**self.sigmas, **sigmas}
        return type(self).model_validate({"kind": self.kind, **content})

    def _entry(self, name: str) -> tuple[str, int | None]:
        if name in type(self).model_fields:
            return name, None
        key, _, index = name.rpartition("_")
        return key, int(index)

    def moves(self, rates: Sequence[float], angles: Sequence[float]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Twist ``(3,)`` of the base, derivatives ``(3, p)`` by the `states`, and what is left of the rows ``(n,)``."""
        if self.reversed:
            rates = [-rate if name in self.reversed else rate for name, rate in zip(self.driven, rates, strict=True)]
        made = self.equations(np.asarray(rates, dtype=float), np.asarray(angles, dtype=float))
        return made.solve(tuple(self.states))

    @model_validator(mode="after")
    def _possible(self) -> Self:
        names = (*self.driven, *self.steered)
        if len(set(names)) < len(names):
            raise ValueError(f"a joint is named twice: {', '.join(names)}; each wheel and each steering has its own")
        known = self.usual_sigmas()
        if unknown := [name for name in self.sigmas if name not in known]:
            raise ValueError(f"sigmas: a {self.kind} has no {unknown[0]}; it has {', '.join(known)}")
        if unknown := [name for name in self.reversed if name not in self.driven]:
            raise ValueError(f"reversed: no wheel is called {unknown[0]}; there are {', '.join(self.driven)}")
        A = self.equations(np.ones(len(self.driven)), np.zeros(len(self.steered))).A
        if len(A) < 3 or np.linalg.svd(A, compute_uv=False)[-1] < _LEAST_SINGULAR:
            raise ValueError(f"wheels placed like this do not determine how a {self.kind} moves: see docs/drives.md")
        return self


class Steered(Drive):
    """Base of the drives with steering, whose encoder may count ticks."""

    steering_ticks: float | None = Field(None, ge=2, le=1e9, description="ticks a turn of the steering; None: rad")
    steering_ratio: float = Field(1.0, ge=-1e3, le=1e3, description="angle of the wheel over the reported one")

    def steering(self, reported: float) -> float:
        """Angle [rad] of a steered joint, from ticks where it reports them."""
        if self.steering_ticks is None:
            return reported
        return math.remainder(reported, self.steering_ticks) / self.steering_ticks * math.tau


def as_many_as_wheels(content: object, key: str) -> object:
    """The section as it is.

    Raises:
        ValueError: this list of it is not as long as that of the wheels.
    """
    if isinstance(content, dict):
        a, b = content.get("wheels"), content.get(key)
        if isinstance(a, list | tuple) and isinstance(b, list | tuple) and len(a) != len(b):
            raise ValueError(f"wheels has {len(a)} entries and {key} {len(b)}; expected one of each for each wheel")
    return content
