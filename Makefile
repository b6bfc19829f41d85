# driverview: `make demo` shows the whole pipeline, `make test` checks it. `make help` lists the rest.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PACKAGES := trackfeatures runtime simulator datagen mtlnet serve controllers
# Debian keeps ldconfig in /sbin, which is not on every user's PATH.
export PATH := $(CURDIR)/$(BIN):$(PATH):/usr/sbin:/sbin

.PHONY: help setup system demo test parallel-tests extended check docs compiled quick fuzz attack chaos api e2e bench endurance format lock clean

help: ## list the targets
	@grep -hE '^[a-z0-9]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 10

setup: $(READY) ## make .venv with everything in it (about 8 GB, minutes)

# The lock pins every version; torch and torchvision come together, from one index. Python compiles
# what it imports: of 21,000 modules a seventh, so that pip need not take a minute to compile all.
$(READY): pyproject.toml requirements.lock
	@$(MAKE) --no-print-directory system
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $$($(PYTHON) --version) found, Python 3.11 or newer is needed: make PYTHON=python3.11 setup" >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { rm -rf $(VENV); $(PYTHON) -m venv $(VENV); }
	$(BIN)/python -m pip install --quiet --no-compile --require-hashes --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# The camera renders through EGL; with no GPU, Mesa's llvmpipe does the work.
EGL_PACKAGES := libegl1 libgl1-mesa-dri
system:
	@if ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' && \
	  { ldconfig -p | grep -q 'libEGL_nvidia' || find /usr/lib* -name 'swrast_dri.so' -o -name 'libgallium*' 2>/dev/null | grep -q .; }; then :; \
	elif ! command -v apt-get >/dev/null; then \
	  echo "error: EGL and Mesa are missing; install your system's packages for them ($(EGL_PACKAGES) on Debian)" >&2; exit 1; \
	elif [ "$$(id -u)" = 0 ]; then apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $(EGL_PACKAGES); \
	elif sudo -n true 2>/dev/null; then sudo apt-get update -qq && sudo apt-get install -y -qq $(EGL_PACKAGES); \
	else echo "error: EGL and Mesa are missing; type: sudo apt-get install $(EGL_PACKAGES)" >&2; exit 1; fi

demo: $(READY) ## collect, train, evaluate, serve, ask, report: in 17 minutes on two cores
	$(BIN)/controllers demo --out demo

# One process more than cores, for many tests wait; four at most: each takes 1 to 2 GB. A file's tests
# stay in one process, for they share what is costly to make; xdist keeps their order (tests/conftest.py).
# What measures time comes after them, when the cores are free. A process that dies ends the run: xdist
# 3.8 would start another, hand out the dead one's finished files again, and wait for ever (its issue 1378).
PROCESSES := $(shell $(PYTHON) -c 'import os; print(min(len(os.sched_getaffinity(0)) + 1, 4))')
PARALLEL := --numprocesses $(PROCESSES) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: $(READY) ## all checks and tests but the extended ones
	@$(MAKE) --no-print-directory --jobs 2 check parallel-tests
	$(BIN)/pytest -m "alone and not extended"

parallel-tests: compiled
	$(BIN)/pytest $(PARALLEL) -m "not alone and not extended"

extended: $(READY) ## the long tests that `make test` leaves out
	$(BIN)/pytest $(PARALLEL) -m extended

# The simulator compiles its numeric code when it first runs; once, before many processes need it.
compiled: $(READY)
	@folder=$$(mktemp -d); \
	$(BIN)/datagen collect --rounds 1 --frames 3 --tracks oval --workers 1 --out $$folder/data \
	  >/dev/null 2>$$folder/said || { cat $$folder/said >&2; exit 1; }; rm -rf $$folder

check: $(READY) ## format, lint, types, imports, links
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy $(PACKAGES) tests benchmarks docs
	$(BIN)/lint-imports
	@$(MAKE) --no-print-directory docs

docs: $(READY) ## build the documentation in build/docs; a broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

quick: $(READY) ## the tests that take seconds
	$(BIN)/pytest $(PARALLEL) -m "not slow and not alone and not extended"

fuzz: $(READY) ## a million damaged images, and as many byte streams, through the service, in process
	$(BIN)/python benchmarks/service_fuzz.py
	$(BIN)/python benchmarks/service_stream_fuzz.py

attack: $(READY) ## the attacks of the tests on a service, beside a well-behaved client; an hour
	$(BIN)/python benchmarks/service_attack.py $(ATTACK)

chaos: $(READY) ## commands killed 200 times, on full and read-only disks, with clocks that jump
	DRIVERVIEW_CHAOS_KILLS=200 DRIVERVIEW_CHAOS_SEED=$$(date +%s) $(BIN)/pytest tests/chaos

api: $(READY) ## a thousand requests an operation, made from the OpenAPI document
	DRIVERVIEW_API_EXAMPLES=1000 $(BIN)/pytest tests/serve/api/test_openapi.py

e2e: $(READY) ## one round from the simulator to a steered car
	$(BIN)/pytest tests/e2e

# A benchmark ends with 0: claim reached, 3: not measured, anything else: missed or failed.
bench: $(READY) ## every benchmark but the hour-long ones; fails where a claim is missed
	@missed=; unmeasured=; \
	for script in $(filter-out %_fuzz.py %_attack.py %/endurance.py,$(wildcard benchmarks/*.py)); do \
	  echo "== $$script"; $(BIN)/python $$script; \
	  case $$? in 0) ;; 3) unmeasured="$$unmeasured $$script" ;; *) missed="$$missed $$script" ;; esac; \
	done; \
	if [ -n "$$unmeasured" ]; then echo "not measured:$$unmeasured"; fi; \
	if [ -n "$$missed" ]; then echo "missed or failed:$$missed"; exit 1; fi

endurance: $(READY) ## an hour of controllers with restarts and new models, two beside bad clients
	$(BIN)/python benchmarks/endurance.py
	$(BIN)/python benchmarks/endurance.py --attacks --minutes 120

format: $(READY) ## put the code in order
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lock: ## pin what is installed now, with hashes, after a change of pyproject.toml
	$(BIN)/python -m pip install --quiet --require-hashes --requirement deploy/uv.txt
	$(BIN)/python -m pip freeze --all --exclude-editable | grep -vE '^(pip|uv)==' | \
	  $(BIN)/uv pip compile - --quiet --no-deps --generate-hashes --no-annotate --no-header \
	  --python-version 3.11.0 --output-file requirements.lock

clean: ## remove what was built and collected here, the environment too
	rm -rf $(VENV) demo build dist *.egg-info
