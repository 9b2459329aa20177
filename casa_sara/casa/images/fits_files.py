"""Images of any imager opened with CASA's image tool: CASA's own, and FITS files, compressed or in an extension too."""

from __future__ import annotations

import os
from contextlib import contextmanager

from casa_sara.casa.runtime.tools import opened, scratch_folder

__all__ = ["is_fits", "opened_image", "readable"]

_FITS = b"SIMPLE  ="
_COMPRESSED = (b"\x1f\x8b", b"BZh", b"\xfd7zXZ")  # gzip, bzip2, xz


def is_fits(name):
    """Tell whether a name is that of a FITS file, or of a compressed file, which is taken for one."""
    return os.path.isfile(name) and os.access(name, os.R_OK) and _beginning(name).startswith((_FITS, *_COMPRESSED))


@contextmanager
def readable(name):
    """Yield the name of an image that CASA can read: this one, or for a FITS file that it cannot, a temporary copy.

    CASA reads the primary array and the first extension, uncompressed, and fails where CROTA turns the axes by 90
    degrees; of other files the copy holds the first image, with a PC matrix for CROTA.

    Raises
    ------
    RuntimeError
        It is no FITS file, or one without an image.
    """
    if not is_fits(name):
        yield name
        return
    from astropy.io import fits  # takes a while, and few need it

    try:
        with fits.open(name) as hdus:
            number, image = next((k, hdu) for k, hdu in enumerate(hdus) if hdu.is_image and len(hdu.shape) > 1)
            turned = any(image.header.get(key) for key in image.header["CROTA*"])
            packed = number > 1 or turned or isinstance(image, fits.CompImageHDU) or _beginning(name) != _FITS
            header = _with_matrix(image.header) if turned else image.header
            data, header = (image.data, header) if packed else (None, None)
    except StopIteration:
        raise RuntimeError("the FITS file holds no image of two axes or more") from None
    except Exception as error:  # of many kinds, from the parser
        raise RuntimeError(f"it is no FITS file: {error}") from error
    if not packed:
        yield name
        return
    with scratch_folder(data.shape) as folder:
        copy = os.path.join(folder, "copy.fits")
        fits.writeto(copy, data, header, output_verify="silentfix")
        yield copy


@contextmanager
def opened_image(name):
    """Open a CASA image or a FITS file with casatools' image tool; RuntimeError where it is none."""
    with readable(name) as path, opened("image", path) as ia:
        yield ia


def _with_matrix(header):
    """Return a header of FITS with a PC matrix in place of CROTA."""
    from astropy.wcs import WCS

    found = header.copy()
    for key in list(header["CROTA*"]):
        found.remove(key)
    found.update(WCS(header).to_header())
    return found


def _beginning(name):
    with open(name, "rb") as file:
        return file.read(len(_FITS))
