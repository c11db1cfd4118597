#!/usr/bin/env python3
"""Write config/calib_ros.yaml from the defaults and documentation in the code, so that both cannot drift apart."""

from __future__ import annotations

import dataclasses
import sys
import textwrap
from pathlib import Path
from typing import Any

from calib_ros.config import STAGES
from calib_ros.ros.parameters import SETTINGS

TARGET = Path(__file__).resolve().parents[1] / "config" / "calib_ros.yaml"
HEAD = """\
# Parameters of calib_node with their defaults: ros2 run calib_ros calib_node --ros-args --params-file THIS_FILE
# `calib-ros calibrate --config THIS_FILE` reads the stages (image. to monitor.) of the same file.
# Made by tools/write_config.py; the meaning of each value stands above it, with its range in brackets.
/**:
  ros__parameters:
"""


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return repr(value)


def _entry(name: str, default: Any, doc: str, low: float | None, high: float | None, choices: Any) -> str:
    allowed = f" [{low:g}, {high:g}]" if low is not None and high is not None else f" [{', '.join(choices)}]" if choices else ""
    comment = textwrap.indent(textwrap.fill(doc + allowed, 110), "    # ")
    return f"{comment}\n    {name}: {_value(default)}\n"


def text() -> str:
    """The whole file."""
    parts = [HEAD]
    parts += [_entry(name, s.default, s.doc, s.low, s.high, s.choices) for name, s in SETTINGS.items()]
    for stage, cls in STAGES.items():
        parts.append(f"\n    # {(cls.__doc__ or '').splitlines()[0]}\n")
        for f in dataclasses.fields(cls):
            m = f.metadata
            parts.append(_entry(f"{stage}.{f.name}", f.default, m["doc"], m["low"], m["high"], m["choices"]))
    return "".join(parts)


if __name__ == "__main__":
    if "--check" in sys.argv:
        sys.exit(
            0 if TARGET.exists() and TARGET.read_text() == text() else f"{TARGET.name} is out of date; run tools/write_config.py"
        )
    TARGET.write_text(text())
