"""Arrays on the disk, for data that are larger than the memory: mapped, in files without a name.

Such a file has no entry in any folder, so that the disk is free again when the last array of it goes, or the process
ends, however it ends.  Pages that have been written or read count as memory of the process until they are let go,
which costs nothing as long as the system keeps them in its cache.
"""

from __future__ import annotations

import errno
import mmap
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["IN_MEMORY", "PIECE", "Scratch", "slices"]

PIECE = 1 << 21  # samples that are worked on at a time


def slices(start: int, stop: int, step: int = PIECE) -> Iterator[slice]:
    """Yield the slices of start:stop, of `step` numbers each.

    Parameters
    ----------
    start, stop, step : int
        As of `range`.
    """
    for first in range(start, stop, step):
        yield slice(first, min(first + step, stop))


class Scratch:
    """Where large arrays are made: in the memory, or in files without a name.

    Parameters
    ----------
    folder : str, optional
        For the files; without it arrays are in memory.
    piece : int
        Samples on the disk that are worked on at a time.

    Attributes
    ----------
    kept : list
        Pairs of what something was made of and this, which is used more than once.
    """

    def __init__(self, folder: str | None = None, piece: int = PIECE) -> None:
        self.folder, self.piece = folder, piece
        self.kept: list[tuple[Any, Any]] = []
        self._maps: list[weakref.ReferenceType[mmap.mmap]] = []

    @property
    def on_disk(self) -> bool:
        """Whether arrays are in files."""
        return self.folder is not None

    def empty(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> np.ndarray:
        """Return an array that nothing has been written to.

        Parameters
        ----------
        shape : int or tuple of int
            Of the array.
        dtype : dtype
            Of the array.

        Returns
        -------
        ndarray

        Raises
        ------
        OSError
            The disk is full.
        """
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if self.folder is None or not size:
            return np.empty(shape, dtype)
        self.require(size)
        with tempfile.TemporaryFile(dir=self.folder) as file:
            os.posix_fallocate(file.fileno(), 0, size)  # else a signal would end the process where the disk is full
            memory = mmap.mmap(file.fileno(), size)
        self._maps = [one for one in self._maps if one() is not None]
        self._maps.append(weakref.ref(memory))
        return np.frombuffer(memory, dtype).reshape(shape)

    def require(self, size: int) -> None:
        """Raise where the disk has no room.

        Parameters
        ----------
        size : int
            Bytes.

        Raises
        ------
        OSError
            The disk has less.
        """
        free = shutil.disk_usage(self.folder or os.curdir).free
        if size > free:
            raise OSError(errno.ENOSPC, f"the disk of '{self.folder}' has {free / 1e9:.3g} GB left: should have "
                          f"{size / 1e9:.3g} GB for visibilities that do not fit into memory")

    def pieces(self, start: int, stop: int) -> Iterator[slice]:
        """Yield the slices of start:stop to work on one after the other: all at once in memory.

        What has been read and written of all arrays is let go after each.

        Parameters
        ----------
        start, stop : int
            Numbers of samples.
        """
        for piece in slices(start, stop, self.piece) if self.on_disk else [slice(start, stop)]:
            yield piece
            self.let_go()

    def let_go(self) -> None:
        """Give back the memory of all arrays in files, which keep what they hold."""
        for one in self._maps:
            memory = one()
            if memory is not None:
                memory.madvise(mmap.MADV_DONTNEED)


IN_MEMORY = Scratch()
