"""The version of casa_sara."""

__version__ = "0.1.0"
