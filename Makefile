# quadjax: `make train` and `make test` set everything up on a fresh clone; only Python 3.11+ and
# make are needed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := test,verify,tensorboard,sweep,sweep-postgresql,gym,notebook

.DEFAULT_GOAL := help
.PHONY: help setup train train-indi test lint format benchmark notebooks clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

$(VENV)/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "quadjax needs Python 3.11 or newer; name one with make PYTHON=..."; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@touch $@

setup: $(VENV)/.ready ## install quadjax and what it needs into .venv

train: setup ## train the E2E policy on this machine and print its lap table
	$(BIN)/python scripts/train.py configs/e2e_shac.yaml --resume

train-indi: setup ## the same for the INDI policy
	$(BIN)/python scripts/train.py configs/indi.yaml --resume

test: setup ## lint and run all tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest -n auto --dist loadfile

lint: setup ## ruff alone
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: setup ## let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: setup ## steps per second and memory on this machine
	$(BIN)/python scripts/benchmark.py

notebooks: setup ## execute the notebooks in place
	$(BIN)/python scripts/notebooks.py

clean: ## remove the environment and caches, not the runs
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache
