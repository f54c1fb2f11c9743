"""Findings: what is wrong with a recording, its set-up or a run, in one list that every output shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Severity(IntEnum):
    """Effect of a finding on the result; a higher value is graver."""

    NOTE = 0  # the user should know
    WARNING = 1  # something is off, and the run copes with it
    ERROR = 2  # the poses are not to be trusted as the set-up is; exit code 3


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong, or worth knowing, with its evidence and its remedy.

    Attributes:
        code: stable name, ``subject.kind``: "sightings.axes", "imu.axes", "truth.frame".
        text: one sentence with the evidence and the remedy.
        severity: effect on the result.
        lines: settings that undo it, ``section.key`` of robot.yaml to the value as YAML.
        value: figure that was found (a lag [s], a scale, an angle [rad]); None: there is none.
        sigma: standard deviation of `value`; None: not known.
    """

    code: str
    text: str
    severity: Severity = Severity.NOTE
    lines: Mapping[str, str] = field(default_factory=dict)
    value: float | None = None
    sigma: float | None = None


def note(code: str, texts: Iterable[str], severity: Severity = Severity.NOTE) -> list[Finding]:
    """Findings without settings, one for each sentence."""
    return [Finding(code, text, severity) for text in texts]


def ordered(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings by severity, the gravest first; else in the given order.

    Repetitions are dropped: of equal sentences, and of two findings that set the same key the later one loses that line
    (and is dropped if it is no graver than a note and has no other line).
    """
    kept: list[Finding] = []
    texts: set[str] = set()
    keys: set[str] = set()
    for finding in sorted(findings, key=lambda f: -f.severity):
        if finding.text in texts:
            continue
        if finding.lines and finding.severity < Severity.ERROR and keys >= finding.lines.keys():
            continue
        texts.add(finding.text)
        keys |= finding.lines.keys()
        kept.append(finding)
    return tuple(kept)
