"""How good an image is: comparisons with a known truth, smoothing to a beam, noise and dynamic range."""

from __future__ import annotations

import numpy as np

__all__ = ["snr", "log_snr", "smooth", "dynamic_range"]


def snr(truth, model) -> float:
    """Return 20 log10(‖truth‖ / ‖truth − model‖) in dB; both of one shape and unit."""
    truth, model = _alike(truth, model)
    error = np.linalg.norm(truth - model)
    return float(20 * np.log10(np.linalg.norm(truth) / error)) if error > 0 else float("inf")


def log_snr(truth, model, dynamic_range=1e3) -> float:
    """Return the SNR in dB of the images on a log scale, where faint emission counts as much as bright.

    An image x goes to log(1 + D x⁺/p) / log(1 + D), with p the peak of the truth, D the dynamic
    range over which the scale is logarithmic, and x⁺ = max(x, 0).

    Parameters
    ----------
    truth, model : array_like
        Images of one shape and unit.
    dynamic_range : float
        D: emission below p/D is on the linear part of the scale.
    """
    truth, model = _alike(truth, model)
    scale = dynamic_range / truth.max()
    return snr(*(np.log1p(scale * np.clip(image, 0, None)) / np.log1p(dynamic_range) for image in (truth, model)))


def smooth(image, fwhm, position_angle_deg=0.0) -> np.ndarray:
    """Convolve an image with a Gaussian of unit integral (the unit stays, Jy/pixel for a model).

    Outside of the image is zero.

    Parameters
    ----------
    image : array_like (nx, ny)
        Indexed [ix, iy], ix to the west and iy to the north.
    fwhm : float or (float, float)
        Full width at half maximum in pixels: of a round Gaussian, or of the major and minor axis.
    position_angle_deg : float
        Of the major axis, from north through east.

    Returns
    -------
    float64 (nx, ny)
    """
    image = np.asarray(image, float)
    major, minor = np.broadcast_to(fwhm, 2)
    padded = [n + int(np.ceil(2 * major)) for n in image.shape]
    kx, ky = np.fft.fftfreq(padded[0])[:, None], np.fft.rfftfreq(padded[1])[None, :]
    sin, cos = np.sin(np.deg2rad(position_angle_deg)), np.cos(np.deg2rad(position_angle_deg))
    along, across = ky * cos - kx * sin, kx * cos + ky * sin
    transfer = np.exp(-(np.pi**2) * ((major * along) ** 2 + (minor * across) ** 2) / (4 * np.log(2)))
    smoothed = np.fft.irfft2(np.fft.rfft2(image, padded) * transfer, padded)
    return smoothed[: image.shape[0], : image.shape[1]]


def dynamic_range(restored, residual) -> float:
    """Return the peak of the restored image over the rms of the residual image, blank pixels left out."""
    return float(np.nanmax(restored) / np.sqrt(np.nanmean(np.square(residual))))


def _alike(truth, model):
    truth, model = np.asarray(truth, float), np.asarray(model, float)
    if truth.shape != model.shape:
        raise ValueError(f"truth has shape {truth.shape} and model {model.shape}: they must be the same")
    return truth, model
