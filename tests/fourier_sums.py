"""Φ as explicit Fourier sums, skies on its pixels and between them, and whole solutions of what it sees."""

import numpy as np
from test_visibilities import observation

from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import GivenBounds

CELL = 1e-6
BEAM = 3.5  # FWHM in pixels of what samples of this spread see
SPREAD = 2 * np.log(2) / (np.pi * np.sqrt(2 * np.log(2)) * BEAM)  # standard deviation of uv, cycles per pixel
NOISE = 0.003  # Jy/beam, of the whole


class Sums:
    """Φ as explicit Fourier sums, with the inverse variances of samples.

    A source is (flux, x, y, FWHM), anywhere between pixels.
    """

    def __init__(self, shape, size=1200, seed=41, shortest=0.0, within_a_site=0):
        rng = np.random.default_rng(seed)
        self.shape, self.size = shape, size
        u, v = np.clip(rng.normal(0, SPREAD, (2, 4 * size if shortest else size)), -0.45, 0.45)  # cycles per pixel
        long = np.flatnonzero(np.hypot(u, v) >= shortest)[:size]
        self.u, self.v = u[long], v[long]
        self.u[:within_a_site], self.v[:within_a_site] = 0, 1e-6
        self.weight = rng.uniform(0.5, 1.5, size) / NOISE**2 / size
        self._rows = np.exp(-2j * np.pi * np.outer(self.u, np.arange(shape[0]) - shape[0] // 2))
        self._columns = np.exp(2j * np.pi * np.outer(self.v, np.arange(shape[1]) - shape[1] // 2))

    def forward(self, image):
        return ((self._rows @ image) * self._columns).sum(axis=1)

    def gradient(self, vis):
        """Φ†Σ⁻¹ of visibilities."""
        return (self._rows.conj().T @ ((self.weight * vis)[:, None] * self._columns.conj())).real

    def hessian(self, image):
        return self.gradient(self.forward(image))

    @property
    def psf(self):
        return self.hessian(pixel(self.shape, *(n // 2 for n in self.shape)))

    def strength(self, image):
        """‖Σ^{−½}Φx‖."""
        return np.sqrt(self.weight @ np.abs(self.forward(image)) ** 2)

    def of(self, *sources):
        """Visibilities of sources."""
        vis = np.zeros(self.size, complex)
        for flux, x, y, fwhm in sources:
            phase = -self.u * (x - self.shape[0] // 2) + self.v * (y - self.shape[1] // 2)
            decay = np.exp(-((np.pi * fwhm) ** 2) * (self.u**2 + self.v**2) / (4 * np.log(2)))
            vis += flux * decay * np.exp(2j * np.pi * phase)
        return vis

    def noise(self, seed):
        rng = np.random.default_rng(1000 + seed)
        return (rng.standard_normal(self.size) + 1j * rng.standard_normal(self.size)) / np.sqrt(self.weight)


def pixel(shape, x, y, value=1.0):
    image = np.zeros(shape)
    image[x, y] = value
    return image


def gaussian(shape, x, y, fwhm):
    """A sampled Gaussian, whose sum over an infinite grid is 1; a pixel where the width is 0."""
    if not fwhm:
        return pixel(shape, x, y)
    i, j = np.ogrid[:shape[0], :shape[1]]
    return np.exp(-4 * np.log(2) * ((i - x) ** 2 + (j - y) ** 2) / fwhm**2) * 4 * np.log(2) / (np.pi * fwhm**2)


def distance(shape, x, y):
    return np.hypot(*np.ogrid[-x:shape[0] - x, -y:shape[1] - y])


OPTIONS = dict(wavelets=("dirac", "db1", "db2", "db4"), wavelevels=3)


def image(sources=(), shape=(48, 48), seed=2, support=None, stop_at=None, checkpoint=None, louder=1.0, **changes):
    """Solve for the image of sources, whose positions count from the middle, and noise."""
    sums = Sums(shape)
    data = observation([(0, 0, 0, 0, 60), (0, 0, 1, 1e4, 60)])
    data, offsets = sort_into_blocks(data, data.rows.scan[data.row])
    data.uvw[:] = sums.u / CELL, sums.v / CELL, 0 * sums.u
    data.weight[:] = sums.weight
    data.vis[:] = sums.of(*((flux, shape[0] // 2 + x, shape[1] // 2 + y, fwhm) for flux, x, y, fwhm in sources))
    data.vis += louder * sums.noise(seed)
    reached, grid = [0], ImageGrid(shape, (CELL, CELL))
    samples = Samples(data, offsets, np.ones(data.size), np.ones(2))
    return reconstruct(samples, grid, SolverOptions(**OPTIONS | changes), support=support, control=Control(
        lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))


POINT = (20 * NOISE, 6.0, -4.0, 0)


def problem(shape=(48, 40), wavelets=("dirac", "db1", "db4"), levels=2, noise=(1.0, 1.0)):
    """The iteration in double precision, its bounds, and the sums that it stands for, noise levels included."""
    sums, offsets = Sums(shape), np.array([0, 500, 1200])
    whiten = np.sqrt(sums.weight)
    measurement = MeasurementOperator(np.array([sums.u, sums.v]) / CELL, CELL, shape, whiten, 1e-10, np.float64)
    dictionary = SaraDictionary(shape, wavelets, levels, np.float64)
    ppd = AdaptivePPD(measurement, dictionary, np.zeros(1200, complex), offsets, np.ones(1200), 1.0)
    ppd.threshold = 1.0
    samples = np.diff(offsets)
    sums.whiten = whiten
    weight_sums = np.add.reduceat(sums.weight, offsets[:-1])
    bounds = GivenBounds(np.array(noise) * np.sqrt(2.0 * samples), samples, weight_sums, len(wavelets))
    sums.weight = sums.weight / np.repeat(noise, samples) ** 2
    return sums, ppd, bounds
