"""The weights W of the ℓ1 prior: from the noise of each band, and from the model."""

from __future__ import annotations

import numpy as np

from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.noise_draws import draw_noise

__all__ = ["band_noise", "first_weights", "reweight"]

SHRINK = 0.95  # of κ with every re-weighting: long steps first, fine ones at the end
SLAB = 64  # lines squared at a time
SAMPLES, MOST_DRAWS = 100_000, 16  # realisations of the noise have so many samples together, or are so many
APPROXIMATIONS = 0.12  # of the prior on them within a support: they hold the flux, and little of the noise
SLOPES = 2.0  # docs/decisions.md, "Unknown spectra"
POINTS = 0.25  # of the prior, on sources that one point explains


def band_noise(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds,
               seed: int = 20180404) -> tuple[np.ndarray, float]:
    """Standard deviation of the noise in every band of the dictionary, and of a pixel, in the unit of the model.

    Realisations of the noise, weighted by 1/σ_j² as the data are, are carried to the image and normalised by the peak
    of the point spread function, Ψ†Φ†Σ⁻¹n / Σ_j σ_j⁻² Σ w: one of many samples, several of few, which say less.  The
    array of the weights W serves as scratch space, and so do those of `ppd`.

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose model is looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.
    seed : int
        Of the random numbers.

    Returns
    -------
    bands : float (number of bands,)
        In the order of `dictionary.bands()`.
    pixel : float
        Of a Dirac coefficient, which is a pixel divided by √(number of bases).
    """
    rng, noise, dictionary = np.random.default_rng(seed), ppd.scratch_vis, ppd.dictionary
    bands, pixel = np.zeros(len(dictionary.bands())), 0.0
    draws = int(np.clip(SAMPLES // sum(ppd.block_sizes), 1, MOST_DRAWS))
    for _ in range(draws):
        draw_noise(ppd, rng, np.sqrt(bounds.noise_weights), noise)
        image = ppd.adjoint(noise, ppd.scratch_image)
        coefs = dictionary.analysis(image, ppd.l1_weights)
        bands += [_mean_square(band.of(coefs)) for band in dictionary.bands()]
        pixel += _mean_square(ppd.planes.main(image))
    scale = bounds.total_weight * np.sqrt(draws)
    return np.maximum(np.sqrt(bands) / scale, 1e-30), np.sqrt(pixel / dictionary.n_bases) / scale


def _mean_square(values):
    slabs = (values[start : start + SLAB] for start in range(0, len(values), SLAB))
    return float(sum(np.square(slab, dtype=float).sum() for slab in slabs) / values.size)


def first_weights(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, confined: bool = False) -> None:
    """W = ν: the noise of every band in units of a pixel's, at least 1; those of the approximations less if `confined`.

    Where the beam spans many pixels, or short baselines abound, the noise lives in the coarse bands; there a
    threshold at the noise of one pixel would let it through.

    Parameters
    ----------
    ppd : AdaptivePPD
        Its `l1_weights` are set.
    bounds : GivenBounds or AdaptiveBounds
        Whose noise levels are the noise.
    confined : bool
        A support confines the model.
    """
    noise, pixel = band_noise(ppd, bounds)
    for band, scale in zip(ppd.dictionary.bands(), _band_scales(ppd, noise, pixel) * _shares(ppd, confined)):
        band.of(ppd.l1_weights)[...] = scale


def _band_scales(ppd, noise, pixel):
    """ν of every band: of slopes and higher orders of spectra twice as much, as they are smaller than the mean."""
    scales = np.maximum(noise / pixel, 1.0)
    if ppd.planes.n_planes > 1:
        scales[[band.order > 0 for band in ppd.dictionary.bands()]] *= SLOPES
    return scales


def _shares(ppd, confined):
    """Share of the prior that each band has."""
    return np.array([APPROXIMATIONS if confined and band.level and band.orientation == "aa" else 1.0
                     for band in ppd.dictionary.bands()])


def reweight(ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, scale: float, confined: bool = False) -> None:
    """W = ν α/(α + d̄), α = scale × the noise of the band, or of a pixel where that is less.

    Within a support of what is significant (`confined`) the coarse bands cannot fill with noise any more, and the prior
    may let go of them sooner: there α is scale × the noise of a coefficient of the model, that of a pixel over ν.
    Around point sources W is a quarter.

    Parameters
    ----------
    ppd : AdaptivePPD
        The iteration, whose model is looked at.
    bounds : GivenBounds or AdaptiveBounds
        Bounds of its blocks, from which the noise levels follow.
    scale : float
        Scale ω^k of the weights, at least that of the noise.
    confined : bool
        Whether the model is confined to what is significant.
    """
    noise, pixel = band_noise(ppd, bounds)
    scales = _band_scales(ppd, noise, pixel)
    alpha = scale * np.minimum(noise, pixel) / (scales if confined else 1.0)
    ppd.dictionary.reweight(ppd.model, alpha, scales * _shares(ppd, confined), ppd.l1_weights)
    if len(ppd.points):
        ppd.dictionary.scale_at(ppd.l1_weights, ppd.points.pixels(ppd.model.shape), POINTS)
    ppd.rescale(SHRINK * ppd.threshold)
    bounds.apply_to(ppd)
