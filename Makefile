# make demo | test | lint | clean; each makes .venv first where it is missing or older than what it depends on.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ARGS ?=

.PHONY: demo test lint format clean

demo: $(STAMP)
	$(BIN)/python -m training demo $(ARGS)

# without the tests marked slow; `make test ARGS="-m slow"` runs those (a later -m wins)
test: $(STAMP)
	$(BIN)/python -m pytest -q -m "not slow" $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -c constraints.txt -e '.[learn,video,cluster,export,dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find tensegrity_gym surrogate training tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
