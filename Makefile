# Everything runs in .venv, which the first target makes; the system Python is only needed for that.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

# What Oclgrind 21.10 simulates right and in seconds; of the files below it at tiny sizes alone, and without halves, which it
# computes wrongly.
OCLGRIND := adam blend conv_local conv_weights hard_cases launch layers loss lpips pair_cache pairs project prune scan shade \
	smooth target weights
OCLGRIND_TINY := conv demo hull peak tiles winograd winograd_filter winograd_weights
TINY := (shape0 or shape1 or 3-2- or 16-16 or masks or carving or distances_equal or silhouettes or loop or copy) \
	and not half and not True
ON_OCLGRIND := OCL_ICD_VENDORS=/usr/lib/oclgrind/liboclgrind-rt-icd.so OCLGRIND_LOG=.venv/oclgrind.log OCLGRIND_DATA_RACES=1 \
	PP_DEVICE=Oclgrind PP_DATA=/nonexistent $(BIN)/python -m pytest $(ARGS)

.PHONY: help setup demo test test-intel bench lint oclgrind clean

help: ## print this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1	\2/p' Makefile | expand -t 12

setup: $(READY) ## make .venv with pp-cl in it, and see to a working OpenCL device

$(READY): setup.cfg pyproject.toml tools/setup_venv.sh tools/setup_opencl.py
	@tools/setup_venv.sh $(PYTHON)
	@$(BIN)/python tools/setup_opencl.py
	@touch $@

demo: $(READY) ## train the demo scene into runs/demo and evaluate it: minutes on a CPU
	$(BIN)/pp-cl train demo --preset tiny --iterations 1500 --out runs/demo
	$(BIN)/pp-cl eval runs/demo --metrics

test: $(READY) ## run the tests on the device of PP_DEVICE, else the default one
	@$(BIN)/python -m pytest $(ARGS)

test-intel: $(READY) ## the same on Intel's CPU runtime, installed into .venv if need be (x86-64)
	@$(BIN)/python tools/setup_opencl.py --intel
	@PP_DEVICE="Intel(R) OpenCL" $(BIN)/python -m pytest $(ARGS)

bench: $(READY) ## time and error of the network and of its layers; ARGS="--size 200 --widths 32,64,128" for others
	$(BIN)/pp-cl bench unet $(ARGS)
	$(BIN)/pp-cl bench conv $(ARGS)

lint: $(READY) ## check the style of the Python files
	@$(BIN)/ruff check

oclgrind: $(READY) ## run the tests of all kernels in Oclgrind (Debian's package): stray accesses, data races
	@rm -f .venv/oclgrind.log
	@$(ON_OCLGRIND) $(OCLGRIND:%=tests/test_%.py)
	@! grep -A7 . .venv/oclgrind.log
	@$(ON_OCLGRIND) $(OCLGRIND_TINY:%=tests/test_%.py) -k "$(TINY)"
	@! grep -A7 . .venv/oclgrind.log

clean: ## remove .venv and everything built; runs/ stays
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
