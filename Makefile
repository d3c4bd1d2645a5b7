# Sets up a clone: a machine needs only Python >= 3.10 and make. `make help` lists the goals.

# ':=' rather than '?=', so that variables of these names in the user's environment have no effect
ALGO := cgp
ENV := Pendulum-v1
SEED := 0
# Environment steps. Empty: the number in the algorithm's YAML file.
STEPS :=
# Environment steps between evaluations. Empty: a twentieth of all, at most 10,000 (benchmark/plan.py).
EVAL_FREQ :=
EVAL_EPISODES := 10
# PyTorch's threads. One by default: two threads that share their cores with other processes can be ten times slower.
THREADS := 1
LOGS := logs
# Hyperparameters to override, and other options of rl_zoo3.train.
PARAMS :=
ARGS :=
# The folder of the run to resume.
RUN :=
# The packages whose environments are tested. Empty: all.
PACKAGES :=

PYTHON ?= python3
VENV := .venv
CONSTRAINTS := constraints.txt
IN_VENV := $(VENV)/bin/python
# For release-check: the tag, and the address of the repository in which it was set (empty: not compared)
TAG :=
ADDRESS :=
# Each test process loads PyTorch, hence the limit
PYTEST := $(IN_VENV) -m pytest --numprocesses logical --maxprocesses 8 --durations 15

# One stamp for each extra that is installed
STAMP := $(VENV)/.installed-
INSTALLED := $(STAMP)zoo
SWEEPS_INSTALLED := $(STAMP)sweeps
TESTS_INSTALLED := $(STAMP)tests
DOCS_INSTALLED := $(STAMP)docs
DIST_INSTALLED := $(STAMP)dist
# An editable install holds copies of the version and of the start-up hook.
REQUIREMENTS := setup.cfg setup.py pyproject.toml $(CONSTRAINTS) _build_backend.py sb3_cgp/version.txt

# A misspelt variable would have no effect. Within another make, variables may be those of the outer one.
KNOWN := ALGO ENV SEED STEPS EVAL_FREQ EVAL_EPISODES THREADS LOGS PARAMS ARGS RUN PACKAGES PYTHON VENV CONSTRAINTS TAG ADDRESS
OTHERS := IN_VENV PYTEST PYTEST_% PIP_% PYTHON% CUDA_% OMP_% MKL_% MUJOCO_% MAKE% GNUMAKE% MFLAGS SHELL .%
GIVEN := $(foreach name,$(.VARIABLES),$(if $(filter command,$(origin $(name))),$(name)))
UNKNOWN := $(filter-out $(KNOWN) $(OTHERS),$(GIVEN))
ifneq ($(and $(filter 0,$(MAKELEVEL)),$(UNKNOWN)),)
$(error There is no variable $(UNKNOWN), but: $(KNOWN). Set variables of other programs before make: $(firstword $(UNKNOWN))=... make)
endif

.DEFAULT_GOAL := help
.PHONY: help train resume sweeps docs test test-quick test-slow test-oldest test-environments lint format dist release-check clean

help: ## list the goals
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-17s %s\n", $$1, $$2}' Makefile
	@echo
	@echo "make train takes ALGO=$(ALGO) ENV=$(ENV) SEED=$(SEED) STEPS= EVAL_FREQ= EVAL_EPISODES=$(EVAL_EPISODES) THREADS=$(THREADS) LOGS=$(LOGS)"
	@echo "PARAMS= (hyperparameters) ARGS= (other options of rl_zoo3.train), as in"
	@echo "  make train ENV=HalfCheetah-v5 STEPS=60000 SEED=1"
	@echo "  make train ALGO=td3 ENV=HalfCheetah-v5 PARAMS=\"batch_size:128 learning_starts:10000\" ARGS=\"--save-freq 10000\""
	@echo "make test-environments takes PACKAGES=\"panda-gym metaworld\" and ARGS= (other options of benchmark.environments)"
	@echo "Every goal that needs Python takes PYTHON=$(PYTHON) (3.10 or newer)."

train: $(INSTALLED) ## install, train with rl_zoo3, evaluate and draw the learning curve
	@plan=$$($(IN_VENV) -m benchmark.plan --algo $(ALGO) --env $(ENV) --folder "$(LOGS)" $(if $(STEPS),--steps $(STEPS)) \
	  $(if $(PARAMS)$(ARGS),-- $(if $(PARAMS),-params $(PARAMS)) $(ARGS))) && \
	set -- $$plan && \
	trap 'interrupted=1' INT && \
	(set -x; exec $(IN_VENV) -m rl_zoo3.train --algo $(ALGO) --env $(ENV) --seed $(SEED) --num-threads $(THREADS) \
	  $(if $(STEPS),--n-timesteps $(STEPS)) \
	  --eval-freq $(or $(EVAL_FREQ),$$1) --eval-episodes $(EVAL_EPISODES) --log-folder "$(LOGS)" --progress \
	  --tensorboard-log "$(LOGS)/tensorboard" \
	  $(if $(PARAMS),-params $$3 $(PARAMS),$${3:+-params $$3}) $(ARGS)) && \
	if test -n "$$interrupted"; then \
	  run="$(LOGS)/$(ALGO)/$(subst /,-,$(ENV))_$$2"; \
	  if ls "$$run"/state/state-*.json > /dev/null 2>&1; then echo "or  make resume RUN=\"$$run\""; fi; exit 130; fi && \
	$(IN_VENV) -m benchmark.report --algo $(ALGO) --env $(ENV) --folder "$(LOGS)" --exp-id $$2

# Before the installation
ifneq ($(filter resume,$(MAKECMDGOALS)),)
ifeq ($(strip $(RUN)),)
$(error Name the run's folder, as in: make resume RUN=logs/cgp/Pendulum-v1_1)
endif
ifeq ($(shell test -d "$(RUN)" && echo yes),)
$(error There is no folder $(RUN): give the folder of a run, as in: make resume RUN=logs/cgp/Pendulum-v1_1)
endif
endif

resume: $(INSTALLED) ## continue an interrupted run of CGP to its end, and report: make resume RUN=logs/cgp/Pendulum-v1_1
	$(IN_VENV) -m sb3_cgp.zoo.resume "$(RUN)"
	$(IN_VENV) -m benchmark.report --run "$(RUN)"

sweeps: $(SWEEPS_INSTALLED) ## install the requirements of benchmark.sweep and benchmark.tune

docs: $(DOCS_INSTALLED) ## install, build the documentation site into build/site, and check its links
	rm -rf build/site
	$(IN_VENV) -m sphinx -c docs --fail-on-warning --keep-going --quiet --doctree-dir build/doctrees . build/site
	$(IN_VENV) docs/check_site.py build/site
	@echo "Open build/site/index.html"

test: lint ## install, lint and run the quick tests on all cores, with coverage
	$(PYTEST) --dist worksteal -m "not slow" --cov --cov-report=term-missing:skip-covered --cov-fail-under=95

test-quick: $(TESTS_INSTALLED) ## run the quick tests alone: no lint, no coverage
	$(PYTEST) --dist worksteal -m "not slow"

test-oldest: ## run the quick tests with the oldest versions that setup.cfg admits, in .venv-oldest: PYTHON=python3.10
	$(MAKE) VENV=.venv-oldest CONSTRAINTS=constraints-oldest.txt test-quick

test-slow: $(TESTS_INSTALLED) ## run the tests that take minutes: learning, packaging
	$(PYTEST) --dist loadgroup -m slow

test-environments: $(SWEEPS_INSTALLED) ## test CGP on other packages' environments, each in a virtual environment of its own
	$(IN_VENV) -m benchmark.environments $(if $(PACKAGES),--packages $(PACKAGES)) $(ARGS)

lint: $(TESTS_INSTALLED) ## check by ruff, black, import-linter and mypy, changing nothing
	$(IN_VENV) -m ruff check .
	$(IN_VENV) -m black --check .
	$(VENV)/bin/lint-imports --no-logo
	$(IN_VENV) -m mypy

format: $(TESTS_INSTALLED) ## reformat and correct by ruff and black
	$(IN_VENV) -m ruff check --fix .
	$(IN_VENV) -m black .

# Without isolation, the build downloads nothing.
dist: $(DIST_INSTALLED) ## install, build the sdist and the wheel into dist/, and check them by twine
	rm -rf dist
	$(IN_VENV) -m build --no-isolation
	$(IN_VENV) -m twine check --strict dist/*

release-check: ## check that TAG=v... can be released: the version, the changelog, the repository's address
	$(PYTHON) .github/check_release.py "$(TAG)" $(if $(ADDRESS),--address "$(ADDRESS)")

clean: ## remove the virtual environments, build artefacts and caches; trained models stay
	rm -rf $(VENV) .venv-oldest build dist ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .coverage .coverage.* htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is removed before an installation and made after it: without one, the environment is created anew.
# A stamp that is older than the requirements is that of a complete environment, into which the new ones are installed.
$(INSTALLED): $(REQUIREMENTS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "sb3-cgp needs Python 3.10 or newer, but $(PYTHON) is: $$($(PYTHON) --version 2>&1)" >&2; \
	  echo "Name a newer one, as in: make PYTHON=python3.12 $(or $(MAKECMDGOALS),train)" >&2; exit 1; }
	test -e $@ || $(PYTHON) -m venv --clear $(VENV)
	rm -f $(STAMP)*
	$(IN_VENV) -m pip install -c $(CONSTRAINTS) -e ".[zoo]"
	touch $@

# All stamps are touched, because an extra installed earlier is still installed.
$(SWEEPS_INSTALLED) $(DOCS_INSTALLED) $(DIST_INSTALLED) $(TESTS_INSTALLED): $(STAMP)%: $(INSTALLED)
	rm -f $(INSTALLED)
	$(IN_VENV) -m pip install -c $(CONSTRAINTS) -e ".[$*]"
	touch $(INSTALLED) $(filter-out $(INSTALLED),$@ $(wildcard $(STAMP)*))
