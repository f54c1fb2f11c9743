"""docs/faults.md and the tests named after its rows agree."""

from fault_rows import PAGE, faults_tested, numbers, with_tests


def test_each_fault_has_tests_and_each_test_a_fault():
    page = PAGE.read_text(encoding="utf-8")
    rows = numbers(page)
    assert sorted(rows) == list(range(1, len(rows) + 1))
    assert len(rows) > 70
    assert sorted(faults_tested()) == sorted(rows)


def test_the_catalogue_names_the_tests_that_are_there():
    page = PAGE.read_text(encoding="utf-8")
    assert page == with_tests(page), "out of date: run `python tests/fault_rows.py`"


def test_a_test_may_cover_two_faults():
    assert any("faults_diagnosis" in name for name in faults_tested()[52])
    assert any("localizer" in name for name in faults_tested()[68])
