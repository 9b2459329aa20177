"""Pictures that set several reconstructions of one sky side by side, on common scales.

Models (Jy/pixel) and restored images (Jy/beam) are both shown as brightness, in mJy/arcsec², so that one
logarithmic scale serves all; residuals, in units of their beam, have a scale of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle

__all__ = ["Reconstruction", "Zoom", "compare"]

BRIGHTNESS_MAP = "inferno"
RESIDUAL_MAP = "RdBu_r"
LINE = "0.75"
TEXT = {"fontsize": 9}


@dataclass(frozen=True)
class Reconstruction:
    """One column of the picture. Images are (nx, ny), indexed [ix, iy], or None where there is none.

    Attributes
    ----------
    name : str
    model : array_like
        Jy/pixel.
    restored, residual : array_like, optional
        Jy/beam.
    beam : (float, float, float), optional
        Major and minor axis in arcsec (FWHM) and position angle in degrees from north through east.
    caption : str
        Lines printed into the panel of the model.
    note : str
        Lines printed in place of a residual, for a reconstruction (the truth) that has none.
    """

    name: str
    model: np.ndarray
    restored: np.ndarray | None = None
    residual: np.ndarray | None = None
    beam: tuple[float, float, float] | None = None
    caption: str = ""
    note: str = ""


@dataclass(frozen=True)
class Zoom:
    """A square part of the models to be enlarged: name, centre (arcsec to the east, north) and side in arcsec."""

    name: str
    east: float
    north: float
    side: float


def compare(
    path, reconstructions: Sequence[Reconstruction], cell_arcsec: float, zooms: Sequence[Zoom] = (), decades=3.5, title=""
) -> None:
    """Draw models, restored images and residuals of several reconstructions, a column for each.

    Parameters
    ----------
    path : str or Path
        Image file to write; matplotlib goes by its suffix.
    reconstructions : sequence of Reconstruction
        The first one sets the scale, so let it be the truth or the best.
    cell_arcsec : float
    zooms : sequence of Zoom
        Enlarged parts of the models, shown below.
    decades : float
        Range of the logarithmic scale below the peak of the first model.
    title : str
    """
    peak = 1e3 * np.max(reconstructions[0].model) / cell_arcsec**2
    brightness = LogNorm(peak / 10**decades, peak)
    rms = [np.nanstd(r.residual) for r in reconstructions if r.residual is not None]
    noise = Normalize(-4e3 * np.median(rms), 4e3 * np.median(rms))

    nx, ny = reconstructions[0].model.shape
    columns, width, gap, labels = len(reconstructions), 4.2, 0.06, 0.48  # inches
    left, right, top, bottom = 0.6, 0.85, 0.68, 0.1
    height, side = width * ny / nx, (width - gap * (len(zooms) - 1)) / max(len(zooms), 1)
    tops = top + np.array([0, height + gap, 2 * (height + gap), 3 * height + 2 * gap + labels])
    size = (left + columns * (width + gap) - gap + right, tops[3] + side * bool(zooms) + bottom)
    figure = Figure(figsize=size, dpi=150, facecolor="white")

    def axes(left, top, w, h):
        return figure.add_axes([left / size[0], 1 - (top + h) / size[1], w / size[0], h / size[1]])

    for column, reconstruction in enumerate(reconstructions):
        edge = left + column * (width + gap)
        for row, kind in enumerate(("model", "restored", "residual")):
            panel = axes(edge, tops[row], width, height)
            drawn = _panel(panel, reconstruction, kind, cell_arcsec, noise if kind == "residual" else brightness)
            _label_axes(panel, first=column == 0, last=row == 2)
            if column == columns - 1 and kind != "restored":
                bar = axes(edge + width + 0.1, tops[row], 0.13, height if kind == "residual" else 2 * height + gap)
                figure.colorbar(drawn, cax=bar).set_label(f"mJy {'beam' if kind == 'residual' else 'arcsec'}$^{{-{1 + (kind == 'model')}}}$", **TEXT)
                bar.tick_params(labelsize=8)
            if kind == "model":
                panel.set_title(reconstruction.name, fontsize=12)
                _mark(panel, zooms)
        for number, zoom in enumerate(zooms):
            panel = axes(edge + number * (side + gap), tops[3], side, side)
            _panel(panel, reconstruction, "model", cell_arcsec, brightness, zoom)
    figure.text(0.5, 1 - 0.2 / size[1], title, ha="center", va="center", fontsize=14)
    figure.savefig(path)


def _panel(panel, reconstruction, kind, cell, norm, zoom=None):
    """Draw one image of a reconstruction, with its beam and caption; return what was drawn."""
    image = getattr(reconstruction, kind)
    if image is None:
        panel.set_axis_off()
        panel.text(0.02, 0.9, reconstruction.note, va="top", linespacing=1.5, transform=panel.transAxes, **TEXT)
        return None
    scale = 1e3
    if kind == "model":
        scale /= cell**2
    elif kind == "restored":
        scale /= np.pi * reconstruction.beam[0] * reconstruction.beam[1] / (4 * np.log(2))
    nx, ny = image.shape
    extent = np.array([nx // 2 + 0.5, nx // 2 + 0.5 - nx, -ny // 2 - 0.5, -ny // 2 - 0.5 + ny]) * cell
    shown = np.maximum(scale * np.asarray(image), norm.vmin) if isinstance(norm, LogNorm) else scale * np.asarray(image)
    colours = BRIGHTNESS_MAP if isinstance(norm, LogNorm) else RESIDUAL_MAP
    drawn = panel.imshow(shown.T, origin="lower", extent=extent, norm=norm, cmap=colours, interpolation="nearest")
    if zoom is not None:
        _frame(panel, zoom)
        return drawn
    ink = "black" if kind == "residual" else "white"
    text = reconstruction.caption if kind == "model" else _beam_text(kind, reconstruction)
    panel.text(0.02, 0.96, text, color=ink, va="top", transform=panel.transAxes, **TEXT)
    if kind != "model":
        _beam(panel, reconstruction.beam, extent, ink)
    return drawn


def _frame(panel, zoom) -> None:
    """Cut the panel to the zoom and give it a scale bar."""
    half = zoom.side / 2
    panel.set_xlim(zoom.east + half, zoom.east - half)
    panel.set_ylim(zoom.north - half, zoom.north + half)
    panel.set_xticks([])
    panel.set_yticks([])
    panel.spines[:].set_color(LINE)
    panel.text(0.04, 0.95, zoom.name, color="white", va="top", transform=panel.transAxes, **TEXT)
    length = 10 ** np.floor(np.log10(half))
    length *= max(f for f in (1, 2, 5) if f * length <= half)
    start = zoom.east - half * 0.9 + length
    panel.plot([start, start - length], [zoom.north - half * 0.85] * 2, color="white", lw=1.5)
    panel.text(start - length / 2, zoom.north - half * 0.8, f'{length:g}"', color="white", ha="center", **TEXT)


def _mark(panel, zooms) -> None:
    """Outline the zooms in a panel of the whole field."""
    for zoom in zooms:
        corner = zoom.east - zoom.side / 2, zoom.north - zoom.side / 2
        panel.add_patch(Rectangle(corner, zoom.side, zoom.side, fill=False, color=LINE, lw=0.7))


def _beam_text(kind, reconstruction) -> str:
    """Return what a panel in Jy/beam is labelled with."""
    if kind == "residual":
        return f"residual, rms {1e3 * np.nanstd(reconstruction.residual):.2g} mJy/beam"
    major, minor, _ = reconstruction.beam
    made = "restored" if reconstruction.residual is not None else "smoothed"
    return f'{made}, beam {major:.2f}" × {minor:.2f}"'


def _beam(panel, beam, extent, colour) -> None:
    """Draw the beam into the lower left corner."""
    major, minor, angle = beam
    away = 0.6 * major + 0.02 * (extent[0] - extent[1])
    corner = extent[0] - away, extent[2] + away
    panel.add_patch(Ellipse(corner, minor, major, angle=-angle, color=colour, lw=0.8, fill=False))


def _label_axes(panel, first, last) -> None:
    """Write offsets in arcsec along the outer edges only."""
    panel.tick_params(labelsize=8, color=LINE, direction="in", labelleft=first, labelbottom=last)
    if first:
        panel.set_ylabel("north [arcsec]", **TEXT)
    if last:
        panel.set_xlabel("east [arcsec]", **TEXT)
