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

import numpy as np
import numpy.typing as npt

from casa_sara.operators import kaiser_bessel
from casa_sara.operators._decimation_kernels import GROUP, Separable

__all__ = ["AxisDecimation", "separable"]

FULLEST_BAND = 0.42
LARGEST_FACTOR = 8


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


def separable(axis: AxisDecimation, size: int, cells: np.ndarray, factors: np.ndarray,
              dtype: npt.DTypeLike) -> Separable:
    """`axis`, of `size` pixels, with its samples' cells and further factors, for arithmetic in complex `dtype`.

    Parameters
    ----------
    axis : AxisDecimation
        How the axis is decimated.
    size : int
        Pixels.
    cells : int64 (count,)
        Where each sample goes in the grid.
    factors : float64 (count,)
        What each is multiplied with, beside the modulation.
    dtype : complex64 or complex128
        Precision of the gains.

    Returns
    -------
    Separable
    """
    margin = (GROUP - 1) * axis.factor
    first = axis.factor * axis.start - axis.taps.size // 2 + size // 2
    gains = factors * axis.modulation(axis.start + np.arange(axis.count))
    return Separable(np.pad(axis.taps, margin).astype(dtype), margin, axis.factor, first, cells, gains.astype(dtype))


