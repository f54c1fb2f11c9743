"""Episodes of a run's judgements: adjacent rows of ``steps.csv`` with the same verdict are one judgement."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict

from fgloc.calibration.installation import contradicted
from fgloc.config import is_motion_source
from fgloc.results import RunData
from fgloc.sensors.measurements import sensor_name
from fgloc.stats import SURE_SIGMAS
from fgloc.types import MOUNTING_CHANGED, Decision, IntArray, Trajectory

# --- What a judgement cost or saved -----------------------------------------------------------------------------------


def plural(count: int, noun: str) -> str:
    """Number with its noun, in the plural unless it is 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _not_used(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    return f"{plural(sum(d.weight == 0.0 for d in rows), 'sighting')} not used"


def _left_out(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    shifts = [d.shift_m for d in rows if math.isfinite(d.shift_m)]
    told = f"; would have moved the pose by {sum(shifts):+.3f} m forward" if shifts else ""
    return f"left out{told}"


def _gone_to(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    far = max((d.shift_m for d in rows if math.isfinite(d.shift_m)), default=math.nan)
    before = _sigma_m(trajectory, rows[0].stamp_ns, before=True)
    after = _sigma_m(trajectory, rows[-1].stamp_ns, before=False)
    moved = f"pose moved by {far:.2f} m; " if math.isfinite(far) else ""
    return f"{moved}position σ {_metres(before)} before, {_metres(after)} after"


def _held(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    far = max((d.shift_m for d in rows if math.isfinite(d.shift_m)), default=math.nan)
    told = f"sightings put the robot {far:.2f} m off; " if math.isfinite(far) else ""
    return f"{told}{_not_used([d for d in rows if d.landmark_id >= 0], trajectory)}"


def _travelled(rows: Sequence[Decision], trajectory: Trajectory) -> str:
    first, end = np.searchsorted(trajectory.stamps_ns, [rows[0].stamp_ns, rows[-1].stamp_ns + 1])
    poses = trajectory.poses[max(first - 1, 0) : end]
    if len(poses) < 2:
        return ""
    way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    covs = None if trajectory.covs is None else trajectory.covs[max(first - 1, 0) : end]
    sigma = math.nan if covs is None else float(np.sqrt(covs[:, 0, 0] + covs[:, 1, 1]).max())
    return f"{way:.2f} m without a fix; position σ up to {_metres(sigma)}"


_EFFECTS: Mapping[str, Callable[[Sequence[Decision], Trajectory], str]] = {
    "motion_faulty": _left_out,
    "motion_overruled": _gone_to,
    "relocated": _gone_to,
    "initial_pose_contradicted": _held,
    "outage": _travelled,
    "lost": _travelled,
    "lifted": _travelled,
    "unconfirmed": _travelled,
    "clock_jump": lambda rows, trajectory: "no motion connects the poses before and after",
    "mounting_changed": lambda rows, trajectory: "mounting found again",
}
"""Sentence on what a judgement did to the pose, by its kind: made of its rows, by time, and of the trajectory."""


def _sigma_m(trajectory: Trajectory, stamp_ns: int, before: bool) -> float:
    """Sigma [m] of the position at the last pose before a time, or at the first one not before it."""
    at = int(np.searchsorted(trajectory.stamps_ns, stamp_ns)) - before
    if trajectory.covs is None or not 0 <= at < len(trajectory):
        return math.nan
    return math.sqrt(trajectory.covs[at, 0, 0] + trajectory.covs[at, 1, 1])


def _metres(value: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{1e3 * value:.1f} mm" if value < 0.1 else f"{value:.2f} m"


# --- Judgements -------------------------------------------------------------------------------------------------------

Kind = Literal[
    "gross_mistake",
    "lost",
    "initial_pose_contradicted",
    "relocated",
    "lifted",
    "clock_jump",
    "landmark_moved",
    "mounting_changed",
    "installation",
    "unconfirmed",
    "motion_overruled",
    "outage",
    "motion_faulty",
    "misread",
    "solver",
    "rejected",
    "outlier",
]
"""The gravest first."""
GRAVITY: Mapping[str, int] = {kind: i for i, kind in enumerate(get_args(Kind))}
_TITLES: Mapping[str, str] = {
    "gross_mistake": "set-up wrong",
    "lost": "robot lost",
    "initial_pose_contradicted": "given first pose contradicted",
    "relocated": "pose contradicted, robot relocated",
    "lifted": "robot lifted or pushed",
    "clock_jump": "clock jumped",
    "landmark_moved": "moved",
    "mounting_changed": "knocked: its mounting changed",
    "installation": "contradicts the given value",
    "unconfirmed": "first pose not confirmed",
    "motion_overruled": "motion contradicted by sightings",
    "outage": "no accepted sightings: dead reckoning",
    "motion_faulty": "faulty",
    "misread": "markers misread",
    "solver": "solver failed, window rebuilt",
    "rejected": "sightings rejected",
    "outlier": "single sightings rejected",
}
_OF_SIGHTINGS: Mapping[str, Kind] = {
    "gate": "rejected",
    "behind_camera": "rejected",
    "contradicts_others": "rejected",
    "contradicts initial_pose": "initial_pose_contradicted",
    "misread": "misread",
    "quarantined": "landmark_moved",
    "window_rebuilt": "solver",
}
_OF_PLACES: Mapping[str, Kind] = {
    "jump": "relocated",
    "overruled by sightings": "motion_overruled",
    "contradicts initial_pose": "initial_pose_contradicted",
    "landmark_moved": "landmark_moved",
}
_OF_MODES: Mapping[str, Kind] = {"dead_reckoning": "outage", "lost": "lost", "unconfirmed": "unconfirmed"}
_JOIN_NS = 1_000_000_000  # rows of one kind and subject further apart than this are two episodes ...
_LASTING = ("landmark_moved", "misread", "initial_pose_contradicted")  # ... but for these
_FEW = 2  # sightings rejected: as few of a landmark in a row are outliers, and all outliers one judgement
_NAMED = 6  # landmarks in one judgement


class Figures(BaseModel):
    """A part of ``metrics.json``; immutable."""

    model_config = ConfigDict(frozen=True)


class Judgement(Figures):
    """One thing that was judged to be wrong.

    Attributes:
        number: in the report's table and in the column ``judgement`` of ``steps.csv``, from 1.
        kind: of the judgement.
        subject: what it is about: a source, a landmark, the pose.
        what: subject and kind in words.
        from_s, to_s: seconds from the first pose; None: before the run, or of all of it.
        from_step, to_step: of the rows of ``steps.csv``.
        rows: how many rows, or sightings, it is made of.
        evidence: statistic and number of steps or sightings, in words.
        statistic: the value that exceeds its threshold most, as ``nis`` in ``steps.csv``.
        threshold: that the statistic was held against.
        effect: what it cost or saved.
    """

    number: int = 0
    kind: Kind
    subject: str
    what: str
    from_s: float | None = None
    to_s: float | None = None
    from_step: int | None = None
    to_step: int | None = None
    rows: int = 0
    evidence: str = ""
    statistic: float | None = None
    threshold: float | None = None
    effect: str = ""

    @property
    def when(self) -> str:
        """Time span in seconds from the first pose, in words."""
        if self.from_s is None or self.to_s is None:
            return "whole run"
        if self.to_s - self.from_s < 0.05:
            return f"{self.from_s:.1f} s"
        return f"{self.from_s:.1f}–{self.to_s:.1f} s"


def judgements(result: RunData) -> tuple[Judgement, ...]:
    """Everything that a run judged to be wrong: of the whole run first, then by time."""
    found = (*_of_setup(result), *episodes(result.decisions, result.trajectory))
    return tuple(j.model_copy(update={"number": i}) for i, j in enumerate(found, start=1))


def numbered(result: RunData) -> dict[Decision, int]:
    """Number of the judgement that a row of ``steps.csv`` belongs to, for those that belong to one."""
    before = sum(1 for _ in _of_setup(result))
    told = _episodes(result.decisions, result.trajectory)
    return {d: before + i for i, (_, rows) in enumerate(told, start=1) for d in rows}


def gravest(found: Iterable[Judgement], count: int) -> list[Judgement]:
    """The gravest judgements, but for what is expected of a sound run and what is said elsewhere.

    By kind, then by the number of rows.
    """
    told = [j for j in found if j.kind not in ("gross_mistake", "outlier")]
    return sorted(told, key=lambda j: (GRAVITY[j.kind], -j.rows))[:count]


def episodes(decisions: Sequence[Decision], trajectory: Trajectory) -> list[Judgement]:
    """Judgements of rows of ``steps.csv``, by time; their effect on the pose is taken from the trajectory."""
    return [judgement for judgement, _ in _episodes(decisions, trajectory)]


def _episodes(decisions: Sequence[Decision], trajectory: Trajectory) -> list[tuple[Judgement, list[Decision]]]:
    """Judgements by time, each with the rows that it is made of."""
    start_ns = int(trajectory.stamps_ns[0])
    found, outliers = [], []
    for (kind, subject), rows in _grouped(decisions).items():
        for episode in _cut(rows, joined=kind in _LASTING):
            if kind == "rejected" and len(episode) <= _FEW:
                outliers += episode
            else:
                found.append((_judgement(kind, subject, episode, trajectory, start_ns), episode))
    if outliers:
        outliers.sort(key=lambda d: d.stamp_ns)
        seen = sum(math.isfinite(d.nis) and d.landmark_id >= 0 for d in decisions)
        made = _judgement("outlier", "", outliers, trajectory, start_ns)
        found.append((made.model_copy(update={"evidence": f"{made.evidence}, of {seen}"}), outliers))
    return sorted(found, key=lambda j: (j[0].from_s or 0.0, GRAVITY[j[0].kind]))


def _grouped(decisions: Sequence[Decision]) -> dict[tuple[Kind, str], list[Decision]]:
    """Rows of ``steps.csv`` by kind and subject of their judgement."""
    last = {(d.step, d.kind): i for i, d in enumerate(decisions) if is_motion_source(d.kind)}
    moved = {d.landmark_id for d in decisions if d.reason in ("quarantined", "landmark_moved")}
    grouped: dict[tuple[Kind, str], list[Decision]] = defaultdict(list)
    for i, d in enumerate(decisions):
        if is_motion_source(d.kind) and last[d.step, d.kind] != i:
            continue  # judged again further down
        if (named := _named(d, moved)) is not None:
            grouped[named].append(d)
    for rows in grouped.values():
        rows.sort(key=lambda d: d.stamp_ns)
    return grouped


def _named(d: Decision, moved: set[int]) -> tuple[Kind, str] | None:
    """Kind and subject of a row's judgement; None: nothing is wrong, or another row has that judgement."""
    if not d.reason:
        return None
    if is_motion_source(d.kind):
        return None if d.reason in _OF_PLACES else ("motion_faulty", d.kind)
    if d.kind == "mode":
        return _OF_MODES[d.reason], "pose"
    if d.kind == "lift":
        return "lifted", "pose"
    if d.kind == "clock":
        return "clock_jump", "clock"
    if d.kind == "place":
        kind = _OF_PLACES.get(d.reason)
        return None if kind is None else (kind, f"landmark {d.landmark_id}" if d.landmark_id >= 0 else "pose")
    if d.reason == MOUNTING_CHANGED:
        return "mounting_changed", sensor_name(d.kind)
    kind = _OF_SIGHTINGS.get(d.reason)
    if kind == "rejected" and d.landmark_id in moved:
        kind = "landmark_moved"
    if kind is None or d.landmark_id < 0:
        return None
    by_landmark = kind in ("landmark_moved", "rejected")
    return kind, f"landmark {d.landmark_id}" if by_landmark else "pose" if kind == "initial_pose_contradicted" else ""


def _cut(rows: Sequence[Decision], joined: bool) -> Iterator[list[Decision]]:
    """Episodes of rows that lie close to one another."""
    stamps: IntArray = np.array([d.stamp_ns for d in rows], dtype=np.int64)
    cuts = [] if joined else (np.flatnonzero(np.diff(stamps) > _JOIN_NS) + 1).tolist()
    for first, end in zip([0, *cuts], [*cuts, len(rows)], strict=True):
        yield list(rows[first:end])


def _judgement(kind: Kind, subject: str, rows: Sequence[Decision], trajectory: Trajectory, start_ns: int) -> Judgement:
    worst = max(rows, key=_excess)
    statistic = worst.residual if worst.kind == "mode" else worst.nis
    told = subject if subject and subject != "pose" and not subject.startswith("clock") else ""
    return Judgement(
        kind=kind,
        subject=subject,
        what=f"{told} {_TITLES[kind]}".strip() + _reasons(kind, rows),
        from_s=round((rows[0].stamp_ns - start_ns) * 1e-9, 3),
        to_s=round((rows[-1].stamp_ns - start_ns) * 1e-9, 3),
        from_step=rows[0].step,
        to_step=rows[-1].step,
        rows=len(rows),
        evidence=_evidence(rows, worst, statistic),
        statistic=statistic if math.isfinite(statistic) else None,
        threshold=worst.threshold if math.isfinite(worst.threshold) else None,
        effect=_EFFECTS.get(kind, _not_used)(rows, trajectory),
    )


def _excess(d: Decision) -> float:
    """Ratio of a row's statistic to its threshold; -1 without a statistic, 0 without a threshold."""
    statistic = d.residual if d.kind == "mode" else d.nis
    if not math.isfinite(statistic):
        return -1.0
    return statistic / d.threshold if d.threshold > 0.0 else 0.0


def _reasons(kind: Kind, rows: Sequence[Decision]) -> str:
    """The most frequent reason, of a fault of motion; the landmarks, where there may be several."""
    if kind == "motion_faulty":
        return f": {Counter(d.reason for d in rows).most_common(1)[0][0].replace('_', ' ')}"
    if kind in ("misread", "outlier"):
        ids = sorted({d.landmark_id for d in rows})
        more = f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else ""
        return f" (landmark id{'s' if len(ids) > 1 else ''} {', '.join(map(str, ids[:_NAMED]))}{more})"
    return ""


def _evidence(rows: Sequence[Decision], worst: Decision, statistic: float) -> str:
    sightings = [d for d in rows if d.landmark_id >= 0 and d.kind != "place"]
    count = plural(len(sightings), "sighting") if sightings else plural(len({d.step for d in rows}), "step")
    if worst.kind == "clock":
        return "stamps of several sensors left the running time together"
    if worst.kind == "mode":
        bound = f", threshold {worst.threshold:.3g} s" if math.isfinite(worst.threshold) else ""
        if not statistic and worst.reason == "lost":  # there is no last accepted sighting to count from
            return f"no sighting was accepted before; {count}"
        return f"{statistic:.1f} s without an accepted sighting{bound}; {count}"
    if not math.isfinite(statistic) or statistic == 0.0:
        return count
    names = {"wheels": "GLR", "lift": f"{worst.reason.replace('_', ' ')}: NIS"}
    name = "2 log likelihood ratio" if worst.reason == "landmark_moved" else names.get(worst.kind, "NIS")
    bound = f", threshold {worst.threshold:.3g}" if math.isfinite(worst.threshold) else ""
    return f"{name} {'up to ' if len(rows) > 1 else ''}{_number(statistic)}{bound}; {count}"


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def _of_setup(result: RunData) -> Iterator[Judgement]:
    """Judgements on the whole run: gross mistakes, and given values that the run contradicts."""
    for sentence in result.mistakes:
        yield Judgement(
            kind="gross_mistake",
            subject="set-up",
            what=_TITLES["gross_mistake"],
            evidence=sentence,
            effect="the run was made without it",
        )
    for s in () if result.found is None else result.found.settings:
        if contradicted(s):
            yield Judgement(
                kind="installation",
                subject=s.name,
                what=f"{s.name} {_TITLES['installation']}",
                evidence=f"{abs(s.off):.1f} σ apart, threshold {SURE_SIGMAS:g}",
                statistic=abs(s.off),
                threshold=SURE_SIGMAS,
                effect=f"{s.given:.5g} was given, {s.found:.5g} ± {s.sigma:.2g} was used",
            )
