"""The SARA dictionary Ψ: Dirac and Daubechies bases whose concatenation is a Parseval frame.

Each basis is orthonormal (Daubechies wavelets with periodic boundaries, PyWavelets' mode 'periodization') and is scaled
by 1/√b, b the number of bases, so that Ψ Ψ† = I and ‖Ψ‖ = 1.  Filters come from PyWavelets, the transforms from the
compiled kernels next door; in single precision the coefficients agree with PyWavelets in double precision to 1e-6 of
the largest.  An image whose size is not a multiple of 2**levels is continued with zeros for the transform and cut out
of the synthesis, which keeps the frame Parseval.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter

from casa_sara.operators import _wavelet_kernels as kernels, _wavelet_lines as lines
from casa_sara.operators._arguments import checked
from casa_sara.operators._coefficient_layout import (
    aligned,
    approximations,
    displacement,
    filter_lengths,
    filters,
    padded_shape,
    rectangle,
    shares,
)
from casa_sara.operators._wavelet_weights import RING_ROWS, neighbourhood_weights
from casa_sara.operators._workers import Workers
from casa_sara.options import SARA_BASES

__all__ = ["Band", "SaraDictionary", "coefficient_bytes", "filter_lengths"]

ORIENTATIONS = ("aa", "ad", "da", "dd")
TRANSFORM_NS = 0.5  # of a coefficient, a step of the transform on one thread


class Band(NamedTuple):
    """Where one band lies; `order` is that of a spectrum, 0 its mean.

    Of several images `part` are the coefficients of one, a slice of those of all, and their shape.
    """

    basis: int
    level: int
    orientation: str
    slice: tuple[Any, ...]
    order: int = 0
    part: tuple[Any, tuple[int, ...]] | None = None

    def of(self, coefs: np.ndarray) -> np.ndarray:
        """Return the 2-D array of this band, without a copy.

        Parameters
        ----------
        coefs : real, of the shape of coefficients
            The coefficients.

        Returns
        -------
        real, 2-D
        """
        return (coefs if self.part is None else coefs[self.part[0]].reshape(self.part[1]))[self.slice]


class SaraDictionary:
    """Ψ† (analysis), Ψ (synthesis) and the dual update of the ℓ1 prior, without allocation in a call.

    Parameters
    ----------
    shape : (int, int)
        Image size (nx, ny), any size ≥ 1.
    wavelets : sequence of str
        Bases: 'dirac' and 'db1' … 'db8', each at most once.
    levels : int
        Number of decomposition levels, 1 to 10.
    dtype : float32 or float64
        Of images and coefficients.
    nthreads : int
        Threads used by each call; results are the same, to the last bit, for any number.
    n_bases : int, optional
        Of the whole dictionary, where `wavelets` are a share of it, which may be empty: the gain is that of the whole.

    Attributes
    ----------
    coef_shape : (int, int, int)
        (number of bases, NX, NY): each basis in the usual nested quadrants of a plane padded to the next multiples of
        2**levels.  Dirac coefficients are the pixels, in the corner [:nx, :ny] of their plane.
    n_bases, n_coefs : int

    Raises
    ------
    ValueError
        For an argument out of these ranges; the message names the task parameter.

    Notes
    -----
    The workspaces belong to the object: one call at a time.  Different objects may be used from different threads.
    """

    def __init__(self, shape: tuple[int, int], wavelets: Sequence[str] = SARA_BASES, levels: int = 4,
                 dtype: npt.DTypeLike = np.float32, nthreads: int = 1, n_bases: int | None = None) -> None:
        self.shape = tuple(int(n) for n in shape)
        self.wavelets = tuple(wavelets)
        self.levels = int(levels)
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        self.n_bases = len(self.wavelets) if n_bases is None else int(n_bases)
        self._validate()
        padded = padded_shape(self.shape, self.levels)
        self.coef_shape = (len(self.wavelets), *padded)
        self.n_coefs = len(self.wavelets) * padded[0] * padded[1]
        self._filters = filters(self.wavelets, self.n_bases, self.dtype)
        self._workers = Workers(nthreads, TRANSFORM_NS * self.n_coefs)
        self._work = self._workspaces()
        self._params = np.zeros((len(self.wavelets), 2), self.dtype)
        self._ring = np.zeros((self._workers.count, RING_ROWS, padded[1]), self.dtype)
        self._rectangles = np.array([rectangle(band) for band in self.bands()], np.int64).reshape(-1, 5)

    def _validate(self):
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(f"imsize must be two sizes of at least 1 pixel, not {self.shape}")
        if not len(set(self.wavelets)) == len(self.wavelets) <= self.n_bases or not self.n_bases \
                or set(self.wavelets) - set(SARA_BASES):
            raise ValueError(f"wavelets={list(self.wavelets)} must be distinct names out of {list(SARA_BASES)}")
        if not 1 <= self.levels <= 10:
            raise ValueError(f"wavelevels={self.levels} must be between 1 and 10")
        if self.dtype not in (np.float32, np.float64):
            raise ValueError(f"dtype must be float32 or float64, not {self.dtype}")

    def _workspaces(self):
        nx, ny = self.coef_shape[1:]
        size, threads = self.dtype.itemsize, self._workers.count
        approx = approximations((nx, ny), self.levels, size)
        width = kernels.padded_width(ny + 2 * kernels.HALO, size)
        return kernels.Work(
            levels=self.levels, approx=aligned((len(self.wavelets), approx), self.dtype),
            owner=shares(self._filters.lengths, threads),
            window=aligned((threads, kernels.WINDOW_ROWS, width), self.dtype),
            scratch=aligned((threads, lines.SCRATCH_ROWS, width), self.dtype),
            tables=np.zeros((threads, 2, lines.TABLE_SIZE), np.int64))

    def allocate(self) -> np.ndarray:
        """Return a zeroed coefficient array of `coef_shape`, aligned as the kernels like it."""
        return aligned(self.coef_shape, self.dtype)

    def bands(self) -> list[Band]:
        """Return the list of all :class:`Band`, level 1 the finest.

        Orientations are PyWavelets' keys: 'da' is detail along the first axis, approximation along the second; 'aa' is
        the approximation of the deepest level.  Dirac is one band of level 0, orientation 'aa'.
        """
        found = []
        nx, ny = self.coef_shape[1:]
        for b, length in enumerate(self._filters.lengths):
            if not length:
                found.append(Band(b, 0, "aa", (b, slice(0, self.shape[0]), slice(0, self.shape[1]))))
                continue
            for level in range(1, self.levels + 1):
                mx, my = nx >> level, ny >> level
                for o, orientation in enumerate(ORIENTATIONS):
                    if o or level == self.levels:
                        i, j = divmod(o, 2)
                        where = (b, slice(i * mx, (i + 1) * mx), slice(j * my, (j + 1) * my))
                        found.append(Band(b, level, orientation, where))
        return found

    def analysis(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ† image, an array of `coef_shape`, in `out` where given.

        Parameters
        ----------
        image : real (nx, ny)
            The image x.
        out : real coef_shape, optional
            Receives the result.

        Returns
        -------
        real coef_shape
        """
        out = self.allocate() if out is None else self._checked(out, "out", self.coef_shape)
        self._analyse(image, self._job(out, lines.KEEP))
        return out

    def synthesis(self, coefs: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the image Ψ coefs, in `out` where given.

        Parameters
        ----------
        coefs : real coef_shape
            The coefficients.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        coefs = self._checked(coefs, "coefs", self.coef_shape)
        out = np.empty(self.shape, self.dtype) if out is None else self._checked(out, "out", self.shape)
        job = self._job(coefs, lines.KEEP)
        self._workers.run(kernels.transform, kernels.SYNTHESISE_DEEPER, out, job)
        self._workers.run(kernels.transform, kernels.SYNTHESISE_FINEST, out, job)
        return out

    def dual_step(self, model_bar: np.ndarray, dual: np.ndarray, threshold: float | np.ndarray,
                  weights: np.ndarray | None = None, out: np.ndarray | None = None,
                  relaxation: float = 1.0) -> np.ndarray:
        """Update the dual variable of the prior in place and return Ψ dual, in one sweep over the bases.

        With c = dual + Ψ† model_bar,

            dual ← dual + ρ(clip(c, ± threshold·weights) − dual),   clip(c, ± t) = c − soft(c, t),

        the proximal operator of the conjugate of threshold·‖weights · ‖₁ (Moreau), relaxed by ρ.

        Parameters
        ----------
        model_bar : (nx, ny)
            Extrapolated model image.
        dual : coef_shape
            Updated in place.
        threshold : float or (n_bases,)
            κ ≥ 0, one number or one per basis.
        weights : coef_shape, optional
            W ≥ 0; ones when None.
        out : (nx, ny), optional
            Receives Ψ dual.
        relaxation : float
            ρ.

        Returns
        -------
        real (nx, ny)
            Ψ dual.

        Raises
        ------
        ValueError
            An array of the wrong shape, type or order, or a negative threshold.
        """
        dual = self._checked(dual, "dual", self.coef_shape)
        out = np.empty(self.shape, self.dtype) if out is None else self._checked(out, "out", self.shape)
        if not np.min(threshold) >= 0:
            raise ValueError(f"threshold={threshold} must not be negative")
        self._params[:, 0], self._params[:, 1] = threshold, relaxation
        if weights is None:
            job = self._job(dual, lines.CLIP)
        else:
            job = self._job(dual, lines.CLIP_WEIGHTED, self._checked(weights, "weights", self.coef_shape))
        self._analyse(model_bar, job, back=True)
        self._workers.run(kernels.transform, kernels.SYNTHESISE_FINEST, out, job)
        return out

    def reweight(self, image: np.ndarray, alpha: float | np.ndarray, scale: float | np.ndarray,
                 out: np.ndarray) -> np.ndarray:
        """Fill `out`, an array of `coef_shape`, with the weights s·α/(α + d̄), d̄ what is around in Ψ† image.

        d̄ is the root mean square of a coefficient and its eight neighbours in the band (periodic).  `alpha` > 0 and
        `scale` s are one number per band, in the order of `bands`, or one for all.

        Parameters
        ----------
        image : real (nx, ny)
            The image whose coefficients set the weights.
        alpha, scale : float or float (number of bands,)
            α > 0, in the unit of the coefficients, and s.
        out : real coef_shape
            Receives the weights.

        Returns
        -------
        real coef_shape
        """
        out = self.analysis(image, self._checked(out, "out", self.coef_shape))
        params = np.empty((len(self._rectangles), 2), self.dtype)
        params[:, 0], params[:, 1] = alpha, scale
        if not np.all(params[:, 0] > 0):
            raise ValueError(f"alpha must be positive in every band, its minimum is {np.min(alpha)}")
        self._workers.run(neighbourhood_weights, out, self._rectangles, params, self._ring)
        return out

    def scale_at(self, coefs: np.ndarray, pixels: np.ndarray, factor: float) -> None:
        """Multiply the coefficients that describe some pixels, bool (nx, ny), and those beside them, in place.

        Parameters
        ----------
        coefs : real coef_shape
            Changed in place.
        pixels : bool (nx, ny)
            Pixels whose coefficients are meant.
        factor : float
            Factor on their weights.
        """
        coefs = self._checked(coefs, "coefs", self.coef_shape)
        plane = np.zeros(self.coef_shape[1:], bool)
        plane[:self.shape[0], :self.shape[1]] = pixels
        (nx, ny), blocks = plane.shape, {}
        for level in range(1, self.levels + 1):
            blocks[level] = plane.reshape(nx >> level, 1 << level, ny >> level, 1 << level).any(axis=(1, 3))
            blocks[level] = maximum_filter(blocks[level], 3, mode="wrap")
        for band in self.bands():
            where = pixels
            if band.level:
                by = displacement(self.wavelets[band.basis], band.level)
                where = np.roll(blocks[band.level], [by[kind] for kind in band.orientation], (0, 1))
            band.of(coefs)[where] *= self.dtype.type(factor)

    def _checked(self, array, name, shape):
        return checked(array, name, shape, self.dtype)

    def _job(self, coefs, mode, weights=None):
        target = kernels.Target(coefs, coefs if weights is None else weights, self._params, mode)
        return kernels.Job(self._filters, target, self._work)

    def _analyse(self, image, job, back=False):
        image = self._checked(np.ascontiguousarray(image, self.dtype), "image", self.shape)
        self._workers.run(kernels.transform, kernels.ANALYSE_FINEST, image, job)
        self._workers.run(kernels.transform, kernels.BOTH_DEEPER if back else kernels.ANALYSE_DEEPER, image, job)


def coefficient_bytes(shape: tuple[int, int], n_bases: int, levels: int,
                      dtype: npt.DTypeLike = np.float32) -> tuple[int, int]:
    """Memory of one array of coefficients, and of the workspace of a dictionary, in bytes.

    Parameters
    ----------
    shape : (int, int)
        Pixels of the image.
    n_bases, levels : int
        Numbers of bases, and of levels of the wavelets.
    dtype : float32 or float64
        Precision of the coefficients.

    Returns
    -------
    int, int
    """
    padded, size = padded_shape(shape, levels), np.dtype(dtype).itemsize
    return n_bases * padded[0] * padded[1] * size, n_bases * approximations(padded, levels, size) * size


