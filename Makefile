PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Touched when the install is complete: the second `make install` has nothing to do.
STAMP := $(VENV)/.installed
DEMO := demo
BENCH := bench
AGAINST :=
MUTANTS := 10000
KILLS := 60
SIGNALS := 10
WORLDS := 60

.DEFAULT_GOAL := help
.PHONY: help install demo bench test soak test-coverage lint format docs

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## */\t/' | expand -t 16

install: $(STAMP)  ## the package and its tools in .venv

# torch comes first and by the constraint alone: nothing after it may choose another build. pip would compile on one core,
# and packages' own tests too, of which torch has some for other Pythons.
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --no-compile -c constraints.txt torch
	$(BIN)/python -m pip install --no-compile -c constraints.txt -e '.[dev]'
	-$(BIN)/python -m compileall -qq -j 0 -x '/tests/|/testing/_internal/' $(VENV)/lib
	touch $@

demo: $(STAMP)  ## simulate a street, map it, compare the map with its survey; everything under demo/
	rm -rf $(DEMO)/street
	$(BIN)/crowdmap simulate $(DEMO)/street --world street --journeys 8 --seed 1
	$(BIN)/crowdmap optimize $(DEMO)/street --out $(DEMO)/run --overwrite

# `make bench AGAINST=../older` runs another checkout beside it, in turns.
bench: $(STAMP)  ## time and memory of each stage of the main job, 25 drives of a kilometre
	test -d $(BENCH) || $(BIN)/crowdmap simulate $(BENCH) --world suburb --journeys 25 --length-m 1000 --vehicles 8 --seed 0
	$(BIN)/crowdmap benchmark stages $(BENCH) $(if $(AGAINST),--against $(AGAINST))

# Two cores: half of the mutants each. What fails stays in soak-failures/.
soak: $(STAMP)  ## destroyed inputs, kills, signals, worlds at random: no traceback, no hang, nothing lost without a word
	$(BIN)/python scripts/soak.py mutants --count $(MUTANTS) --processes 2
	$(BIN)/python scripts/soak.py kills --count $(KILLS)
	$(BIN)/python scripts/soak.py signals --count $(SIGNALS)
	$(BIN)/python scripts/soak.py worlds --count $(WORLDS)

# Each core has a process of its own, and files stay whole: their fixtures are made once. Annotations of shapes are checked.
# Dozens of tests begin programs: with bytecode at hand, each of them begins half a second sooner. Some have two threads: where
# both cores have work, threads that wait by spinning make a benchmark of one second take fifteen.
TESTS := PYTHONDONTWRITEBYTECODE= CROWDMAP_CHECK_SHAPES=1 OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE $(BIN)/python -m pytest -q -n auto --dist loadfile

test: $(STAMP)  ## the test suite
	$(TESTS)

test-coverage: $(STAMP)  ## the test suite, and which lines it does not reach
	$(TESTS) --cov=crowdmap_torch --cov-report=term-missing:skip-covered

lint: $(STAMP)  ## ruff and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads 2

format: $(STAMP)  ## format and sort imports
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# No link may lead nowhere. Needs no network.
docs: $(STAMP)  ## the pages as a site, in site/
	$(BIN)/python docs/configuration.py --write
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -q -d site
