"""The nodes: one that is active from its start to its end, and the same made, started and stopped by a ROS 2 lifecycle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from calib_ros.errors import CalibrationError, defect
from calib_ros.ros.calibration import Calibration


class _Calibrating(Node):
    """calibration: None until it is made: stop() and destroy_node() may follow an __init__ that raised."""

    calibration: Calibration | None = None
    _ended = True  # all threads of calibrations that are gone

    def stop(self) -> bool:
        """End all threads of the node; True if they ended, and those of former calibrations too."""
        if self.calibration is not None:
            self.calibration.stop()
        return self._ended and (self.calibration is None or bool(self.calibration.ended))

    def destroy_node(self) -> None:
        """Ends the threads first: they publish through this node."""
        self.stop()
        if self.calibration is not None:
            self.calibration.destroy_nodes()
        super().destroy_node()


class CalibNode(_Calibrating):
    """The node that is active from its start to its end."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calib_ros", allow_undeclared_parameters=True, **kwargs)  # which are refused, with the nearest name
        self.calibration = Calibration(self)
        self.calibration.start()


class CalibLifecycleNode(_Calibrating, LifecycleNode):
    """configure: parameters, publishers, services. activate: sensors and estimates. cleanup: nothing is left but the parameters.

    calibration: None while the node is unconfigured. A transition that fails says why in one line of the log.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calib_ros", allow_undeclared_parameters=True, **kwargs)
        self.get_logger().info("waiting to be configured and activated")

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters, and make all but the subscriptions to the sensors."""
        return self._transition(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe to the sensors, and estimate."""
        return self._transition(lambda: self._configured().start())

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe and end estimates; keyframes and extrinsic stay."""
        return self._transition(lambda: self._configured().pause())

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Back to where the node was before it was configured, but for parameters that were changed."""
        return self._transition(self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """From any state; the process goes on until a signal ends it."""
        return self._transition(self._clean_up)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """After a transition that raised: unconfigured again."""
        return self._transition(self._clean_up)

    def _configured(self) -> Calibration:
        assert self.calibration is not None  # the state machine sees to it
        return self.calibration

    def _configure(self) -> None:
        self.calibration = Calibration(self)

    def _clean_up(self) -> None:
        calibration, self.calibration = self.calibration, None
        if calibration is not None:
            calibration.destroy()
            self._ended = bool(calibration.ended) and self._ended
            calibration.destroy_nodes()

    def _transition(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        """rclpy itself would end a transition that raises without a word."""
        try:
            work()
        except CalibrationError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.get_logger().error(defect(error))
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS
