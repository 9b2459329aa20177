"""Statistics of a residual image: standard deviation, skewness, kurtosis, and whiteness."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["radial_power_spectrum", "residual_statistics", "whiteness"]


def residual_statistics(residual: npt.ArrayLike, seen: np.ndarray | None = None) -> dict[str, float]:
    """Return the statistics of a residual image.

    Parameters
    ----------
    residual : array_like (nx, ny)
        Finite, not constant.
    seen : bool (nx, ny), optional
        Where it is looked at; everywhere by default.

    Returns
    -------
    dict
        sigma, the standard deviation, and max_abs, both in the unit of the image; skewness and excess kurtosis, 0 for
        Gaussian noise; whiteness, see there.

    Raises
    ------
    ValueError
        Pixels are not finite, or all are equal.
    """
    image = residual = np.asarray(residual, float)
    if seen is not None:
        image, residual = np.where(seen, image, 0), image[seen]
    if not np.isfinite(residual).all():
        raise ValueError(f"residual: {np.sum(~np.isfinite(residual))} pixels are not finite: all should be")
    sigma = residual.std()
    if not sigma > 0:
        raise ValueError(f"residual: all pixels are {residual.flat[0]:g}: there is nothing to measure")
    scaled = (residual - residual.mean()) / sigma
    return {
        "sigma": float(sigma),
        "max_abs": float(np.abs(residual).max()),
        "skewness": float(np.mean(scaled**3)),
        "kurtosis": float(np.mean(scaled**4) - 3),
        "whiteness": whiteness(image),
    }


def radial_power_spectrum(image: npt.ArrayLike, cell: tuple[float, float] = (1.0, 1.0),
                          bins: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the power spectrum of an image, averaged over rings of spatial frequency.

    Parameters
    ----------
    image : array_like (nx, ny)
        Its mean is taken off.
    cell : (float, float)
        Pixel size (x, y), which sets the unit of the frequency.
    bins : int
        Number of rings between 0 and the Nyquist frequency 1/(2·max(cell)); a quarter of the shorter side by default.

    Returns
    -------
    frequency : float64 (K,)
        Mean frequency of each ring in cycles per unit of `cell`; rings without samples are left out.
    power : float64 (K,)
        Mean of |F|²/(nx·ny), in the image's unit squared: white noise of variance s² has s² throughout.
    """
    image = np.asarray(image, float)
    bins = bins or max(min(image.shape) // 4, 1)
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2 / image.size
    fx, fy = (np.fft.fftfreq(n, size) for n, size in zip(image.shape, cell))
    frequency = np.hypot(fx[:, None], fy[None, :])
    ring = np.floor(frequency * 2 * max(cell) * bins).astype(int)
    inside = (frequency > 0) & (ring < bins)
    count, summed, places = (
        np.bincount(ring[inside], values, bins) for values in (None, power[inside], frequency[inside])
    )
    there = count > 0
    return places[there] / count[there], summed[there] / count[there]


def whiteness(image: npt.ArrayLike) -> float:
    """Return geometric over arithmetic mean of the radial power spectrum: 1 when all scales are alike, else less.

    A residual image of pure noise is as white as the sampling of the uv plane lets it be, so this compares
    residuals of one operator and weighting.

    Parameters
    ----------
    image : array_like (nx, ny)
        A residual image.

    Returns
    -------
    float
        From 0 to 1.
    """
    _, power = radial_power_spectrum(image)
    if not power.min() > 0:
        return 0.0
    return float(np.exp(np.mean(np.log(power))) / np.mean(power))
