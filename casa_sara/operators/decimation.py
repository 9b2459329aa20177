"""Fewer samples of a band-limited image: low-pass, then keep every D-th pixel.

Visibilities within |u| ≤ a (cycles per pixel) need z[i] = Σ_p h(p − D·i) x[p] only, D ≤ 0.42/a:

    Σ_i z[i] exp(2πi u D i) = Σ_k ĥ(u + k/D) x̂(u + k/D) / D ≈ x̂(u) · ĥ(u)/D ,

and division by ĥ(u)/D at each visibility is exact but for the aliases k ≠ 0, where the
taps h make ĥ small.  A band centred elsewhere, [0, 2a] for the half-plane that
a real image needs, is served by taps modulated to its centre.  The image is zero outside
its borders; z extends over them by the length of the taps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from casa_sara.operators import kaiser_bessel
from casa_sara.operators._gridding_vectors import load, multiply_add, store

__all__ = ["AxisDecimation", "Separable", "decimate", "expand", "expand_rows", "scratch_shape"]

FULLEST_BAND = 0.42
LARGEST_FACTOR = 8
WIDE, NARROW = (0,) * 64, (0,) * 8  # lengths of vectors


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
        Of the arithmetic.  Its round-off is amplified where ĥ is small, which therefore it may not be.

    Attributes
    ----------
    factor : int
        D, 1 when the band is too full to decimate.
    centre : float
        Middle of the band, cycles per pixel.
    taps : complex (W,)
        h(t)·exp(2πi·centre·t), t = −W//2 … W//2.
    start, count : int
        z has samples i = start … start + count − 1.
    """

    def __init__(self, size, band, eps, precision):
        self.centre, reach = (band[0] + band[1]) / 2, (band[1] - band[0]) / 2
        self.factor = int(max(1, min(LARGEST_FACTOR, FULLEST_BAND / max(reach, 1e-9))))
        largest_gain = np.clip(np.sqrt(eps / (2 * precision)), 1.5, 10)
        self._lowpass = _lowpass(reach, self.factor, eps, largest_gain) if self.factor > 1 else np.ones(1)
        half = self._lowpass.size // 2
        self.taps = self._lowpass * np.exp(2j * np.pi * self.centre * np.arange(-half, half + 1))
        self.start = -((size // 2 + half) // self.factor)
        self.count = (size - 1 - size // 2 + half) // self.factor - self.start + 1

    def response(self, frequency):
        """ĥ(frequency − centre)/D, the factor on the spectrum."""
        return _spectrum(self._lowpass, np.asarray(frequency) - self.centre) / self.factor

    def modulation(self, samples):
        """exp(2πi·centre·D·i) at the given samples i, which moves the band's centre to frequency 0."""
        return np.exp(2j * np.pi * self.centre * self.factor * samples)


def _spectrum(lowpass, frequency):
    """Σ_t h(t) cos(2π t·frequency) of symmetric taps (2·half + 1, …): shape (…, frequency.shape)."""
    series = np.array(lowpass[len(lowpass) // 2 :])
    series[1:] *= 2
    return np.polynomial.chebyshev.chebval(np.cos(2 * np.pi * frequency), series)


def _lowpass(reach, factor, eps, largest_gain):
    """Shortest taps for the band |u| ≤ reach that meet two bounds.

    Aliases are below `eps` of the signal, and ĥ varies over the band by less than `largest_gain`.
    """
    shortest = failed = factor
    while (taps := _windowed_sinc(shortest, reach, factor, eps, largest_gain)) is None:
        failed, shortest = shortest, 2 * shortest
        if shortest > 200 * factor:
            raise ValueError(f"eps={eps} is too small to be reached")
    while shortest - failed > 1:
        half = (shortest + failed) // 2
        trial = _windowed_sinc(half, reach, factor, eps, largest_gain)
        shortest, failed, taps = (shortest, half, taps) if trial is None else (half, failed, trial)
    return taps


def _windowed_sinc(half, reach, factor, eps, largest_gain):
    """Taps −half … half that meet the bounds of `_lowpass`, or None: sincs in Kaiser–Bessel windows."""
    t = np.arange(-half, half + 1)[:, None]
    cutoffs = np.linspace(0, 0.5 / factor, 13)
    betas = np.pi * t.size * (1 / factor - reach - cutoffs)
    lowpasses = np.sinc(2 * cutoffs * t) * kaiser_bessel.kernel(t / (half + 0.5), betas)
    band = np.linspace(-reach, reach, 33)
    passed = _spectrum(lowpasses, band)
    aliases = _spectrum(lowpasses, band + np.arange(1, factor)[:, None] / factor)
    level = np.max(np.sqrt(np.sum(aliases**2, axis=1)) / np.abs(passed), axis=1)
    good = (level <= eps) & (passed.min(axis=1) * largest_gain >= passed.max(axis=1))
    return lowpasses[:, np.argmin(np.where(good, level, np.inf))] if good.any() else None


class Separable(NamedTuple):
    """One axis as the compiled kernels take it."""

    taps: np.ndarray  # real (2·W,): real parts, then imaginary parts
    factor: int
    first: int  # pixel under the first tap of the first sample, ≤ 0
    cells: np.ndarray  # int64 (count,), where each sample goes in the grid
    gains: np.ndarray  # complex (count,), what it is multiplied with


def scratch_shape(columns, workers):
    """Shape of the real work space of `decimate` and `expand`: rows of whole vectors, with a margin for shifts."""
    margin = -(-columns.taps.size // 2 // columns.factor)
    length = margin + -(-columns.cells.size // len(WIDE)) * len(WIDE)
    return workers, columns.factor + 2, margin + length


_jit = njit(nogil=True, cache=True, fastmath={"contract"})


@_jit
def decimate(image, rows, columns, grid, lines, scratch, worker, workers):
    """Write the samples of a real image (nx, ny) into a complex grid, times their gains.

    `lines` real (rows.cells.size, ny) receives the image decimated along its first axis only, by
    real taps.  `scratch` has the shape `scratch_shape`.
    """
    nx, ny = image.shape
    n_taps, count = rows.taps.size // 2, columns.cells.size
    phases, sums = scratch[worker, :-2], scratch[worker, -2:]
    flat, pixels = scratch[worker].reshape(-1), image.reshape(-1)
    for i in range(rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers):
        top = rows.first + rows.factor * i
        low, high = max(0, -top), min(n_taps, nx - top)
        lines[i] = 0
        _add_shifted(lines[i], pixels, (top + low) * ny, ny, rows.taps[low:high], 1, ny, WIDE, NARROW)
        _split_phases(lines[i], columns, phases)
        sums[:] = 0
        for part in range(2):
            for phase in range(columns.factor):
                taps = columns.taps[part * (columns.taps.size // 2) :][: columns.taps.size // 2][phase:]
                _add_shifted(sums[part], flat, phase * phases.shape[1], 1, taps, columns.factor, count, WIDE, NARROW)
        for j in range(count):
            grid[rows.cells[i], columns.cells[j]] = complex(sums[0, j], sums[1, j]) * rows.gains[i] * columns.gains[j]


@_jit
def expand(grid, rows, columns, lines, scratch, worker, workers):
    """Transpose of the second half of `decimate`: samples in the grid to `lines`, Re of the conjugate."""
    phases, sums = scratch[worker, :-2], scratch[worker, -2:]
    flat, width = scratch[worker].reshape(-1), scratch.shape[2]
    n_taps, count = columns.taps.size // 2, columns.cells.size
    margin = -(-n_taps // columns.factor)
    for i in range(rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers):
        sums[:] = 0
        for j in range(count):
            value = grid[rows.cells[i], columns.cells[j]] * np.conj(rows.gains[i] * columns.gains[j])
            sums[0, margin + j], sums[1, margin + j] = value.real, value.imag
        phases[:] = 0
        for part in range(2):
            for phase in range(columns.factor):
                taps = columns.taps[part * n_taps :][:n_taps][phase:]
                start = (columns.factor + part) * width + margin
                _add_shifted(phases[phase], flat, start, -1, taps, columns.factor, width - margin, WIDE, NARROW)
        _join_phases(phases, columns, lines[i])


@_jit
def expand_rows(lines, rows, image, worker, workers):
    """Transpose of the first half of `decimate`: lines to a real image (nx, ny)."""
    nx, ny = image.shape
    n_taps, flat = rows.taps.size // 2, lines.reshape(-1)
    for pixel in range(nx * worker // workers, nx * (worker + 1) // workers):
        offset = pixel - rows.first
        low, high = max(0, -((n_taps - 1 - offset) // rows.factor)), min(rows.cells.size, offset // rows.factor + 1)
        image[pixel] = 0
        taps = rows.taps[offset - rows.factor * (high - 1) : n_taps]
        _add_shifted(image[pixel], flat, (high - 1) * ny, -ny, taps[: rows.factor * (high - 1 - low) + 1], rows.factor,
                     ny, WIDE, NARROW)


@_jit
def _add_shifted(out, source, start, step, taps, tap_step, length, wide, narrow):
    """out[j] += Σ_t taps[t·tap_step] · source[start + t·step + j] for j < length."""
    n_taps, j = -(-taps.size // tap_step), 0
    while j + len(wide) <= length:
        total = load(out, j, wide)
        for t in range(n_taps):
            total = multiply_add(load(source, start + t * step + j, wide), taps[t * tap_step], total)
        store(out, j, total)
        j += len(wide)
    while j + len(narrow) <= length:
        total = load(out, j, narrow)
        for t in range(n_taps):
            total = multiply_add(load(source, start + t * step + j, narrow), taps[t * tap_step], total)
        store(out, j, total)
        j += len(narrow)
    while j < length:
        for t in range(n_taps):
            out[j] += taps[t * tap_step] * source[start + t * step + j]
        j += 1


@_jit
def _split_phases(line, columns, phases):
    """phases[q, k] = line[first + factor·k + q], zero beyond the borders."""
    phases[:] = 0
    for q in range(columns.factor):
        low = -((columns.first + q) // columns.factor)
        for k in range(low, -(-(line.size - columns.first - q) // columns.factor)):
            phases[q, k] = line[columns.first + columns.factor * k + q]


@_jit
def _join_phases(phases, columns, line):
    """Transpose of `_split_phases`."""
    for q in range(columns.factor):
        low = -((columns.first + q) // columns.factor)
        for k in range(low, -(-(line.size - columns.first - q) // columns.factor)):
            line[columns.first + columns.factor * k + q] = phases[q, k]
