# Two commands matter: `make demo` and `make test`. Paths are relative, so a folder with spaces in its name is fine.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
# pip reads the pins for the package's own build requirements from here as well.
export PIP_CONSTRAINT := constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test test-plain lint format bench clean help
help:  ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' Makefile

$(PY):
	$(PYTHON) -m venv $(VENV)

# A stamp per set of packages: a second run installs nothing until the pins or the package's own needs change.
$(VENV)/.run: pyproject.toml constraints.txt | $(PY)
	$(PY) -m pip install -q -c constraints.txt -e .
	@touch $@

$(VENV)/.test: $(VENV)/.run
	$(PY) -m pip install -q -c constraints.txt -e '.[test,fast]'
	@touch $@

$(VENV)/.lint: $(VENV)/.run
	$(PY) -m pip install -q -c constraints.txt -e '.[lint]'
	@touch $@

demo: $(VENV)/.run  ## Fly the paper's figure of eight on the bundled vehicle
	$(VENV)/bin/python -m companion demo

test: $(VENV)/.test  ## Run the tests
	$(PY) -m pytest

test-plain: $(VENV)/.test  ## Run the tests as they run where numba is not installed
	COMPANION_TEST_WITHOUT_NUMBA=1 $(PY) -m pytest

lint: $(VENV)/.lint $(VENV)/.test  ## Style, types and import rules
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(PY) -m pytest tests/unit/test_imports.py

format: $(VENV)/.lint  ## Rewrite the code in the project's style
	$(PY) -m ruff format .
	$(PY) -m ruff check --fix .

clean:  ## Remove what the targets above made
	rm -rf $(VENV) build dist flights
