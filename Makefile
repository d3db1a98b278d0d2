# make demo | test | test-noble | test-noble-quick | test-launch | docs | lint | bench | bench-check | profile | install | clean. Everything runs in .venv, which `install` makes.
.PHONY: install demo test test-noble test-noble-quick noble-python test-launch docs lint bench bench-check profile clean
.DELETE_ON_ERROR:

PYTHON ?= $(shell for p in python3.12 python3.11 python3; do \
	$$p -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
RUN := $(VENV)/bin
SOURCES := setup.py continuum_loc msg_tools studies test bench launch

# A linter of ROS where it is installed: the command $(1); elsewhere a line that says so, with $(2).
define ament
@if command -v $(firstword $(1)) >/dev/null; then $(1); \
	else echo "$(firstword $(1)) is not installed (it comes with ROS): $(2)"; fi
endef

install: $(VENV)/installed

$(VENV)/installed: requirements.txt setup.py setup.cfg pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or 3.12 is needed, and neither is on PATH." \
		"Install one, or name it: make $(MAKECMDGOALS) PYTHON=/path/to/python3.12"; exit 1; }
	@.ci/system-libraries
	@test -x $(RUN)/python || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) cannot make environments; on Debian or Ubuntu: apt-get install python3-venv"; exit 1; }
	$(RUN)/python -m pip install --quiet -r requirements.txt
	$(RUN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

demo: install
	$(RUN)/continuum-loc demo

test: install
	$(RUN)/python -m pytest test

# The oldest versions that are allowed, which are those of Ubuntu 24.04, and its Python where there is one.
NOBLE := .venv-noble
NOBLE_PYTHON ?= $(shell for p in python3.12 $$HOME/.pyenv/versions/3.12*/bin/python3.12; do \
	$$p -c '' 2>/dev/null && echo $$p && break; done)
NOBLE_QUICK := test_lie test_gp test_chain test_factors test_window test_filter_claims test_mechanics \
	test_bag test_cli test_node_parameters test_node_estimator

# Prints which Python 3.12 `test-noble` takes; nothing where there is none.
noble-python:
	@echo $(NOBLE_PYTHON)

test-noble: $(NOBLE)/installed
	PYTHONPATH=$(CURDIR) $(NOBLE)/bin/python -m pytest test

test-noble-quick: $(NOBLE)/installed
	PYTHONPATH=$(CURDIR) $(NOBLE)/bin/python -m pytest $(NOBLE_QUICK:%=test/%.py)

$(NOBLE)/installed: requirements-noble.txt
	@test -n "$(NOBLE_PYTHON)" || { echo "Python 3.12 is needed, which is what Ubuntu 24.04 has, and none is on PATH." \
		"Install it, or name it: make $(MAKECMDGOALS) NOBLE_PYTHON=/path/to/python3.12"; exit 1; }
	@.ci/system-libraries
	$(NOBLE_PYTHON) -m venv --clear $(NOBLE)
	$(NOBLE)/bin/python -m pip install --quiet --no-deps -r requirements-noble.txt
	@touch $@

# The API by sphinx, without a warning, into build/api.
docs: install
	$(RUN)/python -m pip install --quiet -r docs/api/requirements.txt
	for package in continuum_loc msg_tools; do \
		$(RUN)/sphinx-apidoc -q --force --separate --module-first --no-toc -o docs/api/generated $$package || exit 1; done
	$(RUN)/sphinx-build --quiet --fail-on-warning --keep-going -b html docs/api build/api

# Where ROS is installed, and this package beside it by colcon.
test-launch:
	launch_test test/launch/every_file.py

lint: install
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/lint-imports
	$(call ament,ament_flake8 $(SOURCES),its rules are checked by ruff and the tests alone)
	$(call ament,ament_pep257 $(SOURCES),its rules are checked by ruff alone)
	$(call ament,ament_xmllint package.xml,package.xml is checked by the tests alone)

bench: install
	$(RUN)/continuum-loc bench

bench-check: install
	$(RUN)/continuum-loc bench --check

profile: install
	$(RUN)/python bench/_step_profile.py

clean:
	rm -rf $(VENV) $(NOBLE) build dist install log .pytest_cache .ruff_cache .import_linter_cache .hypothesis .cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
