"""YAML as ROS 2 reads it: plain values under plain names, no aliases. Files that say more than they hold are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from calib_ros.errors import BadInputError

MAX_BYTES = 1_000_000  # a result of 10 000 frames; PyYAML takes seconds for it
LARGEST = 10**1000


def read_text(path: str | Path, kind: str, wanted: str) -> str:
    """A text file, UTF-8. BadInputError, saying what is `wanted`, if it cannot be read, is no text or too large."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise BadInputError(f"cannot read {kind} {path}: {error.strerror}") from None
    except ValueError:  # a zero byte in the name
        raise BadInputError(f"cannot read {kind} {str(path)!r}: no file can have this name") from None
    if len(data) > MAX_BYTES:
        raise BadInputError(f"{kind} {path} has more than {MAX_BYTES} bytes; give {wanted}")
    try:
        return data.decode("utf-8-sig")  # editors on Windows put a mark in front
    except UnicodeDecodeError:
        raise BadInputError(f"{path} is not a text file in UTF-8, so not valid YAML or JSON; give {wanted}") from None


def load(text: str) -> Any:
    """The value of a YAML text. yaml.YAMLError, with the place, or ValueError or RecursionError for what is none."""
    return yaml.load(text, _Loader)


class _Loader(yaml.SafeLoader):
    """Without aliases a document is as large as its text: a few hundred bytes of them can stand for 10^9 values."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", event.start_mark)
        return super().compose_node(parent, index)

    def integer(self, node: Any) -> int:
        """A whole number. Python can hold one of more than 4300 digits, but not print it."""
        value = self.construct_yaml_int(node)
        if abs(value) > LARGEST:
            raise yaml.constructor.ConstructorError(None, None, "a number of more than 1000 digits", node.start_mark)
        return int(value)

    def mapping(self, node: Any) -> Any:
        """Names on one line, and their values."""
        for name, _ in node.value:
            if not isinstance(name, yaml.ScalarNode) or len(name.value.splitlines()) > 1 or len(name.value) > 200:
                raise yaml.constructor.ConstructorError(None, None, "a key that is no name", name.start_mark)
        return self.construct_yaml_map(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.integer)
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.mapping)
