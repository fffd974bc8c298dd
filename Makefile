# Everything runs in .venv, which each target sets up as far as it is missing. The two to know:
#   make demo    make test
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

PYTHON ?= python3
VENV := $(CURDIR)/.venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# A sourced ROS 2 whose rclpy this python can import is used as it is; otherwise ROS 2 Jazzy is
# installed into .venv as wheels. Each way has its own stamp, so that changing over starts anew.
ROS := $(shell test -n "$${ROS_DISTRO-}" && $(PYTHON) -c 'import rclpy' 2>/dev/null && echo sourced || echo wheels)
# It holds the versions that are installed.
DEPENDENCIES := $(VENV)/.dependencies-$(ROS)
PACKAGE := $(VENV)/.package
EXTRAS_wheels := [desk,wheels,exchange,autopilot,campaign,docs,test]
EXTRAS_sourced := [desk,exchange,autopilot,campaign,docs,test]
SOURCES := $(shell find quadtree_lss launch rviz foxglove security config examples scripts resource -type f \
    -not -path '*/__pycache__/*' -not -name '*.so') package.xml pyproject.toml setup.py setup.cfg

# The installed package, not the checkout, is what every target runs.
export PYTHONSAFEPATH := 1
unexport VIRTUAL_ENV

.PHONY: help setup lock audit demo test test-slow test-all test-checked test-vehicle test-newest test-autopilot lint docs figures evidence bench clean

help:
	@echo 'make demo      simulate a descent, run both nodes on it, rank landing sites (2 minutes)'
	@echo 'make test      quick tests'
	@echo 'make test-slow  the other tests'
	@echo 'make test-checked  tests of the core with every index checked'
	@echo 'make test-all  these three'
	@echo 'make test-vehicle  test suite with the versions of a vehicle computer, where there is a Python 3.12'
	@echo 'make test-newest  core, messages and a live test with the newest versions that pyproject.toml allows'
	@echo 'make test-autopilot  landings with ArduCopter and PX4, software in the loop: ARDUCOPTER, PX4 name them'
	@echo 'make lint      ruff, mypy, and the language of the documents'
	@echo 'make docs      the site, into build/site/html'
	@echo 'make figures   make the quick tables and pictures of the documents anew, list the others'
	@echo 'make evidence  make all of them anew that this build has not made: hours on an idle computer'
	@echo 'make bench     print benchmark figures'
	@echo 'make setup     only install into .venv'
	@echo 'make lock      write .ci/requirements.lock anew: every wheel of constraints.txt with its hashes'
	@echo 'make audit     known vulnerabilities of what is locked, where their database can be reached'
	@echo 'make clean     remove .venv and everything generated'

setup: $(PACKAGE)

# Nothing that is not in .ci/requirements.lock, byte for byte, where its wheels are for this Python and
# computer; elsewhere the versions of constraints.txt. LOCKED= goes without.
LOCKED ?= $(shell $(PYTHON) -c 'import platform as p, sys; \
    print("yes" if (3, 10) <= sys.version_info < (3, 14) and p.system() == "Linux" \
    and p.machine() == "x86_64" and p.libc_ver()[0] == "glibc" else "")' 2>/dev/null)
NO_INDEX_wheels := $(if $(LOCKED),--no-index)
LOCK := $(BIN)/python -m pip --disable-pip-version-check install --quiet --require-hashes
$(VENV)/.dependencies-wheels: constraints.txt .ci/requirements.lock
	@$(PYTHON) toolchain.py
	@test -f $@ || { rm -rf $(VENV) && $(PYTHON) -m venv $(VENV); }
ifneq ($(LOCKED),)
	@echo 'installing what .ci/requirements.lock names into .venv (the first time a minute or two)'
	@awk '/^(setuptools|wheel|cython)==/,/[^\\]$$/' .ci/requirements.lock > $@.part
	@$(LOCK) -r $@.part
	@$(LOCK) --no-build-isolation -r .ci/requirements.lock
	@rm $@.part
else
	@$(PIP) install --quiet -c constraints.txt setuptools wheel cython
endif
	@cp constraints.txt $@

# With a sourced ROS its own NumPy must stay: message classes are compiled against it.
$(VENV)/.dependencies-sourced:
	@$(PYTHON) toolchain.py
	@rm -rf $(VENV)
	@$(PYTHON) -m venv --system-site-packages $(VENV)
	@$(PYTHON) -c 'import numpy; print("numpy==" + numpy.__version__)' > $@.part
	@$(PIP) install --quiet -c $@.part 'setuptools>=61' wheel 'cython>=3.0.8'
	@mv $@.part $@

# Not editable: an editable install has no launch files, configurations or ament index entry.
$(PACKAGE): $(DEPENDENCIES) $(SOURCES)
	@echo 'installing quadtree_lss and what it needs into .venv (the first time a minute or two)'
	@rm -rf quadtree_lss.egg-info
	@$(PIP) install --quiet $(NO_INDEX_$(ROS)) -c $(DEPENDENCIES) --no-build-isolation '.$(EXTRAS_$(ROS))'
	@rm -rf quadtree_lss.egg-info
	@touch $@

# Universal: for every Python and computer. The tool has an environment of its own.
TOOLS := $(VENV)/tools
TOOL = $(TOOLS)/bin/pip --disable-pip-version-check install --quiet
lock: $(TOOLS)/bin/python
	@$(TOOL) uv==0.13.9
	@{ echo '# Written by `make lock` from constraints.txt; `make setup` installs it.'; \
	    $(TOOLS)/bin/uv pip compile constraints.txt --universal --no-deps --generate-hashes --quiet \
	    --python-version 3.10 --no-python-downloads --no-header --no-annotate; } > .ci/requirements.lock.part
	@mv .ci/requirements.lock.part .ci/requirements.lock

VULNERABILITIES := api.osv.dev
audit: $(TOOLS)/bin/python
	@if ! $(TOOLS)/bin/python -c \
	    'import socket; socket.create_connection(("$(VULNERABILITIES)", 443), 10)' 2>/dev/null; then \
	    echo 'known vulnerabilities not checked: $(VULNERABILITIES) cannot be reached from here'; \
	else \
	    $(TOOL) pip-audit==2.10.1 && \
	    $(TOOLS)/bin/pip-audit -s osv --disable-pip --require-hashes -r .ci/requirements.lock; \
	fi

$(TOOLS)/bin/python:
	@$(PYTHON) -m venv $(TOOLS)

demo: setup
	@$(BIN)/python -m quadtree_lss.lab.live.demo --out demo_output

# Three, for many tests wait; in the order of test/conftest.py.
WORKERS := -n 3 --dist loadgroup --no-loadscope-reorder
test: setup
	$(BIN)/pytest $(WORKERS) $(PYTEST_ARGS)

test-slow: setup
	$(BIN)/pytest $(WORKERS) -m slow $(PYTEST_ARGS)

test-all:
	$(MAKE) --no-print-directory test
	$(MAKE) --no-print-directory test-slow
	$(MAKE) --no-print-directory test-checked

# Hours in real time: FLIGHTS='--landings 20 --faults 13' flies fewer.
FLIGHTS ?= --landings 200 --faults 60
test-autopilot: setup
	@$(BIN)/python benchmark/arducopter.py $(FLIGHTS)
	@$(BIN)/python benchmark/px4.py $(FLIGHTS)

# What Ubuntu 24.04 has, in an environment of its own. Other tests than all: VEHICLE_TESTS=test/core
VEHICLE_PYTHON ?= $(shell for python in python3.12 "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/3.12*/bin/python3.12 \
    "$$(dirname "$$(command -v python3.12)")"/../versions/3.12*/bin/python3.12 \
    $$(uv python find 3.12 2>/dev/null); do \
    if $$python --version >/dev/null 2>&1; then echo $$python; break; fi; done)
VEHICLE_TESTS ?= test
VEHICLE := $(CURDIR)/.venv-vehicle
VEHICLE_PIP := $(VEHICLE)/bin/python -m pip --disable-pip-version-check install --quiet
test-vehicle:
	@if [ -z '$(VEHICLE_PYTHON)' ]; then \
	    echo 'no Python 3.12 here: not tested with the versions of a vehicle'; \
	else \
	    $(MAKE) --no-print-directory $(VEHICLE)/.package && \
	    $(VEHICLE)/bin/pytest $(WORKERS) $(PYTEST_ARGS) $(VEHICLE_TESTS); \
	fi

$(VEHICLE)/.dependencies: constraints.txt Makefile
	@$(VEHICLE_PYTHON) toolchain.py
	@rm -rf $(VEHICLE)
	@$(VEHICLE_PYTHON) -m venv $(VEHICLE)
	@sed -E '/^(cython|numpy|scipy|scipy-stubs|optype|numpy-typing-compat)==/d' constraints.txt > $@.part
	@printf 'cython==3.0.8\nnumpy==1.26.4\nscipy==1.11.4\n' >> $@.part
	@$(VEHICLE_PIP) -c $@.part setuptools wheel cython
	@mv $@.part $@

$(VEHICLE)/.package: $(VEHICLE)/.dependencies $(SOURCES)
	@echo 'installing quadtree_lss and the versions of a vehicle into .venv-vehicle'
	@rm -rf quadtree_lss.egg-info
	@$(VEHICLE_PIP) -c $(VEHICLE)/.dependencies --no-build-isolation '.[desk,wheels,exchange,autopilot,campaign,test]'
	@rm -rf quadtree_lss.egg-info
	@touch $@

# The newest versions that pyproject.toml allows, in an environment of its own, with the newest Python
# that has wheels of them. The ROS wheels stay as locked.
NEWEST_PYTHON ?= $(shell for python in python3.13 "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/3.13*/bin/python3.13 \
    $$(uv python find 3.13 2>/dev/null) $(PYTHON); do \
    if $$python --version >/dev/null 2>&1; then echo $$python; break; fi; done)
NEWEST_TESTS ?= test/core test/messages test/ros/test_nodes.py
NEWEST := $(CURDIR)/.venv-newest
NEWEST_PIP := $(NEWEST)/bin/python -m pip --disable-pip-version-check install --quiet --upgrade
test-newest:
	@rm -rf $(NEWEST) quadtree_lss.egg-info
	@$(NEWEST_PYTHON) -m venv $(NEWEST)
	@grep '^ros-' constraints.txt > $(NEWEST)/constraints.txt
	@$(NEWEST_PIP) setuptools wheel cython
	@$(NEWEST_PIP) -c $(NEWEST)/constraints.txt --no-build-isolation '.[desk,wheels,autopilot,test]'
	@rm -rf quadtree_lss.egg-info
	@$(NEWEST)/bin/python -c 'import numpy, scipy, Cython, sys; \
	    print("Python", *sys.version_info[:2], "NumPy", numpy.__version__, "SciPy", scipy.__version__, "Cython", Cython.__version__)'
	$(NEWEST)/bin/pytest $(WORKERS) $(PYTEST_ARGS) $(NEWEST_TESTS)

# The core with every index checked, in a folder of its own before the installed one.
CHECKED := $(VENV)/checked
CHECKED_TESTS ?= test/core
test-checked: setup $(CHECKED)/.package
	PYTHONPATH=$(CHECKED) $(BIN)/python -c 'from quadtree_lss import build; print(build.name())' | grep checked
	PYTHONPATH=$(CHECKED) $(BIN)/pytest $(WORKERS) $(PYTEST_ARGS) $(CHECKED_TESTS)

$(CHECKED)/.package: $(PACKAGE)
	@echo 'compiling the core with every index checked into .venv/checked'
	@rm -rf $(CHECKED) quadtree_lss.egg-info
	@QUADTREE_LSS_CHECKED=1 $(PIP) install --quiet --no-build-isolation --no-deps --target $(CHECKED) .
	@rm -rf quadtree_lss.egg-info
	@touch $@

# Of a copy, in which the pages outside of docs/ have their places, as rosdoc2 makes one.
SITE := $(CURDIR)/build/site
docs: setup
	@rm -rf $(SITE) && mkdir -p build && cp -rL docs $(SITE)
	$(BIN)/sphinx-build -q -W --keep-going $(SITE) $(SITE)/html
	@echo 'open $(SITE)/html/index.html'

# Tables and pictures of the documents. The second makes those that take hours as well; it resumes.
figures: setup
	@$(BIN)/python docs/figures.py --make
evidence: setup
	@$(BIN)/python docs/figures.py --all

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy quadtree_lss/onboard/core quadtree_lss/lab/simulation/march.py quadtree_lss/lab/simulation/contact.py
	$(BIN)/codespell README.md CONTRIBUTING.md QUALITY_DECLARATION.md CHANGELOG.rst docs msg_docs quadtree_lss config studies
	$(BIN)/python docs/language.py

bench: setup
	@for script in $$(ls benchmark/*.py | grep -v -e arducopter.py -e px4.py -e study.py); do \
	    echo "== $$script"; $(BIN)/python "$$script" || exit 1; \
	done

clean:
	rm -rf .venv .venv-vehicle .venv-newest build demo_output quadtree_lss.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find quadtree_lss -name '*.so' -delete
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
