"""Fewer samples of a band-limited image: low-pass, then keep every D-th pixel.

Visibilities within |u| ≤ a (cycles per pixel) need z[i] = Σ_p h(p − D·i) x[p] only, D ≤ 0.42/a:

    Σ_i z[i] exp(2πi u D i) = Σ_k ĥ(u + k/D) x̂(u + k/D) / D ≈ x̂(u) · ĥ(u)/D ,

and division by ĥ(u)/D at each visibility is exact but for the aliases k ≠ 0, where the
taps h make ĥ small.  A band centred elsewhere, [0, 2a] for the half-plane that
a real image needs, is served by taps modulated to its centre.  The image is zero outside
its borders; z extends over them by the length of the taps.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from casa_sara.operators import kaiser_bessel
from casa_sara.operators._vectors import load_at, multiply_add, store_at, zeros
from casa_sara.runtime import jit

__all__ = ["AxisDecimation", "Separable", "decimate", "expand", "expand_rows", "scratch_shape", "separable"]

FULLEST_BAND = 0.42
LARGEST_FACTOR = 8
WIDE, SINGLE = (0,) * 32, (0,)  # lengths of vectors
GROUP = 4  # rows that are summed together


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

    def __init__(self, size: int, band: tuple[float, float], eps: float, precision: float) -> None:
        self.centre, reach = (band[0] + band[1]) / 2, (band[1] - band[0]) / 2
        self.factor = int(max(1, min(LARGEST_FACTOR, FULLEST_BAND / max(reach, 1e-9))))
        largest_gain = np.clip(np.sqrt(eps / (2 * precision)), 1.5, 10)
        self._lowpass = _lowpass(reach, self.factor, eps, largest_gain) if self.factor > 1 else np.ones(1)
        half = self._lowpass.size // 2
        self.taps = self._lowpass * np.exp(2j * np.pi * self.centre * np.arange(-half, half + 1))
        self.start = -((size // 2 + half) // self.factor)
        self.count = (size - 1 - size // 2 + half) // self.factor - self.start + 1

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """ĥ(frequency − centre)/D, the factor on the spectrum.

        Parameters
        ----------
        frequency : real, any shape
            Cycles per pixel.

        Returns
        -------
        float64, of the shape of frequency
        """
        return _spectrum(self._lowpass, np.asarray(frequency) - self.centre) / self.factor

    def modulation(self, samples: np.ndarray) -> np.ndarray:
        """exp(2πi·centre·D·i) at the given samples i, which moves the band's centre to frequency 0.

        Parameters
        ----------
        samples : int (n,)
            Numbers i.

        Returns
        -------
        complex128 (n,)
        """
        return np.exp(2j * np.pi * self.centre * self.factor * samples)


def _spectrum(lowpass, frequency):
    """Σ_t h(t) cos(2π t·frequency) of symmetric taps (2·half + 1, …): shape (…, frequency.shape)."""
    series = np.array(lowpass[len(lowpass) // 2 :])
    series[1:] *= 2
    return np.polynomial.chebyshev.chebval(np.cos(2 * np.pi * frequency), series)


@functools.lru_cache(maxsize=64)
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
    with np.errstate(divide="ignore", invalid="ignore"):  # taps that pass nothing of some frequency are not good
        level = np.max(np.sqrt(np.sum(aliases**2, axis=1)) / np.abs(passed), axis=1)
    good = (level <= eps) & (passed.min(axis=1) * largest_gain >= passed.max(axis=1))
    return lowpasses[:, np.argmin(np.where(good, level, np.inf))] if good.any() else None


class Separable(NamedTuple):
    """One axis as the compiled kernels take it."""

    taps: np.ndarray  # complex (W + 2·margin,), zeros in the margins
    margin: int
    factor: int
    first: int  # pixel under the first tap of the first sample, ≤ 0
    cells: np.ndarray  # int64 (count,), where each sample goes in the grid
    gains: np.ndarray  # complex (count,), what it is multiplied with


def separable(axis: AxisDecimation, size: int, cells: np.ndarray, factors: np.ndarray,
              dtype: npt.DTypeLike) -> Separable:
    """`axis`, of `size` pixels, with its samples' cells and further factors, for arithmetic in complex `dtype`.

    Parameters
    ----------
    axis : AxisDecimation
    size : int
        Pixels.
    cells : int64 (count,)
        Where each sample goes in the grid.
    factors : float64 (count,)
        What each is multiplied with, beside the modulation.
    dtype : complex64 or complex128

    Returns
    -------
    Separable
    """
    margin = (GROUP - 1) * axis.factor
    first = axis.factor * axis.start - axis.taps.size // 2 + size // 2
    gains = factors * axis.modulation(axis.start + np.arange(axis.count))
    return Separable(np.pad(axis.taps, margin).astype(dtype), margin, axis.factor, first, cells, gains.astype(dtype))


def scratch_shape(columns, workers):
    """Shape of the real work space of `decimate` and `expand`."""
    shifts = -(-(columns.taps.size - 2 * columns.margin) // columns.factor)
    vectors = -(-(columns.cells.size + shifts) // len(WIDE))
    return workers, columns.factor + 2, shifts + vectors * len(WIDE)


_jit = jit.kernel()
_inlined = jit.inner(inline="always")  # one function to compile instead of seven


@_jit
def decimate(image, rows, columns, grid, lines, scratch, worker, workers):
    """Write the samples of a real image (nx, ny) into a complex grid, times their gains.

    `lines` real (rows.cells.size, ny) receives the image decimated along its first axis only, by
    real taps.  `scratch` has the shape `scratch_shape`.
    """
    n_taps = rows.taps.size - 2 * rows.margin
    begin, end = rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers
    phases, sums = scratch[worker, :-2], scratch[worker, -2:]
    for group in range(begin, end, GROUP):
        top = rows.first + rows.factor * group
        low, high = max(0, -top), min(n_taps + rows.margin, image.shape[0] - top)
        size = min(GROUP, end - group)
        tap, pixels = rows.margin + low, image[top + low : top + high]
        _weigh_rows(lines[group : group + size], pixels, rows.taps, tap, np.int64(1), -rows.factor)
        for i in range(group, group + size):
            _split_phases(lines[i], columns, phases)
            _filter_phases(phases, columns, sums)
            for j in range(columns.cells.size):
                gain = rows.gains[i] * columns.gains[j]
                grid[rows.cells[i], columns.cells[j]] = complex(sums[0, j], sums[1, j]) * gain


@_jit
def expand(grid, rows, columns, lines, scratch, worker, workers):
    """Transpose of the second half of `decimate`: samples in the grid to `lines`, Re of the conjugate."""
    phases, sums = scratch[worker, :-2], scratch[worker, -2:]
    shifts = -(-(columns.taps.size - 2 * columns.margin) // columns.factor)
    for i in range(rows.cells.size * worker // workers, rows.cells.size * (worker + 1) // workers):
        sums[:] = 0
        for j in range(columns.cells.size):
            value = grid[rows.cells[i], columns.cells[j]] * np.conj(rows.gains[i] * columns.gains[j])
            sums[0, shifts + j], sums[1, shifts + j] = value.real, value.imag
        _spread_phases(sums, columns, phases, shifts)
        _join_phases(phases, columns, lines[i])


@_jit
def expand_rows(lines, rows, image, worker, workers):
    """Transpose of the first half of `decimate`: lines to a real image (nx, ny)."""
    n_taps = rows.taps.size - 2 * rows.margin
    begin, end = image.shape[0] * worker // workers, image.shape[0] * (worker + 1) // workers
    for group in range(begin, end, GROUP):
        size, offset = min(GROUP, end - group), group - rows.first
        low = max(0, -((n_taps - 1 - offset) // rows.factor))
        high = min(rows.cells.size, (offset + size - 1) // rows.factor + 1)
        tap = rows.margin + offset - rows.factor * low
        _weigh_rows(image[group : group + size], lines[low:high], rows.taps, tap, -rows.factor, np.int64(1))


@_inlined
def _weigh_rows(out, rows, taps, first, row_step, out_step):
    """out[r] = Σ_t taps[first + t·row_step + r·out_step].real · rows[t], for at most GROUP rows r."""
    length = out.shape[1]
    if length < len(WIDE):
        for j in range(length):
            _weigh_block(out, rows.reshape(-1), j, taps, first, row_step, out_step, SINGLE)
    else:
        for block in range(0, length, len(WIDE)):
            _weigh_block(out, rows.reshape(-1), min(block, length - len(WIDE)), taps, first, row_step, out_step, WIDE)


@_inlined
def _weigh_block(out, rows, column, taps, first, row_step, out_step, lanes):
    """len(lanes) columns of `_weigh_rows`, in registers."""
    length, pixels = out.shape[1], out.reshape(-1)
    sum0 = sum1 = sum2 = sum3 = zeros(rows, lanes)
    tap = first
    for t in range(rows.size // length):
        row = load_at(rows, t * length + column, lanes)
        sum0 = multiply_add(row, taps[tap].real, sum0)
        sum1 = multiply_add(row, taps[tap + out_step].real, sum1)
        sum2 = multiply_add(row, taps[tap + 2 * out_step].real, sum2)
        sum3 = multiply_add(row, taps[tap + 3 * out_step].real, sum3)
        tap += row_step
    for r in range(len(out)):
        store_at(pixels, r * length + column, sum0)
        sum0, sum1, sum2 = sum1, sum2, sum3


@_inlined
def _split_phases(line, columns, phases):
    """phases[q, k] = line[first + factor·k + q], zero beyond the borders."""
    phases[:] = 0
    for q in range(columns.factor):
        low = -((columns.first + q) // columns.factor)
        for k in range(low, -(-(line.size - columns.first - q) // columns.factor)):
            phases[q, k] = line[columns.first + columns.factor * k + q]


@_inlined
def _join_phases(phases, columns, line):
    """Transpose of `_split_phases`."""
    for q in range(columns.factor):
        low = -((columns.first + q) // columns.factor)
        for k in range(low, -(-(line.size - columns.first - q) // columns.factor)):
            line[columns.first + columns.factor * k + q] = phases[q, k]


@_inlined
def _filter_phases(phases, columns, sums):
    """sums[:, j] = (Re, Im) of Σ_t taps[t] · line[first + factor·j + t]."""
    flat, width, both = phases.reshape(-1), phases.shape[1], sums.reshape(-1)
    n_taps = columns.taps.size - 2 * columns.margin
    for j in range(0, columns.cells.size, len(WIDE)):
        real = imag = zeros(flat, WIDE)
        for q in range(columns.factor):
            for a in range(-(-(n_taps - q) // columns.factor)):
                tap = columns.taps[columns.margin + columns.factor * a + q]
                pixels = load_at(flat, q * width + a + j, WIDE)
                real, imag = multiply_add(pixels, tap.real, real), multiply_add(pixels, tap.imag, imag)
        store_at(both, j, real)
        store_at(both, width + j, imag)


@_inlined
def _spread_phases(sums, columns, phases, shifts):
    """Transpose of `_filter_phases`, from sums[:, shifts + j]; zeros surround them."""
    flat, width, both = phases.reshape(-1), phases.shape[1], sums.reshape(-1)
    n_taps = columns.taps.size - 2 * columns.margin
    for q in range(columns.factor):
        for k in range(0, width - shifts, len(WIDE)):
            total = zeros(flat, WIDE)
            for a in range(-(-(n_taps - q) // columns.factor)):
                tap = columns.taps[columns.margin + columns.factor * a + q]
                total = multiply_add(load_at(both, shifts + k - a, WIDE), tap.real, total)
                total = multiply_add(load_at(both, width + shifts + k - a, WIDE), tap.imag, total)
            store_at(flat, q * width + k, total)
