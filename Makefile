# Two commands do everything on a fresh machine with Python 3.11 and make: `make demo`, `make test`.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow lint docs serve clean help

help:
	@echo "make demo   the main job, end to end: real service, simulated device, measured frames"
	@echo "make test   the test suite, without the few dearest tests: make test-slow"
	@echo "make lint   ruff, mypy --strict, import contracts, the kernels' C++ headers"
	@echo "make docs   the documentation site, in build/docs; warnings are errors"
	@echo "make serve  the service on port 8000"

$(STAMP): pyproject.toml lumiline/pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV) ..."
	@PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
		$(BIN)/python -m pip install --disable-pip-version-check \
		--editable ./lumiline --editable '.[dev]'
	@touch $(STAMP)

demo: $(STAMP)
	$(BIN)/lumiline demo

# Compiled modules are kept, also where the environment says not to: tests start many processes.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

test: $(STAMP)
	$(PYTEST) --dist loadfile -m "not slow"

# By the test, not by the file: the few files that there are would leave a core idle. Generated
# examples are new in each run, those of `make test` the same.
test-slow: $(STAMP)
	LUMILINE_TEST_EXAMPLES=random $(PYTEST) --dist worksteal -m slow

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.compute.native.lint

# -E: links between pages are checked in pages that have not changed, too.
docs: $(STAMP)
	$(BIN)/python docs/generators/architecture.py
	$(BIN)/python -m sphinx -E -W --keep-going -q -b html docs build/docs
	@echo "build/docs/index.html"

serve: $(STAMP)
	$(BIN)/lumiline serve

clean:
	rm -rf $(VENV) demo-output
