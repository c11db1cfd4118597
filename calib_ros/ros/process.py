"""One node in a process: from the arguments to a clean end by SIGINT or SIGTERM, at whatever moment they come.

Importing this module makes these signals end the process with exit code 0: entry points stand ready before they import the rest.
"""

# ruff: noqa: E402
from __future__ import annotations

import os
import signal

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_asked_to_end = _ros_runs = False


def _on_signal(*_: object) -> None:
    """As long as ROS does not run there is nothing to be finished. Then a node is, and `run` ends it: rclpy's own handlers would
    take the context from under callbacks and threads that publish."""
    global _asked_to_end
    _asked_to_end = True
    if not _ros_runs:
        os._exit(0)


for _number in SIGNALS:  # Python's own would raise KeyboardInterrupt wherever the main thread is
    signal.signal(_number, _on_signal)

import sys
import traceback
from importlib import import_module
from typing import Any

from calib_ros.errors import CalibrationError
from calib_ros.runtime import return_freed_memory

WAKE_S = 0.2  # Python's handlers of signals run between callbacks only


def calib_node(args: list[str] | None = None) -> int:
    """Entry point of the node that is active from its start on."""
    return _run("calib_node", "CalibNode", args)


def calib_lifecycle_node(args: list[str] | None = None) -> int:
    """Entry point of the managed node."""
    return _run("calib_lifecycle_node", "CalibLifecycleNode", args)


def _run(name: str, kind: str, args: list[str] | None) -> int:
    """Run a node until SIGINT or SIGTERM: 0; 2 with one line, which begins with the name, if it cannot start.

    kind: of the node, whose module is imported when signals end the process already.
    """
    global _ros_runs
    try:
        make = getattr(import_module("calib_ros.ros.node"), kind)
    except CalibrationError as error:  # the compiled kernel is missing
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        print(f"{name}: {error.name} is missing: source your ROS install or pip install 'calib_ros[ros]'", file=sys.stderr)
        return 2
    import cv2
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from calib_ros.ros import parameters
    from calib_ros.ros.dds import use_large_message_profile
    from calib_ros.ros.executor import every

    use_large_message_profile()
    return_freed_memory()
    cv2.setNumThreads(1)  # online.max_load counts the own threads of the node, and cores belong to others
    try:
        parameters.check_files(sys.argv if args is None else args)
        _ros_runs = True
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except CalibrationError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except Exception as error:  # rcl's message names what is wrong with the arguments or the parameter file
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    executor = SingleThreadedExecutor()
    node: Any = None  # with threads of its own, which its stop() ends; True if they ended
    try:
        node = make()
        every(node, WAKE_S, lambda: None)
        executor.add_node(node)
        while not _asked_to_end:
            executor.spin_once()
    except CalibrationError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except ExternalShutdownException:
        pass
    finally:
        ended = node is None or node.stop()
        executor.shutdown(timeout_sec=0.2)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        for number in SIGNALS:  # the interpreter puts all handlers but this one back to their defaults
            signal.signal(number, signal.SIG_IGN)
        if not ended:
            end_at_once()
    return 0


def end_at_once() -> None:
    """End the process although a thread is still in a long computation: all files are written, nothing is to be waited for.

    The interpreter's own end would take the thread's next return from compiled code for an error, and abort. Exit code 1, with
    the trace, while an exception is on its way out.
    """
    crashed = sys.exc_info()[0] is not None
    if crashed:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(int(crashed))


if __name__ == "__main__":  # python -m calib_ros.ros.process [managed] --ros-args ...
    managed = sys.argv[1:2] == ["managed"]
    if managed:
        del sys.argv[1]
    sys.exit(calib_lifecycle_node() if managed else calib_node())
