"""Averaging of visibilities that an image cannot tell apart, at their centre of mass.

The samples of one block in one cell of the uv plane become one: their weighted mean at their weighted mean (u, v), with
the sum of their weights.  What moving a sample by δu changes in the visibility of a source at l, exp(2πi δu l),
vanishes in the mean to first order, as the mean of δu does; what is left is −½(2π)² var(u) l² of the source.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from casa_sara.data.parts import Parts
from casa_sara.data.visibilities import Visibilities
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.runtime.scratch import IN_MEMORY, Scratch, slices

__all__ = ["PHASE", "WORTHWHILE", "Averaged", "Cells", "Lazy", "cell_sides"]


class Sliced(Protocol):
    """Numbers of all samples, of which slices can be taken: an array, or :class:`Lazy`."""

    def __getitem__(self, piece: slice, /) -> np.ndarray:
        """Return those of a slice."""


@dataclass(frozen=True)
class Lazy:
    """Numbers of samples that are made when they are asked for.

    Attributes
    ----------
    of : callable
        Returns those of a slice.
    """

    of: Callable[[slice], np.ndarray]

    def __getitem__(self, piece: slice, /) -> np.ndarray:
        """Return those of a slice."""
        return self.of(piece)


PHASE = 0.1  # rad: rms within a full cell, of the phase of a source in the corner of the image
SPARSE = 8  # cells of a block for each sample, above which samples are sorted rather than cells marked
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
    places : list of n float64 (M,) or Lazy
        Of the samples; the first coordinate is v ≥ 0.
    sides : list of n float or None
        Of the cells; None where the places are whole numbers, each a cell.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1] of the samples.
    finer : int (d,)
        The cells of block j are 2^finer[j] times smaller, or larger where that is negative.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    scratch : Scratch
        Where the samples are.

    Attributes
    ----------
    offsets : int64 (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1] of the cells of this rank.

    Raises
    ------
    OverflowError
        There are too many cells to number them.
    """

    def __init__(self, places: Sequence[Sliced], sides: Sequence[float | None],
                 offsets: np.ndarray, finer: np.ndarray, comm: Serial = SERIAL, scratch: Scratch = IN_MEMORY) -> None:
        self._comm, self._scratch, self._of_samples = comm, scratch, offsets
        lattice = _Lattice.of(places, sides, offsets, finer, comm, scratch)
        keys, self._cell, self._first = _distinct(lattice, offsets)
        self._found = keys.size
        # rows of the largest cells go to ranks, from the lowest v to the highest
        volume, spans = lattice.volume, lattice.spans
        row = np.floor(keys % volume // (volume // spans[0]) / np.exp2(finer - finer.min())[keys // volume]).astype(int)
        owner = _owners(row, self._cell.size > 0, comm)
        self._sent = [np.flatnonzero(owner == rank) for rank in range(comm.size)]
        everything, self._place = np.unique(self._exchanged(keys), return_inverse=True)
        self.offsets = np.searchsorted(everything, np.arange(len(offsets)) * volume)

    @property
    def size(self) -> int:
        """Number of cells of this rank."""
        return int(self.offsets[-1])

    def pieces(self) -> Iterator[tuple[int, slice]]:
        """Yield the block and the samples of each piece to work on: all at once (block −1) where they are in memory."""
        return _pieces_of(self._of_samples, self._scratch)

    def sums(self, values: Sliced) -> np.ndarray:
        """Return the sum of the values of the samples in every cell of this rank.

        Parameters
        ----------
        values : real (M,) or Lazy
            Of the samples of this rank.

        Returns
        -------
        float64 (cells,)
        """
        sums = np.zeros(self._found)
        for block, piece in self.pieces():
            first, end = (0, self._found) if block < 0 else self._first[block : block + 2]
            sums[first:end] += np.bincount(self._cell[piece] - first, values[piece], end - first)
        return np.bincount(self._place, self._exchanged(sums), self.size)

    def _exchanged(self, of_cells):
        """Send what each cell has of this rank's samples to the rank of the cell; return what has come."""
        return np.concatenate(self._comm.alltoall([of_cells[chosen] for chosen in self._sent]))


def _pieces_of(offsets, scratch):
    """Yield the block and the samples of each piece: each of one block, or of all (−1) where they are in memory."""
    if not scratch.on_disk:
        yield -1, slice(0, int(offsets[-1]))
        return
    for block, ends in enumerate(zip(offsets[:-1].tolist(), offsets[1:].tolist())):
        for piece in scratch.pieces(*ends):
            yield block, piece


@dataclass
class _Lattice:
    """The cells of all blocks; `least` is the number of the first one along each axis, `spans` how many there are."""

    places: Sequence[Sliced]
    sides: Sequence[float | None]
    offsets: np.ndarray
    finer: np.ndarray
    scratch: Scratch
    least: list[int] = field(default_factory=list)
    spans: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, places, sides, offsets, finer, comm, scratch):
        """Find out how far the cells reach."""
        lattice = cls(places, sides, offsets, finer, scratch)
        for axis in range(len(places)):
            ends = np.array([[-number.min(initial=0), number.max(initial=0)]
                             for _, piece in _pieces_of(offsets, scratch)
                             for number in [lattice.numbers(axis, piece)]]).max(axis=0)
            lattice.least.append(-comm.largest(int(ends[0])))
            lattice.spans.append(comm.largest(int(ends[1])) - lattice.least[-1] + 1)
        if (len(offsets) - 1) * np.prod(lattice.spans, dtype=float) > 2.0**62:
            spans = " x ".join(map(str, lattice.spans))
            raise OverflowError(f"{len(offsets) - 1} blocks of {spans} cells are too many to be numbered")
        return lattice

    @property
    def volume(self) -> int:
        """Number of cells of a block, with and without samples."""
        return int(np.prod(self.spans))

    def numbers(self, axis, piece):
        """Return the number of each sample's cell along an axis, int64."""
        side = self.sides[axis]
        if side is None:
            return self.places[axis][piece].astype(np.int64)
        counts = np.diff(np.clip(self.offsets, piece.start, piece.stop))
        number = np.repeat(np.exp2(self.finer) / side, counts)
        number *= self.places[axis][piece]
        return np.floor(number, out=number).astype(np.int64)

    def keys(self, piece):
        """Return the number of each sample's cell, int64, by block and v first."""
        counts = np.diff(np.clip(self.offsets, piece.start, piece.stop))
        key = np.repeat(np.arange(counts.size), counts)
        for axis, (least, span) in enumerate(zip(self.least, self.spans)):
            key *= span
            key += self.numbers(axis, piece)
            key -= least
        return key


def _distinct(lattice, offsets):
    """Return the distinct cells, one block after the other, which of them each sample is in, and where blocks begin."""
    scratch, size = lattice.scratch, int(offsets[-1])
    key = scratch.empty(size, np.int64)
    for _, piece in _pieces_of(offsets, scratch):
        key[piece] = lattice.keys(piece)
    keys, cell, first = [np.zeros(0, np.int64)], scratch.empty(size, np.int32), [0]
    for block, (start, stop) in enumerate(zip(offsets[:-1].tolist(), offsets[1:].tolist())):
        found = _found(key[start:stop], cell[start:stop], block * lattice.volume, lattice.volume)
        cell[start:stop] += first[-1]
        keys.append(found)
        first.append(first[-1] + found.size)
        scratch.let_go()
    return np.concatenate(keys), cell, np.array(first)


def _found(key, number, least, volume):
    """Return the distinct keys, sorted, which lie between `least` and `least` + `volume`; `number` receives places."""
    if volume > SPARSE * key.size:
        found, number[...] = np.unique(key, return_inverse=True)
        return found
    seen = np.zeros(volume, bool)
    for piece in slices(0, key.size):
        seen[key[piece] - least] = True
    place = np.cumsum(seen, dtype=np.int32)
    for piece in slices(0, key.size):
        number[piece] = place[key[piece] - least] - 1
    return least + np.flatnonzero(seen)


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
    data : Visibilities
        The samples of this rank: `weight` is w; where v < 0 they are averaged as the conjugate at (−u, −v, −w).
    vis : complex (M,) or None
        y; None where it does not fit into memory, and is made of the data.
    offsets : int (d + 1,)
        Of the blocks of the samples.
    operator : object
        Φ, of all samples of this rank: `forward`; `adjoint` where cells are enlarged.
    finer : int (d,)
        Of :class:`Cells`.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    parts : Parts or None
        Of a mosaic: samples are averaged within their parts, around the middles of these.
    sum_of_weights : float64 (cells,)
        W.
    part_of_cell : int (cells,) or None
        Number of the part of each cell.
    samples : int (d,)
        How many samples each block has, on all ranks.
    """

    cells: Cells
    data: Visibilities
    vis: np.ndarray | None
    offsets: np.ndarray
    operator: Any
    finer: np.ndarray
    comm: Serial = SERIAL
    parts: Parts | None = None

    def __post_init__(self):
        self.sum_of_weights = self.cells.sums(self.data.weight)
        self.part_of_cell: np.ndarray | None = None
        self._turn: np.ndarray | None = None
        if self.parts is not None:
            self.part_of_cell = np.rint(self.weighted_mean(self.parts.number)).astype(int)
        self.samples = self.comm.exscan(np.diff(self.offsets))[1]

    @classmethod
    def of(cls, data: Visibilities, offsets: np.ndarray, sides: np.ndarray, finer: np.ndarray,  # noqa: PLR0913 - two
           vis: np.ndarray | None, operator: Any,
           comm: Serial = SERIAL, parts: Parts | None = None) -> tuple[Averaged, np.ndarray, np.ndarray | None]:
        """Average the samples of a problem.

        Parameters
        ----------
        data : Visibilities
            `uvw`, `weight` and `freq_hz` are used.
        offsets : int (d + 1,)
            Block j is the slice offsets[j]:offsets[j + 1].
        sides : float (4,)
            Of :func:`cell_sides`; the first two are those of the parts where there are some.
        finer : int (d,)
            The cells of block j are 2^finer[j] times smaller than these.
        vis, operator, comm, parts
            As of the class.

        Returns
        -------
        averaged : Averaged
        uvw : float64 (3, cells)
            Of the averages; w is 0 where the cells do not depend on it.
        freq_hz : float64 (cells,) or None
            Geometric mean of the frequencies, where the samples have some.
        """
        places: list[Sliced] = [_place(data, axis) for axis in ((1, 0, 2) if np.isfinite(sides[2]) else (1, 0))]
        chosen = [sides[0], sides[1], *sides[2:3][np.isfinite(sides[2:3])]]
        if parts is not None:
            places, chosen = [Lazy(parts.place(1)), Lazy(parts.place(0)), parts.number], [1.0, 1.0, None]
        freqs = data.freq_hz
        if freqs is not None:
            places.append(Lazy(lambda piece: np.log(freqs[piece], dtype=float)))
            chosen.append(sides[3])
        cells = Cells(places, chosen, offsets, finer, comm, data.scratch)
        averaged = cls(cells, data, vis, offsets, operator, finer, comm, parts)
        v, u, *others = (averaged.weighted_mean(place) for place in places)
        freq_hz = None if freqs is None else np.exp(others.pop())
        if parts is not None:
            number = averaged.part_of_cell
            assert number is not None
            u, v = np.array([u, v]) * parts.sides[number].T
            averaged._turn, others = parts.turn_of(np.array([u, v]), number), []
        return averaged, np.array([u, v, *(others or [np.zeros_like(u)])]), freq_hz

    def weighted_mean(self, values: Sliced) -> np.ndarray:
        """Return the weighted mean of the values of the samples in every cell.

        Parameters
        ----------
        values : real (M,) or Lazy
            Of the samples of this rank.

        Returns
        -------
        float64 (cells,)
        """
        return self.cells.sums(Lazy(lambda piece: self.data.weight[piece] * values[piece])) / self.sum_of_weights

    def whitened_mean(self, vis: Sliced) -> np.ndarray:
        """Return Σ√w·vis/√W of whitened samples, which is √W times the weighted mean of what they were before.

        Parameters
        ----------
        vis : complex (M,) or Lazy
            Of the samples of this rank.

        Returns
        -------
        complex (cells,)
        """
        weight, v, sums = self.data.weight, self.data.uvw[1], self.cells.sums
        straight = vis
        if self.parts is not None:
            parts, v = self.parts, self.parts.uv[1]
            straight = Lazy(lambda piece: parts.straight(vis[piece], piece))
        norm = 1 / np.sqrt(self.sum_of_weights)
        mean = np.empty(self.cells.size, np.result_type(vis[:0]))
        mean.real = sums(Lazy(lambda piece: np.sqrt(weight[piece]) * straight[piece].real)) * norm
        mean.imag = sums(Lazy(lambda piece: np.sqrt(weight[piece]) * _fold(v[piece]) * straight[piece].imag)) * norm
        if self._turn is not None:
            mean *= self._turn
        return mean

    @property
    def enlarged(self) -> bool:
        """Whether cells of a block are larger than a phase of `PHASE` allows."""
        return bool(self.finer.min() < 0)

    @property
    def costly(self) -> bool:
        """Whether :meth:`renew` takes longer than many iterations."""
        return self.data.scratch.on_disk

    @property
    def whitened(self) -> Any:
        """y of the samples of this rank, of which slices can be taken."""
        return Lazy(self._whiten) if self.vis is None else self.vis

    def _whiten(self, piece):
        return self.data.vis[piece] * np.sqrt(self.data.weight[piece])

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
        if self.vis is not None:
            predicted = self.operator.forward(model)
            return np.subtract(self.vis, predicted, out=predicted)
        return self._residual_and_gradient(model, None)[0]

    def _residual_and_gradient(self, model, multipliers):
        """Return y − Φx and, where there are multipliers, Φ†λ(y − Φx), in one pass over what is on the disk."""
        if self.vis is not None:
            residual = self.residual(model)
            return residual, None if multipliers is None else \
                self.operator.adjoint(residual * self._of_samples(multipliers, residual))
        residual = self.data.scratch.empty(self.data.size, np.complex64)
        gradient = None if multipliers is None else np.zeros(model.shape)
        for piece, operator in self.operator.pieces():
            left = np.subtract(self.whitened[piece], operator.forward(model), out=residual[piece])
            if multipliers is not None:
                gradient += operator.adjoint(left * self._of_samples(multipliers, left, piece))  # used up
        return residual, gradient

    def _of_samples(self, multipliers, vis, piece=slice(None)):
        """Return the multiplier of each sample of a slice, in the precision of `vis`."""
        start, stop, _ = piece.indices(int(self.offsets[-1]))
        return np.repeat(multipliers.astype(vis.real.dtype), np.diff(np.clip(self.offsets, start, stop)))

    def renew(self, model: np.ndarray, predicted: np.ndarray,
              multipliers: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray | None]:
        """Turn Φ̄x into ȳ, so that the averages leave of this model what all samples leave of it.

        Parameters
        ----------
        model : real (nx, ny)
            x.
        predicted : complex (cells,)
            Φ̄x, which becomes Φ̄x + r̄.
        multipliers : float (d,), optional
            λ of each block, of which a gradient is wanted.

        Returns
        -------
        scatter : float64 (d,)
            Of each block, of all ranks.
        gradient : real (nx, ny) or None
            Φ†λr of the samples of this rank.
        """
        residual, gradient = self._residual_and_gradient(model, multipliers)
        mean = self.whitened_mean(residual)
        predicted += mean
        scatter = self.comm.allreduce(_powers(residual, self.offsets) - _powers(mean, self.cells.offsets))
        return np.maximum(scatter, 0), gradient

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


def _fold(v):
    """Return −1 where v < 0, else 1, float32."""
    return np.where(v < 0, np.float32(-1), np.float32(1))


def _place(data, axis):
    """Return what gives u, v or w of samples, or of their conjugates where v < 0."""
    return Lazy(lambda piece: data.uvw[axis, piece] * _fold(data.uvw[1, piece]))


def _powers(vis, offsets):
    """Return ‖·‖² of each block, float64 (d,)."""
    return np.array([np.square(np.abs(vis[a:b]), dtype=float).sum() for a, b in zip(offsets[:-1], offsets[1:])])
