"""One node in a process: from the arguments to a clean end by SIGINT or SIGTERM, at whatever moment they come.

Importing this module is quick, so that the entry points below stand ready for signals before all that a node needs is imported.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from importlib import import_module
from typing import Any

from calib_ros.errors import CalibrationError
from calib_ros.runtime import return_freed_memory

WAKE_S = 0.5
SIGNALS = (signal.SIGINT, signal.SIGTERM)

_ros_runs = threading.Event()


def calib_node(args: list[str] | None = None) -> int:
    """Entry point of the node that is active from its start on."""
    return _run("calib_node", "calib_ros.ros.node", "CalibNode", args)


def calib_lifecycle_node(args: list[str] | None = None) -> int:
    """Entry point of the managed node."""
    return _run("calib_lifecycle_node", "calib_ros.ros.lifecycle_node", "CalibLifecycleNode", args)


def _run(name: str, module: str, node: str, args: list[str] | None) -> int:
    """Run the node of a module, which is imported when signals end the process already."""
    end_at_signals()
    try:
        make = getattr(import_module(module), node)
    except CalibrationError as error:  # the compiled kernel is missing
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    return run(name, make, args)


def run(name: str, make: Callable[[], Any], args: list[str] | None = None) -> int:
    """Run a node until SIGINT or SIGTERM: 0; 2 with one line, which begins with the name, if it cannot start.

    make: a rclpy node with threads of its own, which its stop() ends; True if they ended.
    """
    end_at_signals()
    import cv2
    import rclpy
    from rclpy.clock import Clock, ClockType
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    from calib_ros.ros import parameters
    from calib_ros.ros.dds import use_large_message_profile

    use_large_message_profile()
    return_freed_memory()
    cv2.setNumThreads(1)  # online.max_load counts the own threads of the node, and cores belong to others
    try:
        parameters.check_files(sys.argv if args is None else args)
        rclpy.init(args=args)
    except CalibrationError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except Exception as error:  # rcl's message names what is wrong with the arguments or the parameter file
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    _ros_runs.set()
    executor = SingleThreadedExecutor()
    node: Any = None
    try:
        node = make()
        # rclpy's handler wakes the executor before it ends the context: an executor that is back in its wait by then would wait
        # for ever, if nothing else came.
        node.create_timer(WAKE_S, lambda: None, clock=Clock(clock_type=ClockType.STEADY_TIME))
        executor.add_node(node)
        executor.spin()
    except CalibrationError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except ExternalShutdownException:
        pass
    except Exception:
        if rclpy.ok():
            raise  # else: a signal took the context away while the node was being made, or in a callback
    finally:
        ended = node is None or node.stop()
        executor.shutdown(timeout_sec=0.2)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
        if not ended:
            end_at_once()
    return 0


def end_at_signals() -> None:
    """End the process at the first SIGINT or SIGTERM with exit code 0, as long as ROS does not run: nothing is to be finished.

    From rclpy.init on its own handlers end the context, and with it spin(); they call this one besides. In place of Python's
    own for SIGINT, which would raise KeyboardInterrupt wherever the main thread is, and again while it cleans up: launch and
    shell both send SIGINT.
    """

    def end(*_: object) -> None:
        if not _ros_runs.is_set():
            os._exit(0)

    for number in SIGNALS:
        signal.signal(number, end)


def ignore_signals() -> None:
    """Of a process that is about to end: the interpreter puts all handlers but this one back to their defaults."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


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
