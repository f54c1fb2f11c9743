"""One run: a recording goes in, a RunResult comes out. Batch replays the events and then smooths; online does not."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack, get_args

import numpy as np

from fgloc.assembly import Assembly, assemble
from fgloc.calibration.installation import contradiction_findings, contradictions, found_values, installation_found
from fgloc.config import Config, Role, base_role, base_roles
from fgloc.diagnosis.mistakes import Mistakes, find_mistakes, unused_sightings
from fgloc.errors import ConfigError, EstimatorError
from fgloc.evaluation.report import write_results
from fgloc.graph.contradictions import Contradiction
from fgloc.instrumentation import one_blas_thread, working
from fgloc.recording.info import unheard, unread_map, unused_positions
from fgloc.recording.reader import Recording, open_recording
from fgloc.replay import Progress, Replay, RunMode, RunOptions, SmoothedRun, smooth_run
from fgloc.results import RunData
from fgloc.sensors import registry
from fgloc.types import (
    Estimate,
    Finding,
    FloatArray,
    Grave,
    Ground,
    LostData,
    Protection,
    Severity,
    Trajectory,
    note,
    ordered,
)

# --- Results besides poses, and their sentences -------------------------------------------------


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of the replay besides poses, collected while the recording is open.

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
        """Collect the outcome from the parts of a run."""
        rejections = replay.rejections()
        rejections.update({f"undecodable.{k}": v for k, v in recording.undecodable.items()})
        seen = sum(decision.landmark_id >= 0 for decision in replay.decisions)
        hints = _hints(recording, parts, replay, seen)
        unused = unused_sightings(rejections, recording.roles, seen)
        known, said = ({getattr(finding, what) for finding in wrong.findings} for what in ("code", "text"))
        unread = (
            unread_map(recording, parts.config) if parts.landmark_map is not None and not recording.problems else None
        )
        # All but images was compared before the run
        seen_in_images = parts.diagnosis.findings() if wrong.checked and parts.cameras else ()
        findings = [
            *note(
                "map.unused", () if unread is None or parts.config.estimator.initial_pose else (unread,), Severity.ERROR
            ),
            *wrong.findings,
            *note("positions.unused", unused_positions(recording, parts.config), Severity.WARNING),
            *note("sensor.unheard", unheard(recording, parts.config), Severity.WARNING),
            *note("floor.uneven", map(sentence, parts.diagnosis.mistakes), Severity.ERROR),
            *note("sightings.unused", map(sentence, unused), Severity.ERROR),
            *note("motion.model", map(sentence, parts.localizer.motion.mistakes), Severity.ERROR),
            *note("setup.unseen", (h for h in map(sentence, hints) if h not in said), Severity.WARNING),
            *(f for f in seen_in_images if f.code not in known),
            *_graded("recording", (*recording.notes, *recording.unreadable)),
            *note("clock", map(sentence, replay.clocks.notes)),
            *_graded("run", parts.sentences),
        ]
        return cls(recording.roles, rejections, tuple(findings))

    def failed(self, why: str) -> str:
        """Message of a run that failed: what is wrong with the set-up, why it failed, what may be the cause."""
        mistakes = [f.text for f in self.findings if f.severity is Severity.ERROR]
        hints = [f.text for f in self.findings if f.severity is Severity.WARNING]
        return " ".join([*mistakes, sentence(why) if mistakes else why, *hints])


def _hints(recording: Recording, parts: Assembly, replay: Replay, seen: int) -> list[str]:
    """Reasons why nothing was received, or no marker was found; ``seen``: sightings that the estimator was given."""
    hints = [*replay.activity.missing()]
    if parts.detector is not None and not any(
        base_role(kind) in registry.detected_kinds() for kind, n in parts.localizer.counts.items() if n
    ):
        found = parts.detector.hints(recording)[0]
        hints = [*(hint for hint in found if not (seen and hint == parts.detector.unseen)), *hints]
    return hints


def _graded(code: str, texts: Iterable[str]) -> Iterator[Finding]:
    """Findings of a part of the run: warnings of what it calls grave."""
    for text in texts:
        if isinstance(text, LostData):
            yield Finding(f"{code}.lost", sentence(text), Severity.WARNING, value=text.share)
        else:
            yield Finding(code, sentence(text), Severity.WARNING if isinstance(text, Grave) else Severity.NOTE)


def sentence(note: str) -> str:
    """Note with a capital, unless it begins with a name (of a topic, a file), and with a full stop."""
    first = note.split(maxsplit=1)[0]
    return (note[0].upper() + note[1:] if first.isalpha() else note) + ("" if note.endswith((".", "?", "!")) else ".")


def never_found(replay: Replay, rejections: Counter[str]) -> str:
    """Message of a run without any pose: what was received and what was rejected."""
    received = ", ".join(f"{topic} {span.count}" for topic, span in replay.activity.spans(0).items()) or "nothing"
    why = ", ".join(f"{reason} {n}" for reason, n in rejections.most_common(6)) or "nothing"
    return (
        f"the first pose was never found in {len(replay.step_ms)} steps. Received: {received}. Rejected: {why}. "
        "Check the map's ids and sizes, or give estimator.initial_pose."
    )


# --- Runs -------------------------------------------------------------------------------------------------------------


class RunResult(RunData):
    """A whole run, ready to be evaluated and written."""

    __slots__ = ()

    def write(self, folder: Path) -> None:
        """Write all files of the run, as ``fgloc smooth`` and ``fgloc online`` do; see ``docs/formats.md``.

        Args:
            folder: made if missing; an error leaves what was there as it was.

        Raises:
            OutputError: the folder cannot be written.
            TrajectoryError: a pose is not finite.
            CovarianceError: a covariance is not positive definite.
        """
        write_results(self, self.config or Config(), folder, "fgloc.RunResult.write")


@one_blas_thread
def run(
    recording_path: Path,
    map_path: Path | None,
    config: Config,
    mode: RunMode,
    progress: Progress | None = None,
    **options: Unpack[RunOptions],
) -> RunResult:
    """Localise one recording.

    Args:
        recording_path: any bag that `open_recording` reads.
        map_path: marker map; None: landmarks are estimated too.
        config: all settings.
        mode: "batch" smooths after the replay; "online" keeps the filtered estimates.
        progress: called now and then.
        options: as `RunOptions` has them.

    Raises:
        FglocError: the input or the mode cannot be used, or no pose was ever found.
    """
    if mode not in get_args(RunMode):
        raise ConfigError(f"mode {mode!r}: expected one of {', '.join(get_args(RunMode))}")
    began = time.perf_counter()
    check = options.get("check", True) and options.get("events") is None and options.get("sightings") is None
    with working("checking"):
        wrong = find_mistakes(recording_path, map_path, config) if check else Mistakes((), config)
    config = wrong.config
    with open_recording(recording_path, config.recording) as recording:
        batch = mode == "batch"
        parts = assemble(recording, map_path, config, batch or map_path is None, wrong.landmark_map, not batch)
        replay = replayed(recording, parts, mode, progress, options)
        outcome = Outcome.of(recording, parts, replay, wrong)
    if not replay.estimates:
        raise EstimatorError(outcome.failed(never_found(replay, outcome.rejections)))
    smoothed = _smoothed(parts, outcome) if mode == "batch" else None
    all_estimates = replay.estimates if smoothed is None else smoothed.estimates
    estimates = last_pass(all_estimates)
    held = parts.localizer.tracking.initial_pose_conflict is not None
    sane = parts.sanity.judge(estimates, causal=mode == "online", held=held)
    estimator = parts.localizer.estimator
    installation = estimator.installation if smoothed is None else smoothed.parameters
    installed = estimator.installed if smoothed is None else smoothed.installation
    found = installation_found(parts, outcome.roles, installation, installed)
    contradiction = _contradiction(parts) if smoothed is None else smoothed.contradiction
    of_constants = contradiction_findings(found, contradiction, config) or contradictions(found, config)
    findings = [
        *outcome.findings,
        *note("batch", () if smoothed is None else smoothed.notes),
        *note("clock.back", _left_out(len(all_estimates) - len(estimates))),
        *of_constants,
        *sane.findings,
        *_meaningless(outcome.roles, parts, estimates),
        *_late(replay, estimates),
    ]
    estimates = sane.simpler or estimates
    return RunResult(
        trajectory=_trajectory(estimates),
        modes=tuple(e.mode for e in estimates),
        decisions=tuple(replay.decisions),
        counts=dict(parts.localizer.counts),
        rejections=dict(sorted(outcome.rejections.items())),
        findings=ordered(findings),
        step_ms=np.array(replay.step_ms),
        truth=replay.truth.trajectory(),
        landmarks=parts.landmark_map if smoothed is None else smoothed.landmarks,
        spans=replay.activity.spans(estimates[0].stamp_ns),
        source=recording_path,
        found=found,
        installation=found_values(installation, installed, parts.config, parts.cameras, parts.landmark_map),
        cost=None if smoothed is None else smoothed.cost,
        first_pose_s=replay.first_pose_s,
        config=config,
        protections=protections(estimates),
        odometry=sane.odometry,
        wall_s=time.perf_counter() - began,
    )


_MOTIONLESS = 0.8  # share of a run without any motion source from which on it is none


def _meaningless(roles: Collection[Role], parts: Assembly, estimates: Sequence[Estimate]) -> Iterator[Finding]:
    """Findings of a run whose figures mean nothing: of one pose, or of positions that nothing measures."""
    if len(estimates) < 2:
        yield Finding("run.short", "The recording gives a single pose: there is no trajectory.", Severity.ERROR)
    elif not parts.sensors and {"odometry", "joints", "command", "image", "sightings"}.isdisjoint(base_roles(roles)):
        yield Finding(
            "motion.unmeasured",
            "Nothing in the recording measures how far the robot goes (no odometry, joint states or commands, and no "
            "landmarks): its positions mean nothing, only its turn is measured. Record the robot's odometry too.",
            Severity.ERROR,
        )
    elif (
        not parts.sensors and parts.config.motion.model is None and {"image", "sightings"}.isdisjoint(base_roles(roles))
    ):
        whole_s = max((estimates[-1].stamp_ns - estimates[0].stamp_ns) * 1e-9, parts.wheels.unknown_s)
        if parts.wheels.unknown_s > _MOTIONLESS * whole_s:
            yield Finding(
                "motion.unmeasured",
                f"For {parts.wheels.unknown_s:.1f} of {whole_s:.1f} s no motion of the wheels is known, and nothing "
                "else measures how far the robot goes: its positions mean nothing. Look for why the messages were "
                "refused: another unit, a geometry that is not filled in, or stamps of another clock.",
                Severity.ERROR,
            )


_LATE_S, _LATE_SHARE = 10.0, 0.3


def _late(replay: Replay, estimates: Sequence[Estimate]) -> Iterator[Finding]:
    """Finding of a run whose place on the map became known late: poses before are missing, or were made afterwards."""
    at_s = replay.first_pose_s
    if at_s is None or replay.first_step_ns is None:
        return
    whole_s = (estimates[-1].stamp_ns - replay.first_step_ns) * 1e-9
    if at_s > max(_LATE_S, _LATE_SHARE * whole_s):
        yield Finding(
            "place.late",
            f"The robot's place was known only after {at_s:.0f} of {whole_s:.0f} s, although it was searched from the "
            "beginning: see which landmarks, ranges or positions there were until then, or give "
            "estimator.initial_pose.",
            Severity.WARNING,
            value=at_s,
        )


def _contradiction(parts: Assembly) -> Contradiction | None:
    """Contradiction by the constants that were held online; None if there are none."""
    estimator = parts.localizer.estimator
    return Contradiction(tuple(estimator.contradicted), estimator.asked()) if estimator.contradicted else None


def replayed(
    recording: Recording,
    parts: Assembly,
    mode: RunMode,
    progress: Progress | None,
    options: RunOptions,
) -> Replay:
    """Run all events through the localizer."""
    memory, file = None, options.get("detections")
    if parts.detector is not None:
        # What a file remembers must not depend on which images came before; without one they are followed, as live.
        detector = parts.detector.following() if file is None else parts.detector
        memory = parts.detector.remembering(detector, file, None, note=file is not None)
    replay = Replay(parts, recording, memory, progress, options, causal=mode == "online")
    replay.run(recording.events())
    if mode == "batch" or not replay.estimates:
        replay.make_up(parts.localizer.finish(replay.no_landmark_sensor))
    if memory is not None:
        memory.save()
    return replay


def _smoothed(parts: Assembly, outcome: Outcome) -> SmoothedRun:
    try:
        with working("smoothing"):
            return smooth_run(parts)
    except EstimatorError as error:
        raise EstimatorError(outcome.failed(sentence(str(error)))) from error


def _left_out(poses: int) -> Iterator[str]:
    if poses:
        yield f"The clock jumped back: {poses} poses whose times came again are left out."


def last_pass(estimates: list[Estimate]) -> list[Estimate]:
    """Estimates with increasing stamps: where the clock jumped back, the last pass over those times is kept."""
    kept: list[Estimate] = []
    for estimate in reversed(estimates):
        if not kept or estimate.stamp_ns < kept[-1].stamp_ns:
            kept.append(estimate)
    return kept[::-1]


def protections(estimates: Sequence[Estimate]) -> tuple[Protection, ...]:
    """Bound of each pose; of one that was made up for, nothing is promised."""
    if all(e.protection is None for e in estimates):
        return ()
    return tuple(e.protection or Protection(np.full(3, np.inf), math.inf, "no fix", alert=True) for e in estimates)


def _trajectory(estimates: list[Estimate]) -> Trajectory:
    return Trajectory(
        np.array([e.stamp_ns for e in estimates], dtype=np.int64),
        np.array([e.pose for e in estimates]),
        np.array([e.cov for e in estimates]),
        *_grounds([e.ground for e in estimates]),
    )


def _grounds(grounds: Sequence[Ground | None]) -> tuple[FloatArray | None, FloatArray | None]:
    """Height, roll and pitch with the covariances of the whole poses; None: the floor is flat.

    Of a pose before the first is confirmed they are not known: taken to be level, with the covariance of that.
    """
    if not any(grounds):
        return None, None
    first = next(g for g in grounds if g is not None)
    known = [first if g is None else g for g in grounds]
    return np.array([(g.z, g.roll, g.pitch) for g in known]), np.array([g.cov for g in known])
