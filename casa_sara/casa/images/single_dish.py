"""Single-dish images: brightness at any place of another image, beam and frequency; what is wrong with them by name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from casa_sara.casa.images.regrid import PixelMap
from casa_sara.casa.images.sky_image import SkyPlane, read_sky_image
from casa_sara.casa.ms.frames import SPEED_OF_LIGHT

__all__ = ["DishImage", "frequency_of", "read_dish_image", "read_dish_psf"]

ARCSEC = np.pi / 180 / 3600
AROUND = 5  # pixels along a square that must be known for one to be interpolated
COARSEST = 0.5  # of the FWHM, pixels
PEAK = 0.05  # by which the peak of a beam may differ from 1
JY, BOLTZMANN = 1e-26, 1.380649e-23


@dataclass(frozen=True)
class DishImage:
    """A single-dish image.

    Attributes
    ----------
    name : str
    pixels : float32 (nx, ny)
        Jy/beam; NaN where it is not known.
    plane : SkyPlane
    beam : tuple or None
        FWHM of both axes in radians, and position angle in radians, in the frame of the image.
    freq_hz : float or None
        None where the image does not say.
    """

    name: str
    pixels: np.ndarray
    plane: SkyPlane
    beam: tuple[float, float, float] | None
    freq_hz: float | None

    def at(self, plane, x, y):
        """Interpolate it at pixel coordinates of another plane.

        Parameters
        ----------
        plane : object with `csys`, the record of a coordinate system
            The other image.
        x, y : float (N,)
            Pixel coordinates there.

        Returns
        -------
        float64 (N,)
            Jy/beam; NaN where pixels within two of the place are not known.
        """
        from scipy.ndimage import map_coordinates, minimum_filter  # takes a while

        place = PixelMap(_coordinates(plane), self.plane)(x, y)
        good = np.isfinite(self.pixels)
        whole = minimum_filter(good, AROUND, mode="constant", cval=0)
        near = np.rint(place).astype(int)
        inside = np.all((near >= 0) & (near < np.array(whole.shape)[:, None]), axis=0)
        inside[inside] = whole[tuple(near[:, inside])]
        values = np.full(np.size(x), np.nan)
        known = np.where(good, self.pixels, 0).astype(float)
        values[inside] = map_coordinates(known, place[:, inside], order=3, mode="mirror")
        return values

    def turn(self, plane):
        """Return the angle, from the north of another plane through its east, of the north of this one, in radians."""
        own, (x, y) = self.plane.coordinates(), (n // 2 for n in self.plane.shape)
        rest = own.referencepixel()["numeric"][2:]
        longitude, latitude, *others = own.toworld([x, y, *rest])["numeric"]
        step = self.plane.cell_rad[1] * (-1 if latitude > 0 else 1)  # away from the nearer pole
        beside = own.topixel([longitude, latitude + step, *others])["numeric"][:2]
        here, there = PixelMap(own, plane)(*np.transpose([[x, y], beside])).T
        cell = SkyPlane(plane.csys, plane.shape).cell_rad
        west, north = (there - here) * cell * np.sign(step)
        return float(np.arctan2(-west, north))


def _coordinates(plane):
    return SkyPlane(plane.csys, tuple(plane.shape)).coordinates()


def read_dish_image(name, parameter="sdimage"):
    """Read a single-dish image of one plane in Jy/beam, or in K (of the main beam) where beam and frequency are known.

    Parameters
    ----------
    name : str
        A CASA image or a FITS file.
    parameter : str
        Task parameter that named it, for messages.

    Returns
    -------
    DishImage

    Raises
    ------
    FileNotFoundError, ValueError
        It is absent, no image of one plane in Stokes I, in another unit, or nowhere known.
    """
    image = read_sky_image(name, parameter, None, holes=True)
    beam = None if image.beam is None else (image.beam[0] * ARCSEC, image.beam[1] * ARCSEC, np.radians(image.beam[2]))
    freq_hz, pixels = frequency_of(image.plane), image.pixels
    if image.unit == "K" and beam and freq_hz:
        solid_angle = np.pi / (4 * np.log(2)) * beam[0] * beam[1]
        pixels = pixels * np.float32(2 * BOLTZMANN * (freq_hz / SPEED_OF_LIGHT) ** 2 * solid_angle / JY)
    elif image.unit != "Jy/beam":
        hint = "; K needs a beam and a frequency in the header" if image.unit == "K" else ""
        raise ValueError(f"{parameter} = '{name}' is in '{image.unit}': should be in 'Jy/beam', or in 'K'{hint}")
    if not np.isfinite(pixels).any():
        raise ValueError(f"{parameter} = '{name}' is masked, or not finite, everywhere: should hold brightness")
    return DishImage(name, pixels, image.plane, beam, freq_hz)


def read_dish_psf(name, parameter="sdpsf"):
    """Read the beam of a single dish, as an image with the beam in its middle.

    Parameters
    ----------
    name : str
        A CASA image or a FITS file; its largest pixel, about 1, is the centre.
    parameter : str
        Task parameter that named it, for messages.

    Returns
    -------
    pixels : float64 (nx, ny)
        1 at pixel (nx//2, ny//2); both sizes are odd.
    cell_rad : (float, float)

    Raises
    ------
    FileNotFoundError, ValueError
        It is absent, no image of one plane, not 1 at its maximum, or does not have x to the west and y to the north.
    """
    image = read_sky_image(name, parameter, ["Jy/beam", ""])
    if image.plane.upright() is not image.plane:
        raise ValueError(f"{parameter} = '{name}': its axes are turned, mirrored, or not in SIN projection: should "
                         "have right ascension along x, growing to the left, and declination along y")
    peak = float(image.pixels.max())
    if abs(peak - 1) > PEAK:
        raise ValueError(f"{parameter} = '{name}' is {peak:.4g} at its maximum: should be 1, the beam of an image in "
                         "Jy/beam")
    x, y = np.unravel_index(np.argmax(image.pixels), image.pixels.shape)
    half = [min(k, n - 1 - k) for k, n in zip((x, y), image.pixels.shape)]
    box = tuple(slice(k - h, k + h + 1) for k, h in zip((x, y), half))
    return image.pixels[box].astype(float) / peak, image.plane.cell_rad


def frequency_of(plane):
    """Return the frequency of an image plane in Hz, None where it has none."""
    import casatools

    csys = plane.coordinates()
    found = csys.findcoordinate("spectral")
    if not found["return"]:
        return None
    axis = int(np.atleast_1d(found["world"])[0])
    pixel = csys.referencepixel()["numeric"]
    pixel[int(np.atleast_1d(found["pixel"])[0])] = 0  # of one plane
    given = f"{float(csys.toworld(pixel)['numeric'][axis])!r}{csys.units()[axis]}"
    value = casatools.quanta().convert(given, "Hz")["value"]
    return float(value) if value > 0 else None
