"""The version of all packages; read by setup.py, and package.xml must say the same."""

__version__ = "0.1.0"
