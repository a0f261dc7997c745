# `make run` and `make test` are all that a newcomer needs; each makes .venv first.
PYTHON ?= python3
# Where to take torch from; empty means wherever pip takes it from (see docs/install.md).
TORCH_INDEX ?=
BIN := .venv/bin
INSTALLED := .venv/.installed
DOCS_INSTALLED := .venv/.installed-docs

VIEWER_PACKAGES := mesa-vulkan-drivers libvulkan1 chromium chromium-driver

.PHONY: run docs docs-serve figures lint test test-integration test-oldest test-newest test-slow test-wheel test-gpu test-viewer test-docs viewer-packages check bench bench-gpu clean

run: $(INSTALLED)
	$(BIN)/python recipes/tragedy.py --watch serve --linger

# The site of docs/*.md with the reference, warnings as errors; docs-serve serves it on 127.0.0.1, PORT takes another port.
docs: $(DOCS_INSTALLED)
	cd docs && ../$(BIN)/python -m website.build

# The committed figures drawn anew, in one style; GROUPS="institutions governs" draws a part of them.
figures: $(INSTALLED)
	$(BIN)/python docs/draw_figures.py $(GROUPS)

docs-serve: docs
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory build/site $(or $(PORT),8765)

# ARGS="tests/learners/test_ring.py" runs a part of the tests.
PYTEST := python -m pytest -n auto --dist worksteal
NOT_HERE := not slow and not gpu and not viewer and not network and not docs

test: $(INSTALLED)
	$(BIN)/$(PYTEST) $(ARGS)

test-integration: $(INSTALLED)
	$(BIN)/$(PYTEST) -m "integration and $(NOT_HERE)" $(ARGS)

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -m slow

# The oldest and the newest versions that pyproject.toml allows, each in an environment of its own; see
# docs/install.md.
MORE_TORCH := $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
test-oldest test-newest: test-%: .venv-%/.installed
	.venv-$*/bin/$(PYTEST) -m "$(NOT_HERE)" $(ARGS)

.venv-oldest/.installed: pyproject.toml tests/support/oldest.py
	$(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/python -m pip install -q packaging
	.venv-oldest/bin/python tests/support/oldest.py dev > .venv-oldest/constraints.txt
	.venv-oldest/bin/python -m pip install -q $(MORE_TORCH) -c .venv-oldest/constraints.txt -e ".[dev]"
	touch $@

.venv-newest/.installed: pyproject.toml
	$(PYTHON) -m venv .venv-newest
	.venv-newest/bin/python -m pip install -q $(MORE_TORCH) --upgrade --upgrade-strategy eager -e ".[dev]"
	touch $@

# Real viewers without a screen, pictures of which are looked at; see docs/watching.md.
test-viewer: $(INSTALLED) viewer-packages
	$(BIN)/python -m pytest -m viewer

# The site built and looked at in Chromium, at two widths.
test-docs: $(DOCS_INSTALLED) viewer-packages
	$(BIN)/python -m pytest -m docs

viewer-packages:
	sh tests/support/install_viewers.sh $(VIEWER_PACKAGES)

# The wheel, in a bare environment outside the checkout; pip fetches what it needs.
test-wheel: $(INSTALLED)
	$(BIN)/python -m pytest -m network tests/house/test_wheel.py

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check: lint test test-integration

bench: $(INSTALLED)
	$(BIN)/python benchmarks/start_up.py
	$(BIN)/python benchmarks/env_steps.py
	$(BIN)/python benchmarks/observation_forms.py
	$(BIN)/python benchmarks/institutions.py
	$(BIN)/python benchmarks/lane_updates.py
	$(BIN)/python benchmarks/training_step.py
	$(BIN)/python benchmarks/many_worlds.py
	$(BIN)/python benchmarks/losses.py
	$(BIN)/python benchmarks/watching.py

# With a GPU: first `.venv/bin/pip install -c constraints.txt -e ".[cuda13]"`, or cuda12, as torch has it.
test-gpu: $(INSTALLED)
	$(BIN)/python -m pytest -m gpu

bench-gpu: $(INSTALLED)
	$(BIN)/python benchmarks/gpu_steps.py

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -c "import sys; sys.version_info >= (3, 11) or sys.exit('cprl needs Python 3.11 or newer, this is ' + sys.version.split()[0] + '; try: make PYTHON=python3.12 ...')"
	$(PYTHON) -m venv .venv
	$(if $(TORCH_INDEX),$(BIN)/python -m pip install -q -c constraints.txt --index-url $(TORCH_INDEX) torch)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev]"
	touch $@

# Apart from dev, so that `make run` and `make test` install no more than they need.
$(DOCS_INSTALLED): $(INSTALLED)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[docs]"
	touch $@

clean:
	rm -rf .venv .venv-oldest .venv-newest
