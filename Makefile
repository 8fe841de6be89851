# make install | demo | play | test | test-all | lint | bench | gpu: each creates or reuses .venv. make findings needs only python3.
SUITS := -c 'import sys; raise SystemExit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do $$p $(SUITS) && echo $$p && break; done)
BIN := .venv/bin
# Marker files: the packages of the demo are installed; all packages, with those of tests and linters, are installed.
COMMA := ,
DEMO := .venv/.demo
INSTALLED := .venv/.installed
ifndef CORES
CORES := $(shell nproc 2>/dev/null || sysctl -n hw.ncpu)
endif
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(CORES)
export MLFLOW_DISABLE_TELEMETRY = true
export DO_NOT_TRACK = true

.PHONY: install demo play sample test test-core test-slow test-all lint format bench gpu findings clean

define INSTALL
@test -n "$(PYTHON)" && $(PYTHON) $(SUITS) || { echo "PYTHON=$(PYTHON): Python 3.11, 3.12 or 3.13 is needed;" \
	"received $$($(PYTHON) --version 2>&1 || echo none). Set PYTHON=/path/to/python3.12"; exit 2; }
@test ! -e .venv -a ! -L .venv || $(BIN)/python $(SUITS) || { echo "Replacing .venv: its Python is missing or not 3.11 to 3.13"; rm -rf .venv; }
@echo "Installing neuspring[$(1)] with $(PYTHON) into .venv (one to four minutes, up to 2.6 GB)"
$(PYTHON) -m venv .venv
PYTHONWARNINGS=ignore PIP_CONSTRAINT="$(CURDIR)/workflow/envs/constraints.txt" $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -e ".[$(1)]"
@touch $@
endef

$(DEMO): pyproject.toml workflow/envs/constraints.txt
	$(call INSTALL,synthetic$(COMMA)video$(COMMA)play)

$(INSTALLED): pyproject.toml workflow/envs/constraints.txt
	$(call INSTALL,dev)
	@touch $(DEMO)

install: $(INSTALLED)

# A .venv whose Python is missing or too old is replaced, whatever marker files it contains.
ifneq ($(shell test ! -e .venv -a ! -L .venv || $(BIN)/python $(SUITS) || echo wrong),)
.PHONY: again
$(DEMO) $(INSTALLED): again
endif

RUNS := $(if $(wildcard $(INSTALLED)),$(INSTALLED),$(DEMO))

demo: $(RUNS)
	$(BIN)/neuspring demo --cores $(CORES)

play: $(RUNS)
	$(BIN)/neuspring play

# Make the packaged twin again (neuspring/data/sample.py): a run of the demo with fewer splats, of which only the files of the twin
# are kept.
SAMPLE := synthetic_single_lift_sloth
SAMPLE_RUN := run.json fit.json twin.npz rollout.json trajectory.npz scores.parquet history.parquet
sample: $(RUNS)
	$(BIN)/snakemake --profile workflow/profiles/default --cores $(CORES) --quiet host progress rules reason --configfile config/data/demo.yaml \
		--config results=.sample 'scenarios=[$(SAMPLE)]' 'methods=[neuspring]' compare_with=neuspring \
		'images={appearance: {spacing: 2.6}}'
	rm -rf neuspring/data/sample_twin && mkdir neuspring/data/sample_twin
	cd .sample && cp --parents -t ../neuspring/data/sample_twin $(SAMPLE)/observations.npz \
		$(SAMPLE)/search-*/0/search.json $(addprefix $(SAMPLE)/neuspring/0/,$(SAMPLE_RUN)) \
		$(addprefix $(SAMPLE)/appearance/0/,appearance.json splats.ply)

test: $(INSTALLED)
	$(PYTEST) --dist worksteal -m "not slow"

# Test the core without extensions, in a copy of the tracked files without both folders of extensions.
test-core: $(INSTALLED)
	rm -rf .core && mkdir .core && git ls-files -z ':!neuspring/extensions' ':!tests/extensions' | xargs -0 cp --parents -t .core
	cd .core && PYTHONPATH=$(CURDIR)/.core PATH="$(CURDIR)/$(BIN):$$PATH" OMP_NUM_THREADS=1 \
		$(CURDIR)/$(BIN)/python -m pytest -n $(CORES) --dist worksteal -m "not slow"
	rm -rf .core

# The tests of a file share a cluster, a database or a group of processes, so each file stays with one worker.
test-slow: $(INSTALLED)
	$(PYTEST) --dist loadfile -m slow

test-all: test test-slow

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/snakefmt --check Snakefile workflow/rules
	$(BIN)/snakemake --lint --configfile config/data/demo.yaml

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile workflow/rules

bench: $(INSTALLED)
	$(BIN)/python -m results.published.bench
	$(BIN)/python -m results.published.bench.splats
	$(BIN)/python -m results.published.bench.spring_gaus

# Requires a GPU; `make gpu GPU_OPTIONS="-k fit"` passes options to pytest. See results/published/bench/GPU.md.
gpu: $(INSTALLED)
	$(BIN)/python -m pytest -m cuda $(GPU_OPTIONS) $(shell grep -rlE '\b(DEVICES|WAYS)\b|import CUDA|mark\.cuda' --include='test_*.py' tests)
	$(BIN)/python -m results.published.bench --device cuda:0

# Each script tests whether an external library still behaves as the script's head says. Exit status 0: yes, 1: no, else: not run.
findings:
	@changed=; missed=; for script in findings/*.sh; do \
		echo "== $$script"; status=0; bash "$$script" || status=$$?; \
		case $$status in \
			0) echo holds;; \
			1) echo CHANGED; changed="$$changed $$script";; \
			*) echo "could not run"; missed="$$missed $$script";; \
		esac; \
	done; \
	echo "changed:$${changed:- none}; could not run:$${missed:- none}"; test -z "$$changed$$missed"

clean:
	rm -rf .venv .snakemake
