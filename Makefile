# `make demo` and `make test` are the two first commands; `make help` lists all.

# The virtual environment, which every target makes when it is missing or out of date.
VENV ?= .venv
# The Python to make it with; without it, 3.12 or 3.11, whichever is found.
PYTHON ?=
# Further requirements for pip, such as WITH='numpy<2'.
WITH ?=
# Empty for the newest packages that setup.py allows, rather than those that requirements/ names.
LOCK ?= yes
# Further arguments for pytest, such as PYTEST_ARGS='-k bags -x'.
PYTEST_ARGS ?=
# How many processes run the tests; `auto` is one for each core. 0 to use a debugger.
TEST_WORKERS ?= auto
# Further arguments for the study, such as STUDY_ARGS='--only turtle --jobs 1'.
STUDY_ARGS ?=
# Further arguments for the paper's experiments, such as REPRODUCE_ARGS='4.1 --runs 5'.
REPRODUCE_ARGS ?=
# The folder with the recordings of human play, for `make bags` and `make study`.
OVERCOOKED ?= ../shared/data/overcooked
# Further arguments for the campaign of damage, such as CAMPAIGN_ARGS='--cuts 10 --changes 50'.
CAMPAIGN_ARGS ?=
# Arguments for the campaign of bad input: half a minute for each door, led by the code it reaches.
FUZZING_ARGS ?= --guided 30
# Further arguments for the long load, such as SOAK_ARGS='--minutes 5 --limit 20000'.
SOAK_ARGS ?=
# Recordings of others, for `make campaigns`.
BAGS ?= ../shared/data/bags
# The recording of a turtlesim robot, for `make bags`.
TURTLE ?= ../shared/data/bags/turtle_waypoints

BIN := $(VENV)/bin
export PYTHON WITH LOCK

# The environment brings its own ROS 2 and must not see the caller's. A sourced ROS installation
# would put its packages and middleware before ours, and a Python of another such environment, one
# that called make, would leave its libraries and the note that they are set.
ifneq ($(AMENT_PREFIX_PATH)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport AMENT_PREFIX_PATH PYTHONPATH PYTHONHOME RMW_IMPLEMENTATION

.PHONY: help demo test lint unit colcon bags reference policies benchmark campaigns study reproduce venv lock \
	audit clean

help:  ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: venv  ## Replay a human demonstration and watch its subgoals appear
	@$(BIN)/bnirl demo

test: lint unit  ## Check style and types, then run all tests

lint: venv  ## Check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

unit: venv  ## Run the tests, without the checks of style and types
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --maxprocesses 4 --dist loadfile $(PYTEST_ARGS)

colcon:  ## Build, test and run the package with colcon, in a folder that is thrown away
	@scripts/colcon $(PYTEST_ARGS)

bags: venv  ## Make the bags in bags/ again
	$(BIN)/python -m bnirl_ros.experiments.make_bags --overcooked "$(OVERCOOKED)" \
		--turtle "$(TURTLE)"

reference: venv  ## Write docs/reference.md, the topics and parameters of the nodes
	$(BIN)/python -m bnirl_ros.nodes.reference docs/reference.md

# All of them run, also where one misses its bound.
BENCHMARKS ?= main_job start_up running load intent replay large_bag goal_values sequential paper_sampler \
	convergence growth

policies: venv  ## Write policies/, what each node may do where access is controlled
	$(BIN)/python -m bnirl_ros.nodes.policies policies

benchmark: venv  ## Time the main job, its parts and the node, and see how cost grows
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[benchmark]'
	@failed=0; for name in $(BENCHMARKS); do \
		echo "== benchmarks/$$name.py"; \
		$(BIN)/python benchmarks/$$name.py || failed=1; \
	done; exit $$failed

campaigns: venv  ## Bad input for every door, damage, cuts, and half an hour of load
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[campaigns]'
	$(BIN)/python -m bnirl_ros.fuzzing $(FUZZING_ARGS)
	$(BIN)/python -m bnirl_ros.experiments.journal_cuts
	$(BIN)/python -m bnirl_ros.experiments.damage $(CAMPAIGN_ARGS) bags $(wildcard $(BAGS))
	$(BIN)/python benchmarks/lossy_network.py
	$(BIN)/python benchmarks/soak.py $(SOAK_ARGS)

study: venv  ## Measure what the models find, into bnirl_out/study.md
	$(BIN)/python -m bnirl_ros.experiments.study --overcooked "$(OVERCOOKED)" $(STUDY_ARGS)

reproduce: venv  ## Run the paper's experiments, into bnirl_out/reproduction.md
	$(BIN)/bnirl reproduce $(REPRODUCE_ARGS)

venv:  ## Make the virtual environment, or bring it up to date
	@scripts/venv $(VENV)

lock:  ## Write requirements/ anew, with the newest packages that setup.py allows
	@scripts/lock

audit: venv  ## Look at the packages of requirements/: do they fit, were any withdrawn, known faults
	@scripts/audit $(VENV)

clean:  ## Remove the virtual environments, caches and build results
	rm -rf .venv .venv-* build install log dist bnirl_ros.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
