"""Sheets of sky panels: rows and columns of images with right ascension, declination, beam and colour bars.

A sheet is at most 11.5 inches wide and is meant to be shown at 100 pixels per inch, where its text has the size of a
page's text.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from astropy.wcs import WCS
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import AsinhNorm, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.transforms import Affine2D

from casa_sara.analysis.comparison import Comparison
from casa_sara.analysis.cube_comparison import CubeComparison

__all__ = ["BRIGHTNESS_MAP", "DIFFERENCE_MAP", "DPI", "LINES", "Sheet", "beam_area", "celestial", "draw", "draw_beam",
           "line", "outline", "plain", "prefix"]

BRIGHTNESS_MAP, DIFFERENCE_MAP = "inferno", "RdBu_r"
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
DPI = 150
WIDEST = 11.5  # of a sheet, in inches
LEFT, RIGHT, TOP, GAP, HEADING, BAR = 0.9, 0.15, 0.3, 0.08, 0.3, 1.15  # BAR: labels and colour bars below the panels
TEXT = {"fontsize": 9.5}


def line(number: int) -> dict[str, str]:
    """Return colour and style of the line of the product of this number.

    Parameters
    ----------
    number : int
        Of the product, from 0.

    Returns
    -------
    dict
        Options of matplotlib's plot.
    """
    return {"color": LINES[number % len(LINES)], "ls": ("-", "--", "-.", ":")[number // len(LINES) % 4]}


def plain(text: object) -> str:
    """Return a text that matplotlib prints as it is: names may hold dollar signs, or start with an underscore.

    Parameters
    ----------
    text : str
        Any text.

    Returns
    -------
    str
    """
    text = str(text).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def prefix(value: float) -> tuple[float, str]:
    """Return the factor and the prefix of the unit that bring a positive value to between 1 and 1000.

    Parameters
    ----------
    value : float
        A positive value in the unit.

    Returns
    -------
    factor : float
    prefix : str
    """
    for factor, sign in ((1.0, ""), (1e3, "m"), (1e6, "µ")):
        if value * factor >= 1:
            return factor, sign
    return 1e9, "n"


def beam_area(beam: tuple[float, float, float]) -> float:
    """Return the solid angle of a Gaussian beam (arcsec, arcsec, degrees) in arcsec².

    Parameters
    ----------
    beam : (float, float, float)
        Major and minor FWHM in arcsec, position angle in degrees from north through east.

    Returns
    -------
    float
        arcsec².
    """
    return np.pi * beam[0] * beam[1] / (4 * np.log(2))


def celestial(comparison: Comparison | CubeComparison) -> WCS:
    """Return the coordinates of the grid of a comparison (SIN projection, ICRS).

    Parameters
    ----------
    comparison : Comparison or CubeComparison
        The products and what was measured.

    Returns
    -------
    astropy WCS
    """
    nx, ny = comparison.products[0].model.shape
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---SIN", "DEC--SIN"]
    wcs.wcs.crval = comparison.centre_deg
    wcs.wcs.crpix = [nx // 2 + 1, ny // 2 + 1]
    wcs.wcs.cdelt = [-comparison.cell_arcsec[0] / 3600, comparison.cell_arcsec[1] / 3600]
    return wcs


@dataclass
class Sheet:
    """Rows and columns of panels with room for headings and colour bars.

    Parameters
    ----------
    rows : sequence of str
        Heading of each row.
    columns : sequence of str
        Heading of each column.
    aspect : float
        Height over width of a panel.
    wcs : astropy.wcs.WCS, optional
        Coordinates of the panels; without them the panels have no labels.
    widest : float
        Limit of the width of a panel, in inches.
    """

    rows: Sequence[str]
    columns: Sequence[str]
    aspect: float
    wcs: WCS | None = None
    widest: float = 5.0

    def __post_init__(self):
        count, left = len(self.columns), LEFT if self.wcs else RIGHT
        self.side = min((WIDEST - left - RIGHT - GAP * (count - 1)) / count, self.widest,
                        max(4.0, 16 / len(self.rows)) / self.aspect)
        self.step = self.side * self.aspect + HEADING
        width = left + count * (self.side + GAP) - GAP + RIGHT
        self.bottom = BAR if self.wcs else BAR - 0.4
        self.size = max(width, 4.0), TOP + len(self.rows) * self.step + self.bottom
        self.left = left + (self.size[0] - width) / 2
        self.figure = Figure(figsize=self.size, dpi=DPI, facecolor="white")
        for number, heading in enumerate(self.columns):
            self._write(self.left + number * (self.side + GAP) + self.side / 2, 0.17, heading, ha="center",
                        fontsize=10.5 if self.side > 1.5 else 9)
        for number, heading in enumerate(self.rows):
            top = TOP + number * self.step + HEADING - 0.08
            self._write(self.left, top, heading, ha="left", va="baseline", fontweight="bold")

    def _write(self, x, y, text, **style):
        style = {"va": "center", "fontsize": 10.5, **style}
        self.figure.text(x / self.size[0], 1 - y / self.size[1], plain(text), **style)

    def _axes(self, left, top, width, height, **options):
        wide, high = self.size
        return self.figure.add_axes([left / wide, 1 - (top + height) / high, width / wide, height / high], **options)

    def panel(self, row: int, column: int, lowest: bool | None = None) -> Axes:
        """Return new axes; labelled along the left edge of the sheet and below the lowest panel of a column.

        Parameters
        ----------
        row : int
            From 0 at the top.
        column : int
            From 0 on the left.
        lowest : bool, optional
            Whether the panel is the lowest of its column; that of the last row by default.

        Returns
        -------
        matplotlib Axes
        """
        lowest = row == len(self.rows) - 1 if lowest is None else lowest
        left, top = self.left + column * (self.side + GAP), TOP + row * self.step + HEADING
        options = {"projection": self.wcs} if self.wcs else {}
        axes = self._axes(left, top, self.side, self.side * self.aspect, **options)
        if not self.wcs:
            axes.set(xticks=[], yticks=[])
            return axes
        for axis, name, shown in zip(axes.coords, ("RA", "Dec"), (lowest, column == 0)):
            axis.set_auto_axislabel(False)
            axis.set_ticklabel_visible(shown)
            axis.set_ticklabel(size=8.5, exclude_overlapping=True)
            axis.set_ticks(number=4 if self.side > 3 else 3 if self.side > 2 or name == "Dec" else 2)
            axis.tick_params(direction="in", color="0.7")
            if shown:
                axis.set_axislabel(name, minpad=0.4 if name == "Dec" else 0.6, **TEXT)
        return axes

    def bar(self, first: int, last: int, norm: Normalize, colours: str, unit: str) -> None:
        """Draw a colour bar below the columns first … last.

        Parameters
        ----------
        first : int
            First column above the bar.
        last : int
            Last column above the bar.
        norm : matplotlib Normalize
            Scale of the panels.
        colours : str
            Name of the colour map.
        unit : str
            Label of the bar.
        """
        width = (last - first + 1) * (self.side + GAP) - GAP
        inset = min(0.15, 0.05 * width)
        left = self.left + first * (self.side + GAP) + inset
        axes = self._axes(left, self.size[1] - 0.6, width - 2 * inset, 0.13)
        bar = self.figure.colorbar(ScalarMappable(norm, colours), cax=axes, orientation="horizontal")
        bar.set_label(unit, **TEXT)
        axes.tick_params(labelsize=8.5)
        if isinstance(norm, AsinhNorm):
            axes.xaxis.set_major_formatter("{x:g}")
        elif not isinstance(norm, LogNorm):
            axes.locator_params(axis="x", nbins=5)

    def save(self, path: str | Path) -> None:
        """Write the sheet.

        Parameters
        ----------
        path : str or Path
            File to write.
        """
        self.figure.savefig(path)


def draw(axes: Axes, image: npt.ArrayLike, norm: Normalize, cell: tuple[float, float],
         colours: str = BRIGHTNESS_MAP) -> None:
    """Draw an image (nx, ny) in pixel coordinates, in the proportions of the sky; what cannot be drawn is grey.

    Parameters
    ----------
    axes : matplotlib Axes
        Axes of the panel.
    image : array_like (nx, ny)
        The image.
    norm : matplotlib Normalize
        Its scale.
    cell : (float, float)
        Pixel size, for the proportions.
    colours : str
        Name of the colour map.
    """
    shown = np.ma.masked_invalid(np.asarray(image, float))
    if isinstance(norm, LogNorm):
        shown = np.ma.maximum(shown, norm.vmin)
    shades = colormaps[colours].with_extremes(bad="0.6")
    axes.imshow(shown.T, origin="lower", norm=norm, cmap=shades, aspect=cell[1] / cell[0])


def draw_beam(axes: Axes, beam: tuple[float, float, float], cell: tuple[float, float], colour: str = "white",
              right: bool = False) -> None:
    """Draw a beam (arcsec, arcsec, degrees from north through east) into a lower corner of the axes.

    Parameters
    ----------
    axes : matplotlib Axes
        Axes of the panel.
    beam : (float, float, float)
        Major and minor FWHM in arcsec, position angle in degrees from north through east.
    cell : (float, float)
        Pixel size in arcsec.
    colour : str
        Of the line.
    right : bool
        In the lower right corner instead of the left one.
    """
    (x0, x1), y0 = axes.get_xlim(), axes.get_ylim()[0]
    away = 0.55 * beam[0] + 0.025 * abs(x1 - x0) * cell[0]
    x, y = (x1 - away / cell[0] if right else x0 + away / cell[0]), y0 + away / cell[1]
    turned = Affine2D().rotate_deg(beam[2]).scale(1 / cell[0], 1 / cell[1]).translate(x, y)
    ellipse = Ellipse((0, 0), beam[1], beam[0], fill=False, color=colour, lw=1.0)
    ellipse.set_transform(turned + axes.transData)
    axes.add_patch(ellipse)


def outline(axes: Axes, box: tuple[int, int, int, int], colour: str = "0.8") -> None:
    """Outline the pixels x0 … x1 − 1, y0 … y1 − 1, with the box as (x0, x1, y0, y1).

    Parameters
    ----------
    axes : matplotlib Axes
        Axes of the panel.
    box : (int, int, int, int)
        x0, x1, y0, y1.
    colour : str
        Of the line.
    """
    x0, x1, y0, y1 = box
    axes.add_patch(Rectangle((x0 - 0.5, y0 - 0.5), x1 - x0, y1 - y0, fill=False, color=colour, lw=0.8))
