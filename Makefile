# All the set-up that a clone needs; a machine brings only Python >= 3.10 and make. `make help` lists the goals.

# ':=' rather than '?=': a variable called ENV or SEED that happens to be in the user's environment is not ours.
ALGO := cgp
ENV := Pendulum-v1
SEED := 0
# Empty: as many steps as the algorithm's YAML file says.
STEPS :=
# Empty: a twentieth of the steps, at most 10,000 (benchmark/plan.py).
EVAL_FREQ :=
EVAL_EPISODES := 10
# PyTorch's threads. One by default: two that share their cores with anything else can be ten times slower than one.
THREADS := 1
LOGS := logs
# Hyperparameters to override, and any other option of rl_zoo3.train.
PARAMS :=
ARGS :=
# The folder of a run to resume.
RUN :=

PYTHON ?= python3
VENV := .venv
IN_VENV := $(VENV)/bin/python

INSTALLED := $(VENV)/.installed
TESTS_INSTALLED := $(VENV)/.installed-tests
# An editable install keeps a copy of the version, and of the hook that the build back-end writes.
REQUIREMENTS := setup.cfg pyproject.toml constraints.txt _build_backend.py sb3_cgp/version.txt

.DEFAULT_GOAL := help
.PHONY: help train resume test test-slow lint format clean

help: ## list the goals
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' Makefile
	@echo
	@echo "make train takes ALGO=$(ALGO) ENV=$(ENV) SEED=$(SEED) STEPS= EVAL_FREQ= EVAL_EPISODES=$(EVAL_EPISODES) THREADS=$(THREADS) LOGS=$(LOGS)"
	@echo "PARAMS= (hyperparameters) ARGS= (any other option of rl_zoo3.train), as in"
	@echo "  make train ENV=HalfCheetah-v5 STEPS=60000 SEED=1"
	@echo "  make train ALGO=td3 ENV=HalfCheetah-v5 PARAMS=\"batch_size:128 learning_starts:10000\" ARGS=\"--save-freq 10000\""
	@echo "Every goal that needs Python takes PYTHON=$(PYTHON) (3.10 or newer)."

train: $(INSTALLED) ## install, train with rl_zoo3, evaluate and draw the learning curve
	@plan=$$($(IN_VENV) -m benchmark.plan --algo $(ALGO) --env $(ENV) --folder "$(LOGS)" $(if $(STEPS),--steps $(STEPS))) && \
	set -- $$plan && \
	(set -x; $(IN_VENV) -m rl_zoo3.train --algo $(ALGO) --env $(ENV) --seed $(SEED) --num-threads $(THREADS) \
	  $(if $(STEPS),--n-timesteps $(STEPS)) \
	  --eval-freq $(or $(EVAL_FREQ),$$1) --eval-episodes $(EVAL_EPISODES) --log-folder "$(LOGS)" --progress \
	  $(if $(PARAMS),-params $(PARAMS)) $(ARGS)) && \
	$(IN_VENV) -m benchmark.report --algo $(ALGO) --env $(ENV) --folder "$(LOGS)" --exp-id $$2

resume: $(INSTALLED) ## go on with an interrupted run of CGP to its end, and report: make resume RUN=logs/cgp/Pendulum-v1_1
	@test -n "$(RUN)" || { echo "Name the run's folder, as in: make resume RUN=logs/cgp/Pendulum-v1_1" >&2; exit 1; }
	$(IN_VENV) -m sb3_cgp.zoo.resume "$(RUN)"
	$(IN_VENV) -m benchmark.report --run "$(RUN)"

test: lint ## install, lint and run the quick tests, with coverage
	$(IN_VENV) -m pytest -m "not slow" --cov=sb3_cgp --cov-report=term-missing:skip-covered --cov-fail-under=95

test-slow: $(TESTS_INSTALLED) ## run the tests that take minutes: learning, packaging
	$(IN_VENV) -m pytest -m slow --durations=10

lint: $(TESTS_INSTALLED) ## ruff, black and mypy, changing nothing
	$(IN_VENV) -m ruff check .
	$(IN_VENV) -m black --check .
	$(IN_VENV) -m mypy

format: $(TESTS_INSTALLED) ## let ruff and black mend what they can
	$(IN_VENV) -m ruff check --fix .
	$(IN_VENV) -m black .

clean: ## remove the virtual environment, build artefacts and caches; trained models stay
	rm -rf $(VENV) build dist ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .coverage .coverage.* htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is missing from before an installation starts until it has ended, so a half-made environment is made afresh.
# An old stamp means that the requirements changed: they are installed over the environment there is.
$(INSTALLED): $(REQUIREMENTS)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	  echo "sb3-cgp needs Python 3.10 or newer, but $(PYTHON) is: $$($(PYTHON) --version 2>&1)" >&2; \
	  echo "Name a newer one, as in: make PYTHON=python3.12 $(or $(MAKECMDGOALS),train)" >&2; exit 1; }
	test -e $@ || $(PYTHON) -m venv --clear $(VENV)
	rm -f $(INSTALLED) $(TESTS_INSTALLED)
	$(IN_VENV) -m pip install -c constraints.txt -e ".[benchmark]"
	touch $@

$(TESTS_INSTALLED): $(INSTALLED)
	rm -f $(INSTALLED)
	$(IN_VENV) -m pip install -c constraints.txt -e ".[tests]"
	touch $(INSTALLED) $@
