"""The benchmark of mechanisms: each switch is really off inside and on again outside, and the table is well-formed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from exact import exact
from robot_world import Chain, World, room

from benchmarks import mechanisms
from benchmarks.common import Row
from benchmarks.mechanisms import (
    Cell,
    Scope,
    changes,
    file_name,
    mechanism_of,
    outcome,
    outside,
    report,
    wanted,
    without_effect,
)
from benchmarks.mechanisms_off import BY_NAME, MECHANISMS, Returns, Switch, watched
from benchmarks.scores import Errors, Scores, Slips, of_errors, ratio_of
from fgloc.estimation import place as place_search
from fgloc.estimation import sightings as association
from fgloc.estimation.sightings import Association
from fgloc.types import LandmarkMap


def moved_world(seconds=12.0):
    """A room in which one marker hangs elsewhere than the map has it."""
    shown = dict(room().landmarks)
    shown[2] = replace(shown[2], position=shown[2].position + np.array([0.0, 0.4, 0.0]))
    return World(room(), seconds=seconds, shown=LandmarkMap(shown))


def refusals(world):
    """Reasons of a replay."""
    estimates = Chain(exact(), room()).run(world.events())
    return [d.reason for e in estimates for d in e.decisions if d.reason and d.landmark_id >= 0]


def result(ate=1.0, nees=1.0, batch=None, **changes_):
    errors = Errors(ate, 0.1, nees)
    smoothed = None if batch is None else Errors(batch, 0.1, 1.0)
    return Scores(errors, smoothed, 100, **changes_)


def scope(*names):
    return Scope("validation", (41, 42), (41,), (), ("none", "slip", "kidnap"), tuple(BY_NAME[n] for n in names))


def found_in(chosen, on, off):
    """The same outcome in every cell with everything on, and another one with something off."""
    return {cell: off if cell.off else on for w in wanted(chosen) for cell in w.cells}


@pytest.mark.parametrize("mechanism", MECHANISMS, ids=lambda m: m.name)
def test_each_switch_replaces_what_is_there_and_puts_it_back(mechanism):
    places = [switch.place() for switch in mechanism.switches]
    before = [vars(holder).get(name) for holder, name in places]
    assert before == [getattr(holder, name, None) for holder, name in places]
    with mechanism.off():
        assert all(vars(h)[n] is not old for (h, n), old in zip(places, before, strict=True))
    assert [vars(holder).get(name) for holder, name in places] == before


def test_names_are_unique_and_cases_exist():
    assert len(BY_NAME) == len(MECHANISMS)
    robots = {f"robot_{case}" for case in mechanisms.ROBOT_CASES}
    assert {mechanism.case for mechanism in MECHANISMS} <= {*mechanisms.CASES, *robots}


def test_probes_watch_what_is_there_and_put_it_back():
    real = Association._agreed
    with watched(MECHANISMS) as counts:
        assert Association._agreed is not real
    assert Association._agreed is real
    assert not counts


def test_a_switch_of_what_is_gone_says_so():
    with pytest.raises(AttributeError, match=r"Association\._never_there"):
        Switch("fgloc.estimation.sightings:Association._never_there", Returns(None)).place()


def test_without_the_gate_nothing_is_refused_and_the_probes_count_the_votes():
    world = moved_world()
    with watched(MECHANISMS) as counts:
        assert "gate" in refusals(world)
    assert counts["landmark_modes"] > 0
    assert counts["misread_ids"] == 0
    with BY_NAME["gate"].off():
        assert "gate" not in refusals(world)
    with BY_NAME["landmark_modes"].off():
        assert "gate" in refusals(world)
        assert "quarantined" not in refusals(world)


def test_what_is_returned_may_be_changed_by_the_caller():
    empty = Returns([])(None)
    empty().append(1)
    assert empty() == []


def test_a_mechanism_that_does_not_act_is_not_run(monkeypatch):
    on = result(acted={"misread_ids": 0, "doubtful_wheels": 3})
    asked = []

    def kept(name, make, *sources):
        asked.append(name)
        return on if "_on_" in name else result(2.0)

    monkeypatch.setattr("benchmarks.mechanisms.kept_scores", kept)
    assert outcome(Cell(3, "none", "misread_ids")) == on
    assert outcome(Cell(3, "none", "doubtful_wheels")).online.ate_mm == 2.0
    assert outcome(Cell(3, "none", "gate")).online.ate_mm == 2.0
    assert sum("_on_" not in name for name in asked) == 2
    assert file_name(Cell(3, "none", "gate")) != file_name(Cell(3, "none", "doubtful_wheels"))


def test_several_at_once_are_all_off_and_have_one_file():
    both = mechanism_of("gate+start_trimming")
    with both.off():
        assert place_search.MOST_STEPS == 0
        assert association.chi2_bound(0.99, 2) == math.inf
    assert file_name(Cell(3, "none", both.name)) != file_name(Cell(3, "none", "gate+misread_ids"))


def test_a_change_counts_where_it_is_large_enough():
    def worse(off, on):
        return {c.what for c in changes("none", [(off, on)]) if c.counts and c.size > 0.0}

    def better(off, on):
        return {c.what for c in changes("none", [(off, on)]) if c.counts and c.size < 0.0}

    assert worse(result(1.04), result()) == set()
    assert worse(result(1.06), result()) == {"online.ate"} == better(result(), result(1.06))
    assert worse(result(batch=2.0), result(batch=1.0)) == {"batch.ate"}
    assert worse(result(nees=1.4), result(nees=0.7)) == set()
    assert worse(result(nees=1.6), result()) == {"online.nees"} == worse(result(nees=0.5), result())
    assert better(result(nees=2.0), result(nees=4.0)) == {"online.nees"}
    assert worse(result(wrong_names=1), result()) == {"names"} == better(result(), result(missed_names=1))
    assert worse(Scores(failed="lost"), result()) == {"failed"}
    assert worse(result(lifted_nees=60.0), result(lifted_nees=1.0)) == {"nees_while_lifted"}
    assert worse(result(lifted_nees=60.0), result()) == set()
    assert worse(replace(result(), poses=90), result()) == {"poses"}
    assert outside(1.0) == 0.0
    assert outside(2.8) == pytest.approx(math.log(2.0))


def test_rows_are_ratios_of_means_and_those_without_value_say_why():
    off, on = [result(4.0), result(2.0)], [result(1.0), result(2.0)]
    assert ratio_of("a", off, on, of_errors("online", "ate_mm")) == Row("a", 2.0, 1.5, 2)
    row = ratio_of("a", [Scores(failed="lost"), result()], on, of_errors("online", "ate_mm"))
    assert row.value is None
    assert "lost" in row.reason


def test_the_table_is_well_formed_and_names_what_has_no_effect():
    chosen = scope("gate", "start_trimming", "misread_ids")
    on = result(batch=1.0, acted={"gate": 1}, slips=Slips((0.2,), (0.05,), (0.04, 0.01), path_m=500.0))
    found = found_in(chosen, on, result(batch=1.0))
    rows = [w.row(w.id, found) for w in wanted(chosen) if w.cells]
    assert len({row.id for row in rows}) == len(rows)
    values = {row.id: row.value for row in rows}
    assert values["off.gate.slip.online.ate_ratio"] == 1.0
    assert values["motion.recall_3cm"] == 0.5
    assert values["motion.false_per_km"] == 0.0
    assert values["none.batch.nees_over_3"] == 1.0
    assert values["kidnap.nees_while_lifted"] is None
    assert without_effect(chosen, found) == ["gate", "start_trimming", "misread_ids"]
    found = found_in(chosen, on, result(1.2, batch=0.5))
    assert without_effect(chosen, found) == []
    assert "none.online.ate: 1 -> 1.2" in report(chosen, found)


def test_a_mechanism_is_taken_away_where_it_is_for_something_and_elsewhere_only_if_nothing_gets_worse_there(
    monkeypatch,
):
    chosen, ran = scope("place_search", "misread_ids"), []

    def run_all(cells, jobs):
        ran.append({(cell.case, cell.off) for cell in cells})
        return {
            cell: result(2.0 if cell.off == "place_search" or (cell.case == "slip" and cell.off) else 1.0)
            for cell in cells
        }

    monkeypatch.setattr(mechanisms, "run_all", run_all)
    found = mechanisms.taken_away(chosen, {}, 1)
    assert [{pair for pair in pairs if pair[1]} for pairs in ran] == [
        {("kidnap", "place_search"), ("none", "misread_ids")},  # ids30, which it is for, is not in the scope
        {("slip", "misread_ids")},
    ]
    assert without_effect(chosen, found) == []
    assert "kidnap.online.ate: 1 -> 2" in report(chosen, found)
    assert without_effect(chosen, {cell: result() for cell in found}) == ["place_search", "misread_ids"]


def test_the_command_line_chooses_split_seeds_and_rows():
    options, rest = mechanisms.parsed(["--split", "validation", "--rows", "off.gate.,motion.", "--quick"])
    assert (options.split, rest) == ("validation", ["--quick"])
    assert options.wants("motion.delay_s")
    assert not options.wants("off.gate_keeper.none")
    assert mechanisms.scope(False, options).seeds == (41, 42, 43)
    assert mechanisms.scope(False, options).off_seeds == (41, 42)
    assert mechanisms.scope(False, replace(options, seeds=10)).off_seeds == (41, 42, 43)
    quick = mechanisms.scope(True, options)
    assert (quick.seeds, quick.cases) == ((41,), mechanisms.QUICK_CASES)
