"""CASA images written and read as float32 planes (nx, ny), index [ix, iy]."""

from __future__ import annotations

import itertools
import os

import numpy as np

from casa_sara.casa.images.fits_files import opened_image
from casa_sara.casa.images.image_plane import read_pixels, slabs
from casa_sara.casa.images.regrid import PixelMap, on_plane
from casa_sara.casa.images.sky_image import check_sky_axes, unit_of
from casa_sara.casa.runtime.quantities import radians
from casa_sara.casa.runtime.tools import opened

__all__ = ["read_model", "read_spectra", "write_image"]


def write_image(name, pixels, plane, unit="", beam=None, masked=False):
    """Write an image with the axes right ascension, declination, Stokes and frequency, of which one may be longer.

    Parameters
    ----------
    name : str
        Path of the image.
    pixels : real (nx, ny), or (n, nx, ny) of n channels or of n Stokes parameters
        The pixels, in `unit`. One plane serves all Stokes parameters.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.
    unit : str
        'Jy/pixel', 'Jy/beam', or '' as tclean leaves it on .psf, .residual, .pb and .sumwt.
    beam : dict or list of nchan dict, optional
        Restoring beam {'major', 'minor', 'positionangle'}, or that of each channel.
    masked : bool
        Give it the pixel mask 'mask0' of the image plane.
    """
    import casatools

    nx, ny = pixels.shape[-2:]
    several = plane.n_stokes > 1
    planes = np.broadcast_to(pixels, (plane.n_stokes, nx, ny)) if several else pixels.reshape(-1, nx, ny)
    ia = casatools.image()
    ia.fromshape(name, [nx, ny, len(planes), 1] if several else [nx, ny, 1, len(planes)], csys=plane.csys, log=False)
    try:
        for number, rows in itertools.product(range(len(planes)), slabs(nx, ny)):
            ia.putchunk(planes[number, rows, :, None, None],
                        blc=[rows.start, 0, number, 0] if several else [rows.start, 0, 0, number])
        if masked:
            ia.calcmask("T", name="mask0")
            mask = np.moveaxis(np.broadcast_to(plane.mask, planes.shape), 0, -1)
            ia.putregion(pixelmask=mask[..., None] if several else mask[:, :, None], usemask=False)
        if unit:
            ia.setbrightnessunit(unit)
        ia.setmiscinfo(plane.miscinfo)
    finally:
        ia.close()
    with opened("table", name, nomodify=False) as tb:
        tb.putkeyword("imageinfo", plane.imageinfo | _beam_record(beam, plane.n_stokes))
    with opened("table", os.path.join(name, "logtable"), nomodify=False) as tb:
        tb.removerows(list(range(tb.nrows())))  # how the image was made of temporary files


def _beam_record(beam, n_stokes):
    """Return the record of the beam, or beams, in the information of an image."""
    if beam and n_stokes > 1:  # the same of all Stokes parameters
        return {"perplanebeams": {"nChannels": 1, "nStokes": n_stokes} | {f"*{k}": beam for k in range(n_stokes)}}
    if not isinstance(beam, (list, tuple)):
        return {"restoringbeam": beam} if beam else {}
    beams = {f"*{channel}": one for channel, one in enumerate(beam)}
    return {"perplanebeams": {"nChannels": len(beam), "nStokes": 1} | beams}


def read_model(name, plane, number=0):
    """Return a model image on the pixels of `plane`, its flux kept.

    On another grid each pixel's flux is shared among the new pixels around its place; a pixel
    larger than the new ones is first cut into parts. What lies beyond the new image is lost,
    masked pixels count as zero.

    Parameters
    ----------
    name : str
        A CASA image or a FITS file in Jy/pixel, or a unit that can be converted to it.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.
    number : int
        Of the channel, or of the Stokes parameter of the plane; a model of one channel serves all of them.

    Returns
    -------
    model : float32 (nx, ny), Jy/pixel

    Raises
    ------
    FileNotFoundError, ValueError
        `startmodel` is absent, no image of one plane, not in Jy/pixel, or not finite.
    """
    if not os.path.exists(name):
        raise FileNotFoundError(f"startmodel = '{name}' does not exist: it takes a CASA image or a FITS file")
    try:
        with opened_image(name) as ia:
            shape, given, csys = tuple(ia.shape()), ia.brightnessunit(), ia.coordsys()
            check_sky_axes(name, "startmodel", csys)
            planes = int(np.prod(shape[2:]))
            stokes = list(csys.stokes()) if csys.findcoordinate("stokes")["return"] else []
            wanted = list(plane.csys["stokes1"]["stokes"])
            if stokes != wanted and (stokes or len(wanted) > 1):
                raise ValueError(f"startmodel = '{name}' is of Stokes {', '.join(stokes) or 'I'}: should be of "
                                 f"{', '.join(wanted)}")
            if (len(shape) < 2 or planes not in ((1, plane.channels) if len(wanted) == 1 else (len(wanted),))
                    or planes != max(shape[2:], default=1)):
                right = f"one channel, or {plane.channels}" if plane.channels > 1 else "one channel"
                raise ValueError(f"startmodel = '{name}' has the shape {shape}: it takes "
                                 f"{'one' if len(wanted) == 1 else len(wanted)} Stokes, {right}")
            chosen = number if planes > 1 else 0
            pixels = np.where(read_pixels(ia, True, chosen), read_pixels(ia, False, chosen), np.float32(0))
    except RuntimeError as error:
        raise ValueError(f"startmodel = '{name}' cannot be read as an image: {error}") from error
    unit, factor = unit_of(given, csys)
    if unit != "Jy/pixel":
        raise ValueError(f"startmodel = '{name}' is in '{given}': it takes 'Jy/pixel'{_conversion(name, unit)}")
    if not np.isfinite(pixels).all():
        raise ValueError(f"startmodel = '{name}' holds pixels that are not finite")
    return on_plane(pixels * np.float32(factor), PixelMap(csys, plane), plane.shape)


def read_spectra(name):
    """Return the model at several frequencies.

    Parameters
    ----------
    name : str
        Image .subbands of a run of tsara.

    Returns
    -------
    freqs_hz : float64 (T,)
    spectra : float32 (T, nx, ny)
        Jy/pixel.
    """
    with opened_image(name) as ia:
        count, csys = ia.shape()[3], ia.coordsys()
        freqs_hz = [csys.toworld([0, 0, 0, plane])["numeric"][3] for plane in range(count)]
        return np.array(freqs_hz), np.array([read_pixels(ia, number=plane) for plane in range(count)])


def _conversion(name, unit):
    """Say how an image in Jy/beam becomes one in Jy/pixel."""
    if unit != "Jy/beam":
        return ""
    with opened_image(name) as ia:
        beam, cell = ia.restoringbeam(), np.abs(ia.coordsys().increment()["numeric"][:2])
    if "major" not in beam:
        return "; divide it by the pixels in its beam, pi/(4 ln 2) times its axes over the pixel's, as immath does"
    axes = [radians(f"{beam[axis]['value']!r}{beam[axis]['unit']}", "startmodel") for axis in ("major", "minor")]
    pixels = np.pi / (4 * np.log(2)) * axes[0] * axes[1] / (cell[0] * cell[1])
    return f"; divide it by {pixels:.6g}, the pixels in its beam, as immath does, and set its unit with imhead"
