"""What a run judged to be wrong, as episodes; the same from the rows of steps.csv."""

import csv
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from run_results import START_NS, figure_eight

from fgloc.evaluation.judgements import episodes, gravest, judgements
from fgloc.files.outputs import write_steps_csv
from fgloc.types import Decision, Finding, Severity

ALARM = 30.0


def row(k, kind, reason, landmark_id=-1, nis=50.0, threshold=ALARM, shift_m=math.nan, weight=0.0):
    stamp_ns = START_NS + 100_000_000 * k
    return Decision(k, stamp_ns, kind, landmark_id, math.sqrt(nis), nis, 3, weight, reason, threshold, shift_m)


def run_of(*rows):
    return replace(figure_eight(), decisions=rows)


def slips(first, last, **changes):
    return [row(k, "wheels", "slip", shift_m=0.01, **changes) for k in range(first, last)]


def read_back(path):
    with path.open() as file:
        for r in csv.DictReader(file):
            seconds, nanos = r["stamp"].split(".")
            rest = [float(r[key] or "nan") for key in ("threshold", "shift_m")]
            fit = (float(r["residual"]), float(r["nis"]), int(r["dof"]), float(r["weight"]), r["reason"])
            yield Decision(
                int(r["step"]), int(seconds) * 10**9 + int(nanos), r["kind"], int(r["landmark_id"]), *fit, *rest
            )


def test_adjacent_steps_are_one_episode_with_its_worst_statistic_and_what_it_would_have_cost():
    worst = row(34, "wheels", "slip", nis=99.0, shift_m=0.01)
    found = judgements(run_of(*slips(20, 34), worst, *slips(35, 40), *slips(80, 83)))
    assert [(j.kind, j.subject, j.from_s, j.to_s, j.rows) for j in found] == [
        ("motion_faulty", "wheels", 2.0, 3.9, 20),
        ("motion_faulty", "wheels", 8.0, 8.2, 3),
    ]
    assert (found[0].statistic, found[0].threshold) == (99.0, ALARM)
    assert (found[0].from_step, found[0].to_step) == (20, 39)
    assert "+0.200 m" in found[0].effect
    assert found[0].when == "2.0–3.9 s"


def test_a_robot_that_never_saw_a_landmark_is_lost_from_the_beginning():
    rows = [replace(row(k, "mode", "lost", nis=0.0, threshold=math.nan), residual=0.0) for k in range(300)]
    (j,) = judgements(run_of(*rows))
    assert (j.kind, j.from_s, j.to_s) == ("lost", 0.0, 29.9)
    assert re.fullmatch(r"\D*\b300 steps", j.evidence)  # not since when: there was none
    later = [replace(r, residual=4.0 + 0.1 * r.step) for r in rows[200:]]
    assert re.fullmatch(r"\d+\.\d s\b.*\b100 steps", judgements(run_of(*later))[0].evidence)


def test_a_step_judged_again_counts_as_it_was_judged_last():
    (j,) = judgements(run_of(row(5, "wheels", "", weight=1.0), row(6, "wheels", "slip"), row(5, "wheels", "slip")))
    assert (j.from_step, j.to_step, j.rows) == (5, 6, 2)
    assert judgements(run_of(row(5, "wheels", "slip"), row(5, "wheels", "", weight=1.0))) == ()


def test_rejections_of_a_landmark_that_is_found_moved_belong_to_that():
    gated = [row(k, "corners", "gate", landmark_id=7) for k in range(10, 70, 10)]
    moved = [row(k, "corners", "quarantined", landmark_id=7) for k in range(80, 200, 40)]
    other = row(50, "corners", "gate", landmark_id=3)
    found = {j.kind: j for j in judgements(run_of(*gated, *moved, other))}
    assert set(found) == {"landmark_moved", "outlier"}
    assert found["landmark_moved"].what == "landmark 7 moved"
    assert (found["landmark_moved"].from_s, found["landmark_moved"].rows) == (1.0, 9)
    assert re.search(r"\bid 3\b", found["outlier"].what)
    several = judgements(run_of(other, row(10, "corners", "gate", landmark_id=9)))
    assert [j.kind for j in several] == ["outlier"]
    assert re.search(r"\bids 3, 9\b", several[0].what)


def test_an_outage_says_how_far_the_robot_went_and_how_well_it_is_known():
    result = figure_eight()
    rows = [row(k, "mode", "dead_reckoning", nis=0.1 * k, threshold=1.0) for k in range(100, 150)]
    (j,) = judgements(replace(result, decisions=tuple(rows)))
    way = np.hypot(*np.diff(result.trajectory.poses[99:150, :2], axis=0).T).sum()
    assert j.kind == "outage"
    assert j.effect.startswith(f"{way:.2f} m ")


def test_the_gravest_come_first_and_stray_outliers_not_at_all():
    place = row(90, "place", "jump", shift_m=1.5, weight=1.0)
    found = judgements(run_of(*slips(20, 30), *slips(60, 64), row(50, "corners", "gate", landmark_id=3), place))
    assert [j.kind for j in gravest(found, 3)] == ["relocated", "motion_faulty", "motion_faulty"]
    assert [j.rows for j in gravest(found, 3)][1:] == [10, 4]
    assert " 1.50 m" in gravest(found, 1)[0].effect


def test_the_setups_mistakes_are_of_the_whole_run():
    (j,) = judgements(replace(run_of(), findings=(Finding("setup", "Markers: 0.16 m, not 0.2 m.", Severity.ERROR),)))
    assert (j.kind, j.when, j.evidence) == ("gross_mistake", "whole run", "Markers: 0.16 m, not 0.2 m.")


@pytest.mark.parametrize("kind", ["jump", "overruled by sightings", "contradicts initial_pose"])
def test_rows_of_steps_csv_give_the_same_judgements(tmp_path, kind):
    seen = [row(k, "corners", "gate", landmark_id=2, nis=40.0) for k in range(40, 48)]
    told = [*slips(20, 30), *seen, row(90, "place", kind, shift_m=0.7), row(95, "clock", "new_segment", nis=math.inf)]
    result = run_of(*told, *[row(k, "mode", "lost", threshold=math.nan) for k in range(200, 220)])
    write_steps_csv(tmp_path / "steps.csv", result.decisions)
    again = episodes(list(read_back(tmp_path / "steps.csv")), result.trajectory)
    expected = episodes(result.decisions, result.trajectory)
    assert len(expected) == 5
    for a, b in zip(again, expected, strict=True):
        exact = {"statistic", "threshold"}
        assert a.model_dump(exclude=exact) == b.model_dump(exclude=exact)
        assert (a.statistic or 0.0) == pytest.approx(b.statistic or 0.0, rel=1e-5)
