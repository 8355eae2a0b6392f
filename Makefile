# `make demo` and `make test` need nothing but Python 3.11+, make and a C++ compiler; both make the environment first, the
# demo with what using the program takes, the tests with the developers' tools as well.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# On Linux the package index's torch is a CUDA build of several GB. A CPU-only machine can save them with
#   make demo PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu"
PIP_FLAGS ?=
# Python files are compiled when they are imported: to compile all that is installed takes half a minute.
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt $(PIP_FLAGS)
NATIVE := CMakeLists.txt $(shell find avatar/csrc -name '*.cpp' -o -name '*.h')
DEMO ?= demo
STRESS_EXAMPLES ?= 100000
STRESS_MINUTES ?= 60
FUZZ_CASES ?= 20000

.PHONY: help setup setup-dev demo test test-all mutate stress stress-view fuzz sanitize wasm arm64 gpu-check paper-smoke check format smoke wheel clean
help: ## show this list
	@sed -n 's/^\([a-z0-9-]*\):.*## \(.*\)/  make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "%-18s %s\n", $$1, $$2}'

setup: $(VENV)/.installed ## make .venv: pinned packages for use, and the compiled core

setup-dev: $(VENV)/.installed-dev ## the same with what tests, checks and wheels need

demo: setup ## make two people, train an avatar of one, evaluate it and let the other drive it
	$(BIN)/avatar demo $(DEMO)

# A worker for each core, with one thread, since most tests have work for one; a worker that is done takes tests of another.
PYTEST := OMP_NUM_THREADS=1 AVATAR_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal --durations=25
test: setup-dev ## run the tests but the slow ones and those that need a browser (five minutes on two cores)
	$(PYTEST) -m "not slow and not chromium"

test-all: setup-dev ## run all tests
	$(PYTEST)

mutate: setup-dev ## plant mistakes in the program, one at a time, and see that tests catch each (ten minutes)
	OMP_NUM_THREADS=1 AVATAR_THREADS=1 $(BIN)/python scripts/mutate.py

stress: setup-dev ## draw a hundred thousand random scenes, and poisoned ones (STRESS_EXAMPLES=100000)
	AVATAR_STRESS_EXAMPLES=$(STRESS_EXAMPLES) $(BIN)/python -m pytest -q --timeout=0 tests/stress

stress-view: setup-dev ## let 50 hostile clients at a viewer for an hour (STRESS_MINUTES=60)
	AVATAR_STRESS_MINUTES=$(STRESS_MINUTES) $(BIN)/python -m pytest -q -rP --timeout=0 tests/stress/test_viewer_stress.py

# The page's avatar files, a stream's packets and a viewer's messages get half as many each.
fuzz: setup-dev ## give every reader damaged and hostile files (FUZZ_CASES=20000 in all)
	AVATAR_FUZZ_CASES=$(FUZZ_CASES) AVATAR_FUZZ_TABLE=docs/bench/fuzz.md $(BIN)/python -m pytest --timeout=0 -rP tests/fuzz
	AVATAR_FUZZ_CASES=$(FUZZ_CASES) $(BIN)/python -m pytest --timeout=0 -k damaged tests/view tests/export/test_web_core.py

sanitize: setup-dev ## run the compiled core's tests with AddressSanitizer and UndefinedBehaviorSanitizer
	scripts/sanitize.sh

wasm: ## compile the core to WebAssembly for avatar/web (Debian: emscripten)
	scripts/build_wasm.sh

arm64: ## compile the core for 64-bit ARM with a cross compiler (Debian: g++-aarch64-linux-gnu)
	scripts/check_arm64.sh

gpu-check: setup-dev ## verify the GPU's kernels without a GPU (installs Triton, 700 MB)
	PIP_FLAGS="$(PIP_FLAGS)" GPU_TARGETS="$(GPU_TARGETS)" scripts/check_gpu_kernels.sh

paper-smoke: setup-dev ## run scripts/paper, which makes the paper's tables and figures, tiny
	scripts/paper/smoke.sh

check: setup-dev ## lint, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: setup-dev ## put the code into its standard form
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

wheel: setup-dev ## build dist/hyperavatar-*.whl
	$(BIN)/python -m build --wheel --no-isolation --outdir dist .

smoke: setup-dev ## install a wheel, made from the source distribution, elsewhere and run the whole program from there
	PYTHON=$(PYTHON) PIP_FLAGS="$(PIP_FLAGS)" scripts/smoke_wheel.sh

clean: ## remove everything that the other targets make
	rm -rf $(VENV) build dist $(DEMO)

$(VENV)/.tools: constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	  || { echo "avatar needs Python 3.11 or newer as $(PYTHON); name another one with make setup PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' \
	  || { echo "avatar needs the headers of $(PYTHON) (Debian: apt install python3-dev; Fedora: dnf install python3-devel)"; exit 1; }
	@command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null \
	  || { echo "avatar needs a C++ compiler (Debian: apt install g++; macOS: xcode-select --install)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
	  || { echo "$(PYTHON) cannot make a virtual environment (Debian: apt install python3-venv)"; exit 1; }
	$(PIP) torch setuptools wheel
	$(PIP) scikit-build-core nanobind cmake ninja
	@touch $@

$(VENV)/.installed: $(VENV)/.tools pyproject.toml $(NATIVE)
	$(PIP) --no-build-isolation -e '.[track,view]'
	@touch $@

# Whoever has the developers' tools has what using the program takes.
$(VENV)/.installed-dev: $(VENV)/.tools pyproject.toml $(NATIVE)
	$(PIP) --no-build-isolation -e '.[dev]'
	@touch $(VENV)/.installed $@
