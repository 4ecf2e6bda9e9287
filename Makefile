# Everything runs in .venv/ in this checkout, made where it is missing, with the versions of constraints.txt.
# Without make, or on Windows: README.md has the same commands for pip.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt

.PHONY: demo test lint bench bench-quality clean

demo: .venv/base
	mkdir -p demo
	$(BIN)/fiberburst demo --output demo/demo.png

test: .venv/dev
	@$(BIN)/python tests/preflight.py
	QT_QPA_PLATFORM=offscreen $(BIN)/python -m pytest

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

clean:
	rm -rf .venv demo .coverage .mypy_cache .pytest_cache .ruff_cache

.venv/base: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable .
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
