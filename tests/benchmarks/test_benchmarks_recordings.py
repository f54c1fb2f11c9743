"""Recordings, failures and scores of the benchmarks are right where the outcome is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from event_makers import corners

from benchmarks import replays
from benchmarks.recordings import SEEDS, Recorded, Take, changed, folder, moved_interval, scenario, slip_intervals
from benchmarks.replays import FAILURES, Replayed, failures, floor, moved_id
from benchmarks.scores import flags, slips
from fgloc.ablation.failures import Kidnap
from fgloc.config import Config, load_config, with_value
from fgloc.runner import RunResult
from fgloc.types import Decision, Landmark, LandmarkMap, Mode, Trajectory

START_NS = 10**18
MAP = LandmarkMap({i: Landmark(i, np.zeros(3), np.eye(3), 0.2) for i in range(4)})


def recorded(slipping=(), seconds=20.0, speed=0.5, events=()):
    """A straight drive along x; the wheels turn 0.1 m/s too fast in the given intervals."""
    t = np.arange(0.0, seconds, 0.02)
    flag = np.zeros(len(t), dtype=bool)
    for start, end in slipping:
        flag |= (t >= start - 1e-9) & (t <= end + 1e-9)
    slip = np.column_stack([np.where(flag, -0.1, 0.0), np.zeros(len(t)), np.zeros(len(t))])
    truth = np.column_stack([t, speed * t, np.zeros(len(t)), np.zeros(len(t))])
    where = ("made", Path(), Path())
    return Recorded(*where, Config(), MAP, tuple(events), START_NS, truth, seconds, t, flag, slip)


def decisions(*flagged, step_s=0.2, seconds=20.0, revised=()):
    """Wheels' rows of ``steps.csv``, with a reason inside the flagged intervals; then rows of steps judged again."""
    rows = []
    for k in range(round(seconds / step_s)):
        t = k * step_s
        reason = "slip" if any(a - 1e-9 <= t <= b + 1e-9 for a, b in flagged) else ""
        rows.append(Decision(k, START_NS + round(t * 1e9), "wheels", -1, 0.0, 0.0, 3, 1.0, reason))
        for at, earlier in revised:
            if abs(at - t) < 1e-9:
                rows.append(Decision(k, START_NS + round(earlier * 1e9), "wheels", -1, 0.0, 0.0, 3, 0.0, "slip"))
    return tuple(rows)


def result(truth, poses, stamps, rows=(), modes=None):
    modes = modes or (Mode.OK,) * len(stamps)
    estimate, exact = Trajectory(stamps, poses), Trajectory(stamps, truth)
    return RunResult(estimate, modes, tuple(rows), {}, {}, (), np.ones(len(stamps)), 1.0, truth=exact)


def test_slips_close_together_are_one_and_instants_are_none():
    made = recorded([(2.0, 3.0), (3.2, 4.0), (8.0, 8.04), (12.0, 12.5)])
    assert np.allclose(slip_intervals(made), [(2.0, 4.0), (12.0, 12.5)])


def test_flags_count_from_the_step_that_raised_them():
    rows = decisions((5.0, 6.0), (9.0, 9.0), revised=[(5.0, 4.2), (5.0, 4.4)])
    assert np.allclose(flags(recorded(), rows), [(5.0, 6.0), (9.0, 9.0)])


def test_slips_are_found_missed_and_imagined():
    made = recorded([(2.0, 3.0), (8.0, 9.0), (12.0, 12.5)])
    rows = decisions((2.2, 3.4), (12.8, 13.0), (17.0, 17.4))
    poses = np.zeros((2, 3))
    scored = slips(made, result(poses, poses, np.array([0, 1]), rows))
    assert scored.delays_s == pytest.approx((0.2, 0.8))
    assert scored.found_m == pytest.approx((0.1, 0.05), abs=0.003)
    assert scored.missed_m == pytest.approx((0.1,), abs=0.003)
    assert scored.false_alarms == 1
    assert scored.path_m == pytest.approx(10.0, abs=0.02)


def test_kidnap_lasts_until_the_robot_is_away():
    start, end = moved_interval(recorded(), 5.0, 3.0)
    assert (start, end) == pytest.approx((5.0, 11.0), abs=0.03)
    swinging = recorded()
    swinging.truth[:, 1] = 2.0 * np.sin(2.0 * np.pi * swinging.truth[:, 0] / 20.0)  # 2 m to either side
    start, end = moved_interval(swinging, 0.0, 3.0)
    assert start == pytest.approx(2.0, abs=0.05)  # the first whole second from which 3 m lie ahead: x is 1.18
    assert 10.0 < end < 15.0
    with pytest.raises(ValueError, match="never 30"):
        moved_interval(recorded(), 5.0, 30.0)


def test_every_case_describes_failures():
    made = recorded([(2.0, 3.0)], seconds=80.0, events=[corners(1.0, 2), corners(2.0, 1, 2), corners(3.0, 9)])
    assert moved_id(made) == 2
    chains = {case: failures(case, made) for case in FAILURES}
    assert {case for case, chain in chains.items() if not chain} == {"none", "slip", "mu01"}
    assert all(len(chain) <= 1 for chain in chains.values())
    assert {floor(case) for case in FAILURES} == {"unequal_radii", "patches", "slippery"}


def test_nothing_is_known_from_the_lift_to_the_first_marker():
    begin = corners(0.0).stamp_ns
    seen = [corners(t, 1) for t in (9.0, 14.0, 15.0)]
    empty = replace(corners(12.0), sightings=())
    lift = Kidnap(when={"intervals": [(10.0, 12.0)]})
    online = result(np.zeros((2, 3)), np.zeros((2, 3)), np.array([0, 1]))
    made = Replayed(online, None, [lift], [*seen, empty], [], MAP)
    assert made.unknown_ns(begin) == (begin + 10 * 10**9, begin + 14 * 10**9)
    assert replace(made, given=seen[:1]).unknown_ns(begin)[1] > 10**18
    assert replace(made, chain=[]).unknown_ns(begin) is None


def test_takes_have_folders_of_their_own_and_splits_share_no_seed():
    takes = [Take(v, "patches", "validation", 41) for v in ("installed", "map5mm", "perfect", "found", "tour")]
    assert len({folder(take) for take in takes}) == len(takes)
    assert not set(SEEDS["test"]) & set(SEEDS["validation"])


def test_cells_are_made_once_and_anew_when_a_source_changes(tmp_path, monkeypatch):
    monkeypatch.setenv("FGLOC_BENCHMARK_CACHE", str(tmp_path))
    made = []

    def make():
        made.append(1)
        return {"value": len(made)}

    assert replays.kept("cell", make) == replays.kept("cell", make) == {"value": 1}
    monkeypatch.setattr(replays, "_sources", lambda others: "other")
    assert replays.kept("cell", make) == {"value": 2}


def test_scenarios_are_the_suites_with_the_splits_control():
    test, validation = scenario("patches", "test"), scenario("patches", "validation")
    assert test.world == validation.world
    assert test.control != validation.control
    assert test.camera is not None
    assert test.duration_s >= 80.0


def test_settings_of_a_file_can_be_changed():
    samples = Path(__file__).parents[2] / "datasets" / "samples"
    config = load_config(samples / "first_run" / "robot.yaml")
    assert changed(config, {"gate": {"max_speed": 3.5}}) == with_value(config, "gate.max_speed", 3.5)
