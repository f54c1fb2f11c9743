# From a fresh clone each target does everything: it makes .venv, installs what it needs, and runs.
# Another interpreter: `make demo PYTHON=python3.12`. No CUDA build of torch: see CONTRIBUTING.md.
PYTHON ?= python3
OTHER ?= python3.13
JOBS ?= 2
BENCHMARKS ?= steps real installed identification gross
QUICK ?= $(addprefix tests/,test_layout.py test_fault_catalogue.py docs files intake view graph/test_graph.py graph/test_observation.py)
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
BIN := .venv/bin

# One thread per process: the work is many small problems, and JOBS processes share the cores.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Tests and examples start many processes: each would compile all it imports anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo follow quick other test test-all coverage check equal format bench docs docs-test dist clean

help:
	@echo "make demo      smooth the bundled recording, batch and online, into demo-out/"
	@echo "make follow    a simulated robot drives itself along waypoints: a picture and a table, in follow-out/"
	@echo "make quick     those tests that take less than a minute together"
	@echo "make other     the same with another interpreter: make other OTHER=python3.13"
	@echo "make test      all but the slow tests: some minutes"
	@echo "make test-all  all tests"
	@echo "make coverage  the tests of \`make test\`, and which lines they execute, in htmlcov/"
	@echo "make check     ruff format, ruff, mypy"
	@echo "make equal     whether short runs of all kinds give the committed results, bit by bit"
	@echo "make dist      sdist and wheel in dist/, checked in a fresh environment outside the repository"
	@echo "make docs      the documentation as a site, in site/"
	@echo "make docs-test run every command and piece of code in README and docs/, and the notebooks"
	@echo "make bench     the figures of docs/benchmarks.md"
	@echo "make clean     remove .venv, caches, demo-out/ and follow-out/"

demo: .venv/.base
	$(BIN)/fgloc demo

follow: .venv/.sim
	$(BIN)/fgloc sim follow-demo --out follow-out --workers $(JOBS)

quick: .venv/.dev
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow" $(QUICK)

# In an environment of its own and without torch, of which another interpreter needs another build.
other: .venv-other/.made
	.venv-other/bin/python -m pytest -n $(JOBS) --dist worksteal -m "not slow" $(filter-out tests/docs,$(QUICK))

.venv-other/.made: pyproject.toml constraints.txt
	$(OTHER) -m venv .venv-other
	.venv-other/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt \
		-e '.[sim,sweep,live,view]' evo hypothesis pytest-xdist
	@touch $@

test: .venv/.dev
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow"

test-all: .venv/.docs
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

coverage: .venv/.dev
	rm -rf htmlcov .coverage .coverage.*
	$(BIN)/python -m coverage run -m pytest -n $(JOBS) --dist worksteal -m "not slow" $(COVERED)
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage html --quiet
	$(BIN)/python -m coverage report

check: .venv/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

equal: .venv/.dev
	$(BIN)/python -m benchmarks.equal --workers $(JOBS)

format: .venv/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: .venv/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-test: .venv/.docs
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal tests/docs

bench: .venv/.dev
	for name in $(BENCHMARKS); do $(BIN)/python -m benchmarks.$$name; done

# The wheel is checked twice: with all extras by the tests, and with nothing but what pip brings along.
dist: .venv/.dev
	rm -rf dist build
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python -m pytest -m slow tests/test_wheel.py
	place=$$(mktemp -d); trap 'rm -rf "$$place"' EXIT; $(PYTHON) -m venv $$place/venv; \
	$$place/venv/bin/python -m pip install --quiet -c constraints.txt dist/*.whl; \
	cd $$place; venv/bin/fgloc --version; venv/bin/fgloc demo

clean:
	rm -rf .venv .venv-other htmlcov .coverage .coverage.* build dist site demo-out follow-out .pytest_cache .mypy_cache .ruff_cache *.egg-info

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' || \
		{ echo "error: $(PYTHON) is not Python 3.11 to 3.13; give one: make demo PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/.base: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e .
	@touch $@

.venv/.sim: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[sim]'
	@touch $@

.venv/.dev: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch .venv/.base .venv/.sim $@

.venv/.docs: .venv/.dev
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[dev,docs]'
	@touch $@
