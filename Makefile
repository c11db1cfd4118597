# Everything runs in .venv, which `make env` makes from wheels: no ROS install needed. For another Python, give
# PYTHON=python3.12 every time or export it, else .venv is made again with python3.
PYTHON ?= python3
PYTEST_ARGS ?=
TEST_PROCESSES ?= 2

# A sourced ROS install would shadow the wheels.
unexport CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH PYTHONHOME PYTHONPATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH := $(CURDIR)/.venv

.PHONY: env demo test bench lint clean distclean

env:
	@$(PYTHON) tools/make_env.py

demo: env
	.venv/bin/calib-ros demo --out demo_out

# A file's tests stay in one process, since they share rendered scenes and running nodes.
test: env
	.venv/bin/python -m pytest -n $(TEST_PROCESSES) --dist loadfile $(PYTEST_ARGS)

bench: env
	.venv/bin/python -m benchmarks.bench

lint: env
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

# Leaves .venv, which takes a download to make again; distclean does not.
clean:
	rm -rf build install log demo_out steps_out evaluation_out .mypy_cache .pytest_cache .ruff_cache *.egg-info
	find calib_ros launch test tools training -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv
