"""Snapshots: the blocks of samples that have an ℓ2 bound each, of one process or of all ranks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from casa_sara.data.visibilities import BlockInfo, Visibilities
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.runtime.scratch import slices

__all__ = ["snapshot_blocks"]

SNAPSHOT_SECONDS = 1800.0
SNAPSHOT_SAMPLES = 100_000
CUT_FOR_SIZE = 64  # blocks that numbers of samples alone make at most
SMALLEST_SNAPSHOT = 500
SESSION_GAP_SECONDS = 12 * 3600.0


def snapshot_blocks(visibilities: Visibilities, blocks: int = 0, group: np.ndarray | None = None,
                    comm: Serial = SERIAL) -> tuple[np.ndarray, list[BlockInfo]]:
    """Split the samples into snapshots: spans over which errors may be taken as constant.

    Each block gets an ℓ2 bound of its own. The automatic rule (`blocks` = 0):

    1. one block for each scan of each observation of each MeasurementSet (and for each
       session of it: a gap of 12 h starts a new one);
    2. a scan longer than 30 min, or of more than 1e5 samples and 1/64 of all, is cut into
       equal spans of time, as many as bring it below both limits; an integration is never cut;
    3. a block of fewer than 500 samples is joined to the neighbour nearer in time, the
       smallest first, as long as the session has one: a bound from few samples says little.

    With `blocks` = n there are n blocks of equal size (± 1) along time; they do not cross from
    one MeasurementSet to another, unless these outnumber the blocks.

    Parameters
    ----------
    visibilities : Visibilities
        The samples to divide.
    blocks : int
        0 for the automatic rule, or the number of blocks.
    group : int (M,), optional
        Samples of different groups are never in one block; the automatic rule splits each group by itself.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread, in the order in which one rank alone has them.

    Returns
    -------
    block_of_sample : int32 (M,)
        Numbers 0 … d−1 along groups, MeasurementSets and time; every block holds a sample, on one of the ranks.
    infos : list of d BlockInfo

    Raises
    ------
    ValueError
        When `blocks` is negative or exceeds the number of samples.
    """
    size = comm.total(visibilities.size)
    if not 0 <= blocks <= size:
        raise ValueError(f"blocks = {blocks}: it takes 0 (automatic) or 1 to {size}, the number of visibilities")
    table, of_row = _integrations(visibilities, comm)
    of_samples = _OfSamples(of_row, visibilities)
    if group is not None:
        block_of_sample = _blocks_of_groups(table, of_samples.all(), group, comm)
    elif blocks:
        block_of_sample = _equal_blocks(table, of_samples, blocks, comm)
    else:
        block_of_sample = _OfSamples(_blocks_of_rows(table)[of_row], visibilities).all()
    return block_of_sample, _block_infos(visibilities.ms_names, table, of_samples, block_of_sample, comm)


@dataclass
class _OfSamples:
    """What a number of each row, int (R,), is of the samples, which may be many."""

    of_row: np.ndarray
    visibilities: Visibilities

    def pieces(self):
        """Yield slices of the samples, and the numbers of these."""
        for piece in slices(0, self.visibilities.size):
            yield piece, self.of_row[self.visibilities.row[piece]]
            self.visibilities.scratch.let_go()

    def all(self):
        """Return the numbers of all samples, int (M,)."""
        numbers = np.empty(self.visibilities.size, self.of_row.dtype)
        for piece, those in self.pieces():
            numbers[piece] = those
        return numbers

    def counts(self, size):
        """Return how many samples have each number, int64 (size,)."""
        return sum((np.bincount(those, minlength=size) for _, those in self.pieces()), np.zeros(size, np.int64))


@dataclass
class _Integrations:
    """The integrations of all samples: rows that differ by their baselines alone are one; `samples` in each, (G,)."""

    ms: np.ndarray
    observation: np.ndarray
    scan: np.ndarray
    time: np.ndarray
    interval: np.ndarray
    samples: np.ndarray


def _integrations(visibilities, comm):
    """Return the integrations of all ranks, and the number (R,) of the one that each row of this rank belongs to."""
    rows = visibilities.rows
    own, of_row = _distinct([getattr(rows, name) for name in list(_Integrations.__dataclass_fields__)[:-1]])
    samples = _OfSamples(of_row, visibilities).counts(own[0].size)
    lists = [np.concatenate(every) for every in zip(*comm.allgather((*own, samples)))]
    whole, of_own = _distinct(lists[:-1])
    begin = sum(comm.allgather(own[0].size)[: comm.rank])
    table = _Integrations(*[*whole, np.bincount(of_own, lists[-1], whole[0].size).astype(np.int64)])
    return table, of_own[begin : begin + own[0].size][of_row]


def _distinct(columns):
    """Return the distinct rows of a table of columns, sorted, and the number of each row among them."""
    order = np.lexsort(columns[::-1])
    new = np.any([np.diff(column[order]) != 0 for column in columns], axis=0)
    number = np.empty(order.size, np.int64)
    number[order] = np.concatenate([[0], np.cumsum(new)])[: order.size]
    first = order[np.concatenate([[True], new])[: order.size]]
    return [column[first] for column in columns], number


def _blocks_of_groups(table, of_sample, group, comm):
    """Return the block int32 (M,) of every sample by the automatic rule in each group."""
    block_of_sample, blocks = np.empty(of_sample.size, np.int32), 0
    for number in range(1 + int(comm.largest(int(group.max(initial=0))))):
        here = group == number
        samples = comm.allreduce(np.bincount(of_sample[here], minlength=table.time.size))
        used = samples > 0
        if used.any():
            columns = {name: getattr(table, name)[used] for name in table.__dataclass_fields__}
            of_integration = _blocks_of_rows(_Integrations(**columns | dict(samples=samples[used])))
            block_of_sample[here] = blocks + of_integration[(np.cumsum(used) - 1)[of_sample[here]]]
            blocks += 1 + int(of_integration.max())
    return block_of_sample


def _equal_blocks(table, of_samples, blocks, comm):
    """Return the block int32 (M,) of every sample for a given number of blocks of equal size.

    They go along MeasurementSets and time; of the same moment those of rank 0 come first, then those of rank 1, …
    """
    (ms, _), of_integration = _distinct([table.ms, table.time])
    moments = _OfSamples(of_integration[of_samples.of_row], of_samples.visibilities)
    before, counts = comm.exscan(moments.counts(ms.size))
    place = np.cumsum(counts) - counts + before  # of this rank's next sample of each moment
    sizes = np.bincount(ms, counts).astype(np.int64)
    sizes = sizes[sizes > 0]
    if blocks < sizes.size:  # then they cross from one MeasurementSet to another
        sizes = np.array([sizes.sum()])
    shares = _shares(sizes, blocks)
    ends, block_of_sample = np.cumsum(sizes), np.empty(of_samples.visibilities.size, np.int32)
    for piece, moment in moments.pieces():
        places = _take_places(place, moment)
        part = np.searchsorted(ends, places, "right")
        along = (places - (ends - sizes)[part]) * shares[part] // sizes[part]
        block_of_sample[piece] = (np.cumsum(shares) - shares)[part] + along
    return block_of_sample


def _take_places(place, moment):
    """Return the place of every sample of some moments, int64 (n,), and count up the next `place` of each moment."""
    own, order = np.bincount(moment, minlength=place.size), np.argsort(moment, kind="stable")
    places = np.empty(order.size, np.int64)
    places[order] = np.arange(order.size) + np.repeat(place - (np.cumsum(own) - own), own)
    place += own
    return places


def _counted(numbers):
    """Return the distinct numbers, sorted, and how many there are of each."""
    first = np.flatnonzero(np.diff(numbers, prepend=-1))  # where another one begins
    found, inverse = np.unique(numbers[first], return_inverse=True)
    return found, np.bincount(inverse, np.diff(first, append=numbers.size), found.size)


def _shares(sizes, blocks):
    """Divide the blocks among parts of these sizes, one at least to each; the next goes to where blocks are largest."""
    shares = np.ones(sizes.size, dtype=int)
    for _ in range(blocks - sizes.size):
        shares[np.argmax(sizes / shares)] += 1
    return shares


def _blocks_of_rows(rows):
    """Return the block int32 (G,) of every integration by the automatic rule."""
    samples = rows.samples
    order = np.lexsort((rows.time, rows.observation, rows.ms))
    steps = [np.diff(column[order]) != 0 for column in (rows.ms, rows.observation)]
    steps.append(np.diff(rows.time[order]) > SESSION_GAP_SECONDS)
    session = np.empty(order.size, dtype=np.int64)
    session[order] = np.concatenate([[0], np.cumsum(np.any(steps, axis=0))])
    scan = _numbered(session, rows.scan.astype(np.int64))
    piece = _numbered(scan, _time_spans(scan, rows.time, samples))
    return _join_small(piece, session, rows.time, samples)


def _numbered(major, minor):
    """Number the distinct pairs of integers, sorted, and return the number of each element."""
    lowest = minor.min()
    return np.unique(major * (minor.max() - lowest + 1) + minor - lowest, return_inverse=True)[1]


def _extents(number, time):
    """Return the first and last time of each group of rows."""
    count = number.max() + 1
    start, end = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(start, number, time)
    np.maximum.at(end, number, time)
    return start, end


def _time_spans(scan, time, samples):
    """Number the equal spans of time within each scan that bring it below the limits."""
    start, end = _extents(scan, time)
    length = end - start
    total = np.bincount(scan, weights=samples)
    most = max(SNAPSHOT_SAMPLES, total.sum() / CUT_FOR_SIZE)
    spans = np.ceil(np.maximum(np.maximum(length / SNAPSHOT_SECONDS, total / most), 1)).astype(int)
    along = (time - start[scan]) / np.where(length > 0, length, 1)[scan]
    return np.minimum(np.floor(along * spans[scan]).astype(int), spans[scan] - 1)


class _Span(NamedTuple):
    """Pieces that follow each other in time: first and last time, samples, and the numbers of the pieces."""

    start: float
    end: float
    samples: float
    pieces: list[int]

    def with_next(self, span):
        """Return both as one."""
        return _Span(self.start, max(self.end, span.end), self.samples + span.samples, self.pieces + span.pieces)


def _join_small(piece, session, time, samples):
    """Join pieces that are too small to their neighbours; return the block of every row, along time."""
    start, end = _extents(piece, time)
    size = np.bincount(piece, weights=samples)
    home = np.zeros(start.size, dtype=np.int64)
    home[piece] = session
    number = np.empty(start.size, dtype=np.int32)
    blocks = 0
    for current in np.unique(home):
        here = np.flatnonzero(home == current)
        along = here[np.argsort(start[here], kind="stable")]
        spans = _joined([_Span(start[k], end[k], size[k], [k]) for k in along])
        for block, span in enumerate(spans, blocks):
            number[span.pieces] = block
        blocks += len(spans)
    return number[piece]


def _joined(spans):
    """Join the smallest span to the neighbour nearer in time, as long as it is too small and has one."""
    while len(spans) > 1:
        k = min(range(len(spans)), key=lambda j: spans[j].samples)
        if spans[k].samples >= SMALLEST_SNAPSHOT:
            break
        left = k - 1 if _gap(spans, k - 1) <= _gap(spans, k) else k
        spans[left : left + 2] = [spans[left].with_next(spans[left + 1])]
    return spans


def _gap(spans, k):
    """Time from span k to the next, infinite where one of them does not exist."""
    return spans[k + 1].start - spans[k].end if 0 <= k < len(spans) - 1 else np.inf


def _block_infos(ms_names, rows, of_samples, block_of_sample, comm):
    """Describe every block."""
    found = [_counted(block_of_sample[piece] * np.int64(rows.time.size) + of_piece)
             for piece, of_piece in of_samples.pieces()]
    found = sum(comm.allgather(found), [])
    pairs, counts = (np.concatenate(every) for every in zip(*found))
    samples = np.bincount(pairs // rows.time.size, counts)
    pairs = np.unique(pairs)
    first = np.searchsorted(pairs, np.arange(samples.size + 1) * rows.time.size)
    infos = []
    for number, (begin, end) in enumerate(zip(first[:-1], first[1:])):
        here = pairs[begin:end] - number * rows.time.size
        infos.append(
            BlockInfo(
                ms_name=", ".join(ms_names[k] for k in np.unique(rows.ms[here])),
                observations=tuple(np.unique(rows.observation[here]).tolist()),
                scans=tuple(np.unique(rows.scan[here]).tolist()),
                start=float(np.min(rows.time[here] - rows.interval[here] / 2)),
                end=float(np.max(rows.time[here] + rows.interval[here] / 2)),
                samples=int(samples[number]),
            )
        )
    return infos
