"""Paths of the repository, and its Python files outside of packages."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]
SUPPORT = ROOT / "test" / "support"
FORMER_VERSION = ROOT / "test" / "data" / "former_version"  # files that the version before the renames wrote
FORMER_OPTIONS = ROOT / "test" / "data" / "former_options"  # the shipped configuration before options were removed


def module_at(path: Path) -> ModuleType:
    """The module that a file holds, under its own name."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
