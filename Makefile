# driverview: `make demo` shows the whole pipeline, `make test` checks it. `make help` lists the rest.
# Python 3.11 first: PyBullet has no wheels for later versions. Then the default one, then others.
SUPPORTED := sys.version_info[:2] in [(3, minor) for minor in (11, 12, 13, 14)]
FIND_PYTHON := for python in python3.11 python3 python3.14 python3.13 python3.12; do \
  "$$python" -c 'import sys, venv, ensurepip; sys.exit(not $(SUPPORTED))' >/dev/null 2>&1 && { echo "$$python"; break; }; \
  done
ifndef PYTHON
PYTHON := $(shell $(FIND_PYTHON))
endif
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SETUP_GB := 9
PACKAGES := trackfeatures runtime simulator datagen mtlnet serve controllers
# Without compiled Python files every process compiles what it imports, which takes half of a command's time.
unexport PYTHONDONTWRITEBYTECODE
# Debian keeps ldconfig in /sbin, which is not on every user's PATH.
export PATH := $(CURDIR)/$(BIN):$(PATH):/usr/sbin:/sbin

.PHONY: help setup system demo test parallel-tests extended check docs compiled quick fuzz attack chaos api e2e bench endurance format lock clean

help: ## list the targets
	@grep -hE '^[a-z0-9]+:.*## ' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 10

setup: $(READY) ## make .venv with everything in it (about 8 GB, minutes)

# The lock pins every version; torch and torchvision come together, from one index. uv installs it in
# less than half of pip's time, but does not read pip's settings (mirrors, certificates): where it
# fails, pip installs the lock. Python compiles what it imports, a seventh of the 21,000 modules, so
# they are not compiled here.
$(READY): pyproject.toml requirements.lock
	@"$(PYTHON)" -c 'import sys, venv, ensurepip; sys.exit(not $(SUPPORTED))' 2>/dev/null || \
	  { echo "error: Python 3.11, 3.12, 3.13 or 3.14 with venv is needed, found: $$("$(or $(PYTHON),python3)" --version 2>&1 | head -n 1); install one" \
	  "(python3-venv on Debian), or name it: make PYTHON=/path/to/python3.11 setup" >&2; exit 1; }
	@[ -d $(VENV) ] || "$(PYTHON)" -c 'import shutil, sys; free = shutil.disk_usage(".").free; \
	  sys.exit(free < $(SETUP_GB) * 1e9 and f"error: .venv needs $(SETUP_GB) GB, but this disk has only {free / 1e9:.1f} GB free; nothing was installed")'
	@$(MAKE) --no-print-directory system
	@"$(PYTHON)" -c '$(DESCRIBE_PYTHON)'
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { rm -rf $(VENV); $(PYTHON) -m venv $(VENV); }
	$(BIN)/python -m pip install --quiet --require-hashes --requirement deploy/uv.txt
	@echo "installing the packages of requirements.lock"
	@$(BIN)/uv pip install --quiet --python $(BIN)/python --require-hashes --requirement requirements.lock || { \
	  echo "uv could not install requirements.lock; pip, which takes longer, tries it"; \
	  $(BIN)/python -m pip install --quiet --no-compile --require-hashes --requirement requirements.lock; }
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

define DESCRIBE_PYTHON
import sys; \
here = ".".join(map(str, sys.version_info[:3])); \
without = "without PyBullet, which has no wheels for it: all works but contacts of the car with walls and other cars"; \
print(f"Python {here} ({sys.executable}):", "with PyBullet" if sys.version_info < (3, 12) else without)
endef

# The camera renders through EGL; with no GPU, Mesa's llvmpipe does the work.
EGL_PACKAGES := libegl1 libgl1 libgl1-mesa-dri
system:
	@if ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1' && ldconfig -p | grep -q 'libGL\.so\.1' && \
	  { ldconfig -p | grep -q 'libEGL_nvidia' || find /usr/lib* -name 'swrast_dri.so' -o -name 'libgallium*' 2>/dev/null | grep -q .; }; then :; \
	elif ! command -v apt-get >/dev/null; then \
	  echo "error: EGL and Mesa are missing; install your system's packages for them ($(EGL_PACKAGES) on Debian)" >&2; exit 1; \
	elif [ "$$(id -u)" = 0 ]; then apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $(EGL_PACKAGES); \
	elif sudo -n true 2>/dev/null; then sudo apt-get update -qq && sudo apt-get install -y -qq $(EGL_PACKAGES); \
	else echo "error: EGL and Mesa are missing; type: sudo apt-get install $(EGL_PACKAGES)" >&2; exit 1; fi

demo: $(READY) ## collect, train, evaluate, serve, ask, report: in 20 minutes on two cores
	$(BIN)/controllers demo --out demo

# Two processes a core, for many tests wait; four at most: each takes 1 to 2 GB. A file's tests
# stay in one process, for they share what is costly to make; xdist keeps their order (tests/conftest.py).
# What measures time comes after them, when the cores are free. A process that dies ends the run: xdist
# 3.8 would start another, hand out the dead one's finished files again, and wait for ever (its issue 1378).
PROCESSES := $(shell cores=$$(nproc 2>/dev/null || echo 1); echo $$((cores < 2 ? 2 : 4)))
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
PARALLEL := --numprocesses $(PROCESSES) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: $(READY) ## all checks and tests but the extended ones
	@$(MAKE) --no-print-directory --jobs 2 check parallel-tests
	$(BIN)/pytest -m "alone and not extended"

parallel-tests: compiled
	$(ONE_THREAD) $(BIN)/pytest $(PARALLEL) -m "not alone and not extended"

extended: $(READY) ## the long tests that `make test` leaves out
	$(ONE_THREAD) $(BIN)/pytest $(PARALLEL) -m extended

# The simulator compiles its numeric code when it first runs; once, before many processes need it.
compiled: $(READY)
	@folder=$$(mktemp -d); \
	$(BIN)/datagen collect --rounds 1 --frames 3 --tracks oval --workers 1 --out $$folder/data \
	  >/dev/null 2>$$folder/said && $(BIN)/python -c '$(STEP_A_VECTOR)' 2>$$folder/said \
	  && $(BIN)/controllers compare --controllers lqr,mpc,lqr-kalman,mpc-kalman,rl-residual --tracks oval --steps 5 --disturb \
	  --out $$folder/drives >/dev/null 2>$$folder/said \
	  || { cat $$folder/said >&2; exit 1; }; rm -rf $$folder

define STEP_A_VECTOR
import gymnasium, numpy; \
name = "simulator.env:driverview/LateralControl-v0"; \
cars = gymnasium.make_vec(name, 2, vectorization_mode="vector_entry_point", sensors=("range",), traffic=1); \
cars.reset(seed=0); cars.step(numpy.zeros((2, 1)))
endef

check: $(READY) ## format, lint, types, imports, links
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy $(PACKAGES) tests benchmarks docs
	$(BIN)/lint-imports
	@$(MAKE) --no-print-directory docs

docs: $(READY) ## build the documentation in build/docs; a broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

quick: $(READY) ## the tests that take seconds
	$(ONE_THREAD) $(BIN)/pytest $(PARALLEL) -m "not slow and not alone and not extended"

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

lock: $(READY) ## resolve and pin all versions, with hashes, after a change of pyproject.toml
	echo 'setuptools>=77' | $(BIN)/uv pip compile pyproject.toml - --quiet --extra dev --universal --python-version 3.11 \
	  --generate-hashes --no-annotate --no-header --output-file requirements.lock $(LOCK)
	sed -i "s/ ; python_full_version < '3.15' and platform_python_implementation == 'CPython' and sys_platform == 'linux'//" requirements.lock
	@for version in 3.11 3.12 3.13 3.14; do \
	  $(BIN)/uv pip compile requirements.lock --quiet --no-deps --only-binary :all: --python-version $$version \
	    --python-platform x86_64-manylinux_2_28 --output-file /dev/null || exit 1; \
	  echo "Python $$version: wheels of all packages"; \
	done

clean: ## remove what was built and collected here, the environment too
	rm -rf $(VENV) demo build dist *.egg-info
