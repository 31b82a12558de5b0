# make demo | test | check: each makes its own environment in .venv first, from nothing.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test check fmus benchmark reproduce format clean

demo: fmus ## the paper's quarter car: two FMU processes, one master, over Zenoh
	$(BIN)/master-node run examples/quarter_car/displacement.toml --output demo_results

test: fmus ## the whole test suite
	$(BIN)/python -m pytest -n 2 --dist loadgroup

check: $(STAMP) ## linter, formatter, type checker, import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

fmus: $(STAMP) ## compile the example FMUs
	$(BIN)/python examples/quarter_car/build.py
	$(BIN)/python examples/oscillators/build.py
	$(BIN)/python examples/no_rollback/build.py

benchmark: fmus ## the tables of docs/benchmarks.md
	$(BIN)/python -m benchmarks

reproduce: fmus ## the pages and pictures of docs/reproduction
	$(BIN)/python -m benchmarks.reproduction

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) demo_results results examples/*/*.fmu examples/*/*.ssp
