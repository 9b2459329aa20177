# make test, make lint, make demo, make docs: what they need is set up on the first call, in $(VENV) and build, offline
# from then on.
#   make PYTHON=python3.12 VENV=.venv312 test    another Python, another environment

PYTHON ?= python3
VENV ?= .venv
python := $(abspath $(VENV))/bin/python

.PHONY: test test-slow test-all lint coverage demo docs install tasks dist clean

# make test COVERAGE=1, or make coverage, reports which lines the tests reach. Compiled kernels are not seen.
# make test JOBS=4: in four processes, each with whole files of tests.
JOBS ?= 2
cover = $(if $(COVERAGE),--cov=casa_sara --cov-append --cov-report=term:skip-covered)

test: install
	$(python) -m pytest -m "not slow" --numprocesses $(JOBS) --dist loadfile $(cover) $(TESTS)

# The tests that take longest; test-all runs both.
test-slow: install
	$(python) -m pytest -m slow $(cover) $(TESTS)

test-all: test test-slow

# Style, docstrings and complexity (ruff), types of the numerics (mypy), who imports whom (import-linter): pyproject.toml.
lint: $(VENV)/installed build/lint/installed
	build/lint/bin/ruff check .
	build/lint/bin/mypy --python-executable $(python)
	build/lint/bin/lint-imports --cache-dir build/lint/imports

build/lint/installed: Makefile
	$(PYTHON) -m venv build/lint
	build/lint/bin/python -m pip install --quiet --disable-pip-version-check 'ruff ==0.17.*' 'mypy ==2.*' 'import-linter ==2.*'
	touch $@

# All tests, or make coverage TESTS=tests/test_solver.py.
coverage: COVERAGE = 1
coverage: install
	rm -f build/coverage
	$(python) -m pytest $(cover) $(TESTS)

demo: install
	$(python) -m casa_sara.demo

# The site, in build/docs; a warning is an error.
docs: $(VENV)/docs-installed
	$(python) -m sphinx -q -W --keep-going docs build/docs

install: $(VENV)/installed

# The tasks, from xml/*.xml.
tasks:
	$(PYTHON) tools/xml2task.py

# The sdist and the wheel, in dist, built and checked with tools in an environment of their own.
dist:
	rm -rf dist
	$(PYTHON) -m venv build/packaging
	build/packaging/bin/python -m pip install --quiet --disable-pip-version-check build twine
	build/packaging/bin/python -m build --outdir dist . >/dev/null
	build/packaging/bin/python -m twine check --strict dist/*

clean:
	rm -rf $(VENV) build dist casa_sara.egg-info

# CASA's data and logs, for every Python of this environment that is not told otherwise: the data of
# the package casadata, no download, no log file, nothing written to ~/.casa. A user's own
# ~/.casa/config.py is read after it and wins.
define CASA_SITE
import os as _os
import sys as _sys

import casadata as _casadata

measurespath = _casadata.datapath
datapath = [_casadata.datapath]
measures_auto_update = data_auto_update = False
cachedir = _os.path.join(_sys.prefix, "casa")
logfile = _os.devnull
nogui = nologger = agg = True
endef
export CASA_SITE
CASA_PTH := import os, sys; os.environ.setdefault("CASASITECONFIG", os.path.join(sys.prefix, "casasiteconfig.py"))

$(VENV)/installed: setup.cfg pyproject.toml Makefile
	@$(PYTHON) -c 'import sys; (3, 10) <= sys.version_info < (3, 14) or sys.exit( \
	    "CASA has no wheels for Python %d.%d: make PYTHON=python3.11, or any from 3.10 to 3.13" % sys.version_info[:2])'
	$(PYTHON) -m venv $(VENV)
	echo '*' > $(VENV)/.gitignore
	$(python) -m pip install --quiet --disable-pip-version-check --editable '.[shell,test]'
	echo "$$CASA_SITE" > $(VENV)/casasiteconfig.py
	echo '$(CASA_PTH)' > "$$($(python) -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/casa_sara_casasite.pth"
	$(python) -m casa_sara.reconstruction.compile_cache  # compiled now, for this user
	touch $@

$(VENV)/docs-installed: $(VENV)/installed
	$(python) -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@
