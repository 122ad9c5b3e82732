# Development commands; `make` alone lists them. Every target works on a fresh clone.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
# Written last, so that an install that failed or was interrupted leaves none.
STAMP := $(VENV)/.installed

# True of a Python that this package runs on and that can make a virtual environment.
PYTHON_OK := import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))

# The Python that makes .venv: the first of these names that runs and is suitable, or `make venv PYTHON=...`.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.10 python3; do \
	if "$$p" -c '$(PYTHON_OK)' >/dev/null 2>&1; then echo "$$p"; break; fi; done)

# `make venv TORCH=cpu` takes torch's builds for a CPU, of 0.2 instead of 3 GB; empty: those of the package index.
TORCH ?=

# Processes that share the test files out; a test uses one thread.
WORKERS ?= 2

# Extra arguments for pytest or the demo: make test ARGS="-k geometry -x", make demo ARGS=--fresh
ARGS ?=

# Folder with the captures of `make results`, by their names there.
DATA ?= captures

.PHONY: help venv demo test lint docs build wheel figures gallery matrix results clean

help: ## List these commands
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

venv: $(STAMP) ## Make .venv and install the package in it, editable, with its pinned dependencies

$(STAMP): pyproject.toml constraints.txt
	@rm -f $@
	@if ! { $(BIN)/python -c '$(PYTHON_OK)' && $(BIN)/python -m pip --version; } >/dev/null 2>&1; then \
		python="$(PYTHON)"; \
		if [ -z "$$python" ] || ! "$$python" -c '$(PYTHON_OK)' >/dev/null 2>&1; then \
			echo "make: no Python 3.10, 3.11 or 3.12 with the venv module was found$${python:+ as $$python}; install one or name it with PYTHON=/path/to/python." >&2; \
			exit 1; \
		fi; \
		echo "Making $(VENV) with $$python"; \
		"$$python" -m venv --clear $(VENV); \
	fi
	@if [ "$(TORCH)" = cpu ]; then \
		$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps \
			--index-url https://download.pytorch.org/whl/cpu \
			$$(sed -nE '/^torch(vision)?==/p' constraints.txt); \
	fi
	@echo "Installing the package and its development tools in $(VENV)"
	@$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: venv ## Make a street, learn it, evaluate it and show what came of it, in demo/ (ARGS="..." as in demo --help)
	@$(BIN)/python examples/demo.py $(ARGS)

test: venv ## Run the tests (ARGS="..." goes to pytest)
	$(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

lint: venv ## Check style, formatting and types
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m pyright

docs: venv ## Build the documentation site in site/
	@$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(BIN)/python -m mkdocs build --quiet --strict

build: venv ## Build the sdist and the wheel in dist/
	rm -rf dist
	$(BIN)/python -m build

wheel: build ## Build, and run the wheel's commands in an otherwise empty environment
	.ci/wheel

figures: venv ## Draw the figures of the documentation anew, from the demo
	$(BIN)/python examples/figures.py

matrix: venv ## Run ordinary captures of 2 to 400 images through the commands (hours) and write docs/results/matrix.md
	$(BIN)/python benchmarks/matrix.py --folder /tmp/mmpi-matrix $(ARGS)

gallery: venv ## Train four procedural scenes and write docs/gallery.md with their pictures
	$(BIN)/python examples/gallery.py $(ARGS)

results: venv ## Make every number of README.md and docs/results (hours; what is finished is kept): DATA=captures/
	$(BIN)/python benchmarks/accuracy.py
	$(BIN)/python benchmarks/results.py --data $(DATA) --threads 1 $(ARGS)

clean: ## Remove build products and caches (not .venv)
	rm -rf build dist site *.egg-info .pytest_cache .ruff_cache
	find mmpi_* benchmarks examples tests -name __pycache__ -type d -prune -exec rm -rf {} +
