"""The islands of emission of the model, and the significance of the residual."""

from __future__ import annotations

from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects, label

from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.convolution import convolve_valid
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.matched_filter import BEAMS, SIGMA_TO_FWHM
from casa_sara.solver.record import SolverRecord
from casa_sara.solver.significance import gradient_image, matched_filter

__all__ = ["STRUCTURE", "add_flux_errors", "islands_of", "look_at"]

STRUCTURE = 5.0  # standard deviations over a beam or more, from which on a residual is not noise


def look_at(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, record: SolverRecord) -> bool:
    """Note in the record the islands of the model and the peaks of the residual, where a support confines the model.

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration at its end, whose model and residual are looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.
    record : SolverRecord
        `islands` and `residual_snr` are set; islands of other parts of the sky than the first have its number `part`.

    Returns
    -------
    bool
        Whether the residual holds structure of more than 5 standard deviations over more than a beam.
    """
    planes = ppd.planes
    filters = [matched_filter(ppd, bounds, part) for part in range(len(planes.parts))]
    gradients = planes.means(gradient_image(ppd, bounds, ppd.model))
    peaks = [ppd.comm.once(_peaks, *one) for one in zip(filters, gradients)]
    record.residual_snr = [max(of_width, key=lambda peak: peak["snr"]) for of_width in zip_longest(
        *peaks, fillvalue=dict(snr=-np.inf))]
    record.islands = []
    for part, (model, filter_) in enumerate(zip(planes.looked_at(ppd.model), filters)):
        islands = ppd.comm.once(islands_of, model, filter_.psf, ppd.unit_jy, ppd.sky_over_image)
        record.islands += islands if part == 0 else [island | dict(part=part) for island in islands]
    return any(entry["snr"] > STRUCTURE for entry in record.residual_snr if entry["beams"] >= 1)


def _peaks(filter_, gradient):
    """Largest |S/N| of the residual at every width."""
    spectrum = filter_.spectrum(gradient)
    return [dict(beams=beams, snr=float(np.abs(filter_.snr(spectrum, scale)).max()))
            for scale, beams in enumerate(BEAMS[:len(filter_.widths)])]


def islands_of(model: np.ndarray, psf: np.ndarray, unit_jy: float = 1.0,
               sky_over_image: np.ndarray | None = None) -> list[dict[str, Any]]:
    """List the connected regions of a model, the most significant first.

    Parameters
    ----------
    model : real (nx, ny)
        x.
    psf : real (nx, ny)
        Φ†Σ⁻¹Φ of a pixel of 1 at (nx // 2, ny // 2).
    unit_jy : float
        Jy in the unit of the model.
    sky_over_image : real (nx, ny), optional
        Of a mosaic, by which x is multiplied to be the sky.

    Returns
    -------
    list of dict
        `x`, `y` (pixel of the centroid), `x_peak`, `y_peak` (of the brightest pixel), `flux_jy`, `flux_error_jy`, `snr`
        (‖Σ^{−½}Φx_i‖, the square root of the χ² that the island explains; the error of the flux is that of its
        strength, its shape being known), `pixels` (area) and `fwhm_pixels` (of a circular Gaussian of the same second
        moments; 0 for a point between pixels, whose pixels have none).
    """
    labels, number = _labelled(model)
    found = []
    for index, box in zip(range(1, number + 1), find_objects(labels)):
        part = np.where(labels[box] == index, model[box], 0).astype(float)
        # moments of the flux, or of its modulus where both signs cancel
        size = part if 2 * abs(part.sum()) > np.abs(part).sum() else np.abs(part)
        total = size.sum()
        x, y = (np.arange(s.start, s.stop) for s in box)
        centre = [float(size.sum(axis=1) @ x / total), float(size.sum(axis=0) @ y / total)]
        spread = (size.sum(axis=1) @ (x - centre[0]) ** 2 + size.sum(axis=0) @ (y - centre[1]) ** 2) / total
        snr = float(np.sqrt(max(np.vdot(part, _response(part, psf)), 0.0)))
        flux = float((part if sky_over_image is None else part * sky_over_image[box]).sum() * unit_jy)
        peak = np.unravel_index(np.abs(part).argmax(), part.shape)
        found.append(dict(x=centre[0], y=centre[1], x_peak=int(x[peak[0]]), y_peak=int(y[peak[1]]), flux_jy=flux,
                          flux_error_jy=abs(flux) / max(snr, 1e-30), snr=snr, pixels=int(np.count_nonzero(part)),
                          fwhm_pixels=float(SIGMA_TO_FWHM * np.sqrt(max(0.5 * spread, 0.0)))))
    return sorted(found, key=lambda island: -island["snr"])


def _labelled(model):
    """Return the number of the island of each pixel, 0 where there is none, and how many there are."""
    return label(model != 0, np.ones((3, 3), int))


def add_flux_errors(islands: list[dict[str, Any]], model: np.ndarray, flux_errors: Callable[[np.ndarray], np.ndarray],
                    name: str) -> None:
    """Give the islands of a model the errors of their fluxes that draws find.

    The flux of a draw belongs to the nearest island, wherever in its surroundings the draw has it.

    Parameters
    ----------
    islands : list of dict
        Of :func:`islands_of`.
    model : real (nx, ny)
        x̂.
    flux_errors : callable
        Takes the number of the region of each pixel, int (nx, ny), and returns the error of each region's flux in Jy.
    name : str
        Of the entry.
    """
    if not islands:
        return
    labels, _ = _labelled(model)
    nearest = distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
    errors = flux_errors(labels[tuple(nearest)])
    for island in islands:
        island[name] = float(errors[labels[island["x_peak"], island["y_peak"]] - 1])


def _response(part, psf):
    """Φ†Σ⁻¹Φ of a part of the image, in that part."""
    nx, ny = part.shape
    cx, cy = (n // 2 for n in psf.shape)
    kernel = np.zeros((2 * nx - 1, 2 * ny - 1))
    left, low, right, high = min(cx, nx - 1), min(cy, ny - 1), min(psf.shape[0] - cx, nx), min(psf.shape[1] - cy, ny)
    kernel[nx - 1 - left:nx - 1 + right, ny - 1 - low:ny - 1 + high] = psf[cx - left:cx + right, cy - low:cy + high]
    return convolve_valid(kernel, part) if part.size > 1 else kernel * part
