"""Images of any imager, CASA or FITS: pixels, unit, beam, coordinates, and the task parameters in their history."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.casa.images.fits_files import opened_image
from casa_sara.casa.images.image_plane import read_pixels
from casa_sara.casa.images.regrid import PixelMap, corners, interpolated, on_plane
from casa_sara.casa.images.units import brightness_unit
from casa_sara.casa.runtime.tools import safe_record

__all__ = ["SkyImage", "SkyPlane", "beam_numbers", "check_finite", "check_sky_axes", "check_stokes_i", "parameters_of",
           "stokes_of",
           "read_header", "read_sky_image", "unit_in", "unit_of"]

_PARAMETER = re.compile(r"(\w+)\s*=\s*(.*)")
_SAME_PLACE = 1e-6  # pixels
_BY_STANDARD = 999.0  # of LONPOLE and LATPOLE: CASA is to follow the FITS standard
_LARGEST_TURN = 0.05  # pixels by which a corner may be off where a grid is of the same centre and axes


@dataclass(frozen=True)
class SkyPlane:
    """A grid: `csys`, the record of a coordinate system whose first two axes are the sky, and `shape` (nx, ny)."""

    csys: dict
    shape: tuple[int, int]

    def coordinates(self):
        """Return a casatools.coordsys that is nobody else's, directions in radians."""
        import casatools

        csys = casatools.coordsys()
        csys.fromrecord(self.csys)
        return csys

    def direction(self, x, y):
        """Return longitude and latitude in radians of one pixel, in the frame of the image."""
        csys = self.coordinates()
        pixel = [x, y, *csys.referencepixel()["numeric"][2:]]
        return tuple(csys.toworld(pixel)["numeric"][:2])

    @property
    def frame(self) -> str:
        """Frame of the directions, as 'J2000'."""
        return self.coordinates().referencecode("direction")[0]

    @property
    def cell_rad(self) -> tuple[float, float]:
        """Pixel size along x and y, both positive."""
        return tuple(np.hypot(*self._steps).tolist())

    @property
    def _steps(self):
        """Steps to the east and north (rows) of one pixel along x and y (columns), rad, before projection."""
        sky = self.csys["direction0"]
        return np.asarray(sky["cdelt"])[:, None] * np.asarray(sky["pc"]).T  # CASA's record has PC transposed

    @property
    def centre(self) -> tuple[float, float]:
        """Longitude and latitude in radians of pixel (nx//2, ny//2); at a pole the longitude that its axes go by."""
        sky, middle = self.csys["direction0"], [n // 2 for n in self.shape]
        if np.abs(sky["crpix"] - middle).max() < _SAME_PLACE:
            return tuple(sky["crval"].tolist())
        return self.direction(*middle)

    def is_aligned(self, plane: SkyPlane) -> bool:
        """Tell whether this plane has the centre, axes and projection of the other, whatever its pixels."""
        found = PixelMap(self.coordinates(), plane)(*corners(self.shape))
        ratio = [[a / b] for a, b in zip(self.cell_rad, plane.cell_rad)]
        offsets = corners(self.shape) - [[n // 2] for n in self.shape]
        expected = offsets * ratio + [[n // 2] for n in plane.shape]
        return bool(np.abs(found - expected).max() < _LARGEST_TURN * max(1, np.min(ratio)))

    def upright(self) -> SkyPlane:
        """Return the plane that shows all of this one with x to the west and y to the north, in SIN projection.

        It is this very plane where that is so already. Of one that is mirrored or turned by right angles, each pixel is
        a pixel of the new one.
        """
        # which axis runs along the new x, which along y, and whether backwards
        steps = self._steps * [[-1], [1]]
        along = [1, 0] if np.abs(steps[[0, 1], [1, 0]]).sum() > np.abs(steps[[0, 1], [0, 1]]).sum() else [0, 1]
        middle = [0, 0]
        for new, old in enumerate(along):
            middle[old] = self.shape[old] // 2 if steps[new, old] > 0 else (self.shape[old] - 1) // 2
        centre = self.centre if middle == [n // 2 for n in self.shape] else self.direction(*middle)
        cell = [self.cell_rad[old] for old in along]
        if self.is_aligned(self._laid_out(centre, cell, self.shape)):
            return self
        # as many pixels as hold the corners
        place = PixelMap(self.coordinates(), self._laid_out(centre, cell, (1, 1)))(*corners(self.shape))
        before, after = (np.ceil(side.max(axis=1) - _LARGEST_TURN).astype(int) for side in (-place, place))
        return self._laid_out(centre, cell, tuple(int(max(2 * b, 2 * a + 1, 1)) for b, a in zip(before, after)))

    def _laid_out(self, centre, cell, shape):
        """Return a plane with pixel (nx//2, ny//2) at this centre, x to the west, y to the north and square corners."""
        import casatools

        axes = {"projection": "SIN", "projection_parameters": np.zeros(2), "crval": np.array(centre, float),
                "crpix": np.array([n // 2 for n in shape], float), "cdelt": np.array([-cell[0], cell[1]]),
                "pc": np.eye(2),
                "longpole": _BY_STANDARD, "latpole": _BY_STANDARD}
        csys = casatools.coordsys()
        csys.fromrecord(self.csys | {"direction0": self.csys["direction0"] | axes})
        return SkyPlane(csys.torecord(), shape)

    def trimmed(self, edges) -> SkyPlane:
        """Return the plane without so many pixels at either end of x and of y."""
        sky = self.csys["direction0"]
        csys = self.csys | {"direction0": sky | {"crpix": np.asarray(sky["crpix"]) - edges}}
        return SkyPlane(csys, tuple(n - 2 * edge for n, edge in zip(self.shape, edges)))


@dataclass(frozen=True)
class SkyImage:
    """One image plane.

    Attributes
    ----------
    name : str
    pixels : float32 (nx, ny)
        Indexed [ix, iy]; all finite.
    unit : str
        'Jy/pixel', 'Jy/beam' or ''.
    beam : tuple or None
        Major and minor axis in arcsec (FWHM), position angle in degrees from north through east.
    plane : SkyPlane
    parameters : dict
        Task parameters in the history, name → text as written; 'taskname' and 'version' too.
    """

    name: str
    pixels: np.ndarray
    unit: str
    beam: tuple[float, float, float] | None
    plane: SkyPlane
    parameters: dict[str, str] = field(default_factory=dict)

    def flux_on(self, plane: SkyPlane) -> np.ndarray:
        """Return a Jy/pixel image on the pixels of another plane, float64, the flux kept but for what lies beyond."""
        place = PixelMap(self.plane.coordinates(), plane)
        return on_plane(self.pixels, place, plane.shape).astype(float)

    def brightness_on(self, plane: SkyPlane) -> np.ndarray:
        """Return a Jy/beam image interpolated at the pixels of another plane, float64, NaN beyond this image."""
        place = PixelMap(_whole(plane).coordinates(), self.plane)
        return interpolated(self.pixels, place, plane.shape)

    def overlaps(self, plane: SkyPlane) -> bool:
        """Tell whether any pixel of this image can be a pixel of the other plane."""
        here, there = self.plane, plane
        apart = _angle(_converted(here, there.frame), there.centre)
        reach = sum(0.5 * np.hypot(*(n * cell for n, cell in zip(p.shape, p.cell_rad))) for p in (here, there))
        if apart >= reach:
            return False
        x, y = PixelMap(here.coordinates(), there)(*_outline(here.shape))
        far = [(x < -0.5).all(), (y < -0.5).all(), (x > there.shape[0] - 0.5).all(), (y > there.shape[1] - 0.5).all()]
        return not any(far)

    def upright(self) -> SkyImage:
        """Return this Jy/pixel image with x to the west and y to the north (see :meth:`SkyPlane.upright`)."""
        plane = self.plane.upright()
        return self if plane is self.plane else replace(self, pixels=self.flux_on(plane).astype(np.float32),
                                                        plane=plane)


def read_sky_image(name, parameter, units, holes=False, stokes="I"):
    """Read one image plane, of several Stokes parameters that of one.

    Parameters
    ----------
    name : str
        A CASA image, or a FITS file.
    parameter : str
        Task parameter that named it, for messages.
    units : sequence of str or None
        What is right here: out of 'Jy/pixel', 'Jy/beam', ''; units that can be converted to these are. None takes any.
    holes : bool
        Pixels may be masked, or not finite, and are NaN then; else the mask is not looked at.
    stokes : str
        Which of the Stokes parameters, where there are several; of an image of one, I.

    Returns
    -------
    SkyImage

    Raises
    ------
    FileNotFoundError, ValueError
        It is absent, no image of the sky, more than one plane, in another unit, or not finite everywhere.
    """
    if not os.path.exists(name):
        raise FileNotFoundError(f"{parameter} = '{name}' does not exist: it takes a CASA image or a FITS file")
    try:
        with opened_image(name) as ia:
            shape, given, beam = tuple(int(n) for n in ia.shape()), ia.brightnessunit(), ia.restoringbeam()
            csys, history = ia.coordsys(), ia.history(list=False)
            check_sky_axes(name, parameter, csys)
            several = stokes_of(ia)
            if int(np.prod(shape[2:])) != max(len(several), 1):
                raise ValueError(f"{parameter} = '{name}' has the shape {list(shape)}: should be one Stokes, one "
                                 "channel")
            if len(several) < 2 or stokes not in several:
                check_stokes_i(name, parameter, csys)
            number = several.index(stokes) if stokes in several else 0
            pixels = read_pixels(ia, number=number)
            if holes:
                pixels[~read_pixels(ia, getmask=True, number=number) | ~np.isfinite(pixels)] = np.nan
    except (RuntimeError, UnicodeDecodeError) as error:
        raise ValueError(f"{parameter} = '{name}' cannot be read as an image: {str(error).strip()}") from error
    unit, factor = unit_in(units, name, parameter, given, csys)
    pixels *= np.float32(factor)
    if not holes:
        check_finite(name, parameter, pixels)
    return SkyImage(name, pixels, unit, beam_numbers(beam), SkyPlane(safe_record(csys), shape[:2]),
                    parameters_of(history))


def unit_in(units, name, parameter, given, csys):
    """Return unit and factor of an image in unit `given`; raise where it is none of `units`, None taking any."""
    unit, factor = unit_of(given, csys)
    if units is not None and unit not in units:
        right = " or ".join(f"'{word}'" for word in units if word)
        hint = "; the model is the image before it is convolved with the beam" if unit == "Jy/beam" else ""
        raise ValueError(f"{parameter} = '{name}' is in '{given}': should be in {right}{hint}")
    return unit, factor


def check_finite(name, parameter, pixels):
    """Raise unless all pixels are finite."""
    bad = int(np.sum(~np.isfinite(pixels)))
    if bad:
        raise ValueError(f"{parameter} = '{name}' holds {bad} pixels that are not finite (NaN): all should be numbers")


def read_header(name, cube=False):
    """Return the beam of an image, None where it has none, and the task parameters in its history.

    Of a cube that is a list with the beam of each channel.
    """
    with opened_image(name) as ia:
        record, parameters = ia.restoringbeam(), parameters_of(ia.history(list=False))
        channels = range(int(np.prod(ia.shape()[2:]))) if cube else ()
    beams = [beam_numbers(record, channel) for channel in channels or (0,)]
    return (beams if cube and None not in beams else None if cube else beams[0]), parameters


def check_sky_axes(name, parameter, csys):
    """Raise unless the first two axes are of the sky; bring these to radians."""
    if list(csys.axiscoordinatetypes()[:2]) != ["Direction", "Direction"]:
        raise ValueError(f"{parameter} = '{name}' has the axes {', '.join(csys.names())}: should begin with right "
                         "ascension and declination")
    csys.setunits(["rad", "rad", *csys.units()[2:]])


def unit_of(text, csys):
    """Return unit and factor of :func:`brightness_unit`; Jy/sr is brought to Jy/pixel by the solid angle of a pixel.

    Parameters
    ----------
    text : str
        A unit as other software spells it.
    csys : casatools.coordsys
        Directions in radians.
    """
    unit, factor = brightness_unit(text)
    if unit != "Jy/sr":
        return unit, factor
    sky = csys.torecord()["direction0"]
    return "Jy/pixel", factor * float(abs(np.prod(sky["cdelt"]) * np.linalg.det(sky["pc"])))


def stokes_of(ia):
    """Return the Stokes parameters of an open image that has several, [] of others."""
    csys = ia.coordsys()
    stokes = list(csys.stokes()) if csys.findcoordinate("stokes")["return"] else []
    return stokes if len(stokes) > 1 and len(stokes) in ia.shape()[2:] else []


def check_stokes_i(name, parameter, csys):
    """Raise unless an image is of Stokes I, or says nothing of it."""
    stokes = csys.stokes() if csys.findcoordinate("stokes")["return"] else ["I"]
    if stokes[0] in ("Q", "U", "V"):
        raise ValueError(f"{parameter} = '{name}' is of Stokes {stokes[0]}: should be of Stokes I, as what it is "
                         "compared with")


def beam_numbers(record, channel=0):
    """Return CASA's restoring beam, or that of a channel, as plain numbers, None where there is none."""
    import casatools

    record = record.get("beams", {}).get(f"*{channel}", {}).get("*0", record)
    if not record or "major" not in record:
        return None
    qa = casatools.quanta()
    major, minor = (float(qa.convert(record[axis], "arcsec")["value"]) for axis in ("major", "minor"))
    angle = record.get("positionangle", record.get("pa"))
    return major, minor, float(qa.convert(angle, "deg")["value"])


def parameters_of(history):
    """Return the task parameters in the lines of a history; of several runs the last one counts."""
    parameters = {}
    for line in history:
        line = line.strip()
        if line.startswith("version:"):
            parameters["version"] = line.removeprefix("version:").strip()
        elif match := _PARAMETER.fullmatch(line):
            name, text = match[1], match[2].strip()
            parameters[name] = text[1:-1] if len(text) > 1 and text[0] == text[-1] == '"' else text
    return parameters


def _whole(plane):
    """Return the plane as a SkyPlane, whatever has its csys and shape."""
    return SkyPlane(plane.csys, tuple(plane.shape))


def _converted(plane, frame):
    """Return the centre of a plane in another frame, in radians."""
    import casatools

    me = casatools.measures()
    me.doframe(plane.csys["obsdate"])
    longitude, latitude = (f"{float(angle)!r}rad" for angle in plane.centre)
    found = me.measure(me.direction(plane.frame, longitude, latitude), frame)
    return found["m0"]["value"], found["m1"]["value"]


def _angle(one, other):
    """Return the angle between two directions, in radians."""
    (lon1, lat1), (lon2, lat2) = one, other
    haversine = np.sin((lat2 - lat1) / 2) ** 2 + np.cos(lat1) * np.cos(lat2) * np.sin((lon2 - lon1) / 2) ** 2
    return 2 * np.arcsin(np.sqrt(min(haversine, 1.0)))


def _outline(shape):
    """Return pixel coordinates (2, N) all around an image and across it."""
    x, y = np.meshgrid(*(np.linspace(-0.5, n - 0.5, 9) for n in shape))
    return np.array([x.ravel(), y.ravel()])
