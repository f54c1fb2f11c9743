"""All drives, by their ``kind``: a new one is a class in a file, and its name here."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from fgloc.drives.sides import Differential, SkidSteer
from fgloc.drives.sliding import Mecanum, Omni, Swerve
from fgloc.drives.steered import Ackermann, Tricycle

AnyDrive = Annotated[
    Differential | SkidSteer | Ackermann | Tricycle | Mecanum | Omni | Swerve, Field(discriminator="kind")
]
