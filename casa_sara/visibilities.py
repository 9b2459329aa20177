"""Stokes I visibilities of one image, and their split into snapshot blocks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

__all__ = ["BlockInfo", "RowTable", "Visibilities", "clock", "snapshot_blocks", "sort_into_blocks"]

SNAPSHOT_SECONDS = 1800.0
SNAPSHOT_SAMPLES = 100_000
SMALLEST_SNAPSHOT = 500
SESSION_GAP_SECONDS = 12 * 3600.0


@dataclass
class RowTable:
    """What is known of each MeasurementSet row that holds at least one sample, all (R,).

    `row` counts in its own MeasurementSet, `ms` numbers the MeasurementSets (in `vis`'s
    order), `time` is the middle of the integration in MJD seconds (UTC) and `interval`
    its length in seconds.
    """

    ms: np.ndarray
    row: np.ndarray
    time: np.ndarray
    interval: np.ndarray
    scan: np.ndarray
    observation: np.ndarray
    field: np.ndarray
    spw: np.ndarray
    antenna1: np.ndarray
    antenna2: np.ndarray


@dataclass
class Visibilities:
    """All usable Stokes I samples, rotated to the image's phase centre.

    Attributes
    ----------
    vis : complex64 (M,)
        Visibilities in Jy.
    weight : float32 (M,)
        Inverse variance of the real part, and of the imaginary part, in 1/Jy²:
        4 / (1/w_RR + 1/w_LL), exact when WEIGHT = 1/SIGMA².
    imaging_weight : float32 (M,)
        tclean's natural gridding weight, (w_RR + w_LL) / 2.
    uvw : float64 (3, M)
        Baselines in wavelengths at the LSRK frequency of the integration.
    row : int32 (M,)
        Index into `rows`.
    chan : int16 (M,)
        Channel number in the spectral window.
    rows : RowTable
    ms_names : tuple of str
    dropped : dict
        Reason → number of samples that were left out.
    notes : list of str
        Warnings that the user must see, also in the record of the run.
    phase_center : dict
        Direction of the image centre, a CASA direction measure.
    freq_range_hz : (float, float)
        Lowest and highest LSRK frequency of the selection, edges of the channels.
    spws : dict
        Number of the MeasurementSet → the spectral windows selected of it; a
        MeasurementSet of which nothing is selected is missing here.
    observatory : str
        Name of the telescope, of the first row selected.
    """

    vis: np.ndarray
    weight: np.ndarray
    imaging_weight: np.ndarray
    uvw: np.ndarray
    row: np.ndarray
    chan: np.ndarray
    rows: RowTable
    ms_names: tuple[str, ...] = ()
    dropped: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    phase_center: dict = field(default_factory=dict)
    freq_range_hz: tuple[float, float] = (0.0, 0.0)
    spws: dict[int, tuple[int, ...]] = field(default_factory=dict)
    observatory: str = ""

    @property
    def size(self) -> int:
        """Number of samples M."""
        return self.vis.size

    def take(self, index) -> Visibilities:
        """Return the samples numbered `index`, in that order; `rows` stays whole."""
        per_sample = ("vis", "weight", "imaging_weight", "uvw", "row", "chan")
        return replace(self, **{name: np.take(getattr(self, name), index, axis=-1) for name in per_sample})

    @property
    def max_uv(self) -> float:
        """Longest projected baseline in wavelengths."""
        return float(np.sqrt(np.max(self.uvw[0] ** 2 + self.uvw[1] ** 2)))

    @property
    def max_w(self) -> float:
        """Largest |w| in wavelengths."""
        return float(np.max(np.abs(self.uvw[2])))


@dataclass(frozen=True)
class BlockInfo:
    """What a snapshot block holds; `start` and `end` in MJD seconds."""

    ms_name: str
    observations: tuple[int, ...]
    scans: tuple[int, ...]
    start: float
    end: float
    samples: int

    @property
    def label(self) -> str:
        """The block in one line."""
        first, last = (clock(time) for time in (self.start, self.end))
        observations, scans = (",".join(map(str, numbers)) for numbers in (self.observations, self.scans))
        return f"{self.ms_name} observation {observations} scan {scans}, {first} to {last}, {self.samples} samples"


def clock(mjd_seconds):
    """Spell a time in UTC."""
    return str(np.datetime64("1858-11-17T00:00:00") + np.timedelta64(round(mjd_seconds), "s"))


def snapshot_blocks(visibilities, blocks=0, group=None):
    """Split the samples into snapshots: spans over which errors may be taken as constant.

    Each block gets an ℓ2 bound of its own. The automatic rule (`blocks` = 0):

    1. one block for each scan of each observation of each MeasurementSet (and for each
       session of it: a gap of 12 h starts a new one);
    2. a scan longer than 30 min, or of more than 1e5 samples, is cut into equal spans of
       time, as many as bring it below both limits; an integration is never cut;
    3. a block of fewer than 500 samples is joined to the neighbour nearer in time, the
       smallest first, as long as the session has one: a bound from few samples says little.

    With `blocks` = n there are n blocks of equal size (± 1) along time; they do not cross from
    one MeasurementSet to another, unless these outnumber the blocks.

    Parameters
    ----------
    visibilities : Visibilities
    blocks : int
        0 for the automatic rule, or the number of blocks.
    group : int (M,), optional
        Samples of different groups are never in one block; the automatic rule splits each group by itself.

    Returns
    -------
    block_of_sample : int32 (M,)
        Numbers 0 … d−1 along groups, MeasurementSets and time; every block holds a sample.
    infos : list of d BlockInfo

    Raises
    ------
    ValueError
        When `blocks` is negative or exceeds the number of samples.
    """
    if not 0 <= blocks <= visibilities.size:
        raise ValueError(
            f"blocks = {blocks}: it takes 0 (automatic) or 1 to {visibilities.size}, the number of visibilities"
        )
    if group is not None:
        block_of_sample = _blocks_of_groups(visibilities, group)
    elif blocks:
        block_of_sample = _equal_blocks(visibilities, blocks)
    else:
        block_of_sample = _blocks_of_rows(visibilities)[visibilities.row]
    return block_of_sample, _block_infos(visibilities, block_of_sample)


def _blocks_of_groups(visibilities, group):
    """Return the block int32 (M,) of every sample by the automatic rule in each group."""
    block_of_sample, blocks = np.empty(visibilities.size, np.int32), 0
    for number in np.unique(group):
        here = group == number
        used, row = np.unique(visibilities.row[here], return_inverse=True)
        rows = RowTable(**{name: getattr(visibilities.rows, name)[used] for name in RowTable.__dataclass_fields__})
        block_of_sample[here] = blocks + _blocks_of_rows(replace(visibilities, rows=rows, row=row))[row]
        blocks = int(block_of_sample[here].max()) + 1
    return block_of_sample


def _equal_blocks(visibilities, blocks):
    """Return the block of every sample for a given number of blocks of equal size."""
    rows = visibilities.rows
    order = np.lexsort((rows.time[visibilities.row], rows.ms[visibilities.row]))
    sizes = np.bincount(rows.ms[visibilities.row])
    sizes = sizes[sizes > 0]
    if blocks < sizes.size:
        sizes, shares = np.array([visibilities.size]), np.array([blocks])
    else:
        shares = np.ones(sizes.size, dtype=int)
        for _ in range(blocks - sizes.size):
            shares[np.argmax(sizes / shares)] += 1
    along = [np.arange(size) * share // size for size, share in zip(sizes, shares)]
    starts = np.concatenate([[0], np.cumsum(shares)[:-1]])
    block_of_sample = np.empty(visibilities.size, dtype=np.int32)
    block_of_sample[order] = np.concatenate([start + part for start, part in zip(starts, along)])
    return block_of_sample


def _blocks_of_rows(visibilities):
    """Return the block int32 (R,) of every row by the automatic rule."""
    rows = visibilities.rows
    samples = np.bincount(visibilities.row, minlength=rows.time.size)
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
    spans = np.ceil(np.maximum(np.maximum(length / SNAPSHOT_SECONDS, total / SNAPSHOT_SAMPLES), 1)).astype(int)
    along = (time - start[scan]) / np.where(length > 0, length, 1)[scan]
    return np.minimum(np.floor(along * spans[scan]).astype(int), spans[scan] - 1)


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
        spans = [[start[k], end[k], size[k], [k]] for k in here[np.argsort(start[here], kind="stable")]]
        while len(spans) > 1:
            k = min(range(len(spans)), key=lambda j: spans[j][2])
            if spans[k][2] >= SMALLEST_SNAPSHOT:
                break
            before = spans[k][0] - spans[k - 1][1] if k > 0 else np.inf
            after = spans[k + 1][0] - spans[k][1] if k + 1 < len(spans) else np.inf
            left = k - 1 if before <= after else k
            one, two = spans[left : left + 2]
            spans[left : left + 2] = [[one[0], max(one[1], two[1]), one[2] + two[2], one[3] + two[3]]]
        for span in spans:
            number[span[3]] = blocks
            blocks += 1
    return number[piece]


def _block_infos(visibilities, block_of_sample):
    """Describe every block."""
    rows = visibilities.rows
    samples = np.bincount(block_of_sample)
    pairs = np.unique(block_of_sample.astype(np.int64) * rows.time.size + visibilities.row)
    first = np.searchsorted(pairs, np.arange(samples.size + 1) * rows.time.size)
    infos = []
    for number, (begin, end) in enumerate(zip(first[:-1], first[1:])):
        here = pairs[begin:end] - number * rows.time.size
        infos.append(
            BlockInfo(
                ms_name=", ".join(visibilities.ms_names[k] for k in np.unique(rows.ms[here])),
                observations=tuple(np.unique(rows.observation[here]).tolist()),
                scans=tuple(np.unique(rows.scan[here]).tolist()),
                start=float(np.min(rows.time[here] - rows.interval[here] / 2)),
                end=float(np.max(rows.time[here] + rows.interval[here] / 2)),
                samples=int(samples[number]),
            )
        )
    return infos


def sort_into_blocks(visibilities, block_of_sample):
    """Return the same samples ordered so that each block is one slice.

    Parameters
    ----------
    visibilities : Visibilities
    block_of_sample : int (M,)
        Numbers 0 … d−1.

    Returns
    -------
    sorted : Visibilities
        Within a block the order is that of `visibilities`.
    offsets : int64 (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    """
    order = np.argsort(block_of_sample, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(block_of_sample))]).astype(np.int64)
    return visibilities.take(order), offsets
