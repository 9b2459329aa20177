"""Spectra and histograms: how far an image resolves, and whether its residuals look like noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from scipy.signal.windows import tukey

from casa_sara.analysis.comparison import Comparison
from casa_sara.analysis.sheets import DPI, line, plain

__all__ = ["histograms", "legend", "new_figure", "radial_spectrum", "spectra"]

ARCSEC = np.pi / 180 / 3600
TEXT, SMALL = {"fontsize": 10.5}, 9.5
WEIGHTINGS = ("natural", "briggs")
REACH = 8.0  # of a histogram, in standard deviations


def new_figure(rows: int, columns: int, height: float, width: float = 7.0, **options: Any) -> tuple[Figure, np.ndarray]:
    """Return a figure, 11.5 inches wide at most, and its axes (rows, columns); `height` inches for each row.

    Parameters
    ----------
    rows : int
        Number of rows of panels.
    columns : int
        Number of columns of panels.
    height : float
        Of a row, inches.
    width : float
        Of a column, inches.
    **options : object
        Options of matplotlib's subplots.

    Returns
    -------
    figure : matplotlib Figure
    axes : array of matplotlib Axes (rows, columns)
    """
    size = min(11.5, width * columns), rows * height
    figure = Figure(figsize=size, dpi=DPI, facecolor="white", layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for panel in axes.flat:
        panel.tick_params(labelsize=SMALL)
        panel.grid(True, color="0.9", lw=0.6)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
    return figure, axes


def legend(figure: Figure, handles: Sequence[Artist]) -> None:
    """Put one legend for all panels below them; handles of one label appear once.

    Parameters
    ----------
    figure : matplotlib Figure
        The figure.
    handles : sequence of matplotlib artists
        What has been drawn, with labels.
    """
    unique = {handle.get_label(): handle for handle in handles}
    columns = max(1, min(len(unique), 130 // (max(map(len, unique)) + 8)))
    figure.legend(handles=list(unique.values()), loc="outside lower center", ncols=columns, fontsize=SMALL,
                  frameon=False)


def radial_spectrum(image: npt.ArrayLike, cell_arcsec: tuple[float, float],
                    window: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the power of an image averaged over rings of the Fourier plane.

    Parameters
    ----------
    image : array_like (nx, ny)
        Blank pixels count as zero.
    cell_arcsec : (float, float)
        Pixel size along x and y in arcsec.
    window : bool
        Taper the outer tenth, for images that do not fade out towards their edge. The power is that of the
        image without the taper, if it looks the same all over.

    Returns
    -------
    frequency : float64 (n,)
        Middle of each ring in wavelengths.
    power : float64 (n,)
        Mean |Σ image e^(2πi…)|², in the square of the image's unit; of white noise σ² nx ny.
    """
    image = np.nan_to_num(np.asarray(image, float))
    nx, ny = image.shape
    if window:
        taper = tukey(nx, 0.2)[:, None] * tukey(ny, 0.2)[None, :]
        image = image * taper / np.sqrt(np.mean(taper**2))
    u, v = np.fft.fftfreq(nx, cell_arcsec[0] * ARCSEC)[:, None], np.fft.rfftfreq(ny, cell_arcsec[1] * ARCSEC)[None, :]
    radius = np.hypot(u, v)
    power = np.abs(np.fft.rfft2(image)) ** 2
    count = np.full(power.shape, 2.0)  # the half of the plane that rfft2 leaves out
    count[:, [0] + ([-1] if ny % 2 == 0 else [])] = 1.0
    width = 1.0 / (max(nx * cell_arcsec[0], ny * cell_arcsec[1]) * ARCSEC)
    ring = np.rint(radius / width).astype(int)
    ring[radius > 0.5 / (max(cell_arcsec) * ARCSEC)] = -1  # corners, which only some directions reach
    inside = ring >= 0
    weight = np.bincount(ring[inside], count[inside])
    mean = np.bincount(ring[inside], (count * power)[inside]) / np.maximum(weight, 1)
    filled = weight > 0
    return np.flatnonzero(filled) * width, mean[filled]


def spectra(path: str | Path, comparison: Comparison) -> bool:
    """Draw the amplitude of the models against spatial frequency, and the power of each kind of residuals.

    Tell whether anything was there to draw.

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
    images = [(product.name, product.model, line(number)) for number, product in enumerate(comparison.products)]
    if comparison.truth is not None:
        images.insert(0, ("truth", comparison.truth, {"color": "0.35", "ls": ":"}))
    images = [image for image in images if np.any(np.nan_to_num(image[1]))]
    if not images:
        return False
    weightings = [w for w in WEIGHTINGS if any(_has_noise(product, w) for product in comparison.products)]
    figure, axes = new_figure(1, 1 + len(weightings), 4.4)
    _model_spectra(axes[0, 0], images, comparison.cell_arcsec)
    for panel, weighting in zip(axes[0, 1:], weightings):
        _residual_spectra(panel, comparison, weighting)
    for panel in axes.flat:
        for weighting, beam in comparison.beams.items():
            edge = 1 / (np.sqrt(beam[0] * beam[1]) * ARCSEC) / 1e3
            panel.axvline(edge, color="0.6", lw=1, ls="-." if weighting == "natural" else "-")
        panel.set(xscale="log", yscale="log")
        panel.set_xlabel("spatial frequency [kλ]", **TEXT)
        panel.yaxis.label.set_size(10.5)
    legend(figure, [handle for panel in axes.flat for handle in panel.get_legend_handles_labels()[0]])
    figure.savefig(path)
    return True


def _model_spectra(panel, images, cell) -> None:
    """Draw spectra of models over no more than seven decades."""
    lowest, highest = np.inf, 0.0
    for name, image, style in images:
        frequency, power = radial_spectrum(image, cell)
        amplitude = np.sqrt(power)
        panel.plot(frequency[1:] / 1e3, amplitude[1:], lw=1.6, label=plain(name), **style)
        lowest, highest = min(lowest, amplitude[1:].min()), max(highest, amplitude.max())
    panel.set_ylim(max(lowest, 1e-7 * highest) / 1.5, 2 * highest)
    panel.set_ylabel("mean amplitude [Jy]")
    panel.set_title("models", **TEXT)


def _residual_spectra(panel, comparison, weighting) -> None:
    """Draw spectra of residuals over no more than seven decades."""
    lowest, highest = np.inf, 1.0
    for number, product in enumerate(comparison.products):
        if not _has_noise(product, weighting):
            continue
        residual = product.residual[weighting]
        frequency, power = radial_spectrum(residual, comparison.cell_arcsec, window=True)
        power /= np.nanvar(residual) * np.isfinite(residual).sum()
        panel.plot(frequency[1:] / 1e3, power[1:], lw=1.4, label=plain(product.name), **line(number))
        lowest, highest = min(lowest, power[1:].min()), max(highest, power.max())
    panel.axhline(1, color="0.3", ls="--", lw=1)
    panel.set_ylim(max(lowest, 1e-7 * highest) / 1.5, 2 * highest)
    panel.set_ylabel("power over that of white noise")
    panel.set_title(f"residuals, {weighting}", **TEXT)


def _has_noise(product, weighting) -> bool:
    """Tell whether there is a residual image that is not constant."""
    return weighting in product.residual and np.nanstd(product.residual[weighting]) > 0


def histograms(path: str | Path, comparison: Comparison) -> bool:
    """Draw the histograms of the residuals against the Gaussian; tell whether there are residuals.

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
    weightings = [w for w in WEIGHTINGS if any(_has_noise(product, w) for product in comparison.products)]
    if not weightings:
        return False
    figure, axes = new_figure(1, len(weightings), 4.2, sharey=True)
    edges = np.linspace(-REACH, REACH, 81)
    middle, width = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    for panel, weighting in zip(axes[0], weightings):
        smallest = np.inf
        for number, product in enumerate(comparison.products):
            if not _has_noise(product, weighting):
                continue
            values = product.residual[weighting]
            values = values[np.isfinite(values)]
            scaled = (values - values.mean()) / values.std()
            counts = np.histogram(np.clip(scaled, -REACH, REACH), edges)[0] / (width * values.size)
            smallest = min(smallest, 1 / (width * values.size))
            panel.stairs(np.where(counts > 0, counts, np.nan), edges, lw=1.6, label=plain(product.name),
                         **line(number))
        panel.plot(middle, np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi), color="0.25", ls="--", lw=1.2,
                   label="Gaussian")
        panel.set(yscale="log", xlim=(-REACH, REACH), ylim=(min(smallest, 1e-3) / 2, 4))
        panel.set_xlabel("residual / its standard deviation σ", **TEXT)
        panel.set_title(f"residuals, {weighting}", **TEXT)
    legend(figure, [handle for panel in axes.flat for handle in panel.get_legend_handles_labels()[0]])
    axes[0, 0].set_ylabel("density of pixels", **TEXT)
    figure.savefig(path)
    return True
