# Everything runs in .venv, which the first target that needs it creates.
#   make demo                              grow the demo's part (CONFIG=, SCENE=, OUT= change what)
#   make test                              all fast tests (minutes); PYTEST_ARGS="-k union -x" narrows them down
#   make fuzz N=5000 SEED=1           spoiled inputs, and a table of how the command line takes them
#   make mutants                           how many small faults the tests find, an hour (MUTANTS="--sample 60")
#   make docs                              the documentation site, into build/site
#   make wheel                             builds the wheel and tries it outside the repository
#   make types                             the type checker, a minute
#   make bench | lint | clean
#   TORCH_INDEX=<url> make demo            take torch from another index first (see README, "Installation")
PYTHON ?= python3
SCENE ?= scenes/cat/scene.xml
CONFIG ?= quick
OUT ?= runs/demo
TORCH ?= torch==2.13.0
TORCH_INDEX ?=
PYTEST_ARGS ?=
N ?= 500
MUTANTS ?=
SEED ?= 0

PY := .venv/bin/python
STAMP := .venv/.installed

.PHONY: demo test fuzz mutants docs wheel bench lint types clean install llvm
.DEFAULT_GOAL := demo

install: $(STAMP)

$(STAMP): pyproject.toml tools/make_venv.sh
	@PYTHON="$(PYTHON)" TORCH="$(TORCH)" TORCH_INDEX="$(TORCH_INDEX)" bash tools/make_venv.sh
	@touch $@

llvm:
	@bash tools/ensure_llvm.sh

demo: $(STAMP) llvm
	@if [ -e "$(OUT)" ]; then mv "$(OUT)" "$(OUT).until-$$(date +%Y%m%d-%H%M%S)"; fi
	$(PY) -m fd_mitsuba run $(SCENE) -c $(CONFIG) -o $(OUT)
	@echo "look at $(OUT)/images/appearance.png, or open $(OUT)/report.html; $(OUT)/export/asset.glb opens in Blender"

test: $(STAMP) llvm
	@# Compiled files spare the processes that tests start a third of a second each.
	PYTHONDONTWRITEBYTECODE= $(PY) -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(PYTEST_ARGS)

fuzz: $(STAMP) llvm
	$(PY) tests/fuzz/fuzzer.py -n $(N) --seed $(SEED) --workers 2 --refusals vague

mutants: $(STAMP) llvm
	$(PY) tests/mutation/mutate.py $(MUTANTS)

bench: $(STAMP) llvm
	$(PY) benchmarks/geometry_step.py --json
	$(PY) benchmarks/appearance_step.py --json
	$(PY) benchmarks/full_size_steps.py --json
	$(PY) benchmarks/export_part.py --json
	$(PY) benchmarks/guidance_call.py --json

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --quiet
	@echo "open build/site/index.html"

wheel: $(STAMP) llvm
	PYTHON=$(PY) bash tools/check_wheel.sh

lint: $(STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check --quiet .

types: $(STAMP)
	$(PY) -m basedpyright

clean:
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis
	find src tests benchmarks scenes -name __pycache__ -type d -prune -exec rm -rf {} +
	@echo "kept: .venv and runs (remove them by hand)"
