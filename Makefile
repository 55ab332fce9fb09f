# make demo    install into .venv and run the main job: examples/09_robot_arm.py
# make test    install into .venv and run the tests; PYTEST_ARGS are handed on, PHYSX_CAMPAIGN=full has all cases
# make quick   run the tests that start no process, of one room with P=dataset: a minute at most
# make lint    ruff, mypy and import-linter
# make docs    build the site: docs/_build/docs/index.html
# make bench   print the measured ratios of benchmarks/: 20 minutes
# make wheels  build all packages, and an index of them: dist/, dist/simple/
# make clean   remove .venv and everything that was built

PYTHON ?= $(shell command -v python3.11 || command -v python3)
DEMO_ARGS ?=
PYTEST_ARGS ?= -n 3
BIN := .venv/bin
DIST := --dist loadgroup --no-loadscope-reorder
ROOM = $(wildcard tests/$(P) tests/*/$(P) tests/*/*/$(P))
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
COMPILE := $(BIN)/python -m compileall -q -j 0 .venv/lib >/dev/null 2>&1 || true  # pip uses one core
PACKAGES := -e ./physx -e ./physx_core -e ./physx_testing -e "./physx_sim[robots,meshes,mjcf]" -e ./physx_formats -e "./physx_dart[robots]" -e ./physx_mujoco -e "./physx_torch[export]" -e ./physx_rerun -e "./physx_viser[robots]" -e ./physx_gym -e ./physx_remote -e ./physx_cluster -e ./physx_report -e ./physx_agree -e ./physx_identify
PROJECTS := $(wildcard physx*/pyproject.toml) constraints.txt

.PHONY: demo test quick lint docs bench wheels clean

demo: .venv/packages
	$(BIN)/python examples/09_robot_arm.py $(DEMO_ARGS)

test: .venv/tools
	$(BIN)/python -m pytest $(DIST) $(PYTEST_ARGS)

quick: .venv/tools
	$(BIN)/python -m pytest -q --quick -m "not faults and not slow" -n 2 $(DIST) $(if $(P),$(or $(ROOM),$(error there is no room $(P))))

lint: .venv/tools
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/towncrier build --draft --version next >/dev/null

docs: .venv/tools
	$(BIN)/python -m sphinx -q -W --keep-going -b html -c docs . docs/_build
	@echo docs/_build/docs/index.html

bench: .venv/packages
	$(BIN)/python benchmarks/calls.py
	$(BIN)/python benchmarks/generation.py
	$(BIN)/python benchmarks/campaign.py
	$(BIN)/python benchmarks/training.py
	$(BIN)/python benchmarks/prediction.py
	$(BIN)/python benchmarks/transport.py
	$(BIN)/python benchmarks/faults.py
	$(BIN)/python benchmarks/dataset.py
	$(BIN)/python benchmarks/views.py
	$(BIN)/python benchmarks/judged.py
	$(BIN)/python benchmarks/unrolled.py
	$(BIN)/python benchmarks/larger_than_memory.py
	$(BIN)/python benchmarks/online.py
	$(BIN)/python benchmarks/states.py
	$(BIN)/python benchmarks/crash.py
	$(BIN)/python benchmarks/checkpoint.py
	$(BIN)/python benchmarks/cluster_sweep.py
	$(BIN)/python benchmarks/backends.py
	$(BIN)/python benchmarks/differentiable.py
	$(BIN)/python benchmarks/physics.py
	$(BIN)/python benchmarks/agree.py
	$(BIN)/python benchmarks/identify.py
	$(BIN)/python benchmarks/gym.py
	$(BIN)/python benchmarks/idle_threads.py
	$(BIN)/python benchmarks/remote.py
	$(BIN)/python benchmarks/viewer.py
	$(BIN)/python benchmarks/cluster.py

wheels: build/tools/bin/hatchling
	build/tools/bin/python .ci/wheels.py dist

build/tools/bin/hatchling:
	$(PYTHON) -m venv build/tools
	build/tools/bin/python -m pip install --quiet --disable-pip-version-check hatchling

clean:
	rm -rf build dist docs/_build .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +

.venv/packages: $(PROJECTS)
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "physx needs Python 3.11 or later: make PYTHON=...")'
	@echo Installing into .venv: one to three minutes.
	$(PYTHON) -m venv .venv
	$(PIP) -c constraints.txt $(PACKAGES)
	$(COMPILE)
	touch $@

.venv/tools: .venv/packages requirements-dev.txt requirements-nodeps.txt requirements-lerobot.txt
	$(PIP) -r requirements-dev.txt
	$(PIP) --no-deps -r requirements-nodeps.txt
	rm -rf .venv/lerobot
	$(PIP) --no-deps --target .venv/lerobot -r requirements-lerobot.txt
	$(COMPILE)
	touch $@
