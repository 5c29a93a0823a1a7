# make demo and make test need nothing but this folder, Debian 12 (or a relative) and root or sudo.
#
#   make demo        run the shipped model on real frames; pictures in demo-out/
#   make test        build everything, run the C++ and the Python tests
#   make setup       only install: system packages, .venv, the built package in it
#   make lint        clang-format, clang-tidy, ruff, mypy
#   make format      let clang-format and ruff rewrite the sources
#   make bench       C++ micro-benchmarks
#   make sanitize    C++ tests under address and undefined-behaviour sanitizers (its own Debug build)
#   make clean       remove what was built (not .venv; `rm -rf .venv` for that)
#
# Variables: PYTHON=python3.12   TORCH=torch==2.9.1   VENV=.venv   BUILD=build/release
#            TORCH_INDEX=https://download.pytorch.org/whl/cpu   (CPU wheels, a tenth of the size)

PYTHON ?= python3
VENV ?= .venv
BUILD ?= build/release
# The only place that names the torch version we build against by default.
TORCH ?= torch==2.13.0
TORCH_INDEX ?=

export PYTHON
export PIP_DISABLE_PIP_VERSION_CHECK = 1
export PATH := $(abspath $(VENV))/bin:$(PATH)
export CMAKE_BUILD_PARALLEL_LEVEL ?= $(shell nproc)

APT_BUILD := make g++ python libopencv-dev libeigen3-dev libcli11-dev libspdlog-dev libyaml-cpp-dev
# The last two let the simulator render off screen; its tests skip without.
APT_TEST := libgtest-dev libosmesa6 libgl1
APT_BENCH := libbenchmark-dev
APT_LINT := clang-format clang-tidy

PY := $(VENV)/bin/python
STAMP := $(VENV)/.stamp
# What goes into the wheel; folders too, so that a deleted file counts as a change.
SOURCES := CMakeLists.txt pyproject.toml tools/torch_requirement.py \
           $(shell find cpp python -name __pycache__ -prune -o -print)
CONFIGURE_IN = cmake -S . -G Ninja -DCMAKE_BUILD_TYPE=Release -DPython_EXECUTABLE=$(abspath $(PY)) \
               -DAJNA_BUILD_PYTHON=ON -B
CONFIGURE = $(CONFIGURE_IN) $(BUILD)

.PHONY: help setup demo test lint format bench sanitize clean always apt apt-test
.DELETE_ON_ERROR:
help:
	@sed -n '/^#   make/s/^#   //p' Makefile

setup: $(STAMP)/package

demo: $(STAMP)/package
	$(PY) tools/demo.py

test: apt-test $(STAMP)/package-test
	$(CONFIGURE) -DAJNA_BUILD_TESTS=ON -DAJNA_BUILD_APPS=ON > $(BUILD)/configure.log || (cat $(BUILD)/configure.log; false)
	cmake --build $(BUILD)
	@sh tools/test.sh $(BUILD) $(PY)

lint: apt-test $(STAMP)/package-lint
	@sh tools/apt.sh $(APT_LINT)
	@# clang-tidy wants the command of every single source.
	@mkdir -p build/lint
	@$(CONFIGURE_IN) build/lint -DAJNA_UNITY_BUILD=OFF > build/lint/configure.log || (cat build/lint/configure.log; false)
	@sh tools/lint.sh build/lint $(VENV)/bin

format: $(STAMP)/package-lint
	@sh tools/apt.sh $(APT_LINT)
	find cpp tests -name '*.[ch]pp' -print0 | xargs -0 clang-format -i
	$(VENV)/bin/ruff check --fix --exit-zero .
	$(VENV)/bin/ruff format .

bench: $(STAMP)/package
	@sh tools/apt.sh $(APT_BENCH)
	$(CONFIGURE) -DAJNA_BUILD_BENCH=ON
	cmake --build $(BUILD)
	sh tools/bench.sh $(BUILD)

sanitize: apt-test $(STAMP)/torch
	cmake --preset asan -DPython_EXECUTABLE=$(abspath $(PY))
	cmake --build --preset asan
	ctest --preset asan

clean:
	rm -rf build demo-out

# --- installation, step by step; each step leaves a stamp in $(VENV) and is skipped while its inputs stay the same ---

apt:
	@sh tools/apt.sh $(APT_BUILD)
apt-test: apt
	@sh tools/apt.sh $(APT_TEST)

$(STAMP)/venv: | apt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(f"{sys.executable} is Python {v[0]}.{v[1]}; Ajna needs 3.10 or newer: make PYTHON=python3.x" if v < (3, 10) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install -q "scikit-build-core>=1.1,<2" "cmake>=3.24" ninja
	@mkdir -p $(STAMP) && touch $@

# Stamps whose input is a variable hold its value and change only with it.
$(STAMP)/torch: $(STAMP)/venv always
	@echo "$(TORCH) $(TORCH_INDEX)" | cmp -s - $@ || { set -ex; \
	  $(PY) -m pip install $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX) )"$(TORCH)"; \
	  echo "$(TORCH) $(TORCH_INDEX)" > $@; }

# Compile with Ninja's progress to watch; scikit-build-core then packs the same build folder.
$(STAMP)/package: $(STAMP)/torch $(SOURCES) | apt
	@mkdir -p $(BUILD)
	$(CONFIGURE) > $(BUILD)/configure.log || (cat $(BUILD)/configure.log; false)
	cmake --build $(BUILD) --target ajna_core
	rm -rf build/dist
	$(PY) -m pip wheel -q --no-deps --no-build-isolation --config-settings=build-dir=$(BUILD) -w build/dist .
	$(PY) -m pip install -q build/dist/ajna-*.whl
	$(PY) -m pip install -q --no-deps --force-reinstall build/dist/ajna-*.whl
	@touch $@

# The extras of pyproject.toml on top: what the tests and the linters need.
$(STAMP)/package-test $(STAMP)/package-lint: $(STAMP)/package-%: $(STAMP)/package
	$(PY) -m pip install -q "$$(echo build/dist/ajna-*.whl)[$*,test]"
	@touch $@

always:
