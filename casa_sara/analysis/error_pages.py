"""The pictures of errors in a report: error of the model, signal-to-noise ratio with islands, and features tested."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from casa_sara.analysis import metrics
from casa_sara.analysis.comparison import Comparison
from casa_sara.analysis.sheets import BRIGHTNESS_MAP, DIFFERENCE_MAP, Sheet, celestial, draw, draw_beam, plain, prefix

__all__ = ["error_maps", "features"]

DECADES = 4.0  # of a logarithmic scale
CONTOURS = (3.0, 5.0)
MOST_RATIO = 100.0  # at the end of the scale
NUMBERED = 12  # islands
SMALLEST, REACH = 8, 1.2  # half side of a picture of a feature, in pixels, and in sizes of its region


def error_maps(path: str | Path, comparison: Comparison, weighting: str) -> bool:
    """Draw model, error and S/N at the beam of a weighting, a row for each product with draws; tell if there are any.

    Parameters
    ----------
    path : str or Path
        Of the picture.
    comparison : casa_sara.analysis.comparison.Comparison
        Whose products may have draws.
    weighting : str
        Of the beam.

    Returns
    -------
    bool
    """
    products = [product for product in comparison.products if weighting in product.smoothed_error]
    if not products:
        return False
    cell, beam = comparison.cell_arcsec, comparison.beams[weighting]
    nx, ny = products[0].model.shape
    pixel = float(np.prod(cell))
    top = max(float(product.model.max()) for product in products) / pixel
    factor, sign = prefix(top)
    norm, ratios = LogNorm(top * factor * 10**-DECADES, top * factor), Normalize(0, MOST_RATIO**0.5)
    columns = ["model", "error of the model", f"S/N at the {weighting} beam"]
    sheet = Sheet([product.name for product in products], columns,
                  ny * cell[1] / (nx * cell[0]), celestial(comparison))
    for row, product in enumerate(products):
        for column, image in enumerate((product.model, product.model_error)):
            draw(sheet.panel(row, column), np.asarray(image) / pixel * factor, norm, cell)
        error = product.smoothed_error[weighting]
        found = metrics.smooth(product.model, beam[:2], beam[2], cell)
        ratio = np.divide(found, error, out=np.zeros_like(found), where=error > 1e-3 * error.max())
        panel = sheet.panel(row, 2)
        draw(panel, np.sqrt(np.clip(ratio, 0, None)), ratios, cell, "Greys")
        panel.contour(ratio.T, levels=CONTOURS, colors=("#0072B2", "#D55E00"), linewidths=0.7)
        draw_beam(panel, beam, cell, "black")
        for number, island in enumerate(_numbered(product, comparison), 1):
            panel.text(island["x"] + 2, island["y"] + 2, str(number), fontsize=8, color="#D55E00", clip_on=True)
    sheet.bar(0, 1, norm, BRIGHTNESS_MAP, f"{sign}Jy arcsec$^{{-2}}$")
    sheet.bar(2, 2, ratios, "Greys", "square root of S/N; contours at S/N 3 and 5")
    sheet.save(path)
    return True


def _numbered(product, comparison):
    """Return the islands to number: of the first product, whose pixels are those of the comparison."""
    if product is not comparison.products[0]:
        return []
    return (product.record.get("islands") or [])[:NUMBERED]


def features(path: str | Path, comparison: Comparison) -> bool:
    """Draw the models with and without emission in each region that was tested; tell whether there was any.

    Parameters
    ----------
    path : str or Path
        Of the picture.
    comparison : casa_sara.analysis.comparison.Comparison
        Whose products may have features.

    Returns
    -------
    bool
    """
    rows = [(f"{product.name}, {name}: {test[0]['sigma']:.2g} σ, p = {test[0]['p_value']:.2g}", *test[1:])
            for product in comparison.products for name, test in product.features.items()]
    if not rows:
        return False
    cell, pixel = comparison.cell_arcsec, float(np.prod(comparison.cell_arcsec))
    top = max(float(with_.max()) for _, with_, _, _ in rows) / pixel
    factor, sign = prefix(top)
    norm = LogNorm(top * factor * 10**-DECADES, top * factor)
    sheet = Sheet([row[0] for row in rows], ["with", "without", "without − with"], 1.0, widest=2.75)
    for row, (_, with_, without, mask) in enumerate(rows):
        change, box = (without - with_) / pixel, _around(mask)
        reach = float(np.abs(change[box]).max()) or 1.0
        own, own_sign = prefix(reach)
        for column, image in enumerate((with_ / pixel * factor, without / pixel * factor, change * own)):
            panel = sheet.panel(row, column)
            draw(panel, image[box], Normalize(-reach * own, reach * own) if column == 2 else norm, cell,
                 DIFFERENCE_MAP if column == 2 else BRIGHTNESS_MAP)
            panel.contour(mask[box].T, levels=[0.5], colors="#56B4E9", linewidths=0.8)
        panel.set_xlabel(plain(f"±{reach * own:.3g} {own_sign}Jy arcsec⁻²"), fontsize=8)
    sheet.bar(0, 1, norm, BRIGHTNESS_MAP, f"{sign}Jy arcsec$^{{-2}}$")
    sheet.save(path)
    return True


def _around(mask):
    """Return the part of an image around a region, as slices: a square, as far as the image goes."""
    places = np.argwhere(mask)
    centre, size = places.mean(axis=0), float(np.ptp(places, axis=0).max()) + 1
    half = max(SMALLEST, int(REACH * size))
    return tuple(slice(max(int(middle) - half, 0), int(middle) + half + 1) for middle in centre)
