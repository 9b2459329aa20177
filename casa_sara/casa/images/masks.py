"""The support of the model: the pixels that the user's mask or the primary beam allows to be non-zero, as in tclean."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from casa_sara.casa.images.fits_files import is_fits, opened_image
from casa_sara.casa.images.image_files import write_image
from casa_sara.casa.images.image_plane import read_planes
from casa_sara.casa.images.sky_image import check_sky_axes
from casa_sara.casa.runtime.tools import made, opened, scratch_folder

__all__ = ["read_support"]


def read_support(grid, plane):
    """Return the pixels that the model may use.

    The mask is made by the code behind tclean, so regions, files and images on any grid mean what they mean there: the
    union of all entries, within the primary beam above `pbmask`.

    Parameters
    ----------
    grid : casa_sara.options.ImageGrid
        Its `usemask`, `mask` and `pbmask`.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.

    Returns
    -------
    bool (nx, ny), or (nchan, nx, ny) of a cube, or None where there is no mask

    Raises
    ------
    ValueError
        An entry is no region and no image, or selects no pixel of this image; or nothing is left of the primary beam.
    """
    if grid.usemask == "pb":
        support = plane.pb > grid.pbmask
        if not support.any():
            raise ValueError(f"usemask = 'pb', pbmask = {grid.pbmask:g}: the primary beam is nowhere in the image "
                             "above this value: should be less, or the image closer to the pointing centre")
        return support
    if not grid.mask:
        return None
    support = np.zeros(plane.pb.shape, bool)
    for entry in grid.mask:
        found = _mask_of(entry, plane) & ((plane.pb > grid.pbmask) | (grid.pbmask == 0))
        if not found.any():
            limits = f", pbmask = {grid.pbmask:g}" if grid.pbmask else ""
            raise ValueError(f"mask = '{entry}'{limits} selects no pixel: should be a CRTF region as "
                             "'circle[[40pix,40pix],10pix]', a file of them that begins with #CRTF, or an image of "
                             f"ones and zeros, CASA's or FITS, with something in it inside this image of "
                             f"{list(plane.shape)} pixels; '' is no mask")
        support |= found
    return support


def _mask_of(entry, plane):
    """Return the mask that tclean makes of one entry, bool, as of the primary beam: empty where it cannot read it."""
    import casatools

    deconvolver = casatools.synthesisdeconvolver()
    with scratch_folder((*plane.shape, plane.channels)) as folder:
        root = os.path.join(folder, "support")
        _write_what_tclean_needs(root, plane)
        try:
            wanted = _as_tclean_reads(entry, root + ".given", plane)
            deconvolver.setupdeconvolution({
                "imagename": root, "deconvolver": "hogbom", "specmode": "cube" if plane.pb.ndim > 2 else "mfs",
                "startmodel": "", "restoringbeam": [], "usemask": "user", "mask": wanted})
            deconvolver.initminorcycle()
            deconvolver.setupmask()
        except (RuntimeError, UnicodeDecodeError) as error:
            raise ValueError(f"mask = '{entry}': CASA cannot make a mask of this: "
                             f"{' '.join(str(error).split())}") from error
        finally:
            deconvolver.done()
        with opened("image", made(root + ".mask", f"mask = '{entry}'")) as ia:
            return read_planes(ia).reshape(plane.pb.shape) > 0


def _as_tclean_reads(entry, copy, plane):
    """Return the name of a mask as tclean takes it.

    Of an image that is FITS, or lacks axes, that is a copy, of which Stokes and frequency say nothing: tclean would
    convert the latter, and fail where the telescope is not known. Its planes, where it has several, are those of the
    cube in their order.
    """
    if not is_fits(entry) and not os.path.isfile(os.path.join(entry, "table.dat")):
        return os.path.abspath(entry) if os.path.exists(entry) else entry  # a region, or a file of them
    with opened_image(entry) as ia:
        csys, shape = ia.coordsys(), ia.shape()
        check_sky_axes(entry, "mask", csys)
        if not is_fits(entry) and all(csys.findcoordinate(kind)["return"] for kind in ("stokes", "spectral")):
            return os.path.abspath(entry)
        if shape[2:].prod() == 1:
            flat = ia.subimage(dropdeg=True)
            flat.adddegaxes(copy, spectral=True, stokes="I").done()
            flat.done()
            return copy
        if shape[2:].prod() != plane.channels or shape[2:].max() != plane.channels:
            right = f"one channel, or {plane.channels}" if plane.channels > 1 else "one channel"
            raise ValueError(f"mask = '{entry}' has the shape {shape.tolist()}: should be one Stokes, {right}")
        there = replace(plane, csys=plane.csys | {"direction0": csys.torecord()["direction0"]})
        write_image(copy, np.where(read_planes(ia, True), read_planes(ia), np.float32(0)), there)
    return copy


def _write_what_tclean_needs(root, plane):
    """Write the images that CASA needs with a mask: all empty, except the primary beam and a point spread function."""
    nx, ny = plane.shape
    x, y = np.arange(nx)[:, None] - nx // 2, np.arange(ny)[None, :] - ny // 2
    point = np.exp(-(x**2 + y**2) / 8.0).astype(np.float32)
    images = {".psf": np.broadcast_to(point, plane.pb.shape), ".pb": plane.pb}
    for suffix in (".residual", ".model"):
        images[suffix] = np.zeros(plane.pb.shape, np.float32)
    for suffix, pixels in images.items():
        write_image(root + suffix, pixels, plane, masked=suffix == ".pb")
