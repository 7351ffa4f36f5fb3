# Needs Python >= 3.11, git and make. Everything is installed into .venv.
PYTHON ?= python3
JOBS ?= 2
RUNS ?= 200
SECONDS ?= 600
FILES ?=
ONLY ?=
REPORT ?= pixmetry-report

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip --disable-pip-version-check
INSTALLED := $(VENV)/.installed
ORACLES := .venv-oracles
# BLAS threads beside JOBS processes would only wait for each other. Bytecode is kept: every process that a test starts would compile anew.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(PY) -m pytest -n $(JOBS) --dist loadfile --hypothesis-seed=0
QUICK := $(PYTEST) -m "not browser and not oracle" --durations=15 --durations-min=5

.DEFAULT_GOAL := help
.PHONY: help install demo test flaky oracles study bench mutants fuzz faults handbook handbook-check docs lint browser-test

help: ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1|\2/p' $(MAKEFILE_LIST) | while IFS='|' read -r target text; do printf '%-20s %s\n' "$$target" "$$text"; done

install: $(INSTALLED) ## install the package into .venv

demo: $(INSTALLED) ## assess the packaged example campaign and write the report
	@$(VENV)/bin/pixmetry assess -o $(REPORT)

# A test that draws may fail by chance: what failed runs once more, with other draws, and must pass.
test: $(INSTALLED)-test ## run the quick tests
	@$(QUICK) || { [ $$? -eq 1 ] && echo "== What failed runs once more, with other draws. ==" && $(QUICK) --last-failed --last-failed-no-failures none; }

flaky: $(INSTALLED)-test ## run tests that draw RUNS=200 times with fresh seeds and tell how often each fails (FILES=...)
	@OPENBLAS_NUM_THREADS=1 $(PY) scripts/flaky.py --runs $(RUNS) --jobs $(JOBS) $(FILES)

oracles: $(INSTALLED)-test $(ORACLES)/.installed ## compare with other people's programs (Python 3.11 or 3.12)
	@$(PYTEST) -m oracle -rP

study: $(INSTALLED)-test ## run the studies in benchmarks/
	@$(call each,$(wildcard benchmarks/study_*.py))

bench: $(INSTALLED)-test ## run the benchmarks
	@$(call each,$(wildcard benchmarks/bench_*.py))

mutants: $(INSTALLED)-test ## plant wrong factors, one at a time, and see whether the tests find them
	@$(PY) scripts/mutants.py --jobs $(JOBS)

fuzz: $(INSTALLED)-all ## damage small files for SECONDS=600 and open them at every door: tracebacks, silent wrong answers, memory
	@OPENBLAS_NUM_THREADS=1 $(PY) scripts/fuzz.py --seconds $(SECONDS)

faults: $(INSTALLED)-all ## kill commands, or fill the disk, at every operation on their output: the old or the new result must stand there
	@$(PY) scripts/faults.py

handbook: $(INSTALLED)-all ## run the handbook's experiments and write docs/handbook (ONLY="PAGE ...": run some)
	@$(PY) scripts/make_handbook.py $(ONLY)

handbook-check: $(INSTALLED)-all ## make the handbook's pages twice and compare them bit by bit
	@$(PY) scripts/make_handbook.py --twice $(ONLY)

docs: $(INSTALLED)-docs ## build the documentation site in site/
	@$(PY) scripts/make_site.py site

lint: $(INSTALLED)-dev ## check style and types
	@$(PY) -m ruff check src tests benchmarks scripts docs
	@$(PY) -m mypy

browser-test: $(INSTALLED)-test $(INSTALLED)-browser ## open the report in chromium and test it
	@command -v chromium >/dev/null || { echo "chromium is not installed (Debian: apt-get install chromium)" >&2; exit 1; }
	@$(PYTEST) -m browser

# Run scripts one after the other and stop at the first that fails.
each = set -e; for script in $(sort $(1)); do echo "== $$script"; $(PY) $$script; done

# The stamp is younger than pyproject.toml once the package is installed. An existing .venv is kept.
$(INSTALLED): pyproject.toml
	@command -v "$(PYTHON)" >/dev/null || { echo "$(PYTHON) was not found; name a Python >= 3.11: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "pixmetry needs Python >= 3.11 and $(PYTHON) is $$($(PYTHON) -V 2>&1); name another: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PY) -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV) || \
		{ echo "$(PYTHON) cannot make a virtual environment (Debian: apt-get install python3-venv)" >&2; exit 1; }
	@echo "installing pixmetry into $(VENV)"
	@$(PIP) install --quiet -e .
	@touch $@

$(INSTALLED)-%: $(INSTALLED)
	@$(PIP) install --quiet -e '.[$*]'
	@touch $@

# What the oracles need (an older NumPy, other licences) never meets the package: an environment of its own.
$(ORACLES)/.installed: scripts/oracles/requirements.txt
	@echo "installing the oracles into $(ORACLES)"
	@$(PY) -m venv $(ORACLES)
	@$(ORACLES)/bin/python -m pip --disable-pip-version-check install --quiet --only-binary=:all: -r $<
	@$(ORACLES)/bin/python -m pip --disable-pip-version-check install --quiet arcticpy-no-gsl 'numpy<2' || echo "no compiler for arcticpy: its tests are skipped"
	@touch $@
