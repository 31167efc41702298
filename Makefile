# The one door: run, test, lint, bench. Everything lives in .venv, made on first use from the lock file.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CLIENTS := .venv-clients
LOWEST := .venv-lowest
COMPILE := $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-emit-index-url
export OPENBLAS_NUM_THREADS ?= 1
# Hundreds of tests start a process of their own, and each would compile every module that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test test-ci test-all lint bench docs wheel-test setup lock clean

run: $(VENV)/.ready
	$(BIN)/testbed run loiter_gnss_outage --out runs/loiter_gnss_outage --mavlink tlog:runs/loiter_gnss_outage/run.tlog

test: $(VENV)/.ready
	$(BIN)/pytest -n 2 --dist worksteal

test-ci: $(VENV)/.ready
	$(BIN)/pytest -n 2 --dist worksteal -m "not slow" --hypothesis-profile=ci

test-all: $(VENV)/.ready $(CLIENTS)/.ready
	$(BIN)/pytest -n 2 --dist worksteal -m "slow or not slow" --hypothesis-profile=all

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The manual, into site/.
docs: $(VENV)/.ready
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(VENV)/.ready
	$(BIN)/python tests/bench $(BENCH)

# The wheel as a user has it, outside the checkout, with the oldest versions that it says it works with.
wheel-test: $(VENV)/.ready $(LOWEST)/.ready
	rm -rf $(LOWEST)/dist
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir $(LOWEST)/dist .
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --force-reinstall $(LOWEST)/dist/*.whl
	$(LOWEST)/bin/python -m pip check
	folder=$$(mktemp -d) && cd $$folder && trap "rm -rf $$folder" EXIT \
		&& "$(CURDIR)/$(LOWEST)/bin/testbed" run static_bench --set duration_s=90 \
		&& "$(CURDIR)/$(LOWEST)/bin/testbed" check regression \
		&& "$(CURDIR)/$(LOWEST)/bin/testbed" init mine \
		&& "$(CURDIR)/$(LOWEST)/bin/testbed" check mine/first.toml

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d: make PYTHON=/path/to/python3.11" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	@echo 'Installing into $(VENV), once.'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

# The ground stations that the slow tests connect, apart from the testbed's environment. Without what MAVProxy needs for
# its windows only, hence --no-deps.
$(CLIENTS)/.ready: requirements-clients.lock
	$(PYTHON) -m venv $(CLIENTS)
	$(CLIENTS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r $<
	@touch $@

$(LOWEST)/.ready: requirements-lowest.lock
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r $<
	@touch $@

# After a change of the dependencies: what is locked stays as it is where it can; for newer versions, delete a lock first.
lock:
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(COMPILE) --extra dev --extra docs --extra examples --extra parquet --extra mcap --output-file requirements.lock pyproject.toml
	$(COMPILE) --resolution lowest-direct --output-file requirements-lowest.lock pyproject.toml
	$(COMPILE) --group clients --no-deps --constraint requirements.lock --output-file requirements-clients.lock

clean:
	rm -rf $(VENV) $(CLIENTS) $(LOWEST) runs site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks
	find . -name __pycache__ -prune -exec rm -rf {} +
