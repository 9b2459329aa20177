"""Images on the pixels of another image: models with their flux kept, images in Jy/beam interpolated."""

from __future__ import annotations

import numpy as np

from casa_sara.casa.images.image_plane import slabs
from casa_sara.casa.ms.frames import direction_measure, turn_to_frame, unit_vectors

__all__ = ["PixelMap", "corners", "interpolated", "on_plane"]

_SAME_PIXEL = 1e-3  # pixels; two grids whose corners agree so well are one
_SAME_SIZE = 1e-2  # pixels over a whole image, below which pixel sizes are the same


class PixelMap:
    """The positions of the pixels of one image in the pixels of another.

    Another frame of directions is reached by the rotation that is right at the image's reference, at the date of the
    other.

    Parameters
    ----------
    csys : casatools.coordsys
        Of the one image.
    plane : object with `csys`, the record of a coordinate system
        The other image.
    """

    def __init__(self, csys, plane):
        import casatools

        self._from, self._to = csys, casatools.coordsys()
        self._to.fromrecord(plane.csys)
        self._rest = np.asarray(csys.referencepixel()["numeric"])[2:]
        self._values = np.asarray(self._to.referencevalue()["numeric"])[2:]
        self._turn = self._to_frame(self._to.referencecode("direction")[0], plane.csys["obsdate"]["m0"]["value"])

    def _to_frame(self, frame, days):
        """Return the rotation to another frame of directions at a date (MJD), None where it is the same."""
        own = self._from.referencecode("direction")[0]
        if own == frame:
            return None
        longitude, latitude = self._from.referencevalue()["numeric"][:2]
        return turn_to_frame(direction_measure(own, longitude, latitude), frame, float(days) * 86400)

    def __call__(self, x, y):
        """Return the pixel coordinates (2, N) of the pixel coordinates x, y (N,)."""
        pixels = np.vstack([x, y, *(np.full(x.size, rest) for rest in self._rest)])
        sky = self._from.toworldmany(pixels)["numeric"][:2]
        if self._turn is not None:
            east, north, up = self._turn @ unit_vectors(*sky)
            sky = np.arctan2(north, east), np.arctan2(up, np.hypot(east, north))
        world = np.vstack([*sky, *(np.full(x.size, value) for value in self._values)])
        return self._to.topixelmany(world)["numeric"][:2]


def corners(shape):
    """Return the pixel coordinates (2, 4) of the corner pixels."""
    nx, ny = shape
    return np.array([[0, nx - 1, 0, nx - 1], [0, 0, ny - 1, ny - 1]], float)


def on_plane(pixels, place, shape):
    """Deposit the flux of an image (Jy/pixel) in the pixels of another.

    Each pixel's flux is shared among the new pixels around its place; a pixel larger than the new ones is first cut
    into parts. The total is kept but for what lies beyond the new image. On the same grid the pixels stay as they are.

    Parameters
    ----------
    pixels : float32 (nx, ny)
        The image.
    place : PixelMap, from the pixels of this image to those of the other
        Pixel coordinates in the image, for each pixel of the result.
    shape : (int, int)
        Of the other.

    Returns
    -------
    float32, of this shape
    """
    nx, ny = pixels.shape
    moved = place(*corners(pixels.shape))
    if pixels.shape == tuple(shape) and np.abs(moved - corners(pixels.shape)).max() < _SAME_PIXEL:
        return pixels
    size = [np.linalg.norm(moved[:, k] - moved[:, 0]) / max(n - 1, 1) for k, n in ((1, nx), (2, ny))]
    # half a new pixel leaves no ripple; pixels of the same size are not cut, so that a shift by whole pixels is exact
    parts = [1 if abs(s - 1) * max(shape) < _SAME_SIZE else max(1, int(np.ceil(2 * s - 1e-3))) for s in size]
    cuts = [(np.arange(k) + 0.5) / k - 0.5 for k in parts]
    model = np.zeros(shape, np.float64)
    for rows in slabs(nx, ny * parts[0] * parts[1]):
        x, y = np.nonzero(pixels[rows])
        flux = pixels[rows][x, y] / (parts[0] * parts[1])
        for dx in cuts[0]:
            for dy in cuts[1]:
                if flux.size:
                    _deposit(model, place(x + rows.start + dx, y + dy), flux)
    return model.astype(np.float32)


def interpolated(pixels, place, shape):
    """Interpolate an image in Jy/beam, whose values do not depend on the pixel size, at the pixels of another.

    Parameters
    ----------
    pixels : real (nx, ny)
        The image.
    place : PixelMap, from the pixels of the other image to those of this one
        Pixel coordinates in the image, for each pixel of the result.
    shape : (int, int)
        Of the other.

    Returns
    -------
    float64, of this shape; NaN beyond this image
    """
    x, y = np.indices(shape).reshape(2, -1).astype(float)
    moved = place(x, y)
    if pixels.shape == tuple(shape) and np.abs(moved - [x, y]).max() < _SAME_PIXEL:
        return pixels.astype(float)
    from scipy.ndimage import map_coordinates  # takes a while, and those who only write do not need it

    edge = np.array(pixels.shape)[:, None] - 1
    near = np.clip(moved, 0, edge)
    values = map_coordinates(pixels.astype(float), near, order=3, mode="mirror")
    values[(np.abs(moved - near) > 0.5).any(axis=0)] = np.nan
    return values.reshape(shape)


def _deposit(model, place, flux):
    """Add each flux to the four pixels around its place, in proportion to the nearness."""
    corner = np.floor(place).astype(int)
    fraction = place - corner
    for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
        i, j = corner[0] + step[0], corner[1] + step[1]
        share = flux * np.prod([f if s else 1 - f for s, f in zip(step, fraction)], axis=0)
        inside = (i >= 0) & (i < model.shape[0]) & (j >= 0) & (j < model.shape[1])
        np.add.at(model, (i[inside], j[inside]), share[inside])
