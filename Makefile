# Two commands matter: `make demo` and `make test`. Paths are relative, so a folder with spaces in its name is fine.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python

# pip takes the pins from here, for the package and (by the second name, which older versions do not know) for what
# builds it. What the caller's own settings say about where and what to install does not hold for $(VENV).
PIP_INSTALL := env -u PIP_TARGET -u PIP_PREFIX -u PIP_ROOT -u PIP_REQUIREMENT -u PIP_EDITABLE -u PIP_NO_DEPS \
  -u PIP_DRY_RUN -u PIP_NO_BUILD_ISOLATION -u PIP_REQUIRE_HASHES PIP_USER=0 PIP_DISABLE_PIP_VERSION_CHECK=1 \
  PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt $(PY) -m pip install -q
unexport PYTHONHOME PYTHONPATH

.NOTPARALLEL:
.PHONY: coverage mutation matrix fuzz audit demo test test-programs test-long test-plain lint format clean help

help:  ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1: \2/p' Makefile

$(PY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or later is needed: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

# A stamp per set of packages: a second run installs nothing until the pins or the package's own needs change.
$(VENV)/.run: pyproject.toml constraints.txt | $(PY)
	@echo "installing into $(VENV) ..."
	@$(PIP_INSTALL) -e .
	@touch $@

$(VENV)/.test: pyproject.toml constraints.txt | $(PY)
	@echo "installing into $(VENV), with what the tests need ..."
	@$(PIP_INSTALL) -e '.[test,campaign]'
	@touch $(VENV)/.run $@

$(VENV)/.lint: pyproject.toml constraints.txt | $(PY)
	@echo "installing into $(VENV), with what the checks need ..."
	@$(PIP_INSTALL) -e '.[test,campaign,lint]'
	@touch $(VENV)/.run $(VENV)/.test $@

demo: $(VENV)/.run  ## Fly the paper's figure of eight on the bundled vehicle
	$(PY) -m companion demo

test: $(VENV)/.test  ## Run the tests: units, and whole flights over loopback
	$(PY) -m pytest -n 2 --dist loadfile -m "not long" tests/unit tests/loopback

test-programs: $(VENV)/.test  ## Run what starts whole programs: installed, served, killed, in browsers, with other clients
	$(PY) -m pytest -n 2 --dist loadfile -m "not long" tests/programs tests/clients tests/px4

test-long: $(VENV)/.test  ## Run the tests that take their time: whole campaigns, fault matrices, real time
	$(PY) -m pytest -n 2 --dist loadfile -m long

test-plain: $(VENV)/.test  ## Run test and test-programs as they run where numba is not installed
	COMPANION_TEST_WITHOUT_NUMBA=1 $(PY) -m pytest -n 2 --dist loadfile -m "not long"

coverage: $(VENV)/.test  ## Run the tests as plain Python and say how many branches they reach; the programs they start count
	mkdir -p .coverage && rm -f .coverage/data*
	-COMPANION_TEST_WITHOUT_NUMBA=1 COVERAGE_PROCESS_START=pyproject.toml \
	  $(PY) -m coverage run -m pytest -n 2 --dist loadfile -m "not long"
	$(PY) -m coverage combine -q
	$(PY) -m coverage report --fail-under=90
	$(PY) tools/branches.py

mutation: $(VENV)/.test  ## Change the law and the guards in one place at a time: a test must notice; hours
	$(PY) tools/mutation.py

matrix: $(VENV)/.test  ## Fly the whole fault matrix: an hour or more on two idle cores
	$(PY) tools/fault_matrix.py singles && $(PY) tools/fault_matrix.py pairs && $(PY) tools/fault_matrix.py real

lint: $(VENV)/.lint  ## Check style, types and import rules
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(PY) -m pytest tests/unit/test_imports.py

format: $(VENV)/.lint  ## Rewrite the code in the project's style
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

$(VENV)/.fuzz: $(VENV)/.test
	@echo "installing what fuzzes into $(VENV) ..."
	@$(PIP_INSTALL) -e '.[test,fast,fuzz]'
	@touch $@

$(VENV)/.audit: $(VENV)/.run
	@echo "installing what audits into $(VENV) ..."
	@$(PIP_INSTALL) -e '.[audit]'
	@touch $@

fuzz: $(VENV)/.fuzz  ## Fuzz everything that reads bytes from elsewhere: ten million inputs, an hour or more
	$(PY) tools/fuzz.py

audit: $(VENV)/.audit  ## Ask for known vulnerabilities of the pinned packages, where advisories can be reached
	$(PY) tools/audit.py

clean:  ## Remove what the targets above made
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
