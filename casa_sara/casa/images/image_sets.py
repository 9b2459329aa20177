"""The products of one imager with a common root: model, residual, beam, history and record."""

from __future__ import annotations

import ast
import os
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from casa_sara.casa.images.fits_files import opened_image
from casa_sara.casa.images.products import DRAWS, RECORD
from casa_sara.casa.images.record import read_record
from casa_sara.casa.images.sky_cube import SkyCube, read_sky_cube
from casa_sara.casa.images.sky_image import SkyImage, read_header, read_sky_image, stokes_of

__all__ = ["ImageSet", "check_same_data", "data_names", "has_channels", "read_frames", "read_image_set",
           "read_polarised"]

_SUFFIXES = ("", ".fits", ".fits.gz")
_NAMES = (".model", ".model.fits", ".model.fits.gz", ".fits", ".fits.gz")


@dataclass(frozen=True)
class ImageSet:
    """The images of one run.

    Attributes
    ----------
    name : str
        How the comparison calls it.
    model : SkyImage or SkyCube
        Jy/pixel.
    residual : SkyImage, SkyCube or None
        Jy/beam.
    beam : (float, float, float), list of these or None
        Of the restored image, else of the residual or the PSF: arcsec, arcsec, degrees; of each channel of a cube.
    parameters : dict
        Task parameters in the history of the images.
    record : dict
        What tsara recorded, else empty.
    draws : str
        File of the draws of a bootstrap, '' where there is none.
    spectra : str
        Image of the model at several frequencies, '' where its spectra were not solved for.
    pb : str
        Image of the primary beam, '' where there is none.
    polarised : dict of SkyImage
        The models of 'Q' and 'U', where the image has both beside I.
    """

    name: str
    model: SkyImage | SkyCube
    residual: SkyImage | SkyCube | None = None
    beam: tuple[float, float, float] | list[tuple[float, float, float]] | None = None
    parameters: dict[str, str] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    draws: str = ""
    spectra: str = ""
    pb: str = ""
    polarised: dict[str, SkyImage] = field(default_factory=dict)

    def called(self, name):
        """Return the same with another name."""
        return replace(self, name=name)

    @property
    def data(self) -> set[str]:
        """The MeasurementSets in the history, without their folders; empty if it has none."""
        return _data(self)

    @property
    def weighting(self) -> str:
        """'natural', 'uniform' or 'briggs' according to the history, '' if it has no weighting."""
        return self.parameters.get("weighting", "")


def has_channels(given):
    """Tell whether a product is a cube; False where there is none, or no image, which reading it explains."""
    try:
        with opened_image(_model_path(given, "models")[0]) as ia:
            return len(ia.shape()) > 2 and int(np.prod(ia.shape()[2:])) > max(1, len(stokes_of(ia)))
    except (FileNotFoundError, RuntimeError):
        return False


def read_image_set(given, name="", with_residual=True, cube=False):
    """Read the products with one name.

    Parameters
    ----------
    given : str
        Common root of the images, the model image itself, or a FITS file.
    name : str
        What to call it; '' is the root without its folder.
    with_residual : bool
        Read the residual image, where there is one.
    cube : bool
        They are cubes, whose channels are read when they are asked for.

    Returns
    -------
    ImageSet

    Raises
    ------
    FileNotFoundError, ValueError
        There is no model, or an image is not as it should be.
    """
    path, root = _model_path(given, "models")
    read = read_sky_cube if cube else read_sky_image
    model = read(path, "models", ("Jy/pixel",))
    found = _beside(root, ".residual")
    residual = read(found, "models", ("Jy/beam", "")) if found and with_residual else None
    parameters, beams = {}, []
    for kind in (".image", ".residual", ".psf"):
        beam, of_image = read_header(_beside(root, kind), cube) if _beside(root, kind) else (None, {})
        beams.append(beam)
        parameters |= of_image
    record = root + RECORD
    return ImageSet(name or os.path.basename(root), model, residual, next(filter(None, beams), None),
                    parameters | model.parameters, _of_stokes_i(read_record(record)) if os.path.isfile(record) else {},
                    root + DRAWS if os.path.isfile(root + DRAWS) else "", _beside(root, ".subbands"),
                    _beside(root, ".pb"), {} if cube else read_polarised(path, "models"))


def read_polarised(name, parameter):
    """Return the images of Q and U, by name, of an image in Jy/pixel that has both; else {}.

    Parameters
    ----------
    name : str
        A CASA image, or a FITS file.
    parameter : str
        Task parameter that named it, for messages.

    Returns
    -------
    dict of SkyImage
    """
    with opened_image(name) as ia:
        there = {"Q", "U"} <= set(stokes_of(ia))
    return {stokes: read_sky_image(name, parameter, ("Jy/pixel",), stokes=stokes) for stokes in "QU"} if there else {}


def _of_stokes_i(record):
    """Return a record with the entries of Stokes I at its top, as that of an image of Stokes I has them."""
    return record | next((one for one in record.get("stokes") or [] if one.get("stokes") == "I"), {})


def read_frames(names, plane):
    """Read models of one sky on different pixels, to be shown one after the other.

    Parameters
    ----------
    names : sequence of str
        As the products are given.
    plane : SkyPlane
        Its centre is theirs.

    Returns
    -------
    tuple of (str, float32 (nx, ny), float)
        Name without folder, model in Jy/pixel and pixel size in arcsec.

    Raises
    ------
    FileNotFoundError, ValueError
        There is but one, a model is absent or not as it should be, or lies otherwise on the sky.
    """
    if len(names) == 1:
        raise ValueError(f"frames = {list(names)}: should be two or more images, in the order to show them")
    frames = []
    for given in names:
        path, root = _model_path(given, "frames")
        image = read_sky_image(path, "frames", ("Jy/pixel",)).upright()
        cell = np.degrees(image.plane.cell_rad) * 3600
        if not image.plane.is_aligned(plane):
            raise ValueError(f"frames = '{given}' has another centre than the first of models: should be "
                             "images of one field, with a pixel on one centre")
        if not np.isclose(*cell, rtol=1e-6):
            raise ValueError(f"frames = '{given}' has pixels of {cell[0]:.4g} x {cell[1]:.4g} arcsec: should be square")
        frames.append((os.path.basename(root), image.pixels, float(cell[1])))
    return tuple(frames)


def check_same_data(sets):
    """Raise ValueError when the histories of the products name different MeasurementSets."""
    first, *others = [(one, one.data) for one in sets if one.data] or [(None, None)]
    for other, data in others:
        if data != first[1]:
            pair = [f"'{one.name}' ({', '.join(sorted(names))})" for one, names in (first, (other, data))]
            raise ValueError(f"models: {' and '.join(pair)} are made from different data, so their residuals cannot be "
                             "compared: give vis, from which all residuals are then made")


def _model_path(given, parameter):
    """Return the path of the model image and the root of the names beside it."""
    given = given.rstrip("/")
    if os.path.exists(given):
        for suffix in (".model.fits.gz", ".model.fits", ".model", ".fits.gz", ".fits"):
            if given.endswith(suffix):
                return given, given.removesuffix(suffix)
        if os.path.isfile(os.path.join(given, "table.dat")) or os.path.isfile(given):
            return given, given
    for suffix in _NAMES:
        if os.path.exists(given + suffix):
            return given + suffix, given
    tried = ", ".join(f"'{given}{suffix}'" for suffix in _NAMES)
    raise FileNotFoundError(f"{parameter} = '{given}': neither it nor {tried} exists: should be the images' common "
                            "root, a model image or a FITS file")


def _beside(root, kind):
    """Return the path of one more image of the root, '' where there is none."""
    return next((root + kind + suffix for suffix in _SUFFIXES if os.path.exists(root + kind + suffix)), "")


def _data(one):
    """Return the names of the MeasurementSets in a history, without their folders."""
    text = one.parameters.get("vis", "")
    try:
        value = ast.literal_eval(text)
    except (SyntaxError, ValueError):
        value = text
    return data_names(value if isinstance(value, (list, tuple)) else [value])


def data_names(vis):
    """Return MeasurementSets by their names without folders, to tell whether they are the same."""
    return {os.path.basename(str(name).rstrip("/")) for name in vis if str(name)}
