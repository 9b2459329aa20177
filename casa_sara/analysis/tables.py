"""The measures of a comparison as tables, for a page or for a terminal."""

from __future__ import annotations

from typing import Any

import numpy as np

from casa_sara.analysis.columns import Table, build, fixed, is_number, number
from casa_sara.analysis.comparison import Comparison

__all__ = ["as_text", "tables"]

WEIGHTINGS = ("natural", "briggs")


REGION_TABLES = (
    ("model_flux_jy", "model_error_jy", "Regions, flux of the models",
     "Sum of the model within each region; the error is that of the draws of tsara's ndraws."),
    ("flux_jy", "error_jy", "Regions, flux of the restored images",
     "Within each region; a region smaller than the beam holds a part of its source. The error is that of the noise."),
)


def tables(comparison: Comparison) -> list[Table]:
    """Return the tables for which there are measures.

    Parameters
    ----------
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.

    Returns
    -------
    list of Table
    """
    measured = comparison.measures.get("products", {})
    names = [product.name for product in comparison.products if product.name in measured]
    measured = {name: measured[name] for name in names}
    made = [_models(measured), *(_residuals(measured, weighting) for weighting in WEIGHTINGS), _blocks(measured),
            _polarisation(measured), *(_regions(measured, *of) for of in REGION_TABLES), _truth(measured),
            _features(measured), _injected(measured, comparison.beams),
            _similarity(comparison.measures.get("similarity", {}))]
    return [table for table in made if table is not None]


def as_text(comparison: Comparison) -> str:
    """Return all tables of a comparison as text for a terminal.

    Parameters
    ----------
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.

    Returns
    -------
    str
    """
    parts = [_layout(table) for table in tables(comparison)]
    parts += [f"note: {note}" for note in comparison.notes]
    return "\n\n".join(parts) + "\n" if parts else "nothing was measured\n"


def _models(measured):
    columns = [
        ("flux_jy", "flux", "Jy"),
        ("peak_jy_per_pixel", "peak", "Jy/pixel"),
        ("negative_jy", "negative flux", "Jy"),
        ("mdr", "MDR", ""),
        ("fwhm_recovered_arcsec", "width of a point", "arcsec"),
    ]
    caption = "MDR: peak of the model over the brightest pixel outside of the source."
    if any("fwhm_recovered_arcsec" in entry for entry in measured.values()):
        caption += (" Width of a point: full width at half maximum, in the model, of the brightest unresolved source "
                    "that stands alone in the truth.")
    return build("Models", columns, measured, caption)


def _polarisation(measured):
    entries = {name: entry["polarisation"] for name, entry in measured.items() if "polarisation" in entry}
    columns = [
        ("peak_jy_per_beam", "peak", "Jy/beam"),
        ("intensity_jy", "intensity", "Jy"),
        ("fraction", "fraction of I", ""),
        ("snr", "SNR", "dB"),
        ("angle_rms_deg", "angle, rms", "deg"),
    ]
    return build("Polarisation", columns, entries, "Of models smoothed with the CLEAN beam: peak of sqrt(Q^2 + U^2); "
                 "its sum, and the fraction of Stokes I, where the reference is above ten times the noise of the "
                 "residual; SNR of Q + iU, and rms of the difference of the angles there. The reference is the truth, "
                 "where it has Q and U, else the first product that has.")


def _residuals(measured, weighting):
    entries = {name: entry[weighting] for name, entry in measured.items() if weighting in entry}
    columns = [
        ("sigma", "σ", "Jy/beam"),
        ("max_abs", "largest |r|", "Jy/beam"),
        ("peak", "peak restored", "Jy/beam"),
        ("dr", "DR", ""),
        ("skewness", "skewness", ""),
        ("kurtosis", "kurtosis", ""),
        ("whiteness", "whiteness", ""),
    ]
    caption = (
        "Residual images of all products made with one operator and the same weights. DR: peak of the restored image "
        "over σ, the standard deviation of the residual image."
    )
    return build(f"Residual and restored images, {weighting} weighting", columns, entries, caption)


def _blocks(measured):
    """χ² of the blocks: how many there are, and their median and extremes."""
    entries = {}
    for name, entry in measured.items():
        chi = np.atleast_1d(np.asarray(entry.get("natural", {}).get("chi_square", []), float))
        if chi.size:
            entries[name] = {"blocks": str(chi.size), "median": float(np.median(chi)), "least": float(chi.min()),
                             "most": float(chi.max())}
    columns = [("median", "median", ""), ("least", "least", ""), ("most", "most", ""), ("blocks", "blocks", "")]
    caption = (
        "Reduced chi-square of each block: the sum of w|r|² of its residual visibilities over twice their number. It "
        "is 1 where the residual is noise as given by the MS weights, and less where the model has fitted noise."
    )
    return build("χ² of the blocks", columns, entries, caption)


def _regions(measured, key, error, title, caption):
    """Flux in every region; `key` and `error` are those of the models, or of the restored images."""
    found = {
        name: {region: entry for region, entry in one.get("regions", {}).items() if key in entry}
        for name, one in measured.items()
    }
    regions = list(dict.fromkeys(region for entries in found.values() for region in entries))
    if not regions:
        return None
    rows = []
    for region in regions:
        entries = [one.get(region, {}) for one in found.values()]
        rows.append((region, *(_with_error(entry.get(key), entry.get(error)) for entry in entries)))
    return Table(title, ("", *measured), ("", *["Jy"] * len(measured)), tuple(rows), caption)


def _with_error(value, error) -> str:
    """Return a value and its error with two significant digits of the error."""
    if not (is_number(value) and is_number(error) and error > 0):
        return number(value)
    decimals = max(1 - int(np.floor(np.log10(error))), 0)
    return f"{fixed(value, decimals)} ± {fixed(error, decimals)}"


def _truth(measured):
    entries = {name: entry["truth"] for name, entry in measured.items() if entry.get("truth")}
    scales = sorted({scale for entry in entries.values() for scale in entry.get("snr_at_scale", {})}, key=float)
    flat = {
        name: {**entry, **{("scale", scale): value for scale, value in entry.get("snr_at_scale", {}).items()}}
        for name, entry in entries.items()
    }
    columns: list[tuple[Any, str, str]] = [
        ("snr", "SNR", "dB"), ("log_snr", "log SNR", "dB"), ("ssim", "SSIM", ""),
        ("ssim_range_jy_per_pixel", "its range", "Jy/pixel")]
    columns += [(("scale", scale), f'SNR at {float(scale):.3g}"', "dB") for scale in scales]
    caption = (
        "SNR: norm of the truth over that of the error. Log SNR: the same of the images on a logarithmic scale, where "
        "faint emission counts. SSIM, the structural similarity, 1 for equal images, of values within its range: 0 to "
        "the peak of the truth. SNR at a scale: both smoothed to that width."
    )
    return build("Against the truth", columns, flat, caption)


def _features(measured):
    """The tests of structures."""
    rows = {f"{name}, {feature}": test | {"mean": float(np.mean(test["drawn"])), "most": float(np.max(test["drawn"]))}
            for name, entry in measured.items() for feature, test in entry.get("features", {}).items()}
    if not rows:
        return None
    columns = [("flux_jy", "flux", "Jy"), ("delta_chi_square", "Δχ²", ""), ("mean", "Δχ² of draws, mean", ""),
               ("most", "largest", ""), ("p_value", "p-value", ""), ("sigma", "Gaussian", "σ")]
    caption = (
        "Δχ²: what the fit to the data loses when the model may have no emission in the region; the draws are of the "
        "model without it and new noise. The p-value is the probability of so large a Δχ² where nothing is, of the "
        "scaled χ² distribution of the draws; far beyond the largest of them it is an extrapolation."
    )
    return build("Is it real?", columns, rows, caption)


def _injected(measured, beams):
    """What became of injected sources; restored images have the width of the beam."""
    found = {f"{name}, {place}": source for name, entry in measured.items()
             for place, source in entry.get("injected", {}).items()}
    if not found:
        return None
    widths = {weighting: float(np.sqrt(beam[0] * beam[1])) for weighting, beam in beams.items()}
    rows = {
        name: {**source, "percent": 100 * source["flux_jy"] / source["injected_jy"], **source.get("fwhm_in_beams", {})}
        for name, source in found.items()
    }
    rows |= {f"restored images, {name} weighting": {"fwhm_arcsec": width}
             | {other: width / size for other, size in widths.items()} for name, width in widths.items()}
    columns = [("injected_jy", "injected", "Jy"), ("flux_jy", "recovered", "Jy"), ("percent", "recovered", "%"),
               ("offset_arcsec", "offset", "arcsec"), ("fwhm_arcsec", "width", "arcsec"),
               *((name, "width", f"{name} beams") for name in widths)]
    caption = (
        "Point sources put into the visibilities, which tsara then imaged without and with them. Measured is "
        f"the difference of the two models, in a circle of {number(min(widths.values()), 3)}″ (the finest beam's "
        "width) around the source. Width: of the circle that holds half of the flux, which is the full width at half "
        "maximum of a Gaussian. A restored image has the width of its beam by definition; other imagers were not run "
        "again, so the width of a point source in their models is not known."
    )
    return build("Injected point sources: resolution reached", columns, rows, caption)


def _similarity(similarity):
    found = {weighting: pairs for weighting, pairs in similarity.items() if pairs}
    if not found:
        return None
    pairs = list(dict.fromkeys(pair for entry in found.values() for pair in entry))
    rows = tuple((pair.replace("|", " and "), *(fixed(entry.get(pair), 1) for entry in found.values()))
                 for pair in pairs)
    caption = "S of two models smoothed with the CLEAN beam of each weighting: norm of the larger over the difference."
    heads = ("", *(f"S, {weighting} beam" for weighting in found))
    return Table("Similarity", heads, ("", *["dB"] * len(found)), rows, caption)


def _layout(table) -> str:
    """Return one table in columns, the first one to the left."""
    lines = [table.heads, *([table.units] if any(table.units) else []), *table.rows]
    widths = [max(len(cell) for cell in column) for column in zip(*lines)]
    text = ["  ".join([line[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:]))])
            for line in lines]
    return "\n".join([table.title, *("  " + line.rstrip() for line in text)])
