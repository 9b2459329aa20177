"""Regions of the sky as masks: circles given by coordinates and radius, CRTF and DS9 files or lines."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from astropy.coordinates import Angle, SkyCoord
from astropy.wcs import WCS
from regions import CirclePixelRegion, CircleSkyRegion, PixCoord, PixelRegion, Regions, SkyRegion

__all__ = ["Frame", "places", "region_masks"]

RIGHT = "a circle as '19h59m28.3s +40d44m02s 1.5arcsec', or a CRTF or DS9 file or line; 'name = ' may stand before it"


@dataclass(frozen=True)
class Frame:
    """Where an image is, in SIN projection: `centre_deg` of pixel (nx//2, ny//2), `cell_arcsec` (x, y) and `shape`.

    `radesys` is FITS's word for the frame: 'FK5' is CASA's J2000, 'FK4' its B1950.
    """

    centre_deg: tuple[float, float]
    cell_arcsec: tuple[float, float]
    shape: tuple[int, int]
    radesys: str = "FK5"

    @property
    def wcs(self) -> WCS:
        """The astropy WCS; x runs to the west."""
        return self._wcs(self.cell_arcsec[0])

    @property
    def square_wcs(self) -> WCS:
        """The same with pixels that are as wide as they are high: regions keep their shape only on these."""
        return self._wcs(self.cell_arcsec[1])

    def square_x(self, x: np.ndarray) -> np.ndarray:
        """Return pixel coordinates x on the square pixels.

        Parameters
        ----------
        x : float or float (n,)
            Pixel coordinates along x.

        Returns
        -------
        float or float (n,)
        """
        middle = self.shape[0] // 2
        return (x - middle) * self.cell_arcsec[0] / self.cell_arcsec[1] + middle

    def _wcs(self, width):
        wcs = WCS(naxis=2)
        wcs.wcs.ctype = ["RA---SIN", "DEC--SIN"]
        wcs.wcs.radesys = self.radesys
        wcs.wcs.equinox = 1950.0 if self.radesys == "FK4" else 2000.0
        wcs.wcs.crval = self.centre_deg
        wcs.wcs.crpix = [n // 2 + 1 for n in self.shape]
        wcs.wcs.cdelt = [-width / 3600, self.cell_arcsec[1] / 3600]
        return wcs


def region_masks(texts: Sequence[str], frame: Frame, parameter: str = "regions") -> dict[str, np.ndarray]:
    """Return the regions as masks, by name.

    A region's name is what stands before ' = ', else its label in the file, else the text or the file's name; a
    number is added where a name comes again. A pixel belongs to a region when its centre does.

    Parameters
    ----------
    texts : sequence of str
        Each is a circle 'RA DEC RADIUS', a line in CRTF or DS9 syntax, or the path of a file of such lines.
    frame : Frame
        The grid of the image on the sky.
    parameter : str
        Task parameter, for messages.

    Returns
    -------
    dict of bool (nx, ny)

    Raises
    ------
    ValueError, FileNotFoundError
        A text is no region, a file is absent, a region is not on the sky, excludes, holds no pixel, or reaches beyond
        the image.
    """
    masks: dict[str, np.ndarray] = {}
    for text in texts:
        given, _, body = text.rpartition(" = ") if " = " in text and not os.path.exists(text) else ("", "", text)
        found = _parse(body.strip(), text, parameter)
        for region in found:
            label = region.meta.get("label") or region.meta.get("text") or _short(body.strip())
            name = _unused(given.strip() or str(label).strip("{}'\""), masks)
            masks[name] = _mask(region, frame, f"{parameter} = '{text}'")
    return masks


def places(texts: Sequence[str], frame: Frame, parameter: str) -> dict[str, tuple[float, float]]:
    """Return positions 'RA DEC' as pixel coordinates, by their texts.

    Parameters
    ----------
    texts : sequence of str
        Each is 'RA DEC', as '19h59m28.4s +40d44m02s'.
    frame : Frame
        The grid of the image on the sky.
    parameter : str
        Task parameter, for messages.

    Returns
    -------
    dict
        Text → (x, y), pixels.

    Raises
    ------
    ValueError
        A text is no position, or one outside the image.
    """
    found = {}
    for text in texts:
        wrong = f"{parameter} = '{text}' is not a position: should be right ascension and declination, as " \
                "'19h59m28.3s +40d44m02s'"
        if len(text.split()) != 2:
            raise ValueError(wrong)
        try:
            place = SkyCoord(text)
        except Exception as error:  # of many kinds, from the parser
            raise ValueError(f"{wrong} ({error})") from None
        x, y = (float(axis) for axis in frame.wcs.world_to_pixel(place))
        if not (0 <= x <= frame.shape[0] - 1 and 0 <= y <= frame.shape[1] - 1):  # NaN beyond the horizon
            raise ValueError(f"{parameter} = '{text}' is outside the image, which is centred on {_spell(frame)}")
        found[text] = x, y
    return found


def _parse(body, text, parameter):
    """Return the regions that one text stands for."""
    wrong = f"{parameter} = '{text}' is not a region: should be {RIGHT}"
    if os.path.isfile(body):
        with open(body, encoding="utf-8") as file:
            body = file.read()
    elif "[[" not in body and "(" not in body:
        return [_circle(body, wrong)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a line that is not understood must not be left out
            found = list(_regions(body))
    except Exception as error:  # of many kinds, from the parsers
        raise ValueError(f"{wrong} ({error})") from None
    if not found:
        raise ValueError(f"{wrong}; it holds none")
    for region in found:
        if not isinstance(region, SkyRegion):
            raise ValueError(f"{parameter} = '{text}' is in pixels, of an unknown image: should be in right ascension "
                             "and declination")
        if not region.meta.get("include", True):
            raise ValueError(f"{parameter} = '{text}' excludes a part of the sky: should hold regions to measure in")
    return found


def _regions(body):
    """Return the regions of a text in CASA's or DS9's format."""
    if not body.startswith("#CRTF") and "[[" not in body:
        return Regions.parse(body, format="ds9")
    lines = [line for line in body.splitlines() if not line.startswith("#")]
    if "coord" not in body and "pix" not in body:  # of the image, says CASA; the parser takes it for pixels
        lines.insert(0, "global coord=J2000")
    return Regions.parse("\n".join(["#CRTFv0", *lines]), format="crtf")


def _circle(body, wrong):
    """Return the circle 'RA DEC RADIUS'."""
    words = body.split()
    if len(words) != 3:
        if body.endswith((".crtf", ".reg", ".txt")):
            raise FileNotFoundError(f"{wrong.split(' is not')[0]} does not exist: should be {RIGHT}")
        raise ValueError(wrong)
    try:
        centre, radius = SkyCoord(f"{words[0]} {words[1]}"), Angle(words[2])
    except Exception as error:  # of many kinds, from the parsers
        raise ValueError(f"{wrong} ({error})") from None
    if not radius.deg > 0:
        raise ValueError(f"{wrong}; the radius should be positive")
    return CircleSkyRegion(centre, radius)


def _mask(region, frame, given):
    """Return one region as a mask."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pixel = _on_pixels(region, frame)
    box = pixel.bounding_box if np.isfinite(_centre(pixel)).all() else None
    left, right = (frame.square_x(edge - 0.5) + 0.5 for edge in (0, frame.shape[0]))
    top = frame.shape[1]
    if box is None or box.ixmin >= right or box.iymin >= top or box.ixmax <= left or box.iymax <= 0:
        raise ValueError(f"{given} is outside the image, which is centred on {_spell(frame)}")
    if box.ixmin < left or box.iymin < 0 or box.ixmax > right or box.iymax > top:
        raise ValueError(f"{given} reaches beyond the image, which is centred on {_spell(frame)}: should be inside")
    x, y = np.indices(frame.shape)
    mask = np.asarray(pixel.contains(PixCoord(frame.square_x(x), y)), bool)
    if not mask.any():
        cell = " x ".join(f"{size:.3g}" for size in frame.cell_arcsec)
        raise ValueError(f"{given} is empty: no pixel centre is inside, pixels are {cell} arcsec")
    return mask


def _on_pixels(region, frame) -> PixelRegion:
    """Return the region in square pixels; a circle with its exact radius."""
    if isinstance(region, CircleSkyRegion):
        x, y = frame.square_wcs.world_to_pixel(region.center)
        return CirclePixelRegion(PixCoord(float(x), float(y)), region.radius.to_value("arcsec") / frame.cell_arcsec[1])
    return region.to_pixel(frame.square_wcs)


def _centre(pixel):
    """Return the pixel coordinates of a region, of its corners where it has no centre."""
    place = pixel.center if hasattr(pixel, "center") else pixel.vertices if hasattr(pixel, "vertices") else None
    return np.array([0.0]) if place is None else np.array([place.x, place.y], float)


def _spell(frame):
    extent = " x ".join(f"{n * cell:.4g}" for n, cell in zip(frame.shape, frame.cell_arcsec))
    return f"{SkyCoord(*frame.centre_deg, unit='deg').to_string('hmsdms', precision=2)} and has {extent} arcsec"


def _short(text):
    return os.path.splitext(os.path.basename(text))[0] if os.path.isfile(text) else text


def _unused(name, masks):
    number, unused = 1, name
    while unused in masks:
        number += 1
        unused = f"{name} {number}"
    return unused
