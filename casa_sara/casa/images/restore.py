"""Restoring beam and restored image, made by the code behind tclean; images divided by the primary beam."""

from __future__ import annotations

import math
import os

import numpy as np

from casa_sara.casa.images.image_files import write_image
from casa_sara.casa.images.image_plane import read_pixels
from casa_sara.casa.runtime.quantities import radians
from casa_sara.casa.runtime.tools import made, opened, scratch_folder

__all__ = ["fit_beam", "restore", "restored_beam", "restoring_beam_words", "write_corrected"]

PSF_CUTOFF = 0.35  # of tclean: the Gaussian is fitted to the PSF above this fraction of its peak


def fit_beam(psf, plane):
    """Fit the restoring beam to the main lobe of the PSF.

    Parameters
    ----------
    psf : float32 (nx, ny), 1 at the centre
        The point spread function, 1 at its peak.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.

    Returns
    -------
    beam : dict
        {'major', 'minor', 'positionangle'}, each a CASA quantity.

    Raises
    ------
    ValueError
        The PSF has no main lobe that could be fitted.
    """
    import casatools

    utils = casatools.synthesisutils()
    with scratch_folder(psf.shape) as folder:
        root = os.path.join(folder, "beam")
        write_image(root + ".psf", psf, plane)
        try:
            utils.fitPsfBeam(imagename=root, nterms=1, psfcutoff=PSF_CUTOFF)
        finally:
            utils.done()
        with opened("image", root + ".psf") as ia:
            beam = ia.restoringbeam()
    cell = abs(plane.csys["direction0"]["cdelt"]).min() * 180 * 3600 / math.pi
    if not beam or not cell / 10 < beam["minor"]["value"] < math.inf:
        raise ValueError(f"no beam could be fitted to the PSF: cell = '{cell:.4g}arcsec' is too large, imsize = "
                         f"{list(psf.shape)} too small, or vis and its selection have too few baselines")
    return beam


def restoring_beam_words(restoringbeam):
    """Return tclean's `restoringbeam` as a list of strings, empty for the beam of each channel.

    Parameters
    ----------
    restoringbeam : str or sequence
        '' or [] for the fitted one, 'common' for the smallest that holds those of all channels (the same in an image
        of one channel), one angle for a circular beam, or [major, minor, position angle].

    Raises
    ------
    ValueError
        It is something else.
    """
    words = [restoringbeam] if isinstance(restoringbeam, str) else [str(word) for word in restoringbeam]
    words = [word.strip() for word in words if word.strip()]
    if words in ([], ["common"]):
        return words
    if len(words) not in (1, 3):
        raise ValueError(f"restoringbeam = {words} takes one angle, or [major, minor, position angle]")
    axes = [radians(word, "restoringbeam") for word in words[:2]]
    if min(axes) <= 0 or axes[0] < axes[-1]:
        raise ValueError(f"restoringbeam = {words}: the axes are positive, the major one first")
    if len(words) == 3:
        radians(words[2], "restoringbeam")
    return words


def restored_beam(words, fitted):
    """Return the beam of the restored image of one channel.

    Parameters
    ----------
    words : list of str
        Of `restoring_beam_words`.
    fitted : dict
        Of `fit_beam`.

    Returns
    -------
    dict
        {'major', 'minor', 'positionangle'}, each a CASA quantity.
    """
    import casatools

    if words in ([], ["common"]):
        return fitted
    major, minor, angle = words if len(words) == 3 else (words[0], words[0], "0deg")
    quantity = casatools.quanta().quantity
    return dict(major=quantity(major), minor=quantity(minor), positionangle=quantity(angle))


def restore(root, restoringbeam=(), specmode="mfs"):
    """Write `root`.image = `root`.model ∗ beam + `root`.residual, in Jy/beam.

    The residual is smoothed to the beam too, as in tclean, when the beam is not the fitted
    one and larger. Needs `root`.psf with its beam, `root`.residual and `root`.model.

    Parameters
    ----------
    root : str
        Name of the images without suffix.
    restoringbeam : str or sequence
        See `restoring_beam_words`.
    specmode : str
        'mfs' or 'cube'.
    """
    import casatools

    words = restoring_beam_words(restoringbeam)
    deconvolver = casatools.synthesisdeconvolver()
    try:
        deconvolver.setupdeconvolution(
            {
                "imagename": root,
                "deconvolver": "hogbom",
                "specmode": specmode,
                "usemask": "user",
                "startmodel": "",
                "restoringbeam": words if specmode == "cube" or words != ["common"] else [],
            }
        )
        deconvolver.restore()
    finally:
        deconvolver.done()
    made(root + ".image", f"restoringbeam = {words}")


def write_corrected(root, plane, model):
    """Write `root`.image.pbcor and `root`.model.pbcor: what was seen, divided by the primary beam.

    Below the limit of the primary beam they are zero and masked, as tclean's .image.pbcor. Needs `root`.image.

    Parameters
    ----------
    root : str
        Name of the images without suffix.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.
    model : float32 (nx, ny), or (n, nx, ny) of n channels or of n Stokes parameters, Jy/pixel
        The model.
    """
    with opened("image", root + ".image") as ia:
        image = np.array([read_pixels(ia, number=k) for k in range(plane.channels * plane.n_stokes)])
        beam = ia.restoringbeam()
    image = image.reshape(model.shape)
    if "beams" in beam and plane.n_stokes > 1:
        beam = beam["beams"]["*0"]["*0"]
    elif "beams" in beam:
        beam = [beam["beams"][f"*{k}"]["*0"] for k in range(plane.channels)]
    for name, pixels, unit, restored_with in ((".image", image, "Jy/beam", beam), (".model", model, "Jy/pixel", None)):
        corrected = np.divide(pixels, plane.pb, out=np.zeros_like(pixels), where=plane.mask)
        write_image(f"{root}{name}.pbcor", corrected, plane, unit=unit, beam=restored_with, masked=True)
