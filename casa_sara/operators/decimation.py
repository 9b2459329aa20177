"""Fewer samples of a band-limited image: low-pass, then keep every D-th pixel.

Visibilities within |u| ≤ a (cycles per pixel) need z[i] = Σ_p h(p − D·i) x[p] only, D ≤ 0.42/a:

    Σ_i z[i] exp(2πi u D i) = Σ_k ĥ(u + k/D) x̂(u + k/D) / D ≈ x̂(u) · ĥ(u)/D ,

and division by ĥ(u)/D at each visibility is exact but for the aliases k ≠ 0, where the
taps h make ĥ small.  A band centred elsewhere, [0, 2a] for the half-plane that
a real image needs, is served by taps modulated to its centre.  The image is zero outside
its borders; z extends over them by the length of the taps.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit

from casa_sara.operators import kaiser_bessel

__all__ = ["AxisDecimation", "Separable", "decimate", "expand", "expand_rows"]

FULLEST_BAND = 0.42
LARGEST_FACTOR = 8


@dataclass
class AxisDecimation:
    """Low-pass and decimation along one image axis; pixel ix is at p = ix − size//2.

    Parameters
    ----------
    size : int
        Pixels along the axis.
    band : (float, float)
        Frequencies to keep, cycles per pixel.
    eps : float
        Largest ratio of aliases to signal.
    precision : float
        Of the arithmetic; its round-off is amplified where ĥ is small, so that it limits ĥ.

    Attributes
    ----------
    factor : int
        D, 1 when the band is too full to decimate.
    taps : complex (W,)
        h(t)·exp(2πi·centre·t), t = −W//2 … W//2.
    start, count : int
        z has samples i = start … start + count − 1.
    """

    size: int
    band: tuple[float, float]
    eps: float
    precision: float
    factor: int = field(init=False)
    taps: np.ndarray = field(init=False)

    def __post_init__(self):
        reach = (self.band[1] - self.band[0]) / 2
        self.factor = int(max(1, min(LARGEST_FACTOR, FULLEST_BAND / max(reach, 1e-9))))
        largest_gain = np.clip(np.sqrt(self.eps / (8 * self.precision)), 1.5, 10)
        self._lowpass = _lowpass(reach, self.factor, self.eps, largest_gain) if self.factor > 1 else np.ones(1)
        half = self._lowpass.size // 2
        self.taps = self._lowpass * np.exp(2j * np.pi * self.centre * np.arange(-half, half + 1))
        self.start = -((self.size // 2 + half) // self.factor)
        self.count = (self.size - 1 - self.size // 2 + half) // self.factor - self.start + 1

    @property
    def centre(self):
        """Middle of the band, cycles per pixel."""
        return (self.band[0] + self.band[1]) / 2

    def response(self, frequency):
        """ĥ(frequency − centre)/D, the factor on the spectrum."""
        return _spectrum(self._lowpass, np.asarray(frequency) - self.centre) / self.factor

    def modulation(self, samples):
        """exp(2πi·centre·D·i) at the given samples i, which moves the band's centre to frequency 0."""
        return np.exp(2j * np.pi * self.centre * self.factor * samples)


def _spectrum(lowpass, frequency):
    half = lowpass.size // 2
    total = np.full(np.shape(frequency), lowpass[half])
    for t in range(1, half + 1):
        total += 2 * lowpass[half + t] * np.cos(2 * np.pi * t * frequency)
    return total


def _lowpass(reach, factor, eps, largest_gain):
    """Shortest taps for the band |u| ≤ reach, a sinc of cutoff c in a Kaiser–Bessel window.

    The aliases are below `eps`, and the gain 1/ĥ varies over the band by less than `largest_gain`.
    """
    band = np.linspace(-reach, reach, 33)
    orders = np.arange(1, factor) / factor
    for half in range(factor, 100 * factor):
        t = np.arange(-half, half + 1)
        for cutoff in np.linspace(0, 0.5 / factor, 13):
            beta = np.pi * t.size * (1 / factor - reach - cutoff)
            lowpass = np.sinc(2 * cutoff * t) * kaiser_bessel.kernel(t / (half + 0.5), beta)
            passed = _spectrum(lowpass, band)
            if passed.min() * largest_gain >= passed.max():
                aliases = _spectrum(lowpass, band[:, None] + orders)
                if np.all(np.sqrt(np.sum(aliases**2, axis=1)) <= eps * passed):
                    return lowpass
    raise ValueError(f"eps={eps} cannot be reached: use a larger one")


class Separable(NamedTuple):
    """One axis as the compiled kernels take it."""

    taps: np.ndarray  # real (2, W): real and imaginary parts
    factor: int
    first: int  # pixel under the first tap of the first sample, ≤ 0
    cells: np.ndarray  # int64 (count,), where each sample goes in the grid
    gains: np.ndarray  # complex (count,), what it is multiplied with


_jit = njit(nogil=True, cache=True, fastmath={"contract"})


@_jit
def decimate(image, rows, columns, grid, lines, scratch, worker, workers):
    """Write the samples of a real image (nx, ny) into a complex grid, times their gains.

    `lines` real (rows.cells.size, ny) receives the image decimated along its first axis only; the
    row taps are real.  `scratch` real (workers, factor + 2, columns.cells.size + taps) is overwritten.
    """
    nx, ny = image.shape
    phases, real, imag = scratch[worker, :-2], scratch[worker, -2], scratch[worker, -1]
    for i in range(rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers):
        line, top = lines[i], rows.first + rows.factor * i
        line[:] = 0
        for t in range(max(0, -top), min(rows.taps.shape[1], nx - top)):
            tap, pixels = rows.taps[0, t], image[top + t]
            for j in range(ny):
                line[j] += tap * pixels[j]
        phases[:] = 0
        for pixel in range(ny):
            phases[(pixel - columns.first) % columns.factor, (pixel - columns.first) // columns.factor] = line[pixel]
        real[:] = 0
        imag[:] = 0
        for t in range(columns.taps.shape[1]):
            shifted = phases[t % columns.factor, t // columns.factor :]
            for j in range(columns.cells.size):
                real[j] += columns.taps[0, t] * shifted[j]
                imag[j] += columns.taps[1, t] * shifted[j]
        for j in range(columns.cells.size):
            grid[rows.cells[i], columns.cells[j]] = complex(real[j], imag[j]) * rows.gains[i] * columns.gains[j]


@_jit
def expand(grid, rows, columns, lines, scratch, worker, workers):
    """Transpose of the second half of `decimate`: samples in the grid to `lines`, Re of the conjugate."""
    phases, real, imag = scratch[worker, :-2], scratch[worker, -2], scratch[worker, -1]
    for i in range(rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers):
        for j in range(columns.cells.size):
            value = grid[rows.cells[i], columns.cells[j]] * np.conj(rows.gains[i] * columns.gains[j])
            real[j], imag[j] = value.real, value.imag
        phases[:] = 0
        for t in range(columns.taps.shape[1]):
            shifted = phases[t % columns.factor, t // columns.factor :]
            for j in range(columns.cells.size):
                shifted[j] += columns.taps[0, t] * real[j] + columns.taps[1, t] * imag[j]
        for pixel in range(lines.shape[1]):
            lines[i, pixel] = phases[(pixel - columns.first) % columns.factor, (pixel - columns.first) // columns.factor]


@_jit
def expand_rows(lines, rows, image, worker, workers):
    """Transpose of the first half of `decimate`: lines to a real image (nx, ny)."""
    nx, ny = image.shape
    for pixel in range(nx * worker // workers, nx * (worker + 1) // workers):
        offset, pixels = pixel - rows.first, image[pixel]
        pixels[:] = 0
        low = max(0, -((rows.taps.shape[1] - 1 - offset) // rows.factor))
        for i in range(low, min(rows.cells.size, offset // rows.factor + 1)):
            tap, line = rows.taps[0, offset - rows.factor * i], lines[i]
            for j in range(ny):
                pixels[j] += tap * line[j]
