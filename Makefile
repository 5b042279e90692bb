# SPDX-License-Identifier: Apache-2.0
# `make demo` and `make test` do all they need; `make help` lists the rest.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup dev networks browser build test test-slow test-soak lint docs demo bench arms soak blind blind-short clean

STARTER ?= python3
SETUP = $(STARTER) scripts/setup_env.py
ENTER = source scripts/env.sh
# Test files side by side; every test has a ROS domain of its own. With 0 they go one by one.
# The quick tests wait for more than half of their time, so there is one more of them.
TEST_WORKERS ?= $(if $(filter test,$(MAKECMDGOALS)),3,2)
# They start hundreds of processes: byte code is kept, whatever this shell has set.
PYTEST = env -u PYTHONDONTWRITEBYTECODE python -m pytest --numprocesses $(TEST_WORKERS) --dist loadfile --no-loadscope-reorder
# Given on the command line, as in `make GALEN_PYTHON=/usr/bin/python3.12 build`.
ifdef GALEN_PYTHON
export GALEN_PYTHON
endif

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 20
	@echo "  ARGS='...' is handed to the demo, to pytest, to bench and to blind."

setup: ## make .venv: on the sourced ROS 2 Jazzy, or else with ROS 2 from PyPI
	@$(SETUP) setup

dev: ## add to .venv what tests and checks the packages
	@$(SETUP) dev

networks: ## add PyTorch to .venv (5 GB): deflection's networks need it, nothing else does
	@$(SETUP) networks

browser: ## install Debian's Chromium, which the panel's tests click through the page with
	@scripts/install_browser.sh

build: ## set up, then build the packages
	@$(SETUP) build

test: build dev ## run the quick tests
	@$(ENTER) && $(PYTEST) -m "not slow and not soak" $(ARGS)

test-slow: build dev ## run the slow tests
	@$(ENTER) && $(PYTEST) -m "slow and not soak" --durations 12 $(ARGS)

test-soak: build dev ## run the long tests: a thousand kills, more made-up input (many minutes)
	@$(ENTER) && env -u PYTHONDONTWRITEBYTECODE python -m pytest -m soak $(ARGS)

lint: dev ## check style, format and types
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy

docs: build dev ## build the documentation's site, site/index.html
	@$(SETUP) docs
	@$(ENTER) && NO_MKDOCS_2_WARNING=1 mkdocs build --strict $(ARGS)

demo: build ## calibrate two tools on the simulated arm and show the report's tables
	@$(ENTER) && python -m galen_bringup.demo $(ARGS)

bench: build dev ## measure: nodes against a bare relay, kernels, start-up, diagnosis, bags (40 min)
	@$(ENTER) && python -m galen_validation.speed --output output/bench.json $(ARGS)

arms: build dev ## calibrate robots that others described, a UR5 in MuJoCo, a measured Panda (20 min)
	@$(SETUP) arms
	@$(ENTER) && python -m galen_validation.arms $(ARGS)

soak: build ## run the nodes for long: losses, memory, stamps; an hour simulated, 10 min at 1000 Hz
	@$(ENTER) && python -m galen_validation.soak $(ARGS)

blind: build dev ## hide causes in recordings, diagnose them, score that (an hour or more)
	@$(ENTER) && python -m galen_validation.blind_check run $(ARGS)

blind-short: build dev ## the same with six recordings, always the same ones; must get them right
	@$(ENTER) && python -m galen_validation.blind_check run --short --seed 1

clean: ## remove what was built; with ALL=1 the environment too
	rm -rf build install log $(if $(ALL),.venv)
