"""What a replay found besides poses, and the sentences that say so."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from fgloc.assembly import Assembly
from fgloc.config import Role
from fgloc.diagnosis.mistakes import Mistakes, unused_sightings
from fgloc.recording.reader import Recording
from fgloc.replay.replay import Replay
from fgloc.sensors import registry
from fgloc.types import Finding, Severity, note

_GRAVE = re.compile(r"another (frame|clock)|is damaged|cannot be decoded|perhaps degrees")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the replay found besides poses: read while the recording is open.

    Attributes:
        roles: topics by role.
        rejections: everything rejected anywhere, by reason.
        findings: what is wrong with the set-up, what does not fit together, and what the user should know.
    """

    roles: Mapping[Role, str]
    rejections: Counter[str]
    findings: tuple[Finding, ...]

    @classmethod
    def of(cls, recording: Recording, parts: Assembly, replay: Replay, wrong: Mistakes) -> Outcome:
        """Collect it from the parts of a run."""
        hints = _hints(recording, parts, replay)
        rejections = replay.rejections()
        rejections.update({f"undecodable.{k}": v for k, v in recording.undecodable.items()})
        seen = sum(decision.landmark_id >= 0 for decision in replay.decisions)
        unused = unused_sightings(rejections, recording.roles, seen)
        known = {finding.code for finding in wrong.findings}
        # All but images was compared before the run
        seen_in_images = parts.diagnosis.findings() if wrong.checked and parts.camera is not None else ()
        findings = [
            *wrong.findings,
            *note("floor.uneven", map(sentence, parts.diagnosis.mistakes), Severity.ERROR),
            *note("sightings.unused", map(sentence, unused), Severity.ERROR),
            *note("motion.model", map(sentence, parts.localizer.motion.mistakes), Severity.ERROR),
            *note("setup.unseen", map(sentence, hints), Severity.WARNING),
            *(f for f in seen_in_images if f.code not in known),
            *_graded("recording", recording.notes),
            *_graded("clock", replay.clocks.notes),
            *_graded("run", parts.sentences),
        ]
        return cls(recording.roles, rejections, tuple(findings))

    def failed(self, why: str) -> str:
        """Message of a run that failed: what is wrong with the set-up, why it failed, what may be the cause."""
        mistakes = [f.text for f in self.findings if f.severity is Severity.ERROR]
        hints = [f.text for f in self.findings if f.severity is Severity.WARNING]
        return " ".join([*mistakes, sentence(why) if mistakes else why, *hints])


def _hints(recording: Recording, parts: Assembly, replay: Replay) -> list[str]:
    """Why nothing was received, or no marker was found."""
    hints = [*replay.activity.missing()]
    if parts.detector is not None and not any(parts.localizer.counts[kind] for kind in registry.detected_kinds()):
        hints = [*parts.detector.hints(recording)[0], *hints]
    return hints


def _graded(code: str, texts: Iterable[str]) -> Iterator[Finding]:
    """Findings of a part of the run: warnings where data are damaged or in another frame, clock or unit."""
    for text in texts:
        yield Finding(code, sentence(text), Severity.WARNING if _GRAVE.search(text) else Severity.NOTE)


def sentence(note: str) -> str:
    """With a capital, unless it begins with a name (of a topic, a file), and with a full stop."""
    first = note.split(maxsplit=1)[0]
    return (note[0].upper() + note[1:] if first.isalpha() else note) + ("" if note.endswith((".", "?", "!")) else ".")


def never_found(replay: Replay, rejections: Counter[str]) -> str:
    """Message of a run without any pose: what was received and what was rejected."""
    received = ", ".join(f"{topic} {span.count}" for topic, span in replay.spans().items()) or "nothing"
    why = ", ".join(f"{reason} {n}" for reason, n in rejections.most_common(6)) or "nothing"
    return (
        f"the first pose was never found in {len(replay.step_ms)} steps. Received: {received}. Rejected: {why}. "
        "Check the map's ids and sizes, or give estimator.initial_pose."
    )
