# Every target sets up what it needs; `make help` lists them.

# The first interpreter that runs and is new enough. 3.11 comes first: PyBullet has wheels for it.
PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$p" && break; done)
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := drake,pybullet,dev,ray
# Two processes of one thread each: what the tests measure does not depend on their order, and the numerical
# libraries' own threads only get in each other's way on problems this small.
WORKERS ?= 2
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS)
SOURCES := sb3_mpc_policy envs benchmarks tests

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow check format benchmark benchmark-full benchmark-solvers benchmark-contacts results docs clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 20

setup: $(VENV)/.installed ## make .venv with everything the other targets need

$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt
	@if [ -z "$(PYTHON)" ]; then \
		echo "Python 3.11 or newer is needed, and no such python3 is on the PATH; name one: make setup PYTHON=/path/to/python3.11" >&2; \
		exit 1; fi
	@"$(PYTHON)" -c 'import sys; v = sys.version_info; v < (3, 11) and sys.exit("Python 3.11 or newer is needed; $(PYTHON) is %d.%d" % v[:2])'
	@echo "Making $(VENV) with $$("$(PYTHON)" --version) ..."
	@"$(PYTHON)" -m venv --clear $(VENV)
	@echo "Installing the package with its simulators and tools (2.5 GB on disk, some minutes) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@
	@echo "Ready: $(BIN)/python"

demo: setup ## train on the cart-pole with soft walls, score and draw the result into demo/
	@OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.demo --output demo

test: setup ## run the tests, without the slow ones
	$(PYTEST) -m "not slow"

test-slow: setup ## run the slow tests
	$(PYTEST) -m slow

check: setup ## format, lint, types
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/mypy

format: setup ## rewrite the sources as `check` wants them
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

benchmark: setup ## a small version of every experiment, in some minutes, into build/benchmark/small/
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.run --small --jobs $(WORKERS)

benchmark-full: setup ## every experiment of docs/results.md (hours; goes on where it was stopped), then the page
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.run --jobs $(WORKERS)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.probes.robustness
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.physics
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.contact_matters
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.results_page

results: setup ## docs/results.md and its figures, from the committed result files alone
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.results_page

benchmark-solvers: setup ## the solvers' speed and accuracy and the relaxation's quality, into benchmarks/results/
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.solver_speed
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.solver_speed --latency --training
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.solver_accuracy
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.relaxation
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.warm_start

benchmark-contacts: setup ## how well contacts are found, in random systems and in training, into benchmarks/results/
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.contact_identification --jobs $(WORKERS)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.learned_contacts --jobs $(WORKERS)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.learned_contacts --jobs $(WORKERS) --variant linear --eval-every 3840 \
		--output benchmarks/results/learned_contacts_linear.csv
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.learned_contacts --jobs $(WORKERS) --env CartPoleSoftWallsHardDrake-v0 \
		--episodes 10 --output benchmarks/results/learned_contacts_drake.csv
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.fit_speed

docs: setup ## build the documentation into docs/_build/html
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/python -m sphinx -W -b html docs docs/_build/html

clean: ## remove everything the targets made, the environment too
	rm -rf $(VENV) demo docs/_build build dist *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
