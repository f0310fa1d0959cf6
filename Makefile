PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Touched when the install is complete: the second `make install` has nothing to do.
STAMP := $(VENV)/.installed
DEMO := demo

.DEFAULT_GOAL := help
.PHONY: help install demo test lint format

help:  ## this list
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## */\t/' | expand -t 12

install: $(STAMP)  ## the package and its tools in .venv

# torch comes first and by the constraint alone: nothing after it may choose another build.
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -c constraints.txt torch
	$(BIN)/python -m pip install -c constraints.txt -e '.[dev]'
	touch $@

demo: $(STAMP)  ## simulate a street, map it, compare the map with its survey; everything under demo/
	rm -rf $(DEMO)/street
	$(BIN)/python scripts/simulate.py $(DEMO)/street --world street --journeys 8 --seed 1
	$(BIN)/python scripts/optimize.py $(DEMO)/street --out $(DEMO)/run --overwrite

test: $(STAMP)  ## the test suite
	$(BIN)/python -m pytest -q

lint: $(STAMP)  ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: $(STAMP)  ## format and sort imports
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
