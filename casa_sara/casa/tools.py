"""casatools' tools, opened and closed."""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from contextlib import contextmanager

__all__ = ["made", "opened", "safe_record", "scratch_folder"]


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


def made(path, parameter):
    """Return the path of what CASA was asked to make; where it failed it may have said so in its log only.

    Parameters
    ----------
    path : str
    parameter : str
        Task parameter with its value, for the message.

    Raises
    ------
    ValueError
    """
    if not os.path.exists(path):
        raise ValueError(f"{parameter}: CASA makes no {os.path.splitext(path)[1]} image of it; the reason stands in its log")
    return path


def safe_record(csys):
    """Return the record of a coordinate system; CASA ends the process where its observer or telescope is not UTF-8."""
    for read, write in ((csys.observer, csys.setobserver), (csys.telescope, csys.settelescope)):
        try:
            read()
        except UnicodeDecodeError:
            write("")
    return csys.torecord()


@contextmanager
def scratch_folder(shape):
    """Yield a temporary folder with room for images of this shape: CASA ends the process where there is none.

    Raises
    ------
    OSError
        The disk of temporary files has too little space left.
    """
    with tempfile.TemporaryDirectory(prefix="casa_sara_") as folder:
        needed, free = 10 * math.prod(shape) + 2_000_000, shutil.disk_usage(folder).free
        if free < needed:
            raise OSError(errno.ENOSPC, f"the folder of temporary files, '{tempfile.gettempdir()}', has "
                          f"{free / 1e6:.1f} MB left, and an image takes {needed / 1e6:.1f} MB: free some, or set TMPDIR to "
                          "another folder")
        yield folder
