"""Launch files without ROS's launch, of which there are no wheels: what they declare and would start."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from paths import ROOT, module_at

Context = dict[str, str]
PLACES = {
    "launch": ("LaunchContext", "LaunchDescription"),
    "launch.actions": ("DeclareLaunchArgument", "ExecuteProcess", "GroupAction", "IncludeLaunchDescription", "OpaqueFunction"),
    "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
    "launch.substitutions": ("LaunchConfiguration", "PathJoinSubstitution"),
    "launch_ros": (),
    "launch_ros.actions": ("Node",),
    "launch_ros.parameter_descriptions": ("ParameterValue",),
    "launch_ros.substitutions": ("ExecutableInPackage", "FindPackageShare"),
}


class Stand:
    """Stands in for one class of launch: what it was made with, and what it would be at run time."""

    def __init__(self, kind: str, /, *given: Any, **named: Any) -> None:
        self.kind, self.given, self.named = kind, given, named

    def perform(self, context: Context) -> str:
        if self.kind == "LaunchConfiguration":
            return context[self.given[0]]
        if self.kind == "ParameterValue":
            return text(self.given[0], context)
        return str(ROOT) if self.kind == "FindPackageShare" else "/".join(text(part, context) for part in self.given[0])


def text(value: Any, context: Context) -> str:
    return value.perform(context) if isinstance(value, Stand) else str(value)


@contextmanager
def stands_for_launch() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module, names in PLACES.items():
            patch.setitem(sys.modules, module, ModuleType(module))
            for name in names:
                setattr(sys.modules[module], name, partial(Stand, name))
        yield


def started(file: str, **arguments: str) -> list[SimpleNamespace]:
    """What `ros2 launch calib_ros FILE ARGUMENTS` gives to launch_ros's Node, for each node; substitutions are performed."""
    with stands_for_launch():
        return list(visited(described(f"{ROOT}/launch/{file}"), dict(arguments)))


def declared(file: str) -> set[str]:
    """The arguments that `ros2 launch calib_ros FILE` takes, those of included files too."""
    with stands_for_launch():
        return set(_declared(described(f"{ROOT}/launch/{file}")))


def _declared(entity: Stand) -> Iterator[str]:
    inner: Any = ()
    if entity.kind == "DeclareLaunchArgument":
        yield entity.given[0]
    elif entity.kind == "IncludeLaunchDescription":
        inner = [described(text(entity.given[0].given[0], {}))]
    elif entity.kind in ("LaunchDescription", "GroupAction"):
        inner = entity.given[0]
    for part in inner:
        yield from _declared(part)


def described(path: str) -> Any:
    return module_at(Path(path)).generate_launch_description()


def visited(entity: Stand, context: Context) -> Iterator[SimpleNamespace]:
    """As launch does: declared arguments keep what is given, a group keeps to itself what is set within."""
    kind, inner = entity.kind, []
    if kind == "LaunchDescription":
        inner = entity.given[0]
    elif kind == "GroupAction":
        inner, context = entity.given[0], dict(context)
    elif kind == "OpaqueFunction":
        inner = entity.named["function"](context)
    elif kind == "IncludeLaunchDescription":
        context |= {name: text(value, context) for name, value in entity.named["launch_arguments"]}
        inner = [described(text(entity.given[0].given[0], context))]
    elif kind == "DeclareLaunchArgument" and "default_value" in entity.named:
        value = context.setdefault(entity.given[0], text(entity.named["default_value"], context))
        assert value in entity.named.get("choices", [value])
    elif kind == "Node":
        node = {name: text(value, context) if isinstance(value, Stand) else value for name, value in entity.named.items()}
        node["ros_arguments"] = [text(word, context) for word in node["ros_arguments"]]
        node["remappings"] = {name: text(topic, context) for name, topic in node["remappings"]}
        node["parameters"] = [
            {name: v.perform(context) if isinstance(v, Stand) else v for name, v in given.items()}
            if isinstance(given, dict)
            else given
            for given in node["parameters"]
        ]
        yield SimpleNamespace(**{"prefix": None, **node})
    for part in inner:
        yield from visited(part, context)
