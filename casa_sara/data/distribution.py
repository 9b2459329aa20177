"""Visibilities that are spread over the ranks of a communicator: their positions among all, and their distribution."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casa_sara.data.visibilities import RowTable, Visibilities
from casa_sara.parallel.serial import Serial

__all__ = ["Layout", "by_baseline", "series_with"]

SERIES = ("ms", "observation", "field", "spw", "antenna1", "antenna2")


class Layout:
    """Where this rank's block-sorted samples stand among those of all ranks, as one rank alone has them.

    Within a block the samples of rank 0 come first, then those of rank 1, …

    Parameters
    ----------
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1] of this rank's samples.
    comm : casa_sara.parallel.serial.Serial or MPI
    """

    def __init__(self, offsets: np.ndarray, comm: Serial) -> None:
        self._offsets, self._comm = np.asarray(offsets), comm
        self._counts = np.array(comm.allgather(np.diff(self._offsets)))  # (ranks, d)
        before, self.totals = self._counts[: comm.rank].sum(axis=0), self._counts.sum(axis=0)
        self.offsets = np.concatenate([[0], np.cumsum(self.totals)])  # of all samples
        self._starts = self.offsets[:-1] + before

    def numbers(self, index: np.ndarray) -> np.ndarray:
        """Return the numbers, among all samples, of the samples `index` of this rank.

        Parameters
        ----------
        index : int (n,)
            Positions in this rank's samples.

        Returns
        -------
        int (n,)
        """
        block = np.searchsorted(self._offsets, index, "right") - 1
        return self._starts[block] + index - self._offsets[block]

    def here(self, numbers: np.ndarray) -> np.ndarray:
        """Return which of this rank's samples are among those of these numbers.

        Parameters
        ----------
        numbers : int (n,)
            Numbers among all samples.

        Returns
        -------
        int (k,)
            Positions in this rank's samples.
        """
        block = np.searchsorted(self.offsets, numbers, "right") - 1
        within = numbers - self._starts[block]
        held = (within >= 0) & (within < np.diff(self._offsets)[block])
        return (self._offsets[block] + within)[held]

    def gather(self, array: np.ndarray) -> np.ndarray | None:
        """Return the samples of all ranks along the last axis of an array, on rank 0; None on the others.

        Parameters
        ----------
        array : (…, M)
            This rank's samples, along the last axis.

        Returns
        -------
        (…, M) or None
            On rank 0 the samples of all ranks as one rank alone has them.
        """
        if self._comm.size == 1:
            return array
        parts = self._comm.gather(array)
        if parts is None:
            return None
        whole = np.empty((*array.shape[:-1], self.offsets[-1]), array.dtype)
        for rank, part in enumerate(parts):
            for there, here in self._slices(rank):
                whole[..., there] = part[..., here]
            parts[rank] = None
        return whole

    def scatter(self, whole: np.ndarray | None) -> np.ndarray | None:
        """Return this rank's samples of an array (M,) of rank 0; the others give None.

        Parameters
        ----------
        whole : (M,) or None
            The samples of all ranks on rank 0, None on the others.

        Returns
        -------
        (M,)
        """
        if self._comm.size == 1:
            return whole
        return self._comm.scatter(None if whole is None else [
            np.concatenate([whole[there] for there, _ in self._slices(rank)]) for rank in range(self._comm.size)])

    def _slices(self, rank):
        """Yield where each block of a rank's samples lies among all, and in its own arrays."""
        starts = self.offsets[:-1] + self._counts[:rank].sum(axis=0)
        ends = np.cumsum(self._counts[rank])
        for start, end, count in zip(starts.tolist(), ends.tolist(), self._counts[rank].tolist()):
            yield slice(start, start + count), slice(end - count, end)


def by_baseline(visibilities: Visibilities, offsets: np.ndarray, comm: Serial) -> tuple[Visibilities, np.ndarray]:
    """Return the samples that this rank is given so that it has all of each of its baselines, and their offsets.

    Of the samples only `vis`, `weight`, `row` and `chan` come along.

    Parameters
    ----------
    visibilities : Visibilities
        This rank's samples, in the order of their blocks.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    visibilities : Visibilities
    offsets : int (d + 1,)
    """
    if comm.size == 1:
        return visibilities, offsets
    light = replace(visibilities, uvw=visibilities.uvw[:0], imaging_weight=visibilities.imaging_weight[None][:0])
    rows = visibilities.rows
    goal = ((rows.antenna1.astype(np.int64) * 1009 + rows.antenna2) % comm.size)[visibilities.row]
    chosen = [np.flatnonzero(goal == rank) for rank in range(comm.size)]
    received = comm.alltoall([(light.part(index), np.diff(np.searchsorted(index, offsets))) for index in chosen])
    parts, counts = zip(*received)
    block = np.concatenate([np.repeat(np.arange(count.size), count) for count in counts])
    offsets = np.concatenate([[0], np.cumsum(sum(counts))])
    return _joined(parts).take(np.argsort(block, kind="stable")), offsets


def series_with(data: Visibilities, residual: np.ndarray, suspect: np.ndarray,
                comm: Serial) -> tuple[Visibilities, np.ndarray, np.ndarray]:
    """Return (data, residual, suspect) that hold the series of all samples `suspect` from the first to the last.

    A series is what one baseline and channel have seen.  One rank alone has them all; of several each is given those of
    its own suspects, and of the others'.  Of data on the disk those of the suspects are taken.

    Parameters
    ----------
    data : Visibilities
        This rank's samples.
    residual : complex (M,)
        Of these samples.
    suspect : int (n,)
        Numbers of samples.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    data : Visibilities
    residual : complex (M',)
    suspect : int (n,)
        The same samples among those.
    """
    if comm.size == 1 and not data.scratch.on_disk:
        return data, residual, suspect
    of_row = np.stack([getattr(data.rows, name).astype(np.int64) for name in SERIES], axis=1)
    own = np.column_stack([of_row[data.row[suspect]], data.chan[suspect].astype(np.int64)])
    wanted = np.concatenate(comm.allgather(np.unique(own, axis=0)))
    if len(wanted) == 0:
        return data, residual, suspect
    chosen = np.concatenate([piece.start + np.flatnonzero(_is_of(wanted, of_row, data.row[piece], data.chan[piece]))
                             for piece in data.scratch.pieces(0, data.size)])
    parts, residuals = zip(*comm.allgather((data.part(chosen), residual[chosen])))
    begin = sum(part.size for part in parts[: comm.rank])
    return _joined(parts), np.concatenate(residuals), begin + np.searchsorted(chosen, suspect)


def _is_of(wanted, of_row, row, chan):
    """Whether each sample is of one of some series, bool (M,).

    Parameters
    ----------
    wanted : int64 (n, 7)
        The columns `SERIES` and the channel of each series, n > 0.
    of_row : int64 (R, 6)
        The columns `SERIES` of each row.
    row, chan : int (M,)
        Row and channel of each sample.
    """
    number = np.unique(np.concatenate([wanted[:, :-1], of_row]), axis=0, return_inverse=True)[1].ravel()
    of_wanted, of_row = number[: len(wanted)], number[len(wanted):]
    channels = 1 + max(int(wanted[:, -1].max()), int(chan.max(initial=0)))
    return np.isin(of_row[row] * channels + chan, of_wanted * channels + wanted[:, -1])


def _joined(parts):
    """Put parts one after the other."""
    begins = np.cumsum([0, *(part.rows.row.size for part in parts[:-1])])
    rows = {name: np.concatenate([getattr(part.rows, name) for part in parts])
            for name in RowTable.__dataclass_fields__}
    samples = {name: np.concatenate([getattr(part, name) for part in parts], axis=-1)
               for name in ("vis", "weight", "imaging_weight", "uvw", "chan", "freq_hz", "beam")
               if getattr(parts[0], name) is not None}
    row = np.concatenate([begin + part.row for begin, part in zip(begins, parts)])
    return replace(parts[0], rows=RowTable(**rows), row=row.astype(np.int32), **samples)
