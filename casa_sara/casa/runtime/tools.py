"""casatools' tools, opened and closed."""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from contextlib import contextmanager, suppress

__all__ = ["check_handles", "made", "more_handles", "opened", "safe_record", "scratch_folder"]

_HANDLES = 64  # for what CASA opens beside the MeasurementSets


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
    """Return the path of an image that CASA was to make; it may have reported a failure in its log only.

    Parameters
    ----------
    path : str
        Path of the new image.
    parameter : str
        Task parameter with its value, for the message.

    Raises
    ------
    ValueError
    """
    if not os.path.exists(path):
        raise ValueError(f"{parameter}: CASA cannot make the {os.path.splitext(path)[1]} image; the reason is in the "
                         "CASA log")
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
def more_handles(names):
    """Let the process open, for a while, as many files as these MeasurementSets have, as far as the system lets it."""
    try:
        import resource
    except ImportError:  # a system without such limits
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = _open_handles() + sum(map(_files, names)) + _HANDLES
    wanted = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
    changed = soft != resource.RLIM_INFINITY and soft < wanted
    if changed:
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    try:
        yield
    finally:
        if changed:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def check_handles(name, names):
    """Raise unless the process may open the files of one more MeasurementSet: CASA ends it where it may not.

    Raises
    ------
    OSError
        With how many files the process may open.
    """
    try:
        import resource
    except ImportError:
        return
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and _open_handles() + _files(name) + _HANDLES > soft:
        raise OSError(errno.EMFILE, f"vis has {len(names)} MeasurementSets, and CASA opens all of them at once for the "
                      f"coordinates of the image: this process may open {soft} files, which is too few for "
                      f"'{name}'; raise the limit (ulimit -n), or join MeasurementSets with concat")


def _files(name):
    """Return the number of files of a MeasurementSet, which is more than CASA opens."""
    return sum(len(files) for _, _, files in os.walk(name))


def _open_handles():
    """Return how many files this process has open."""
    return len(os.listdir("/dev/fd"))


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
                          f"{free / 1e6:.1f} MB left, and an image takes {needed / 1e6:.1f} MB: free some, or set "
                          "TMPDIR to another folder")
        yield folder
