# `make demo` and `make test` set up all they need; `make help` lists the rest.
VENV ?= .venv
export VENV
PYTHON_BIN := $(VENV)/bin/python
DEMO_ARGS ?=
# One thread a process and no spinning: physics has threads of its own, and tests run beside each other.
# OpenMP's busy waiting would starve the physics.
THREADS := OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE GOMP_SPINCOUNT=0
WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help venv demo train-demo docs test test-slow lint format clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

venv: ## make the virtual environment and check headless GL
	@scripts/setup.sh

demo: venv ## show on one page what the pretrained weights make of a person they have not seen
	$(THREADS) $(PYTHON_BIN) -m egopose.demo $(DEMO_ARGS)

train-demo: venv ## train a policy on the default data, evaluate it, show a table and a video
	$(PYTHON_BIN) -m egopose.demo train=true $(DEMO_ARGS)

docs: venv ## build the docs as a site in outputs/site; a broken link ends it (the tests do this too)
	NO_MKDOCS_2_WARNING=1 $(PYTHON_BIN) -m mkdocs build --strict

lint: venv ## style and types
	$(PYTHON_BIN) -m ruff check .
	$(PYTHON_BIN) -m ruff format --check .
	$(PYTHON_BIN) -m mypy

test: lint ## style, types and the tests
	$(THREADS) $(PYTHON_BIN) -m pytest -n $(WORKERS) --durations=10

test-slow: venv ## the long tests
	$(THREADS) $(PYTHON_BIN) -m pytest -n $(WORKERS) -m slow --durations=10

format: venv ## rewrite the sources in the project's style
	$(PYTHON_BIN) -m ruff format .
	$(PYTHON_BIN) -m ruff check --fix .

clean: ## remove the virtual environment and caches
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis
