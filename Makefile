# Everything a new machine needs: `make test`, `make demo` and so on install what is missing and then do their work.
# Needs GNU make, bash and a Python of 3.11 or later; name another one with `make PYTHON=/path/to/python3.12 test`.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
MAKEFLAGS += --no-builtin-rules --no-print-directory

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?=
PYTEST_ARGS ?=
BENCH_ARGS ?=
DEMO ?= demo

# Debian packages. Headless rendering needs EGL and OpenGL by their sonames and a driver: Mesa's software rasteriser will do.
GL_PACKAGES := libegl1 libgl1 libgl1-mesa-dri

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help
help: ## this list
	@grep -hE '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:.*## /\t/' | expand -t 13

.PHONY: install
install: $(VENV)/.installed ## clipmap and its tools in .venv

.PHONY: demo
demo: $(VENV)/.installed $(VENV)/.headless-gl ## build, serve and render a built-in terrain: demo/demo.png
	@$(BIN)/clipmap demo -o $(DEMO)

.PHONY: test
test: $(VENV)/.installed $(VENV)/.headless-gl ## all tests on all processors; PYTEST_ARGS="-k lattice" runs some
	@$(BIN)/pytest -n auto $(PYTEST_ARGS)

.PHONY: lint
lint: $(VENV)/.installed ## style, types and import directions
	@status=0
	for tool in 'ruff check' 'ruff format --check' mypy lint-imports; do $(BIN)/$$tool || status=1; done
	exit $$status

.PHONY: bench
bench: $(VENV)/.installed ## clipmap beside vips, GDAL and OpenImageIO, half an hour: writes the tables of docs/PERFORMANCE.md
	@$(BIN)/python tests/bench/peers.py $(BENCH_ARGS)

.PHONY: docs
docs: $(VENV)/.installed ## write the generated parts of docs/ anew
	@for script in docs/generate/*.py; do echo "$$script"; $(BIN)/python "$$script"; done

.PHONY: clean
clean: ## remove what make and the tools made, .venv included
	@rm -rf $(VENV) demo out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A directory without pip is what a failed attempt leaves behind: Debian keeps ensurepip in a package of its own.
$(BIN)/pip:
	@for candidate in $(or $(PYTHON),python3.11 python3.12 python3.13 python3 python); do
	  if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python="$$candidate"; break; fi
	done
	if [ -z "$${python:-}" ]; then
	  echo "make: no Python 3.11 or later found; install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1
	fi
	if ! "$$python" -c 'import venv, ensurepip' 2>/dev/null; then
	  if [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
	    echo "make: $$python has no module venv; install it first (Debian, Ubuntu: apt-get install python3-venv)" >&2; exit 1
	  fi
	  echo "make: $$python has no module venv: installing python3-venv" >&2
	  apt-get -qq update
	  DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends python3-venv >/dev/null
	fi
	rm -rf $(VENV)
	"$$python" -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/pip
	@echo "make: installing clipmap and its tools into $(VENV)"
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

# The stamp means: an EGL context could be made. Without it the tests that render are skipped and the rest goes on.
$(VENV)/.headless-gl: $(VENV)/.installed
	@probe() { $(BIN)/python -c 'import moderngl; print(moderngl.create_context(standalone=True, backend="egl").info["GL_RENDERER"])' 2>/dev/null; }
	if ! renderer="$$(probe)" && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
	  echo "make: no headless OpenGL: installing $(GL_PACKAGES)" >&2
	  apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends $(GL_PACKAGES) >/dev/null || true
	fi
	if [ -n "$${renderer:-}" ] || renderer="$$(probe)"; then
	  echo "make: headless OpenGL on $$renderer"; touch $@
	else
	  echo "make: no headless OpenGL (Debian, Ubuntu: apt-get install $(GL_PACKAGES)); tests that render are skipped" >&2
	fi
