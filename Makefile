# Everything runs in .venv/ in this checkout, made where it is missing, with the versions of constraints.txt.
# Without make, or on Windows: README.md has the same commands for pip.

PYTHON ?= python3
BIN := .venv/bin
# For processes beside one another: one thread each, and threads that wait let others work.
SHARING := OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt

.PHONY: demo gui test coverage lint bench bench-quick bench-code bench-memory bench-plugin soak peers docs docs-images docs-results screenshots clean

demo: .venv/base
	mkdir -p demo
	$(BIN)/fiberburst demo --output demo/demo.png

# Tracing napari's own code takes as long as the tests do, so it is not part of `make test`.
coverage: .venv/dev
	$(SHARING) $(BIN)/python -m pytest --numprocesses auto --dist worksteal --cov=napari_fiberburst

gui: .venv/gui
	$(BIN)/napari --with napari-fiberburst "Fiber burst reconstruction"

# One process a core, each with one thread: small bursts leave no work for more. Processes that have opened napari's
# windows are slow at anything else, so the plugin's tests have their own.
test: .venv/dev
	@$(BIN)/python tests/preflight.py
	$(SHARING) $(BIN)/python -m pytest --numprocesses auto --dist worksteal --ignore tests/plugin
	$(SHARING) $(BIN)/python -m pytest --numprocesses auto --dist worksteal tests/plugin

lint: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/npe2 validate src/napari_fiberburst/napari.yaml

# Every table and figure of the documentation: some 90 minutes on two cores. BURST=FOLDER adds the real burst's table;
# MORE passes anything else on: make bench MORE=--resume
bench: .venv/bench .venv-peers/made
	$(BIN)/python -m benchmarks $(if $(BURST),--burst $(BURST)) $(MORE)

bench-quick: .venv/bench
	$(BIN)/python -m benchmarks --quick --results benchmarks/results-quick --overwrite $(MORE)

# What a change of the code may cost, in under five minutes: a step, startup, and whole fits beside an earlier version's.
bench-code: .venv/bench
	$(BIN)/python benchmarks/step.py
	$(BIN)/python benchmarks/startup.py
	$(BIN)/python -m benchmarks.speed

# Memory beside its estimate, run by run: a quarter of an hour.
bench-memory: .venv/bench
	$(BIN)/python -m benchmarks.memory

# What is promised of files, memory, processes and faults, tried for long; under 15 minutes on two cores.
soak: .venv/soak
	OMP_NUM_THREADS=1 $(BIN)/python -m soak $(MORE)

# PyFibreBundle, away from napari: its OpenCV brings another Qt.
peers: .venv-peers/made

# In a window that is drawn: without a display, under xvfb-run.
bench-plugin: .venv/gui
	$(BIN)/python benchmarks/plugin.py

screenshots: .venv/dev
	$(BIN)/python examples/show_the_plugin.py docs/plugin
	$(BIN)/python examples/record_the_plugin.py docs/plugin.gif
	$(BIN)/python examples/record_live.py docs/live.gif

# The site, in site/; what is wrong in it is an error.
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# What the site shows of the examples, and of the latest `make bench`. Rows that were not measured anew stay; only some
# tables: make docs-results MORE="--tables 1 2"
docs-images: .venv/bench
	cd docs/gallery && for name in read_the_evidence as_recorded where_it_fails wide_mosaic clean_video; do \
	  ../../$(BIN)/python ../../examples/$$name.py || exit 1; done
	mkdir -p docs/gallery/stages && cd docs/gallery/stages && ../../../$(BIN)/python ../../../examples/draw_the_stages.py
	for pair in first:your_first_burst trust:can_i_trust_it published:as_published; do \
	  mkdir -p docs/tutorials/images/$${pair%:*} && cd docs/tutorials/images/$${pair%:*} \
	  && ../../../../$(BIN)/python ../../../../examples/$${pair#*:}.py && rm -f *.tif *.json && cd ../../../.. || exit 1; done

docs-results: .venv/bench
	$(BIN)/python -m benchmarks.publish docs/results $(MORE)

clean:
	rm -rf .venv .venv-peers demo site .coverage .mypy_cache .pytest_cache .ruff_cache

.venv/base: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable .
	@touch $@

.venv/gui: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable . --group gui
	@touch $@

.venv/bench: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable . --group bench
	@touch $@

.venv/docs: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable . --group docs
	@touch $@

.venv/soak: pyproject.toml constraints.txt | .venv/pip
	$(PIP) --editable . --group soak
	@touch $@

.venv-peers/made:
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet PyFibreBundle==1.3.6
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
