# Everything runs in .venv/ in this checkout, made where it is missing, with the versions of constraints.txt.
# Without make, or on Windows: README.md has the same commands for pip.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt

.PHONY: demo gui test coverage lint bench bench-quality bench-plugin screenshots clean

demo: .venv/base
	mkdir -p demo
	$(BIN)/fiberburst demo --output demo/demo.png

# Tracing napari's own code takes as long as the tests do, so it is not part of `make test`.
coverage: .venv/dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist worksteal --cov=napari_fiberburst

gui: .venv/gui
	$(BIN)/napari --with napari-fiberburst "Fiber burst reconstruction"

# One process a core, each with one thread: small bursts leave no work for more. Processes that have opened napari's
# windows are slow at anything else, so the plugin's tests have their own.
test: .venv/dev
	@$(BIN)/python tests/preflight.py
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist worksteal --ignore tests/plugin
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist worksteal tests/plugin

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/npe2 validate src/napari_fiberburst/napari.yaml

bench: .venv/base
	$(BIN)/python benchmarks/step.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/startup.py
	$(BIN)/python benchmarks/speed.py

bench-quality: .venv/base
	$(BIN)/python benchmarks/quality.py

# In a window that is drawn: without a display, under xvfb-run.
bench-plugin: .venv/gui
	$(BIN)/python benchmarks/plugin.py

screenshots: .venv/dev
	FIBERBURST_SCREENSHOTS=docs $(BIN)/python -m pytest tests/plugin/test_window.py
	rm docs/plugin_light_1920x1080.png docs/plugin_dark_1920x1080.png
	$(BIN)/python examples/record_the_plugin.py docs/plugin.gif

clean:
	rm -rf .venv demo .coverage .mypy_cache .pytest_cache .ruff_cache

.venv/base: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable .
	@touch $@

.venv/gui: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable . --group gui
	@touch $@

.venv/dev: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable . --group dev
	@touch $@

# pip before 25.1 knows no --group.
.venv/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or newer is needed; name one by: make PYTHON=python3.12 ..."; exit 1; }
	@$(PYTHON) -m venv .venv \
	  || { rm -rf .venv; echo "no virtual environment could be made; on Debian or Ubuntu: sudo apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	@touch $@
