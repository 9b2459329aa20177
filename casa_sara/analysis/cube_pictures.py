"""The pictures of cubes: spectrum, line maps, channel maps, and the noise of every channel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import AsinhNorm, Normalize
from PIL import Image

from casa_sara.analysis.cube_comparison import CubeComparison, CubeProduct
from casa_sara.analysis.diagnostics import legend, new_figure
from casa_sara.analysis.sheets import (
    BRIGHTNESS_MAP,
    DIFFERENCE_MAP,
    DPI,
    Sheet,
    celestial,
    draw,
    draw_beam,
    line,
    plain,
    prefix,
)

__all__ = ["channel_maps", "line_maps", "noise", "spectrum"]

VELOCITY_MAP = "turbo"
SIDE_BY_SIDE = 6  # channels in a row
TEXT = {"fontsize": 10.5}
PERCENTILE = 99.8  # of the absolute differences, at the ends of their scale


def spectrum(path: str | Path, comparison: CubeComparison) -> None:
    """Draw the flux of the models by channel: of the whole image, and of each region.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : CubeComparison
        The products and what was measured.
    """
    channels = comparison.measures["channels"]
    regions = list(dict.fromkeys(region for channel in channels for entry in channel.get("products", {}).values()
                                 for region in entry["regions"]))
    columns = min(2, 1 + len(regions))
    figure, axes = new_figure(-(-(1 + len(regions)) // columns), columns, 3.6, 11.5 / columns)
    for panel, region in zip(axes.flat, [None, *regions]):
        keys = ("flux_jy",) if region is None else ("regions", region, "model_flux_jy")
        for number, product in enumerate(comparison.products):
            panel.plot(comparison.values, comparison.measured(product.name, *keys), drawstyle="steps-mid", lw=1.6,
                       label=plain(product.name), **line(number))
        panel.axhline(0, color="0.5", lw=0.8)
        panel.set_title(plain(region or "whole image"), **TEXT)
        panel.set_ylabel("flux of the model [Jy]", **TEXT)
        panel.set_xlabel(_axis(comparison), **TEXT)
    for panel in axes.flat[1 + len(regions):]:
        panel.set_axis_off()
    legend(figure, axes.flat[0].get_legend_handles_labels()[0])
    figure.savefig(path)


def noise(path: str | Path, comparison: CubeComparison) -> bool:
    """Draw σ and the largest residual of every channel; tell whether there are residuals.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : CubeComparison
        The products and what was measured.

    Returns
    -------
    bool
    """
    weightings = [weighting for weighting in ("natural", "briggs")
                  if any(np.isfinite(comparison.measured(product.name, weighting, "sigma")).any()
                         for product in comparison.products)]
    if not weightings:
        return False
    figure, axes = new_figure(1, len(weightings), 3.8, 11.5 / len(weightings))
    for panel, weighting in zip(axes[0], weightings):
        levels = [[comparison.measured(product.name, weighting, key) for key in ("sigma", "max_abs")]
                  for product in comparison.products]
        factor, sign = prefix(float(np.nanmin([sigma[sigma > 0].min() for sigma, _ in levels if np.any(sigma > 0)])))
        for number, (product, (sigma, largest)) in enumerate(zip(comparison.products, levels)):
            style = {"color": line(number)["color"], "drawstyle": "steps-mid"}
            panel.plot(comparison.values, sigma * factor, lw=1.6, label=f"{plain(product.name)}: σ", **style)
            panel.plot(comparison.values, largest * factor, lw=1.0, ls=":", label=f"{plain(product.name)}: largest |r|",
                       **style)
        panel.set_ylim(bottom=0)
        panel.set_title(f"residuals, {weighting}", **TEXT)
        panel.set_ylabel(f"{sign}Jy beam$^{{-1}}$", **TEXT)
        panel.set_xlabel(_axis(comparison), **TEXT)
    legend(figure, [handle for panel in axes.flat for handle in panel.get_legend_handles_labels()[0]])
    figure.savefig(path)
    return True


def line_maps(path: str | Path, comparison: CubeComparison) -> None:
    """Draw moment 0 of models and restored images, and moment 1, a row for each product, and their differences.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : CubeComparison
        The products and what was measured.
    """
    products, cell = comparison.products, comparison.cell_arcsec
    nx, ny = products[0].model.shape
    pairs = [(product, products[0]) for product in products[1:]]
    rows = [product.name for product in products] + [f"{one.name} − {other.name}" for one, other in pairs]
    restored = any(product.moment0.any() for product in products)
    columns = ["model, moment 0"] + ["restored, moment 0", "moment 1"] * restored
    sheet = Sheet(rows, columns, ny * cell[1] / (nx * cell[0]), celestial(comparison))
    for column, kind in enumerate(("model", "moment0", "moment1")[: len(columns)]):
        images = [getattr(product, kind) for product in products]
        differences = [getattr(one, kind) - getattr(other, kind) for one, other in pairs]
        norm, factor, unit = _scale(kind, images, comparison)
        for row, image in enumerate(images):
            panel = sheet.panel(row, column)
            draw(panel, image * factor, norm, cell, VELOCITY_MAP if kind == "moment1" else BRIGHTNESS_MAP)
            if kind == "moment0" and comparison.beams:
                draw_beam(panel, comparison.beams[comparison.weighting], cell)
        for row, image in enumerate(differences, len(images)):
            reach = float(np.nanpercentile(np.abs(image), PERCENTILE)) if np.isfinite(image).any() else 0.0
            panel = sheet.panel(row, column)
            draw(panel, image, Normalize(-(reach or 1), reach or 1), cell, DIFFERENCE_MAP)
            panel.text(0.04, 0.95, f"± {reach * factor:.3g} {unit}", va="top", transform=panel.transAxes, fontsize=9)
        sheet.bar(column, column, norm, VELOCITY_MAP if kind == "moment1" else BRIGHTNESS_MAP, unit)
    sheet.save(path)


def channel_maps(path: str | Path, comparison: CubeComparison, product: CubeProduct, kind: str) -> bool:
    """Draw the channels of a product side by side; tell whether there were any.

    Parameters
    ----------
    path : str or Path
        File to write.
    comparison : CubeComparison
        The products and what was measured; all have one scale.
    product : CubeProduct
        The one to draw.
    kind : str
        'restored' or 'residual'.

    Returns
    -------
    bool
    """
    images = getattr(product, kind)
    if not images:
        return False
    sigma = float(np.median([np.std(image) for one in comparison.products for image in one.residual.values()]))
    peak = max(float(image.max()) for one in comparison.products for image in one.restored.values())
    factor, sign = prefix(4 * sigma)
    norm, colours = _channel_norm(kind, sigma * factor, peak * factor)
    cell, (nx, ny) = comparison.cell_arcsec, product.model.shape
    columns = min(SIDE_BY_SIDE, len(images))
    sheet = Sheet([""] * -(-len(images) // columns), [""] * columns, ny * cell[1] / (nx * cell[0]))
    for place, number in enumerate(sorted(images)):
        panel = sheet.panel(*divmod(place, columns))
        draw(panel, images[number] * factor, norm, cell, colours)
        panel.set_title(f"{number}: {comparison.values[number]:.6g} {comparison.unit}", fontsize=9, pad=3)
        if not place and comparison.beams:
            draw_beam(panel, comparison.beams[comparison.weighting], cell, "white" if kind == "restored" else "black")
    sheet.bar(0, columns - 1, norm, colours, f"{sign}Jy beam$^{{-1}}$")
    sheet.save(path)
    with Image.open(path) as picture:  # of noise, which does not compress: a third of the size with 256 colours
        few = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE)
    few.save(path, dpi=(DPI, DPI))
    return True


def _channel_norm(kind: str, sigma: float, peak: float) -> tuple[Normalize, str]:
    """Return the scale of channel maps, and its colours."""
    sigma = sigma or 1.0
    if kind == "residual":
        return Normalize(-4 * sigma, 4 * sigma), DIFFERENCE_MAP
    return AsinhNorm(3 * sigma, vmin=-2 * sigma, vmax=max(peak, 3 * sigma)), BRIGHTNESS_MAP


def _scale(kind: str, images: Sequence[np.ndarray], comparison: CubeComparison) -> tuple[Normalize, float, str]:
    """Return the scale of a line map, the factor to its unit, and the unit."""
    if kind == "moment1":
        seen = np.concatenate([image[np.isfinite(image)] for image in images])
        low, high = (float(seen.min()), float(seen.max())) if seen.size else (0.0, 1.0)
        return Normalize(low, high if high > low else low + 1), 1.0, comparison.unit
    peak = max(float(image.max()) for image in images)
    factor, sign = prefix(peak) if peak > 0 else (1.0, "")
    per = "pixel" if kind == "model" else "beam"
    top = peak * factor or 1.0
    return Normalize(min(0.0, -0.05 * top), top), factor, f"{sign}Jy {per}$^{{-1}}$ {comparison.unit}"


def _axis(comparison: CubeComparison) -> str:
    """Return the label of the spectral axis."""
    return f"{'radio velocity' if comparison.unit == 'km/s' else 'frequency'}, {comparison.frame} [{comparison.unit}]"
