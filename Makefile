# Everything runs in .venv, which `make env` makes from wheels: no ROS install needed. For another Python, give
# PYTHON=python3.12 every time or export it, else .venv is made again with python3.
PYTHON ?= python3
ROS ?= kilted
VENV := .venv$(if $(filter-out kilted,$(ROS)),-$(ROS))
PYTEST_ARGS ?=
# One more than the two cores of a small machine: tests of nodes mostly wait for messages and clocks.
TEST_PROCESSES ?= 3

# A sourced ROS install would shadow the wheels.
unexport CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONHOME PYTHONPATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Some hundred processes start in a run of the tests, and each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE
export AMENT_PREFIX_PATH := $(CURDIR)/$(VENV)

.PHONY: help env demo test test-all bench compare lint docs dist clean distclean

help:
	@echo "make demo               drive, node and player on a synthetic street; before and after; GIF=, a moving picture"
	@echo "make test               the standard tests of the product; a few minutes"
	@echo "make test ROOM=lidar    all tests of one room: a folder below test/, or a module such as config"
	@echo "make test PYTEST_ARGS='-k deskew -x'    further arguments of pytest"
	@echo "make test-all           everything, with long scenarios and the laboratory"
	@echo "make bench [BASE=X]     CPU time of commands and node, beside commit X"
	@echo "make compare BASE=main  is the working tree better or worse than a commit? Paired, with intervals; SETS=, TRIALS=, TIP="
	@echo "make lint               ruff and mypy"
	@echo "make docs               the documentation site in site/"
	@echo "make dist               sdist and wheels in dist/"
	@echo "make env                the environment in .venv; every target above brings it up to date first"
	@echo "make test ROS=jazzy     any target with another distribution than Kilted, in .venv-jazzy"
	@echo "make clean, distclean   what was built; and .venv too"

env:
	@$(PYTHON) tools/make_env.py $(ROS)

demo: env
	$(VENV)/bin/calib-ros demo --out demo_out $(if $(GIF),--gif $(GIF))

# `make test` guards the product in a few minutes. It leaves out two markers of pytest:
#   slow        a scenario that takes long; a shorter test of the same behaviour stays in `make test`
#   laboratory  tests of calib_ros_evaluation and benchmarks: set by test/conftest.py for their folders
# `make test-all`, which CI runs, leaves out nothing. `make test ROOM=lidar` runs all tests of one room: a folder of
# test/ or below (evaluation, ros), or a file of test/unit without its "test_" (ROOM=config).
ROOM ?=
TESTS = $(if $(ROOM),$(or $(wildcard test/$(ROOM) test/*/$(ROOM) test/unit/test_$(ROOM).py),$(error no tests of "$(ROOM)": see test/*/)),test)
# The tests of a file stay in one process, since they share rendered scenes and running nodes; and files begin in the order of
# test/conftest.py, the longest first, instead of the order of their number of tests.
PYTEST = $(VENV)/bin/python -m pytest -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder $(TESTS)

test: env
	$(PYTEST) $(if $(ROOM),,-m "not slow and not laboratory") $(PYTEST_ARGS)

test-all: env
	$(PYTEST) $(PYTEST_ARGS)

bench: env
	$(VENV)/bin/python -m benchmarks.bench $(if $(BASE),--base $(BASE))

SETS ?=
TRIALS ?= 1
TIP ?=
compare: env
	@$(VENV)/bin/python -m benchmarks.compare $(or $(BASE),$(error give the commit to compare with: make compare BASE=main)) \
		--trials $(TRIALS) $(if $(TIP),--tip $(TIP)) $(if $(SETS),--sets $(SETS))

lint: env
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

dist: env
	$(VENV)/bin/python tools/build_wheels.py dist

# The site's tools are no part of `make env`: they are installed here when they are missing or others.
docs: env
	@cmp -s requirements-docs.txt $(VENV)/stamps/docs || \
		{ $(VENV)/bin/pip install -q --disable-pip-version-check -r requirements-docs.txt && cp requirements-docs.txt $(VENV)/stamps/docs; }
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict --quiet
	@echo "site/index.html"

# Leaves .venv, which takes a download to make again; distclean does not.
clean:
	rm -rf build dist install log site demo_out steps_out evaluation_out .mypy_cache .pytest_cache .ruff_cache *.egg-info
	find calib_ros* benchmarks launch test tools -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv .venv-* calib_ros/registration/score/kernel*.so calib_ros_thesis/kernel*.so
