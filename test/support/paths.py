"""Paths of the repository."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SUPPORT = ROOT / "test" / "support"
FORMER_VERSION = ROOT / "test" / "data" / "former_version"  # files that the version before the renames wrote
