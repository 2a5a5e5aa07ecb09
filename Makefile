.DEFAULT_GOAL := help
.PHONY: help setup reproduce run rerun test test-all soak viewer validators fuzz lint bench speed container clean

PYTHON ?= python3
VENV := .venv
VALIDATORS := .validators
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# At these sizes more than one BLAS thread per process is slower.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export NUMBA_NUM_THREADS := 1

TILES ?= 24
SEED ?= 1
CONFIG ?= paper
OUT ?= runs/run
JOBS ?= 2

help: ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 14

setup: $(STAMP) ## Install everything into .venv

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@

ifdef GEROD_ROOT
# The published dataset has no true road mask, and all of its tiles are taken.
REPRODUCED := runs/gerod
TRUE :=
else
REPRODUCED := runs/synthetic-$(TILES)-$(SEED)
TRUE := $(REPRODUCED)/true
endif
LITERAL := $(REPRODUCED)/literal
# The same meshes against the DSM in place of the reference.
BY_DSM := $(REPRODUCED)/dsm
# The column of the paper read literally has fewer tiles: a smaller survey has the first tiles of a larger survey.
LITERAL_TILES ?= $(shell [ $(TILES) -lt 6 ] && echo $(TILES) || echo 6)
SURVEY := $(REPRODUCED)/survey/catalog.parquet
# The same tiles with the true heights and roads as reference, in place of the paper's extended DTM.
TRUE_SURVEY := $(REPRODUCED)/survey/catalog_true.parquet
LITERAL_SURVEY := $(if $(GEROD_ROOT),$(SURVEY),runs/synthetic-$(LITERAL_TILES)-$(SEED)/survey/catalog.parquet)
RESULTS ?= $(REPRODUCED)/results
# The published dataset lies elsewhere than its catalog; an archive is unpacked into a folder beside it.
ABLATE = $(BIN)/flexroad $(if $(GEROD_ROOT),--allow $(GEROD_ROOT:.zip=)) run --store $(REPRODUCED)/store
# DSC3D is not available as rasters: five synthetic scenes replace it, with the paper's reference and the truth.
STANDIN := runs/standin-$(SEED)
SCENES := $(STANDIN)/scenes/catalog.parquet
STAND_IN = $(BIN)/flexroad run --config dsc3d --store $(STANDIN)/store

reproduce: $(SURVEY) $(SCENES) $(LITERAL_SURVEY) ## The paper's tables and figures beside ours, on synthetic tiles (TILES=24 SEED=1) or GEROD_ROOT=FOLDER|ZIP
	$(ABLATE) --catalog $(SURVEY) --config ablation --out $(REPRODUCED)/segmented
	$(if $(TRUE),$(ABLATE) --catalog $(TRUE_SURVEY) --config ablation_true --out $(TRUE))
	$(ABLATE) --catalog $(SURVEY) --config ablation_dsm --out $(BY_DSM)
	$(ABLATE) --catalog $(LITERAL_SURVEY) --config literal --out $(LITERAL)
	$(STAND_IN) --catalog $(SCENES) --out $(STANDIN)/circular
	$(STAND_IN) --catalog $(STANDIN)/scenes/catalog_true.parquet --out $(STANDIN)/true
	$(BIN)/flexroad tables $(REPRODUCED)/segmented $(if $(TRUE),--true $(TRUE)) --dsm $(BY_DSM) --literal $(LITERAL) --dsc3d $(STANDIN)/circular --dsc3d-true $(STANDIN)/true -o $(RESULTS)
	$(BIN)/flexroad figures $(REPRODUCED)/segmented -o $(RESULTS)

# Made once: rasters that are written again have new times, and all results from them would be computed again.
MESHED := $(addprefix tools/synthetic/,command.py dsc3d.py)
MADE := $(filter-out $(MESHED),$(wildcard tools/synthetic/*.py))
runs/synthetic-%-$(SEED)/survey/catalog.parquet: $(MADE) | $(STAMP)
	$(BIN)/flexroad catalog synthetic --preset gerod -o $(@D) --tiles $* --seed $(SEED)

$(SCENES): $(wildcard tools/synthetic/*.py tools/prepare/*.py tools/prepare/*/*.py) | $(STAMP)
	$(BIN)/flexroad catalog synthetic --preset dsc3d -o $(@D) --seed $(SEED)

runs/gerod/survey/catalog.parquet: configs/gerod.yaml | $(STAMP)
	$(BIN)/flexroad catalog gerod $(GEROD_ROOT) -o $@

run: $(STAMP) ## Run a catalog: make run CONFIG=paper CATALOG=... OUT=...
	@test -n "$(CATALOG)" || { echo "error: name a catalog: make run CATALOG=catalog.parquet [CONFIG=$(CONFIG)] [OUT=$(OUT)]" >&2; exit 2; }
	$(BIN)/flexroad run --config $(CONFIG) --catalog $(CATALOG) --out $(OUT)

rerun: $(STAMP) ## Bring tiles of a run up to date: make rerun RUN=... [TILE=...]
	@test -n "$(RUN)" || { echo "error: name a run: make rerun RUN=runs/run [TILE=295500_5629250]" >&2; exit 2; }
	$(BIN)/flexroad rerun $(RUN) $(foreach tile,$(TILE),--tile $(tile))

# Each process has one thread, so that two of them use two cores. A file's tests share fixtures, so they stay together.
PYTEST = $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

TESTED = $(if $(AREA),$(or $(shell find tests -type d -name '$(AREA)'),$(error no folder of tests has the name $(AREA))))
# Both test processes would compile the same functions: two small runs compile them first, side by side.
COMPILED := $(VENV)/.compiled
COMPILING := $(VENV)/compiling
$(COMPILED): $(STAMP) $(wildcard tasks/*.py tasks/*/*.py)
	rm -rf $(COMPILING)
	$(BIN)/flexroad catalog synthetic --tiles 1 --tile-size 120 --decks -o $(COMPILING)/survey > $(VENV)/compiled.log
	printf '%s\n' paper production_vector | xargs -P 2 -I {} $(BIN)/flexroad run --executor serial \
	  --config {} --catalog $(COMPILING)/survey/catalog.parquet --out $(COMPILING)/{} >> $(VENV)/compiled.log
	rm -rf $(COMPILING)
	touch $@

test: $(STAMP) $(if $(AREA),,$(COMPILED)) ## Run the tests except slow tests (minutes), or the tests of one folder: make test AREA=lift
	$(PYTEST) -m "not slow" $(TESTED)

test-all: $(STAMP) $(COMPILED) ## Run all tests
	$(PYTEST)

soak: export FLEXROAD_VALIDATORS := $(VALIDATORS)
soak: $(STAMP) validators ## Run the soak tests and the fuzzer; if all pass, record the commit for .ci/run
	$(BIN)/python -m tests.fuzz --seconds 10 --seed 1 --jobs $(JOBS)
	$(PYTEST) -m soak --soak record

viewer: ## Build the browser viewer into viewer/dist and test its parts (needs npm)
	npm ci --prefix viewer --ignore-scripts --no-audit --no-fund
	node viewer/build.js
	node --test viewer/tests/

# Third-party programs that check exports; FLEXROAD_VALIDATORS=.validators makes the tests use them.
VALIDATED_BY := $(addprefix tests/validators/,requirements.txt package.json package-lock.json)

validators: $(VALIDATORS)/.installed ## Install the programs that check exports into .validators (2 GB, needs npm)

$(VALIDATORS)/.installed: $(VALIDATED_BY)
	$(PYTHON) -m venv $(VALIDATORS)
	$(VALIDATORS)/bin/pip install --quiet --disable-pip-version-check -r tests/validators/requirements.txt
	cp $(filter %.json,$^) $(VALIDATORS)
	npm ci --prefix $(VALIDATORS) --ignore-scripts --no-audit --no-fund
	touch $@

# Two of the eight kinds at a time: half an hour.
FUZZ_SECONDS ?= 450
FUZZ_SEED ?= $(shell date +%s)

fuzz: $(STAMP) ## Damage files of every kind at random and read them: make fuzz [FUZZ_SECONDS=450] [FUZZ_SEED=1]
	$(BIN)/python -m tests.fuzz --seconds $(FUZZ_SECONDS) --seed $(FUZZ_SEED) --jobs $(JOBS)

lint: $(STAMP) ## Check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(STAMP) ## Print the stages beside their floors, peers, starts and make reproduce; one other benchmark: make bench BENCH=ground
	@$(BIN)/python -m bench $(BENCH)

speed: $(STAMP) ## Measure the tables and the plot of docs/results/speed.md anew
	@PYTHONPATH=. $(BIN)/python bench/speed_page.py

# The extras of pyproject.toml in the image, and where PyTorch's build for CPUs comes from.
BUILDER ?= podman
IMAGE ?= flexroad
EXTRAS ?= s3
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

container: ## Build a container image: make container [BUILDER=docker] [IMAGE=flexroad] [EXTRAS=s3,dinov2]
	$(BUILDER) build --build-arg EXTRAS=$(EXTRAS) --build-arg TORCH_INDEX=$(TORCH_INDEX) --tag $(IMAGE) --file Containerfile .

clean: ## Remove the environments, caches and runs
	rm -rf $(VENV) $(VALIDATORS) runs build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
