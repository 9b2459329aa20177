"""The lock `<imagename>.lock`, which allows only one run at a time under one name."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
from contextlib import contextmanager
from datetime import datetime, timezone

from casa_sara.casa.runtime import log

__all__ = ["LOCK", "one_run_of"]

LOCK = ".lock"
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
_KEYS = {"pid", "host", "since"}


@contextmanager
def one_run_of(imagename):
    """Lock this name against all other runs, those of this process too, until the end.

    The lock is `flock` on a file that says which process holds it. The kernel gives it back when that
    process ends, however it ends, so the file that a killed run leaves locks nothing. On a file system
    without locks (some network disks) a warning says that runs are not kept apart.

    Raises
    ------
    BlockingIOError
        Another run holds the name; the message says which.
    FileExistsError
        A file of something else stands at the lock's place.
    """
    path = imagename + LOCK
    handle = _take(path, imagename)
    try:
        since = datetime.now(timezone.utc).isoformat(" ", "seconds")
        holder = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
        os.ftruncate(handle, 0)
        os.pwrite(handle, json.dumps(holder).encode() + b"\n", 0)
        yield
    finally:
        # removed while it is held: whoever opened it meanwhile finds, with the lock, that it is gone, and makes another
        if _stands(handle, path):
            os.unlink(path)
        os.close(handle)


def _take(path, imagename):
    """Return the opened and locked file that is at this path."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
        try:
            _lock(handle, imagename)
            if os.fstat(handle).st_size and not _said(handle):
                raise FileExistsError(errno.EEXIST, f"imagename = '{imagename}': '{path}' is not a lock file of tsara; "
                                      "move it, or choose another name")
            if _stands(handle, path):
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _stands(handle, path):
    """Return whether the opened file is the one at this path."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def _lock(handle, imagename):
    """Lock the opened file, or raise with the holder of the lock."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = _said(handle)
        who = "process {pid} on {host}, since {since}," if holder else "another run, which has just started,"
        raise BlockingIOError(
            errno.EWOULDBLOCK, f"imagename = '{imagename}': {who.format_map(holder)} is writing under this name; wait "
            "until it has finished, or choose another name"
        ) from None
    except OSError as error:
        if error.errno not in _WITHOUT_LOCKS:
            raise
        log.warn(f"imagename = '{imagename}': the file system does not support locks ({error.strerror}): do not start "
                 "another run under this name at the same time")


def _said(handle):
    """Return the holder that a lock file names, {} if it names none."""
    try:
        holder = json.loads(os.pread(handle, 4096, 0))
    except ValueError:
        return {}
    return holder if isinstance(holder, dict) and holder.keys() == _KEYS else {}
