# make compare   compare trigger policies on test sequences: a table, curves, a page
# make test      ruff, mypy and the whole test suite
# make bench     time every stage, the networks and their training; writes docs/performance.md and others
# make realism   measure how close the scenes are to the published figures
# Every target first creates .venv and installs what it needs, once.

PYTHON ?= python3
WORKERS ?= 2
BIN := .venv/bin
COMPILING = find nl_env -name '*.nbi' | grep -q . || echo "compiling kernels, once (about a minute)" >&2

.PHONY: compare test lint bench realism recompile clean
.DELETE_ON_ERROR:

compare: .venv/.report
	@$(COMPILING)
	$(BIN)/python scripts/compare.py --overwrite

test: export NUMBA_NUM_THREADS := 1
test: export OMP_NUM_THREADS := 1
test: lint
	@$(COMPILING)
	$(BIN)/python -m pytest -n $(WORKERS)

lint: .venv/.dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: .venv/.dev
	@$(COMPILING)
	$(BIN)/python benchmarks/stages.py --json docs/performance.json --markdown docs/performance.md
	$(BIN)/python benchmarks/extrapolators.py --markdown docs/extrapolators.md > docs/extrapolators.json
	$(BIN)/python benchmarks/inference.py --markdown docs/runtimes.md > docs/runtimes.json
	$(BIN)/python benchmarks/training.py --markdown docs/training.md > docs/training.json
	$(BIN)/python benchmarks/replay.py --markdown docs/data.md > docs/replay.json

realism: .venv/.report
	@$(COMPILING)
	$(BIN)/python scripts/realism.py --overwrite

# Numba's cache watches each kernel's own file: after editing one that others call, start afresh.
recompile:
	find nl_env -name '*.nb[ic]' -delete

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# .venv/.EXTRA records that the extra EXTRA of pyproject.toml is installed, at the tested versions.
.venv/.%: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[$*]'
	touch $@

$(BIN)/python:
	$(PYTHON) -m venv .venv
