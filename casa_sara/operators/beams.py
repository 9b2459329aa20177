"""The primary beams of a mosaic, the sensitivity that they make, and what samples of different beams have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from casa_sara.operators._workers import Workers
from casa_sara.parallel.numbering import numbered
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.runtime import jit

__all__ = ["Beam", "Mosaic", "around", "beam_at", "mosaic_density"]

LEAST = 0.1  # of the largest sensitivity, that of the mosaic where it ends
COARSE = 128  # pixels along an image in which the overlap of beams is summed


@dataclass(frozen=True)
class Beam:
    """A primary beam A: circular, of one pointing, one pair of dishes, and one frequency.

    Attributes
    ----------
    centre : (float, float)
        Pixel of the pointing, which may be outside the image.
    radius_rad : float
        Where A ends, in direction cosines.
    profile : float32 (K,)
        A at the squares k·radius_rad²/(K − 1) of the distance from the centre, k = 0 … K − 1; linear between them.
    """

    centre: tuple[float, float]
    radius_rad: float
    profile: np.ndarray

    def box(self, shape: tuple[int, int], cell_rad: Sequence[float]) -> tuple[slice, slice]:
        """Return the slices of an image in which this beam is; empty ones where it is not in the image.

        Parameters
        ----------
        shape : (int, int)
            Pixels of the image.
        cell_rad : (float, float)
            Pixel size.

        Returns
        -------
        (slice, slice)
        """
        reach = [self.radius_rad / cell for cell in cell_rad]
        edges = [(max(0, int(np.ceil(c - r))), min(n, int(np.floor(c + r)) + 1))
                 for c, r, n in zip(self.centre, reach, shape)]
        return tuple(slice(low, max(low, high)) for low, high in edges)  # type: ignore[return-value]

    def scales(self, cell_rad: Sequence[float]) -> np.ndarray:
        """Return (x, y, p, q), float64: pixel (i, j) has the place (i − x)²p + (j − y)²q in the profile.

        Parameters
        ----------
        cell_rad : (float, float)
            Pixel size.

        Returns
        -------
        float64 (4,)
        """
        per_sq = (self.profile.size - 1) / self.radius_rad**2
        return np.array([*self.centre, *(per_sq * cell**2 for cell in cell_rad)])

    def at(self, x: np.ndarray, y: np.ndarray, cell_rad: Sequence[float]) -> np.ndarray:
        """Return A at pixels, real.

        Parameters
        ----------
        x, y : real
            Pixels, of shapes that broadcast.
        cell_rad : (float, float)
            Pixel size.

        Returns
        -------
        real
        """
        centre_x, centre_y, per_x, per_y = self.scales(cell_rad)
        place = (x - centre_x) ** 2 * per_x + (y - centre_y) ** 2 * per_y
        return np.interp(place, np.arange(self.profile.size), self.profile, right=0.0)


@dataclass(frozen=True)
class Mosaic:
    """The primary beams of the pointings in an image.

    Attributes
    ----------
    shape : (int, int)
        Pixels of the image.
    cell_rad : (float, float)
    beams : tuple of Beam
    over : float32 (nx, ny), optional
        The sky is the image times this (:meth:`flat`); without it, the image is the sky.
    profiles : object, optional
        What the beams of more samples of the same data are made of.
    """

    shape: tuple[int, int]
    cell_rad: tuple[float, float]
    beams: tuple[Beam, ...]
    over: np.ndarray | None = None
    profiles: Any = None

    def middle(self, number: int) -> tuple[float, float, float]:
        """Return the direction cosines (l, m, n) of the middle of the part of the image that a beam takes.

        Parameters
        ----------
        number : int
            Of the beam.

        Returns
        -------
        (float, float, float)
        """
        box = self.beams[number].box(self.shape, self.cell_rad)
        l, m = ((axis.start + (axis.stop - axis.start) // 2 - n // 2) * step
                for axis, n, step in zip(box, self.shape, (-self.cell_rad[0], self.cell_rad[1])))
        return l, m, float(np.sqrt(1 - l**2 - m**2))

    def sums(self, beam_of_sample: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the summed weight of the samples of each beam, float64 (number of beams,).

        Parameters
        ----------
        beam_of_sample : int (M,)
            Number of the beam of each sample.
        weight : real (M,)
            Of each sample.

        Returns
        -------
        float64 (number of beams,)
        """
        return np.bincount(beam_of_sample, weight, len(self.beams)).astype(float)  # of no samples they are whole

    def power(self, weights: npt.ArrayLike) -> np.ndarray:
        """Return Σ_g W_g A_g²: the weight of the data at each place of the sky.

        Parameters
        ----------
        weights : real (number of beams,)
            W, of :meth:`sums`.

        Returns
        -------
        float32 (nx, ny)
        """
        total, workers = np.zeros(self.shape, np.float32), Workers(1)
        for beam, weight in zip(self.beams, np.asarray(weights, float)):
            if weight > 0:
                rows, columns = beam.box(self.shape, self.cell_rad)
                workers.run(_add_power, total[rows, columns], (rows.start, columns.start), beam.scales(self.cell_rad),
                            beam.profile, weight)
        return total

    def sensitivity(self, weights: npt.ArrayLike) -> np.ndarray:
        """Return S = √(Σ_g W_g A_g²/Σ_g W_g): the noise of the sky is as 1/S.

        Where S is below `LEAST` of its maximum it is set to 0: what is there is not modelled.

        Parameters
        ----------
        weights : real (number of beams,)
            W, of :meth:`sums`.

        Returns
        -------
        float32 (nx, ny)
        """
        found = np.sqrt(self.power(weights) / np.float32(np.sum(weights)))
        found[found < LEAST * found.max()] = 0
        return found

    def flat(self, sensitivity: np.ndarray) -> Mosaic:
        """Return the same mosaic for images of sky × sensitivity, whose noise is the same everywhere.

        Parameters
        ----------
        sensitivity : real (nx, ny)
            S; where it is 0, the image has no visibilities.

        Returns
        -------
        Mosaic
        """
        over = np.zeros(self.shape, np.float32)
        np.divide(1, sensitivity, out=over, where=sensitivity > 0, casting="same_kind")
        return replace(self, over=over)


def around(uvw: np.ndarray, middle: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return baselines around a place of the image, and the phase of that place: see `operators/mosaic.py`.

    Parameters
    ----------
    uvw : float64 (3, M)
        Wavelengths.
    middle : (float, float, float)
        Direction cosines (l0, m0, n0).

    Returns
    -------
    uv : float64 (2, M)
        (u − w l0/n0, v − w m0/n0).
    turn : complex128 (M,)
        exp(2πi [u l0 + v m0 + w (n0 − 1)]).
    """
    (u, v, w), (l, m, n) = uvw, middle
    cycles = u * l + v * m + w * (n - 1)
    return np.array([u - w * (l / n), v - w * (m / n)]), np.exp(2j * np.pi * (cycles - np.rint(cycles)))


def mosaic_density(uvw: np.ndarray, beam_of_sample: np.ndarray, weight: np.ndarray, mosaic: Mosaic,
                   comm: Serial = SERIAL) -> np.ndarray:
    """Return the sampling density of each sample of a mosaic, float32 (M,), in the unit of `weight`.

    It is the sum of the weights in the sample's uv cell, those of each beam times its overlap with that of the sample,

        Σ_h O_gh D_h(u, v),      O_gh = mean of A_g A_h/S²,      S² = Σ_h W_h A_h²/Σ_h W_h,

    with D_h the summed weight of the samples of beam h in the cell, and W_h of all of them: what the samples have in
    common, as rows of Φ, when the image is sky × S.  The cells are of side 1/(widest part of the image of a beam).

    Parameters
    ----------
    uvw : float64 (3, M)
        Wavelengths.
    beam_of_sample : int (M,)
        Number of the beam of each sample.
    weight : real (M,)
        Of each sample.
    mosaic : Mosaic
        The beams.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    float32 (M,)
    """
    count = len(mosaic.beams)
    weights = comm.allreduce(mosaic.sums(beam_of_sample, weight))
    step = max(1, max(mosaic.shape) // COARSE)
    x, y = np.arange(0, mosaic.shape[0], step)[:, None], np.arange(0, mosaic.shape[1], step)[None, :]
    gains = np.array([beam.at(x, y, mosaic.cell_rad).ravel().astype(np.float32) for beam in mosaic.beams])
    sensitivity_sq = weights @ gains**2 / weights.sum()
    gains = gains[:, sensitivity_sq > 0] / np.sqrt(sensitivity_sq[sensitivity_sq > 0])
    overlap = gains @ gains.T / gains.shape[1]
    # the cells of the Fourier plane, each with its conjugate
    boxes = [beam.box(mosaic.shape, mosaic.cell_rad) for beam in mosaic.beams]
    sides = [max(box[axis].stop - box[axis].start for box in boxes) for axis in (0, 1)]
    cells = [np.rint(side * cell * axis).astype(np.int64) for side, cell, axis in zip(sides, mosaic.cell_rad, uvw)]
    other = (cells[0] < 0) | ((cells[0] == 0) & (cells[1] < 0))
    row, column = (np.where(other, -cell, cell) for cell in cells)
    column += comm.largest(-int(column.min(initial=0)))
    place = row * (comm.largest(int(column.max(initial=0))) + 1) + column
    everywhere, place = numbered(place, comm)
    density = np.zeros(uvw.shape[1])
    order = np.argsort(beam_of_sample, kind="stable")
    ends = np.cumsum(np.bincount(beam_of_sample, minlength=count))
    members = [order[start:end] for start, end in zip([0, *ends[:-1]], ends)]
    for h, samples in enumerate(members):
        if weights[h]:
            summed = comm.allreduce(np.bincount(place[samples], weight[samples], everywhere.size).astype(float))
            for g in np.flatnonzero(overlap[h] > 0):
                density[members[g]] += overlap[h, g] * summed[place[members[g]]]
    return np.maximum(density, weight).astype(np.float32)


_jit = jit.kernel()
_jit_inner = jit.inner()


@_jit_inner
def beam_at(profile, place):
    """A at a place in a profile, 0 beyond its end.

    Parameters
    ----------
    profile : real (K,)
        As of :class:`Beam`.
    place : float
        In steps of the profile.
    """
    if place >= profile.size - 1:
        return profile[0] * 0
    k = int(place)
    return profile[k] + profile.dtype.type(place - k) * (profile[k + 1] - profile[k])


@_jit
def _add_power(out, corner, scales, profile, weight, worker, workers):
    """Add weight·A² to that part of an image."""
    x, y, per_x, per_y = scales
    for i in range(len(out) * worker // workers, len(out) * (worker + 1) // workers):
        across = (corner[0] + i - x) ** 2 * per_x
        for j in range(out.shape[1]):
            gain = beam_at(profile, across + (corner[1] + j - y) ** 2 * per_y)
            out[i, j] += weight * gain * gain
