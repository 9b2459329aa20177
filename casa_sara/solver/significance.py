"""The support of the model: the pixels where the data show emission at the requested significance.

Noise is fitted by positive pixels as a carpet of islands of one or two standard deviations, and no penalty that leaves
faint sources alone removes it.  The model is therefore confined to a support, found anew at every re-weighting: pixels
around what a matched filter of some width (a point, one, two, four or eight beams) finds at the significance asked
for.  Within it the prior needs to hold less (:mod:`casa_sara.solver.l1_weights`).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.islands import faint_islands
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.matched_filter import MatchedFilter
from casa_sara.solver.point_sources import PointSources
from casa_sara.solver.unresolved import unresolved

__all__ = ["SignificantSupport", "gradient_image", "matched_filter"]

GROWN = 0.5  # of the significance, down to which the surroundings belong to a source
SURE = 10.0  # times the significance: what is believed of a model that nothing confines yet
FAINT, CORE, RIM = 0.3, 0.5, 0.5  # of the significance, beside emission deeper than the core, to the rim (in widths)
PIXELS = 8  # across a width, at least, where cores are looked for
EXCESS, MOST_EXCESS = 1.25, 3.0  # residual over the noise found, from which on its own noise counts; more is sky
MEDIAN_TO_SIGMA = 1.482602218505602


class SignificantSupport:
    """The support of the model, and the point sources in it.

    The first support holds what is sure of the first model, later ones what is significant in the residual and in the
    model that the support before allowed.  A level never lies below the sidelobes of what is still left.  Templates
    go from narrow to wide, and what the narrow ones have found counts as known for the wide ones.  Where the residual
    image is noisier than the visibilities say (calibration errors), the significance is in units of its own noise.

    Parameters
    ----------
    significance : float
        Standard deviations asked for, > 0.
    begun : bool
        Whether there is a support already.

    """

    def __init__(self, significance: float, begun: bool = False) -> None:
        self.significance, self.begun = float(significance), bool(begun)
        self._noise_weights: np.ndarray | None = None  # for which there are a point response and a filter
        self._psfs: list[np.ndarray] = []
        self._filters: list[MatchedFilter | None] = []

    def update(self, ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, calibration: Any = None) -> int:
        """Confine the model to what is significant now.

        Parameters
        ----------
        ppd : AdaptivePPD
            Its support is changed, and its point sources.
        bounds : GivenBounds or AdaptiveBounds
            Whose noise levels are the noise.
        calibration : object or None
            What knows which artefacts errors of the antenna gains make of a model, by `artefacts(model, noise_weights,
            in_doubt)`: they are not emission.

        Returns
        -------
        int
            Pixels of the support.
        """
        planes = ppd.planes
        gradient = gradient_image(ppd, bounds, ppd.model)
        if self._noise_weights is None or not np.array_equal(self._noise_weights, bounds.noise_weights):
            self._psfs = [point_response(ppd, bounds, part) for part in range(len(planes.parts))]
            self._filters, self._noise_weights = [None] * len(planes.parts), bounds.noise_weights
        whole = without = planes.means(gradient)
        if self.begun and calibration is not None:
            artefacts = calibration.artefacts(ppd.model, bounds.noise_weights, partial(self._faint, ppd))
            if artefacts is not None:
                without = planes.means(gradient - artefacts)
        images = zip(whole, without, planes.means(ppd.model), planes.allowed(ppd.confined_to, ppd.model))
        found = [ppd.comm.once(self._found, part, *image, ppd.positivity, ppd.measurement.workers.count)
                 for part, image in enumerate(images)]
        self.begun = True
        supports, points = zip(*found)
        ppd.support_only(planes.joined(supports), planes.points(points, ppd.model.shape))
        return int(sum(map(np.count_nonzero, supports)))

    def _faint(self, ppd, snr):
        """The part of the model whose islands have less than a signal-to-noise ratio."""
        faint = [ppd.comm.once(faint_islands, model, psf, snr)
                 for model, psf in zip(ppd.planes.means(ppd.model), self._psfs)]
        return np.where(ppd.planes.joined(faint), ppd.model, ppd.model.dtype.type(0))

    def _found(self, part, whole, gradient, model, allowed, positivity, workers):
        """Return the support of one part of the sky and the point sources in it; `whole` is with artefacts."""
        self._filters[part] = filter_ = self._filters[part] or MatchedFilter(self._psfs[part], workers)
        signed = (lambda snr: snr) if positivity else np.abs
        spectrum = filter_.spectrum(gradient)
        if not self.begun:
            snr = signed(filter_.snr(spectrum, 0) + filter_.nearby(model, 0))
            level = np.clip(filter_.sidelobe * snr.max(), self.significance, SURE * self.significance)
            support = _connected(snr, level)
        else:
            noisy = spectrum if whole is gradient else filter_.spectrum(whole)
            excess = _excess(filter_.snr(noisy, 0), model == 0)
            support = self._grown(filter_, spectrum, model, signed, self.significance * excess)
        if not positivity or not support.any():
            return support, PointSources()
        return unresolved(filter_, gradient, model, support, allowed, self.significance)

    def _grown(self, filter_, spectrum, model, signed, significance):
        """The support of a model that a support has confined already, of what is as significant."""
        found = np.zeros(model.shape, bool)
        rim, empty = found.copy(), model == 0
        for scale, width in enumerate(filter_.widths):
            snr = filter_.snr(spectrum, scale)
            level = max(significance, filter_.sidelobe * float(signed(snr).max(initial=0, where=empty)))
            snr += filter_.nearby(np.where(found, 0, model), scale)
            snr = signed(snr)
            found |= _connected(snr, level)
            if scale and level == significance:
                rim |= _around_cores(found, width) & (snr >= FAINT * significance)
        return found | rim

    def state(self) -> dict[str, Any]:
        """Return what the next call depends on, beside the state of the iteration."""
        return dict(significance=self.significance, begun=self.begun)


def matched_filter(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, part: int = 0) -> MatchedFilter:
    """Return the :class:`MatchedFilter` of the data with the present noise levels.

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose model is looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.
    part : int
        Number of the part of the sky.

    Returns
    -------
    MatchedFilter
    """
    return MatchedFilter(point_response(ppd, bounds, part), ppd.measurement.workers.count)


def point_response(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, part: int = 0) -> np.ndarray:
    """Return Φ†Σ⁻¹Φ of a pixel of 1 in the middle of an image, real (nx, ny).

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose model is looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.
    part : int
        Number of the part of the sky.

    Returns
    -------
    real (nx, ny)
    """
    vis, image, planes = ppd.scratch_vis, ppd.scratch_image, ppd.planes
    planes.set_pixel(image, tuple(n // 2 for n in planes.split(image)[part].shape), part)
    ppd.measurement.forward(image, vis)
    vis *= _whitening(ppd, bounds)
    return planes.means(ppd.adjoint(vis, image))[part].copy()


def gradient_image(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, model: np.ndarray) -> np.ndarray:
    """Return Φ†Σ⁻¹(y − Φx), real (nx, ny).

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose model is looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.
    model : real (nx, ny)
        x, in the unit of the iteration.

    Returns
    -------
    real (nx, ny)
    """
    vis = ppd.scratch_vis
    ppd.measurement.forward(model, vis)
    np.subtract(ppd.vis, vis, out=vis)
    vis *= _whitening(ppd, bounds)
    image = ppd.adjoint(vis, ppd.scratch_image).copy()
    if ppd.correction is not None:
        image -= ppd.correction * image.dtype.type(bounds.noise_weights.sum() / ppd.multipliers.sum())
    return image


def _whitening(ppd, bounds):
    """1/σ² of every sample."""
    return np.repeat(bounds.noise_weights.astype(ppd.precond.dtype), np.diff(ppd.offsets))


def _connected(snr, level):
    """Regions above GROWN × level that hold a pixel above the level."""
    labels, number = label(snr >= GROWN * level)
    chosen = np.zeros(number + 1, bool)
    chosen[labels[snr >= level]] = True
    chosen[0] = False
    return chosen[labels]


def _around_cores(found, width):
    """What is within RIM widths of the parts of a support that are CORE widths deep, on a grid of suitable step."""
    step = max(1, int(width // PIXELS))
    cores = distance_transform_edt(found[::step, ::step]) * step >= CORE * width
    if not cores.any():
        return np.zeros_like(found)
    around = distance_transform_edt(~cores) * step <= (CORE + RIM) * width
    return np.repeat(np.repeat(around, step, axis=0), step, axis=1)[:found.shape[0], :found.shape[1]]


def _excess(snr, empty):
    """Noise of the residual image where the model is empty, over what it should be; 1 where it is not much more."""
    values = snr[empty] if 5 * np.count_nonzero(empty) > snr.size else snr
    noise = MEDIAN_TO_SIGMA * float(np.median(np.abs(values)))
    return min(noise, MOST_EXCESS) if noise > EXCESS else 1.0
