# Front door. `make map` maps the embedded sample; `make map SESSION=path [OUT=folder]` maps a log.
SHELL := /bin/bash
SESSION ?= sample
OUT ?=
FLEET ?= fleet.yaml
ARGS ?=
BENCH ?= odometry
PY := .venv/bin/python
PACKAGES := schemas stages pipeline workflows

.PHONY: help setup setup-dev map test check format lock nightly docs clean bench bench-setup viewer

help:
	@echo "make map [SESSION=log] [OUT=folder] [ARGS='--set odometry.voxel_size_m=0.4']   logs into a map"
	@echo "make test     all tests          make check    style, types, import rules"
	@echo "make nightly FLEET=fleet.yaml    many logs      make setup    only set up .venv"
	@echo "make bench [BENCH=odometry|loops|fusion|extension|clean|viewer] [ARGS=...]   accuracy and speed against others; their packages: make bench-setup"

setup:
	@./setup.sh run

setup-dev:
	@./setup.sh dev

map: setup
	@.venv/bin/scanloom map $(SESSION) $(if $(OUT),--out $(OUT)) $(ARGS)

nightly: setup
	@.venv/bin/scanloom nightly $(FLEET) $(ARGS)

test: setup-dev
	$(PY) -m pytest -n 2 --dist loadfile $(ARGS)

check: setup-dev
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/lint-imports
	@mkdir -p build/types/scanloom && for d in $(PACKAGES); do ln -sfn ../../../$$d build/types/scanloom/$$d; done
	MYPYPATH=build/types .venv/bin/mypy $(foreach p,$(PACKAGES),-p scanloom.$(p))

format: setup-dev
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

# Locked for every supported Python at once; needs uv.
lock:
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
		--extra setup pyproject.toml -o requirements.lock
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
		--extra setup --extra export --extra dev -c requirements.lock pyproject.toml -o requirements-dev.lock

clean:
	rm -rf build store maps .venv

# Bundles the libraries of the viewer's page into one file, which is kept in the repository: only whoever updates them needs
# Node.js (https://nodejs.org).
viewer:
	cd workflows/viewer/vendor && npm ci --omit=peer --legacy-peer-deps --ignore-scripts && npm run build
	cp workflows/viewer/vendor/node_modules/three/LICENSE workflows/viewer/vendor/licences/three.txt
	cp workflows/viewer/vendor/node_modules/3d-tiles-renderer/LICENSE workflows/viewer/vendor/licences/3d-tiles-renderer.txt
	rm -rf workflows/viewer/vendor/node_modules

docs: setup
	$(PY) -m scanloom.workflows.reference docs

bench: setup
	@$(PY) -m benchmarks.$(BENCH) $(ARGS)

# The systems that the benchmark compares with; they are no part of the product.
bench-setup: setup
	@$(PY) -m pip install -q --disable-pip-version-check --no-build-isolation -e '.[bench]'
