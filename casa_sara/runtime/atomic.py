"""Files that appear whole, or not at all: one file, or several that replace older ones together.

Several files ROOT.x, ROOT.y, … are written in the folder `.ROOT.new`, beside their places. When all are complete the
folder is renamed `.ROOT.whole`, and from then on they count: the older files go to `.ROOT.old`, the folder becomes
`.ROOT.moving`, its contents go to their places, and `.ROOT.old` is removed. A process that is killed leaves one of
these folders, and the next one goes by it: `.new` is thrown away, `.whole` and `.moving` are followed to the end.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import BinaryIO

from casa_sara.runtime.signals import signals_deferred

__all__ = ["NEW", "new_file", "new_files", "recover_files", "sync"]

NEW = ".new"  # ends the name of what is not complete yet


@contextmanager
def new_file(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Yield a file to write; it takes its place when it is complete and on the disk.

    Parameters
    ----------
    path : path
        Path of the file.

    Raises
    ------
    OSError
        It cannot be written; what was there is still there.
    """
    path = os.fspath(path)
    try:
        with open(path + NEW, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(path + NEW, path)
    except BaseException:
        if os.path.lexists(path + NEW):
            os.unlink(path + NEW)
        raise
    _fsync(os.path.dirname(path) or ".")


@contextmanager
def new_files(root: str, older: Callable[[], Iterable[str]]) -> Iterator[str]:
    """Yield a folder to write in; what is in it at the end takes the place of the older files, all together.

    When something fails, everything stays as it was.

    Parameters
    ----------
    root : str
        The files go to the folder of this path; its last part names the folders in which they wait.
    older : callable
        Returns the paths of the files that are replaced.
    """
    recover_files(root, older)
    new = _folder_of(root, NEW)
    os.mkdir(new)
    try:
        yield new
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    with signals_deferred():
        os.rename(new, _folder_of(root, ".whole"))
        _take_places(root, older)


def recover_files(root: str, older: Callable[[], Iterable[str]]) -> None:
    """Complete or remove what a process that was killed has left of :func:`new_files`.

    Parameters
    ----------
    root, older
        As there.
    """
    shutil.rmtree(_folder_of(root, NEW), ignore_errors=True)
    _take_places(root, older)


def _take_places(root, older):
    """Replace the older files by those in '.whole', or continue an interrupted replacement."""
    whole, moving, old = (_folder_of(root, stage) for stage in (".whole", ".moving", ".old"))
    if os.path.isdir(whole):  # what stands under the name is older
        os.makedirs(old, exist_ok=True)
        for path in older():
            os.rename(path, os.path.join(old, os.path.basename(path)))
        os.rename(whole, moving)
    if os.path.isdir(moving):
        for name in os.listdir(moving):
            os.rename(os.path.join(moving, name), os.path.join(os.path.dirname(root), name))
        os.rmdir(moving)
    shutil.rmtree(old, ignore_errors=True)


def _folder_of(root, stage):
    """Return the folder of one stage: '.new', '.whole', '.moving' or '.old'."""
    folder, base = os.path.split(root)
    return os.path.join(folder, f".{base}{stage}")


def sync(folder: str) -> None:
    """Bring the files and folders in a folder to the disk, so that a power failure keeps the order of events."""
    for parent, _, names in os.walk(folder):
        for path in [parent, *(os.path.join(parent, name) for name in names)]:
            _fsync(path)


def _fsync(path):
    """Bring one file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
