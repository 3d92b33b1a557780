# Set-up, demo and tests. Needs Python 3.10 or newer and a C++17 compiler (GCC 11 or Clang 12, or newer); everything
# else is installed into .venv. PYTHON=... chooses the Python, VENV=... another place for the environment.

VENV ?= .venv
DEMO ?= demo-output
PYTHON ?= $(shell for name in python3 python python3.14 python3.13 python3.12 python3.11 python3.10; do \
	$$name -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))' 2>/dev/null && echo $$name && break; done)

# Else each of the processes that tests start compiles the package anew, for half a second.
unexport PYTHONDONTWRITEBYTECODE

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
CORE_SOURCES := $(wildcard src/meshsplats/csrc/*.h src/meshsplats/csrc/*.cpp)
BUILD_INPUTS := pyproject.toml CMakeLists.txt ci-constraints.txt $(CORE_SOURCES) \
	$(wildcard src/meshsplats/csrc/options.txt src/meshsplats/csrc/exports.*)

# Blender's Python module exists for one version of Python only, and each version of it lives in a place of its own.
# The oldest and the newest that there is a Python for: since 5.1 it is 3.13, which is looked for by its place, too, as
# below. Before a release: make test-blender BPY="4.2.23 4.5.15 5.0.1 5.2.3 5.3.0".
BLENDER_VENV ?= .venv-blender
BLENDER_PYTHON ?= $(shell for name in python3.11 python3 python; do \
	$$name -c 'import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null && echo $$name && break; done)
BLENDER_PYTHON_313 ?= $(shell for name in python3.13 $(wildcard $(HOME)/.pyenv/versions/3.13.*/bin/python) python3; do \
	$$name -c 'import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, 13))' 2>/dev/null && echo $$name && break; done)
ifndef BPY
BPY := 4.2.23 $(if $(BLENDER_PYTHON_313),5.3.0,5.0.1)
endif
before_5_1 = $(filter 4.% 5.0.%,$(1))

# The lowest versions that pyproject.toml allows want the lowest Python. That of pyenv answers to its short name only
# where it was chosen, so it is looked for by its place, too.
LOWEST_VENV ?= .venv-lowest
LOWEST_PYTHON ?= $(shell for name in python3.10 $(wildcard $(HOME)/.pyenv/versions/3.10.*/bin/python) python3.11 python3 \
	python; do $$name -c 'import sys, venv, ensurepip; sys.exit(sys.version_info[:2] not in ((3, 10), (3, 11)))' \
	2>/dev/null && echo $$name && break; done)

# Wheels for all platforms, and machines on which to test them. The standard library of Python 3.11 becomes part of the
# Python for Windows.
WHEELS_VENV ?= .venv-wheels
WHEELS_PYTHON ?= $(or $(BLENDER_PYTHON),$(PYTHON))
WHEELS_BIN := $(WHEELS_VENV)/bin
DOCS_VENV ?= .venv-docs
OTHER_TESTS ?= tests
WINDOWS := build/windows
ARM64 := build/arm64

# The sanitizers' run-time libraries are found by the names that GCC gives them. Checks that take two fifths of the time
# of compiling are left out: what they see of pointers, AddressSanitizer reports where memory is touched.
SANITIZED := build/sanitizers
SANITIZER_CXX ?= g++
SANITIZER_FLAGS := -std=gnu++17 -O1 -g1 -fno-omit-frame-pointer -fno-sanitize-recover=all -fPIC -shared -pthread \
	-ffp-contract=off -fno-math-errno -fno-trapping-math -fvisibility=hidden -Wno-psabi -Wno-uninitialized \
	-Wno-maybe-uninitialized $(if $(filter x86_64,$(shell uname -m)),-march=x86-64-v3) -DMS_CHECKS -D_GLIBCXX_ASSERTIONS
CORE_TESTS := $(foreach name,rendering rendering_variants rendering_splats splat_order rasterize cutoff ramp fan_filter \
	viewers losses adam merging cell_neighbours stereo textures listing ordering shading median_depth \
	core_fuzz,$(or $(shell find tests -name test_$(name).py),tests/test_$(name).py))
# Libraries of variants are not under test, nor is memory, which sanitizers need a lot of.
CORE_TESTS_LEFT_OUT := unknown_variant or memory_stays_bounded

.PHONY: help dawn cesium node-packages demo fuzz fuzz-core test test-slow test-nightly test-lowest test-blender $(BPY:%=test-blender-%) test-sanitizers \
	test-memory test-threads test-windows test-arm64 wheels release docs lint format clean
.DEFAULT_GOAL := help

help:
	@echo 'make demo    splats to mesh, GLB, images, a comparison and a page, in $(DEMO)/'
	@echo 'make test    the quick tests; make test-slow and make test-nightly run the others'
	@echo 'make test-lowest    those that need no extra, with the lowest versions allowed of Python, NumPy and the rest'
	@echo 'make test-blender   those of the Blender part, with Blender $(BPY) (half a gigabyte each)'
	@echo 'make test-sanitizers   those of the compiled core, with GCC'"'"'s sanitizers and with assertions'
	@echo 'make fuzz    broken files against every reader, guided by coverage, for MINUTES=60'
	@echo 'make fuzz-core   arrays made up at random against the compiled core under sanitizers, CALLS=10000 of each call'
	@echo 'make wheels  wheels for Linux, Windows and macOS, in dist/'
	@echo 'make test-windows, test-arm64   the tests with the wheels for Windows, under wine, and for arm64, under qemu'
	@echo 'make release   all that a release consists of, in dist/ (docs/releasing.md)'
	@echo 'make docs    the documents as a site, in site/'
	@echo 'make lint    ruff, mypy and clang-format (make format tidies the source)'
	@echo 'make clean   removes everything that these made'

$(BIN)/python:
	@if [ -z "$(PYTHON)" ]; then echo 'No Python 3.10 or newer with venv was found.' \
	  'Install one (Debian, Ubuntu: apt install python3-venv), or name it: make demo PYTHON=...' >&2; exit 1; fi
	@echo 'Making $(VENV) with $(PYTHON)'
	@$(PYTHON) -m venv $(VENV)

# Editable installs: Python is used where it lies in src/; a change of the compiled core's source installs again.
# Programs that build it stay in the environment: what was compiled is used again, for the wheel too.
BUILD_TOOLS := scikit-build-core $(foreach tool,cmake ninja,$(shell command -v $(tool) > /dev/null || echo $(tool)))
BUILD_OPTIONS := --no-build-isolation --config-settings=build-dir=build/core
$(VENV)/installed: $(BUILD_INPUTS) | $(BIN)/python
	@echo 'Compiling the core and installing MeshSplats: about a minute'
	@$(PIP) install $(BUILD_TOOLS)
	@$(PIP) install --editable . $(BUILD_OPTIONS) --constraint ci-constraints.txt
	@touch $@

# To the package that is installed, pip adds what these extras name; it does not compile it again.
$(VENV)/installed-dev: $(VENV)/installed
	@echo 'Installing what tests need, torch too: some minutes'
	@$(PIP) install 'meshsplats[dev,torch]' --constraint ci-constraints.txt
	@touch $@

demo: $(VENV)/installed
	$(BIN)/meshsplats demo -o $(DEMO) --force

# A worker for each processor; each takes whole files, whose tests share what they make.
PARALLEL := --numprocesses auto --dist loadfile
test: $(VENV)/installed-dev dawn
	$(BIN)/python -m pytest $(PARALLEL) --tier quick

test-slow: $(VENV)/installed-dev dawn
	$(BIN)/python -m pytest $(PARALLEL) --tier slow

# The slowest, in the newest Blender too.
test-nightly: $(VENV)/installed-dev dawn cesium $(BLENDER_VENV)/$(lastword $(BPY))/installed
	$(BIN)/python -m pytest $(PARALLEL) --tier nightly
	$(call in_blender,$(lastword $(BPY))) --tier nightly $(BLENDER_TESTS)

# Chromium's compiler of WGSL, for tests/webgpu/test_dawn.py: 130 MB. Without npm, these tests are skipped.
DAWN := build/dawn
DAWN_VERSION := 0.6.2
dawn:
	@test -e $(DAWN)/$(DAWN_VERSION) || ! command -v npm > /dev/null \
	  || { echo 'Installing Dawn into $(DAWN)'; mkdir -p $(DAWN); \
	    npm install --silent --fetch-retries 1 --no-fund --no-audit --prefix $(DAWN) webgpu@$(DAWN_VERSION) && touch $(DAWN)/$(DAWN_VERSION); } \
	  || echo 'Dawn cannot be installed here: its tests are skipped'

# Programs of others that tests compare with, from npm; without them, these tests are skipped. splat-transform from 3 on
# keeps SPZ in the axes of .ply, against its specification.
NODE := build/node
NODE_PACKAGES := gltf-validator@2.0.0-dev.3.10 @playcanvas/splat-transform@2.7.1 three@0.187.0 \
	@gltf-transform/cli@4.5.1 meshoptimizer@1.3.0
node-packages: $(NODE)/installed
$(NODE)/installed: Makefile
	@echo 'Installing packages of npm into $(@D)'
	@mkdir -p $(@D)
	@npm install --silent --fetch-retries 1 --no-fund --no-audit --prefix $(@D) $(NODE_PACKAGES)
	@touch $@

# 79 MB that one of the slowest tests needs alone, in the version that docs/tiles.md names.
CESIUM := cesium@1.145.0
cesium:
	@test -e $(NODE)/$(CESIUM) || ! command -v npm > /dev/null \
	  || { echo 'Installing CesiumJS into $(NODE)'; mkdir -p $(NODE); \
	    npm install --silent --fetch-retries 1 --no-fund --no-audit --prefix $(NODE) $(CESIUM) && touch $(NODE)/$(CESIUM); } \
	  || echo 'CesiumJS cannot be installed here: its test is skipped'

# One wheel serves all versions of Python.
PACKAGE_FILES := $(foreach kind,py wgsl js html css,$(shell find src -name '*.$(kind)'))
build/wheel/made: $(BUILD_INPUTS) $(PACKAGE_FILES) $(VENV)/installed
	@rm -f $(@D)/*.whl
	@$(PIP) wheel --no-deps $(BUILD_OPTIONS) --wheel-dir $(@D) .
	@touch $@

$(LOWEST_VENV)/installed: build/wheel/made lowest-constraints.txt
	@if [ -z "$(LOWEST_PYTHON)" ]; then echo 'The lowest versions need Python 3.10 or 3.11 with venv; neither was found.' \
	  'Name it: make test-lowest LOWEST_PYTHON=...' >&2; exit 1; fi
	@echo 'Installing the lowest versions into $(@D) with $(LOWEST_PYTHON)'
	@test -x $(@D)/bin/python || $(LOWEST_PYTHON) -m venv $(@D)
	@$(@D)/bin/python -m pip --disable-pip-version-check --quiet install --only-binary :all: \
	  --constraint lowest-constraints.txt pytest pytest-xdist hypothesis $(<D)/*.whl
	@$(@D)/bin/python -m pip --disable-pip-version-check --quiet install --force-reinstall --no-deps $(<D)/*.whl
	@touch $@

# Left out is what does not depend on the versions: what Chromium and Dawn draw and compile, the rules of this
# repository, what the core computes, to which all commands give arrays, whole sessions whose commands have tests of
# their own, merging for views and in blocks, which takes long, and real scenes, which go through the same lines as
# small ones.
LOWEST_LEFT_OUT := $(addprefix tests/,$(addprefix viewer/test_,compilers.py controls.py docs_page.py exact.py screens.py \
	shader_of_docs.py) $(addprefix conversion/test_,conversion_blocks.py merging_views.py) webgpu/test_dawn.py \
	cli/test_cli_demo.py $(addprefix test_,benchmarks.py compare_commits.py house.py option_names.py rooms.py \
	tutorials.py)) $(CORE_TESTS)

# What MESHSPLATS_REQUIRE names is in the newcomer's environment alone, neither here nor, but for EGL, in those of Blender.
test-lowest: $(LOWEST_VENV)/installed
	MESHSPLATS_REQUIRE= MESHSPLATS_SHARED_DATA=left-out MESHSPLATS_EXAMPLES=10 $(LOWEST_VENV)/bin/python -m pytest \
	  $(PARALLEL) --assert plain --tier few $(LOWEST_LEFT_OUT:%=--ignore=%)

$(BLENDER_VENV)/%/installed: blender_python = $(if $(call before_5_1,$*),$(BLENDER_PYTHON),$(BLENDER_PYTHON_313))
$(BLENDER_VENV)/%/installed: blender_numpy = $(if $(call before_5_1,$*),'numpy<2')
$(BLENDER_VENV)/%/installed: build/wheel/made
	@if [ -z "$(blender_python)" ]; then echo 'Blender needs Python 3.11, since 5.1 Python 3.13, with venv. It was not' \
	  'found. Name it: make test-blender BLENDER_PYTHON=... BLENDER_PYTHON_313=...' >&2; exit 1; fi
	@echo 'Installing Blender $* into $(@D)'
	@test -x $(@D)/bin/python || $(blender_python) -m venv $(@D)
	@$(@D)/bin/python -m pip --disable-pip-version-check --quiet install 'bpy==$*' $(blender_numpy) pytest hypothesis \
	  $(<D)/*.whl
	@$(@D)/bin/python -m pip --disable-pip-version-check --quiet install --force-reinstall --no-deps $(<D)/*.whl
	@$(@D)/bin/python -m pip --disable-pip-version-check --quiet install mitsuba $(blender_numpy) \
	  || echo 'Mitsuba cannot be installed here: the test that compares it with Cycles is skipped'
	@touch $@

# Slow tests, and more than two cases of a quick one, run in the newest of the versions alone.
in_blender = MESHSPLATS_REQUIRE=$(findstring egl,$(MESHSPLATS_REQUIRE)) MESHSPLATS_WHEEL=$$(echo build/wheel/*.whl) $(BLENDER_VENV)/$(1)/bin/python -m pytest
BLENDER_TESTS := tests/blender tests/conversion/test_conversion.py tests/test_demo_mesh.py
test-blender: $(BPY:%=test-blender-%)
$(BPY:%=test-blender-%): test-blender-%: $(BLENDER_VENV)/%/installed
	@echo 'Blender $*'
	@$(call in_blender,$*) --tier $(if $(filter $*,$(lastword $(BPY))),daily,few) $(BLENDER_TESTS)

$(SANITIZED)/address.so: SANITIZERS := address,undefined,float-cast-overflow \
	-fno-sanitize=null,object-size,vptr,pointer-overflow
$(SANITIZED)/thread.so: SANITIZERS := thread
$(SANITIZED)/%.so: $(CORE_SOURCES) Makefile
	@echo 'Compiling the core with -fsanitize=$(SANITIZERS)'
	@mkdir -p $(@D)
	@$(SANITIZER_CXX) $(SANITIZER_FLAGS) -fsanitize=$(SANITIZERS) -DMS_VARIANT='"sanitizers"' \
	  src/meshsplats/csrc/api.cpp -o $@

# Python itself is built without sanitizers: their library has to be loaded before it, its leaks and races are its own.
# OpenBLAS and OpenMP run without threads, which the thread sanitizer cannot follow. A report ends the process, so pytest
# must not capture what the core prints.
sanitized = LD_PRELOAD="$$($(SANITIZER_CXX) -print-file-name=$(1)) $$($(SANITIZER_CXX) -print-file-name=libstdc++.so.6)" \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	TSAN_OPTIONS='halt_on_error=1 ignore_noninstrumented_modules=1' OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 \
	MESHSPLATS_LIBRARY=$(CURDIR)/$(SANITIZED)/$(2).so $(BIN)/python
core_tests = -m pytest --capture=sys -k 'not ($(CORE_TESTS_LEFT_OUT))' $(CORE_TESTS)

test-sanitizers: test-memory test-threads
test-memory: $(VENV)/installed-dev $(SANITIZED)/address.so
	$(call sanitized,libasan.so,address) $(core_tests) --tier few $(PARALLEL) --max-worker-restart 0
test-threads: $(VENV)/installed-dev $(SANITIZED)/thread.so
	$(call sanitized,libtsan.so,thread) $(core_tests) -k 'threads and not chunk'

$(WHEELS_VENV)/installed: tools/requirements.txt
	@echo 'Making $(WHEELS_VENV) with $(WHEELS_PYTHON)'
	@test -x $(WHEELS_BIN)/python || $(WHEELS_PYTHON) -m venv $(WHEELS_VENV)
	@$(WHEELS_BIN)/python -m pip --disable-pip-version-check --quiet install --requirement $<
	@touch $@

wheels: $(WHEELS_VENV)/installed
	$(WHEELS_BIN)/python tools/wheels.py -o dist

# The tests compare their images with this digest of the machine at hand.
digest = MESHSPLATS_DIGEST=$$(cd tests/rendering && PYTHONPATH=.. $(abspath $(BIN))/python -c \
	'import test_rendering_variants as t; print(t.digest())')

# wine wants a file as standard input and a pipe as output.
test-windows: $(VENV)/installed-dev $(WHEELS_VENV)/installed
	@rm -rf $(WINDOWS)/wheel
	$(WHEELS_BIN)/python tools/wheels.py -o $(WINDOWS)/wheel --only win_amd64
	$(WHEELS_BIN)/python tools/windows_python.py $(WINDOWS)/python $(WINDOWS)/wheel/*.whl
	bash -o pipefail -c "$(digest) WINEPREFIX=$(CURDIR)/$(WINDOWS)/prefix WINEDEBUG=-all WINEARCH=win64 \
	  wine $(WINDOWS)/python/python.exe -m pytest -p no:cacheprovider $(OTHER_TESTS) < /dev/null 2>&1 | cat"

# Processes that a test starts would need qemu in the kernel (binfmt_misc): such tests are left out.
test-arm64: $(VENV)/installed-dev $(WHEELS_VENV)/installed
	@rm -rf $(ARM64)/wheel
	$(WHEELS_BIN)/python tools/wheels.py -o $(ARM64)/wheel --only manylinux_2_17_aarch64
	$(WHEELS_BIN)/python tools/arm64_python.py $(ARM64)/root $(ARM64)/wheel/*.whl
	$(digest) qemu-aarch64-static -L $(ARM64)/root $(ARM64)/root/usr/bin/python3.11 -m pytest -p no:cacheprovider \
	  -k 'not variants_do_not_change and not memory_stays_bounded' tests/rendering tests/conversion

# Coverage-guided; the tests feed each reader a few dozen random changes.
MINUTES ?= 60
fuzz: $(VENV)/installed-dev
	@$(PIP) install atheris
	$(BIN)/python tests/fuzz/guided.py $(if $(INPUTS),--inputs $(INPUTS),--minutes $(MINUTES))

fuzz-core: $(VENV)/installed-dev $(SANITIZED)/address.so
	$(call sanitized,libasan.so,address) tests/fuzz/fuzz_core.py --count $(or $(CALLS),10000)

release: $(WHEELS_VENV)/installed
	$(WHEELS_BIN)/python tools/release.py -o dist

$(DOCS_VENV)/installed: tools/docs-requirements.txt
	@if [ -z "$(WHEELS_PYTHON)" ]; then echo 'make docs needs Python 3.11 or newer with venv: WHEELS_PYTHON=...' >&2; exit 1; fi
	@echo 'Making $(DOCS_VENV) with $(WHEELS_PYTHON)'
	@test -x $(DOCS_VENV)/bin/python || $(WHEELS_PYTHON) -m venv $(DOCS_VENV)
	@$(DOCS_VENV)/bin/python -m pip --disable-pip-version-check --quiet install --requirement $<
	@touch $@

docs: $(DOCS_VENV)/installed $(VENV)/installed
	@mkdir -p build/docs
	$(BIN)/python -m meshsplats.demo_scene build/docs/scene.ply
	$(BIN)/meshsplats view build/docs/scene.ply -o build/docs/scene.html --title 'A still life of splats' --force
	$(DOCS_VENV)/bin/python tools/docs_site.py -o site --page build/docs/scene.html

lint: $(VENV)/installed-dev
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy
	$(BIN)/clang-format --dry-run --Werror $(CORE_SOURCES)

format: $(VENV)/installed-dev
	$(BIN)/python -m ruff format .
	$(BIN)/python -m ruff check --fix .
	$(BIN)/clang-format -i $(CORE_SOURCES)

clean:
	rm -rf $(VENV) $(LOWEST_VENV) $(BLENDER_VENV) $(WHEELS_VENV) $(DOCS_VENV) $(DEMO) build dist site
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
