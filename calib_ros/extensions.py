"""How other packages join the core: entry points, loaded when somebody asks for what they bring.

The core imports none of them. What is not installed is missing as if it had never been there. Groups:

================================  ===========================================================================================
``calib_ros.commands``            a command of ``calib-ros``: a `Command`
``calib_ros.sources``             a kind of dataset, opened as ``NAME`` or ``NAME:...``: a callable, text -> `Source`; with
                                  the camera, name or number, as second argument where one is asked for
``calib_ros.rigs``                one of several sensors, opened likewise: a callable, text -> `RecordedRig`, None = a pair
``calib_ros.objectives``          a score by the name of ``refine.objective``: an `ObjectiveKind` of registration/features.py
``calib_ros.classes``             what recognises classes of points and pixels: a `ClassModels` of registration/classes.py
``calib_ros.stages``              a stage of the configuration: a frozen dataclass made with `calib_ros.config.options`
``calib_ros.presets``             configurations by one word: the YAML files that they are made of, in this order
``calib_ros.pages``               a page or picture for an option of commands: a callable, path -> what makes it there
``calib_ros.node_services``       a service of the node, ``~/NAME``: a callable, node, pipeline, health -> `NodeService`
================================  ===========================================================================================
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from typing import Any, Protocol

COMMANDS, SOURCES, NODE_SERVICES = "calib_ros.commands", "calib_ros.sources", "calib_ros.node_services"
RIGS, PAGES = "calib_ros.rigs", "calib_ros.pages"
OBJECTIVES, CLASSES = "calib_ros.objectives", "calib_ros.classes"
STAGES, PRESETS = "calib_ros.stages", "calib_ros.presets"


class Command(Protocol):
    """A command of ``calib-ros``. Its module is imported whenever the command line starts: slow imports belong into run. help:
    one line. add_arguments: its options. run: executes it and returns the exit code."""

    help: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None: ...

    def run(self, args: argparse.Namespace) -> int: ...


class NodeService:
    """A part of the node, such as a service, to be inherited from. Used on the executor's thread, but for add."""

    def start(self) -> None:
        """The node is active from now on: it receives messages and makes estimates."""

    def check(self) -> None:
        """To be called about once a second while it is active."""

    def again(self) -> None:
        """To be called every publish_period_s while it is active."""

    def pause(self) -> None:
        """It is not active any more; what has been found stays."""

    def stop(self) -> None:
        """The node ends: no thread of the service's own may go on. Called once, after the pipeline's threads have ended."""

    def destroy(self) -> None:
        """Leave nothing on the node. Called after stop."""

    def status(self) -> Any:
        """A diagnostic_msgs/DiagnosticStatus for /diagnostics, asked for every second; None = nothing to say."""

    def add(self, event: Any) -> None:
        """Any event of the pipeline (calib_ros/online/events.py); on any thread."""


_installed = cache(entry_points)  # of all groups, since each question reads every distribution


@cache
def _entries(group: str) -> Mapping[str, EntryPoint]:
    found = {}
    for entry in sorted(_installed().select(group=group), key=lambda e: e.name):
        with suppress(ImportError):  # a distribution may leave some of our packages out
            if find_spec(entry.module.partition(".")[0]) is not None:
                found[entry.name] = entry
    return found


def names(group: str) -> list[str]:
    """What is installed of a group, sorted; nothing is loaded."""
    return list(_entries(group))


def load(group: str, name: str) -> Any:
    """What an entry point names. KeyError if there is none."""
    return _entries(group)[name].load()


def commands() -> dict[str, Command]:
    """Commands of other packages, by name."""
    return {name: load(COMMANDS, name) for name in names(COMMANDS)}


def source_of(text: str, group: str = SOURCES) -> Callable[..., Any] | None:
    """What opens ``NAME`` or ``NAME:...``; None where no package brings such datasets."""
    name = text.partition(":")[0]
    return load(group, name) if name in _entries(group) else None


def node_services(warn: Callable[[str], None]) -> dict[str, Callable[[Any, Any, Any], NodeService]]:
    """What makes the services of other packages, by name. warn: called with a line for each whose libraries are missing."""
    found = {}
    for name in names(NODE_SERVICES):
        try:
            found[name] = load(NODE_SERVICES, name)
        except ImportError as error:
            warn(f"the service ~/{name} is left out, what it needs is not installed: {error}")
    return found
