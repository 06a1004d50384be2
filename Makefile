# Everything runs in .venv, which the first target makes; the system Python is only needed for that.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# the packages alone, without an OpenCL driver
MADE := .venv/.made
KERNELS = $(shell find cl -name "*.cl" -o -name "*.h")

# of `make fuzz`
COUNT ?= 5000
SEED ?= 0

# No test needs another in its process: runs that several use are trained once for all (tests/support/runs.py).
ON_ALL_CORES := --numprocesses auto --dist worksteal

# The tests that are named like a kernel file, and those with the marker `kernels`.
OCLGRIND = $(wildcard $(shell find cl -name "*.cl" | sed "s|^cl/\(.*\)/\(.*\).cl|tests/\1/test_\2.py tests/engine/\1/test_\2.py|")) \
	$(shell grep -rl "pytest.mark.kernels" --include="test_*.py" tests)
# Its check for uninitialised reads knows no optimised code and no forced inlining; it takes its options from here, where
# pyopencl's cache does not see them.
ON_OCLGRIND := OCL_ICD_VENDORS=/usr/lib/oclgrind/liboclgrind-rt-icd.so OCLGRIND_DATA_RACES=1 OCLGRIND_UNINITIALIZED=1 \
	OCLGRIND_NUM_THREADS=1 OCLGRIND_BUILD_OPTIONS="-cl-opt-disable -DALWAYS_INLINE=static" PYOPENCL_NO_CACHE=1 \
	PP_DEVICE=Oclgrind PP_DATA=/nonexistent

.PHONY: help setup demo test test-slow test-intel test-no-unix bench lint format docs results readme figures network dist oclgrind gpu-check fuzz bits faults test-coarse test-gpu-form clean

help: ## print this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1	\2/p' Makefile | expand -t 12

setup: $(READY) ## make .venv with pp-cl in it, and see to a working OpenCL device

$(READY): $(MADE) tools/setup_opencl.py
	@$(BIN)/python tools/setup_opencl.py
	@touch $@

$(MADE): setup.cfg setup.py pyproject.toml tools/setup_venv.sh
	@tools/setup_venv.sh $(PYTHON)
	@touch $@

demo: $(READY) ## train the demo scene into runs/demo and evaluate it: minutes on a CPU
	$(BIN)/pp-cl train demo --preset tiny --iterations 1500 --out runs/demo
	$(BIN)/pp-cl eval runs/demo --metrics

test: $(READY) ## run the tests on the device of PP_DEVICE, else on the default one, a process a core
	@$(BIN)/python -m pytest $(ON_ALL_CORES) $(ARGS)

test-slow: $(READY) ## run the tests that `make test` leaves out: long ones of tools, Dask and faults, and what others show in part
	@$(BIN)/python -m pytest $(ON_ALL_CORES) -m slow $(ARGS)

test-intel: $(READY) ## the same on Intel's CPU runtime, installed into .venv if need be (x86-64)
	@$(BIN)/python tools/setup_opencl.py --intel
	@PP_DEVICE="Intel(R) OpenCL" $(BIN)/python -m pytest $(ON_ALL_CORES) $(ARGS)

# With it PoCL divides with errors up to 2.5 ulp, as GPUs may; more than they do, it takes no number for NaN or infinite.
test-coarse: $(READY) ## run the tests of all kernels on PoCL with the coarse division that GPUs may have
	@PYOPENCL_BUILD_OPTIONS=-cl-fast-relaxed-math PP_DEVICE="Portable Computing Language" \
		$(BIN)/python -m pytest $(ON_ALL_CORES) -m "not large and not exact" $(ARGS) $(sort $(OCLGRIND) tests/engine/device/test_rounding.py)

test-no-unix: $(READY) ## run the tests without fcntl, resource, os.fork and the signals that Windows lacks
	@PYTHONPATH=$(CURDIR)/tests/support/hidden $(BIN)/python -m pytest $(ON_ALL_CORES) $(ARGS)

# Drivers and kernels work in one way on CPUs and in another on GPUs (pp_cl/engine/device/launch.py).
test-gpu-form: $(READY) ## run the tests on PoCL with all drivers and kernels working as on GPUs
	@PP_FORM=gpu PP_DEVICE="Portable Computing Language" $(BIN)/python -m pytest $(ON_ALL_CORES) $(ARGS)

bench: $(READY) ## time and error of the network and of its layers; ARGS="--size 200 --widths 32,64,128" for others
	$(BIN)/pp-cl bench unet $(ARGS)
	$(BIN)/pp-cl bench conv $(ARGS)

lint: $(MADE) ## check the Python files (ruff, mypy for three systems, import-linter) and the format of the kernels (clang-format)
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@for system in linux win32 darwin; do $(BIN)/mypy --platform $$system || exit; done
	@$(BIN)/lint-imports --no-logo --no-cache
	@$(BIN)/clang-format --dry-run --Werror $(KERNELS)

format: $(MADE) ## format the Python files and the kernels
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format
	@$(BIN)/clang-format -i $(KERNELS)

docs: $(READY) ## write the tables, settings and commands in README.md and docs/, and docs/road.md
	@$(BIN)/python -m tools.docs_tables
	@$(BIN)/python -m tools.road

# Links that leave docs/ are those of the repository's root; there docs/ is the root of the pages.
site: $(MADE) ## build README.md and docs/ as a site in build/site; fails on a dead link
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check 'mkdocs-material>=9.5'
	@rm -rf build/pages build/site
	@mkdir -p build; cp -r docs build/pages; cp -r CONTRIBUTING.md CHANGELOG.md CITATION.cff LICENSE packaging tools build/pages
	@cp README.md build/pages/index.md
	@sed -i 's#](\.\./#](#g' build/pages/*.md
	@sed -i 's#](docs/#](#g; s#"docs/#"#g; s#](README.md#](index.md#g' build/pages/index.md build/pages/C*.md
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -f packaging/mkdocs.yml

results: $(READY) ## measure what README.md and docs/ state, and write it there: hours, with the scenes of PP_DATA
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[cpu,plot,torch,capture]'
	@$(if $(findstring --kind,$(ARGS)),,PP_DEVICE="$${PP_DEVICE:-Intel(R) OpenCL}") $(BIN)/python -m tools.results $(ARGS)
	@$(BIN)/python -m tools.docs_tables

readme: $(READY) ## type README.md's commands in an empty folder, on each driver that is here, and write their lines there: minutes
	@$(BIN)/python -m tools.readme_lines
	@$(BIN)/python -m tools.docs_tables

network: $(READY) ## train the demo and keep its network as what `--network demo` begins with
	@$(BIN)/pp-cl train demo --iterations 1500 --seed 1 --out runs/network
	@$(BIN)/python -m tools.keep_network runs/network

figures: $(READY) ## fail if a figure in README.md or docs/ is older than the code that decides it: before a release
	@$(BIN)/python -m tools.provenance

dist: $(READY) ## build the wheel and the source archive into dist/, check both, train the demo with each from an empty folder
	@rm -rf build dist
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check build twine
	@$(BIN)/python -m build -q
	@$(BIN)/python -m twine check --strict dist/*
	@set -e; unset PYTHONPATH; for archive in $(CURDIR)/dist/*; do \
		empty=$$(mktemp -d); cd $$empty; \
		$(CURDIR)/$(BIN)/python -m venv venv; \
		venv/bin/pip install --quiet --disable-pip-version-check $$archive; \
		venv/bin/pp-cl train demo --iterations 20 --out run; \
		venv/bin/pp-cl eval run; \
		rm -r $$empty; \
	done

oclgrind: $(READY) ## run the tests of all kernels in Oclgrind (Debian's package): stray accesses, data races, uninitialised reads
	@printf '%s\n' $(OCLGRIND) | $(ON_OCLGRIND) xargs -P $$(nproc) -I{} \
		$(BIN)/python -m pytest -q -p no:cacheprovider -m "not large" $(ARGS) {}

gpu-check: $(READY) ## compile and link all kernels for NVIDIA's, AMD's and Intel's GPUs, with no GPU; fetches Debian's compilers
	@$(BIN)/python -m tools.gpu_check $(ARGS)

fuzz: $(READY) ## try damaged and odd input on all that pp-cl reads: COUNT (5000) examples of a property, SEED (0)
	@COUNT=$(COUNT) $(BIN)/python -m pytest $(ON_ALL_CORES) --hypothesis-profile=fuzz --hypothesis-seed=$(SEED) \
		$(ARGS) tests/test_fuzz.py tests/test_properties.py

faults: $(READY) ## fail every call that changes a file of a training and an evaluation, kill them: minutes
	@FAULTS=all $(BIN)/python -m pytest $(ON_ALL_CORES) -m slow tests/test_faults.py $(ARGS)

bits: $(READY) ## compare the bits of short trainings with those of a BASE, a commit or a folder; ARGS="--driver intel" for one driver
	@$(BIN)/python -m tools.bits $(BASE) $(ARGS)

clean: ## remove .venv and everything built; runs/ stays
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
