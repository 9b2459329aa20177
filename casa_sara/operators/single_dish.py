"""The measurement operator of a single dish: the sky convolved with its beam, at points half a beam apart.

    y_k = Σ_p B(θ_k − θ_p) I_p,      B = 1 at its centre,

in Jy/beam where I is in Jy/pixel.  B hardly passes spatial frequencies above 1/FWHM, so that few modes of the image say
all of it.  On a grid of modes of spacing 1/P, P as wide as image and beam together,

    y_k = 1/P² Σ_u B̂(u) Î(u) exp(−2πi u·θ_k),      Î(u) = Σ_p I_p exp(2πi u·θ_p),

with Î from the transform that visibilities have.  The points are a part of a grid, and the sum over u is two products
with small matrices.

A beam is sampled twice along its FWHM, where its own transform has fallen to 0.03.  Pixels of an image that are closer
have noise in common and would count what they measure more than once; the noise of points half a beam apart is nearly
independent, as that of the dish's samples is before they are gridded with a kernel narrower than the beam.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from casa_sara.operators._arguments import for_adjoint, for_forward
from casa_sara.operators.measurement import MeasurementOperator

__all__ = ["GaussianBeam", "ImagedBeam", "Points", "SingleDishOperator", "Stacked"]

STEP = 0.5  # of the FWHM, between points
FINEST = 2.0  # cycles within a FWHM, beyond which a Gaussian has passed 7e-7
FARTHEST = 2.5  # FWHM from its centre, beyond which a Gaussian is 3e-8


@dataclass(frozen=True)
class GaussianBeam:
    """An elliptical Gaussian, 1 at its centre.

    Attributes
    ----------
    major, minor : float
        FWHM in radians.
    angle : float
        Of the major axis, in radians from m (north) through l (east).
    """

    major: float
    minor: float
    angle: float = 0.0

    @property
    def width(self) -> float:
        """FWHM in radians of a circle of the same area."""
        return float(np.sqrt(self.major * self.minor))

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which the beam is 0, radians."""
        return FARTHEST * self.major

    @property
    def finest(self) -> float:
        """Spatial frequency that the beam does not pass any more, cycles per radian."""
        return FINEST / self.minor

    @property
    def solid_angle(self) -> float:
        """∫B in steradians."""
        return float(np.pi / (4 * np.log(2)) * self.major * self.minor)

    def transform(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return B̂(u) = ∫B exp(2πi(ul + vm)), real, in steradians.

        Parameters
        ----------
        u, v : real (K,)
            Cycles per radian along l and m.

        Returns
        -------
        real (K,)
        """
        along = u * np.sin(self.angle) + v * np.cos(self.angle)
        across = u * np.cos(self.angle) - v * np.sin(self.angle)
        square = (along * self.major) ** 2 + (across * self.minor) ** 2
        return self.solid_angle * np.exp(-(np.pi**2) / (4 * np.log(2)) * square)


@dataclass(frozen=True)
class ImagedBeam:
    """A beam as an image.

    Attributes
    ----------
    pixels : real (nx, ny)
        B, 1 at pixel (nx//2, ny//2), its centre.
    cell_rad : (float, float)
        Pixel size; x grows to the west, y to the north.
    angle : float
        Of its north, in radians from m through l.
    """

    pixels: np.ndarray
    cell_rad: tuple[float, float]
    angle: float = 0.0

    @property
    def width(self) -> float:
        """FWHM in radians of a circle as large as what is above a half."""
        area = np.count_nonzero(self.pixels > 0.5) * self.cell_rad[0] * self.cell_rad[1]
        return float(2 * np.sqrt(area / np.pi))

    @property
    def reach(self) -> float:
        """Distance from the centre beyond which the beam is 0, radians."""
        return float(max((n // 2 + 1) * cell for n, cell in zip(self.pixels.shape, self.cell_rad)))

    @property
    def finest(self) -> float:
        """Spatial frequency that the beam, or its image, does not pass any more, cycles per radian."""
        return min(FINEST / self.width, 0.35 / max(self.cell_rad))  # turned by any angle

    @property
    def solid_angle(self) -> float:
        """∫B in steradians."""
        return float(self.pixels.sum(dtype=float) * self.cell_rad[0] * self.cell_rad[1])

    def transform(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return B̂(u) = ∫B exp(2πi(ul + vm)), complex, in steradians.

        Parameters
        ----------
        u, v : real (K,)
            Cycles per radian along l and m.

        Returns
        -------
        complex (K,)
        """
        north, east = np.cos(self.angle), np.sin(self.angle)
        own = np.array([u * north - v * east, u * east + v * north])
        operator = MeasurementOperator(own, self.cell_rad, self.pixels.shape, eps=1e-9, dtype=np.float64)
        return operator.forward(self.pixels) * (self.cell_rad[0] * self.cell_rad[1])


@dataclass(frozen=True)
class Points:
    """Points of a grid: `east` (n,) and `north` (m,) are its lines, direction cosines, and `chosen` bool (n, m)."""

    east: np.ndarray
    north: np.ndarray
    chosen: np.ndarray

    @classmethod
    def within(cls, shape: tuple[int, int], cell_rad: tuple[float, float], width: float) -> Points:
        """Return all points, half a beam apart, of a grid around the centre of an image.

        Parameters
        ----------
        shape : (int, int)
            Pixels of the image.
        cell_rad : (float, float)
            Pixel size.
        width : float
            FWHM of the beam in radians.

        Returns
        -------
        Points
        """
        counts = [int(0.5 * (n - 1) * cell / (STEP * width)) for n, cell in zip(shape, cell_rad)]
        east, north = (STEP * width * np.arange(-count, count + 1) for count in counts)
        return cls(east, north, np.ones((east.size, north.size), bool))

    @property
    def size(self) -> int:
        """How many there are."""
        return int(np.count_nonzero(self.chosen))

    @property
    def places(self) -> np.ndarray:
        """Direction cosines l and m, float64 (2, N), in the order of the values."""
        i, j = np.nonzero(self.chosen)
        return np.array([self.east[i], self.north[j]])

    def pixels(self, shape: tuple[int, int], cell_rad: tuple[float, float]) -> np.ndarray:
        """Return their pixel coordinates in an image, float64 (2, N).

        Parameters
        ----------
        shape : (int, int)
            Pixels of the image.
        cell_rad : (float, float)
            Pixel size.

        Returns
        -------
        float64 (2, N)
        """
        east, north = self.places
        return np.array([shape[0] // 2 - east / cell_rad[0], shape[1] // 2 + north / cell_rad[1]])

    def only(self, kept: np.ndarray) -> Points:
        """Return some of them.

        Parameters
        ----------
        kept : bool (N,)
            Which ones.

        Returns
        -------
        Points
        """
        chosen = self.chosen.copy()
        chosen[self.chosen] = kept
        return Points(self.east, self.north, chosen)


class SingleDishOperator:
    """Φ of a single dish, and its adjoint, with the interface of an operator of visibilities.

    Its values are real; two that follow each other are the real and the imaginary part of one "visibility", so that
    they have the variance that real and imaginary parts have, and all sums over samples hold. Of an odd number the last
    has 0 for its partner.

    Parameters
    ----------
    points : Points
        Where the values are.
    beam : GaussianBeam or ImagedBeam
        B.
    shape : (int, int)
        Pixels of the image.
    cell_rad : (float, float)
        Pixel size.
    over : real (nx, ny), optional
        The sky is the image times this.
    scale : float
        On all values: the inverse of their noise, for whitening.
    dtype : float32 or float64
        Of images.
    nthreads : int or Workers
        Threads.
    """

    def __init__(self, points: Points, beam: GaussianBeam | ImagedBeam,  # noqa: PLR0913 - four have a default
                 shape: tuple[int, int], cell_rad: tuple[float, float], over: np.ndarray | None = None,
                 scale: float = 1.0, dtype: npt.DTypeLike = np.float32, nthreads: Any = 1) -> None:
        self.shape, self.size, self.dtype = tuple(shape), (points.size + 1) // 2, np.dtype(dtype)
        self.complex_dtype = np.result_type(self.dtype, np.complex64)
        self._points, self._places = points.size, np.flatnonzero(points.chosen)
        periods = [n * cell + beam.reach for n, cell in zip(shape, cell_rad)]
        u, v = (np.arange(-count, count + 1) / period
                for period, count in ((period, int(np.ceil(beam.finest * period))) for period in periods))
        v = v[v >= 0]  # the others are the conjugates of these
        modes = np.array([np.repeat(u, v.size), np.tile(v, u.size)])
        self._transform = MeasurementOperator(modes, cell_rad, shape, eps=1e-6, dtype=dtype, nthreads=nthreads)
        self.workers = self._transform.workers
        weight = scale / (periods[0] * periods[1]) * np.where(modes[1] > 0, 2, 1)
        self._passed = (weight * beam.transform(*modes)).reshape(u.size, v.size).astype(self.complex_dtype)
        self._east, self._north = (np.exp(-2j * np.pi * np.outer(*pair)).astype(self.complex_dtype)
                                   for pair in ((points.east, u), (v, points.north)))
        self._adjoints = [np.ascontiguousarray(array.conj().T) for array in (self._east, self._north)]
        self._passed_conj = self._passed.conj()
        self._modes = np.empty((u.size, v.size), self.complex_dtype)
        self._half, self._half_back = (np.empty(pair, self.complex_dtype)
                                       for pair in ((points.east.size, v.size), (u.size, points.north.size)))
        self._grid, self._values = (np.zeros(points.chosen.shape, dtype) for dtype in (self.complex_dtype, self.dtype))
        self._over = None if over is None else np.asarray(over, self.dtype)
        self._image = np.empty(self.shape if over is not None else (0, 0), self.dtype)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return what the dish measures of a real image.

        Parameters
        ----------
        image : real (nx, ny)
            The image.
        out : complex (M,), optional
            Receives the result.

        Returns
        -------
        complex (M,)
            Values of points 0, 2, 4 … as real parts, 1, 3, 5 … as imaginary parts.
        """
        image, out = for_forward(self, image, out)
        if self._over is not None:
            image = np.multiply(image, self._over, out=self._image)
        self._transform.forward(image, self._modes.reshape(-1))
        self._modes *= self._passed
        np.matmul(np.matmul(self._east, self._modes, out=self._half), self._north, out=self._grid)
        self._values[...] = self._grid.real
        values = out.view(self.dtype)
        values[self._points:] = 0
        self._values.take(self._places, out=values[:self._points], mode="clip")
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the adjoint, for real inner products.

        Parameters
        ----------
        vis : complex (M,)
            Values as of :meth:`forward`.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        vis, out = for_adjoint(self, vis, out)
        east, north = self._adjoints
        self._grid.fill(0)
        self._grid.reshape(-1)[self._places] = vis.view(self.dtype)[:self._points]
        np.matmul(np.matmul(east, self._grid, out=self._half_back), north, out=self._modes)
        self._modes *= self._passed_conj
        self._transform.adjoint(self._modes.reshape(-1), out)
        if self._over is not None:
            out *= self._over
        return out


class Stacked:
    """Two operators of one image, the values of the second after those of the first.

    Parameters
    ----------
    first, second : object
        Operators, as of :class:`casa_sara.operators.measurement.MeasurementOperator`.
    """

    def __init__(self, first: Any, second: Any) -> None:
        self._first, self._second = first, second
        self.shape, self.size, self.dtype = first.shape, first.size + second.size, first.dtype
        self.complex_dtype, self.workers = first.complex_dtype, first.workers
        self._image = np.empty(self.shape, self.dtype)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return what both make of a real image.

        Parameters
        ----------
        image : real (nx, ny)
            The image.
        out : complex (M,), optional
            Receives the result.

        Returns
        -------
        complex (M,)
        """
        image, out = for_forward(self, image, out)
        self._first.forward(image, out[:self._first.size])
        self._second.forward(image, out[self._first.size:])
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the sum of both adjoints.

        Parameters
        ----------
        vis : complex (M,)
            Values of both.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        vis, out = for_adjoint(self, vis, out)
        self._first.adjoint(vis[:self._first.size], out)
        out += self._second.adjoint(vis[self._first.size:], self._image)
        return out
