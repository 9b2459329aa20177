"""Visibilities of one image in Stokes I or others, and their split into snapshot blocks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casa_sara.runtime.scratch import IN_MEMORY, Scratch, slices

__all__ = ["BlockInfo", "RowTable", "Visibilities", "clock", "sort_into_blocks"]


@dataclass
class RowTable:
    """The metadata of each MeasurementSet row with at least one sample, all (R,).

    `row` counts in its own MeasurementSet, `ms` numbers the MeasurementSets (in `vis`'s
    order), `time` is the middle of the integration in MJD seconds (UTC), `interval`
    its length in seconds, and `hands` the number of correlations that a sample is formed of.
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
    hands: np.ndarray


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
        tclean's natural gridding weight, (w_RR + w_LL) / 2 of RR (first) to LL (last).
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
    alone : dict
        Correlation → number of samples that are of it alone, because the other correlation has no weight.
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
    freq_hz : float32 (M,) or None
        LSRK frequencies, where they were asked for.
    further_vis, further_weight : complex64 and float32 (S - 1, M), or None
        The same of further Stokes parameters, where several were asked for: see :meth:`of_stokes`.
    beam : int32 (M,) or None
        Number of the primary beam of each sample, where they are modelled.
    fields : dict
        (number of the MeasurementSet, number of the field) → its direction, a CASA direction measure.
    mixed_weights : bool
        Whether some rows of a MeasurementSet have a WEIGHT_SPECTRUM and others have not.
    scratch : Scratch
        Where the arrays of samples are, and others of their size go.
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
    alone: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    phase_center: dict = field(default_factory=dict)
    freq_range_hz: tuple[float, float] = (0.0, 0.0)
    spws: dict[int, tuple[int, ...]] = field(default_factory=dict)
    observatory: str = ""
    freq_hz: np.ndarray | None = None
    beam: np.ndarray | None = None
    further_vis: np.ndarray | None = None
    further_weight: np.ndarray | None = None
    fields: dict[tuple[int, int], dict] = field(default_factory=dict)
    mixed_weights: bool = False
    scratch: Scratch = IN_MEMORY

    @property
    def size(self) -> int:
        """Number of samples M."""
        return self.vis.size

    @property
    def n_stokes(self) -> int:
        """Number of Stokes parameters S."""
        return 1 if self.further_vis is None else 1 + len(self.further_vis)

    def of_stokes(self, number: int) -> Visibilities:
        """Return the samples of one of several Stokes parameters; all else is shared.

        Parameters
        ----------
        number : int
            0 for the first.

        Returns
        -------
        Visibilities
        """
        alone = replace(self, further_vis=None, further_weight=None)
        if number == 0:
            return alone
        assert self.further_vis is not None and self.further_weight is not None
        return replace(alone, vis=self.further_vis[number - 1], weight=self.further_weight[number - 1])

    def take(self, index: np.ndarray) -> Visibilities:
        """Return the samples numbered `index`, in that order; `rows` stays whole.

        Parameters
        ----------
        index : int (n,)
            Numbers of samples.

        Returns
        -------
        Visibilities
        """
        scratch = self.scratch if len(index) > self.scratch.piece else IN_MEMORY
        taken: dict[str, Any] = {name: _taken(column, index, scratch) for name, column in self._columns().items()}
        return replace(self, **taken, scratch=scratch)

    def _columns(self):
        """Return name → array of what there is of each sample."""
        names = ("vis", "weight", "imaging_weight", "uvw", "row", "chan", "freq_hz", "beam", "further_vis",
                 "further_weight")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def parts(self) -> Iterator[tuple[slice, Visibilities]]:
        """Yield slices of the samples, as many as are worked on at a time, and these; `rows` stays whole."""
        for piece in self.scratch.pieces(0, self.size):
            columns = {name: column[..., piece] for name, column in self._columns().items()}
            yield piece, replace(self, **columns, scratch=IN_MEMORY)

    def part(self, index: np.ndarray) -> Visibilities:
        """Return the samples numbered `index`, in that order, with `rows` of their own.

        Parameters
        ----------
        index : int (n,)
            Numbers of samples.

        Returns
        -------
        Visibilities
        """
        chosen = self.take(index)
        used = np.zeros(self.rows.row.size, bool)
        used[chosen.row] = True
        chosen.row = (np.cumsum(used) - 1).astype(np.int32)[chosen.row]
        chosen.rows = RowTable(**{name: column[used] for name, column in vars(self.rows).items()})
        return chosen

    @property
    def max_uv(self) -> float:
        """Longest projected baseline in wavelengths."""
        return max((float(np.sqrt(np.max(square))) for square in self._uv_squares()), default=0.0)

    @property
    def min_uv(self) -> float:
        """Shortest projected baseline in wavelengths."""
        return min((float(np.sqrt(np.min(square))) for square in self._uv_squares()), default=np.inf)

    def _uv_squares(self):
        """Yield u² + v² of some samples after the other."""
        for piece in slices(0, self.size):
            yield self.uvw[0, piece] ** 2 + self.uvw[1, piece] ** 2
            self.scratch.let_go()

    @property
    def reach(self) -> tuple[float, float, float]:
        """Largest |u|, |v| and |w| in wavelengths."""
        reach = np.zeros(3)
        for piece in self.scratch.pieces(0, self.size):
            np.maximum(reach, [np.abs(axis[piece]).max(initial=0) for axis in self.uvw], out=reach)
        u, v, w = reach.tolist()
        return u, v, w

    @property
    def max_w(self) -> float:
        """Largest |w| in wavelengths."""
        return self.reach[2]


def _taken(column, index, scratch):
    """Return the samples numbered `index` of a column."""
    if not scratch.on_disk:
        return np.take(column, index, axis=-1)
    taken = scratch.empty((*column.shape[:-1], len(index)), column.dtype)
    for piece in scratch.pieces(0, len(index)):
        taken[..., piece] = np.take(column, index[piece], axis=-1)
    return taken


@dataclass(frozen=True)
class BlockInfo:
    """The contents of a data block; `start` and `end` in MJD seconds, `band_hz` where it holds a part of the band."""

    ms_name: str
    observations: tuple[int, ...]
    scans: tuple[int, ...]
    start: float
    end: float
    samples: int
    band_hz: tuple[float, float] | None = None

    @property
    def label(self) -> str:
        """The block in one line."""
        first, last = (clock(time) for time in (self.start, self.end))
        observations, scans = (",".join(map(str, numbers)) for numbers in (self.observations, self.scans))
        band = "" if self.band_hz is None else f"{self.band_hz[0] / 1e9:.4g} to {self.band_hz[1] / 1e9:.4g} GHz, "
        return (f"{self.ms_name} observation {observations} scan {scans}, {first} to {last}, {band}{self.samples} "
                "samples")


def clock(mjd_seconds: float) -> str:
    """Spell a time in UTC.

    Parameters
    ----------
    mjd_seconds : float
        Time in MJD seconds, UTC.

    Returns
    -------
    str
    """
    return str(np.datetime64("1858-11-17T00:00:00") + np.timedelta64(round(mjd_seconds), "s"))


def sort_into_blocks(visibilities: Visibilities, block_of_sample: np.ndarray,
                     blocks: int = 0) -> tuple[Visibilities, np.ndarray]:
    """Return the same samples ordered so that each block is one slice.

    Parameters
    ----------
    visibilities : Visibilities
        The samples to sort.
    block_of_sample : int (M,)
        Numbers 0 … d−1.
    blocks : int
        d, where some blocks may have no sample here.

    Returns
    -------
    sorted : Visibilities
        Within a block the order is that of `visibilities`.
    offsets : int64 (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    """
    offsets = np.concatenate([[0], np.cumsum(np.bincount(block_of_sample, minlength=blocks))]).astype(np.int64)
    if visibilities.scratch.on_disk and np.all(block_of_sample[1:] >= block_of_sample[:-1]):
        return visibilities, offsets
    return visibilities.take(np.argsort(block_of_sample, kind="stable")), offsets
