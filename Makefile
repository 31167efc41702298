# The one door: run, test, lint, bench. Everything lives in .venv, made on first use from the lock file.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CLIENTS := .venv-clients
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: run test test-all lint bench setup lock clean

run: $(VENV)/.ready
	$(BIN)/testbed run loiter_gnss_outage --out runs/loiter_gnss_outage --mavlink tlog:runs/loiter_gnss_outage/run.tlog

test: $(VENV)/.ready
	$(BIN)/pytest -n 2 --dist worksteal

test-all: $(VENV)/.ready $(CLIENTS)/.ready
	$(BIN)/pytest -n 2 --dist worksteal -m "slow or not slow"

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.bench
	$(BIN)/python tests/bench

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d: make PYTHON=/path/to/python3.11" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	@echo 'Installing into $(VENV), once.'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

# The peers that the benchmark compares with; nothing else needs them.
$(VENV)/.bench: $(VENV)/.ready requirements-bench.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-bench.lock
	@touch $@

# The ground stations that the slow tests connect, apart from the testbed's environment. Without what MAVProxy needs for
# its windows only, hence --no-deps.
$(CLIENTS)/.ready: requirements-clients.lock
	$(PYTHON) -m venv $(CLIENTS)
	$(CLIENTS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r $<
	@touch $@

clean:
	rm -rf $(VENV) $(CLIENTS) runs .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
