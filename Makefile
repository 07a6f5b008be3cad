# make demo | demo-data | docs | docs-all | test | test-all | bench | bench-peers | bench-augmentation | bench-planner | bench-field | bench-style | bench-styles | bench-data | check | wheel-test | clean.   All is installed into .venv, once.
PYTHON ?= python3
VENV ?= .venv
PEERS ?= .venv-peers
BIN := $(VENV)/bin
PIP_INSTALL := -m pip --disable-pip-version-check install -qq --constraint constraints.txt
PIP := $(BIN)/python $(PIP_INSTALL)
WORKERS ?= 2
# One thread per worker: torch's own threads fight over the cores that pytest-xdist already uses.
# Neighbours go to one worker, which sets up what they share once.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

.DEFAULT_GOAL := help
.PHONY: help demo demo-data docs docs-all test test-slow test-all bench bench-peers bench-augmentation bench-planner bench-field bench-style bench-styles bench-data lint types check wheel-test clean

help:
	@head -1 Makefile

# torch comes first and pinned: asked for by a range, pip would take a newer build with gigabytes of CUDA packages.
$(VENV)/core.stamp: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) torch==2.13.0
	$(PIP) --editable .
	@touch $@

$(VENV)/dev.stamp: $(VENV)/core.stamp
	$(PIP) --editable '.[dev]'
	@touch $@

$(VENV)/docs.stamp: $(VENV)/dev.stamp
	$(PIP) --editable '.[docs]'
	@touch $@

demo: $(VENV)/core.stamp
	$(BIN)/kcam demo --out demo/

# A set of cubes from the built-in scenes, a look at them, and a patch store: what data_tools/ is for.
demo-data: $(VENV)/dev.stamp
	rm -rf demo-data
	$(BIN)/python data_tools/demo_cubes.py --out demo-data/cubes
	$(BIN)/python data_tools/inspect_cubes.py demo-data/cubes --out demo-data/report
	$(BIN)/python data_tools/extract_patches.py demo-data/cubes --size 128 --stride 64 --out demo-data/patches \
	    --split 0.7/0.3 --workers 2
	$(BIN)/python data_tools/verify_patches.py demo-data/patches

# The site, into docs/_build/html: a warning is an error. docs-all runs the scripts that take minutes, too.
SPHINX := $(BIN)/python -m sphinx -b html -W --keep-going docs docs/_build/html

docs: $(VENV)/docs.stamp
	MPLBACKEND=Agg $(SPHINX)
	$(BIN)/python docs/check_site.py

docs-all: $(VENV)/docs.stamp
	KCAM_DOCS_ALL=1 MPLBACKEND=Agg $(SPHINX)
	$(BIN)/python docs/check_site.py

# Then some on a device that is pretended: what a GPU would refuse is refused there too.
test: $(VENV)/dev.stamp
	$(PYTEST) -m "not slow"
	$(PYTEST) -n 0 -m "not slow" --device pretend tests/test_devices.py

test-slow: $(VENV)/dev.stamp
	$(PYTEST) -m slow
	$(PYTEST) --device pretend

test-all: $(VENV)/dev.stamp
	$(PYTEST)
	$(PYTEST) --device pretend

bench: $(VENV)/dev.stamp
	$(BIN)/python -m benchmarks.bench

bench-augmentation: $(VENV)/dev.stamp
	$(BIN)/python -m benchmarks.augmentation

# 300 random pairs of camera and scene, 100 hard, 200 adversarial, 100 assorted and 200 strange ones, planned at five
# tolerances and measured: two hours.
bench-planner: $(VENV)/dev.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.planner
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.planner --unseen --random 50 --hard 15 --adversarial 20 --assorted 40 --strange 40

# Pictures over the field, up to 12 megapixels: an hour. PARTS=methods measures one part anew, the others stay.
PARTS ?= pictures,growth,methods,gradient
bench-field: $(VENV)/dev.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.field --only $(PARTS)

# One step at the thesis's sizes: ten minutes. Four styles and all arms, trained and measured: half an hour.
bench-style: $(VENV)/dev.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.style_step

bench-styles: $(VENV)/dev.stamp
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.style
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.style --styles strokes --arms stage --seeds 1,2
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.style --collect
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.style --paint

# The peers come with dependencies of their own, so they get an environment of their own.
$(PEERS)/peers.stamp: pyproject.toml constraints.txt benchmarks/peers.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python $(PIP_INSTALL) torch==2.13.0
	$(PEERS)/bin/python $(PIP_INSTALL) --editable .
	for peer in $$(grep -v '^#' benchmarks/peers.txt); do \
	    $(PEERS)/bin/python $(PIP_INSTALL) $$peer || echo "$$peer does not install here and is skipped"; done
	@touch $@

bench-peers: $(PEERS)/peers.stamp
	OMP_NUM_THREADS=1 $(PEERS)/bin/python -m benchmarks.peers

# Zarr is there to be compared with, and for export; nothing else needs it.
bench-data: $(VENV)/dev.stamp
	$(PIP) --editable '.[zarr]' || echo "zarr does not install here and is skipped"
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.patches

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .

types: $(VENV)/dev.stamp
	$(BIN)/mypy

check: lint types test

# The wheel, in an environment of its own and from another folder: tables, py.typed and dependencies are all inside.
wheel-test: $(VENV)/core.stamp
	rm -rf .wheel-test && mkdir .wheel-test
	$(BIN)/python -m pip --disable-pip-version-check wheel -qq --no-deps --wheel-dir .wheel-test/dist .
	$(PYTHON) -m venv .wheel-test/venv
	.wheel-test/venv/bin/python $(PIP_INSTALL) torch==2.13.0
	.wheel-test/venv/bin/python $(PIP_INSTALL) .wheel-test/dist/*.whl
	cd .wheel-test && venv/bin/python -I -c 'import kcam, pathlib; root = pathlib.Path(kcam.__file__).parent; \
	    checks = ["site-packages" in str(root), (root / "py.typed").exists(), any(root.glob("tables/*.npz"))]; \
	    print("wheel:", kcam.__version__, root, checks); raise SystemExit(not all(checks))'
	cd .wheel-test && venv/bin/kcam --version && venv/bin/kcam psf --camera phone --out psf.png
	rm -rf .wheel-test

clean:
	rm -rf $(VENV) $(PEERS) .wheel-test build dist demo demo-data docs/_build docs/learn docs/gallery docs/reference/api
