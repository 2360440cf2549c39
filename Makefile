# The developer's verbs. `make run` and `make test` need nothing but Python 3.11 and make.
PYTHON ?= python3
VENV := .venv
PEERS := .peers
BIN := $(VENV)/bin
ARGS ?=

.PHONY: help run test lint type unit leaderboard faults validate bench bench-data bench-world bench-step bench-models figures peers small docs docs-serve clean

help:  ## Show what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

$(VENV)/installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test,dev,card,cluster,figures,page,render,validation,docs]'
	touch $@

run: $(VENV)/installed  ## From nothing to a leaderboard row (add options by ARGS="--max-steps 500")
	$(BIN)/dlobench run --task meta --model maml --K 10 $(ARGS)

test: lint type leaderboard docs unit  ## Lint, types, the committed board, the site and tests

lint: $(VENV)/installed  ## Ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(VENV)/installed  ## Mypy, strict
	$(BIN)/mypy

unit: $(VENV)/installed  ## The tests alone, a file at a time on every core
	$(BIN)/pytest --numprocesses auto --dist loadfile --durations=8

leaderboard: $(VENV)/installed  ## Verify the committed records, rebuild board and page, and fail on a difference
	$(BIN)/dlobench leaderboard verify
	$(BIN)/dlobench leaderboard build
	$(BIN)/python leaderboard/top.py
	$(BIN)/python paper_figures/findings.py --out paper_figures/tables
	$(BIN)/python paper_figures/table1.py --out paper_figures/tables
	git diff --exit-code --stat -- leaderboard README.md paper_figures/tables

faults: $(VENV)/installed  ## Kills, flipped bytes, full disks, lost nodes: all rounds (2 minutes)
	DLOBENCH_FAULTS=1 $(BIN)/pytest -m faults --durations=8

bench: $(VENV)/installed  ## Benchmarks, with their ratios
	$(BIN)/pytest tests/benchmarks --benchmark-enable --benchmark-sort=name

bench-data: $(VENV)/installed  ## Generation, verification, reading and executors beside their peers
	$(BIN)/pytest tests/benchmarks/test_generation.py tests/benchmarks/test_data.py tests/benchmarks/test_workers.py \
		--benchmark-enable --benchmark-sort=name

bench-world: $(VENV)/installed  ## The world beside MuJoCo's rod, ball joints and its own environment (3 minutes)
	$(BIN)/pytest tests/benchmarks/test_world.py tests/benchmarks/test_memory.py --benchmark-enable --benchmark-sort=name

bench-step: $(VENV)/installed  ## Step-size error against speed, as a picture
	$(BIN)/python tests/benchmarks/step_size.py docs/pictures/step_size.png

bench-models: $(VENV)/installed  ## Steps of models beside their peers, and predictions a second
	$(BIN)/pytest tests/benchmarks/test_models.py tests/benchmarks/test_training.py tests/benchmarks/test_fit_memory.py \
		--benchmark-enable --benchmark-sort=name

peers: $(PEERS)/installed  ## learn2learn and torch_geometric beside ours: the same gradients, and the race (builds .peers)
	$(PEERS)/bin/python -m pytest tests/test_maml.py tests/test_contract.py -k learn2learn -rA
	$(PEERS)/bin/python -m pytest tests/benchmarks -k 'learn2learn or step_of_the_graph' --benchmark-enable --benchmark-sort=name

# Both peers are for these races alone. learn2learn is only to be had as sources, which pip 26 builds with this option and pip 23
# does not. All else is borrowed from .venv, so that both sides of a race have one torch.
$(PEERS)/installed: $(VENV)/installed
	$(BIN)/python -m venv --clear $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check 'pip==26.*'
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
		> $$($(PEERS)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/borrowed.pth
	$(PEERS)/bin/python -m pip install --quiet --no-deps learn2learn==0.2.0 --config-settings=--build-option=build_ext
	$(PEERS)/bin/python -m pip install --quiet --no-deps torchvision==0.28.0 gym==0.26.2 gym-notices==0.1.0 cloudpickle qpth==0.0.18 \
		torch_geometric==2.8.1 psutil
	$(PEERS)/bin/python -m pip install --quiet --no-deps --editable .
	touch $@

figures: $(VENV)/installed  ## The paper's figures and those beyond it, into paper_figures/out (ARGS="--out FOLDER")
	$(BIN)/python paper_figures $(ARGS)

small: $(VENV)/installed  ## The board's records at scale small: hours, and it says how many (ARGS="--plan" only says it)
	$(BIN)/python leaderboard/small.py $(ARGS)

validate: $(VENV)/installed  ## The world beside closed forms and independent codes (up to 10 minutes)
	$(BIN)/dlobench validate

docs: $(VENV)/installed  ## The documentation site, strictly: open site/index.html (10 seconds)
	cp leaderboard/index.html docs/board.html
	$(BIN)/zensical build --strict --clean

docs-serve: docs  ## The site at localhost:8000, built again as pages change
	$(BIN)/zensical serve

clean:  ## Remove the environment and the caches; data and records stay
	rm -rf $(VENV) $(PEERS) build dist site .cache *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
