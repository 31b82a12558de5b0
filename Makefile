# make demo | test | slow | sample | check: each makes its own environment in .venv first, from nothing.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DEVELOPED := $(VENV)/.developed
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal

.PHONY: demo test slow sample check fmus benchmark reproduce format clean

demo: fmus ## the paper's quarter car: two FMU processes, one master, over Zenoh
	$(BIN)/master-node run examples/quarter_car/displacement.toml --output demo_results

test: $(DEVELOPED) fmus ## all tests but the slow ones
	$(PYTEST) -m "not slow"

slow: $(DEVELOPED) fmus ## the slow tests: more seeds, more cycles, more hosts
	$(PYTEST) -m slow

SEED := $(shell git rev-parse --short=8 HEAD 2>/dev/null)
sample: $(DEVELOPED) fmus ## some of the slow tests, others for each commit
	$(PYTEST) -m slow --sample 2 --seed "$(SEED)"

POSIX := 'slave_node/states/(fork_|channel)'
check: $(DEVELOPED) ## linter, formatter, type checker for three platforms, import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --platform darwin --cache-dir .mypy_cache/darwin
	$(BIN)/mypy --platform win32 --cache-dir .mypy_cache/win32 --exclude $(POSIX) --follow-imports silent
	$(BIN)/lint-imports --no-cache

fmus: $(INSTALLED) ## compile the example FMUs
	$(BIN)/python examples/quarter_car/build.py
	$(BIN)/python examples/oscillators/build.py
	$(BIN)/python examples/no_rollback/build.py

benchmark: $(DEVELOPED) fmus ## the tables of docs/benchmarks.md
	$(BIN)/python -m benchmarks

reproduce: $(DEVELOPED) fmus ## the pages and pictures of docs/reproduction
	$(BIN)/python -m benchmarks.reproduction

format: $(DEVELOPED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(INSTALLED): pyproject.toml ## the package alone
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(DEVELOPED): $(INSTALLED) ## and the development tools
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) demo_results results examples/*/*.fmu examples/*/*.ssp
