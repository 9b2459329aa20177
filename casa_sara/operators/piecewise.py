"""The measurement operator of more visibilities than the memory holds: one piece of them after the other.

What the operator of a piece keeps of each visibility goes to the disk, and all pieces share one grid.  Those that model
more than the plane (w-term, images of spectral indices) are made anew at every call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from casa_sara.operators._workers import Workers
from casa_sara.operators.measurement import MeasurementOperator, WorkSpace
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid
from casa_sara.runtime.scratch import Scratch

__all__ = ["PiecewiseOperator", "operator_on_disk"]


class PiecewiseOperator:
    """Φ of all samples, of which only a piece is at hand at a time.

    Parameters
    ----------
    uvw : float64 (3, M)
        Baselines in wavelengths.
    grid : casa_sara.options.ImageGrid
        As of :func:`casa_sara.operators.sky.sky_operator`.
    freq_hz : real (M,) or None
        Frequencies, where there is a spectrum.
    eps : float
        Accuracy.
    workers : Workers
        Threads.
    scratch : Scratch
        Where the samples are.
    """

    dtype = np.dtype(np.float32)

    def __init__(self, uvw: np.ndarray, grid: ImageGrid,
                 freq_hz: np.ndarray | None, eps: float, workers: Workers, scratch: Scratch) -> None:
        self.shape, self.size, self.workers = grid.shape, uvw.shape[1], workers
        self._uvw, self._grid, self._freq_hz, self._eps, self._scratch = uvw, grid, freq_hz, eps, scratch
        self._kept: dict[int, MeasurementOperator] = {}
        self._space = WorkSpace()

    def pieces(self) -> Iterator[tuple[slice, Any]]:
        """Yield the slice and the operator of each piece."""
        for piece in self._scratch.pieces(0, self.size):
            yield piece, self._kept.get(piece.start) or self._made(piece)

    def _made(self, piece):
        """Return the operator of a piece, and keep it where that is possible."""
        freq_hz = None if self._freq_hz is None else self._freq_hz[piece]
        nthreads = self.workers if self._grid.gridder == "standard" else self.workers.count
        operator = sky_operator(self._uvw[:, piece], self._grid, freq_hz, eps=self._eps, nthreads=nthreads)
        if isinstance(operator, MeasurementOperator):
            operator.keep_in(self._space, self._scratch.empty)
            self._kept[piece.start] = operator
        return operator

    def adjoint(self, vis: Callable[[slice, Any], np.ndarray]) -> np.ndarray:
        """Return Re(Φ†·vis).

        Parameters
        ----------
        vis : callable
            Returns the visibilities of a slice from this and its operator.

        Returns
        -------
        real (nx, ny)
        """
        total = np.zeros(self.shape)
        for piece, operator in self.pieces():
            total += operator.adjoint(vis(piece, operator))
        return total.astype(self.dtype)

    def forward_pieces(self, image: np.ndarray) -> Iterator[np.ndarray]:
        """Yield Φ·image of each piece.

        Parameters
        ----------
        image : real (nx, ny)
            The image x.

        Returns
        -------
        iterator of complex (n,)
        """
        for _, operator in self.pieces():
            yield operator.forward(image)

    def scaled(self, scale: Callable[[slice], np.ndarray]) -> ScaledPieces:
        """Return the operator with a factor on each sample.

        Parameters
        ----------
        scale : callable
            Returns the factors of a slice.

        Returns
        -------
        ScaledPieces
        """
        return ScaledPieces(self, scale)


@dataclass(frozen=True)
class ScaledPieces:
    """A `PiecewiseOperator` with a factor on each sample."""

    base: PiecewiseOperator
    scale: Callable[[slice], np.ndarray]

    def pieces(self) -> Iterator[tuple[slice, _Scaled]]:
        """Yield the slice and the operator of each piece."""
        for piece, operator in self.base.pieces():
            yield piece, _Scaled(operator, self.scale(piece))


@dataclass(frozen=True)
class _Scaled:
    operator: Any
    scale: np.ndarray

    def forward(self, image):
        """Return the scaled visibilities."""
        vis = self.operator.forward(image)
        vis *= self.scale
        return vis

    def adjoint(self, vis):
        """Return the image of scaled visibilities, which are used up."""
        vis *= self.scale
        return self.operator.adjoint(vis)


def operator_on_disk(uvw: np.ndarray, grid: ImageGrid,
                     freq_hz: np.ndarray | None, eps: float, nthreads: int, scratch: Scratch) -> PiecewiseOperator:
    """Return the operator of samples on the disk: the one that there is, where it is of the same samples and spectrum.

    Parameters
    ----------
    uvw, grid, freq_hz, eps, scratch
        As of `PiecewiseOperator`.
    nthreads : int
        Of its calls.

    Returns
    -------
    PiecewiseOperator
    """
    what = (uvw, freq_hz, grid.gridder, grid.spectrum)
    for known, operator in scratch.kept:
        if all(one is other for one, other in zip(known, what)):
            return operator
    operator = PiecewiseOperator(uvw, grid, freq_hz, eps, Workers(nthreads), scratch)
    scratch.kept = [(known, other) for known, other in scratch.kept if known[0] is uvw] + [(what, operator)]
    return operator
