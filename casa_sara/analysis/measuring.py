"""All measures of a comparison, taken of plain arrays on one grid."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from casa_sara.analysis import metrics
from casa_sara.analysis.comparison import WEIGHTINGS, Product
from casa_sara.analysis.residuals import residual_statistics

__all__ = ["measure", "source_support"]

SCALES = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the beam, at which a model is compared with the truth


def source_support(models: Sequence[np.ndarray], truth: np.ndarray | None, threshold: float,
                   beam: tuple[float, float, float], cell_arcsec: tuple[float, float]) -> np.ndarray:
    """Return where the source is: the same for all models, so that none declares its own artefacts to be source.

    Parameters
    ----------
    models : sequence of (nx, ny)
        Jy/pixel, on one grid.
    truth : (nx, ny) or None
        Used in place of the models when there is one.
    threshold : float
        Fraction of the peak.
    beam : (float, float, float)
        Major and minor axis in arcsec, position angle in degrees, to which all are smoothed first.
    cell_arcsec : (float, float)
        Pixel size along x and y in arcsec.

    Returns
    -------
    bool (nx, ny)
        Where the smoothed truth, or the median of the smoothed models, exceeds the threshold.
    """
    images = models if truth is None else [truth]
    smoothed = [metrics.smooth(image, beam[:2], beam[2], cell_arcsec) for image in images]
    middle = np.median(smoothed, axis=0)
    return middle > threshold * middle.max()


def measure(products: Sequence[Product], cell_arcsec: tuple[float, float], beams: dict[str, tuple[float, float, float]],
            truth: np.ndarray | None, support: np.ndarray, regions: dict[str, np.ndarray],
            chi_square: dict[str, Any] | None = None) -> dict[str, Any]:
    """Take all measures.

    Parameters
    ----------
    products : sequence of casa_sara.analysis.comparison.Product
        On one grid.
    cell_arcsec : (float, float)
        Pixel size along x and y in arcsec.
    beams : dict
        Weighting → (major, minor) in arcsec FWHM and position angle in degrees.
    truth : (nx, ny) or None
        Jy/pixel.
    support : bool (nx, ny)
        Where the source is.
    regions : dict
        Name → bool (nx, ny).
    chi_square : dict, optional
        Name of the product → reduced χ² of each block.

    Returns
    -------
    dict
        As `casa_sara.analysis.comparison.Comparison.measures` says.
    """
    chi_square = chi_square or {}
    measured = {}
    for product in products:
        entry = _model(product, support)
        for weighting in WEIGHTINGS:
            if weighting in product.residual:
                entry[weighting] = _residual(product, weighting)
        if product.name in chi_square and "natural" in entry:
            entry["natural"]["chi_square"] = [float(value) for value in chi_square[product.name]]
        entry["regions"] = {name: _region(product, mask, cell_arcsec, beams) for name, mask in regions.items()}
        for name, error in product.region_errors.items():
            entry["regions"][name]["model_error_jy"] = error
        if product.features:
            entry["features"] = {name: dict(test[0]) for name, test in product.features.items()}
        if truth is not None:
            entry |= _against_truth(product, truth, cell_arcsec, beams)
        measured[product.name] = entry
    return {"products": measured, "similarity": _similarities(products, cell_arcsec, beams)}


def _model(product, support):
    """Measures of the model alone."""
    model = product.model
    found = {
        "flux_jy": float(model.sum()),
        "peak_jy_per_pixel": float(model.max()),
        "negative_jy": float(model[model < 0].sum()),
    }
    if support.any() and not support.all():
        found["mdr"] = metrics.model_dynamic_range(model, support)
    return found


def _residual(product, weighting):
    """Measures of the residual and of the restored image."""
    residual, restored = product.residual[weighting], product.restored[weighting]
    seen = np.isfinite(residual) if product.primary_beams else None
    return residual_statistics(residual, seen) | {
        "peak": float(np.nanmax(restored)),
        "dr": metrics.dynamic_range(restored, residual),
    }


def _region(product: Product, mask, cell_arcsec, beams):
    """Flux in a region: of the restored image with its uncertainty where there is one, and of the model."""
    model, _ = metrics.integrated_flux(product.model, mask)
    for weighting in WEIGHTINGS:
        if weighting in product.restored:
            beam = metrics.beam_pixels(beams[weighting][:2], cell_arcsec)
            image, rms = product.restored[weighting], np.nanstd(product.residual[weighting])
            if product.primary_beams:  # the flux of the sky, and its noise
                pb = product.primary_beams[weighting]
                image, rms = image / pb, rms * np.sqrt(np.mean(pb[mask] ** -2.0))
            flux, error = metrics.integrated_flux(image, mask, "Jy/beam", beam, rms)
            return {"flux_jy": flux, "error_jy": error, "model_flux_jy": model, "weighting": weighting}
    return {"flux_jy": model, "model_flux_jy": model}


def _against_truth(product, truth, cell_arcsec, beams):
    """Measures of the model against the truth."""
    weighting = next(name for name in WEIGHTINGS if name in beams)
    beam, cell = np.sqrt(np.prod(beams[weighting][:2])), np.sqrt(np.prod(cell_arcsec))
    found: dict[str, Any] = {
        "snr": metrics.snr(truth, product.model),
        "log_snr": metrics.log_snr(truth, product.model),
        "snr_at_scale": {
            f"{scale:.3g}": metrics.snr_at_scale(truth, product.model, scale, cell_arcsec)
            for scale in beam * np.array(SCALES)
        },
    }
    if min(truth.shape) > 11:
        found["ssim_range_jy_per_pixel"] = float(truth.max())
        found["ssim"] = metrics.ssim(truth, product.model, found["ssim_range_jy_per_pixel"])
    entry: dict[str, Any] = {"truth": found}
    point = metrics.isolated_point(truth)
    if point is not None:
        width = metrics.point_width(product.model, point, max(2, round(beam / cell)), cell_arcsec)
        entry |= {} if width is None else {"fwhm_recovered_arcsec": width}
    return entry


def _similarities(products, cell_arcsec, beams):
    """S of each pair of models, smoothed with each beam."""
    found = {}
    for weighting, (*axes, angle) in beams.items():
        smoothed = {p.name: metrics.smooth(p.model, axes, angle, cell_arcsec) for p in products}
        found[weighting] = {
            f"{one}|{other}": metrics.similarity(smoothed[one], smoothed[other])
            for one, other in combinations(smoothed, 2)
        }
    return found
