"""The measures of a comparison as tables, for a page or for a terminal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casa_sara.analysis.sheets import prefix

__all__ = ["Table", "as_text", "number", "tables"]

NOTHING = "–"
WEIGHTINGS = ("natural", "briggs")


@dataclass(frozen=True)
class Table:
    """A table of text: title, heads of the columns, their units, rows (the first cell names the row), explanation."""

    title: str
    heads: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


def number(value, digits: int = 4) -> str:
    """Return a number with some significant digits; a dash for what there is not, ∞ for infinity."""
    if value is None or isinstance(value, float) and np.isnan(value):
        return NOTHING
    if not isinstance(value, (int, float, np.number)):
        return str(value)
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value != 0 and not 1e-3 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(exponent)}".replace("-", "−")
    decimals = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0) if value != 0 else 0
    return f"{value:,.{decimals}f}".replace("-", "−")


REGION_TABLES = (
    ("model_flux_jy", "Regions, flux of the models", "Sum of the model within each region."),
    ("flux_jy", "Regions, flux of the restored images",
     "Within each region; a region smaller than the beam holds a part of its source. The error is that of the noise."),
)


def tables(comparison) -> list[Table]:
    """Return the tables for which there are measures.

    Parameters
    ----------
    comparison : casa_sara.analysis.comparison.Comparison
    """
    measured = comparison.measures.get("products", {})
    names = [product.name for product in comparison.products if product.name in measured]
    measured = {name: measured[name] for name in names}
    made = [_models(measured), *(_residuals(measured, weighting) for weighting in WEIGHTINGS), _blocks(measured),
            *(_regions(measured, *of) for of in REGION_TABLES), _truth(measured),
            _similarity(comparison.measures.get("similarity", {}))]
    return [table for table in made if table is not None]


def as_text(comparison) -> str:
    """Return all tables of a comparison as text for a terminal."""
    parts = [_layout(table) for table in tables(comparison)]
    parts += [f"note: {note}" for note in comparison.notes]
    return "\n\n".join(parts) + "\n" if parts else "nothing was measured\n"


def _build(title, columns, measured, caption="") -> Table | None:
    """Make a table of products from columns (key, head, unit), leaving out what no product has."""
    columns = [column for column in columns if any(column[0] in entry for entry in measured.values())]
    if not columns:
        return None
    values = [[entry.get(key) for entry in measured.values()] for key, _, _ in columns]
    scales = {unit: _scale([column for column, (_, _, its) in zip(values, columns) if its == unit])
              for _, _, unit in columns if unit.startswith("Jy")}
    units, texts = zip(*(_column(column, unit, scales) for column, (_, _, unit) in zip(values, columns)))
    rows = tuple((name, *cells) for name, *cells in zip(measured, *texts))
    return Table(title, ("", *(head for _, head, _ in columns)), ("", *units), rows, caption)


def _scale(columns) -> tuple[float, str]:
    """Return factor and prefix for columns of one unit; the fainter ones may be below 1."""
    peaks = [max((abs(value) for value in column if _is_number(value)), default=0) for column in columns]
    peaks = [peak for peak in peaks if peak > 0]
    return prefix(10 * min(peaks)) if peaks else (1.0, "")


def _column(values, unit, scales) -> tuple[str, list[str]]:
    """Return the unit of a column and its numbers in that unit, with one number of decimals where that says enough."""
    factor, sign = scales.get(unit, (1.0, ""))
    finite = [abs(float(value)) for value in values if _is_number(value) and value != 0]
    if not finite:
        return sign + unit, [number(value) for value in values]
    if unit == "dB":
        return unit, [_fixed(value, 1) for value in values]
    values = [value * factor if _is_number(value) else value for value in values]
    largest, least = max(finite) * factor, min(finite) * factor
    decimals = max(3 - int(np.floor(np.log10(largest))), 0)
    if not unit:  # ratios and moments
        decimals = min(decimals, 0 if largest >= 100 else 1 if largest >= 10 else 3)
    if largest >= 1e7 or least < 2 * 10.0**-decimals:
        return sign + unit, [number(value, 3) for value in values]
    return sign + unit, [_fixed(value, decimals) for value in values]


def _is_number(value) -> bool:
    return isinstance(value, (int, float, np.number)) and bool(np.isfinite(value))


def _fixed(value, decimals) -> str:
    return f"{value:,.{decimals}f}".replace("-", "−") if _is_number(value) else number(value)


def _models(measured):
    columns = [
        ("flux_jy", "flux", "Jy"),
        ("peak_jy_per_pixel", "peak", "Jy/pixel"),
        ("negative_jy", "negative flux", "Jy"),
        ("mdr", "MDR", ""),
        ("fwhm_recovered_arcsec", "width of a point", "arcsec"),
    ]
    caption = (
        "MDR: peak of the model over the brightest pixel outside of the source. Width of a point: full width at half "
        "maximum, in the model, of the brightest unresolved source that stands alone in the truth."
    )
    return _build("Models", columns, measured, caption)


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
    return _build(f"Residual and restored images, {weighting} weighting", columns, entries, caption)


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
        "Of each block, the sum of w|r|² of its residual visibilities over twice their number: 1 where the model leaves "
        "noise as the weights say, less where it has fitted noise."
    )
    return _build("χ² of the blocks", columns, entries, caption)


def _regions(measured, key, title, caption):
    """Flux in every region; `key` is that of the models, or of the restored images with its error."""
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
        error = "error_jy" if key == "flux_jy" else ""
        rows.append((region, *(_with_error(entry.get(key), entry.get(error)) for entry in entries)))
    return Table(title, ("", *measured), ("", *["Jy"] * len(measured)), tuple(rows), caption)


def _with_error(value, error) -> str:
    """Return a value and its error with two significant digits of the error."""
    if not (_is_number(value) and _is_number(error) and error > 0):
        return number(value)
    decimals = max(1 - int(np.floor(np.log10(error))), 0)
    return f"{_fixed(value, decimals)} ± {_fixed(error, decimals)}"


def _truth(measured):
    entries = {name: entry["truth"] for name, entry in measured.items() if entry.get("truth")}
    scales = sorted({scale for entry in entries.values() for scale in entry.get("snr_at_scale", {})}, key=float)
    flat = {
        name: {**entry, **{("scale", scale): value for scale, value in entry.get("snr_at_scale", {}).items()}}
        for name, entry in entries.items()
    }
    columns = [("snr", "SNR", "dB"), ("log_snr", "log SNR", "dB"), ("ssim", "SSIM", ""),
               ("ssim_range_jy_per_pixel", "its range", "Jy/pixel")]
    columns += [(("scale", scale), f'SNR at {float(scale):.3g}"', "dB") for scale in scales]
    caption = (
        "SNR: norm of the truth over that of the error. Log SNR: the same of the images on a logarithmic scale, where "
        "faint emission counts. SSIM, the structural similarity, 1 for equal images, of values within its range: 0 to "
        "the peak of the truth. SNR at a scale: both smoothed to that width."
    )
    return _build("Against the truth", columns, flat, caption)


def _similarity(similarity):
    found = {weighting: pairs for weighting, pairs in similarity.items() if pairs}
    if not found:
        return None
    pairs = list(dict.fromkeys(pair for entry in found.values() for pair in entry))
    rows = tuple((pair.replace("|", " and "), *(_fixed(entry.get(pair), 1) for entry in found.values()))
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
