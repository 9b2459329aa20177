"""Pictures that set several images of one sky side by side, on common scales.

Models (Jy/pixel) and restored images (Jy/beam) are both shown as brightness, in mJy/arcsec², so that one
logarithmic scale serves all; residuals, in mJy/beam, have a scale of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator

__all__ = ["Column", "Zoom", "compare"]

BRIGHTNESS_MAP = "inferno"
RESIDUAL_MAP = "RdBu_r"
LINE = "0.75"
TEXT = {"fontsize": 9}
WIDTH, GAP = 4.2, 0.06  # of a panel and between panels, in inches
LEFT, RIGHT, TOP, BOTTOM, LABELS = 0.6, 0.85, 0.68, 0.1, 0.48  # margins; room for the labels above the zooms


@dataclass(frozen=True)
class Column:
    """One column of the picture. Images are (nx, ny), indexed [ix, iy].

    Attributes
    ----------
    name : str
    model : array_like
        Jy/pixel.
    restored : array_like
        Jy/beam.
    residual : array_like, optional
        Jy/beam; a truth has none.
    beam : (float, float, float)
        Major and minor axis in arcsec (FWHM) and position angle in degrees from north through east.
    caption : str
        Printed into the panel of the model.
    note : str
        Printed in place of a residual that there is not.
    """

    name: str
    model: np.ndarray
    restored: np.ndarray
    residual: np.ndarray | None
    beam: tuple[float, float, float]
    caption: str = "model"
    note: str = ""


@dataclass(frozen=True)
class Zoom:
    """A square part of the models to be enlarged: name, centre (arcsec to the east, north) and side in arcsec."""

    name: str
    east: float
    north: float
    side: float


def compare(path: str | Path, columns: Sequence[Column], cell_arcsec: float, zooms: Sequence[Zoom],
            decades: float = 3.5, title: str = "") -> None:
    """Draw models, restored images, residuals and enlarged parts of the models, a column for each reconstruction.

    Parameters
    ----------
    path : str or Path
        Image file to write; matplotlib goes by its suffix.
    columns : sequence of Column
        The peak of the first one's model sets the scale, so let it be the truth or the best.
    cell_arcsec : float
        Pixel size along x and y in arcsec.
    zooms : sequence of Zoom
        Enlarged parts of the models, side by side below.
    decades : float
        Range of the logarithmic scale.
    title : str
        Heading of the picture.
    """
    peak = 1e3 * np.max(columns[0].model) / cell_arcsec**2
    rms = 1e3 * np.median([np.nanstd(column.residual) for column in columns if column.residual is not None])
    brightness, noise = LogNorm(peak / 10**decades, peak), Normalize(-4 * rms, 4 * rms)

    nx, ny = columns[0].model.shape
    height, side = WIDTH * ny / nx, (WIDTH - GAP * (len(zooms) - 1)) / len(zooms)
    tops = TOP + np.array([0, height + GAP, 2 * (height + GAP), 3 * height + 2 * GAP + LABELS])
    size = (LEFT + len(columns) * (WIDTH + GAP) - GAP + RIGHT, tops[3] + side + BOTTOM)
    figure = Figure(figsize=size, dpi=150, facecolor="white")

    def axes(left, top, width, height):
        return figure.add_axes([left / size[0], 1 - (top + height) / size[1], width / size[0], height / size[1]])

    for number, column in enumerate(columns):
        left = LEFT + number * (WIDTH + GAP)
        for top, kind in zip(tops, ("model", "restored", "residual")):
            panel = axes(left, top, WIDTH, height)
            _panel(panel, column, kind, cell_arcsec, noise if kind == "residual" else brightness)
            _label_axes(panel, first=number == 0, last=kind == "residual")
            if kind == "model":
                panel.set_title(column.name, fontsize=12)
                _mark(panel, zooms)
        for place, zoom in enumerate(zooms):
            panel = axes(left + place * (side + GAP), tops[3], side, side)
            _draw(panel, column.model, 1e3 / cell_arcsec**2, cell_arcsec, brightness)
            _frame(panel, zoom)
    _bar(axes(left + WIDTH + 0.1, tops[0], 0.13, 2 * height + GAP), brightness, BRIGHTNESS_MAP, "mJy arcsec$^{-2}$")
    _bar(axes(left + WIDTH + 0.1, tops[2], 0.13, height), noise, RESIDUAL_MAP, "mJy beam$^{-1}$")
    figure.text(0.5, 1 - 0.2 / size[1], title, ha="center", va="center", fontsize=14)
    figure.savefig(path)


def _panel(panel, column, kind, cell, norm) -> None:
    """Draw one image of a column with its beam and caption, or the column's note."""
    major, minor, _ = column.beam
    place = {"va": "top", "transform": panel.transAxes, **TEXT}
    if kind == "model":
        _draw(panel, column.model, 1e3 / cell**2, cell, norm)
        panel.text(0.02, 0.96, column.caption, color="white", **place)
    elif kind == "restored":
        _draw(panel, column.restored, 1e3 * 4 * np.log(2) / (np.pi * major * minor), cell, norm)
        made = "smoothed" if column.residual is None else "restored"
        panel.text(0.02, 0.96, f'{made}, beam {major:.2f}" × {minor:.2f}"', color="white", **place)
        _beam(panel, column.beam, "white")
    elif column.residual is not None:
        _draw(panel, column.residual, 1e3, cell, norm)
        ground = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
        text = f"residual, rms {1e3 * np.nanstd(column.residual):.3g} mJy/beam"
        panel.text(0.02, 0.96, text, bbox=ground, **place)
        _beam(panel, column.beam, "black")
    else:
        panel.set_axis_off()
        panel.text(0.02, 0.9, column.note, linespacing=1.6, **place)


def _draw(panel, image, scale, cell, norm) -> None:
    """Draw an image times `scale`; the axes are offsets in arcsec from pixel [nx//2, ny//2], east to the left."""
    nx, ny = image.shape
    extent = np.array([nx // 2 + 0.5, nx // 2 + 0.5 - nx, -(ny // 2) - 0.5, ny - ny // 2 - 0.5]) * cell
    shown, colours = scale * np.asarray(image), RESIDUAL_MAP
    if isinstance(norm, LogNorm):
        shown, colours = np.maximum(shown, norm.vmin), BRIGHTNESS_MAP
    panel.imshow(shown.T, origin="lower", extent=extent, norm=norm, cmap=colours, interpolation="nearest")


def _frame(panel, zoom) -> None:
    """Cut a panel to the zoom and give it a scale bar."""
    half = zoom.side / 2
    panel.set(xlim=(zoom.east + half, zoom.east - half), ylim=(zoom.north - half, zoom.north + half))
    panel.set(xticks=[], yticks=[])
    panel.spines[:].set_color(LINE)
    panel.text(0.04, 0.95, zoom.name, color="white", va="top", transform=panel.transAxes, **TEXT)
    unit = 10 ** np.floor(np.log10(half))
    length = unit * max(factor for factor in (1, 2, 5) if factor * unit <= half)
    start, height = zoom.east - 0.9 * half + length, zoom.north - 0.85 * half
    panel.plot([start, start - length], [height] * 2, color="white", lw=1.5)
    panel.text(start - length / 2, height + 0.05 * half, f'{length:g}"', color="white", ha="center", **TEXT)


def _mark(panel, zooms) -> None:
    """Outline the zooms in a panel of the whole field."""
    for zoom in zooms:
        corner = zoom.east - zoom.side / 2, zoom.north - zoom.side / 2
        panel.add_patch(Rectangle(corner, zoom.side, zoom.side, fill=False, color=LINE, lw=0.7))


def _beam(panel, beam, colour) -> None:
    """Draw the beam into the lower left corner."""
    major, minor, angle = beam
    (east, west), south = panel.get_xlim(), panel.get_ylim()[0]
    away = 0.6 * major + 0.02 * (east - west)
    panel.add_patch(Ellipse((east - away, south + away), minor, major, angle=-angle, color=colour, lw=0.8, fill=False))


def _label_axes(panel, first, last) -> None:
    """Write offsets in arcsec along the outer edges only."""
    panel.tick_params(labelsize=8, color=LINE, direction="in", labelleft=first, labelbottom=last)
    for axis in (panel.xaxis, panel.yaxis):
        low, high = sorted(axis.get_view_interval())
        ticks = MaxNLocator(7, steps=[1, 2, 5, 10]).tick_values(low, high)
        room = 0.04 * (high - low)  # or the labels of neighbours would touch
        axis.set_ticks(ticks[(ticks > low + room) & (ticks < high - room)])
    if first:
        panel.set_ylabel("north [arcsec]", **TEXT)
    if last:
        panel.set_xlabel("east [arcsec]", **TEXT)


def _bar(axes, norm, colours, unit) -> None:
    """Draw a colour bar into `axes`."""
    axes.figure.colorbar(ScalarMappable(norm, colours), cax=axes).set_label(unit, **TEXT)
    axes.tick_params(labelsize=8)
