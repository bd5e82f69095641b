# Each target makes .venv and installs what it needs.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-fast test-long goldens lint docs site size versions clean

demo: .venv/installed
	$(BIN)/jaxbl demo

# one worker a core: more threads of linear algebra would only wait for one another; modules are compiled once, for all processes
PYTEST := OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

# all but what runs or opens the pages of docs, which `make docs` does
test: .venv/installed-dev
	$(PYTEST) -m "not pages"

# without slow tests (tests/durations.json), and those that call a browser or a compiler
test-fast: .venv/installed-dev
	$(PYTEST) -m "not slow and not program and not pages"

# hundreds of kills, damages and random inputs, a million steps
test-long: .venv/installed-dev
	$(PYTEST) -m long --long

# results of the tree beside those of the base commit, and what moved: make goldens ONLY="export_code tune"
goldens: .venv/installed-dev
	$(BIN)/python benchmarks/goldens.py $(if $(ONLY),--only $(ONLY))

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# every page as written, then the site, and its pages in a browser
docs: .venv/installed-dev
	$(PYTEST) -m pages

# from the pages, docstrings, and the studies of the gallery
site: .venv/installed-dev
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet --builder html --conf-dir docs . docs/_build/html

# lines, tokens and words by folder; tests/test_size.py holds ceilings
size:
	$(PYTHON) benchmarks/size.py

versions: .venv/installed-dev
	.ci/versions

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/installed: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e .
	@touch $@

# by uv, which takes a fourth of pip's time; without bytecode each process would compile what it imports
.venv/installed-dev: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python -e ".[dev,logs]"
	@touch $@ .venv/installed

clean:
	rm -rf .venv results docs/_build
