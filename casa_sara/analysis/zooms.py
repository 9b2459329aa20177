"""The parts of the sky that a report enlarges: the given regions, or else the brightest peaks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from casa_sara.analysis.comparison import Comparison

__all__ = ["Zoom", "find_zooms", "reference"]

MOST = 4
SMALLEST = 12  # side of a box, in pixels
FAINTEST = 1e-3  # peak, as part of the brightest


@dataclass(frozen=True)
class Zoom:
    """A part of the grid: its name and its pixels x0 … x1 − 1, y0 … y1 − 1 as (x0, x1, y0, y1)."""

    name: str
    box: tuple[int, int, int, int]

    def on_sky(self, comparison: Comparison) -> tuple[float, float, float]:
        """Return its centre in arcsec to the east and to the north of the grid's, and its side in arcsec.

        Parameters
        ----------
        comparison : casa_sara.analysis.comparison.Comparison
            The products and what was measured.

        Returns
        -------
        (float, float, float)
            arcsec.
        """
        x0, x1, y0, y1 = self.box
        (nx, ny), cell = comparison.products[0].model.shape, comparison.cell_arcsec
        east, north = (nx // 2 - (x0 + x1 - 1) / 2) * cell[0], ((y0 + y1 - 1) / 2 - ny // 2) * cell[1]
        return east, north, max((x1 - x0) * cell[0], (y1 - y0) * cell[1])


def reference(comparison: Comparison) -> np.ndarray:
    """Return the model that sets scales and zooms, Jy/pixel: the truth, or the first product's.

    Parameters
    ----------
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.

    Returns
    -------
    float64 (nx, ny)
    """
    return comparison.products[0].model if comparison.truth is None else comparison.truth


def find_zooms(comparison: Comparison, most: int = MOST) -> list[Zoom]:
    """Return the boxes around the regions of a comparison, or around the brightest peaks when there are none.

    Boxes are as high as they are wide on the sky and lie on the grid as far as it goes.

    Parameters
    ----------
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.
    most : int
        Largest number of boxes.

    Returns
    -------
    list of Zoom
    """
    named = [(name, mask) for name, mask in comparison.regions.items() if np.any(mask)][:most]
    if named:
        return [_around_region(name, mask, comparison.cell_arcsec) for name, mask in named]
    return _around_peaks(comparison, most)


def _around_region(name, mask, cell) -> Zoom:
    x, y = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    side = 1.3 * max((x[-1] - x[0] + 1) * cell[0], (y[-1] - y[0] + 1) * cell[1])
    return Zoom(name, _box((x[0] + x[-1]) / 2, (y[0] + y[-1]) / 2, side, cell, mask.shape))


def _around_peaks(comparison, most) -> list[Zoom]:
    """Take the highest peaks, so far apart that their boxes do not overlap."""
    image = np.nan_to_num(reference(comparison))
    cell, shape = comparison.cell_arcsec, image.shape
    side = max(0.12 * max(shape[0] * cell[0], shape[1] * cell[1]), SMALLEST * max(cell))
    softened = gaussian_filter(image, 1.0)  # two pixels that share a source make one peak
    highest = maximum_filter(softened, [2 * max(int(np.ceil(side / width)), 2) + 1 for width in cell])
    peaks = np.argwhere((softened == highest) & (softened > FAINTEST * softened.max()))
    peaks = sorted(peaks, key=lambda peak: -softened[tuple(peak)])[:most]
    return [Zoom(f"peak {number}", _box(peak[0], peak[1], side, cell, shape)) for number, peak in enumerate(peaks, 1)]


def _box(x, y, side, cell, shape) -> tuple[int, int, int, int]:
    """Return a box of `side` arcsec around pixel (x, y), moved onto the grid."""
    edges = []
    for centre, width, size in zip((x, y), cell, shape):
        pixels = min(max(int(round(side / width)), SMALLEST), size)
        start = int(np.clip(round(centre - (pixels - 1) / 2), 0, size - pixels))
        edges += [start, start + pixels]
    return tuple(edges)
