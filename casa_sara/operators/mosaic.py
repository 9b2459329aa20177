"""The measurement operator of a mosaic: one sky, seen by many pointings, each through its primary beam.

    V_m = Σ A_g I exp(2πi [u l + v m + w (n − 1)]),      n = √(1 − l² − m²),

where g is the beam of sample m: that of its pointing, of the dishes at both ends of its baseline (A is the
product of their voltage patterns), and of its frequency.  Each beam is zero beyond a radius, so that its samples are
those of a part of the image around its centre.  With (l0, m0, n0) the middle of that part, to first order in the
distance from it,

    u l + v m + w (n − 1) = [u l0 + v m0 + w (n0 − 1)] + (u − w l0/n0)(l − l0) + (v − w m0/n0)(m − m0):

a factor on each sample, and a plain transform of a small image with baselines as the pointing sees them.  What is
left of the w-term is −w (δl² + δm²)/2, as much as in an image of that pointing alone.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from casa_sara.operators._arguments import for_adjoint, for_forward
from casa_sara.operators._workers import Workers
from casa_sara.operators.beams import Mosaic, around, beam_at
from casa_sara.operators.measurement import MeasurementOperator, share_work_space
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.runtime import jit

__all__ = ["MosaicOperator", "remaining_w_phase"]

REACH_STEPS = 4  # values of the largest baseline, in a factor of 2, that plans are made for


class MosaicOperator:
    """Φ of a mosaic and its adjoint; nothing is allocated by calls with `out`.

    As of :class:`casa_sara.operators.measurement.MeasurementOperator`, one operator serves one thread at a time. The
    plans of all pointings share their work space.

    Parameters
    ----------
    uvw : float64 (3, M)
        Baselines in wavelengths, with their axes along those of the image.
    beam_of_sample : int (M,)
        Number of the beam of each sample; each of them is in the image.
    mosaic : Mosaic
        The beams.
    row_scale, eps, dtype, nthreads
        As of `MeasurementOperator`.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the visibilities are spread: the plans are those of all, which may be none here.
    """

    def __init__(self, uvw: np.ndarray, beam_of_sample: np.ndarray, mosaic: Mosaic,  # noqa: PLR0913 - five defaults
                 row_scale: np.ndarray | None = None,
                 eps: float = 1e-6, dtype: npt.DTypeLike = np.float32, nthreads: int = 1,
                 comm: Serial = SERIAL) -> None:
        self.shape, self.size, self.dtype = tuple(mosaic.shape), uvw.shape[1], np.dtype(dtype)
        self.complex_dtype, self.workers = np.result_type(self.dtype, np.complex64), Workers(nthreads)
        if np.shape(beam_of_sample) != (self.size,):
            raise ValueError(f"beam_of_sample must have shape ({self.size},), not {np.shape(beam_of_sample)}")
        row_scale = np.broadcast_to(1.0, self.size) if row_scale is None else row_scale
        order = np.argsort(beam_of_sample, kind="stable")
        ends = np.cumsum(np.bincount(beam_of_sample, minlength=len(mosaic.beams)))
        members = [order[start:end] for start, end in zip([0, *ends[:-1]], ends)]
        whole = _whole(mosaic, uvw, members, comm)
        self._parts = [
            _Part(mosaic, number, uvw, samples, row_scale, eps, self.dtype, self.workers, whole[number])
            for number, samples in enumerate(members) if samples.size]
        share_work_space([part.operator for part in self._parts])
        self._over = None if mosaic.over is None else mosaic.over.astype(self.dtype, copy=False)
        self._image = np.empty(self.shape if self._over is not None else (0, 0), self.dtype)
        self._pixels = np.empty(max((part.pixels for part in self._parts), default=0), self.dtype)
        self._vis = np.empty(max((part.index.size for part in self._parts), default=0), self.complex_dtype)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the visibilities of a real image.

        Parameters
        ----------
        image : real (nx, ny)
            The sky, or the sky times the sensitivity where the mosaic is of flat noise.
        out : complex (M,), optional
            Where the result goes.

        Returns
        -------
        complex (M,)
        """
        image, out = for_forward(self, image, out)
        if self._over is not None:
            image = np.multiply(image, self._over, out=self._image)
        for part in self._parts:
            pixels, vis = part.space(self._pixels, self._vis)
            self.workers.run(_attenuate, image[part.box], part.corner, part.scales, part.profile, pixels)
            part.operator.forward(pixels, vis)
            self.workers.run(_put_turned, vis, part.rotation, part.index, out)
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the adjoint, for real inner products, of visibilities.

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : real (nx, ny), optional
            Where the result goes.

        Returns
        -------
        real (nx, ny)
        """
        vis, out = for_adjoint(self, vis, out)
        out.fill(0)
        for part in self._parts:
            pixels, own = part.space(self._pixels, self._vis)
            self.workers.run(_take_turned, vis, part.rotation, part.index, own)
            part.operator.adjoint(own, pixels)
            self.workers.run(_add_attenuated, pixels, part.corner, part.scales, part.profile, out[part.box])
        if self._over is not None:
            out *= self._over
        return out


class _Part:
    """The samples of one beam, `index` int32 (m,), and the transform of that part of the image."""

    def __init__(self, mosaic, number, uvw, samples, row_scale, eps, dtype, workers, whole):  # noqa: PLR0913 - one caller
        beam, cell = mosaic.beams[number], mosaic.cell_rad
        self.box = beam.box(mosaic.shape, cell)
        self.shape = tuple(axis.stop - axis.start for axis in self.box)
        self.pixels = self.shape[0] * self.shape[1]
        if not self.pixels:
            raise ValueError(f"beam {number}, around pixel {beam.centre}, is outside the image of {mosaic.shape}")
        self.corner = tuple(axis.start for axis in self.box)
        self.scales, self.profile = beam.scales(cell), beam.profile.astype(dtype, copy=False)
        self.index = samples.astype(np.int32)
        uv, rotation = around(uvw[:, samples], mosaic.middle(number))
        self.rotation = rotation.astype(np.result_type(dtype, np.complex64))
        self.operator = MeasurementOperator(uv, cell, self.shape, np.asarray(row_scale)[samples], eps, dtype, workers,
                                            (int(whole[0]), _reach(whole[1:] * cell) / cell))

    def space(self, pixels, vis):
        """Return as much as this part needs of the space that all share."""
        return pixels[: self.pixels].reshape(self.shape), vis[: self.index.size]


def _whole(mosaic, uvw, members, comm):
    """Return how many visibilities each beam has, and their largest |u| and |v|, of all ranks; float64 (beams, 3)."""
    here = np.zeros((len(members), 3))
    for number, samples in enumerate(members):
        uv, _ = around(uvw[:, samples], mosaic.middle(number))
        here[number] = [samples.size, *np.abs(uv).max(axis=1, initial=0)]
    everywhere = np.array(comm.allgather(here))
    return np.column_stack([everywhere[:, :, 0].sum(axis=0), everywhere[:, :, 1:].max(axis=0)])


def _reach(cycles):
    """Largest |u| and |v| to plan for, in cycles per pixel: up to the next of few values, so that plans are alike."""
    steps = np.ceil(REACH_STEPS * np.log2(np.maximum(cycles, 1e-6)))
    return np.maximum(np.minimum(2 ** (steps / REACH_STEPS), 0.5), cycles)


def remaining_w_phase(max_w: float, mosaic: Mosaic) -> float:
    """Return the largest phase in rad that a mosaic leaves of the w-term: π|w|r² at the edge of the widest beam.

    Parameters
    ----------
    max_w : float
        Largest |w| in wavelengths.
    mosaic : Mosaic
        The beams.

    Returns
    -------
    float
    """
    return np.pi * max_w * max(beam.radius_rad for beam in mosaic.beams) ** 2


_jit = jit.kernel()


@_jit
def _attenuate(image, corner, scales, profile, out, worker, workers):
    """out = A·image, in the part of an image that begins at a corner."""
    x, y, per_x, per_y = scales
    for i in range(len(out) * worker // workers, len(out) * (worker + 1) // workers):
        across = (corner[0] + i - x) ** 2 * per_x
        for j in range(out.shape[1]):
            out[i, j] = beam_at(profile, across + (corner[1] + j - y) ** 2 * per_y) * image[i, j]


@_jit
def _add_attenuated(image, corner, scales, profile, out, worker, workers):
    """Add A·image to that part of an image: the transpose of `_attenuate`."""
    x, y, per_x, per_y = scales
    for i in range(len(out) * worker // workers, len(out) * (worker + 1) // workers):
        across = (corner[0] + i - x) ** 2 * per_x
        for j in range(out.shape[1]):
            out[i, j] += beam_at(profile, across + (corner[1] + j - y) ** 2 * per_y) * image[i, j]


@_jit
def _put_turned(vis, rotation, index, out, worker, workers):
    """out[index] = rotation·vis."""
    for k in range(vis.size * worker // workers, vis.size * (worker + 1) // workers):
        out[index[k]] = rotation[k] * vis[k]


@_jit
def _take_turned(vis, rotation, index, out, worker, workers):
    """out = conj(rotation)·vis[index]."""
    for k in range(out.size * worker // workers, out.size * (worker + 1) // workers):
        out[k] = np.conj(rotation[k]) * vis[index[k]]
