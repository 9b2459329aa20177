"""The known spectral index: a number, or an image of it."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np

from casa_sara.casa.images.fits_files import opened_image
from casa_sara.casa.images.image_plane import read_pixels
from casa_sara.casa.images.sky_image import SkyPlane, read_sky_image
from casa_sara.casa.runtime.quantities import hertz
from casa_sara.options import LARGEST_INDEX, Spectrum

__all__ = ["check_spectral_index", "reference_hz", "spectral_band", "with_spectrum"]


def check_spectral_index(text):
    """Raise unless `text` is '', a number within ±5, or the name of an image that exists."""
    value = _number(text)
    if value is None and text and not os.path.exists(text):
        raise FileNotFoundError(f"spectralindex = '{text}' is neither a number nor an image that exists: should be the "
                                "exponent of the frequency, as '-0.7', or an image of it")
    if value is not None and not abs(value) <= LARGEST_INDEX:
        raise ValueError(f"spectralindex = '{text}': should be from {-LARGEST_INDEX:g} to {LARGEST_INDEX:g}, the "
                         "exponent of the frequency, as '-0.7'")


def with_spectrum(grid, plane, reference=None):
    """Return the grid with the spectrum given by its `spectralindex`.

    Parameters
    ----------
    grid : casa_sara.options.ImageGrid
        Size, pixels, direction and gridder of the image.
    plane : ImagePlane or SkyPlane
        `csys` and `shape`.
    reference : ImagePlane or SkyPlane, optional
        The frequency on its spectral axis is the reference; that of `plane` by default.

    Returns
    -------
    casa_sara.options.ImageGrid

    Raises
    ------
    ValueError, FileNotFoundError
        There is no such image, it shows another part of the sky, or its values are no spectral indices.
    """
    if not grid.spectralindex:
        return grid
    check_spectral_index(grid.spectralindex)
    plane, reference = (SkyPlane(one.csys, tuple(one.shape)) for one in (plane, reference or plane))
    value = _number(grid.spectralindex)
    index = _index_image(grid.spectralindex, plane) if value is None else value
    return replace(grid, spectrum=Spectrum(index, reference_hz(reference)))


def spectral_band(grid, freq_range_hz):
    """Return the largest |ln(ν/ν0)| where an image of the spectral index is given, else 0: for the memory forecast."""
    if not grid.spectralindex or _number(grid.spectralindex) is not None or not min(freq_range_hz) > 0:
        return 0.0
    reference = hertz(grid.reffreq, "reffreq") if grid.reffreq else sum(freq_range_hz) / 2
    return max(abs(math.log(freq / reference)) for freq in freq_range_hz)


def _number(text):
    """Return the text as a number, None where it is the name of an image."""
    try:
        return float(text)
    except ValueError:
        return None


def reference_hz(plane):
    """Return the frequency of the spectral axis.

    Parameters
    ----------
    plane : ImagePlane or SkyPlane
        Of one channel.

    Returns
    -------
    float
        Hz.
    """
    csys = SkyPlane(plane.csys, tuple(plane.shape)).coordinates()
    return float(csys.convert(csys.referencevalue()["numeric"], unitsout=["rad", "rad", "", "Hz"])[3])


def _index_image(name, plane):
    """Return an image of the spectral index on the pixels of the plane, float32 (nx, ny).

    Masked pixels, and those beyond the image, have the median of the others.
    """
    image = read_sky_image(name, "spectralindex", ("",))
    with opened_image(name) as ia:
        good = read_pixels(ia, getmask=True)
    if not good.any() or not image.overlaps(plane):
        raise ValueError(f"spectralindex = '{name}' has no valid pixel in the image: should cover the same part of the "
                         "sky")
    low, high = float(image.pixels[good].min()), float(image.pixels[good].max())
    if max(-low, high) > LARGEST_INDEX:
        raise ValueError(f"spectralindex = '{name}' has values from {low:.3g} to {high:.3g}: should be from "
                         f"{-LARGEST_INDEX:g} to {LARGEST_INDEX:g}; mask the pixels without a known index")
    middle = np.float32(np.median(image.pixels[good]))
    index = replace(image, pixels=np.where(good, image.pixels, middle)).brightness_on(plane)
    index = np.where(np.isfinite(index), np.clip(index, low, high), middle)  # the interpolation may overshoot
    return index.astype(np.float32)
