"""Sources that are consistent with a point, and are modelled as one.

The prior prefers smooth sources, and where a source is faint the data do not contradict it: an unresolved source comes
out as wide as the beam, and too faint where it is.  Of a source that leaves nothing significant when one point is taken
out of the data, the simplest model is that point (:mod:`casa_sara.solver.point_sources`).
"""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.ndimage import label, maximum_filter, shift

from casa_sara.solver.convolution import convolve_valid
from casa_sara.solver.matched_filter import MatchedFilter, distance, gaussian
from casa_sara.solver.point_sources import PointSources

__all__ = ["unresolved"]

REACH = 1.75  # beams around a point in which there must be nothing else
FITS = 3.5  # standard deviations that may be left
BRIGHTEST = 300.0  # S/N above which six pixels hold a source between pixels less well than the data need
TEMPLATES, TEMPLATE_REACH = 3, 2.5  # widths at which what is left is looked at; their reach in beams
ALL_BUT = 1.5  # times as much flux as the point has, at most, and five standard deviations


def unresolved(filter_: MatchedFilter, gradient: np.ndarray, model: np.ndarray, support: np.ndarray,
               allowed: np.ndarray, significance: float) -> tuple[np.ndarray, PointSources]:
    """Find the sources in a support that one point explains.

    Parameters
    ----------
    filter_ : MatchedFilter
        The templates of points and Gaussians.
    gradient : real (nx, ny)
        Φ†Σ⁻¹(y − Φx).
    model : real (nx, ny)
        x.
    support : bool (nx, ny)
        Where emission is significant.
    allowed : bool (nx, ny)
        Where the pixels of a point may be.
    significance : float
        Least S/N of a point.

    Returns
    -------
    support : bool (nx, ny)
        With the pixels of the points, and without what is around them.
    points : PointSources
    """
    snr = filter_.snr(filter_.spectrum(gradient), 0) + filter_.nearby(model, 0)
    peaks = (snr == maximum_filter(snr, int(filter_.beam) | 1)) & (snr >= significance) & (snr < BRIGHTEST) & support
    peaks = np.argwhere(peaks)
    patch = _Patch(filter_)
    margin = patch.outer
    gradient, model, free = np.pad(gradient, margin), np.pad(model, margin), np.pad(allowed, margin)
    given_up, places = np.zeros_like(free), []
    for peak, level in zip(peaks + margin, snr[tuple(peaks.T)]):
        place = patch.point_at(gradient, model, peak, level)
        if place is None:
            continue
        point = PointSources([place])
        if free[point.x, point.y].all():  # inside, and no pixel is another point's
            free[point.x, point.y] = False
            given_up[patch.around(peak)] |= patch.disc
            places.append(place)
    points = PointSources(np.array(places).reshape(-1, 2) - margin)
    given_up = given_up[tuple(slice(margin, margin + n) for n in support.shape)]
    support = _without_fragments(support & ~given_up, given_up, patch.beam_area)
    return support | points.pixels(support.shape), points


def _without_fragments(support, given_up, area):
    """A support without the parts smaller than this at points given up: remains of a source's surroundings."""
    labels, number = label(support)
    sizes = np.bincount(labels.ravel(), minlength=number + 1)
    beside = np.zeros(number + 1, bool)
    beside[labels[maximum_filter(given_up, 3)]] = True
    beside[0] = False
    return support & ~(beside & (sizes < area))[labels]


class _Patch:
    """The surroundings of one source: `disc` is bool (2r + 1, 2r + 1)."""

    def __init__(self, filter_):
        self.reach = int(np.ceil(REACH * filter_.beam)) + 1
        self.outer = self.reach + int(np.ceil(TEMPLATE_REACH * filter_.beam))
        self.disc = distance((2 * self.reach + 1,) * 2) <= REACH * filter_.beam
        self.beam_area = np.pi / 4 * filter_.beam**2
        self._looked_at = distance((2 * self.outer + 1,) * 2) <= REACH * filter_.beam
        half = self.reach + self.outer
        centre = [n // 2 + half for n in filter_.shape]
        padded = np.pad(filter_.psf, half)
        self._psf = padded[tuple(slice(c - half, c + half + 1) for c in centre)]
        self._noise = float(self._psf[half, half]) ** -0.5
        self._size = [fft.next_fast_len(4 * self.outer + 1, real=True)] * 2
        templates = [gaussian(self.outer, filter_.widths[k]) / filter_.norm(k)
                     for k in range(min(TEMPLATES, len(filter_.widths)))]
        self._templates = fft.rfft2(np.array(templates), self._size)

    def around(self, pixel):
        """Slices of the patch around a pixel."""
        return tuple(slice(k - self.reach, k + self.reach + 1) for k in pixel)

    def point_at(self, gradient, model, peak, snr):
        """The place of the one point that explains what is around a peak of this S/N; None where none does."""
        near = model[self.around(peak)] * self.disc
        if near.sum() > self._noise * (ALL_BUT * snr + 5):
            return None
        wide = tuple(slice(k - self.outer, k + self.outer + 1) for k in peak)
        # the gradient of the data without the other sources
        alone = gradient[wide] + convolve_valid(self._psf, near)
        o = self.outer
        offset = [_vertex(alone[o - 1:o + 2, o]), _vertex(alone[o, o - 1:o + 2])]
        inner = slice(self.reach - 3, len(self._psf) - self.reach + 3)
        psf = shift(self._psf[inner, inner], offset, order=3)[3:-3, 3:-3]
        left = self._filtered(alone - (alone[o, o] / psf[o, o]) * psf)
        if np.abs(left[:, self._looked_at]).max() >= FITS:
            return None
        return [k + by for k, by in zip(peak, offset)]

    def _filtered(self, left):
        """What is left, in standard deviations, by every template."""
        filtered = fft.irfft2(fft.rfft2(left, self._size) * self._templates, self._size)
        return filtered[:, self.outer:3 * self.outer + 1, self.outer:3 * self.outer + 1]


def _vertex(three):
    """Where the parabola through three values has its maximum, −1 … 1 from the middle."""
    curvature = three[0] - 2 * three[1] + three[2]
    return float(np.clip(0.5 * (three[0] - three[2]) / curvature, -1, 1)) if curvature < 0 else 0.0
