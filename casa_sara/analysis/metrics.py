"""Measures of image quality: those of Dabbech et al. (2018), comparison with a true sky, flux and resolution.

All take plain arrays, indexed [ix, iy] with ix to the west and iy to the north.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

__all__ = [
    "beam_pixels", "dynamic_range", "integrated_flux", "isolated_point", "log_snr", "model_dynamic_range",
    "point_width", "similarity", "smooth", "snr", "snr_at_scale", "ssim",
]

FWHM_PER_SIGMA = np.sqrt(8 * np.log(2))


def snr(truth: npt.ArrayLike, model: npt.ArrayLike) -> float:
    """Return 20 log10(‖truth‖ / ‖truth − model‖) in dB; both of one shape and unit.

    Parameters
    ----------
    truth : array_like (nx, ny)
        The true image.
    model : array_like (nx, ny)
        The image to judge.

    Returns
    -------
    float
        dB.
    """
    truth, model = _alike(truth, model)
    error = np.linalg.norm(truth - model)
    return float("inf") if error == 0 else float(20 * np.log10(np.linalg.norm(truth) / error))


def log_snr(truth: npt.ArrayLike, model: npt.ArrayLike, dynamic_range: float = 1e3) -> float:
    """Return the SNR in dB of the images on a log scale, where faint emission counts as much as bright.

    An image x goes to log(1 + D x⁺/p) / log(1 + D), with p the peak of the truth, D the dynamic
    range over which the scale is logarithmic, and x⁺ = max(x, 0).

    Parameters
    ----------
    truth, model : array_like
        Images of one shape and unit.
    dynamic_range : float
        D: emission below p/D is on the linear part of the scale.

    Returns
    -------
    float
        dB.
    """
    truth, model = _alike(truth, model)
    scale = dynamic_range / truth.max()
    return snr(*(np.log1p(scale * np.clip(image, 0, None)) / np.log1p(dynamic_range) for image in (truth, model)))


def smooth(image: npt.ArrayLike, fwhm: float | tuple[float, float], position_angle_deg: float = 0.0,
           cell: tuple[float, float] = (1.0, 1.0)) -> np.ndarray:
    """Convolve an image with a Gaussian of unit integral (the unit stays, Jy/pixel for a model).

    Outside of the image is zero.

    Parameters
    ----------
    image : array_like (nx, ny)
        Indexed [ix, iy], ix to the west and iy to the north.
    fwhm : float or (float, float)
        Full width at half maximum in the unit of `cell`: of a round Gaussian, or of the major and minor axis.
    position_angle_deg : float
        Of the major axis, from north through east.
    cell : (float, float)
        Pixel size; by default the width is in pixels.

    Returns
    -------
    float64 (nx, ny)
    """
    image = np.asarray(image, float)
    major, minor = np.broadcast_to(fwhm, 2)
    padded = [n + int(np.ceil(2 * major / size)) for n, size in zip(image.shape, cell)]
    kx, ky = np.fft.fftfreq(padded[0], cell[0])[:, None], np.fft.rfftfreq(padded[1], cell[1])[None, :]
    sin, cos = np.sin(np.deg2rad(position_angle_deg)), np.cos(np.deg2rad(position_angle_deg))
    along, across = ky * cos - kx * sin, kx * cos + ky * sin
    transfer = np.exp(-(np.pi**2) * ((major * along) ** 2 + (minor * across) ** 2) / (4 * np.log(2)))
    smoothed = np.fft.irfft2(np.fft.rfft2(image, padded) * transfer, padded)
    return smoothed[: image.shape[0], : image.shape[1]]


def snr_at_scale(truth: npt.ArrayLike, model: npt.ArrayLike, fwhm: float,
                 cell: tuple[float, float] = (1.0, 1.0)) -> float:
    """Return the SNR in dB of two images that are both smoothed with a round Gaussian; FWHM in the unit of `cell`.

    Parameters
    ----------
    truth : array_like (nx, ny)
        The true image.
    model : array_like (nx, ny)
        The image to judge, in the same unit.
    fwhm : float
        Of the Gaussian, in the unit of `cell`.
    cell : (float, float)
        Pixel size.

    Returns
    -------
    float
        dB.
    """
    truth, model = _alike(truth, model)
    return snr(*(smooth(image, fwhm, 0.0, cell) for image in (truth, model)))


def similarity(one: npt.ArrayLike, other: npt.ArrayLike) -> float:
    """Return S = 20 log10(max(‖one‖, ‖other‖) / ‖one − other‖) in dB, infinite for equal images.

    Parameters
    ----------
    one, other : array_like
        Images of one shape and unit; the paper takes models smoothed with the CLEAN beam.

    Returns
    -------
    float
        dB.

    Raises
    ------
    ValueError
        The shapes differ.
    """
    one, other = _alike(one, other, "one", "other")
    difference = np.linalg.norm(one - other)
    if difference == 0:
        return float("inf")
    return float(20 * np.log10(max(np.linalg.norm(one), np.linalg.norm(other)) / difference))


def dynamic_range(restored: npt.ArrayLike, residual: npt.ArrayLike) -> float:
    """Return DR = max(restored) / standard deviation of the residual, NaN (blank) pixels left out; one unit.

    Parameters
    ----------
    restored : array_like (nx, ny)
        The restored image.
    residual : array_like (nx, ny)
        The residual image, in the same unit.

    Returns
    -------
    float
    """
    return float(np.nanmax(restored) / np.nanstd(np.asarray(residual)))


def model_dynamic_range(model: npt.ArrayLike, support: npt.ArrayLike) -> float:
    """Return MDR = max(model) / brightest pixel outside the support of the source, infinite if that is not positive.

    Parameters
    ----------
    model : array_like (nx, ny)
        The model.
    support : bool array_like (nx, ny)
        Where the source is.

    Returns
    -------
    float

    Raises
    ------
    ValueError
        The shapes differ, or the support is empty or the whole image.
    """
    model, support = _alike(model, support, "model", "support")
    support = support > 0
    if support.all() or not support.any():
        raise ValueError(f"support holds {support.sum()} of {support.size} pixels: it takes some, and not all")
    outside = model[~support].max()
    return float(model.max() / outside) if outside > 0 else float("inf")


def beam_pixels(fwhm: tuple[float, float], cell: tuple[float, float] = (1.0, 1.0)) -> float:
    """Return the solid angle of a Gaussian beam in pixels; (major, minor) FWHM and cell (x, y) in one unit.

    Parameters
    ----------
    fwhm : (float, float)
        Major and minor axis.
    cell : (float, float)
        Pixel size, in the same unit.

    Returns
    -------
    float
        Pixels.
    """
    return float(np.pi * fwhm[0] * fwhm[1] / (4 * np.log(2) * cell[0] * cell[1]))


def integrated_flux(image: npt.ArrayLike, mask: npt.ArrayLike, unit: str = "Jy/pixel", beam: float | None = None,
                    rms: float | None = None) -> tuple[float, float | None]:
    """Sum an image over a region.

    Parameters
    ----------
    image : array_like (nx, ny)
        The image.
    mask : bool array_like (nx, ny)
        The region.
    unit : {'Jy/pixel', 'Jy/beam'}
        Of the image.
    beam : float
        Solid angle of the beam in pixels, for Jy/beam.
    rms : float
        Noise in Jy/beam.

    Returns
    -------
    flux : float
        Jy.
    error : float or None
        rms·√N_beams in Jy, N_beams being the number of beams in the region; None for a model, or without rms.

    Raises
    ------
    ValueError
        The region is empty or of another shape, the unit is another one, or the beam is missing.
    """
    image, mask = _alike(image, mask, "image", "mask")
    if not mask.any():
        raise ValueError("mask is empty: it takes one pixel or more")
    flux = float(image[mask > 0].sum())
    if unit == "Jy/pixel":
        return flux, None
    if unit != "Jy/beam":
        raise ValueError(f"unit = '{unit}': should be 'Jy/pixel' or 'Jy/beam'")
    if not (beam and beam > 0):
        raise ValueError(f"beam = {beam!r}: an image in Jy/beam needs the solid angle of its beam in pixels")
    error = None if rms is None else float(rms * np.sqrt((mask > 0).sum() / beam))
    return flux / beam, error


def ssim(truth: npt.ArrayLike, model: npt.ArrayLike, value_range: float, sigma: float = 1.5) -> float:
    """Return the mean structural similarity (Wang et al. 2004), 1 for equal images.

    Parameters
    ----------
    truth, model : array_like (nx, ny)
        Images of one shape and unit.
    value_range : float
        The range L of the values, in the same unit; K1 = 0.01, K2 = 0.03.
    sigma : float
        Of the Gaussian window in pixels, which is cut at 3.5 sigma; the mean leaves out its half width at the edges.

    Returns
    -------
    float
    """
    truth, model = _alike(truth, model)
    half = int(3.5 * sigma + 0.5)
    if min(truth.shape) <= 2 * half:
        raise ValueError(f"images of {truth.shape} pixels are too small for a window of {2 * half + 1}")

    def local(image):
        return gaussian_filter(image, sigma, truncate=3.5)[half:-half, half:-half]

    c1, c2 = (0.01 * value_range) ** 2, (0.03 * value_range) ** 2
    m1, m2 = local(truth), local(model)
    v1, v2, v12 = local(truth**2) - m1**2, local(model**2) - m2**2, local(truth * model) - m1 * m2
    return float(np.mean((2 * m1 * m2 + c1) * (2 * v12 + c2) / ((m1**2 + m2**2 + c1) * (v1 + v2 + c2))))


def isolated_point(truth: npt.ArrayLike, guard: int = 4) -> tuple[int, int] | None:
    """Return the brightest pixel [ix, iy] that is alone in a square of 2·guard + 1 pixels, None if there is none.

    Parameters
    ----------
    truth : array_like (nx, ny)
        The true image.
    guard : int
        Half the side of the square, pixels.

    Returns
    -------
    (int, int) or None
    """
    truth = np.asarray(truth, float)
    nx, ny = truth.shape
    for flat in np.argsort(truth, axis=None)[::-1][:100]:
        ix, iy = np.unravel_index(flat, truth.shape)
        if truth[ix, iy] <= 0:
            return None
        if guard <= ix < nx - guard and guard <= iy < ny - guard:
            around = truth[ix - guard : ix + guard + 1, iy - guard : iy + guard + 1]
            if np.abs(around).sum() - truth[ix, iy] <= 1e-3 * truth[ix, iy]:
                return int(ix), int(iy)
    return None


def point_width(model: npt.ArrayLike, pixel: tuple[int, int], half_side: int,
                cell: tuple[float, float] = (1.0, 1.0)) -> float | None:
    """Return the FWHM that a point source was recovered with, from the second moments of a square around it.

    The geometric mean of both axes, as the covariance's determinant gives it; negative pixels count as zero. A source
    that is one pixel has the width zero.

    Parameters
    ----------
    model : array_like (nx, ny)
        Jy/pixel.
    pixel : (int, int)
        Where the point source is.
    half_side : int
        The square has 2·half_side + 1 pixels, less at the edge.
    cell : (float, float)
        Pixel size, which sets the unit of the width.

    Returns
    -------
    float, or None where the square is empty
    """
    square = tuple(slice(max(centre - half_side, 0), centre + half_side + 1) for centre in pixel)
    part = np.clip(np.asarray(model, float)[square], 0, None)
    flux = part.sum()
    if not flux > 0:
        return None
    x, y = (axis * size for axis, size in zip(np.indices(part.shape), cell))
    x, y = (axis - (axis * part).sum() / flux for axis in (x, y))
    xx, yy, xy = ((product * part).sum() / flux for product in (x * x, y * y, x * y))
    return float(FWHM_PER_SIGMA * max(xx * yy - xy * xy, 0.0) ** 0.25)


def _alike(truth, model, first="truth", second="model"):
    truth, model = np.asarray(truth, float), np.asarray(model, float)
    if truth.shape != model.shape:
        raise ValueError(f"{first} has shape {truth.shape} and {second} {model.shape}: they must be the same")
    return truth, model
