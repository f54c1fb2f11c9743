"""One cell of `benchmarks.mechanisms`: a failure on a recording, replayed with one mechanism off, and its figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, Self

from benchmarks.adaptive_recordings import Recorded
from benchmarks.adaptive_runs import CASES as FAILURES
from benchmarks.adaptive_runs import Replayed, changed, failure, replayed
from benchmarks.adaptive_scores import score
from benchmarks.installed_recordings import Take, load
from benchmarks.installed_scores import Errors, carried, errors, lost_share
from benchmarks.mechanisms_off import BY_NAME, MECHANISMS
from benchmarks.mechanisms_robots import robot, robot_chain
from benchmarks.mechanisms_switch import watched
from fgloc.ablation.failures import Kidnap, Lift
from fgloc.config import Config
from fgloc.errors import FglocError
from fgloc.evaluation.metrics import match_result, nees
from fgloc.runner import RunResult
from fgloc.sensors.failures import Failure

_KINDS = {"frozen": "frozen", "onewheel": "left_wheel_dead"}  # the fault of the wheels in a case
FOREIGN = "foreign"  # a case: the motion model is of another robot, one whose landmarks are beacons
PUSHED = "pushed"  # a case: for 0.6 s nothing is recorded, twice, so that the robot is 15 to 20 cm farther on at once
_PUSHED_S = [[20.0, 20.6], [40.0, 40.6]]
WHEELS = "wheels"  # a case: ``dark60`` of a robot that has wheels and a camera alone
_WHEELS_ALONE = {"motion": {"use": False}, "gyro": {"use": False}}
GIVEN = "given"  # a case: the first pose is given and right, while the map is shifted as a whole ...
_SHIFTED_M = 0.5  # ... by this
CARRIED30 = "carried30"  # a case: carried away, with 30 % of the ids misread
LIKE = {FOREIGN: "slip", WHEELS: "dark60", CARRIED30: "kidnap"}  # the case whose recording they are
OWN_CASES = (FOREIGN, PUSHED, WHEELS, GIVEN, CARRIED30)
_FOREIGN_MODEL = {"motion": {"model": "shipped:mrclam/all"}}
_NAMED_KINDS = {"frozen", "left_wheel_dead", "right_wheel_dead"}


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """A case on a recording.

    Attributes:
        source: what is replayed: a recording of the simulator, or the number of a robot of MRCLAM 6.
        case: the failure.
        off: name of the mechanism that is switched off; "" for none.
    """

    source: Take | int
    case: str
    off: str = ""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Figures of one run, as they are kept.

    Attributes:
        online, batch: of the estimates as they were made and of the smoothed ones; None if there are none.
        poses: estimates online.
        lost_share: of the poses, those of mode LOST.
        named, moved: landmarks that the notes of the run name as moved, and those that were moved.
        wrong_names: landmarks and faults of wheels that are named although they are not there.
        missed_names: those that are there and not named.
        delays_s, found_m, missed_m, false_alarms, path_m: of slips, as in `benchmarks.adaptive_scores`.
        lifted_nees: NEES/3 while a robot was carried and until it saw a marker again; None without a kidnapping.
        acted: how often each mechanism acted, by name; of the run with all of them on.
        failed: why there are no figures.
    """

    online: Errors | None = None
    batch: Errors | None = None
    poses: int = 0
    lost_share: float = 0.0
    named: tuple[int, ...] = ()
    moved: tuple[int, ...] = ()
    wrong_names: int = 0
    missed_names: int = 0
    delays_s: tuple[float, ...] = ()
    found_m: tuple[float, ...] = ()
    missed_m: tuple[float, ...] = ()
    false_alarms: int = 0
    path_m: float = 0.0
    lifted_nees: float | None = None
    acted: dict[str, int] = field(default_factory=dict)
    failed: str = ""

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Outcome from values of `asdict`, as JSON keeps them."""
        told = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
        for name in ("online", "batch"):
            told[name] = None if told[name] is None else Errors(**told[name])
        return cls(**told)


def run(cell: Cell) -> Outcome:
    """Replay and score a case; a failed run has its reason, and the run with everything on is smoothed too."""
    mechanism = BY_NAME.get(cell.off)
    recorded = robot(cell.source) if isinstance(cell.source, int) else load(cell.source)
    seed = cell.source if isinstance(cell.source, int) else cell.source.seed
    try:
        chain = [failure(described) for described in _chain(cell, recorded)]
    except ValueError as error:  # a drive too short for the failure
        return Outcome(failed=str(error))
    smooth = (
        not isinstance(cell.source, int)
        and (cell.case in OWN_CASES or cell.case in FAILURES)
        and (mechanism is None or mechanism.batch)
    )
    watching = watched(MECHANISMS) if mechanism is None else nullcontext({})
    with watching as acted, nullcontext() if mechanism is None else mechanism.off():
        try:
            config = changed(recorded.config, _changes(cell, recorded))
            made = replayed(recorded, config, chain, seed, smooth)
        except (FglocError, RuntimeError, ValueError, ArithmeticError) as error:
            return Outcome(failed=f"{type(error).__name__}: {str(error).splitlines()[0][:200]}")
    if made is None:
        return Outcome(failed="no pose was ever found")
    return _scored(cell, recorded, chain, made, dict(acted))


def _chain(cell: Cell, recorded: Recorded) -> list[dict[str, Any]]:
    kind, _, amount = cell.case.partition("_")
    if kind == FOREIGN:
        return []
    if kind == CARRIED30:
        return [*FAILURES[LIKE[CARRIED30]].chain(recorded), *FAILURES["ids30"].chain(recorded)]
    if kind == WHEELS:
        return FAILURES[LIKE[WHEELS]].chain(recorded)
    if kind == GIVEN:
        ids = sorted(recorded.landmarks.landmarks)
        return [{"kind": "moved_marker", "ids": ids, "distance_m": _SHIFTED_M, "together": True}]
    if kind == PUSHED:
        return [{"kind": "kidnap", "when": {"intervals": _PUSHED_S}}]
    if kind == "ids":
        return [{"kind": "wrong_ids", "probability": 0.01 * int(amount)}]
    if kind == "moved" and amount:
        moved = FAILURES["moved"].chain(recorded)
        return [described | {"distance_m": 0.01 * int(amount)} for described in moved]
    if isinstance(cell.source, int):
        return robot_chain(recorded, cell.case)
    return FAILURES[cell.case].chain(recorded)


def _changes(cell: Cell, recorded: Recorded) -> dict[str, Any]:
    """Changes of the configuration."""
    if cell.case == GIVEN:
        return {"estimator": {"initial_pose": recorded.truth[0, 1:].tolist()}}
    return {FOREIGN: _FOREIGN_MODEL, WHEELS: _WHEELS_ALONE}.get(cell.case, {})


def _scored(cell: Cell, recorded: Recorded, chain: Sequence[Failure], made: Replayed, acted: dict[str, int]) -> Outcome:
    config, online, batch = recorded.config, made.online, made.batch
    lifted = [] if cell.case == PUSHED else [f.when.intervals[0][0] for f in chain if isinstance(f, Kidnap | Lift)]
    unknown = carried(made.given, recorded.start_ns + round(lifted[0] * 1e9)) if lifted else None
    figures = score(recorded, 0, config, online, None, chain, made.given)
    reasons = {d.reason for d in online.decisions if d.kind == "wheels"} & _NAMED_KINDS
    right = {_KINDS[cell.case]} if cell.case in _KINDS else set()
    slips, moved = figures.slips, frozenset() if cell.case == GIVEN else figures.moved
    simulated = slips is not None and not isinstance(cell.source, int)
    return Outcome(
        online=errors(online, config, unknown),
        batch=None if batch is None else errors(batch, config, unknown),
        poses=len(online.trajectory),
        lost_share=lost_share(online.modes, online.trajectory.stamps_ns, unknown),
        named=tuple(sorted(figures.named)),
        moved=tuple(sorted(moved)),
        wrong_names=len(figures.named - moved) + len(reasons - right),
        missed_names=len(moved - figures.named) + len(right - reasons),
        delays_s=slips.delays_s if slips and simulated else (),
        found_m=slips.found_m if slips and simulated else (),
        missed_m=slips.missed_m if slips and simulated else (),
        false_alarms=slips.false_alarms if slips and simulated else 0,
        path_m=slips.path_m if slips and simulated else 0.0,
        lifted_nees=None if unknown is None else nees_between(online, config, unknown),
        acted=acted,
    )


def nees_between(result: RunResult, config: Config, span_ns: tuple[int, int]) -> float | None:
    """NEES/3 of the poses in a time; None if there are none."""
    matched = match_result(result, config)
    if matched is None or matched.covs is None:
        return None
    inside = (matched.stamps_ns >= span_ns[0]) & (matched.stamps_ns < span_ns[1])
    return float(nees(matched.errors[inside], matched.covs[inside]).mean()) / 3.0 if inside.any() else None
