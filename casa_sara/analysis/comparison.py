"""The data of a comparison of images: the products on one grid, and their measures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["Comparison", "Product"]

WEIGHTINGS = ("natural", "briggs")


@dataclass(frozen=True)
class Product:
    """What one imager made, on the grid of the comparison; images are float64 (nx, ny), indexed [ix, iy].

    Attributes
    ----------
    name : str
        Unique among the products, e.g. 'tsara'.
    model : ndarray
        Jy/pixel.
    residual, restored : dict
        Weighting ('natural', 'briggs') → image in Jy/beam; all products with one operator and the same weights. Empty
        when there are no visibilities to make them of.
    parameters : dict
        Task parameters found in the history of the image, name → text.
    record : dict
        What tsara recorded of the run ('history', 'bounds', 'blocks', 'reweightings' as in its return dictionary);
        empty for other imagers.
    model_error, smoothed_error, region_errors
        From the draws of a bootstrap, where there are any: the error of the model, Jy/pixel; that of the model smoothed
        with the beam of each weighting, Jy/pixel; and that of its flux in each region, Jy.
    features : dict
        Of each region tested: its measures, the models with and without emission there, Jy/pixel, and its mask.
    primary_beams : dict
        Of mosaics, weighting → primary beam, NaN where nothing is compared; else empty. Models are the sky then, and
        residual and restored images the sky times the primary beam, NaN where that is.
    polarised : complex ndarray or None
        Q + iU of the model, Jy/pixel, where the image has these.
    """

    name: str
    model: np.ndarray
    residual: dict[str, np.ndarray] = field(default_factory=dict)
    restored: dict[str, np.ndarray] = field(default_factory=dict)
    parameters: dict[str, str] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    model_error: np.ndarray | None = None
    smoothed_error: dict[str, np.ndarray] = field(default_factory=dict)
    region_errors: dict[str, float] = field(default_factory=dict)
    features: dict[str, tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)
    primary_beams: dict[str, np.ndarray] = field(default_factory=dict)
    polarised: np.ndarray | None = None


@dataclass(frozen=True)
class Comparison:
    """Several products and what was measured.

    Attributes
    ----------
    products : tuple of Product
    cell_arcsec : (float, float)
        Pixel size along x and y, both positive; x runs to the west.
    centre_deg : (float, float)
        Right ascension and declination of pixel (nx//2, ny//2).
    beams : dict
        Weighting → (major, minor) in arcsec FWHM and position angle in degrees from north through east.
    truth : ndarray or None
        Jy/pixel.
    support : bool ndarray
        Where the source is.
    regions : dict
        Name → bool mask (nx, ny).
    measures : dict
        Plain numbers, strings, lists and dicts only:
        `products` → name → {flux_jy, peak_jy_per_pixel, negative_jy, mdr, fwhm_recovered_arcsec, injected → {source →
        {injected_jy, flux_jy, offset_arcsec, fwhm_arcsec, fwhm_in_beams → {weighting → ratio}}}, regions → {name →
        {flux_jy, error_jy, model_flux_jy, model_error_jy}}, features → {name → {flux_jy, delta_chi_square, drawn,
        p_value, rank_p_value, sigma}}, natural/briggs → {sigma, peak, dr, max_abs, skewness, kurtosis, whiteness,
        chi_square → [of each block]}, polarisation → as of
        :func:`casa_sara.analysis.polarisation.polarised_measures`, truth → {snr, log_snr, ssim,
        ssim_range_jy_per_pixel, snr_at_scale → {arcsec → dB}}} and
        `similarity` → weighting → {'one|other' → S in dB}; what could not be measured is left out.
    versions : dict
        Package → version.
    notes : tuple of str
        Warnings for the reader.
    frames : tuple of (str, ndarray, float)
        Title, model in Jy/pixel and pixel size in arcsec of reconstructions with different pixels, to be animated;
        pixel (nx//2, ny//2) of each is at `centre_deg`.
    polarised_truth : complex ndarray or None
        Q + iU of the truth, Jy/pixel, where its image has these.
    """

    products: tuple[Product, ...]
    cell_arcsec: tuple[float, float]
    centre_deg: tuple[float, float]
    beams: dict[str, tuple[float, float, float]]
    truth: np.ndarray | None
    support: np.ndarray
    regions: dict[str, np.ndarray]
    measures: dict[str, Any]
    versions: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    frames: tuple[tuple[str, np.ndarray, float], ...] = ()
    polarised_truth: np.ndarray | None = None
