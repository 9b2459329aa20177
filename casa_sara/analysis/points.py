"""Flux, position and width of a point source in an image without other emission."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["recovered_point"]

FINE = 9  # parts of a pixel along an axis, over which its flux is spread evenly


def recovered_point(image: npt.ArrayLike, place: tuple[float, float], radius: float,
                    cell: tuple[float, float] = (1.0, 1.0)) -> dict[str, float]:
    """Measure a point source in a circle around its true place.

    The flux is the sum F over the circle. The place found is the centroid of that flux, and the width twice the radius
    R around it with Σ_{r < R} = F/2: for a Gaussian, its full width at half maximum. Unlike second moments it does not
    grow with the little that noise leaves far from the source, and negative pixels count as they are. Pixels are spread
    evenly over their area, so flux in one pixel alone has a width of 0.8 pixels.

    Parameters
    ----------
    image : array_like (nx, ny)
        Jy/pixel.
    place : (float, float)
        Pixel coordinates of the source.
    radius : float
        Of the circle, in the unit of `cell`.
    cell : (float, float)
        Pixel size.

    Returns
    -------
    dict
        flux, in the image's unit, and, where it is positive, offset and width in the unit of `cell`.

    Raises
    ------
    ValueError
        The circle is not within the image.
    """
    image, cell = np.asarray(image, float), np.asarray(cell, float)
    first = np.floor(np.asarray(place) - radius / cell).astype(int)
    last = np.ceil(np.asarray(place) + radius / cell).astype(int)
    if (first < 0).any() or (last >= image.shape).any():
        raise ValueError(f"place = {tuple(place)}: a circle of {radius:g} around it is not within {image.shape} "
                         f"pixels of {tuple(cell.tolist())}")
    part = image[first[0] : last[0] + 1, first[1] : last[1] + 1]
    part = np.repeat(np.repeat(part, FINE, axis=0), FINE, axis=1) / FINE**2
    steps = ((np.arange(n) + 0.5) / FINE - 0.5 for n in part.shape)
    x, y = np.meshgrid(*((start + step - centre) * size
                         for start, step, centre, size in zip(first, steps, place, cell)), indexing="ij")
    inside = np.hypot(x, y) <= radius
    x, y, part = x[inside], y[inside], part[inside]
    flux = float(part.sum())
    if not flux > 0:
        return {"flux": flux}
    x0, y0 = (x * part).sum() / flux, (y * part).sum() / flux
    away = np.hypot(x - x0, y - y0)
    order = np.argsort(away)
    half = np.argmax(np.cumsum(part[order]) >= flux / 2)
    return {"flux": flux, "offset": float(np.hypot(x0, y0)), "width": float(2 * away[order][half])}
