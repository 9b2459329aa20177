"""The pictures of the sky in a report: all products on one stretch, enlarged parts, differences.

Models (Jy/pixel) and restored images (Jy/beam) are shown as brightness, per arcsec², so that one logarithmic scale
serves all of them; residuals, per beam, have a scale of their own.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord
from matplotlib.colors import LogNorm, Normalize

from casa_sara.analysis import metrics
from casa_sara.analysis.comparison import Comparison
from casa_sara.analysis.sheets import (
    BRIGHTNESS_MAP,
    DIFFERENCE_MAP,
    Sheet,
    beam_area,
    celestial,
    draw,
    draw_beam,
    outline,
    plain,
    prefix,
)
from casa_sara.analysis.zooms import find_zooms, reference

__all__ = ["differences", "overview", "smoothed", "zoomed"]

DECADES = 2.5, 4.5  # the least and the most of a logarithmic scale
PERCENTILE = 99.8  # of the differences, at the ends of their scale


def smoothed(comparison: Comparison, image: np.ndarray, weighting: str) -> np.ndarray:
    """Return an image in Jy/pixel convolved with the CLEAN beam of a weighting, still in Jy/pixel.

    Parameters
    ----------
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.
    image : array_like (nx, ny)
        Jy/pixel.
    weighting : str
        'natural' or 'briggs'.

    Returns
    -------
    float64 (nx, ny)
    """
    major, minor, angle = _in_pixels(comparison.beams[weighting], comparison.cell_arcsec)
    return metrics.smooth(np.nan_to_num(image), (major, minor), angle)


def _in_pixels(beam, cell) -> tuple[float, float, float]:
    """Return major and minor axis in pixels, and position angle on a grid drawn with square pixels."""
    sin, cos = np.sin(np.deg2rad(beam[2])), np.cos(np.deg2rad(beam[2]))
    axes = np.array([[beam[0] * sin, beam[1] * cos], [beam[0] * cos, -beam[1] * sin]]) / np.reshape(cell, (2, 1))
    squares, directions = np.linalg.eigh(axes @ axes.T)  # rows: east, north
    return float(np.sqrt(squares[1])), float(np.sqrt(squares[0])), float(np.rad2deg(np.arctan2(*directions[:, 1])))


def overview(path: str | Path, comparison: Comparison, weighting: str | None = None) -> None:
    """Draw models, smoothed models, restored and residual images, a row for the truth and for each product.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.
    weighting : str, optional
        Of the beam, the restored and the residual images; without it, models only.
    """
    columns = _columns(comparison, weighting)
    norm, factor, unit = _brightness(comparison)
    rows = _rows(comparison)
    nx, ny = comparison.products[0].model.shape
    cell, zooms = comparison.cell_arcsec, find_zooms(comparison)
    sheet = Sheet([row[0] for row in rows], columns, ny * cell[1] / (nx * cell[0]), celestial(comparison))
    noise, per_beam, noise_unit = _noise(comparison, weighting)
    for column, kind in enumerate(columns):
        images = [_image(comparison, model, product, kind, weighting) for _, model, product in rows]
        there = [row for row, image in enumerate(images) if image is not None]
        residual = kind == "residual"
        for row in there:
            panel = sheet.panel(row, column, row == there[-1])
            draw(panel, images[row] * (per_beam if residual else factor), noise if residual else norm, cell,
                 DIFFERENCE_MAP if residual else BRIGHTNESS_MAP)
            if kind == "model":
                for zoom in zooms:
                    outline(panel, zoom.box)
            elif weighting:
                draw_beam(panel, comparison.beams[weighting], cell, "black" if residual else "white")
    last = len(columns) - ("residual" in columns) - 1
    sheet.bar(0, last, norm, BRIGHTNESS_MAP, unit)
    if "residual" in columns:
        sheet.bar(last + 1, last + 1, noise, DIFFERENCE_MAP, noise_unit)
    sheet.save(path)


def zoomed(path: str | Path, comparison: Comparison) -> bool:
    """Draw enlarged parts of the models, a row for the truth and for each product; tell whether there were any.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.

    Returns
    -------
    bool
    """
    zooms, cell = find_zooms(comparison), comparison.cell_arcsec
    if not zooms:
        return False
    wcs, columns = celestial(comparison), []
    for zoom in zooms:
        x0, x1, y0, y1 = zoom.box
        centre = SkyCoord(*wcs.wcs_pix2world((x0 + x1 - 1) / 2, (y0 + y1 - 1) / 2, 0), unit="deg")
        columns.append(centre.to_string("hmsdms", precision=1, format="unicode"))
    rows = _rows(comparison)
    norm, factor, unit = _brightness(comparison)
    sheet = Sheet([row[0] for row in rows], columns, 1.0, widest=2.75)
    for row, (_, model, _) in enumerate(rows):
        for column, zoom in enumerate(zooms):
            panel = sheet.panel(row, column)
            draw(panel, model / np.prod(cell) * factor, norm, cell)
            _cut(panel, zoom, cell)
            if comparison.beams:
                draw_beam(panel, min(comparison.beams.values(), key=beam_area), cell, right=True)
    sheet.bar(0, len(zooms) - 1, norm, BRIGHTNESS_MAP, unit)
    sheet.save(path)
    return True


def differences(path: str | Path, comparison: Comparison) -> bool:
    """Draw each product minus the truth, or minus the first product; tell whether there was anything to subtract.

    The models as they are and smoothed with each beam; every column has a linear scale of its own.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.

    Returns
    -------
    bool
    """
    products = list(comparison.products)
    if comparison.truth is None:
        first, products = products[0], products[1:]
        name, model = first.name, first.model
    else:
        name, model = "truth", comparison.truth
    if not products:
        return False
    cell, (nx, ny) = comparison.cell_arcsec, model.shape
    columns = ["models", *(f"smoothed, {weighting} beam" for weighting in comparison.beams)]
    sheet = Sheet([f"{product.name} − {name}" for product in products], columns, ny * cell[1] / (nx * cell[0]),
                  celestial(comparison))
    for column, weighting in enumerate([None, *comparison.beams]):
        images = [product.model - model for product in products]
        if weighting:
            images = [smoothed(comparison, image, weighting) for image in images]
        images = [image / np.prod(cell) for image in images]
        reach = max(np.nanpercentile(np.abs(image), PERCENTILE) for image in images)
        factor, sign = prefix(reach) if reach > 0 else (1.0, "")
        norm = Normalize(-(reach * factor or 1), reach * factor or 1)
        for row, image in enumerate(images):
            panel = sheet.panel(row, column)
            draw(panel, image * factor, norm, cell, DIFFERENCE_MAP)
            if weighting:
                draw_beam(panel, comparison.beams[weighting], cell, "black")
        sheet.bar(column, column, norm, DIFFERENCE_MAP, f"{sign}Jy arcsec$^{{-2}}$")
    sheet.save(path)
    return True


def _rows(comparison) -> list[tuple]:
    """Return (name, model, product or None) of the truth and of every product."""
    found = [(product.name, product.model, product) for product in comparison.products]
    return found if comparison.truth is None else [("truth", comparison.truth, None), *found]


def _columns(comparison, weighting) -> list[str]:
    """Return the kinds of images that there are."""
    columns = ["model"]
    if weighting in comparison.beams:
        columns.append("smoothed model")
        columns += [kind for kind in ("restored", "residual")
                    if any(weighting in getattr(product, kind) for product in comparison.products)]
    return columns


def _image(comparison, model, product, kind, weighting):
    """Return one image in Jy/arcsec² (a residual in Jy/beam), or None."""
    pixel = np.prod(comparison.cell_arcsec)
    if kind == "model":
        return model / pixel
    if kind == "smoothed model":
        return smoothed(comparison, model, weighting) / pixel
    image = getattr(product, kind).get(weighting) if product else None
    if image is None or kind == "residual":
        return image
    return image / beam_area(comparison.beams[weighting])


def _brightness(comparison) -> tuple[LogNorm, float, str]:
    """Return the scale of brightness, the factor from Jy/arcsec² to its unit, and the unit.

    It ends at the peak of the reference and begins at the lowest noise of the restored images.
    """
    peak = float(np.nanmax(reference(comparison))) / np.prod(comparison.cell_arcsec)
    peak = peak if peak > 0 else 1.0
    noise = [
        np.nanstd(image) / beam_area(comparison.beams[weighting])
        for product in comparison.products
        for weighting, image in product.residual.items()
        if weighting in comparison.beams
    ]
    floor = np.clip(min(noise, default=0), peak / 10 ** DECADES[1], peak / 10 ** DECADES[0])
    factor, sign = prefix(peak)
    return LogNorm(floor * factor, peak * factor), factor, f"brightness, {sign}Jy arcsec$^{{-2}}$"


def _noise(comparison, weighting) -> tuple[Normalize, float, str]:
    """Return the scale of the residuals, the factor from Jy/beam to its unit, and the unit."""
    found = [np.nanstd(product.residual[weighting]) for product in comparison.products
             if weighting in product.residual]
    rms = float(np.median(found)) if found else 0.0
    if not rms > 0:
        return Normalize(-1, 1), 1.0, "Jy beam$^{-1}$"
    factor, sign = prefix(4 * rms)
    return Normalize(-4 * rms * factor, 4 * rms * factor), factor, f"{sign}Jy beam$^{{-1}}$"


def _cut(panel, zoom, cell) -> None:
    """Cut a panel to a zoom; give it its name and a scale bar."""
    x0, x1, y0, y1 = zoom.box
    panel.set(xlim=(x0 - 0.5, x1 - 0.5), ylim=(y0 - 0.5, y1 - 0.5))
    panel.text(0.04, 0.95, plain(zoom.name), color="white", va="top", transform=panel.transAxes,
               fontsize=9.5)
    half = (x1 - x0) * cell[0] / 2
    unit = 10.0 ** np.floor(np.log10(half))
    length = unit * max(factor for factor in (1, 2, 5) if factor * unit <= half)
    start, height = x0 + 0.06 * (x1 - x0), y0 + 0.06 * (y1 - y0)
    panel.plot([start, start + length / cell[0]], [height] * 2, color="white", lw=1.8)
    panel.text(start, height + 0.02 * (y1 - y0), f'{length:g}"', color="white", va="bottom", fontsize=9.5)
