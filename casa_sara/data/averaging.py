"""Averaging of visibilities that an image cannot tell apart, at their centre of mass.

The samples of one block in one cell of the uv plane become one: their weighted mean at their weighted mean (u, v), with
the sum of their weights.  What moving a sample by δu changes in the visibility of a source at l, exp(2πi δu l),
vanishes in the mean to first order, as the mean of δu does; what is left is −½(2π)² var(u) l² of the source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casa_sara.data.visibilities import Visibilities
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["PHASE", "WORTHWHILE", "Averaged", "Cells", "cell_sides"]

PHASE = 0.1  # rad: rms within a full cell, of the phase of a source in the corner of the image
WORTHWHILE = 0.5  # of the samples: where there are more averages than that, all samples are used


def cell_sides(shape: tuple[int, int], cell_rad: Sequence[float], depth: float = 0.0, index: float = 0.0) -> np.ndarray:
    """Sides of the cells along v, u, w and ln ν.

    A full cell has the variance side²/12 along each axis.  The sides along u and v give a source in the corner of the
    image, half its width away from the centre along both axes, a phase of rms `PHASE`; w and ln ν may each change its
    visibilities by as much as u or v alone.

    Parameters
    ----------
    shape : (int, int)
        Pixels of the image.
    cell_rad : (float, float)
        Pixel size in radians.
    depth : float
        Largest 1 − n in the image where the w-term is modelled, else 0.
    index : float
        Largest |α| of the spectral index, 0 where the sky is the same at all frequencies.

    Returns
    -------
    float (4,)
        The first three in wavelengths; infinite where nothing depends on it.
    """
    extents = np.array([shape[1] * cell_rad[1] / 2, shape[0] * cell_rad[0] / 2, depth, index / (2 * np.pi)])
    with np.errstate(divide="ignore"):
        return np.sqrt(6) * PHASE / (2 * np.pi * extents)


class Cells:
    """Which samples share a cell of their block, over the ranks.

    Every rank is given the cells of a range of v, so that they lie, block by block, as one rank alone has them.

    Parameters
    ----------
    places : list of n float64 (M,)
        Of the samples; the first coordinate is v ≥ 0.
    sides : list of n float
        Of the cells.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1] of the samples.
    finer : int (d,)
        The cells of block j are 2^finer[j] times smaller.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Attributes
    ----------
    offsets : int64 (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1] of the cells of this rank.

    Raises
    ------
    OverflowError
        There are too many cells to number them.
    """

    def __init__(self, places: Sequence[np.ndarray], sides: Sequence[float], offsets: np.ndarray, finer: np.ndarray,
                 comm: Serial = SERIAL) -> None:
        self._comm = comm
        key, spans = _numbers(places, sides, offsets, finer, comm)
        keys, self._cell = _distinct(key, offsets)
        self._found = keys.size
        # rows of the largest cells go to ranks, from the lowest v to the highest
        volume = int(np.prod(spans))
        row = keys % volume // (volume // spans[0]) >> finer[keys // volume]
        owner = _owners(row, key.size > 0, comm)
        self._sent = [np.flatnonzero(owner == rank) for rank in range(comm.size)]
        everything, self._place = np.unique(self._exchanged(keys), return_inverse=True)
        self.offsets = np.searchsorted(everything, np.arange(len(offsets)) * volume)

    @property
    def size(self) -> int:
        """Number of cells of this rank."""
        return int(self.offsets[-1])

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of the values of the samples in every cell of this rank.

        Parameters
        ----------
        values : real (M,)
            Of the samples of this rank.

        Returns
        -------
        float64 (cells,)
        """
        sums = np.bincount(self._cell, values, self._found)
        return np.bincount(self._place, self._exchanged(sums), self.size)

    def _exchanged(self, of_cells):
        """Send what each cell has of this rank's samples to the rank of the cell; return what has come."""
        return np.concatenate(self._comm.alltoall([of_cells[chosen] for chosen in self._sent]))


def _numbers(places, sides, offsets, finer, comm):
    """Return the number of each sample's cell, int64 (M,), by block and v first, and the cells along each axis."""
    counts, spans = np.diff(offsets), []
    key = np.repeat(np.arange(counts.size), counts)
    for place, side in zip(places, sides):
        number = np.repeat(np.exp2(finer) / side, counts)
        number *= place
        number = np.floor(number, out=number).astype(np.int64)
        least = -comm.largest(int(-number.min(initial=0)))
        spans.append(comm.largest(int(number.max(initial=0))) - least + 1)
        key *= spans[-1]
        key += number
        key -= least
    if counts.size * np.prod(spans, dtype=float) > 2.0**62:
        raise OverflowError(f"{counts.size} blocks of {' x '.join(map(str, spans))} cells are too many to be numbered")
    return key, spans


def _distinct(key, offsets):
    """Return the distinct numbers of each block, one block after the other, and where among them each sample's is."""
    keys, cell, count = [np.zeros(0, np.int64)], np.empty(key.size, np.int32), 0
    for start, stop in zip(offsets[:-1], offsets[1:]):
        found, inverse = np.unique(key[start:stop], return_inverse=True)
        np.add(inverse, count, out=cell[start:stop], casting="same_kind")
        keys.append(found)
        count += found.size
    return np.concatenate(keys), cell


def _owners(row, holds, comm):
    """Return the rank that each cell belongs to: those that hold samples share the rows of cells evenly."""
    holders = np.flatnonzero(comm.allgather(holds))
    rows = comm.largest(int(row.max(initial=0))) + 1
    count = comm.allreduce(np.bincount(row, minlength=rows).astype(float))
    before = np.cumsum(count) - count
    return holders[(before * (holders.size / count.sum())).astype(int)][row]


@dataclass
class Averaged:
    """The averages of whitened samples y = √w·V, and what links them to all samples.

    They are whitened as well, √W times the mean with W = Σw, so that the average of noise has the variance of one
    sample.  Where a model has the same visibility for all samples of a cell,

        ‖y − Φx‖² = ‖ȳ − Φ̄x‖² + scatter,      scatter = Σ|r|² − Σ|r̄|²   for r = y − Φx,

    and Φ†UΦ = Φ̄†ŪΦ̄ with Ū the weighted mean of U.  It has nearly the same, and :meth:`renew` therefore averages
    residuals: ȳ = Φ̄x + r̄ for the model at hand leaves what that model leaves, without any error, and its scatter is
    exact.  For another model Φ̄ is wrong by what it makes of the difference of the two.

    Attributes
    ----------
    cells : Cells
    weight : real (M,)
        w of the samples of this rank.
    fold : float32 (M,)
        −1 where v < 0: those are averaged as the conjugate at (−u, −v, −w); else 1.
    vis : complex (M,)
        y.
    offsets : int (d + 1,)
        Of the blocks of the samples.
    operator : object
        Φ, of all samples of this rank: `forward`.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    sum_of_weights : float64 (cells,)
        W.
    samples : int (d,)
        How many samples each block has, on all ranks.
    """

    cells: Cells
    weight: np.ndarray
    fold: np.ndarray
    vis: np.ndarray
    offsets: np.ndarray
    operator: Any
    comm: Serial = SERIAL

    def __post_init__(self):
        self.sum_of_weights = self.cells.sums(self.weight)
        self.samples = self.comm.exscan(np.diff(self.offsets))[1]

    @classmethod
    def of(cls, data: Visibilities, offsets: np.ndarray, sides: np.ndarray, finer: np.ndarray | None, vis: np.ndarray,
           operator: Any, comm: Serial = SERIAL) -> tuple[Averaged, np.ndarray, np.ndarray | None]:
        """Average the samples of a problem.

        Parameters
        ----------
        data : Visibilities
            `uvw`, `weight` and `freq_hz` are used.
        offsets : int (d + 1,)
            Block j is the slice offsets[j]:offsets[j + 1].
        sides : float (4,)
            Of :func:`cell_sides`.
        finer : int (d,) or None
            The cells of block j are 2^finer[j] times smaller than these; None for 0.
        vis, operator, comm
            As of the class.

        Returns
        -------
        averaged : Averaged
        uvw : float64 (3, cells)
            Of the averages; w is 0 where the cells do not depend on it.
        freq_hz : float64 (cells,) or None
            Geometric mean of the frequencies, where the samples have some.
        """
        fold = np.where(data.uvw[1] < 0, np.float32(-1), np.float32(1))
        places = [data.uvw[axis] * fold for axis in ((1, 0, 2) if np.isfinite(sides[2]) else (1, 0))]
        if data.freq_hz is not None:
            places.append(np.log(data.freq_hz, dtype=float))
        finer = np.zeros(len(offsets) - 1, int) if finer is None else finer
        chosen = [sides[0], sides[1], *sides[2:3][np.isfinite(sides[2:3])], *sides[3:][:data.freq_hz is not None]]
        averaged = cls(Cells(places, chosen, offsets, finer, comm), data.weight, fold, vis, offsets, operator, comm)
        v, u, *others = (averaged.weighted_mean(place) for place in places)
        freq_hz = None if data.freq_hz is None else np.exp(others.pop())
        return averaged, np.array([u, v, *(others or [np.zeros_like(u)])]), freq_hz

    def weighted_mean(self, values: np.ndarray) -> np.ndarray:
        """Return the weighted mean of the values of the samples in every cell.

        Parameters
        ----------
        values : real (M,)
            Of the samples of this rank.

        Returns
        -------
        float64 (cells,)
        """
        return self.cells.sums(self.weight * values) / self.sum_of_weights

    def whitened_mean(self, vis: np.ndarray) -> np.ndarray:
        """Return Σ√w·vis/√W of whitened samples, which is √W times the weighted mean of what they were before.

        Parameters
        ----------
        vis : complex (M,)
            Of the samples of this rank.

        Returns
        -------
        complex (cells,)
        """
        root, norm = np.sqrt(self.weight), 1 / np.sqrt(self.sum_of_weights)
        mean = np.empty(self.cells.size, vis.dtype)
        mean.real = self.cells.sums(root * vis.real) * norm
        root *= self.fold
        mean.imag = self.cells.sums(root * vis.imag) * norm
        return mean

    def residual(self, model: np.ndarray) -> np.ndarray:
        """Return y − Φx of all samples of this rank.

        Parameters
        ----------
        model : real (nx, ny)
            x.

        Returns
        -------
        complex (M,)
        """
        predicted = self.operator.forward(model)
        return np.subtract(self.vis, predicted, out=predicted)

    def renew(self, model: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """Turn Φ̄x into ȳ, so that the averages leave of this model what all samples leave of it.

        Parameters
        ----------
        model : real (nx, ny)
            x.
        predicted : complex (cells,)
            Φ̄x, which becomes Φ̄x + r̄.

        Returns
        -------
        float64 (d,)
            The scatter of each block, of all ranks.
        """
        residual = self.residual(model)
        mean = self.whitened_mean(residual)
        predicted += mean
        return np.maximum(self.comm.allreduce(_powers(residual, self.offsets) - _powers(mean, self.cells.offsets)), 0)

    def error(self, residual: np.ndarray, of_averages: np.ndarray) -> np.ndarray:
        """Return how wrong Φ̄ is for a model: the rms, in each block, of Φ̄x less the average of Φx.

        Parameters
        ----------
        residual : complex (M,)
            y − Φx.
        of_averages : complex (cells,)
            ȳ − Φ̄x, with the averages ȳ of y.

        Returns
        -------
        float64 (d,)
            Of real and imaginary parts, whitened: in units of what the MS weights say of the noise of an average.
        """
        wrong = self.whitened_mean(residual) - of_averages
        powers, cells = self.comm.allreduce(np.array([_powers(wrong, self.cells.offsets), np.diff(self.cells.offsets)]))
        return np.sqrt(powers / (2 * np.maximum(cells, 1)))


def _powers(vis, offsets):
    """Return ‖·‖² of each block, float64 (d,)."""
    return np.array([np.square(np.abs(vis[a:b]), dtype=float).sum() for a, b in zip(offsets[:-1], offsets[1:])])
