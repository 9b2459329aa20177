"""The images of the errors that the draws of a bootstrap give."""

from __future__ import annotations

import numpy as np

from casa_sara.analysis.metrics import beam_pixels, smooth
from casa_sara.casa.images.restore import restored_beam
from casa_sara.casa.images.sky_image import beam_numbers
from casa_sara.reconstruction.draws import FEWEST, Draws

__all__ = ["error_images"]

ARCSEC = np.radians(1 / 3600)


def error_images(draws: Draws | None, jackknife: Draws | None, fitted: dict, restoringbeam: tuple[str, ...] | None,
                 cell_rad: tuple[float, float], pb: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return the error of the model, and those of the model smoothed to the restoring beam.

    Parameters
    ----------
    draws, jackknife : Draws or None
        Of a solution.
    fitted : dict
        Beam of the PSF, of :func:`casa_sara.casa.images.restore.fit_beam`.
    restoringbeam : tuple of str or None
        As of :class:`casa_sara.options.Output`.
    cell_rad : (float, float)
        Pixel size.
    pb : real (nx, ny), optional
        Primary beam of a mosaic, whose draws are of the sky, and whose restored image is the sky times that.

    Returns
    -------
    dict
        'model.error' in Jy/pixel and, where there is a restored image, 'image.error' and 'image.jackknife' in Jy/beam,
        float32 (nx, ny); those of which there are two draws or more.
    """
    both = ("error", draws), ("jackknife", jackknife)
    drawn = {name: one for name, one in both if one is not None and len(one) >= FEWEST}
    errors = {"model.error": draws.error()} if "error" in drawn else {}
    if restoringbeam is not None and drawn:
        *axes, angle = beam_numbers(restored_beam(list(restoringbeam), fitted))
        cell = tuple(size / ARCSEC for size in cell_rad)
        per_beam = beam_pixels(axes, cell)

        def restored(difference):
            return per_beam * smooth(difference if pb is None else difference * pb, axes, angle, cell)

        errors |= {f"image.{name}": one.error(restored) for name, one in drawn.items()}
    return errors
