"""Cubes of any imager, CASA or FITS: their spectral axis, and their channels as images of the sky."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from casa_sara.casa.images.fits_files import opened_image
from casa_sara.casa.images.image_plane import read_pixels
from casa_sara.casa.images.sky_image import (
    SkyImage,
    SkyPlane,
    check_finite,
    check_sky_axes,
    check_stokes_i,
    parameters_of,
    unit_in,
)
from casa_sara.casa.images.spectral_axis import SpectralAxis
from casa_sara.casa.runtime.tools import safe_record

__all__ = ["SkyCube", "read_sky_cube"]

SAME_CHANNEL = 0.01  # of its width
LIGHT_KM_S = 299792.458


@dataclass(frozen=True)
class SkyCube:
    """A cube on disk, one Stokes, several channels.

    Attributes
    ----------
    name : str
    plane : SkyPlane
        That of each channel.
    unit : str
        'Jy/pixel', 'Jy/beam' or ''.
    factor : float
        To this unit from that of the file.
    axis : SpectralAxis
    restfreq_hz : float
        0 where there is none.
    parameters : dict
        Task parameters in the history, name → text.
    """

    name: str
    plane: SkyPlane
    unit: str
    factor: float
    axis: SpectralAxis
    restfreq_hz: float
    parameters: dict[str, str] = field(default_factory=dict)

    @property
    def velocities(self):
        """Radio velocity of each channel in km/s, in the frame of the axis; None without a rest frequency."""
        return LIGHT_KM_S * (1 - self.axis.freqs_hz / self.restfreq_hz) if self.restfreq_hz > 0 else None

    def channel(self, number, finite=True):
        """Return one channel as a SkyImage; with `finite` False, pixels that are no numbers are allowed."""
        with opened_image(self.name) as ia:
            pixels = read_pixels(ia, number=number) * np.float32(self.factor)
        if finite:
            check_finite(f"{self.name}, channel {number}", "models", pixels)
        return SkyImage(self.name, pixels, self.unit, None, self.plane, self.parameters)

    def has_channels_of(self, other):
        """Tell whether the channels are those of another cube."""
        ours, theirs = self.axis.lsrk_hz, other.axis.lsrk_hz
        return ours.size == theirs.size and bool(
            np.abs(ours - theirs).max() < SAME_CHANNEL * np.abs(np.diff(theirs)).min())


@dataclass(frozen=True)
class _Axes:
    """What SpectralAxis takes of an image."""

    csys: dict
    channels: int


def read_sky_cube(name, parameter, units):
    """Return a cube, of which nothing but the header is read.

    Parameters
    ----------
    name : str
        A CASA image, or a FITS file.
    parameter : str
        Task parameter that named it, for messages.
    units : sequence of str
        What is right here: out of 'Jy/pixel', 'Jy/beam', ''.

    Returns
    -------
    SkyCube

    Raises
    ------
    ValueError
        It is no image of the sky, has no channels or more than one Stokes, or is in another unit.
    """
    try:
        with opened_image(name) as ia:
            shape, given = tuple(int(n) for n in ia.shape()), ia.brightnessunit()
            csys, history = ia.coordsys(), ia.history(list=False)
            check_sky_axes(name, parameter, csys)
    except (RuntimeError, UnicodeDecodeError) as error:
        raise ValueError(f"{parameter} = '{name}' cannot be read as an image: {str(error).strip()}") from error
    check_stokes_i(name, parameter, csys)
    number = dict(zip(csys.axiscoordinatetypes(), shape)).get("Spectral", 1)
    if number != np.prod(shape[2:]) or number == 1:
        raise ValueError(f"{parameter} = '{name}' has the shape {list(shape)}: should be one Stokes, and several "
                         "channels as the other cubes")
    unit, factor = unit_in(units, name, parameter, given, csys)
    found = safe_record(csys)
    return SkyCube(name, SkyPlane(found, shape[:2]), unit, factor, SpectralAxis.of(_Axes(found, number)),
                   float(csys.restfrequency()["value"][0]), parameters_of(history))
