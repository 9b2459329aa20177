"""casatools' tools, opened and closed."""

from __future__ import annotations

from contextlib import contextmanager

__all__ = ["opened"]


@contextmanager
def opened(tool_name, *args, **options):
    """Open a casatools tool ('table', 'ms', 'msmetadata') and close it whatever happens."""
    import casatools

    tool = getattr(casatools, tool_name)()
    tool.open(*args, **options)
    try:
        yield tool
    finally:
        tool.close()
