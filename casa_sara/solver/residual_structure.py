"""The last look: the islands of the model, and whether its residual is noise."""

from __future__ import annotations

from itertools import zip_longest

import numpy as np

from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.islands import islands_of
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.matched_filter import BEAMS
from casa_sara.solver.record import SolverRecord
from casa_sara.solver.significance import gradient_image, matched_filter

__all__ = ["STRUCTURE", "look_at", "structure_of"]

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
    filters, record.residual_snr = _looked(ppd, bounds)
    record.islands = []
    for part, (model, filter_) in enumerate(zip(ppd.planes.looked_at(ppd.model), filters)):
        islands = ppd.comm.once(islands_of, model, filter_.psf, ppd.unit_jy, ppd.sky_over_image)
        record.islands += islands if part == 0 else [island | dict(part=part) for island in islands]
    return _largest(record.residual_snr) > STRUCTURE


def structure_of(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds) -> float:
    """Return the largest S/N of the residual over a beam or more.

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose residual is looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.

    Returns
    -------
    float
    """
    return _largest(_looked(ppd, bounds)[1])


def _looked(ppd, bounds):
    """Return the matched filter of each part of the sky, and the largest S/N of the residual at every width."""
    filters = [matched_filter(ppd, bounds, part) for part in range(len(ppd.planes.parts))]
    gradients = ppd.planes.means(gradient_image(ppd, bounds, ppd.model))
    peaks = [ppd.comm.once(_peaks, *one) for one in zip(filters, gradients)]
    return filters, [max(of_width, key=lambda peak: peak["snr"]) for of_width in zip_longest(
        *peaks, fillvalue=dict(snr=-np.inf))]


def _largest(peaks):
    """The largest S/N over a beam or more; 0 where the image has no room for one."""
    return max((peak["snr"] for peak in peaks if peak["beams"] >= 1), default=0.0)


def _peaks(filter_, gradient):
    """Largest |S/N| of the residual at every width."""
    spectrum = filter_.spectrum(gradient)
    return [dict(beams=beams, snr=float(np.abs(filter_.snr(spectrum, scale)).max()))
            for scale, beams in enumerate(BEAMS[:len(filter_.widths)])]
