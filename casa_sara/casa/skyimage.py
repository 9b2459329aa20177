"""Images of any imager, CASA or FITS: pixels, unit, beam, coordinates, and the task parameters in their history."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field

import numpy as np

from casa_sara.casa.imageplane import read_pixels
from casa_sara.casa.regrid import PixelMap, corners, interpolated, on_plane
from casa_sara.casa.tools import opened, safe_record

__all__ = ["SkyImage", "SkyPlane", "beam_numbers", "read_header", "read_sky_image"]

_SPELLINGS = {"jy/pixel": "Jy/pixel", "jy/pix": "Jy/pixel", "jy/beam": "Jy/beam", "jy/bm": "Jy/beam", "": ""}
_PARAMETER = re.compile(r"(\w+)\s*=\s*(.*)")
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
        increments = self.coordinates().increment()["numeric"][:2]
        return tuple(float(abs(step)) for step in increments)

    @property
    def centre(self) -> tuple[float, float]:
        """Longitude and latitude in radians of pixel (nx//2, ny//2)."""
        return self.direction(*(n // 2 for n in self.shape))


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

    def is_aligned(self, plane: SkyPlane) -> bool:
        """Tell whether this image has the centre, axes and projection of the other, whatever its pixels."""
        found = PixelMap(self.plane.coordinates(), plane)(*corners(self.plane.shape))
        ratio = [[a / b] for a, b in zip(self.plane.cell_rad, plane.cell_rad)]
        offsets = corners(self.plane.shape) - [[n // 2] for n in self.plane.shape]
        expected = offsets * ratio + [[n // 2] for n in plane.shape]
        return bool(np.abs(found - expected).max() < _LARGEST_TURN * max(1, np.min(ratio)))


def read_sky_image(name, parameter, units):
    """Read one image plane.

    Parameters
    ----------
    name : str
        A CASA image, or a FITS file.
    parameter : str
        Task parameter that named it, for messages.
    units : sequence of str or None
        What is right here: out of 'Jy/pixel', 'Jy/beam', ''; None takes any.

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
        with opened("image", name) as ia:
            shape, unit, beam = tuple(int(n) for n in ia.shape()), ia.brightnessunit(), ia.restoringbeam()
            csys, history = ia.coordsys(), ia.history(list=False)
            _check_axes(name, parameter, shape, csys)
            csys.setunits(["rad", "rad", *csys.units()[2:]])
            pixels = read_pixels(ia)
    except (RuntimeError, UnicodeDecodeError) as error:
        raise ValueError(f"{parameter} = '{name}' cannot be read as an image: {str(error).strip()}") from error
    unit = _SPELLINGS.get(unit.lower(), unit)
    if units is not None and unit not in units:
        right = " or ".join(f"'{word}'" for word in units if word)
        hint = "; the model is the image before it is convolved with the beam" if unit == "Jy/beam" else ""
        raise ValueError(f"{parameter} = '{name}' is in '{unit}': should be in {right}{hint}")
    bad = int(np.sum(~np.isfinite(pixels)))
    if bad:
        raise ValueError(f"{parameter} = '{name}' holds {bad} pixels that are not finite (NaN): all should be numbers")
    return SkyImage(name, pixels, unit, beam_numbers(beam), SkyPlane(safe_record(csys), shape[:2]), _parameters(history))


def read_header(name):
    """Return the beam of an image, None where it has none, and the task parameters in its history."""
    with opened("image", name) as ia:
        return beam_numbers(ia.restoringbeam()), _parameters(ia.history(list=False))


def _check_axes(name, parameter, shape, csys):
    """Raise unless the axes are two of the sky and at most one plane of others."""
    axes = csys.axiscoordinatetypes()
    if len(shape) < 2 or list(axes[:2]) != ["Direction", "Direction"]:
        raise ValueError(f"{parameter} = '{name}' has the axes {', '.join(csys.names())}: should begin with right "
                         "ascension and declination")
    if int(np.prod(shape[2:])) != 1:
        raise ValueError(f"{parameter} = '{name}' has the shape {list(shape)}: should be one Stokes, one channel")
    stokes = csys.stokes() if csys.findcoordinate("stokes")["return"] else ["I"]
    if stokes[0] in ("Q", "U", "V"):
        raise ValueError(f"{parameter} = '{name}' is of Stokes {stokes[0]}: should be of Stokes I, which it is held against")


def beam_numbers(record):
    """Return CASA's restoring beam as plain numbers, None where there is none."""
    import casatools

    record = record.get("beams", {}).get("*0", {}).get("*0", record)
    if not record or "major" not in record:
        return None
    qa = casatools.quanta()
    major, minor = (float(qa.convert(record[axis], "arcsec")["value"]) for axis in ("major", "minor"))
    angle = record.get("positionangle", record.get("pa"))
    return major, minor, float(qa.convert(angle, "deg")["value"])


def _parameters(history):
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
