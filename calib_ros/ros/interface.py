"""What the interfaces of a pair and of a rig have in common."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.extensions import NodeService
from calib_ros.online.pipeline import Pipeline
from calib_ros.ros import parameters
from calib_ros.ros.diagnostics import Health
from calib_ros.ros.executor import every
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.tf import CURES, StaticTf
from calib_ros.ros.write_back import WriteBack


class PairPart(NodeService):
    """A part of the interface of a pair: `own`, a `PairInterface`, which imports all its parts."""

    def __init__(self, own: Any) -> None:
        self._own = own
        self._node: Node = own.node
        self._pipeline: Pipeline = own.pipeline
        self._health: Health = own.health

    @property
    def _parameters(self) -> Parameters:
        """As they are now."""
        given: Parameters = self._own.parameters
        return given


class Interface(NodeService):
    """Topics, services and parameters on a node of any kind, a list of parts.

    Made with everything but the subscriptions to the sensors; start() begins to receive and to estimate. Raises a
    CalibrationError for parameters that cannot work. To be used on the executor's thread. parameters: as they are now. files:
    writes them, one after the other. listener: node whose remapping holds for topics; if another one, this is a part of what
    that has. cures: see `StaticTf`. active: between start() and pause(). ended: once stopped, whether all threads did.
    """

    end_threads: Callable[[], bool]  # all but those of the parts; True if they ended

    def __init__(self, node: Node, declared: Parameters, listener: Node, cures: tuple[str, str] = CURES) -> None:
        self.node, self.parameters, self.health = node, declared, Health(node.get_logger())
        self.given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
        for line in parameters.misspelt(self.given, node._parameters):
            node.get_logger().warning(line)
        self.tf = StaticTf(listener, lambda: self.parameters, self.health.error, cures)
        self.files = ThreadPoolExecutor(max_workers=1, thread_name_prefix="calib_files")  # disks may be slow
        self.write_back = WriteBack(lambda: self.parameters, self.files, self.health, self.tf.edges)
        self.parts: list[NodeService] = [self.health, self.tf, self.write_back]  # as they begin; they end the other way round
        self._timers: list[Timer] = []
        self._is_part, self.active = listener is not node, False
        self.ended: bool | None = None

    def start(self) -> None:
        """Receive messages, make estimates, publish at a steady rate."""
        self.active = True
        try:
            for part in self.parts:
                part.start()
        except Exception:
            self.pause()
            raise
        ticks = () if self._is_part else ((1.0, self.check), (self.parameters["publish_period_s"], self.again))
        self._timers = [every(self.node, period_s, call) for period_s, call in ticks]

    def pause(self) -> None:
        """Receive nothing, end estimates under way, and say as the last message that nothing is usable any more.

        Keyframes and extrinsic stay.
        """
        self.active = False
        for timer in self._timers:
            self.node.destroy_timer(timer)
        self._timers = []
        for part in reversed(self.parts):
            part.pause()

    def stop(self) -> None:
        """End all threads, an estimate under way included; files under way are finished."""
        if self.ended is None:
            self.ended = self.end_threads()
            for part in self.parts:
                part.stop()
            self.files.shutdown(wait=True)

    def destroy(self) -> None:
        """Leave nothing on the node but its parameters."""
        if self.active:
            self.pause()
        self.stop()
        self.node.remove_on_set_parameters_callback(self._on_parameters)
        for part in reversed(self.parts):
            part.destroy()

    def destroy_nodes(self) -> None:
        """Those beside this one, at the very end."""

    def check(self) -> None:
        """See `NodeService`."""
        with self.health.guard():
            self.look()

    def look(self) -> None:
        """Every second."""
        for part in self.parts:
            part.check()

    def again(self) -> None:
        """See `NodeService`."""
        with self.health.guard():
            for part in self.parts:
                part.again()

    def _on_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        """What costs more to change than constants of the stages waits for the next check()."""
        try:
            new = parameters.changed(self.parameters, changed)
            if new["publish_tf"] and self.tf.missing:
                raise MissingDependencyError(self.tf.missing)
            self._take(new, changed)
        except CalibrationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, new: Parameters, changed: list[Parameter]) -> None:
        """Use other parameters from now on. Raises a CalibrationError for what cannot work."""
        raise NotImplementedError
