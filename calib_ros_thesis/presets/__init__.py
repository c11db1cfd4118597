"""The thesis's own system as presets: `--preset thesis` and `--preset thesis-literal`. A YAML file each, which reads as the
thesis's table of contents; the literal one changes the other."""

from pathlib import Path

THESIS = (Path(__file__).with_name("thesis.yaml"),)
LITERAL = (*THESIS, Path(__file__).with_name("thesis-literal.yaml"))
