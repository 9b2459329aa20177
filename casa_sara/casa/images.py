"""CASA images written and read as float32 planes (nx, ny), index [ix, iy]."""

from __future__ import annotations

import os

import numpy as np

from casa_sara.casa.imageplane import read_pixels, slabs
from casa_sara.casa.tools import opened

__all__ = ["read_model", "write_image"]

_SAME_PIXEL = 1e-3  # pixels; two grids whose corners agree so well are one


def write_image(name, pixels, plane, unit="", beam=None, masked=False):
    """Write one image plane with the axes right ascension, declination, Stokes and frequency.

    Parameters
    ----------
    name : str
    pixels : real (nx, ny)
    plane : ImagePlane
    unit : str
        'Jy/pixel', 'Jy/beam', or '' as tclean leaves it on .psf, .residual, .pb and .sumwt.
    beam : dict, optional
        Restoring beam {'major', 'minor', 'positionangle'}.
    masked : bool
        Give it the pixel mask 'mask0' of the image plane.
    """
    import casatools

    nx, ny = pixels.shape
    ia = casatools.image()
    ia.fromshape(name, [nx, ny, 1, 1], csys=plane.csys, log=False)
    try:
        for rows in slabs(nx, ny):
            ia.putchunk(pixels[rows, :, None, None], blc=[rows.start, 0, 0, 0])
        if masked:
            ia.calcmask("T", name="mask0")
            ia.putregion(pixelmask=plane.mask[:, :, None, None], usemask=False)
        if unit:
            ia.setbrightnessunit(unit)
        ia.setmiscinfo(plane.miscinfo)
    finally:
        ia.close()
    with opened("table", name, nomodify=False) as tb:
        tb.putkeyword("imageinfo", plane.imageinfo | ({"restoringbeam": beam} if beam else {}))
    with opened("table", os.path.join(name, "logtable"), nomodify=False) as tb:
        tb.removerows(list(range(tb.nrows())))  # how the image was made of temporary files


def read_model(name, plane):
    """Return a model image on the pixels of `plane`, its flux kept.

    On another grid each pixel's flux is shared among the new pixels around its place; a pixel
    larger than the new ones is first cut into parts. What lies beyond the new image is lost,
    masked pixels count as zero.

    Parameters
    ----------
    name : str
        A CASA image in Jy/pixel.
    plane : ImagePlane

    Returns
    -------
    model : float32 (nx, ny), Jy/pixel

    Raises
    ------
    FileNotFoundError, ValueError
        `startmodel` is absent, no image of one plane, not in Jy/pixel, or not finite.
    """
    if not os.path.isdir(name):
        raise FileNotFoundError(f"startmodel = '{name}' does not exist")
    try:
        with opened("image", name) as ia:
            shape, unit, csys = tuple(ia.shape()), ia.brightnessunit(), ia.coordsys()
            if len(shape) < 2 or int(np.prod(shape[2:])) != 1:
                raise ValueError(f"startmodel = '{name}' has the shape {shape}: it takes one Stokes, one channel")
            pixels = np.where(read_pixels(ia, getmask=True), read_pixels(ia), np.float32(0))
    except RuntimeError as error:
        raise ValueError(f"startmodel = '{name}' cannot be read as an image: {error}") from error
    if unit != "Jy/pixel":
        raise ValueError(f"startmodel = '{name}' is in '{unit}': it takes 'Jy/pixel'")
    if not np.isfinite(pixels).all():
        raise ValueError(f"startmodel = '{name}' holds pixels that are not finite")
    return _on_plane(pixels, _PixelMap(csys, plane), plane)


class _PixelMap:
    """Where the pixels of one image stand in the pixels of another."""

    def __init__(self, csys, plane):
        import casatools

        self._from, self._to = csys, casatools.coordsys()
        self._to.fromrecord(plane.csys)
        self._rest = np.asarray(csys.referencepixel()["numeric"])[2:]
        self._values = np.asarray(self._to.referencevalue()["numeric"])[2:]
        self._turn_to(self._to.referencecode("direction")[0], plane.csys["obsdate"])

    def _turn_to(self, frame, date):
        """Convert directions to this frame; coordsys does it without the date, which moves B1950 by 0.1 arcsec."""
        import casatools

        me, center = casatools.measures(), self._from.referencevalue("m")["measure"]["direction"]
        me.doframe(date)
        exact = me.measure(center, frame)
        self._from.setconversiontype(direction=frame)
        found = self._from.toworld(self._from.referencepixel()["numeric"])["numeric"][:2]
        shift = np.array([exact["m0"]["value"], exact["m1"]["value"]]) - found
        self._shift = np.array([np.remainder(shift[0] + np.pi, 2 * np.pi) - np.pi, shift[1]])[:, None]

    def __call__(self, x, y):
        """Return the pixel coordinates (2, N) of the pixel coordinates x, y (N,)."""
        pixels = np.vstack([x, y, *(np.full(x.size, rest) for rest in self._rest)])
        sky = self._from.toworldmany(pixels)["numeric"][:2] + self._shift
        world = np.vstack([sky, *(np.full(x.size, value) for value in self._values)])
        return self._to.topixelmany(world)["numeric"][:2]


def _on_plane(pixels, place, plane):
    """Deposit the flux of `pixels` in the pixels of `plane`."""
    nx, ny = pixels.shape
    corners = np.array([[0, nx - 1, 0, nx - 1], [0, 0, ny - 1, ny - 1]], float)
    moved = place(*corners)
    if pixels.shape == plane.shape and np.abs(moved - corners).max() < _SAME_PIXEL:
        return pixels
    size = [np.linalg.norm(moved[:, k] - moved[:, 0]) / max(n - 1, 1) for k, n in ((1, nx), (2, ny))]
    parts = [max(1, int(np.ceil(2 * s))) for s in size]
    cuts = [(np.arange(k) + 0.5) / k - 0.5 for k in parts]
    model = np.zeros(plane.shape, np.float64)
    for rows in slabs(nx, ny * parts[0] * parts[1]):
        x, y = np.nonzero(pixels[rows])
        flux = pixels[rows][x, y] / (parts[0] * parts[1])
        for dx in cuts[0]:
            for dy in cuts[1]:
                if flux.size:
                    _deposit(model, place(x + rows.start + dx, y + dy), flux)
    return model.astype(np.float32)


def _deposit(model, place, flux):
    """Add each flux to the four pixels around its place, in proportion to the nearness."""
    corner = np.floor(place).astype(int)
    fraction = place - corner
    for step in ((0, 0), (0, 1), (1, 0), (1, 1)):
        i, j = corner[0] + step[0], corner[1] + step[1]
        share = flux * np.prod([f if s else 1 - f for s, f in zip(step, fraction)], axis=0)
        inside = (i >= 0) & (i < model.shape[0]) & (j >= 0) & (j < model.shape[1])
        np.add.at(model, (i[inside], j[inside]), share[inside])
